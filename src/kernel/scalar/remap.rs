//! Bilinear remapping through a precomputed fixed-point map: the specification.
//!
//! The map holds one line of source positions for every [`GROUP`] output pixels: 1.5 bytes a
//! pixel. Between the ends of so short a stretch a lens is straight to a few thousandths of a
//! pixel.

use crate::image::Plane;

/// Fractions are in 1/128 px: two of them make weights that sum to 2^14 exactly.
pub const FRACTION_ONE: u16 = 128;
/// Output pixels that share a line of sources.
pub const GROUP: usize = 8;
/// Fractional bits of positions and steps.
pub const POSITION_BITS: u32 = 10;
/// A narrow group's sources lie in a window of so many columns, all inside the image.
pub const WINDOW: usize = 16;

/// Where [`GROUP`] output pixels come from: pixel `i` from (`left` + `x` + i `dx`,
/// `top` + `y` + i `dy`), positions and steps in Q10.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Source {
    /// Column that `x` counts from.
    pub left: u16,
    /// Row that `y` counts from.
    pub top: u16,
    /// Source column of the first pixel.
    pub x: u16,
    /// Source columns an output pixel.
    pub dx: i16,
    /// Source row of the first pixel.
    pub y: u16,
    /// Source rows an output pixel.
    pub dy: i16,
}

impl Source {
    /// The line from the source of a group's first pixel to that of its last; `None` when it is not
    /// wholly inside an image of `size_px`, or steeper than Q10 can hold.
    pub fn between(first: [f64; 2], last: [f64; 2], size_px: [usize; 2]) -> Option<Self> {
        let one = f64::from(1u32 << POSITION_BITS);
        let axis = |first: f64, last: f64, side: usize, window: usize| {
            let step = ((last - first) / (GROUP - 1) as f64 * one).round();
            // The ends as the kernel will compute them.
            let from = (first * one).round();
            let to = from + step * (GROUP - 1) as f64;
            let inside = from.min(to) >= 0.0 && from.max(to) < (side.checked_sub(1)? as f64) * one;
            let base =
                (from.min(to) / one).floor().min(side.saturating_sub(window) as f64).max(0.0);
            let rest = from - base * one;
            let fits = inside && from.max(to) - base * one < 65536.0;
            fits.then_some((base as u16, rest as u16, step as i16))
        };
        let (left, x, dx) = axis(first[0], last[0], size_px[0], WINDOW)?;
        let (top, y, dy) = axis(first[1], last[1], size_px[1], 0)?;
        Some(Self { left, top, x, dx, y, dy })
    }

    /// Position of pixel `i` from (`left`, `top`), Q10.
    pub fn at(&self, i: usize) -> [u16; 2] {
        let at = |from: u16, step: i16| from.wrapping_add((step as u16).wrapping_mul(i as u16));
        [at(self.x, self.dx), at(self.y, self.dy)]
    }

    /// Whether all sources lie in [`WINDOW`] columns and as many rows.
    pub fn is_narrow(&self) -> bool {
        let ([x0, y0], [x1, y1]) = (self.at(0), self.at(GROUP - 1));
        (x0.max(x1).max(y0).max(y1) >> POSITION_BITS) < WINDOW as u16 - 1
    }
}

/// `dst` = bilinear values of `src`, rounded to nearest, one [`Source`] for each [`GROUP`].
///
/// Sources are those of [`Source::between`] for the size of `src`.
pub fn remap(src: Plane<'_>, map: &[Source], dst: &mut [u8]) {
    let (groups, _) = dst.as_chunks_mut::<GROUP>();
    for (out, source) in groups.iter_mut().zip(map) {
        remap_group(src, source, out);
    }
}

fn remap_group(src: Plane<'_>, source: &Source, out: &mut [u8; GROUP]) {
    let one = u32::from(FRACTION_ONE);
    for (i, out) in out.iter_mut().enumerate() {
        let at = source.at(i);
        let [column, row] = at.map(|at| usize::from(at >> POSITION_BITS));
        let [fx, fy] = at.map(|at| u32::from(at >> (POSITION_BITS - 7)) % one);
        let (x, y) = (usize::from(source.left) + column, usize::from(source.top) + row);
        let (top, bottom) = (&src.row(y)[x..x + 2], &src.row(y + 1)[x..x + 2]);
        let t = u32::from(top[0]) * (one - fx) + u32::from(top[1]) * fx;
        let b = u32::from(bottom[0]) * (one - fx) + u32::from(bottom[1]) * fx;
        *out = ((t * (one - fy) + b * fy + one * one / 2) / (one * one)) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [40, 30];

    fn plane(data: &[u8]) -> Plane<'_> {
        Plane::packed(data, SIZE[0], SIZE[1]).expect("packed")
    }

    #[test]
    fn all_low_and_all_high_stay_so_everywhere() {
        for value in [0, 255] {
            let data = [value; SIZE[0] * SIZE[1]];
            for eighth in 0..200 {
                let x = f64::from(eighth) / 8.0;
                let source = Source::between([x, 0.7 * x], [x + 7.5, 0.7 * x + 2.1], SIZE);
                let mut out = [0xa5; GROUP];
                remap(plane(&data), &[source.expect("inside")], &mut out);
                assert_eq!(out, [value; GROUP]);
            }
        }
    }

    #[test]
    fn a_ramp_is_reproduced_to_half_a_grey_level() {
        let data: Vec<u8> =
            (0..SIZE[0] * SIZE[1]).map(|i| (i % SIZE[0] * 4 + i / SIZE[0] * 3) as u8).collect();
        let lines = [
            ([0.0, 0.0], [7.0, 0.0]),
            ([31.3, 3.1], [38.2, 3.9]),
            ([20.9, 28.4], [12.1, 20.2]),
            ([5.5, 2.0], [5.5, 9.0]),
            ([1.0, 1.0], [36.0, 1.5]),
        ];
        for (first, last) in lines {
            let source = Source::between(first, last, SIZE).expect("inside");
            let mut out = [0; GROUP];
            remap(plane(&data), &[source], &mut out);
            for (i, got) in out.into_iter().enumerate() {
                let t = i as f64 / (GROUP - 1) as f64;
                let [x, y] = [0, 1].map(|k| first[k] + t * (last[k] - first[k]));
                let exact = 4.0 * x + 3.0 * y;
                // Rounding, 1/128 px cut off from each coordinate, and steps of 1/1024 px.
                let bound = 0.5 + 7.0 / 128.0 + 7.0 * 7.0 / 1024.0;
                assert!((f64::from(got) - exact).abs() <= bound, "{first:?} {i}: {got} {exact}");
            }
        }
    }

    #[test]
    fn what_is_not_wholly_inside_has_no_source() {
        assert_eq!(Source::between([-0.1, 3.0], [7.0, 3.0], SIZE), None);
        assert_eq!(Source::between([33.0, 3.0], [39.0, 3.0], SIZE), None);
        assert_eq!(Source::between([3.0, 25.0], [3.0, 29.1], SIZE), None);
        assert_eq!(Source::between([0.0, 3.0], [90.0, 3.0], [200, 200]), None, "steeper than Q10");
        assert!(Source::between([32.0, 3.0], [38.9, 28.9], SIZE).is_some());
    }
}
