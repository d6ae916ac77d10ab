//! The slow part of a picture: a mean over neighbours.
#![expect(clippy::inline_always, reason = "only inlined code is compiled for its level")]

/// Neighbours to either side.
pub const REACH: usize = 2;
const WIDTH: usize = 2 * REACH + 1;

/// Mean over a square of [`REACH`] neighbours to either side, in place; `scratch` is as large. The borders
/// keep their values along the side that ends there. NaN spreads to its neighbours alone.
#[inline(always)]
pub fn box_filter(values: &mut [f32], scratch: &mut [f32], width: usize) {
    let height = values.len() / width;
    if width < WIDTH || height < WIDTH {
        return;
    }
    for (line, out) in values.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
        out[..REACH].copy_from_slice(&line[..REACH]);
        out[width - REACH..].copy_from_slice(&line[width - REACH..]);
        mean(std::array::from_fn(|d| &line[d..]), &mut out[REACH..width - REACH]);
    }
    let last = (height - REACH) * width;
    values[..REACH * width].copy_from_slice(&scratch[..REACH * width]);
    values[last..].copy_from_slice(&scratch[last..]);
    mean(std::array::from_fn(|d| &scratch[d * width..]), &mut values[REACH * width..last]);
}

#[inline(always)]
fn mean(neighbours: [&[f32]; WIDTH], out: &mut [f32]) {
    let [a, b, c, d, e] = neighbours.map(|line| &line[..out.len()]);
    for (i, out) in out.iter_mut().enumerate() {
        *out = (a[i] + b[i] + c[i] + d[i] + e[i]) * (1.0 / WIDTH as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slow_part_is_the_mean_of_five_by_five() {
        let (width, height) = (13, 9);
        let picture: Vec<f32> = (0..width * height).map(|i| ((i * 7) % 11) as f32).collect();
        let (mut values, mut scratch) = (picture.clone(), vec![-1.0; picture.len()]);
        box_filter(&mut values, &mut scratch, width);
        let line = |at: usize, end: usize| match at {
            _ if at < REACH || at + REACH >= end => at..=at,
            _ => at - REACH..=at + REACH,
        };
        for v in 0..height {
            for u in 0..width {
                let around = line(v, height).flat_map(|v| line(u, width).map(move |u| (u, v)));
                let greys: Vec<f32> = around.map(|(u, v)| picture[v * width + u]).collect();
                let mean = greys.iter().sum::<f32>() / greys.len() as f32;
                assert!((values[v * width + u] - mean).abs() < 1e-5, "{u} {v}");
            }
        }
    }

    #[test]
    fn what_is_not_seen_spreads_to_its_neighbours_alone() {
        let (mut values, mut scratch) = ([1.0f32; 144], [0.0; 144]);
        values[5 * 12 + 6] = f32::NAN;
        box_filter(&mut values, &mut scratch, 12);
        for (i, value) in values.iter().enumerate() {
            let near = (i / 12).abs_diff(5) <= REACH && (i % 12).abs_diff(6) <= REACH;
            assert_eq!(value.is_nan(), near, "{i}");
        }
    }
}
