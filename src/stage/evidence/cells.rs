//! Cells of a few mm: a view's fine structure, without light, shadow and what stands still.
//!
//! In: a belt view. Out: a small picture, column by column, of the logarithm of the grey values
//! without its slow part: a shadow is a factor there, and drops out. What stays where it is while the
//! belt moves (rails, dirt on the lens) is learned and taken out.

use crate::camera::BeltView;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::Level;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::box_filter::REACH;
use crate::kernel::simd::box_filter::box_filter;
use crate::plan::{Block, Memory, Plan};
use crate::stage::views::VIEWS_MAX;

/// Side of a cell, about.
const CELL_MM: f64 = 3.5;
/// Added to grey values, so that noise in the dark does not become structure.
pub(in crate::stage) const DARK_GREY: f32 = 6.0;
/// Units of a cell's value for a factor of e.
const UNITS: f32 = 160.0;
/// How fast what stands still is learned, a view: its median.
const STILL_STEP: f32 = 0.012;

/// The cells of the views kept.
pub struct Cells {
    /// Pixels of a cell.
    pub cell_px: usize,
    /// Cells along and across the view.
    pub size: [usize; 2],
    level: Level,
    /// Whether the camera sees a cell with its surroundings: 0 or 1.
    seen: Block<u8>,
    /// Logarithms of the mean, by the sum of a cell's grey values.
    log_of_sum: Block<f32>,
    log: Block<f32>,
    slow: Block<f32>,
    scratch: Block<f32>,
    still: Block<f32>,
    values: Block<i8>,
}

/// Pixels of a cell's side.
pub fn cell_px(view: &BeltView) -> usize {
    (CELL_MM / view.mm_per_px).round().max(1.0) as usize
}

/// Cells across a view.
pub fn rows(view: &BeltView) -> usize {
    size_of(view).1[1]
}

fn size_of(view: &BeltView) -> (usize, [usize; 2]) {
    let cell_px = cell_px(view);
    (cell_px, view.size_px.map(|n| n / cell_px))
}

impl Cells {
    /// Memory for a view.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let (cell_px, [columns, rows]) = size_of(view);
        let n = columns * rows;
        plan.add::<u8>("evidence.seen_cells", n, "cells that the camera sees with all around");
        plan.add::<f32>("evidence.log_of_sum", 255 * cell_px * cell_px + 1, "logarithms");
        plan.add::<f32>("evidence.log", n, "logarithm of a view's cells");
        plan.add::<f32>("evidence.slow", n, "its slow part");
        plan.add::<f32>("evidence.scratch", n, "the other half of each smoothing");
        plan.add::<f32>("evidence.still", n, "what does not move with the belt");
        plan.add::<i8>("evidence.cells", n * VIEWS_MAX, "fine structure of each view kept");
    }

    /// Nothing seen yet. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(view: &BeltView, level: Level, seen: &[u64], memory: &mut Memory) -> Result<Self> {
        let (cell_px, size) = size_of(view);
        let [columns, rows] = size;
        let n = words(view.size_px[0]);
        let is_seen = |u: usize, v: usize| bits::get(&seen[v * n..][..n], u);
        let whole = |column: usize, row: usize| {
            let (u, v) = (column * cell_px, row * cell_px);
            let last = cell_px - 1;
            is_seen(u, v)
                && is_seen(u + last, v)
                && is_seen(u, v + last)
                && is_seen(u + last, v + last)
        };
        let mut seen_cells = memory.take("evidence.seen_cells", 0)?;
        let reach = 2 * REACH;
        for column in reach..columns.saturating_sub(reach) {
            for row in reach..rows.saturating_sub(reach) {
                let all = [column - reach, column + reach]
                    .into_iter()
                    .all(|c| [row - reach, row + reach].into_iter().all(|r| whole(c, r)));
                seen_cells[column * rows + row] = u8::from(all);
            }
        }
        let mut log_of_sum = memory.take("evidence.log_of_sum", 0.0)?;
        let share = 1.0 / (cell_px * cell_px) as f32;
        for (sum, log) in log_of_sum.iter_mut().enumerate() {
            *log = (sum as f32 * share + DARK_GREY).ln();
        }
        Ok(Self {
            cell_px,
            size,
            level,
            seen: seen_cells,
            log_of_sum,
            log: memory.take("evidence.log", 0.0)?,
            slow: memory.take("evidence.slow", 0.0)?,
            scratch: memory.take("evidence.scratch", 0.0)?,
            still: memory.take("evidence.still", 0.0)?,
            values: memory.take("evidence.cells", 0)?,
        })
    }

    /// Take the fine structure of the view at `place`.
    pub fn add(&mut self, grey: Plane<'_>, place: usize) {
        let [columns, rows] = self.size;
        for row in 0..rows {
            for column in 0..columns {
                let mut sum = 0;
                for v in row * self.cell_px..(row + 1) * self.cell_px {
                    let pixels = &grey.row(v)[column * self.cell_px..][..self.cell_px];
                    sum += pixels.iter().map(|&p| usize::from(p)).sum::<usize>();
                }
                self.log[column * rows + row] = self.log_of_sum[sum];
            }
        }
        self.slow.copy_from_slice(&self.log);
        for _ in 0..2 {
            box_filter(self.level, &mut self.slow, &mut self.scratch, rows);
        }
        let values = &mut self.values[place * columns * rows..][..columns * rows];
        let fine = self.log.iter().zip(&*self.slow).map(|(log, slow)| log - slow);
        let cells = values.iter_mut().zip(&mut *self.still).zip(&*self.seen).zip(fine);
        for (((value, still), _), fine) in cells.filter(|((_, seen), _)| **seen > 0) {
            *still += (fine - *still).clamp(-STILL_STEP, STILL_STEP);
            *value = ((fine - *still) * UNITS).round().clamp(-127.0, 127.0) as i8;
        }
    }

    /// The fine structure of the view at `place`: columns one after the other, 0 where it is not seen.
    pub fn view(&self, place: usize) -> &[i8] {
        let n = self.size[0] * self.size[1];
        &self.values[place * n..][..n]
    }

    /// Which cells every view sees: 0 or 1.
    pub fn seen(&self) -> &[u8] {
        &self.seen
    }
}
