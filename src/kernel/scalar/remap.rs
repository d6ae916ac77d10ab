//! Bilinear remapping through a precomputed fixed-point map.

use crate::image::Plane;

/// Fractions are in 1/128 px: two of them make weights that sum to 2^14 exactly.
pub const FRACTION_ONE: u16 = 128;

/// Where one output pixel comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Source {
    /// Column of the upper left of four neighbours.
    pub x: u16,
    /// Row of the same.
    pub y: u16,
    /// Fraction along the row, 0 to 127.
    pub fx: u8,
    /// Fraction along the column, 0 to 127.
    pub fy: u8,
}

/// `dst[i]` = bilinear value of `src` at `map[i]`, rounded to nearest.
///
/// Every `x + 1`, `y + 1` of the map must lie inside `src`.
pub fn remap(src: Plane<'_>, map: &[Source], dst: &mut [u8]) {
    let one = u32::from(FRACTION_ONE);
    for (out, at) in dst.iter_mut().zip(map) {
        let x = usize::from(at.x);
        let top = &src.row(usize::from(at.y))[x..x + 2];
        let bottom = &src.row(usize::from(at.y) + 1)[x..x + 2];
        let (fx, fy) = (u32::from(at.fx), u32::from(at.fy));
        let t = u32::from(top[0]) * (one - fx) + u32::from(top[1]) * fx;
        let b = u32::from(bottom[0]) * (one - fx) + u32::from(bottom[1]) * fx;
        *out = ((t * (one - fy) + b * fy + one * one / 2) / (one * one)) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 5;

    fn remap_one(data: &[u8; SIDE * SIDE], at: Source) -> u8 {
        let mut out = [0xa5];
        remap(Plane::packed(data, SIDE, SIDE).expect("square"), &[at], &mut out);
        out[0]
    }

    #[test]
    fn all_low_and_all_high_stay_so_at_every_fraction() {
        for value in [0, 255] {
            for fx in 0..128 {
                for fy in 0..128 {
                    assert_eq!(remap_one(&[value; 25], Source { x: 1, y: 3, fx, fy }), value);
                }
            }
        }
    }

    #[test]
    fn a_ramp_is_reproduced_to_half_a_grey_level() {
        let ramp = std::array::from_fn(|i| (i % SIDE * 30 + i / SIDE * 20) as u8);
        for (fx, fy) in [(0, 0), (64, 0), (0, 64), (127, 127), (13, 99)] {
            let exact = 30.0 * (2.0 + f64::from(fx) / 128.0) + 20.0 * (1.0 + f64::from(fy) / 128.0);
            let got = f64::from(remap_one(&ramp, Source { x: 2, y: 1, fx, fy }));
            assert!((got - exact).abs() <= 0.5, "{fx} {fy}: {got} {exact}");
        }
    }
}
