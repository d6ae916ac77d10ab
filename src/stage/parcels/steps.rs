//! Steps of the views' logarithm, without its slow part: what the stacks add up.
//!
//! In: the views kept. Out: for each a picture of steps, taken once, when the view comes. A shadow's factor
//! drops out of a logarithm's step, and its soft border is part of what is slow.

use crate::camera::BeltView;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::box_filter::{self, box_filter};
use crate::plan::{Block, Memory, Plan};
use crate::stage::evidence::DARK_GREY;
use crate::stage::views::VIEWS_MAX;

/// Side of a fine picture's pixel, mm, about: coarser than the fit's, finer than any gap that matters.
const PX_MM: f64 = 2.0;
/// Pixels of a coarse picture are twice as wide, if that is no more than this, mm: a small parcel still has
/// sides.
const COARSE_PX_MAX_MM: f64 = 5.0;
/// A step of 1 in the logarithm, in units of a stored one.
pub const STEP_ONE: f32 = 256.0;
/// The longest step that is stored; longer ones keep their direction.
const STEP_MOST: f32 = 127.0;

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
    /// Along X and along Y, from dark to bright, in units of 1 / [`STEP_ONE`].
    pub steps: &'a [[i8; 2]],
    /// Grey values; 0: not known.
    pub grey: &'a [u8],
}

const LOG: [&str; 2] = ["steps.log", "coarse_steps.log"];
const SLOW: [&str; 2] = ["steps.slow", "coarse_steps.slow"];
const STEPS: [&str; 2] = ["steps.steps", "coarse_steps.steps"];
const GREY: [&str; 2] = ["steps.grey", "coarse_steps.grey"];

/// The stage.
pub struct Steps {
    /// Pixels of the view to a side of a picture's.
    side_px: usize,
    view_px: [usize; 2],
    size_px: [usize; 2],
    /// Logarithm of the grey values 0 to 255.
    log_of: [f32; 256],
    log: Block<f32>,
    slow: Block<f32>,
    steps: Block<[i8; 2]>,
    grey: Block<u8>,
}

impl Steps {
    /// Memory for a view.
    pub fn plan(view: &BeltView, scale: Scale, plan: &mut Plan) {
        let (_, [width, height]) = scale.sizes(view);
        let n = width * height;
        plan.add::<f32>(scale.name(LOG), n, "logarithm of one view");
        plan.add::<f32>(scale.name(SLOW), n, "its slow part");
        plan.add::<[i8; 2]>(scale.name(STEPS), n * VIEWS_MAX, "steps of each view kept");
        plan.add::<u8>(scale.name(GREY), n * VIEWS_MAX, "grey values to them");
    }

    /// None yet.
    pub fn new(view: &BeltView, scale: Scale, memory: &mut Memory) -> Result<Self> {
        let (side_px, size_px) = scale.sizes(view);
        Ok(Self {
            side_px,
            view_px: view.size_px,
            size_px,
            log_of: std::array::from_fn(|grey| (grey as f32 + DARK_GREY).ln()),
            log: memory.take(scale.name(LOG), 0.0)?,
            slow: memory.take(scale.name(SLOW), 0.0)?,
            steps: memory.take(scale.name(STEPS), [0; 2])?,
            grey: memory.take(scale.name(GREY), 0)?,
        })
    }

    /// The steps of the view at a place.
    pub fn picture(&self, place: usize) -> StepPicture<'_> {
        let n = self.size_px[0] * self.size_px[1];
        StepPicture { steps: &self.steps[place * n..][..n], grey: &self.grey[place * n..][..n] }
    }

    /// A view more. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn add(&mut self, grey: Plane<'_>, seen: &[u64], place: usize) {
        self.take_logarithms(grey, seen, place);
        self.find_slow_part();
        let [width, height] = self.size_px;
        for (log, slow) in self.log.iter_mut().zip(self.slow.iter()) {
            *log -= slow;
        }
        let n = width * height;
        let steps = &mut self.steps[place * n..][..n];
        let grey = &mut self.grey[place * n..][..n];
        steps.fill([0; 2]);
        for j in 0..height {
            for i in 0..width {
                let at = j * width + i;
                let inside = i > 0 && j > 0 && i + 1 < width && j + 1 < height;
                let step = inside.then(|| {
                    let fine = &self.log;
                    [fine[at + 1] - fine[at - 1], fine[at - width] - fine[at + width]]
                });
                match step.and_then(stored) {
                    Some(step) => steps[at] = step,
                    None => grey[at] = 0,
                }
            }
        }
    }

    /// Means over a picture's pixel, and their logarithms; NaN where one is not seen.
    fn take_logarithms(&mut self, grey: Plane<'_>, seen: &[u64], place: usize) {
        let ([width, height], side) = (self.size_px, self.side_px);
        let n = words(self.view_px[0]);
        for j in 0..height {
            for i in 0..width {
                let (mut sum, mut unseen) = (0u32, false);
                for v in j * side..(j + 1) * side {
                    let here = i * side..(i + 1) * side;
                    sum += grey.row(v)[here.clone()].iter().map(|&g| u32::from(g)).sum::<u32>();
                    unseen |= here.into_iter().any(|u| !bits::get(&seen[v * n..][..n], u));
                }
                let at = j * width + i;
                let mean = sum as f32 / (side * side) as f32;
                self.grey[place * width * height + at] = (mean as u8).max(1);
                self.log[at] = match (unseen, side) {
                    (true, _) => f32::NAN,
                    (false, 1) => self.log_of[sum as usize],
                    (false, _) => (mean + DARK_GREY).ln(),
                };
            }
        }
    }

    fn find_slow_part(&mut self) {
        let [width, height] = self.size_px;
        self.slow.copy_from_slice(&self.log);
        for _ in 0..PASSES {
            for line in self.slow.chunks_exact_mut(width) {
                box_filter(line, 1, width);
            }
            for column in 0..width {
                box_filter(&mut self.slow[column..], width, height);
            }
        }
    }
}

/// So far the slow part spreads an edge.
pub const REACH_PX: usize = PASSES * box_filter::REACH;
/// Times that the box filter is applied.
const PASSES: usize = 2;

fn stored([x, y]: [f32; 2]) -> Option<[i8; 2]> {
    let length = STEP_ONE * x.hypot(y);
    if length.is_nan() {
        return None;
    }
    let scale = STEP_ONE * (STEP_MOST / length.max(STEP_MOST));
    Some([x, y].map(|step| (scale * step).round() as i8))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_stored_with_its_direction_however_long_and_what_is_unknown_is_none() {
        assert_eq!(stored([0.1, -0.2]), Some([26, -51]));
        let [x, y] = stored([3.0, 4.0]).expect("known");
        assert_eq!([x, y], [76, 102], "of length 127");
        assert_eq!(stored([f32::NAN, 0.0]), None);
    }
}
