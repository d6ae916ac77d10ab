//! Foreground mask -> blobs: opening, closing, run-based labels, fixed tables.
//!
//! Neighbours are told apart by what is bright: the gap between them is belt in shadow, or a dark
//! side, which the mask holds and which the closing would fill.
//!
//! In: bit mask. Out: runs with labels, blobs with box and area. Owns: masks, run and blob
//! tables. Limits: `limits.runs_max`, `limits.blobs_max`; what does not fit is counted.

use crate::config::{Limits, Segment as Settings};
use crate::error::Result;
use crate::kernel::bands;
use crate::kernel::scalar::bits::{self, Square, words};
use crate::kernel::scalar::runs::{Run, collect, resolve};
use crate::plan::{Block, Memory, Plan};

/// A blob with less of its area far from the background is a stain or a reflection.
const STRONG_SHARE_MIN: f64 = 0.3;
/// A bright piece is a parcel of its own, not a label or a stripe, from this share of its blob on ...
const PIECE_SHARE_MIN: f64 = 0.08;
/// ... when such pieces leave no more of the blob than gaps, shadows and dark sides.
const PIECES_SHARE_MIN: f64 = 0.6;

/// A connected piece of foreground, in belt view pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Blob {
    /// Label of its runs.
    pub label: u32,
    /// Pixels.
    pub area_px: u32,
    /// Pixels far from the background: stains on the belt have few.
    pub strong_px: u32,
    /// Pixels that cannot be a shadow.
    pub bright_px: u32,
    /// Bounding box.
    pub bounds: PxBox,
    /// Of a bright piece: label of the blob that it is part of.
    pub whole: u32,
    /// Of a blob: its bright pieces that may be parcels ...
    pub pieces: u32,
    /// ... and their pixels.
    pub pieces_px: u32,
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
    bands: usize,
    settings: Settings,
    area_min_px: u32,
    mask: Block<u64>,
    bright: Block<u64>,
    scratch: [Block<u64>; 2],
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
        plan.add::<u64>("segment.bright", words(width) * height, "foreground without dark parts");
        for scratch in ["segment.scratch", "segment.scratch_bright"] {
            plan.add::<u64>(scratch, words(width) * height, "the other half of each filter");
        }
        plan.add::<Run>("segment.runs", limits.runs_max, "limits.runs_max");
        plan.add::<Blob>("segment.blobs", limits.blobs_max, "limits.blobs_max");
    }

    /// Empty tables.
    pub fn new(
        size_px: [usize; 2],
        mm_per_px: f64,
        settings: Settings,
        bands: usize,
        memory: &mut Memory,
    ) -> Result<Self> {
        let area_min_px = (settings.area_min_mm2 / (mm_per_px * mm_per_px)).ceil() as u32;
        Ok(Self {
            size_px,
            bands,
            settings,
            area_min_px,
            mask: memory.take("segment.mask", 0)?,
            bright: memory.take("segment.bright", 0)?,
            scratch: [
                memory.take("segment.scratch", 0)?,
                memory.take("segment.scratch_bright", 0)?,
            ],
            runs: memory.take("segment.runs", Run::default())?,
            run_count: 0,
            blobs: memory.take("segment.blobs", Blob::default())?,
            blob_count: 0,
            overflows: 0,
        })
    }

    /// Segment one mask; `strong` is its part that is beyond doubt, `dark` what may be shadow.
    pub fn step(&mut self, foreground: &[u64], strong: &[u64], dark: &[u64]) {
        let (open, close) = (self.settings.open_px, self.settings.close_px);
        let width = self.size_px[0];
        let Self { bright, mask, scratch: [scratch, scratch_bright], .. } = self;
        // Side by side: a filter alone is too short to be worth the call of another thread.
        let square = |radius: usize| Square { width, radius, bands: self.bands.div_ceil(2) };
        bands::join(
            self.bands,
            || {
                mask.copy_from_slice(foreground);
                square(open).erode(mask, scratch);
                square(open + close).dilate(mask, scratch);
                square(close).erode(mask, scratch);
            },
            || {
                for ((bright, all), dark) in bright.iter_mut().zip(foreground).zip(dark) {
                    *bright = all & !dark;
                }
                square(open).erode(bright, scratch_bright);
                square(open).dilate(bright, scratch_bright);
            },
        );
        let found = collect(&self.mask, width, &mut self.runs);
        self.run_count = found.min(self.runs.len());
        let (runs, rest) = self.runs.split_at_mut(self.run_count);
        let labels = resolve(runs);
        // Pieces follow in the same tables, their labels after those of the blobs.
        let pieces_found = collect(&self.bright, width, rest);
        let piece_runs = pieces_found.min(rest.len());
        let piece_labels = resolve(&mut rest[..piece_runs]);
        for run in &mut rest[..piece_runs] {
            run.label += labels as u32;
        }
        self.gather_blobs(labels, piece_runs, labels + piece_labels, strong);
        if found + pieces_found > self.runs.len() || labels + piece_labels > self.blobs.len() {
            self.overflows += 1;
        }
    }

    /// Blobs and their bright pieces; a blob of several pieces is replaced by them: parcels
    /// side by side, joined by the shadow in the gap or by the closing.
    fn gather_blobs(&mut self, wholes: usize, piece_runs: usize, labels: usize, strong: &[u64]) {
        let n = words(self.size_px[0]);
        let count = labels.min(self.blobs.len());
        let wholes = wholes.min(count);
        let blobs = &mut self.blobs[..count];
        for (label, blob) in blobs.iter_mut().enumerate() {
            *blob = Blob { label: label as u32, ..Blob::default() };
        }
        let (runs, pieces) = self.runs[..self.run_count + piece_runs].split_at(self.run_count);
        for run in runs.iter().chain(pieces) {
            let Some(blob) = blobs.get_mut(run.label as usize) else { continue };
            let (v, u0, u1) = (f32::from(run.v), f32::from(run.start), f32::from(run.end) - 1.0);
            let row = usize::from(run.v) * n;
            blob.area_px += u32::from(run.end - run.start);
            blob.strong_px += bits::count(&strong[row..], run.start, run.end);
            blob.bright_px += bits::count(&self.bright[row..], run.start, run.end);
            blob.bounds = blob.bounds.union(&PxBox { u0, u1, v0: v, v1: v });
        }
        // Runs of both are in the order of rows: a piece's lies in the last one before it.
        let mut at = 0;
        for run in pieces {
            let from = (run.v, run.start);
            while runs.get(at + 1).is_some_and(|next| (next.v, next.start) <= from) {
                at += 1;
            }
            if let Some(piece) = blobs.get_mut(run.label as usize) {
                piece.whole = runs.get(at).map_or(u32::MAX, |r| r.label);
            }
        }
        self.replace_by_pieces(wholes, count);
        let blobs = &mut self.blobs[..count];
        let mut kept = 0;
        for i in 0..count {
            let beyond_doubt =
                f64::from(blobs[i].strong_px) >= STRONG_SHARE_MIN * f64::from(blobs[i].area_px);
            if blobs[i].area_px >= self.area_min_px && beyond_doubt {
                blobs[kept] = blobs[i];
                kept += 1;
            }
        }
        self.run_count += piece_runs;
        self.blob_count = kept;
    }

    /// Where several bright pieces make up a blob, take its area from it; elsewhere, from them.
    fn replace_by_pieces(&mut self, wholes: usize, count: usize) {
        let area_min_px = self.area_min_px;
        let is_piece = |piece: &Blob, whole: &Blob| {
            piece.area_px >= area_min_px
                && f64::from(piece.area_px) >= PIECE_SHARE_MIN * f64::from(whole.area_px)
        };
        let splits = |whole: &Blob| {
            whole.pieces >= 2
                && f64::from(whole.pieces_px) >= PIECES_SHARE_MIN * f64::from(whole.area_px)
        };
        let (whole_blobs, piece_blobs) = self.blobs[..count].split_at_mut(wholes);
        for piece in piece_blobs.iter() {
            let whole = whole_blobs.get_mut(piece.whole as usize);
            if let Some(whole) = whole.filter(|whole| is_piece(piece, whole)) {
                whole.pieces += 1;
                whole.pieces_px += piece.area_px;
            }
        }
        for piece in piece_blobs {
            let whole = whole_blobs.get(piece.whole as usize);
            if !whole.is_some_and(|whole| splits(whole) && is_piece(piece, whole)) {
                piece.area_px = 0;
            }
        }
        for whole in whole_blobs.iter_mut().filter(|whole| splits(whole)) {
            whole.area_px = 0;
        }
    }

    /// Blobs of at least the smallest area.
    pub fn blobs(&self) -> &[Blob] {
        &self.blobs[..self.blob_count]
    }

    /// Bit mask after opening and closing.
    pub fn mask(&self) -> &[u64] {
        &self.mask
    }

    /// All runs: those of the blobs, row by row, then those of the bright pieces.
    pub fn runs(&self) -> &[Run] {
        &self.runs[..self.run_count]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Blobs of a 64 pixel wide mask: `#` bright, `s` dark.
    fn blobs(rows: &[&str]) -> Vec<Blob> {
        let size_px = [64, rows.len()];
        let mut plan = Plan::default();
        Segment::plan(size_px, &Limits::default(), &mut plan);
        let mut memory = plan.reserve(8).expect("small");
        let settings = Settings { area_min_mm2: 4.0, ..Settings::default() };
        let mut segment = Segment::new(size_px, 1.0, settings, 1, &mut memory).expect("planned");
        let mask = |of: &str| -> Vec<u64> {
            let bit = |(u, c): (usize, char)| u64::from(of.contains(c)) << u;
            rows.iter().map(|row| row.char_indices().map(bit).sum()).collect()
        };
        segment.step(&mask("#s"), &mask("#s"), &mask("s"));
        segment.blobs().to_vec()
    }

    #[test]
    fn two_bright_pieces_joined_by_a_shadow_are_two_blobs() {
        let found = blobs(&["  #########ss#########"; 4]);
        let columns: Vec<[u32; 2]> =
            found.iter().map(|b| [b.bounds.u0 as u32, b.bounds.u1 as u32]).collect();
        assert_eq!(columns, [[2, 10], [13, 21]]);
    }

    #[test]
    fn a_label_on_a_dark_parcel_and_a_shadow_beside_a_bright_one_split_nothing() {
        for row in ["  ssssssssssssss###ss####", "  ##################ssssss"] {
            assert_eq!(blobs(&[row; 4]).len(), 1, "{row}");
        }
    }

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
