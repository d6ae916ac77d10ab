//! [`crate::kernel::scalar::texture`] in vectors.

use super::mixture::brighten;
pub use crate::kernel::scalar::texture::Means;
use crate::kernel::scalar::texture::{
    self as scalar, Belt, COUNT_BITS, NO_TEXTURE, SUMS_BORDER, Sums, TEXTURE_MAX, overlap,
    running_sums,
};
use fearless_simd::{Level, dispatch, prelude::*};

/// Pixels whose sums of products fit 32 bits with room: 2^15 times 112^2.
const STRETCH: usize = 1 << 15;

/// Texture of a row, without its shading. All rows are whole blocks of 64 pixels; `covered` is a
/// bit mask of what is not belt, `sums` scratch of [`SUMS_BORDER`] elements more than the row.
pub fn extract(
    level: Level,
    grey: &[u8],
    belt: Belt<'_>,
    covered: &[u64],
    sums: &mut [i32],
    out: &mut [i8],
) {
    dispatch!(level, simd => {
        differences(simd, grey, belt, covered, out);
        running_sums(out, sums);
        remove_shading(out, sums);
    });
}

/// Add a row to the means of fewer than `frames_max` frames, between two of its pixels.
pub fn add_to_means(
    level: Level,
    current: &[i8],
    fraction: f32,
    frames_max: u8,
    means: &mut Means<'_>,
) {
    dispatch!(level, _simd => scalar::add_to_means(current, fraction, frames_max, means));
}

#[inline(always)]
fn differences<S: Simd>(
    simd: S,
    grey: &[u8],
    Belt { mean, gain, shift }: Belt<'_>,
    covered: &[u64],
    out: &mut [i8],
) {
    let n = S::u16s::LEN;
    for (k, out) in out.chunks_exact_mut(2 * n).enumerate() {
        let at = k * 2 * n;
        let (low, high) = S::u8s::from_slice(simd, &grey[at..at + 2 * n]).widen();
        let low_mean = S::u16s::from_slice(simd, &mean[at..at + n]);
        let high_mean = S::u16s::from_slice(simd, &mean[at + n..at + 2 * n]);
        let covered = covered[at / 64] >> (at % 64);
        let low = difference::<S>(simd, brighten::<S>(low, gain), low_mean, shift, covered);
        let high = difference::<S>(simd, brighten::<S>(high, gain), high_mean, shift, covered >> n);
        let bytes: S::u8s = low.narrow(high);
        for (out, &byte) in out.iter_mut().zip(bytes.as_slice()) {
            *out = byte as i8;
        }
    }
}

#[inline(always)]
fn difference<S: Simd>(simd: S, x: S::u16s, mean: S::u16s, shift: u32, covered: u64) -> S::u16s {
    let size = (x.max(mean) - x.min(mean)) >> shift;
    let is_belt = size.simd_le(TEXTURE_MAX) & !S::mask16s::from_bitmask(simd, covered);
    let signed = x.simd_gt(mean).select(size, !size + 1);
    is_belt.select(signed, S::u16s::splat(simd, NO_TEXTURE as u16))
}

#[inline(always)]
fn remove_shading(row: &mut [i8], sums: &[i32]) {
    let limit = f32::from(TEXTURE_MAX);
    for ((value, &from), &to) in row.iter_mut().zip(sums).zip(&sums[SUMS_BORDER..]) {
        let window = to.wrapping_sub(from);
        let (sum, count) = (window >> COUNT_BITS, window & ((1 << COUNT_BITS) - 1));
        // Quotients of such small numbers are cut off as integers are.
        let mean = (sum as f32 / count.max(1) as f32).trunc();
        let high = (f32::from(*value) - mean).clamp(-limit, limit);
        *value = if *value == NO_TEXTURE { NO_TEXTURE } else { high as i32 as i8 };
    }
}

/// Add the products of `key[i]` and `current[i + shift]` over their overlap.
pub fn correlate(level: Level, key: &[i8], current: &[i8], shift: isize, sums: &mut Sums) {
    let (key, current) = overlap(key, current, shift);
    for (key, current) in key.chunks(STRETCH).zip(current.chunks(STRETCH)) {
        dispatch!(level, _simd => products(key, current, sums));
    }
}

#[inline(always)]
fn products(key: &[i8], current: &[i8], sums: &mut Sums) {
    let (mut ab, mut aa, mut bb, mut n) = (0i32, 0i32, 0i32, 0u32);
    for (&a, &b) in key.iter().zip(current) {
        let both = a != NO_TEXTURE && b != NO_TEXTURE;
        let a = i32::from(if both { i16::from(a) } else { 0 });
        let b = i32::from(if both { i16::from(b) } else { 0 });
        ab += a * b;
        aa += a * a;
        bb += b * b;
        n += u32::from(both);
    }
    sums.ab += i64::from(ab);
    sums.aa += i64::from(aa);
    sums.bb += i64::from(bb);
    sums.n += n;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::scalar::mixture::Gain;
    use crate::kernel::simd::each_level;

    const N: usize = 5 * 64;

    fn random(seed: u64) -> impl FnMut() -> u64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            state >> 33
        }
    }

    type Row = ([i8; N], [f32; N], [u8; N]);

    fn means_of(mut add: impl FnMut(&[i8], f32, u8, &mut Means<'_>)) -> Row {
        let mut next = random(3);
        let mut row: Row = ([NO_TEXTURE; N], [0.0; N], [0; N]);
        for frames_max in [16, 16, 16, 16, 16, 3] {
            let current: [i8; N + 1] = std::array::from_fn(|i| {
                let grey = (next() % 225) as i8;
                if i < 8 || next().is_multiple_of(4) { NO_TEXTURE } else { grey }
            });
            let fraction = (next() % 1000) as f32 / 1000.0;
            let (texture, mean, frames) = (&mut row.0[..], &mut row.1[..], &mut row.2[..]);
            add(&current, fraction, frames_max, &mut Means { texture, mean, frames });
        }
        row
    }

    #[test]
    fn every_level_averages_as_the_specification() {
        let expected = means_of(scalar::add_to_means);
        assert!((0..=5).all(|frames| expected.2.contains(&frames)), "some of each");
        each_level(|level| {
            let add = |current: &[i8], fraction, most, means: &mut Means<'_>| {
                add_to_means(level, current, fraction, most, means);
            };
            assert_eq!(means_of(add), expected);
        });
    }

    #[test]
    fn every_level_extracts_the_texture_of_the_specification() {
        let (mut grey, mut cover) = (random(1), random(2));
        for case in 0..40 {
            let greys: [u8; N] = std::array::from_fn(|_| match case {
                0 => 0,
                1 => 255,
                2..20 => 60 + (grey() % 9) as u8,
                _ => grey() as u8,
            });
            let mean: [u16; N] = std::array::from_fn(|_| ((60 + grey() % 5) << 7) as u16);
            let covered: [u64; N / 64] =
                std::array::from_fn(|_| if case % 3 == 0 { 0 } else { cover() << 13 ^ cover() });
            let gain = Gain::from_q15(30000 + 200 * case);
            let belt = Belt { mean: &mean, gain, shift: 3 + case % 5 };
            let mut expected = [0; N];
            let mut sums = [0; N + SUMS_BORDER];
            scalar::extract(&greys, belt, &covered, &mut expected);
            running_sums(&expected, &mut sums);
            scalar::remove_shading(&mut expected, &sums);
            each_level(|level| {
                let (mut out, mut sums) = ([0x5a; N], [-1; N + SUMS_BORDER]);
                extract(level, &greys, belt, &covered, &mut sums, &mut out);
                assert!(out == expected, "{level:?} case {case}");
            });
        }
    }

    #[test]
    fn every_level_sums_the_products_of_the_specification() {
        let mut value = random(3);
        for (len, fill) in [
            (0, None),
            (1, None),
            (63, None),
            (500, None),
            (40_000, Some(-112)),
            (40_000, Some(112)),
            (70_000, None),
        ] {
            let mut row = || -> Vec<i8> {
                let any = |v: u64| if v.is_multiple_of(11) { NO_TEXTURE } else { (v % 225) as i8 };
                (0..len).map(|_| fill.unwrap_or_else(|| any(value()))).collect()
            };
            let (key, current) = (row(), row());
            for shift in [0, 1, 17, 64, -1, -33, 499, -900] {
                let mut expected = Sums::default();
                scalar::correlate(&key, &current, shift, &mut expected);
                each_level(|level| {
                    let mut sums = Sums::default();
                    correlate(level, &key, &current, shift, &mut sums);
                    assert_eq!(sums, expected, "{level:?} {len} {shift}");
                });
            }
        }
    }
}
