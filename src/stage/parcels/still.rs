//! What stands still while the belt moves: rails, frames, dirt on the lens.
//!
//! In: the views kept. Out: a mask of the view's pixels without an edge of the still scene. Such an edge
//! is at the same place in every view, so that along the travel it would look as if it rode along.
//! The still scene is the running median of each pixel over the views: what passes is soon forgotten.

use crate::camera::BeltView;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::bits::{stride, words};
use crate::plan::{Block, Memory, Plan};

/// A step of the still scene between neighbours but one, as a share of its grey values ...
const STEP_SHARE: f32 = 0.06;
/// ... and in grey levels: noise is none.
const STEP_GREY: f32 = 4.0;

/// The still scene.
pub struct Still {
    size_px: [usize; 2],
    median: Block<u8>,
    known: bool,
    usable: Block<u64>,
}

impl Still {
    /// Memory for a view.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let [width, height] = view.size_px;
        plan.add::<u8>("still.median", stride(width) * height, "what stands still");
        plan.add::<u64>("still.usable", words(width) * height, "pixels without its edges");
    }

    /// Nothing seen.
    pub fn new(view: &BeltView, memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            size_px: view.size_px,
            median: memory.take("still.median", 0)?,
            known: false,
            usable: memory.take("still.usable", 0)?,
        })
    }

    /// Pixels that the camera sees and that have no edge of the still scene, as bits.
    pub fn usable(&self) -> &[u64] {
        &self.usable
    }

    /// A view more. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn add(&mut self, grey: Plane<'_>, seen: &[u64]) {
        let [width, height] = self.size_px;
        for v in 0..height {
            let median = &mut self.median[v * stride(width)..][..width];
            for (median, &grey) in median.iter_mut().zip(grey.row(v)) {
                let step = i16::from(grey).cmp(&i16::from(*median)) as i8;
                *median = if self.known { median.saturating_add_signed(step) } else { grey };
            }
        }
        self.known = true;
        self.usable.copy_from_slice(seen);
        let n = words(width);
        let at = |u: usize, v: usize| f32::from(self.median[v * stride(width) + u]);
        for v in 1..height - 1 {
            for u in 1..width - 1 {
                // Only edges along the travel stay where they are on the belt, too.
                let (above, below) = (at(u, v - 1), at(u, v + 1));
                if (above - below).abs() > STEP_GREY.max(STEP_SHARE * (above + below)) {
                    self.usable[v * n + u / 64] &= !(1 << (u % 64));
                }
            }
        }
    }
}
