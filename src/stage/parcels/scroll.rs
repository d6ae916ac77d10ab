//! The part of the scroll that is not decided yet: its cells, and which of them are still to be explained.

use super::face::{Face, STEP_MM};
use super::place_of;
use super::rectangle::Rectangle;
use crate::stage::evidence::{Cell, Evidence};

/// Trial planes are this far apart, mm.
const PLANE_STEP_MM: f32 = 3.0;
/// A cell belongs to a plane that is this near, mm.
const TOLERANCE_MM: f32 = 6.0;
/// Lower than this is the belt, mm: cells of the belt scatter by 1 mm.
pub const HEIGHT_MIN_MM: f32 = 2.4;
/// A cell within this is the belt's, mm.
const BELT_MM: f32 = 1.2;
/// A cell whose possible heights span more than this, mm, tells none.
const NARROW_MM: f32 = 40.0;
/// Cells of one beginning are at most this far apart, cells.
const GAP: i32 = 2;
/// Columns behind a group that must be decided before it is whole.
const WAIT_COLUMNS: usize = 8;
/// A smaller group this near to a larger one that is not whole waits for it, cells.
const BESIDE_CELLS: usize = 6;
/// A group of fewer cells is an accident.
pub const CELLS_MIN: usize = 12;
/// Cells so far inside of a border are its own, mm.
const BORDER_MM: f64 = 10.0;
/// Cells so near to a face are its own, whatever they tell, mm: an edge spreads them by four.
const HALO_MM: f64 = 25.0;
/// A thing is as high as this share of its cells: a few scatter.
pub const HIGHEST_SHARE: f64 = 0.95;
/// At a top face's border this share of the cells tells its height.
const BORDER_LEVEL_MIN: f64 = 0.2;
/// On a parcel at most this many cells for one that is raised lie on the belt.
const BELT_SHARE_MAX: f64 = 0.3;
/// What has no top face is full of raised cells: this share.
const RAISED_SHARE_MIN: f64 = 0.5;

/// The cells.
pub struct Scroll {
    /// Number of the first column.
    first: i64,
    cells: Vec<Cell>,
    /// Whether a cell may begin something.
    free: Vec<bool>,
    rows: usize,
    cell_mm: f64,
    row_0_mm: f64,
    height_max_mm: f32,
}

/// What the cells within a border tell: shares of them.
pub struct Content {
    on_belt: f64,
    raised: f64,
    /// At the border's height: of all, and of those along the border.
    level: f64,
    border_level: f64,
    /// Beyond it.
    higher: f64,
    /// What nearly none of the raised ones exceeds, mm.
    pub highest_mm: f64,
}

impl Content {
    /// Whether the belt shows within.
    pub fn is_belt(&self) -> bool {
        self.on_belt >= BELT_SHARE_MAX * self.raised
    }

    /// Whether this is what the cells of a top face tell.
    pub fn is_top(&self) -> bool {
        self.border_level > BORDER_LEVEL_MIN && self.higher <= self.level && !self.is_belt()
    }

    /// Whether this is what the cells of a thing tell whose border is not at its top.
    pub fn is_heap(&self) -> bool {
        self.raised > RAISED_SHARE_MIN && self.higher > self.level && !self.is_belt()
    }
}

impl Scroll {
    /// Nothing seen.
    pub fn new(evidence: &Evidence, height_max_mm: f64) -> Self {
        Self {
            first: 0,
            cells: Vec::new(),
            free: Vec::new(),
            rows: evidence.rows(),
            cell_mm: evidence.side_mm(),
            row_0_mm: evidence.row_mm(0),
            height_max_mm: height_max_mm as f32,
        }
    }

    /// Columns decided since the last time, less what `faces` own; old ones go.
    pub fn take_columns<'a>(&mut self, evidence: &Evidence, faces: impl Iterator<Item = &'a Face>) {
        let decided = evidence.decided();
        if decided.start > self.first {
            let gone = ((decided.start - self.first) as usize * self.rows).min(self.cells.len());
            self.cells.drain(..gone);
            self.free.drain(..gone);
            self.first = decided.start;
        }
        let known = self.first + (self.cells.len() / self.rows) as i64;
        for column in known..decided.end {
            self.cells.extend(evidence.column(column));
            self.free.extend(evidence.column(column).iter().map(tells));
        }
        let fresh = (known - self.first).max(0) as usize * self.rows;
        for face in faces {
            for i in fresh..self.cells.len() {
                self.free[i] &= !face.owns(&self.cells[i], self.place_mm(i));
            }
        }
    }

    /// X less travel of the first column's middle, mm.
    pub fn first_mm(&self) -> f64 {
        -(self.first as f64) * self.cell_mm
    }

    /// Side of a cell, mm.
    pub fn side_mm(&self) -> f64 {
        self.cell_mm
    }

    /// X less travel, Y and height of a cell, mm.
    pub fn cell_mm(&self, i: usize) -> [f64; 3] {
        let [x_mm, y_mm] = self.place_mm(i);
        [x_mm, y_mm, self.height_mm(i)]
    }

    /// Raised cells within a rectangle.
    pub fn raised_within(&self, rectangle: &Rectangle) -> Vec<[f64; 3]> {
        let is_within = |i: &usize| {
            let [x_mm, y_mm] = self.place_mm(*i);
            self.is_raised(*i) && rectangle.outside_mm(x_mm, y_mm) < 0.0
        };
        (0..self.cells.len()).filter(is_within).map(|i| self.cell_mm(i)).collect()
    }

    /// X less travel, and Y, of a cell's middle, mm.
    pub fn place_mm(&self, i: usize) -> [f64; 2] {
        let column = self.first + (i / self.rows) as i64;
        [-(column as f64) * self.cell_mm, self.row_0_mm - (i % self.rows) as f64 * self.cell_mm]
    }

    /// Height of a cell, mm.
    fn height_mm(&self, i: usize) -> f64 {
        f64::from(self.cells[i].height_mm)
    }

    /// Those of some cells that may still begin something.
    pub fn free_of(&self, mut members: Vec<usize>) -> Vec<usize> {
        members.retain(|&i| self.free[i]);
        members
    }

    /// Cells begin nothing any more.
    pub fn take(&mut self, members: &[usize]) {
        for &i in members {
            self.free[i] = false;
        }
    }

    /// The cells of a face begin nothing any more.
    pub fn claim(&mut self, face: &Face) {
        for i in 0..self.cells.len() {
            self.free[i] &= !face.owns(&self.cells[i], self.place_mm(i));
        }
    }

    /// Whether a cell tells that something is over the belt.
    fn is_raised(&self, i: usize) -> bool {
        tells(&self.cells[i]) && self.cells[i].possible_mm[1] < self.height_max_mm
    }

    /// Whether a group is whole: none of it reaches the newest columns.
    fn is_whole(&self, members: &[usize]) -> bool {
        let columns = self.cells.len() / self.rows;
        members.iter().all(|i| i / self.rows + WAIT_COLUMNS < columns)
    }

    /// Groups of neighbouring free cells of one height that are whole (all, once the belt has `ended`), and their
    /// heights, largest first. What lies beside a larger group waits for that one.
    pub fn beginnings(&self, ended: bool) -> Vec<(Vec<usize>, f64)> {
        let usable = |i: &usize| self.free[*i] && self.is_raised(*i);
        let free: Vec<usize> = (0..self.cells.len()).filter(usable).collect();
        let count = ((self.height_max_mm - HEIGHT_MIN_MM) / PLANE_STEP_MM) as usize;
        let mut groups: Vec<Vec<usize>> = Vec::new();
        let mut here = vec![false; self.cells.len()];
        for k in 0..count {
            let height_mm = HEIGHT_MIN_MM + 1.0 + PLANE_STEP_MM * k as f32;
            for &i in &free {
                here[i] = (self.cells[i].height_mm - height_mm).abs() <= TOLERANCE_MM;
            }
            for &start in &free {
                if here[start] {
                    let members = self.connected(start, GAP, &mut here);
                    if members.len() >= CELLS_MIN {
                        groups.push(members);
                    }
                }
            }
        }
        groups.sort_by_key(|members| std::cmp::Reverse(members.len()));
        let mut waiting: Vec<[usize; 4]> = Vec::new();
        let mut whole = Vec::new();
        for members in groups {
            let here = self.extent(&members);
            let is_beside = waiting.iter().any(|other| is_beside(&here, other));
            if is_beside || !(ended || self.is_whole(&members)) {
                waiting.push(here);
                continue;
            }
            let mut heights_mm: Vec<f64> = members.iter().map(|&i| self.height_mm(i)).collect();
            let height_mm = place_of(&mut heights_mm, 0.5);
            whole.push((members, height_mm));
        }
        whole
    }

    /// First and last column and row of cells.
    fn extent(&self, members: &[usize]) -> [usize; 4] {
        members.iter().fold([usize::MAX, 0, usize::MAX, 0], |[a, b, c, d], i| {
            let (column, row) = (i / self.rows, i % self.rows);
            [a.min(column), b.max(column), c.min(row), d.max(row)]
        })
    }

    /// Cells connected to one, with gaps of less than `gap` cells, taken out of `here`.
    fn connected(&self, start: usize, gap: i32, here: &mut [bool]) -> Vec<usize> {
        let columns = (self.cells.len() / self.rows) as i32;
        let mut members = vec![start];
        here[start] = false;
        let mut next = 0;
        while next < members.len() {
            let (column, row) =
                ((members[next] / self.rows) as i32, (members[next] % self.rows) as i32);
            next += 1;
            for c in (column - gap).max(0)..=(column + gap).min(columns - 1) {
                for r in (row - gap).max(0)..=(row + gap).min(self.rows as i32 - 1) {
                    let i = c as usize * self.rows + r as usize;
                    if here[i] {
                        here[i] = false;
                        members.push(i);
                    }
                }
            }
        }
        members
    }

    /// Pieces of raised cells that none of the `faces` explains and that have passed `end_mm`, X less the belt's travel.
    pub fn left_over<'a>(
        &self,
        faces: &(impl Iterator<Item = &'a Face> + Clone),
        end_mm: f64,
    ) -> Vec<Vec<usize>> {
        let is_left = |i: usize| {
            let [x_mm, y_mm] = self.place_mm(i);
            let near = |face: &Face| face.rectangle.outside_mm(x_mm, y_mm) < HALO_MM;
            self.is_raised(i) && !faces.clone().any(near)
        };
        let mut here: Vec<bool> = (0..self.cells.len()).map(is_left).collect();
        let mut pieces = Vec::new();
        for start in 0..self.cells.len() {
            if !here[start] {
                continue;
            }
            let members = self.connected(start, 1, &mut here);
            let trailing = members.iter().copied().max().unwrap_or(start);
            let is_whole = end_mm == f64::NEG_INFINITY || self.is_whole(&[trailing]);
            if is_whole && self.place_mm(trailing)[0] > end_mm && members.len() >= CELLS_MIN {
                pieces.push(members);
            }
        }
        pieces
    }

    /// What the cells within a face's border tell.
    pub fn content(&self, face: &Face) -> Content {
        let [mut all, mut on_belt, mut level, mut higher] = [0usize; 4];
        let [mut border, mut border_level] = [0usize; 2];
        let mut raised_mm = Vec::new();
        for i in 0..self.cells.len() {
            let [x_mm, y_mm] = self.place_mm(i);
            let outside_mm = face.rectangle.outside_mm(x_mm, y_mm);
            if outside_mm > 0.0 {
                continue;
            }
            let at_border = outside_mm > -BORDER_MM;
            all += 1;
            border += usize::from(at_border);
            let cell = &self.cells[i];
            if self.is_raised(i) {
                let height_mm = f64::from(cell.height_mm);
                let is_level = (height_mm - face.height_mm).abs() <= STEP_MM;
                raised_mm.push(height_mm);
                level += usize::from(is_level);
                border_level += usize::from(is_level && at_border);
                higher += usize::from(height_mm > face.height_mm + STEP_MM);
            } else {
                on_belt += usize::from(cell.strength > 0.0 && cell.height_mm.abs() <= BELT_MM);
            }
        }
        let share = |count: usize, of: usize| count as f64 / of.max(1) as f64;
        Content {
            on_belt: share(on_belt, all),
            raised: share(raised_mm.len(), all),
            level: share(level, all),
            border_level: share(border_level, border),
            higher: share(higher, all),
            highest_mm: place_of(&mut raised_mm, HIGHEST_SHARE),
        }
    }
}

/// Whether a cell tells a height over the belt.
fn tells(cell: &Cell) -> bool {
    cell.strength > 0.0
        && cell.height_mm > HEIGHT_MIN_MM
        && cell.possible_mm[1] - cell.possible_mm[0] < NARROW_MM
}

/// Whether two extents are near each other.
fn is_beside(one: &[usize; 4], other: &[usize; 4]) -> bool {
    other[0] <= one[1] + BESIDE_CELLS
        && one[0] <= other[1] + BESIDE_CELLS
        && other[2] <= one[3] + BESIDE_CELLS
        && one[2] <= other[3] + BESIDE_CELLS
}
