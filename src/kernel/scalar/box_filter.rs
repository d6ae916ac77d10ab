//! The slow part of a line: a mean over neighbours, in place.

/// Neighbours to either side.
pub const REACH: usize = 2;
const WIDTH: usize = 2 * REACH + 1;

/// Mean over [`REACH`] neighbours to either side of every `step`-th of `values`, `count` of them; the ends
/// stay. NaN spreads to its neighbours alone.
pub fn box_filter(values: &mut [f32], step: usize, count: usize) {
    if count < WIDTH {
        return;
    }
    // What the means have already overwritten: a ring of the last values.
    let mut ring = [0.0f32; WIDTH];
    for i in 0..2 * REACH {
        ring[i] = values[i * step];
    }
    for i in REACH..count - REACH {
        ring[(i + REACH) % WIDTH] = values[(i + REACH) * step];
        values[i * step] = ring.iter().sum::<f32>() / WIDTH as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slow_part_is_the_mean_of_five() {
        let values: Vec<f32> = (0..12).map(|i| ((i * 7) % 5) as f32).collect();
        let mut columns: Vec<f32> = values.iter().flat_map(|&v| [v, -1.0]).collect();
        box_filter(&mut columns, 2, values.len());
        for i in 0..12 {
            let inside = (2..10).contains(&i);
            let mean =
                if inside { values[i - 2..=i + 2].iter().sum::<f32>() / 5.0 } else { values[i] };
            assert!((columns[2 * i] - mean).abs() < 1e-5, "{i}");
        }
        assert!(columns.iter().skip(1).step_by(2).all(|&v| (v + 1.0).abs() < 1e-6));
    }

    #[test]
    fn what_is_not_seen_spreads_to_its_neighbours_alone() {
        let mut values = [1.0f32; 12];
        values[5] = f32::NAN;
        box_filter(&mut values, 1, 12);
        let unknown: Vec<usize> = (0..12).filter(|&i| values[i].is_nan()).collect();
        assert_eq!(unknown, [3, 4, 5, 6, 7]);
    }
}
