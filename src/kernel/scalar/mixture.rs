//! Incremental Gaussian mixture background model, per pixel, in fixed point.
//!
//! Source: Zivkovic, ICPR 2004, eq. 4 to 14 (recursive update, complexity prior that removes
//! modes); Zivkovic and van der Heijden 2006. One plane a mode: a pixel that matches its
//! first mode and has no second touches 6 bytes of model.
//!
//! Units: weights Q16 (65535 is one), means Q8 grey levels, variances Q8 grey levels squared.

/// Modes a pixel may have.
pub const MODES: usize = 3;

/// One mode of a stretch of pixels.
#[derive(Debug)]
pub struct ModeRow<'a> {
    /// Share of the observations, Q16; 0 means the mode does not exist.
    pub weight: &'a mut [u16],
    /// Mean, Q8.
    pub mean: &'a mut [u16],
    /// Variance, Q8.
    pub variance: &'a mut [u16],
}

/// Parameters of the update, one set a frame.
#[derive(Clone, Copy, Debug)]
pub struct Params {
    /// Learning rate, Q16.
    pub rate_q16: u32,
    /// Scene brightness to model brightness, Q12: an observation is multiplied by it.
    pub gain_q12: u32,
    /// Squared Mahalanobis distance within which an observation belongs to a mode, Q8.
    pub match_d2_q8: u32,
    /// The same for "is background", Q8.
    pub background_d2_q8: u32,
    /// Modes that together hold this share are background, Q16.
    pub background_share_q16: u32,
    /// Shadow when at least this fraction of the background, Q8.
    pub shadow_ratio_q8: u32,
    /// Darker than a shadow, but possibly a deep one, when at least this fraction, Q8.
    pub dark_ratio_q8: u32,
}

/// Variance of a new mode: 5 grey levels squared, Q8.
const VARIANCE_NEW: u16 = 25 << 8;
/// A sensor is never better than 1.2 grey levels, quantisation and interpolation included.
const VARIANCE_MIN: u16 = 370;
/// Below this a mean cannot carry a ratio: 6 grey levels, Q8.
const SHADOW_MEAN_MIN: u16 = 6 << 8;
/// Complexity prior `c_T` of eq. 14, as a right shift: 1/32.
const PRUNE_SHIFT: u32 = 5;

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

/// Observed grey level in model units, Q8, saturating.
pub fn observation(grey: u8, gain: u32) -> u16 {
    ((u32::from(grey) * gain) >> 4).min(65535) as u16
}

/// Bits of 64 pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Masks {
    /// Foreground, dark pixels included.
    pub foreground: u64,
    /// Dark pixels.
    pub dark: u64,
    /// Foreground at twice the distance that makes a pixel foreground.
    pub strong: u64,
}

/// Classify and learn 64 pixels or fewer; bit i of the result is pixel i.
///
/// Shadows, and pixels whose bit in `hold` is set, are classified but not learned. All slices have the
/// same length, at most 64.
pub fn update(grey: &[u8], modes: &mut [ModeRow<'_>; MODES], hold: u64, params: &Params) -> Masks {
    let mut masks = Masks::default();
    for (i, &value) in grey.iter().enumerate() {
        let x = observation(value, params.gain_q12);
        let class = classify(x, modes, i, params);
        masks.foreground |= u64::from(matches!(class, Class::Foreground | Class::Dark)) << i;
        masks.dark |= u64::from(class == Class::Dark) << i;
        if class != Class::Background && class != Class::Shadow {
            let far = 4 * params.background_d2_q8;
            let strong = !within(x, modes[0].mean[i], modes[0].variance[i], far);
            masks.strong |= u64::from(strong) << i;
        }
        // A shadow comes and goes with its parcel: learned, it would hide the next dark one.
        if hold >> i & 1 == 0 && class != Class::Shadow {
            learn(x, modes, i, params);
        }
    }
    masks
}

/// Squared difference in Q16; 65535^2 fits.
fn squared(x: u16, mean: u16) -> u32 {
    u32::from(x.abs_diff(mean)).pow(2)
}

fn within(x: u16, mean: u16, variance: u16, d2: u32) -> bool {
    u64::from(squared(x, mean)) < u64::from(variance) * u64::from(d2)
}

/// Class of observation `x` at pixel `i`.
pub fn classify(x: u16, modes: &[ModeRow<'_>; MODES], i: usize, params: &Params) -> Class {
    let mut share = 0;
    let mut class = Class::Foreground;
    for mode in modes {
        let (weight, mean) = (mode.weight[i], mode.mean[i]);
        if weight == 0 || share >= params.background_share_q16 {
            break;
        }
        if within(x, mean, mode.variance[i], params.background_d2_q8) {
            return Class::Background;
        }
        let keeps = |ratio: u32| u32::from(x) << 8 >= ratio * u32::from(mean);
        if x < mean && mean >= SHADOW_MEAN_MIN {
            if keeps(params.shadow_ratio_q8) {
                class = Class::Shadow;
            } else if keeps(params.dark_ratio_q8) && class == Class::Foreground {
                class = Class::Dark;
            }
        }
        share += u32::from(weight);
    }
    class
}

fn learn(x: u16, modes: &mut [ModeRow<'_>; MODES], i: usize, params: &Params) {
    let mut matched = None;
    for (m, mode) in modes.iter_mut().enumerate() {
        let weight = u32::from(mode.weight[i]);
        if weight == 0 {
            break;
        }
        let belongs =
            matched.is_none() && within(x, mode.mean[i], mode.variance[i], params.match_d2_q8);
        let decayed = weight - ((weight * params.rate_q16) >> 16);
        if belongs {
            matched = Some(m);
            let grown = (decayed + params.rate_q16).min(65535);
            mode.weight[i] = grown as u16;
            move_mode(x, mode, i, params.rate_q16, grown);
        } else {
            // Eq. 14: the prior takes c_T a step, and a mode with nothing left is removed.
            mode.weight[i] = decayed.saturating_sub(params.rate_q16 >> PRUNE_SHIFT) as u16;
        }
    }
    match matched {
        Some(m) => raise(modes, i, m),
        None => insert(x, modes, i, params.rate_q16),
    }
}

/// Eq. 5 and 6: mean and variance follow at rate / weight, rounded to nearest.
fn move_mode(x: u16, mode: &mut ModeRow<'_>, i: usize, rate: u32, weight: u32) {
    let step = i64::from(((rate << 12) / weight).min(1 << 12)); // Q12
    let follow = |value: u16, target: i64| {
        let value = i64::from(value);
        value + (((target - value) * step + (1 << 11)) >> 12)
    };
    let d2 = i64::from(squared(x, mode.mean[i]) >> 8);
    mode.mean[i] = follow(mode.mean[i], i64::from(x)) as u16;
    mode.variance[i] = follow(mode.variance[i], d2).clamp(i64::from(VARIANCE_MIN), 65535) as u16;
}

/// Keep modes in order of weight.
fn raise(modes: &mut [ModeRow<'_>; MODES], i: usize, from: usize) {
    for m in (1..=from).rev() {
        let (before, after) = modes.split_at_mut(m);
        let (a, b) = (&mut before[m - 1], &mut after[0]);
        if a.weight[i] >= b.weight[i] {
            break;
        }
        std::mem::swap(&mut a.weight[i], &mut b.weight[i]);
        std::mem::swap(&mut a.mean[i], &mut b.mean[i]);
        std::mem::swap(&mut a.variance[i], &mut b.variance[i]);
    }
}

/// A new mode takes the first free place, or the place of the weakest.
fn insert(x: u16, modes: &mut [ModeRow<'_>; MODES], i: usize, rate: u32) {
    let free = modes.iter().position(|mode| mode.weight[i] == 0).unwrap_or(MODES - 1);
    let mode = &mut modes[free];
    mode.weight[i] = rate.clamp(1, 65535) as u16;
    mode.mean[i] = x;
    mode.variance[i] = VARIANCE_NEW;
    raise(modes, i, free);
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Model([[u16; 3]; MODES]);

    impl Model {
        fn step(&mut self, grey: u8, hold: u64, rate: u32) -> bool {
            let params = Params {
                rate_q16: rate,
                gain_q12: 1 << 12,
                match_d2_q8: 9 << 8,
                background_d2_q8: 16 << 8,
                background_share_q16: 58982,
                shadow_ratio_q8: 184,
                dark_ratio_q8: 77,
            };
            let mut rows = self.0.each_mut().map(|[weight, mean, variance]| ModeRow {
                weight: std::slice::from_mut(weight),
                mean: std::slice::from_mut(mean),
                variance: std::slice::from_mut(variance),
            });
            update(&[grey], &mut rows, hold, &params).foreground == 1
        }

        fn learned(grey: u8) -> Self {
            let mut model = Self([[0; 3]; MODES]);
            for n in 1..=50 {
                model.step(grey, 0, 65536 / n);
            }
            model
        }
    }

    #[test]
    fn a_learned_level_is_background_and_a_far_one_is_not() {
        let mut model = Model::learned(100);
        assert!(!model.step(101, 1, 131));
        assert!(model.step(130, 1, 131));
        assert!(model.step(40, 1, 131));
    }

    #[test]
    fn a_little_darker_is_shadow_not_foreground() {
        let mut model = Model::learned(100);
        assert!(!model.step(80, 1, 131));
        assert!(model.step(60, 1, 131));
    }

    #[test]
    fn a_lasting_shadow_never_becomes_background() {
        let mut model = Model::learned(100);
        for _ in 0..2000 {
            model.step(80, 0, 131);
        }
        assert_eq!(model.0[1][0], 0, "no second mode");
    }

    #[test]
    fn a_held_pixel_never_becomes_background() {
        let mut model = Model::learned(100);
        for _ in 0..10_000 {
            assert!(model.step(200, 1, 131));
        }
    }

    #[test]
    fn a_lasting_change_becomes_background() {
        let mut model = Model::learned(100);
        let frames = (0..2000).position(|_| !model.step(200, 0, 131));
        // The new mode must reach 10 % of the weight: -500 ln 0.9 = 53 frames.
        assert!(frames.is_some_and(|n| (40..80).contains(&n)), "{frames:?}");
    }

    #[test]
    fn weights_stay_ordered_and_bounded_under_noise() {
        let mut model = Model([[0; 3]; MODES]);
        let mut state = 1u32;
        for n in 1..20_000u32 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            model.step((state >> 24) as u8, 0, (65536 / n).max(131));
            let w = model.0.map(|m| u32::from(m[0]));
            assert!(w[0] >= w[1] && w[1] >= w[2] && w.iter().sum::<u32>() <= 65536 + 131, "{w:?}");
        }
    }

    #[test]
    fn a_new_model_takes_the_first_frame_whole() {
        let mut model = Model([[0; 3]; MODES]);
        model.step(77, 0, 65536);
        assert_eq!(model.0[0][..2], [65535, 77 << 8]);
        assert!(!model.step(77, 1, 131));
    }
}
