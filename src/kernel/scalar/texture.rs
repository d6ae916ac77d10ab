//! Belt texture: taking it out of a row of the view, and matching two rows: the specification.
//!
//! Texture is in 1/16 grey level on a plain belt, in coarser units on one of strong texture.
#![expect(clippy::inline_always, reason = "only inlined code is compiled for its level")]

use super::mixture::{Gain, observation};
use std::ops::Range;

/// Value of a pixel that shows no belt texture (foreground, not seen).
pub const NO_TEXTURE: i8 = i8::MIN;
/// Differences beyond this are shadows, dirt or parcels, not texture: 7 grey levels of 1/16.
pub const TEXTURE_MAX: u16 = 112;
/// A difference of Q7 is shifted by at least this: to 1/16 grey level.
const SHIFT_MIN: u32 = 3;
/// Texture reaches as far from the mean as this many standard deviations of the belt.
const REACH_SIGMA: f64 = 3.0;
/// Half width of the window whose mean is taken out of the texture.
pub const SHADING_PX: usize = 16;
/// Elements of the running sums of a row besides one a pixel.
pub const SUMS_BORDER: usize = 2 * SHADING_PX + 1;
/// Running sums hold the sum of the values above this bit, their number below it. Rows are
/// shorter than `2^COUNT_BITS`.
pub const COUNT_BITS: u32 = 13;

/// What the grey levels of a row are compared with.
#[derive(Clone, Copy, Debug)]
pub struct Belt<'a> {
    /// Mean of each pixel, Q7.
    pub mean: &'a [u16],
    /// Light of this frame.
    pub gain: Gain,
    /// A difference of Q7 is shifted by this: see [`texture_shift`].
    pub shift: u32,
}

/// Shift that lets the texture of a belt with this standard deviation fit into its 8 bits.
pub fn texture_shift(belt_sigma_grey: f64) -> u32 {
    let reach_grey = |shift: u32| f64::from(TEXTURE_MAX << shift) / 128.0;
    (SHIFT_MIN..SHIFT_MIN + 4)
        .find(|&shift| reach_grey(shift) >= REACH_SIGMA * belt_sigma_grey)
        .unwrap_or(SHIFT_MIN + 4)
}

/// Texture of a row: grey levels less the belt's mean. `covered`: bit mask of what is not belt.
pub fn extract(grey: &[u8], belt: Belt<'_>, covered: &[u64], out: &mut [i8]) {
    let Belt { mean, gain, shift } = belt;
    for (u, ((out, &grey), &mean)) in out.iter_mut().zip(grey).zip(mean).enumerate() {
        let x = observation(grey, gain);
        let size = x.abs_diff(mean) >> shift;
        let is_belt = size <= TEXTURE_MAX && covered[u / 64] >> (u % 64) & 1 == 0;
        let signed = if x > mean { size as i16 } else { -(size as i16) };
        *out = if is_belt { signed as i8 } else { NO_TEXTURE };
    }
}

/// Running sums of a row for [`remove_shading`], beginning [`SHADING_PX`] pixels before it;
/// `sums` has [`SUMS_BORDER`] elements more than the row. They wrap; their differences do not.
pub fn running_sums(row: &[i8], sums: &mut [i32]) {
    let (before, rest) = sums.split_at_mut(SHADING_PX + 1);
    before.fill(0);
    let (inside, after) = rest.split_at_mut(row.len());
    let mut sum = 0i32;
    for (out, &value) in inside.iter_mut().zip(row) {
        let is_texture = i32::from(value != NO_TEXTURE);
        sum = sum.wrapping_add(is_texture * ((i32::from(value) << COUNT_BITS) + 1));
        *out = sum;
    }
    after.fill(sum);
}

/// Take the local mean out of a row: shading that a parcel's height makes move faster than the belt
/// is smooth, the belt's own texture is not. `sums`: its [`running_sums`].
pub fn remove_shading(row: &mut [i8], sums: &[i32]) {
    let limit = i32::from(TEXTURE_MAX);
    for (u, value) in row.iter_mut().enumerate().filter(|(_, value)| **value != NO_TEXTURE) {
        let window = sums[u + SUMS_BORDER].wrapping_sub(sums[u]);
        let (sum, count) = (window >> COUNT_BITS, window & ((1 << COUNT_BITS) - 1));
        *value = (i32::from(*value) - sum / count).clamp(-limit, limit) as i8;
    }
}

/// Sums over the overlap of a key row and a current row.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sums {
    /// Sum of products.
    pub ab: i64,
    /// Sum of squares of the key row.
    pub aa: i64,
    /// Sum of squares of the current row.
    pub bb: i64,
    /// Pixel pairs with texture on both sides.
    pub n: u32,
}

impl Sums {
    /// Both together.
    #[must_use]
    pub fn plus(&self, more: &Self) -> Self {
        Self {
            ab: self.ab + more.ab,
            aa: self.aa + more.aa,
            bb: self.bb + more.bb,
            n: self.n + more.n,
        }
    }
}

/// The pixels of a key row and a current row, of these lengths, that lie on each other when the current one has moved by `shift`.
pub fn overlap_range(key: usize, current: usize, shift: isize) -> (Range<usize>, Range<usize>) {
    let first = shift.unsigned_abs();
    let (from, to) = if shift < 0 { (first.min(key), 0) } else { (0, first.min(current)) };
    let n = (key - from).min(current - to);
    (from..from + n, to..to + n)
}

/// The same pixels.
pub fn overlap<'a>(key: &'a [i8], current: &'a [i8], shift: isize) -> (&'a [i8], &'a [i8]) {
    let (from, to) = overlap_range(key.len(), current.len(), shift);
    (&key[from], &current[to])
}

/// Means over several frames, of a row.
pub struct Means<'a> {
    /// The means, rounded.
    pub texture: &'a mut [i8],
    /// The means.
    pub mean: &'a mut [f32],
    /// Frames in each.
    pub frames: &'a mut [u8],
}

/// Add a row to the means of fewer than `frames_max` frames, between two of its pixels: `fraction` of the way to the next.
/// `current` is one pixel longer.
#[inline(always)]
pub fn add_to_means(current: &[i8], fraction: f32, frames_max: u8, means: &mut Means<'_>) {
    let n = means.texture.len();
    let (left, right) = (&current[..n], &current[1..][..n]);
    let (mean, frames) = (&mut means.mean[..n], &mut means.frames[..n]);
    for i in 0..n {
        let is_known = left[i] != NO_TEXTURE && right[i] != NO_TEXTURE;
        let (here, next) = (f32::from(left[i]), f32::from(right[i]));
        let value = here + fraction * (next - here);
        let is_added = is_known && frames[i] < frames_max;
        let count = frames[i] + u8::from(is_added);
        let weight = if is_added { 1.0 / f32::from(count) } else { 0.0 };
        mean[i] += weight * (value - mean[i]);
        frames[i] = count;
        let rounded = (mean[i] + 0.5_f32.copysign(mean[i])) as i32 as i8;
        means.texture[i] = if count > 0 { rounded } else { NO_TEXTURE };
    }
}

/// Add the products of `key[i]` and `current[i + shift]` over their overlap.
pub fn correlate(key: &[i8], current: &[i8], shift: isize, sums: &mut Sums) {
    let (key, current) = overlap(key, current, shift);
    for (&a, &b) in key.iter().zip(current) {
        if a != NO_TEXTURE && b != NO_TEXTURE {
            let (a, b) = (i64::from(a), i64::from(b));
            sums.ab += a * b;
            sums.aa += a * a;
            sums.bb += b * b;
            sums.n += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_true_shift_correlates_fully_both_ways() {
        let texture: Vec<i8> = (0..200).map(|i: i32| (i * i % 17 - 8) as i8).collect();
        for (key, current, shift) in
            [(&texture[..150], &texture[20..170], -20), (&texture[20..170], &texture[..150], 20)]
        {
            let mut sums = Sums::default();
            correlate(key, current, shift, &mut sums);
            assert_eq!((sums.n, sums.ab), (130, sums.aa));
            assert_eq!(sums.aa, sums.bb);
        }
    }

    #[test]
    fn pixels_without_texture_do_not_count() {
        let mut sums = Sums::default();
        correlate(&[3, NO_TEXTURE, 5], &[3, 4, NO_TEXTURE], 0, &mut sums);
        assert_eq!(sums, Sums { ab: 9, aa: 9, bb: 9, n: 1 });
    }

    #[test]
    fn a_shift_beyond_the_row_adds_nothing() {
        let mut sums = Sums::default();
        correlate(&[1; 4], &[1; 4], 9, &mut sums);
        correlate(&[1; 4], &[1; 4], -9, &mut sums);
        assert_eq!(sums, Sums::default());
    }

    #[test]
    fn texture_is_the_difference_from_the_belt_where_it_is_small_and_free() {
        let mut out = [0; 4];
        let mean = [100 << 7; 4];
        let mut belt = Belt { mean: &mean, gain: Gain::ONE, shift: texture_shift(1.3) };
        extract(&[101, 98, 110, 101], belt, &[0b1000], &mut out);
        assert_eq!(out, [16, -32, NO_TEXTURE, NO_TEXTURE]);
        // A woven belt: the same difference is texture, in units twice as coarse.
        belt.shift = texture_shift(4.5);
        extract(&[101, 98, 110, 101], belt, &[0b1000], &mut out);
        assert_eq!(out, [8, -16, 80, NO_TEXTURE]);
    }

    #[test]
    fn shading_goes_and_texture_stays() {
        let texture = |u: usize| if u % 4 < 2 { 20 } else { -20 };
        let hidden = |u: usize| (90..110).contains(&u);
        let mut row: [i8; 200] = std::array::from_fn(|u| {
            let shading = (u as i32 - 100) / 2;
            if hidden(u) { NO_TEXTURE } else { (texture(u) + shading) as i8 }
        });
        let mut sums = [0; 200 + SUMS_BORDER];
        running_sums(&row, &mut sums);
        remove_shading(&mut row, &sums);
        for (u, &value) in row.iter().enumerate() {
            let error = i32::from(value) - texture(u);
            // At an end the mean is of one side: half the window's ramp, and the texture's own.
            let slack = SHADING_PX as i32 / 4 + 4;
            assert!(
                if hidden(u) { value == NO_TEXTURE } else { error.abs() <= slack },
                "{u} {value}"
            );
        }
    }
}
