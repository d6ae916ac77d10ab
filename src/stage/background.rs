//! Belt view -> foreground mask, by an incremental Gaussian mixture that follows the light.
//!
//! In: belt view; pixels to hold (parcels, or everything while the belt stands). Out: bit
//! masks of the foreground, shadows excluded, and of its dark part, which may be deep shadow;
//! the belt's mean brightness. Owns: the model.
//! A common factor on all pixels (lamp flicker, drift, exposure) is estimated each frame from
//! a coarse grid and divided out, so that a light change does not flood the mask.

use crate::config::Background as Settings;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::bits::words;
use crate::kernel::scalar::mixture::{MODES, ModeRow, Params, observation, update};
use crate::plan::{Block, Memory, Plan};

/// Gain 1 in Q12.
const GAIN_ONE: u32 = 1 << 12;
/// Every so many pixels and rows one pixel votes on the gain.
const GAIN_GRID_PX: usize = 6;
/// Pixels darker than this say little about the gain: 10 grey levels, Q8.
const GAIN_MEAN_MIN: u16 = 10 << 8;
/// Brightness ratios are counted in bins of 1/128, up to 4.
const GAIN_BINS: usize = 512;
const GAIN_BIN_ONE: u32 = 128;
/// The mean is taken over ratios this near to the median.
const GAIN_BINS_NEAR: usize = 8;

const MODE_BLOCKS: [[&str; 3]; MODES] = [
    ["background.weight_0", "background.mean_0", "background.variance_0"],
    ["background.weight_1", "background.mean_1", "background.variance_1"],
    ["background.weight_2", "background.mean_2", "background.variance_2"],
];

struct Mode {
    weight: Block<u16>,
    mean: Block<u16>,
    variance: Block<u16>,
}

/// The background stage.
pub struct Background {
    width: usize,
    settings: Settings,
    modes: [Mode; MODES],
    foreground: Block<u64>,
    dark: Block<u64>,
    strong: Block<u64>,
    gain_histogram: Block<u32>,
    /// Model brightness over scene brightness, Q12.
    gain_q12: u32,
    frames: u32,
}

impl Background {
    /// Memory for a view.
    pub fn plan([width, height]: [usize; 2], plan: &mut Plan) {
        for name in MODE_BLOCKS.iter().flatten() {
            plan.add::<u16>(name, width * height, "mixture model, one plane a mode and value");
        }
        plan.add::<u64>("background.foreground", words(width) * height, "bit: foreground");
        plan.add::<u64>("background.dark", words(width) * height, "bit: foreground or deep shadow");
        plan.add::<u64>("background.strong", words(width) * height, "bit: far from the background");
        plan.add::<u32>("background.gain", GAIN_BINS, "histogram of brightness ratios");
    }

    /// An empty model.
    pub fn new([width, _]: [usize; 2], settings: Settings, memory: &mut Memory) -> Result<Self> {
        let mut mode = |names: [&'static str; 3]| -> Result<Mode> {
            Ok(Mode {
                weight: memory.take(names[0], 0)?,
                mean: memory.take(names[1], 0)?,
                variance: memory.take(names[2], 0)?,
            })
        };
        let modes = [mode(MODE_BLOCKS[0])?, mode(MODE_BLOCKS[1])?, mode(MODE_BLOCKS[2])?];
        Ok(Self {
            width,
            settings,
            modes,
            foreground: memory.take("background.foreground", 0)?,
            dark: memory.take("background.dark", 0)?,
            strong: memory.take("background.strong", 0)?,
            gain_histogram: memory.take("background.gain", 0)?,
            gain_q12: GAIN_ONE,
            frames: 0,
        })
    }

    /// Classify and learn one frame. `seen` and `hold` are bit masks of the view.
    pub fn step(&mut self, view: Plane<'_>, seen: &[u64], hold: &[u64]) {
        if self.frames > 0 {
            self.gain_q12 = self.estimate_gain(view, seen);
        }
        self.frames = self.frames.saturating_add(1);
        let params = self.params();
        let n = words(self.width);
        for v in 0..view.height() {
            let row = view.row(v);
            for (w, grey) in row.chunks(64).enumerate() {
                let word = v * n + w;
                let pixels = v * self.width + w * 64..v * self.width + w * 64 + grey.len();
                let mut modes = self.modes.each_mut().map(|m| ModeRow {
                    weight: &mut m.weight[pixels.clone()],
                    mean: &mut m.mean[pixels.clone()],
                    variance: &mut m.variance[pixels.clone()],
                });
                let hold = hold[word] | !seen[word];
                let masks = update(grey, &mut modes, hold, &params);
                self.foreground[word] = masks.foreground & seen[word];
                self.dark[word] = masks.dark & seen[word];
                self.strong[word] = masks.strong & seen[word];
            }
        }
    }

    fn params(&self) -> Params {
        let sigma = self.settings.threshold_sigma;
        let history = self.frames.min(self.settings.history_frames);
        Params {
            rate_q16: 65536 / history,
            gain_q12: self.gain_q12,
            match_d2_q8: 9 << 8, // 3 sigma, as in Zivkovic 2004
            background_d2_q8: (sigma * sigma * 256.0) as u32,
            background_share_q16: 58982, // 0.9
            shadow_ratio_q8: (self.settings.shadow_ratio_min * 256.0) as u32,
            dark_ratio_q8: (self.settings.deep_shadow_ratio_min * 256.0) as u32,
        }
    }

    /// Model over scene brightness: the median of scene over model on the grid finds the belt,
    /// the mean of the ratios near it is the gain. What was foreground does not vote.
    fn estimate_gain(&mut self, view: Plane<'_>, seen: &[u64]) -> u32 {
        let (n, width) = (words(self.width), self.width);
        let mean = &self.modes[0].mean;
        let foreground = &self.foreground;
        let grid = |v: usize| {
            let row = view.row(v);
            (0..width).step_by(GAIN_GRID_PX).filter_map(move |u| {
                let model = mean[v * width + u];
                let is_belt = seen[v * n + u / 64] & !foreground[v * n + u / 64];
                let visible = is_belt >> (u % 64) & 1 == 1;
                let bin = u32::from(row[u]) * 256 * GAIN_BIN_ONE / u32::from(model.max(1));
                (visible && model >= GAIN_MEAN_MIN).then_some((
                    row[u],
                    model,
                    (bin as usize).min(GAIN_BINS - 1),
                ))
            })
        };
        let rows = || (0..view.height()).step_by(GAIN_GRID_PX);
        let histogram = &mut self.gain_histogram;
        histogram.fill(0);
        let mut votes = 0;
        for (_, _, bin) in rows().flat_map(grid) {
            histogram[bin] += 1;
            votes += 1;
        }
        let mut below = 0;
        let median = histogram.iter().position(|&count| {
            below += count;
            below * 2 > votes
        });
        let Some(median) = median else { return self.gain_q12 };
        let (mut scene, mut model) = (0u64, 0u64);
        for (grey, mean, bin) in rows().flat_map(grid) {
            if bin.abs_diff(median) <= GAIN_BINS_NEAR {
                scene += u64::from(grey);
                model += u64::from(mean);
            }
        }
        // Both sums are over the same pixels; the model is in Q8.
        let gain = model * u64::from(GAIN_ONE) / (scene * 256).max(1);
        (gain as u32).clamp(GAIN_ONE / 4, GAIN_ONE * 4)
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

    /// A pixel's difference from the belt's mean, in Q8 grey levels at model brightness.
    pub fn difference(&self, grey: u8, index: usize) -> i32 {
        i32::from(observation(grey, self.gain_q12)) - i32::from(self.modes[0].mean[index])
    }
}
