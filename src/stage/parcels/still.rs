//! What stands still while the belt moves: rails, frames, dirt on the lens.
//!
//! In: the grey values of the step pictures. Out: which of their pixels are away from every edge of the still scene.
//! Such an edge is at the same place in every view, so that along the travel it would look as if it rode
//! along. The still scene is the running median of each pixel over the views, which moves by a grey level a
//! view: what is in the first one is forgotten after as many views as it has contrast.

use super::steps::{REACH_PX, Scale};
use crate::camera::BeltView;
use crate::error::Result;
use crate::plan::{Block, Memory, Plan};

/// A step of the still scene between neighbours but one, in hundredths of its grey values ...
const STEP_PERCENT: u16 = 6;
/// ... and in grey levels: noise is none.
const STEP_GREY: u8 = 4;

const MEDIAN: [&str; 2] = ["still.median", "coarse_still.median"];
const FREE: [&str; 2] = ["still.free", "coarse_still.free"];
const USABLE: [&str; 2] = ["still.usable", "coarse_still.usable"];

/// The still scene.
pub struct Still {
    size_px: [usize; 2],
    median: Block<u8>,
    known: bool,
    /// 255 where the scene has no edge along the travel, else 0.
    free: Block<u8>,
    usable: Block<u8>,
}

impl Still {
    /// Memory for a view.
    pub fn plan(view: &BeltView, scale: Scale, plan: &mut Plan) {
        let (_, [width, height]) = scale.sizes(view);
        plan.add::<u8>(scale.name(MEDIAN), width * height, "what stands still");
        plan.add::<u8>(scale.name(FREE), width * height, "pixels that are none of its edges");
        plan.add::<u8>(scale.name(USABLE), width * height, "pixels without its edges");
    }

    /// Nothing seen.
    pub fn new(view: &BeltView, scale: Scale, memory: &mut Memory) -> Result<Self> {
        let (_, size_px) = scale.sizes(view);
        Ok(Self {
            size_px,
            median: memory.take(scale.name(MEDIAN), 0)?,
            known: false,
            free: memory.take(scale.name(FREE), u8::MAX)?,
            usable: memory.take(scale.name(USABLE), 0)?,
        })
    }

    /// 255 for pixels that are seen away from every edge of the still scene, else 0.
    pub fn usable(&self) -> &[u8] {
        &self.usable
    }

    /// The grey values of a view more. `seen`: 255 for pixels that the camera sees, else 0.
    pub fn add(&mut self, grey: &[u8], seen: &[u8]) {
        if !self.known {
            self.median.copy_from_slice(grey);
            self.known = true;
        }
        for (median, &grey) in self.median.iter_mut().zip(grey) {
            *median = *median + u8::from(grey > *median) - u8::from(grey < *median);
        }
        self.find_edges(seen);
        let [width, height] = self.size_px;
        self.usable.copy_from_slice(seen);
        for v in 0..height {
            let usable = &mut self.usable[v * width..][..width];
            // As far as the slow part spreads an edge.
            for near in v.saturating_sub(REACH_PX)..=(v + REACH_PX).min(height - 1) {
                let free = &self.free[near * width..][..width];
                usable.iter_mut().zip(free).for_each(|(usable, free)| *usable &= free);
            }
        }
    }

    /// Only edges along the travel stay where they are on the belt, too.
    fn find_edges(&mut self, seen: &[u8]) {
        let [width, height] = self.size_px;
        for v in 1..height.saturating_sub(1) {
            let row = |v: usize| v * width..(v + 1) * width;
            let [above, below] = [v - 1, v + 1].map(|v| &self.median[row(v)]);
            let known = seen[row(v - 1)].iter().zip(&seen[row(v + 1)]).map(|(a, b)| a & b);
            let greys = above.iter().zip(below).zip(known);
            for (free, ((&above, &below), known)) in self.free[row(v)].iter_mut().zip(greys) {
                let step = above.abs_diff(below);
                let sum = u16::from(above) + u16::from(below);
                let is_edge = step > STEP_GREY && 100 * u16::from(step) > STEP_PERCENT * sum;
                *free = if is_edge { !known } else { u8::MAX };
            }
        }
    }
}
