//! Incremental Gaussian mixture background model, per pixel, in fixed point: the specification.
//!
//! Source: Zivkovic, ICPR 2004, eq. 4 to 14 (recursive update, complexity prior that removes
//! modes); Zivkovic and van der Heijden 2006.
//! Nearly every belt pixel has one mode, and that one has 4 bytes: a pixel without a second mode
//! is read and written in 4 bytes of model. Everything that such a pixel needs fits products of
//! 8 by 8 bits in 16-bit lanes, so that the vector kernel gives the same bits.
//!
//! Units: means Q7 grey levels, variances Q6 grey levels squared, weights in 1/255. Increments
//! smaller than one unit are dithered over the frames, so that none is ever lost.
//! Range: standard deviations of 1.2 to 32 grey levels, distances without limit. A distance counts
//! as at most 32 grey levels when it is learned: a belt of 20 is learned as one of 17.

/// Weaker modes that a pixel may have besides its main one.
pub const MINORS: usize = 2;

/// A weaker mode. Weight 0: there is none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Minor {
    /// Mean, Q7.
    pub mean: u16,
    /// Standard deviation, Q3: its square is a variance in Q6.
    pub deviation: u8,
    /// Share of the observations, 1/255. The main mode has what is left.
    pub weight: u8,
}

/// The model of one pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pixel {
    /// Mean of the main mode, Q7.
    pub mean: u16,
    /// Variance of the main mode, Q6.
    pub variance: u16,
    /// The weaker modes, the heavier first.
    pub minors: [Minor; MINORS],
}

/// Scene brightness to model brightness: an observation is multiplied by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gain {
    /// Factor, Q7.
    pub whole: u16,
    /// What is missing to it, Q15; below 256.
    pub part: u16,
}

impl Gain {
    /// No change.
    pub const ONE: Self = Self { whole: 128, part: 0 };

    /// From Q15; below 2.
    pub fn from_q15(gain: u32) -> Self {
        let gain = gain.min(65535);
        Self { whole: (gain >> 8) as u16, part: (gain & 255) as u16 }
    }
}

/// Learning rate `mantissa / 2^exponent`, and the frame's dither.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate {
    /// At most 127.
    pub mantissa: u16,
    /// At least 8.
    pub exponent: u32,
    /// Evenly spread over all values in the course of the frames.
    dither: u32,
}

impl Rate {
    /// 1 / `frames`, at most 127/256, at least 1/2048.
    pub fn new(frames: u32, frame: u32) -> Self {
        let frames = frames.clamp(2, 2048);
        let exponent = (6 + frames.next_power_of_two().ilog2()).max(8);
        let mantissa = ((1u32 << exponent) / frames).min(127) as u16;
        Self { mantissa, exponent, dither: frame.reverse_bits() }
    }

    /// Right shift and dither for a value that has `gained` bits more than the rate's exponent.
    pub fn shift(&self, gained: u32) -> (u32, u16) {
        let shift = self.exponent - gained;
        (shift, self.dither.checked_shr(32 - shift).unwrap_or(0) as u16)
    }

    /// Factor, shift and dither that move a weight: products of it fit 16 bits.
    pub fn for_weight(&self) -> (u16, u32, u16) {
        let shift = self.exponent.min(15);
        let (_, dither) = self.shift(self.exponent - shift);
        (self.mantissa >> (self.exponent - shift), shift, dither)
    }

    fn q16(&self) -> i32 {
        (i32::from(self.mantissa) << 16) >> self.exponent
    }

    fn dither_q16(&self) -> i32 {
        (self.dither >> 16) as i32
    }
}

/// Parameters of the update, one set a frame.
#[derive(Clone, Copy, Debug)]
pub struct Params {
    /// Learning rate.
    pub rate: Rate,
    /// Light of this frame.
    pub gain: Gain,
    /// 1 / (standard deviations within which an observation is background), Q8; at most
    /// [`MATCH_Q8`].
    pub reach_q8: u16,
    /// Modes that together hold this share are background, 1/255.
    pub background_share: u8,
    /// Shadow when at least this fraction of the background, Q8; below 256.
    pub shadow_ratio_q8: u16,
    /// Darker than a shadow, but possibly a deep one, when at least this fraction, Q8.
    pub dark_ratio_q8: u16,
}

/// 1 / (standard deviations within which a mode learns an observation), Q8: 3, as in the paper.
pub const MATCH_Q8: u16 = 85;
/// Variance of a new mode: 5 grey levels squared, Q6.
pub const VARIANCE_NEW: u16 = 25 << 6;
/// A sensor is never better than 1.2 grey levels, quantisation and interpolation included.
pub const VARIANCE_MIN: u16 = 92;
/// Its root, Q3, rounded up.
const DEVIATION_MIN: u8 = 10;
/// Below this a mean cannot carry a ratio: 6 grey levels, Q7.
pub const SHADOW_MEAN_MIN: u16 = 6 << 7;
/// Complexity prior `c_T` of eq. 14: 0.05 of 255.
pub const PRIOR: u16 = 13;

/// Deviations are compared up to this, Q5: 32 grey levels, and beyond every variance.
pub const REACH_MAX: u16 = 1023;

/// Bits that the mean's unit has more than that of [`distance`].
pub const MEAN_GAINED: u32 = 4;
/// Bits that a step of the variance loses before it is dithered.
pub const VARIANCE_GAINED: u32 = 8;

/// What a pixel shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Belongs to a background mode.
    Background,
    /// Darker than the background by no more than the shadow ratio.
    Shadow,
    /// Darker still, by no more than the dark ratio: a dark parcel or a deep shadow.
    Dark,
    /// Anything else.
    Foreground,
}

/// Observed grey level in model units, Q7.
pub fn observation(grey: u8, gain: Gain) -> u16 {
    let grey = u16::from(grey);
    grey * gain.whole + ((grey * gain.part) >> 8)
}

/// Distance to a mean, Q3, at most 255: 32 grey levels.
fn distance(x: u16, mean: u16) -> u16 {
    (x.abs_diff(mean) >> 4).min(255)
}

/// Square, Q6, of a deviation in Q5 of at most [`REACH_MAX`].
fn square(deviation: u16) -> u16 {
    let (whole, quarters) = (deviation >> 2, deviation & 3);
    whole * whole + ((8 * whole * quarters + quarters * quarters) >> 4)
}

/// Square, Q6, of a distance over the reach, `halves` times halved before.
fn reach(x: u16, mean: u16, reach_q8: u16, halves: u32) -> u16 {
    square((part_of(x.abs_diff(mean), reach_q8) >> (2 + halves)).min(REACH_MAX))
}

fn within(x: u16, mean: u16, variance: u16, reach_q8: u16) -> bool {
    reach(x, mean, reach_q8, 0) < variance
}

/// At more than twice the distance that makes a pixel foreground, from the main mode.
pub fn is_strong(x: u16, pixel: &Pixel, params: &Params) -> bool {
    reach(x, pixel.mean, params.reach_q8, 1) >= pixel.variance
}

/// `ratio * value`, the ratio in Q8 and at most 1.
fn part_of(value: u16, ratio_q8: u16) -> u16 {
    (value >> 8) * ratio_q8 + (((value & 255) * ratio_q8) >> 8)
}

/// How much darker than a mode's mean: shadow, dark, or neither.
fn shade(x: u16, mean: u16, params: &Params) -> Class {
    if x >= mean || mean < SHADOW_MEAN_MIN {
        Class::Foreground
    } else if x >= part_of(mean, params.shadow_ratio_q8) {
        Class::Shadow
    } else if x >= part_of(mean, params.dark_ratio_q8) {
        Class::Dark
    } else {
        Class::Foreground
    }
}

/// Class of observation `x`. The lightest shade that any background mode offers counts.
pub fn classify(x: u16, pixel: &Pixel, params: &Params) -> Class {
    if within(x, pixel.mean, pixel.variance, params.reach_q8) {
        return Class::Background;
    }
    let mut class = shade(x, pixel.mean, params);
    let mut share = pixel.main_weight();
    for minor in pixel.minors {
        if minor.weight == 0 || share >= params.background_share {
            break;
        }
        if within(x, minor.mean, minor.variance(), params.reach_q8) {
            return Class::Background;
        }
        class = match (class, shade(x, minor.mean, params)) {
            (Class::Shadow, _) | (_, Class::Shadow) => Class::Shadow,
            (Class::Dark, _) | (_, Class::Dark) => Class::Dark,
            _ => Class::Foreground,
        };
        share = share.saturating_add(minor.weight);
    }
    class
}

/// Classify observation `x` and, where `learn` is set, learn it. A shadow is not learned: it comes
/// and goes with its parcel, and would hide the next dark one.
pub fn update(x: u16, pixel: &mut Pixel, learn: bool, params: &Params) -> Class {
    let class = classify(x, pixel, params);
    if learn && class != Class::Shadow {
        pixel.learn(x, params);
    }
    class
}

impl Minor {
    /// A mode that has seen one observation.
    pub fn new(x: u16, rate: &Rate) -> Self {
        let (mantissa, shift, dither) = rate.for_weight();
        let weight = ((255 * mantissa + dither) >> shift) as u8;
        Self { mean: x, deviation: VARIANCE_NEW.isqrt() as u8, weight }
    }

    fn variance(self) -> u16 {
        u16::from(self.deviation).pow(2)
    }

    /// Eq. 5 and 6 at rate / weight: a young mode is the mean of what it has seen.
    fn follow(&mut self, x: u16, rate: &Rate) {
        let step = (rate.q16() * 255 / i32::from(self.weight.max(1))).min(1 << 15);
        let follow = |value: i32, target: i32| {
            value
                + ((i64::from(target - value) * i64::from(step) + i64::from(rate.dither_q16()))
                    >> 16) as i32
        };
        let deviation = i32::from(self.deviation.max(DEVIATION_MIN));
        // Half of the variance's change over the deviation is the deviation's.
        let change = i32::from(distance(x, self.mean)).pow(2) - deviation.pow(2);
        self.mean = follow(i32::from(self.mean), i32::from(x)) as u16;
        let deviation = follow(deviation, deviation + change / (2 * deviation));
        self.deviation = deviation.clamp(i32::from(DEVIATION_MIN), 255) as u8;
    }

    /// Eq. 4 and 14: the weight goes towards 1 or 0, less the prior.
    fn weigh(&mut self, matched: bool, rate: &Rate) {
        let (mantissa, shift, dither) = rate.for_weight();
        let weight = u16::from(self.weight);
        let step = |distance: u16| (distance * mantissa + dither) >> shift;
        let weight = match (matched, weight) {
            (_, 0) => 0,
            (true, weight) => weight + step(255 - weight),
            (false, weight) => weight.saturating_sub(step(weight + PRIOR)),
        };
        self.weight = weight.min(255) as u8;
    }
}

impl Pixel {
    /// A model that has seen one observation.
    pub fn new(x: u16) -> Self {
        Self { mean: x, variance: VARIANCE_NEW, ..Self::default() }
    }

    /// Whether it has more than its main mode.
    pub fn is_multiple(&self) -> bool {
        self.minors.iter().any(|m| m.weight > 0)
    }

    fn main_weight(&self) -> u8 {
        self.minors.iter().fold(255, |left: u8, m| left.saturating_sub(m.weight))
    }

    /// Learn observation `x`, whatever its class.
    pub fn learn(&mut self, x: u16, params: &Params) {
        let near = |m: &Minor| m.weight > 0 && within(x, m.mean, m.variance(), MATCH_Q8);
        let main = within(x, self.mean, self.variance, MATCH_Q8);
        let minor = if main { None } else { self.minors.iter().position(near) };
        for (k, m) in self.minors.iter_mut().enumerate() {
            m.weigh(minor == Some(k), &params.rate);
        }
        match minor {
            _ if main => self.follow(x, &params.rate),
            Some(k) => self.minors[k].follow(x, &params.rate),
            None => self.insert(x, &params.rate),
        }
        self.sort();
    }

    /// Eq. 5 and 6 for the main mode. Its weight is taken as one.
    fn follow(&mut self, x: u16, rate: &Rate) {
        let distance = distance(x, self.mean);
        let square = distance * distance;
        let (shift, dither) = rate.shift(MEAN_GAINED);
        let step = (distance * rate.mantissa + dither) >> shift;
        self.mean = if x > self.mean { self.mean + step } else { self.mean - step };
        let (shift, dither) = rate.shift(VARIANCE_GAINED);
        let step = (part_of(square.abs_diff(self.variance), rate.mantissa) + dither) >> shift;
        self.variance = if square > self.variance {
            self.variance + step
        } else {
            self.variance.saturating_sub(step).max(VARIANCE_MIN)
        };
    }

    /// A new mode takes the place of the weakest. At a rate below 1/255 it has a weight in some
    /// frames only.
    fn insert(&mut self, x: u16, rate: &Rate) {
        let new = Minor::new(x, rate);
        if new.weight == 0 {
            return;
        }
        let free = self.minors.iter().position(|m| m.weight == 0).unwrap_or(MINORS - 1);
        self.minors[free] = new;
    }

    /// Keep modes in order of weight.
    fn sort(&mut self) {
        if self.minors[1].weight > self.minors[0].weight {
            self.minors.swap(0, 1);
        }
        let main = self.main_weight();
        let heaviest = self.minors[0];
        if heaviest.weight > main {
            let deviation = self.variance.isqrt() as u8;
            self.minors[0] = Minor { mean: self.mean, deviation, weight: main };
            self.mean = heaviest.mean;
            self.variance = heaviest.variance();
            if self.minors[1].weight > self.minors[0].weight {
                self.minors.swap(0, 1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn params(frames: u32, frame: u32) -> Params {
        Params {
            rate: Rate::new(frames, frame),
            gain: Gain::ONE,
            reach_q8: 64,
            background_share: 229,
            shadow_ratio_q8: 184,
            dark_ratio_q8: 77,
        }
    }

    fn is_foreground(pixel: &Pixel, grey: u8) -> bool {
        let x = observation(grey, Gain::ONE);
        !matches!(classify(x, pixel, &params(500, 0)), Class::Background | Class::Shadow)
    }

    /// Sees `grey` of frame `n` for `frames` frames after the first.
    fn see(pixel: &mut Pixel, frames: u32, grey: impl Fn(u32) -> u8) {
        for n in 0..frames {
            update(observation(grey(n), Gain::ONE), pixel, true, &params((n + 2).min(500), n));
        }
    }

    fn learned(grey: u8) -> Pixel {
        let mut pixel = Pixel::new(observation(grey, Gain::ONE));
        see(&mut pixel, 600, |_| grey);
        pixel
    }

    #[test]
    fn a_learned_level_is_background_and_a_far_one_is_not() {
        let pixel = learned(100);
        assert!(!is_foreground(&pixel, 101));
        assert!(is_foreground(&pixel, 130));
        assert!(is_foreground(&pixel, 40));
    }

    #[test]
    fn a_little_darker_is_shadow_not_foreground() {
        let pixel = learned(100);
        assert!(!is_foreground(&pixel, 80));
        assert!(is_foreground(&pixel, 60));
    }

    #[test]
    fn a_lasting_shadow_never_becomes_background() {
        let mut pixel = learned(100);
        see(&mut pixel, 2000, |_| 80);
        assert!(!pixel.is_multiple());
    }

    #[test]
    fn mean_and_variance_are_those_of_the_noise() {
        // Sum of 12 uniform values of variance 3/4: sigma 3 around 100.4.
        let mut state = 7u64;
        let mut uniform = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 40) as f64 / f64::from(1 << 24) - 0.5
        };
        let greys: Vec<u8> = (0..20_000)
            .map(|_| (100.4 + 3.0 * (0..12).map(|_| uniform()).sum::<f64>()).round() as u8)
            .collect();
        let mut pixel = Pixel::new(observation(greys[0], Gain::ONE));
        let (mut mean, mut variance) = (0.0, 0.0);
        for (n, &grey) in greys.iter().enumerate() {
            let params = params((n as u32 + 2).min(500), n as u32);
            update(observation(grey, Gain::ONE), &mut pixel, true, &params);
            if n >= 5000 {
                mean += f64::from(pixel.mean) / 128.0 / 15_000.0;
                variance += f64::from(pixel.variance) / 64.0 / 15_000.0;
            }
        }
        // Averages over 15,000 frames: their own scatter is 0.03 grey levels and 2 %; 1/12 of
        // quantisation belongs to the variance.
        assert!((mean - 100.4).abs() < 0.1, "{mean}");
        assert!((variance - 9.08).abs() < 0.5, "{variance}");
    }

    #[test]
    fn a_step_smaller_than_the_unit_is_not_lost() {
        // 1 grey level at rate 1/500 is 0.26 units of Q7 a frame.
        let mut pixel = learned(100);
        see(&mut pixel, 3000, |_| 101);
        assert!(pixel.mean.abs_diff(101 << 7) < 26, "{}", f64::from(pixel.mean) / 128.0);
    }

    #[test]
    fn a_lasting_change_becomes_background() {
        let mut pixel = learned(100);
        let frames = (0..2000u32).position(|n| {
            let x = observation(200, Gain::ONE);
            update(x, &mut pixel, true, &params(500, n)) == Class::Background
        });
        // The new mode must reach 10 % of the weight: -500 ln 0.9 = 53 frames.
        assert!(frames.is_some_and(|n| (40..80).contains(&n)), "{frames:?}");
    }

    #[test]
    fn a_mode_seen_once_is_soon_removed() {
        let mut pixel = learned(100);
        update(observation(200, Gain::ONE), &mut pixel, true, &params(500, 1));
        assert!(pixel.is_multiple());
        for n in 0..200 {
            update(observation(100, Gain::ONE), &mut pixel, true, &params(500, n));
        }
        // The prior takes 1 of 255 every 36 frames.
        assert!(!pixel.is_multiple());
    }

    #[test]
    fn two_levels_that_alternate_are_both_background() {
        let mut pixel = learned(100);
        see(&mut pixel, 3000, |n| if n % 3 == 0 { 160 } else { 100 });
        assert!(!is_foreground(&pixel, 100) && !is_foreground(&pixel, 160));
        assert!(is_foreground(&pixel, 200) && is_foreground(&pixel, 60));
    }

    #[test]
    fn weights_stay_ordered_and_bounded_under_noise() {
        let mut pixel = Pixel::new(0);
        let mut state = 1u32;
        for n in 0..20_000u32 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let params = params((n + 2).min(500), n);
            update(observation((state >> 24) as u8, Gain::ONE), &mut pixel, true, &params);
            let [a, b] = pixel.minors.map(|m| m.weight);
            assert!(pixel.main_weight() >= a && a >= b, "{pixel:?}");
        }
    }

    #[test]
    fn all_low_and_all_high_overflow_nothing() {
        for (first, then) in [(0, 255), (255, 0), (255, 255), (0, 0)] {
            for gain in [0, 1, 255, 256, 32768, 65535] {
                let gain = Gain::from_q15(gain);
                let mut pixel = Pixel::new(observation(first, gain));
                for n in 0..3000 {
                    let params = Params { gain, reach_q8: 256, ..params(n + 2, n) };
                    update(observation(then, gain), &mut pixel, true, &params);
                }
                assert_eq!(
                    classify(observation(then, gain), &pixel, &params(500, 0)),
                    Class::Background
                );
            }
        }
    }

    #[test]
    fn a_rate_is_near_what_was_asked_for() {
        for frames in 2..=2048u32 {
            let rate = Rate::new(frames, 0);
            let got =
                f64::from(rate.mantissa) / f64::from(1u32 << rate.exponent) * f64::from(frames);
            assert!((0.97..=1.0).contains(&got), "{frames}: {got}");
            assert!(rate.mantissa <= 127 && rate.exponent >= 8);
        }
    }
}
