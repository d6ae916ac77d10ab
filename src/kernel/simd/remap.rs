//! [`crate::kernel::scalar::remap`] for two groups at once: the window of each source row is loaded
//! whole and the neighbours of all pixels are picked from it by one shuffle.
//!
//! Cost: 1.5 bytes of map and 1 of output a pixel, and the image once.

use crate::image::Plane;
use crate::kernel::scalar::remap::{
    self as scalar, FRACTION_ONE, GROUP, POSITION_BITS, Source, WINDOW,
};
use fearless_simd::{Level, dispatch, i16x16, i32x8, prelude::*, u8x16, u8x32, u16x8, u16x16};

/// `dst` = bilinear values of `src`, one [`Source`] for each [`GROUP`] pixels.
pub fn remap(level: Level, src: Plane<'_>, map: &[Source], dst: &mut [u8]) {
    dispatch!(level, simd => remap_groups(simd, src, map, dst));
}

#[inline(always)]
fn remap_groups<S: Simd>(simd: S, src: Plane<'_>, map: &[Source], dst: &mut [u8]) {
    let (pairs, _) = dst.as_chunks_mut::<{ 2 * GROUP }>();
    let (sources, last) = map.as_chunks::<2>();
    for (out, [a, b]) in pairs.iter_mut().zip(sources) {
        if a.is_narrow() && b.is_narrow() && src.width() >= WINDOW {
            narrow_pair(simd, src, [a, b], out);
        } else {
            let (first, second) = out.split_at_mut(GROUP);
            scalar::remap(src, &[*a], first);
            scalar::remap(src, &[*b], second);
        }
    }
    scalar::remap(src, last, &mut dst[2 * GROUP * sources.len()..]);
}

#[inline(always)]
fn narrow_pair<S: Simd>(simd: S, src: Plane<'_>, pair: [&Source; 2], out: &mut [u8; 2 * GROUP]) {
    let [a, b] = pair;
    let (column_a, column_b) = (places(simd, a.x, a.dx), places(simd, b.x, b.dx));
    let x = column_a.combine(column_b);
    let y = places(simd, a.y, a.dy).combine(places(simd, b.y, b.dy));
    let fx = (x >> FRACTION_SHIFT) & (FRACTION_ONE - 1);
    let fy = (y >> FRACTION_SHIFT) & (FRACTION_ONE - 1);
    let gx = u16x16::splat(simd, FRACTION_ONE) - fx;
    let gy = u16x16::splat(simd, FRACTION_ONE) - fy;
    let row = y >> POSITION_BITS;
    let windows = [Window::new(src, a, column_a), Window::new(src, b, column_b)];
    let weights = [gx, fx];
    let here = across(simd, &windows, 1, weights);
    let lower = row.simd_eq(1);
    let mut above = lower.select(here, across(simd, &windows, 0, weights));
    let mut below = lower.select(across(simd, &windows, 2, weights), here);
    // Nearly every group crosses one row at most: more rows are a branch seldom taken.
    for v in 2..windows[0].rows.max(windows[1].rows) {
        let here = across(simd, &windows, v, weights);
        let in_row = row.simd_eq(v as u16);
        above = in_row.select(here, above);
        below = in_row.select(across(simd, &windows, v + 1, weights), below);
    }
    let low = weighted(above.zip_low(below), gy.zip_low(fy));
    let high = weighted(above.zip_high(below), gy.zip_high(fy));
    let values: i16x16<S> = low.narrow(high);
    let values: u16x16<S> = values.bitcast();
    let bytes: u8x32<S> = values.narrow(values);
    out.copy_from_slice(&bytes.as_slice()[..2 * GROUP]);
}

/// Bits of a position below those of its fraction.
const FRACTION_SHIFT: u32 = POSITION_BITS - FRACTION_ONE.ilog2();

/// Positions of a group's pixels along an axis.
#[inline(always)]
fn places<S: Simd>(simd: S, from: u16, step: i16) -> u16x8<S> {
    u16x8::simd_from(simd, [0, 1, 2, 3, 4, 5, 6, 7]) * (step as u16) + from
}

/// Where a group's pixels find their neighbours.
struct Window<'a, S: Simd> {
    /// From the window's first column, top row, on.
    pixels: &'a [u8],
    stride: usize,
    /// Rows in which a pixel has its upper neighbours.
    rows: usize,
    /// Columns of the left neighbours, then of the right ones.
    neighbours: u8x16<S>,
}

impl<'a, S: Simd> Window<'a, S> {
    #[inline(always)]
    fn new(src: Plane<'a>, source: &Source, x: u16x8<S>) -> Self {
        let column = x >> POSITION_BITS;
        let lowest = source.at(0)[1].max(source.at(GROUP - 1)[1]);
        Self {
            pixels: src.from(usize::from(source.left), usize::from(source.top)),
            stride: src.stride(),
            rows: usize::from(lowest >> POSITION_BITS) + 1,
            neighbours: column.narrow(column + 1),
        }
    }

    /// Left and right neighbours in row `v`, or in the last one below it.
    #[inline(always)]
    fn row(&self, simd: S, v: usize) -> (u16x8<S>, u16x8<S>) {
        let pixels = &self.pixels[v.min(self.rows) * self.stride..][..WINDOW];
        u8x16::from_slice(simd, pixels).swizzle_dyn(self.neighbours).widen()
    }
}

/// Both groups interpolated along row `v`, Q7.
#[inline(always)]
fn across<S: Simd>(
    simd: S,
    [a, b]: &[Window<'_, S>; 2],
    v: usize,
    [left, right]: [u16x16<S>; 2],
) -> u16x16<S> {
    let ((left_a, right_a), (left_b, right_b)) = (a.row(simd, v), b.row(simd, v));
    left_a.combine(left_b) * left + right_a.combine(right_b) * right
}

/// Sums of weighted pairs, Q14, rounded. Both factors are below 2^15, so that signed products do.
#[inline(always)]
fn weighted<S: Simd>(values: u16x16<S>, weights: u16x16<S>) -> i32x8<S> {
    let values: i16x16<S> = values.bitcast();
    let weights: i16x16<S> = weights.bitcast();
    let half = i32::from(FRACTION_ONE).pow(2) / 2;
    (values.pairwise_dot_product(weights) + half) >> 14
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::each_level;

    #[test]
    fn every_level_gives_the_bits_of_the_specification() {
        let mut state = 11u64;
        let mut random = move |below: f64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 11) as f64 / (1u64 << 53) as f64 * below
        };
        for size in [[16, 2], [17, 9], [64, 48], [9, 30]] {
            let [width, height] = size;
            let [w, h] = size.map(|n| n as f64 - 1.0);
            let noise: Vec<u8> = (0..width * height).map(|_| random(256.0) as u8).collect();
            // A stretch along the row, up to steep and wide ones; everywhere in the image.
            let mut map = Vec::new();
            for i in 0..4000 {
                let slope = [0.05, 0.3, 1.2, 4.0][i % 4];
                let first = [random(w), random(h)];
                let angle = random(std::f64::consts::TAU) * f64::from(u8::from(i % 3 == 0));
                let length = 7.0 * (0.2 + random(slope + 1.2));
                let last = [
                    first[0] + length * angle.cos(),
                    first[1] + length * angle.sin() * slope.min(1.0),
                ];
                map.extend(Source::between(first, last, size));
            }
            assert!(map.len() > 100, "{size:?}: {}", map.len());
            for fill in [Some(0), Some(255), None] {
                let data = fill.map_or_else(|| noise.clone(), |v| vec![v; width * height]);
                let plane = Plane::packed(&data, width, height).expect("packed");
                let mut expected = vec![0; map.len() * GROUP];
                scalar::remap(plane, &map, &mut expected);
                each_level(|level| {
                    let mut got = vec![0xa5; map.len() * GROUP];
                    remap(level, plane, &map, &mut got);
                    assert!(got == expected, "{level:?} {size:?} {fill:?}");
                });
            }
        }
    }
}
