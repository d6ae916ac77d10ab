//! Steps of the views' logarithm, without its slow part: what the stacks add up.
//!
//! In: the views kept. Out: for each a picture of steps, taken once, when the view comes. A shadow's factor
//! drops out of a logarithm's step, and its soft border is part of what is slow.

use crate::camera::BeltView;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::Level;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::box_filter;
use crate::kernel::scalar::steps::Rows;
use crate::kernel::simd::box_filter::box_filter;
use crate::kernel::simd::steps::take_steps;
use crate::plan::{Block, Memory, Plan};
use crate::stage::evidence::DARK_GREY;
use crate::stage::views::VIEWS_MAX;

/// Side of a fine picture's pixel, mm, about: coarser than the fit's, finer than any gap that matters.
const PX_MM: f64 = 2.0;
/// Pixels of a coarse picture are twice as wide, if that is no more than this, mm: a small parcel still has
/// sides.
const COARSE_PX_MAX_MM: f64 = 5.0;

/// How large the pixels are: what is sought is found in coarse pictures and looked at in fine ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// About 2 mm.
    Fine,
    /// Twice as much.
    Coarse,
}

impl Scale {
    /// The name of a block of memory at this scale.
    pub fn name(self, [fine, coarse]: [&'static str; 2]) -> &'static str {
        if self == Self::Fine { fine } else { coarse }
    }

    /// Pixels of the view to a side of a picture's, and the picture's size.
    pub fn sizes(self, view: &BeltView) -> (usize, [usize; 2]) {
        let fine_px = (PX_MM / view.mm_per_px).round().max(1.0) as usize;
        let is_twice = 2.0 * fine_px as f64 * view.mm_per_px <= COARSE_PX_MAX_MM;
        let side_px = if self == Self::Coarse && is_twice { 2 * fine_px } else { fine_px };
        (side_px, view.size_px.map(|px| (px / side_px).max(1)))
    }
}

/// The steps of one view.
#[derive(Clone, Copy)]
pub struct StepPicture<'a> {
    /// Along X, from dark to bright, in units of 1 / [`STEP_ONE`](crate::kernel::scalar::steps::STEP_ONE).
    pub along: &'a [i8],
    /// Along Y.
    pub across: &'a [i8],
    /// Grey values.
    pub grey: &'a [u8],
}

const LOG_OF_SUM: [&str; 2] = ["steps.log_of_sum", "coarse_steps.log_of_sum"];
const LOG: [&str; 2] = ["steps.log", "coarse_steps.log"];
const SLOW: [&str; 2] = ["steps.slow", "coarse_steps.slow"];
const SCRATCH: [&str; 2] = ["steps.scratch", "coarse_steps.scratch"];
const SEEN: [&str; 2] = ["steps.seen", "coarse_steps.seen"];
const ALONG: [&str; 2] = ["steps.along", "coarse_steps.along"];
const ACROSS: [&str; 2] = ["steps.across", "coarse_steps.across"];
const GREY: [&str; 2] = ["steps.grey", "coarse_steps.grey"];

/// The stage.
pub struct Steps {
    /// Pixels of the view to a side of a picture's.
    side_px: usize,
    size_px: [usize; 2],
    level: Level,
    /// Logarithms of the mean, by the sum of a pixel's grey values.
    log_of_sum: Block<f32>,
    log: Block<f32>,
    slow: Block<f32>,
    scratch: Block<f32>,
    seen: Block<u8>,
    along: Block<i8>,
    across: Block<i8>,
    grey: Block<u8>,
}

impl Steps {
    /// Memory for a view.
    pub fn plan(view: &BeltView, scale: Scale, plan: &mut Plan) {
        let (side_px, [width, height]) = scale.sizes(view);
        let n = width * height;
        plan.add::<f32>(scale.name(LOG_OF_SUM), 255 * side_px * side_px + 1, "logarithms");
        plan.add::<f32>(scale.name(LOG), n, "logarithm of one view");
        plan.add::<f32>(scale.name(SLOW), n, "its slow part");
        plan.add::<f32>(scale.name(SCRATCH), n, "the other half of each smoothing");
        plan.add::<u8>(scale.name(SEEN), n, "pixels that the camera sees with all around");
        plan.add::<i8>(scale.name(ALONG), n * VIEWS_MAX, "steps along X of each view kept");
        plan.add::<i8>(scale.name(ACROSS), n * VIEWS_MAX, "steps along Y of each view kept");
        plan.add::<u8>(scale.name(GREY), n * VIEWS_MAX, "grey values to them");
    }

    /// None yet. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(
        view: &BeltView,
        scale: Scale,
        level: Level,
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        let (side_px, size_px) = scale.sizes(view);
        let mut log_of_sum = memory.take(scale.name(LOG_OF_SUM), 0.0)?;
        let share = 1.0 / (side_px * side_px) as f32;
        for (sum, log) in log_of_sum.iter_mut().enumerate() {
            *log = (sum as f32 * share + DARK_GREY).ln();
        }
        let mut steps = Self {
            side_px,
            size_px,
            level,
            log_of_sum,
            log: memory.take(scale.name(LOG), 0.0)?,
            slow: memory.take(scale.name(SLOW), 0.0)?,
            scratch: memory.take(scale.name(SCRATCH), 0.0)?,
            seen: memory.take(scale.name(SEEN), 0)?,
            along: memory.take(scale.name(ALONG), 0)?,
            across: memory.take(scale.name(ACROSS), 0)?,
            grey: memory.take(scale.name(GREY), 0)?,
        };
        steps.find_seen(words(view.size_px[0]), seen);
        Ok(steps)
    }

    /// Of a picture's pixels, 255 for those that the camera sees with all that their steps are made from,
    /// else 0.
    fn find_seen(&mut self, words: usize, seen: &[u64]) {
        let ([width, height], side) = (self.size_px, self.side_px);
        // What is not seen spreads as it does in the steps: as NaN.
        for j in 0..height {
            for i in 0..width {
                let row = |v: usize| &seen[v * words..][..words];
                let mut pixels = (j * side..(j + 1) * side)
                    .flat_map(|v| (i * side..(i + 1) * side).map(move |u| (u, v)));
                let whole = pixels.all(|(u, v)| bits::get(row(v), u));
                self.log[j * width + i] = if whole { 0.0 } else { f32::NAN };
            }
        }
        self.take_out_slow_part();
        for j in 1..height - 1 {
            for i in 1..width - 1 {
                let at = j * width + i;
                let around = [at - 1, at + 1, at - width, at + width].map(|at| self.log[at]);
                let known = around.iter().all(|log| !log.is_nan());
                self.seen[at] = if known { u8::MAX } else { 0 };
            }
        }
    }

    /// Of a picture's pixels, 255 for those that the camera sees, else 0.
    pub fn seen(&self) -> &[u8] {
        &self.seen
    }

    /// The steps of the view at a place.
    pub fn picture(&self, place: usize) -> StepPicture<'_> {
        let n = self.size_px[0] * self.size_px[1];
        let here = place * n..(place + 1) * n;
        StepPicture {
            along: &self.along[here.clone()],
            across: &self.across[here.clone()],
            grey: &self.grey[here],
        }
    }

    /// A view more.
    pub fn add(&mut self, grey: Plane<'_>, place: usize) {
        self.take_logarithms(grey, place);
        self.take_out_slow_part();
        let [width, height] = self.size_px;
        let n = width * height;
        let along = &mut self.along[place * n..][..n];
        let across = &mut self.across[place * n..][..n];
        for j in 1..height - 1 {
            let line = |j: usize| &self.log[j * width..][..width];
            let [above, here, below] = [j - 1, j, j + 1].map(line);
            let out = j * width + 1..(j + 1) * width - 1;
            let rows = Rows { above: &above[1..], here, below: &below[1..] };
            take_steps(self.level, rows, &mut along[out.clone()], &mut across[out]);
        }
    }

    /// Means over a picture's pixel, and their logarithms.
    fn take_logarithms(&mut self, grey: Plane<'_>, place: usize) {
        let ([width, height], side) = (self.size_px, self.side_px);
        let means = &mut self.grey[place * width * height..][..width * height];
        let lines = means.chunks_exact_mut(width).zip(self.log.chunks_exact_mut(width));
        for (j, (means, logs)) in lines.enumerate() {
            for (i, (mean, log)) in means.iter_mut().zip(logs).enumerate() {
                let mut sum = 0;
                for v in j * side..(j + 1) * side {
                    let pixels = &grey.row(v)[i * side..(i + 1) * side];
                    sum += pixels.iter().map(|&g| usize::from(g)).sum::<usize>();
                }
                *mean = (sum / (side * side)) as u8;
                *log = self.log_of_sum[sum];
            }
        }
    }

    fn take_out_slow_part(&mut self) {
        self.slow.copy_from_slice(&self.log);
        for _ in 0..PASSES {
            box_filter(self.level, &mut self.slow, &mut self.scratch, self.size_px[0]);
        }
        for (log, slow) in self.log.iter_mut().zip(self.slow.iter()) {
            *log -= slow;
        }
    }
}

/// So far the slow part spreads an edge.
pub const REACH_PX: usize = PASSES * box_filter::REACH;
/// Times that the box filter is applied.
const PASSES: usize = 2;
