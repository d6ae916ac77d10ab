//! Belt view -> foreground mask, by an incremental Gaussian mixture that follows the light.
//!
//! In: belt view; pixels to hold (parcels, or everything while the belt stands). Out: bit
//! masks of the foreground, shadows excluded, and of its dark part, which may be deep shadow;
//! the belt's mean brightness. Owns: the model.
//! A common factor on all pixels (lamp flicker, drift, exposure) is estimated each frame from
//! a coarse grid and divided out, so that a light change does not flood the mask.

use crate::config::Background as Settings;
use crate::error::Result;

use crate::kernel::Level;
use crate::kernel::bands::{self, Jobs, rows_per_band};
use crate::kernel::scalar::bits::{stride, words};
use crate::kernel::scalar::mixture::{
    Gain, MATCH_Q8, MINORS, Params, Rate, VARIANCE_NEW, observation,
};
use crate::kernel::scalar::texture::{Belt, texture_shift};
use crate::kernel::simd::mixture::{Masks, Minors, Model, update};
use crate::plan::{Block, Memory, Plan};

/// Gain 1 in Q15.
const GAIN_ONE: u32 = 1 << 15;
/// So many pixels, evenly spread, vote on the gain.
const GAIN_VOTES: usize = 8000;
/// Pixels darker than this say little about the gain: 10 grey levels, Q7.
const GAIN_MEAN_MIN: u16 = 10 << 7;
/// Brightness ratios are counted in bins of 1/128, up to 4.
const GAIN_BINS: usize = 512;
const GAIN_BIN_ONE: u32 = 128;
/// The mean is taken over ratios this near to the median.
const GAIN_BINS_NEAR: usize = 8;
/// Modes that together hold nine tenths of the observations are background, 1/255.
const BACKGROUND_SHARE: u8 = 229;

const MINOR_BLOCKS: [[&str; 3]; MINORS] = [
    ["background.mean_1", "background.deviation_1", "background.weight_1"],
    ["background.mean_2", "background.deviation_2", "background.weight_2"],
];

/// Bin with the middle one of `count` votes.
fn median(votes: impl IntoIterator<Item = u32>, count: u32) -> Option<usize> {
    let mut below = 0;
    votes.into_iter().position(|votes| {
        below += votes;
        below * 2 > count
    })
}

/// A weaker mode of every pixel.
struct Minor {
    mean: Block<u16>,
    deviation: Block<u8>,
    weight: Block<u8>,
}

/// Pixels of about the same brightness ratio.
#[derive(Clone, Copy, Default)]
struct GainBin {
    votes: u32,
    /// Sum of their grey levels.
    scene: u32,
    /// Sum of their means, Q7.
    model: u32,
}

/// The background stage.
pub struct Background {
    level: Level,
    bands: usize,
    width: usize,
    settings: Settings,
    mean: Block<u16>,
    variance: Block<u16>,
    minors: [Minor; MINORS],
    multiple: Block<u64>,
    foreground: Block<u64>,
    dark: Block<u64>,
    strong: Block<u64>,
    gain_histogram: Block<GainBin>,
    gain_step_px: usize,
    /// Model brightness over scene brightness, Q15.
    gain_q15: u32,
    /// Median standard deviation of the belt, Q3.
    deviation_q3: u16,
    frames: u32,
}

impl Background {
    /// Memory for a view.
    pub fn plan([width, height]: [usize; 2], plan: &mut Plan) {
        let (pixels, words) = (stride(width) * height, words(width) * height);
        plan.add::<u16>("background.mean", pixels, "mixture model, the main mode of each pixel");
        plan.add::<u16>("background.variance", pixels, "mixture model, the main mode");
        for [mean, deviation, weight] in MINOR_BLOCKS {
            plan.add::<u16>(mean, pixels, "mixture model, a weaker mode; seldom touched");
            plan.add::<u8>(deviation, pixels, "mixture model, a weaker mode");
            plan.add::<u8>(weight, pixels, "mixture model, a weaker mode");
        }
        plan.add::<u64>("background.multiple", words, "bit: the pixel has a weaker mode");
        plan.add::<u64>("background.foreground", words, "bit: foreground");
        plan.add::<u64>("background.dark", words, "bit: foreground or deep shadow");
        plan.add::<u64>("background.strong", words, "bit: far from the background");
        plan.add::<GainBin>("background.gain", GAIN_BINS, "histogram of brightness ratios");
    }

    /// An empty model.
    pub fn new(
        [width, height]: [usize; 2],
        settings: Settings,
        level: Level,
        bands: usize,
        memory: &mut Memory,
    ) -> Result<Self> {
        let mean = memory.take("background.mean", 0)?;
        let variance = memory.take("background.variance", VARIANCE_NEW)?;
        let mut minor = |[mean, deviation, weight]: [&'static str; 3]| -> Result<Minor> {
            Ok(Minor {
                mean: memory.take(mean, 0)?,
                deviation: memory.take(deviation, 0)?,
                weight: memory.take(weight, 0)?,
            })
        };
        let minors = [minor(MINOR_BLOCKS[0])?, minor(MINOR_BLOCKS[1])?];
        Ok(Self {
            level,
            bands,
            width,
            settings,
            mean,
            variance,
            minors,
            multiple: memory.take("background.multiple", 0)?,
            foreground: memory.take("background.foreground", 0)?,
            dark: memory.take("background.dark", 0)?,
            strong: memory.take("background.strong", 0)?,
            gain_histogram: memory.take("background.gain", GainBin::default())?,
            gain_step_px: (width * height / GAIN_VOTES).isqrt().max(1),
            gain_q15: GAIN_ONE,
            deviation_q3: 0,
            frames: 0,
        })
    }

    /// Classify and learn one frame: `grey`, rows of [`stride`] pixels. `hold`: bit mask of the
    /// pixels not to learn.
    pub fn step(&mut self, grey: &[u8], seen: &[u64], hold: &[u64]) {
        if self.frames == 0 {
            for (mean, &grey) in self.mean.iter_mut().zip(grey) {
                *mean = observation(grey, Gain::ONE);
            }
        } else {
            self.gain_q15 = self.estimate_gain(grey, seen);
        }
        self.frames = self.frames.saturating_add(1);
        let params = self.params();
        let level = self.level;
        let height = self.foreground.len() / words(self.width);
        let rows = rows_per_band(height, self.bands);
        let (pixels, words) = (rows * stride(self.width), rows * words(self.width));
        let mut minors = self.minors.each_mut().map(|m| {
            (m.mean.chunks_mut(pixels), m.deviation.chunks_mut(pixels), m.weight.chunks_mut(pixels))
        });
        let mut minor = |k: usize| {
            let (mean, deviation, weight) = &mut minors[k];
            Some(Minors {
                mean: mean.next()?,
                deviation: deviation.next()?,
                weight: weight.next()?,
            })
        };
        let (mut mean, mut variance) =
            (self.mean.chunks_mut(pixels), self.variance.chunks_mut(pixels));
        let mut multiple = self.multiple.chunks_mut(words);
        let (mut foreground, mut dark, mut strong) = (
            self.foreground.chunks_mut(words),
            self.dark.chunks_mut(words),
            self.strong.chunks_mut(words),
        );
        let parts = grey.chunks(pixels).zip(hold.chunks(words)).zip(seen.chunks(words));
        let mut jobs: Jobs<_> = parts
            .map_while(|((grey, hold), seen)| {
                let model = Model {
                    mean: mean.next()?,
                    variance: variance.next()?,
                    minors: [minor(0)?, minor(1)?],
                    multiple: multiple.next()?,
                };
                let masks = Masks {
                    foreground: foreground.next()?,
                    dark: dark.next()?,
                    strong: strong.next()?,
                };
                Some((grey, hold, seen, model, masks))
            })
            .collect();
        bands::run(&mut jobs, &|(grey, hold, seen, model, masks)| {
            update(level, grey, model, hold, masks, &params);
            for mask in [&mut *masks.foreground, &mut *masks.dark, &mut *masks.strong] {
                for (bits, seen) in mask.iter_mut().zip(*seen) {
                    *bits &= seen;
                }
            }
        });
    }

    fn params(&self) -> Params {
        let ratio_q8 = |ratio: f64| ((ratio * 256.0) as u16).min(255);
        Params {
            rate: Rate::new(self.frames.min(self.settings.history_frames), self.frames),
            gain: Gain::from_q15(self.gain_q15),
            reach_q8: ((256.0 / self.settings.threshold_sigma) as u16).min(MATCH_Q8),
            background_share: BACKGROUND_SHARE,
            shadow_ratio_q8: ratio_q8(self.settings.shadow_ratio_min),
            dark_ratio_q8: ratio_q8(self.settings.deep_shadow_ratio_min),
        }
    }

    /// Model over scene brightness: the median of scene over model on the grid finds the belt,
    /// the mean of the ratios near it is the gain. What was foreground does not vote.
    fn estimate_gain(&mut self, grey: &[u8], seen: &[u64]) -> u32 {
        let (n, stride, step) = (words(self.width), stride(self.width), self.gain_step_px);
        let histogram = &mut self.gain_histogram;
        histogram.fill(GainBin::default());
        let mut deviations = [0u32; 256];
        let mut count = 0;
        for v in (0..self.mean.len() / stride).step_by(step) {
            for u in (0..self.width).step_by(step) {
                let (scene, model) = (grey[v * stride + u], self.mean[v * stride + u]);
                let word = v * n + u / 64;
                deviations[usize::from(self.variance[v * stride + u].isqrt())] +=
                    u32::from(seen[word] >> (u % 64) & 1 == 1);
                let is_belt = (seen[word] & !self.foreground[word]) >> (u % 64) & 1 == 1;
                if is_belt && model >= GAIN_MEAN_MIN {
                    let ratio = u32::from(scene) * 128 * GAIN_BIN_ONE / u32::from(model);
                    let bin = &mut histogram[(ratio as usize).min(GAIN_BINS - 1)];
                    bin.votes += 1;
                    bin.scene += u32::from(scene);
                    bin.model += u32::from(model);
                    count += 1;
                }
            }
        }
        let all = deviations.iter().sum();
        self.deviation_q3 = median(deviations, all).unwrap_or_default() as u16;
        let Some(median) = median(histogram.iter().map(|bin| bin.votes), count) else {
            return self.gain_q15;
        };
        let near =
            median.saturating_sub(GAIN_BINS_NEAR)..GAIN_BINS.min(median + GAIN_BINS_NEAR + 1);
        let (mut scene, mut model) = (0u64, 0u64);
        for bin in &histogram[near] {
            scene += u64::from(bin.scene);
            model += u64::from(bin.model);
        }
        // Both sums are over the same pixels; the model is in Q7.
        let gain = model * u64::from(GAIN_ONE) / (scene * 128).max(1);
        gain.clamp(u64::from(GAIN_ONE / 4), 65535) as u32
    }

    /// Standard deviation of a belt pixel over time, grey levels: its texture as it passes, and the
    /// camera's noise. Median over the view.
    pub fn belt_sigma_grey(&self) -> f64 {
        f64::from(self.deviation_q3) / 8.0
    }

    /// Grey levels by which a parcel must differ from the belt to be beyond doubt.
    pub fn contrast_min_grey(&self) -> f64 {
        2.0 * self.settings.threshold_sigma * self.belt_sigma_grey()
    }

    /// Learn anew, from the next frame on.
    pub fn forget(&mut self) {
        self.variance.fill(VARIANCE_NEW);
        for block in [&mut self.multiple, &mut self.foreground, &mut self.dark, &mut self.strong] {
            block.fill(0);
        }
        (self.gain_q15, self.frames) = (GAIN_ONE, 0);
    }

    /// Whether the model has seen enough frames to be trusted.
    pub fn learned(&self) -> bool {
        self.frames > self.settings.learn_frames
    }

    /// Bit mask of the foreground.
    pub fn foreground(&self) -> &[u64] {
        &self.foreground
    }

    /// Bit mask of its dark part.
    pub fn dark(&self) -> &[u64] {
        &self.dark
    }

    /// Bit mask of the foreground that is beyond doubt.
    pub fn strong(&self) -> &[u64] {
        &self.strong
    }

    /// What grey levels are to be compared with, row by row of [`stride`] pixels.
    pub fn belt(&self) -> Belt<'_> {
        Belt {
            mean: &self.mean,
            gain: Gain::from_q15(self.gain_q15),
            shift: texture_shift(self.belt_sigma_grey()),
        }
    }
}
