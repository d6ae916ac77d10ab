//! The part of the scroll that is not decided yet: its cells, and which of them are still to be explained.

use super::enclosing::smallest_rectangle;
use super::face::Face;
use super::rectangle::Rectangle;
use crate::error::Result;
use crate::plan::{Block, Memory, Plan};
use crate::stage::evidence::{Cell, Evidence};

/// Lower than this is the belt, mm: cells of the belt scatter by 1 mm.
pub const HEIGHT_MIN_MM: f32 = 2.4;
/// A cell whose possible heights span more than this, mm, tells none.
const NARROW_MM: f32 = 40.0;

/// Where the cells are.
#[derive(Clone, Copy)]
struct Grid {
    /// Number of the first column.
    first: i64,
    rows: usize,
    cell_mm: f64,
    row_0_mm: f64,
}

impl Grid {
    /// X less travel, and Y, of a cell's middle, mm.
    fn place_mm(&self, i: usize) -> [f64; 2] {
        let column = self.first + (i / self.rows) as i64;
        [-(column as f64) * self.cell_mm, self.row_0_mm - (i % self.rows) as f64 * self.cell_mm]
    }
}

/// The cells.
pub struct Scroll {
    grid: Grid,
    /// Columns known.
    pub(super) columns: usize,
    pub(super) height_max_mm: f32,
    pub(super) cells: Block<Cell>,
    /// Whether a cell may begin something.
    pub(super) free: Block<bool>,
    /// Whether it may be part of something that has no face.
    pub(super) open: Block<bool>,
    /// Numbers of the cells that are looked at.
    pub(super) members: Block<u32>,
    pub(super) member_count: usize,
    /// Marks and numbers of cells while groups are sought.
    pub(super) here: Block<bool>,
    pub(super) usable: Block<u32>,
    /// Values of some cells, to find their median.
    pub(super) scratch: Block<f64>,
}

impl Scroll {
    /// Memory for a scroll of so many cells.
    pub fn plan(cells: usize, plan: &mut Plan) {
        plan.add::<Cell>("scroll.cells", cells, "cells that are not decided yet");
        plan.add::<bool>("scroll.free", cells, "whether each may begin something");
        plan.add::<bool>("scroll.open", cells, "whether each may be part of what has no face");
        plan.add::<u32>("scroll.members", cells, "cells of the group that is looked at");
        plan.add::<bool>("scroll.here", cells, "marks while groups are sought");
        plan.add::<u32>("scroll.usable", cells, "cells that may be in a group");
        plan.add::<f64>("scroll.scratch", cells, "values whose median is sought");
    }

    /// Nothing seen.
    pub fn new(evidence: &Evidence, height_max_mm: f64, memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            grid: Grid {
                first: 0,
                rows: evidence.rows(),
                cell_mm: evidence.side_mm(),
                row_0_mm: evidence.row_mm(0),
            },
            columns: 0,
            height_max_mm: height_max_mm as f32,
            cells: memory.take("scroll.cells", Cell::default())?,
            free: memory.take("scroll.free", false)?,
            open: memory.take("scroll.open", false)?,
            members: memory.take("scroll.members", 0)?,
            member_count: 0,
            here: memory.take("scroll.here", false)?,
            usable: memory.take("scroll.usable", 0)?,
            scratch: memory.take("scroll.scratch", 0.0)?,
        })
    }

    /// Columns decided since the last time, less what `faces` own; old ones go.
    pub fn take_columns<'a>(&mut self, evidence: &Evidence, faces: impl Iterator<Item = &'a Face>) {
        let decided = evidence.decided();
        if self.columns == 0 {
            self.grid.first = decided.start;
        }
        if decided.start > self.grid.first {
            let gone = ((decided.start - self.grid.first) as usize).min(self.columns);
            let kept = gone * self.rows()..self.columns * self.rows();
            self.cells.copy_within(kept.clone(), 0);
            self.free.copy_within(kept.clone(), 0);
            self.open.copy_within(kept, 0);
            self.columns -= gone;
            self.grid.first = decided.start;
        }
        let fresh = self.len();
        let columns_max = self.cells.len() / self.rows();
        for column in self.grid.first + self.columns as i64..decided.end {
            if self.columns == columns_max {
                break;
            }
            let here = self.len()..self.len() + self.rows();
            let cells = evidence.column(column);
            self.cells[here.clone()].copy_from_slice(cells);
            let free = self.free[here.clone()].iter_mut().zip(cells);
            free.for_each(|(free, cell)| *free = tells(cell));
            self.open[here].fill(true);
            self.columns += 1;
        }
        for face in faces {
            self.claim_from(fresh, face);
        }
    }

    /// Another belt begins: its columns may have the numbers of these.
    pub fn forget(&mut self) {
        self.columns = 0;
    }

    /// Cells known.
    pub fn len(&self) -> usize {
        self.columns * self.rows()
    }

    /// X less travel of the first column's middle, mm.
    pub fn first_mm(&self) -> f64 {
        -(self.grid.first as f64) * self.grid.cell_mm
    }

    /// Side of a cell, mm.
    pub fn side_mm(&self) -> f64 {
        self.grid.cell_mm
    }

    /// Cells of a column.
    pub fn rows(&self) -> usize {
        self.grid.rows
    }

    /// X less travel, and Y, of a cell's middle, mm.
    pub fn place_mm(&self, i: usize) -> [f64; 2] {
        self.grid.place_mm(i)
    }

    /// Height of a cell, mm.
    pub fn height_mm(&self, i: usize) -> f64 {
        f64::from(self.cells[i].height_mm)
    }

    /// Whether a cell tells that something is over the belt.
    pub fn is_raised(&self, i: usize) -> bool {
        tells(&self.cells[i]) && self.cells[i].possible_mm[1] < self.height_max_mm
    }

    /// The cells that are looked at.
    pub fn members(&self) -> impl Iterator<Item = usize> + Clone {
        self.members[..self.member_count].iter().map(|&i| i as usize)
    }

    /// Look at the raised cells within a rectangle.
    pub fn look_within(&mut self, rectangle: &Rectangle) {
        self.member_count = 0;
        for i in 0..self.len() {
            let [x_mm, y_mm] = self.place_mm(i);
            if self.is_raised(i) && rectangle.outside_mm(x_mm, y_mm) < 0.0 {
                self.members[self.member_count] = i as u32;
                self.member_count += 1;
            }
        }
    }

    /// The height of those looked at that a share of them does not exceed, of those at places that `are_meant` (X less
    /// travel, Y, mm); 0 if there are none.
    pub fn height_of(&mut self, share: f64, are_meant: impl Fn([f64; 2]) -> bool) -> f64 {
        let mut count = 0;
        for k in 0..self.member_count {
            let i = self.members[k] as usize;
            if are_meant(self.place_mm(i)) {
                self.scratch[count] = self.height_mm(i);
                count += 1;
            }
        }
        place_of(&mut self.scratch[..count], share)
    }

    /// The rectangle of the smallest area around those looked at.
    pub fn smallest_rectangle(&mut self) -> Rectangle {
        let grid = self.grid;
        let members = self.members[..self.member_count].iter();
        let places = members.map(move |&i| grid.place_mm(i as usize));
        smallest_rectangle(&places, &mut self.scratch)
    }

    /// Those looked at begin nothing any more.
    pub fn take(&mut self) {
        for &i in &self.members[..self.member_count] {
            self.free[i as usize] = false;
        }
    }

    /// Those looked at are no part of anything without a face.
    pub fn settle(&mut self) {
        for &i in &self.members[..self.member_count] {
            self.open[i as usize] = false;
        }
    }

    /// The cells of a face begin nothing any more.
    pub fn claim(&mut self, face: &Face) {
        self.claim_from(0, face);
    }

    fn claim_from(&mut self, first: usize, face: &Face) {
        for i in first..self.len() {
            self.free[i] &= !face.owns(&self.cells[i], self.place_mm(i));
        }
    }
}

/// Whether a cell tells a height over the belt.
fn tells(cell: &Cell) -> bool {
    cell.strength > 0.0
        && cell.height_mm > HEIGHT_MIN_MM
        && cell.possible_mm[1] - cell.possible_mm[0] < NARROW_MM
}

/// The value below which a share of them lies; 0 if there are none.
pub fn place_of(values: &mut [f64], share: f64) -> f64 {
    let place = (share * values.len() as f64) as usize;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(place.min(values.len() - 1), f64::total_cmp).1
}
