//! Foreground mask -> blobs: opening, closing, run-based labels, fixed tables.
//!
//! In: bit mask. Out: runs with labels, blobs with box and area. Owns: masks, run and blob
//! tables. Limits: `limits.runs_max`, `limits.blobs_max`; what does not fit is counted.

use crate::config::{Limits, Segment as Settings};
use crate::error::Result;
use crate::kernel::scalar::bits::{self, dilate, erode, words};
use crate::kernel::scalar::runs::{Run, collect, resolve};
use crate::plan::{Block, Memory, Plan};

/// A blob with less of its area far from the background is a stain or a reflection.
const STRONG_SHARE_MIN: f64 = 0.3;

/// A connected piece of foreground, in belt view pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Blob {
    /// Label of its runs.
    pub label: u32,
    /// Pixels.
    pub area_px: u32,
    /// Pixels far from the background: stains on the belt have few.
    pub strong_px: u32,
    /// Bounding box.
    pub bounds: PxBox,
}

/// A box of pixels, ends included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PxBox {
    /// First column.
    pub u0: f32,
    /// Last column.
    pub u1: f32,
    /// First row.
    pub v0: f32,
    /// Last row.
    pub v1: f32,
}

impl Default for PxBox {
    /// The empty box: including a point gives that point.
    fn default() -> Self {
        Self { u0: f32::INFINITY, u1: f32::NEG_INFINITY, v0: f32::INFINITY, v1: f32::NEG_INFINITY }
    }
}

impl PxBox {
    /// Area of the overlap, counting end pixels whole.
    pub fn overlap(&self, other: &Self) -> f32 {
        let side = |a0: f32, a1: f32, b0: f32, b1: f32| (a1.min(b1) - a0.max(b0) + 1.0).max(0.0);
        side(self.u0, self.u1, other.u0, other.u1) * side(self.v0, self.v1, other.v0, other.v1)
    }

    /// Area.
    pub fn area(&self) -> f32 {
        self.overlap(self)
    }

    /// Smallest box that holds both.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        Self {
            u0: self.u0.min(other.u0),
            u1: self.u1.max(other.u1),
            v0: self.v0.min(other.v0),
            v1: self.v1.max(other.v1),
        }
    }

    /// Moved along the belt by between `least` and `most` px: the box of all of these.
    #[must_use]
    pub fn swept(&self, least: f32, most: f32) -> Self {
        Self { u0: self.u0 + least.min(most), u1: self.u1 + most.max(least), ..*self }
    }
}

/// The segmentation stage.
pub struct Segment {
    size_px: [usize; 2],
    settings: Settings,
    area_min_px: u32,
    mask: Block<u64>,
    scratch: Block<u64>,
    runs: Block<Run>,
    run_count: usize,
    blobs: Block<Blob>,
    blob_count: usize,
    /// Frames in which the run or blob table was too small.
    pub overflows: u64,
}

impl Segment {
    /// Memory for a view.
    pub fn plan([width, height]: [usize; 2], limits: &Limits, plan: &mut Plan) {
        plan.add::<u64>("segment.mask", words(width) * height, "mask after opening and closing");
        plan.add::<u64>("segment.scratch", words(width) * height, "the other half of each filter");
        plan.add::<Run>("segment.runs", limits.runs_max, "limits.runs_max");
        plan.add::<Blob>("segment.blobs", limits.blobs_max, "limits.blobs_max");
    }

    /// Empty tables.
    pub fn new(
        size_px: [usize; 2],
        mm_per_px: f64,
        settings: Settings,
        memory: &mut Memory,
    ) -> Result<Self> {
        let area_min_px = (settings.area_min_mm2 / (mm_per_px * mm_per_px)).ceil() as u32;
        Ok(Self {
            size_px,
            settings,
            area_min_px,
            mask: memory.take("segment.mask", 0)?,
            scratch: memory.take("segment.scratch", 0)?,
            runs: memory.take("segment.runs", Run::default())?,
            run_count: 0,
            blobs: memory.take("segment.blobs", Blob::default())?,
            blob_count: 0,
            overflows: 0,
        })
    }

    /// Segment one mask; `strong` is its part that is beyond doubt.
    pub fn step(&mut self, foreground: &[u64], strong: &[u64]) {
        self.mask.copy_from_slice(foreground);
        let (open, close) = (self.settings.open_px, self.settings.close_px);
        let width = self.size_px[0];
        erode(&mut self.mask, &mut self.scratch, width, open);
        dilate(&mut self.mask, &mut self.scratch, width, open + close);
        erode(&mut self.mask, &mut self.scratch, width, close);
        let found = collect(&self.mask, self.size_px[0], &mut self.runs);
        self.run_count = found.min(self.runs.len());
        let labels = resolve(&mut self.runs[..self.run_count]);
        self.gather_blobs(labels, strong);
        if found > self.runs.len() || labels > self.blobs.len() {
            self.overflows += 1;
        }
    }

    fn gather_blobs(&mut self, labels: usize, strong: &[u64]) {
        let count = labels.min(self.blobs.len());
        let blobs = &mut self.blobs[..count];
        for (label, blob) in blobs.iter_mut().enumerate() {
            *blob = Blob { label: label as u32, ..Blob::default() };
        }
        for run in &self.runs[..self.run_count] {
            let Some(blob) = blobs.get_mut(run.label as usize) else { continue };
            let (v, u0, u1) = (f32::from(run.v), f32::from(run.start), f32::from(run.end) - 1.0);
            blob.area_px += u32::from(run.end - run.start);
            let row = &strong[usize::from(run.v) * words(self.size_px[0])..];
            blob.strong_px += bits::count(row, run.start, run.end);
            blob.bounds = blob.bounds.union(&PxBox { u0, u1, v0: v, v1: v });
        }
        let mut kept = 0;
        for i in 0..count {
            let beyond_doubt =
                f64::from(blobs[i].strong_px) >= STRONG_SHARE_MIN * f64::from(blobs[i].area_px);
            if blobs[i].area_px >= self.area_min_px && beyond_doubt {
                blobs[kept] = blobs[i];
                kept += 1;
            }
        }
        self.blob_count = kept;
    }

    /// Blobs of at least the smallest area.
    pub fn blobs(&self) -> &[Blob] {
        &self.blobs[..self.blob_count]
    }

    /// Bit mask after opening and closing.
    pub fn mask(&self) -> &[u64] {
        &self.mask
    }

    /// All runs, row by row.
    pub fn runs(&self) -> &[Run] {
        &self.runs[..self.run_count]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_overlap_where_they_share_pixels() {
        let a = PxBox { u0: 0.0, u1: 9.0, v0: 0.0, v1: 9.0 };
        let b = PxBox { u0: 9.0, u1: 12.0, v0: 5.0, v1: 20.0 };
        let whole = |area: f32| area.round() as u32;
        assert_eq!((whole(a.area()), whole(a.overlap(&b)), whole(b.overlap(&a))), (100, 5, 5));
        assert!(a.overlap(&a.swept(20.0, 20.0)) < 0.5);
        assert_eq!(a.union(&PxBox::default()), a);
    }
}
