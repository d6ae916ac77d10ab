//! [`crate::kernel::scalar::mixture`] for 64 pixels at once: all are classified in vectors, those
//! that belong to their main mode are learned in vectors, and the few that belong to a weaker
//! mode, or need one, are left to the specification.
//!
//! Cost: 1 byte of image, 4 of model read and 4 written a pixel of the common kind; 2 more of
//! each in a block that has a pixel with a second mode.

use crate::kernel::scalar::mixture::{
    Gain, MATCH_Q8, MEAN_GAINED, MINORS, Minor, PRIOR, Params, Pixel, REACH_MAX, SHADOW_MEAN_MIN,
    VARIANCE_GAINED, VARIANCE_MIN, observation,
};
use fearless_simd::{Level, dispatch, prelude::*};

/// A new mode of this weight would be the main one.
const OUTWEIGHS: u8 = 128;

/// Pixels of a block: the bits of a mask's word.
pub const BLOCK: usize = 64;

/// The model of a stretch of pixels, a whole number of blocks.
#[derive(Debug)]
pub struct Model<'a> {
    /// Means of the main mode, Q7.
    pub mean: &'a mut [u16],
    /// Variances of the main mode, Q6.
    pub variance: &'a mut [u16],
    /// Weaker modes, the heavier first.
    pub minors: [Minors<'a>; MINORS],
    /// Bit: the pixel has a second mode.
    pub multiple: &'a mut [u64],
}

/// One weaker mode of a stretch of pixels: see [`Minor`].
#[derive(Debug)]
pub struct Minors<'a> {
    /// Means, Q7.
    pub mean: &'a mut [u16],
    /// Standard deviations, Q3.
    pub deviation: &'a mut [u8],
    /// Weights, 1/255; 0: no mode.
    pub weight: &'a mut [u8],
}

impl Minors<'_> {
    fn get(&self, i: usize) -> Minor {
        Minor { mean: self.mean[i], deviation: self.deviation[i], weight: self.weight[i] }
    }

    fn block(&self, pixels: &std::ops::Range<usize>) -> MinorBlock<'_> {
        MinorBlock {
            mean: &self.mean[pixels.clone()],
            deviation: &self.deviation[pixels.clone()],
            weight: &self.weight[pixels.clone()],
        }
    }

    fn set(&mut self, i: usize, minor: Minor) {
        self.mean[i] = minor.mean;
        self.deviation[i] = minor.deviation;
        self.weight[i] = minor.weight;
    }
}

/// Bits of a stretch of pixels, a word for each block.
#[derive(Debug)]
pub struct Masks<'a> {
    /// Foreground, dark pixels included; shadows are none.
    pub foreground: &'a mut [u64],
    /// Dark pixels.
    pub dark: &'a mut [u64],
    /// Foreground at twice the distance that makes a pixel foreground.
    pub strong: &'a mut [u64],
}

/// Classify `grey`, a whole number of blocks, and learn it where the bits of `hold` are not set.
pub fn update(
    level: Level,
    grey: &[u8],
    model: &mut Model<'_>,
    hold: &[u64],
    masks: &mut Masks<'_>,
    params: &Params,
) {
    dispatch!(level, simd => update_blocks(simd, grey, model, hold, masks, params));
}

#[inline(always)]
fn update_blocks<S: Simd>(
    simd: S,
    grey: &[u8],
    model: &mut Model<'_>,
    hold: &[u64],
    masks: &mut Masks<'_>,
    params: &Params,
) {
    let new_weight = Minor::new(0, &params.rate).weight;
    let (greys, _) = grey.as_chunks::<BLOCK>();
    let (means, _) = model.mean.as_chunks_mut::<BLOCK>();
    let (variances, _) = model.variance.as_chunks_mut::<BLOCK>();
    let main = greys.iter().zip(means).zip(variances);
    let bits = hold.iter().zip(&mut *model.multiple);
    for (w, (((grey, mean), variance), (&hold, multiple))) in main.zip(bits).enumerate() {
        let (within, near) = if hold == 0 {
            follow::<S, true>(simd, grey, mean, variance, u64::MAX, params)
        } else {
            follow::<S, false>(simd, grey, mean, variance, !hold, params)
        };
        let mut shade = Shade::default();
        if within != u64::MAX {
            shade = main_shade(simd, grey, mean, variance, params);
            shade.background = within;
            if *multiple & !within != 0 {
                let pixels = w * BLOCK..(w + 1) * BLOCK;
                let [first, second] = &model.minors;
                let minors = [first.block(&pixels), second.block(&pixels)];
                add_minor_shades(simd, grey, &minors, params, &mut shade);
            }
            shade.settle();
        }
        // Where the main mode learns, the weaker ones fade.
        let fading = near & *multiple & !hold;
        if fading != 0 {
            let [first, second] = &mut model.minors;
            let lasting = fade(simd, &mut first.weight[w * BLOCK..][..BLOCK], fading, params)
                | fade(simd, &mut second.weight[w * BLOCK..][..BLOCK], fading, params);
            *multiple = (*multiple & !fading) | (lasting & fading);
        }
        // A weaker mode learns, or a new one begins.
        let alone = !(near | hold | shade.shadow);
        let begins = if new_weight < OUTWEIGHS { alone & !*multiple } else { 0 };
        if begins != 0 && new_weight > 0 {
            begin_one_by_one(begins, grey, &mut model.minors[0], w * BLOCK, params);
            *multiple |= begins;
        }
        let learns = alone & !begins;
        if learns != 0 {
            let (main, minors) = ([mean, variance], &mut model.minors);
            let more = learn_one_by_one(learns, grey, main, minors, w * BLOCK, params);
            *multiple = (*multiple & !learns) | more;
        }
        let foreground = if within == u64::MAX { 0 } else { shade.foreground() };
        masks.foreground[w] = foreground;
        masks.dark[w] = shade.dark & foreground;
        masks.strong[w] = shade.strong & foreground;
    }
}

/// What the pixels of a block are, as bits.
#[derive(Clone, Copy, Default)]
struct Shade {
    background: u64,
    shadow: u64,
    dark: u64,
    strong: u64,
}

impl Shade {
    /// The lightest shade counts: any mode's background, any mode's shadow, any mode's dark.
    #[inline(always)]
    fn settle(&mut self) {
        self.shadow &= !self.background;
        self.dark &= !(self.background | self.shadow);
    }

    #[inline(always)]
    fn foreground(&self) -> u64 {
        !(self.background | self.shadow)
    }
}

/// Let the weights of the pixels of `fading` fade; returns which are not zero.
#[inline(always)]
fn fade<S: Simd>(simd: S, weights: &mut [u8], fading: u64, params: &Params) -> u64 {
    let n = S::u8s::LEN;
    let (mantissa, shift, dither) = params.rate.for_weight();
    let mut lasting = 0;
    for (k, weights) in weights.chunks_exact_mut(n).enumerate() {
        let weight = S::u8s::from_slice(simd, weights);
        let (low, high) = weight.widen();
        let low = ((low + PRIOR) * mantissa + dither) >> shift;
        let high = ((high + PRIOR) * mantissa + dither) >> shift;
        let faded = weight.saturating_sub(low.narrow(high));
        let fades = S::mask8s::from_bitmask(simd, fading >> (k * n));
        let weight = fades.select(faded, weight);
        weight.store_slice(weights);
        lasting |= weight.simd_gt(0).to_bitmask() << (k * n);
    }
    lasting
}

/// Pixels of a mask.
fn each(mut mask: u64, mut visit: impl FnMut(usize)) {
    while mask != 0 {
        visit(mask.trailing_zeros() as usize);
        mask &= mask - 1;
    }
}

/// A second mode begins at each pixel of `begins`, a block that begins at pixel `from`.
fn begin_one_by_one(
    begins: u64,
    grey: &[u8; BLOCK],
    minors: &mut Minors<'_>,
    from: usize,
    params: &Params,
) {
    each(begins, |i| {
        minors.set(from + i, Minor::new(observation(grey[i], params.gain), &params.rate));
    });
}

/// The specification's learning for the pixels of `alone`, a block that begins at pixel `from`;
/// returns which of them have a second mode.
fn learn_one_by_one(
    alone: u64,
    grey: &[u8; BLOCK],
    [mean, variance]: [&mut [u16; BLOCK]; 2],
    [first, second]: &mut [Minors<'_>; MINORS],
    from: usize,
    params: &Params,
) -> u64 {
    let mut multiple = 0;
    each(alone, |i| {
        let minors = [first.get(from + i), second.get(from + i)];
        let mut pixel = Pixel { mean: mean[i], variance: variance[i], minors };
        pixel.learn(observation(grey[i], params.gain), params);
        (mean[i], variance[i]) = (pixel.mean, pixel.variance);
        first.set(from + i, pixel.minors[0]);
        second.set(from + i, pixel.minors[1]);
        multiple |= u64::from(pixel.is_multiple()) << i;
    });
    multiple
}

/// Observations, Q7, of one vector of grey levels: its lower and upper half.
#[inline(always)]
fn observe<S: Simd>(grey: S::u8s, params: &Params) -> [S::u16s; 2] {
    let (low, high) = grey.widen();
    [brighten::<S>(low, params.gain), brighten::<S>(high, params.gain)]
}

/// [`observation`] of grey levels.
#[inline(always)]
pub(super) fn brighten<S: Simd>(grey: S::u16s, gain: Gain) -> S::u16s {
    grey * gain.whole + ((grey * gain.part) >> 8)
}

#[inline(always)]
fn part_of<S: Simd>(value: S::u16s, ratio_q8: u16) -> S::u16s {
    (value >> 8) * ratio_q8 + (((value & 255) * ratio_q8) >> 8)
}

/// Square of a distance over the reach, `halves` times halved before.
#[inline(always)]
fn reach<S: Simd>(distance: S::u16s, reach_q8: u16, halves: u32) -> S::u16s {
    let deviation = (part_of::<S>(distance, reach_q8) >> (2 + halves)).min(REACH_MAX);
    let (whole, quarters) = (deviation >> 2, deviation & 3);
    whole * whole + ((((whole * quarters) << 3) + quarters * quarters) >> 4)
}

#[inline(always)]
fn abs_diff<S: Simd>(a: S::u16s, b: S::u16s) -> S::u16s {
    a.max(b) - a.min(b)
}

/// Let the main modes follow the pixels of `learn` (all: `ALL`) that are near to them; returns the
/// bits of those within reach, and of those near.
#[inline(always)]
fn follow<S: Simd, const ALL: bool>(
    simd: S,
    grey: &[u8; BLOCK],
    mean: &mut [u16; BLOCK],
    variance: &mut [u16; BLOCK],
    learn: u64,
    params: &Params,
) -> (u64, u64) {
    let n = S::u16s::LEN;
    let (mean_shift, mean_dither) = params.rate.shift(MEAN_GAINED);
    let (variance_shift, variance_dither) = params.rate.shift(VARIANCE_GAINED);
    let mantissa = params.rate.mantissa;
    let (mut all_within, mut all_near) = (0, 0);
    for at in (0..BLOCK).step_by(2 * n) {
        let grey = S::u8s::from_slice(simd, &grey[at..at + 2 * n]);
        let [low, high] = observe::<S>(grey, params);
        for (at, x) in [(at, low), (at + n, high)] {
            let m = S::u16s::from_slice(simd, &mean[at..at + n]);
            let v = S::u16s::from_slice(simd, &variance[at..at + n]);
            let difference = abs_diff::<S>(x, m);
            let distance = (difference >> 4).min(255);
            let within = reach::<S>(difference, params.reach_q8, 0).simd_lt(v);
            all_within |= within.to_bitmask() << at;
            let near = reach::<S>(difference, MATCH_Q8, 0).simd_lt(v);
            all_near |= near.to_bitmask() << at;
            let moves = if ALL { near } else { near & S::mask16s::from_bitmask(simd, learn >> at) };
            let step = (distance * mantissa + mean_dither) >> mean_shift;
            let moved = x.simd_gt(m).select(m + step, m - step);
            moves.select(moved, m).store_slice(&mut mean[at..at + n]);
            let square = distance * distance;
            let step = part_of::<S>(abs_diff::<S>(square, v), mantissa) + variance_dither;
            let step = step >> variance_shift;
            let shrunk = v.saturating_sub(step).max(VARIANCE_MIN);
            let moved = square.simd_gt(v).select(v + step, shrunk);
            moves.select(moved, v).store_slice(&mut variance[at..at + n]);
        }
    }
    (all_within, all_near)
}

/// How much darker than a mode's mean: bits of shadow, and of shadow or dark.
#[inline(always)]
fn darker<S: Simd>(x: S::u16s, mean: S::u16s, params: &Params) -> (S::mask16s, S::mask16s) {
    let darker = x.simd_lt(mean) & mean.simd_ge(SHADOW_MEAN_MIN);
    let shadow = x.simd_ge(part_of::<S>(mean, params.shadow_ratio_q8));
    let dark = x.simd_ge(part_of::<S>(mean, params.dark_ratio_q8));
    (darker & shadow, darker & (shadow | dark))
}

/// Shades against the main modes.
#[inline(always)]
fn main_shade<S: Simd>(
    simd: S,
    grey: &[u8; BLOCK],
    mean: &[u16; BLOCK],
    variance: &[u16; BLOCK],
    params: &Params,
) -> Shade {
    let n = S::u16s::LEN;
    let mut shade = Shade::default();
    for at in (0..BLOCK).step_by(2 * n) {
        let grey = S::u8s::from_slice(simd, &grey[at..at + 2 * n]);
        let [low, high] = observe::<S>(grey, params);
        for (at, x) in [(at, low), (at + n, high)] {
            let m = S::u16s::from_slice(simd, &mean[at..at + n]);
            let v = S::u16s::from_slice(simd, &variance[at..at + n]);
            let (shadow, dark) = darker::<S>(x, m, params);
            let strong = reach::<S>(abs_diff::<S>(x, m), params.reach_q8, 1).simd_ge(v);
            shade.shadow |= shadow.to_bitmask() << at;
            shade.dark |= dark.to_bitmask() << at;
            shade.strong |= strong.to_bitmask() << at;
        }
    }
    shade
}

/// A weaker mode of a block.
struct MinorBlock<'a> {
    mean: &'a [u16],
    deviation: &'a [u8],
    weight: &'a [u8],
}

/// Shades against those weaker modes that are background.
#[inline(always)]
fn add_minor_shades<S: Simd>(
    simd: S,
    grey: &[u8; BLOCK],
    minors: &[MinorBlock<'_>; MINORS],
    params: &Params,
    shade: &mut Shade,
) {
    let n = S::u16s::LEN;
    for at in (0..BLOCK).step_by(2 * n) {
        let bytes = at..at + 2 * n;
        let seen = observe::<S>(S::u8s::from_slice(simd, &grey[bytes.clone()]), params);
        let weights = [
            S::u8s::from_slice(simd, &minors[0].weight[bytes.clone()]),
            S::u8s::from_slice(simd, &minors[1].weight[bytes.clone()]),
        ];
        // What the modes before it hold.
        let main = S::u8s::splat(simd, 255).saturating_sub(weights[0]).saturating_sub(weights[1]);
        let shares = [main, main.saturating_add(weights[0])];
        let mut counts = u64::MAX;
        for k in 0..MINORS {
            let exists = weights[k].simd_gt(0) & shares[k].simd_lt(params.background_share);
            // Without one mode there is none after it.
            counts &= exists.to_bitmask();
            let (low, high) = S::u8s::from_slice(simd, &minors[k].deviation[bytes.clone()]).widen();
            for (half, deviation) in [low, high].into_iter().enumerate() {
                let (x, at) = (seen[half], at + half * n);
                let m = S::u16s::from_slice(simd, &minors[k].mean[at..at + n]);
                let distance = abs_diff::<S>(x, m);
                let within =
                    reach::<S>(distance, params.reach_q8, 0).simd_lt(deviation * deviation);
                let (shadow, dark) = darker::<S>(x, m, params);
                let counts = counts >> (half * n);
                shade.background |= (within.to_bitmask() & counts) << at;
                shade.shadow |= (shadow.to_bitmask() & counts) << at;
                shade.dark |= (dark.to_bitmask() & counts) << at;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::scalar::mixture::{
        Class, Rate, VARIANCE_NEW, is_strong, update as update_pixel,
    };
    use crate::kernel::simd::each_level;

    const BLOCKS: usize = 3;
    const N: usize = BLOCKS * BLOCK;

    struct Random(u64);

    impl Random {
        fn next(&mut self) -> u64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            self.0 >> 24
        }
    }

    fn params(frame: u32, gain: u32, reach_q8: u16) -> Params {
        Params {
            rate: Rate::new((frame + 2).min(40), frame),
            gain: Gain::from_q15(gain),
            reach_q8,
            background_share: 229,
            shadow_ratio_q8: 184,
            dark_ratio_q8: 77,
        }
    }

    /// Runs frames through both and compares every byte of model and masks after each.
    fn compare(
        level: Level,
        greys: &mut dyn FnMut(u32) -> [u8; N],
        holds: &mut dyn FnMut() -> u64,
    ) {
        let first = greys(0).map(|g| observation(g, Gain::ONE));
        let mut pixels = first.map(Pixel::new);
        let (mut mean, mut variance) = (first, [VARIANCE_NEW; N]);
        let mut minors = [([0u16; N], [0u8; N], [0u8; N]); MINORS];
        let mut multiple = [0u64; BLOCKS];
        for frame in 0..80 {
            let params = params(frame, 32768 + 300 * (frame % 7), 40 + 24 * (frame as u16 % 2));
            let grey = greys(frame + 1);
            let hold: [u64; BLOCKS] = std::array::from_fn(|_| holds());
            let mut model = Model {
                mean: &mut mean,
                variance: &mut variance,
                minors: minors.each_mut().map(|(mean, deviation, weight)| Minors {
                    mean,
                    deviation,
                    weight,
                }),
                multiple: &mut multiple,
            };
            let mut masks = [[0xa5a5; BLOCKS]; 3];
            let [foreground, dark, strong] = &mut masks;
            let mut out = Masks { foreground, dark, strong };
            update(level, &grey, &mut model, &hold, &mut out, &params);
            for (i, pixel) in pixels.iter_mut().enumerate() {
                let (w, bit) = (i / BLOCK, i % BLOCK);
                let x = observation(grey[i], params.gain);
                let far = is_strong(x, pixel, &params);
                let class = update_pixel(x, pixel, hold[w] >> bit & 1 == 0, &params);
                let expected = [
                    matches!(class, Class::Foreground | Class::Dark),
                    class == Class::Dark,
                    far && matches!(class, Class::Foreground | Class::Dark),
                ];
                let got = masks.map(|mask| mask[w] >> bit & 1 == 1);
                assert_eq!(got, expected, "{level:?} frame {frame} pixel {i} {pixel:?}");
                let got = Pixel {
                    mean: mean[i],
                    variance: variance[i],
                    minors: minors.map(|m| Minor {
                        mean: m.0[i],
                        deviation: m.1[i],
                        weight: m.2[i],
                    }),
                };
                assert_eq!(got, *pixel, "{level:?} frame {frame} pixel {i}");
                assert_eq!(multiple[w] >> bit & 1 == 1, pixel.is_multiple());
            }
        }
    }

    #[test]
    fn every_level_gives_the_bits_of_the_specification() {
        each_level(|level| {
            for fill in [0, 255] {
                compare(level, &mut |_| [fill; N], &mut || 0);
                compare(level, &mut |_| [fill; N], &mut || u64::MAX);
                compare(
                    level,
                    &mut |frame| [if frame % 9 == 0 { 255 - fill } else { fill }; N],
                    &mut || 0,
                );
            }
            let mut random = Random(5);
            compare(level, &mut |_| std::array::from_fn(|_| random.next() as u8), &mut || 0);
            // A belt with noise, shadows, parcels and held stretches.
            let (mut random, mut other) = (Random(6), Random(7));
            let mut scene = |frame: u32| {
                std::array::from_fn(|i| {
                    let noise = random.next() % 7 + random.next() % 7;
                    let place = (i as u32 + 3 * frame) % 190;
                    let base = match place {
                        0..20 => 160,
                        20..30 => 75,
                        30..40 => 40,
                        _ => 100,
                    };
                    (base + noise) as u8
                })
            };
            compare(level, &mut scene, &mut || {
                if other.next() % 3 == 0 { other.next() } else { 0 }
            });
        });
    }
}
