//! Cells of a few mm: a view's fine structure, without light, shadow and what stands still.
//!
//! In: a belt view. Out: a small picture, column by column, of the logarithm of the grey values
//! without its slow part: a shadow is a factor there, and drops out. What stays where it is while the
//! belt moves (rails, dirt on the lens) is learned and taken out.

use crate::camera::BeltView;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::box_filter::{REACH, box_filter};
use crate::plan::{Block, Memory, Plan};
use crate::stage::views::VIEWS_MAX;

/// Side of a cell, about.
const CELL_MM: f64 = 3.5;
/// Added to grey values, so that noise in the dark does not become structure.
pub(in crate::stage) const DARK_GREY: f32 = 6.0;
/// Units of a cell's value for a factor of e.
const UNITS: f32 = 160.0;
/// A cell that the camera does not see.
pub const UNSEEN: i8 = i8::MIN;
/// How fast what stands still is learned, a view: its median.
const STILL_STEP: f32 = 0.012;

/// The cells of the views kept.
pub struct Cells {
    /// Pixels of a cell.
    pub cell_px: usize,
    /// Cells along and across the view.
    pub size: [usize; 2],
    usable: Block<bool>,
    log: Block<f32>,
    slow: Block<f32>,
    still: Block<f32>,
    values: Block<i8>,
}

/// Pixels of a cell's side.
pub fn cell_px(view: &BeltView) -> usize {
    (CELL_MM / view.mm_per_px).round().max(1.0) as usize
}

fn size_of(view: &BeltView) -> (usize, [usize; 2]) {
    let cell_px = cell_px(view);
    (cell_px, view.size_px.map(|n| n / cell_px))
}

impl Cells {
    /// Memory for a view.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let (_, [columns, rows]) = size_of(view);
        let n = columns * rows;
        plan.add::<bool>(
            "evidence.usable",
            n,
            "cells that the camera sees with their surroundings",
        );
        plan.add::<f32>("evidence.log", n, "logarithm of a view's cells");
        plan.add::<f32>("evidence.slow", n, "its slow part");
        plan.add::<f32>("evidence.still", n, "what does not move with the belt");
        plan.add::<i8>("evidence.cells", n * VIEWS_MAX, "fine structure of each view kept");
    }

    /// Nothing seen yet. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(view: &BeltView, seen: &[u64], memory: &mut Memory) -> Result<Self> {
        let (cell_px, size) = size_of(view);
        let [columns, rows] = size;
        let mut usable = memory.take("evidence.usable", false)?;
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
        let reach = 2 * REACH;
        for column in reach..columns.saturating_sub(reach) {
            for row in reach..rows.saturating_sub(reach) {
                usable[column * rows + row] = [column - reach, column + reach]
                    .into_iter()
                    .all(|c| [row - reach, row + reach].into_iter().all(|r| whole(c, r)));
            }
        }
        Ok(Self {
            cell_px,
            size,
            usable,
            log: memory.take("evidence.log", 0.0)?,
            slow: memory.take("evidence.slow", 0.0)?,
            still: memory.take("evidence.still", 0.0)?,
            values: memory.take("evidence.cells", UNSEEN)?,
        })
    }

    /// Take the fine structure of the view at `place`.
    pub fn add(&mut self, grey: Plane<'_>, place: usize) {
        let [columns, rows] = self.size;
        let scale = 1.0 / (self.cell_px * self.cell_px) as f32;
        for row in 0..rows {
            for column in 0..columns {
                let mut sum = 0u32;
                for v in row * self.cell_px..(row + 1) * self.cell_px {
                    let pixels = &grey.row(v)[column * self.cell_px..][..self.cell_px];
                    sum += pixels.iter().map(|&p| u32::from(p)).sum::<u32>();
                }
                self.log[column * rows + row] = (sum as f32 * scale + DARK_GREY).ln();
            }
        }
        self.slow.copy_from_slice(&self.log);
        for _ in 0..2 {
            for column in self.slow.chunks_exact_mut(rows) {
                box_filter(column, 1, rows);
            }
            for row in 0..rows {
                box_filter(&mut self.slow[row..], rows, columns);
            }
        }
        let values = &mut self.values[place * columns * rows..][..columns * rows];
        let fine = self.log.iter().zip(&*self.slow).map(|(log, slow)| log - slow);
        let cells = values.iter_mut().zip(&mut *self.still).zip(&*self.usable).zip(fine);
        for (((value, still), _), fine) in cells.filter(|((_, usable), _)| **usable) {
            *still += (fine - *still).clamp(-STILL_STEP, STILL_STEP);
            *value = ((fine - *still) * UNITS).round().clamp(-127.0, 127.0) as i8;
        }
    }

    /// The fine structure of the view at `place`: columns one after the other.
    pub fn view(&self, place: usize) -> &[i8] {
        let n = self.size[0] * self.size[1];
        &self.values[place * n..][..n]
    }
}
