//! Neighbouring cells that tell one thing: what a parcel's face begins with, and what no face explains.

use super::face::Face;
use super::scroll::{HEIGHT_MIN_MM, Scroll, place_of};
use std::cmp::Reverse;

/// Trial planes are this far apart, mm.
const PLANE_STEP_MM: f32 = 3.0;
/// A cell belongs to a plane that is this near, mm.
const TOLERANCE_MM: f32 = 6.0;
/// Cells of one beginning are at most this far apart, cells.
const GAP: usize = 2;
/// Columns behind a group that must be decided before it is whole.
const WAIT_COLUMNS: usize = 8;
/// A smaller group this near to a larger one that is not whole waits for it, cells.
const BESIDE_CELLS: usize = 6;
/// A smaller group is an accident, mm^2: an edge of no length spreads cells over 32 mm either way, and half of them
/// may tell nothing.
const AREA_MIN_MM2: f64 = 512.0;
/// Cells so near to a face are its own, whatever they tell, mm: an edge spreads them by four.
const HALO_MM: f64 = 25.0;
/// Groups of which the largest is chosen; of more the smallest are left out.
const GROUPS_MAX: usize = 256;

/// Where a group is, and how high.
#[derive(Clone, Copy, Debug)]
pub struct Group {
    /// Its cells.
    pub cells: usize,
    /// Lowest and highest X less the belt's travel, and Y, of their middles, mm.
    pub around_mm: [[f64; 2]; 2],
    /// Their median.
    pub inside_mm: [f64; 2],
    /// Median height, mm.
    pub height_mm: f64,
}

/// A group in the making.
struct Found {
    cells: usize,
    /// One of its cells, and the plane that it lies on, from which it is found again.
    start: usize,
    plane: usize,
    extent: Extent,
}

/// First and last column and row.
#[derive(Clone, Copy)]
struct Extent([usize; 4]);

impl Extent {
    fn is_beside(&self, other: &Self) -> bool {
        let ([a, b, c, d], [e, f, g, h]) = (self.0, other.0);
        e <= b + BESIDE_CELLS
            && a <= f + BESIDE_CELLS
            && g <= d + BESIDE_CELLS
            && c <= h + BESIDE_CELLS
    }
}

/// Keep a group, in place of the smallest one when there is no room.
fn keep(groups: &mut heapless::Vec<Found, GROUPS_MAX>, group: Found) {
    if let Err(group) = groups.push(group)
        && let Some(smallest) = groups.iter_mut().min_by_key(|group| group.cells)
        && group.cells > smallest.cells
    {
        *smallest = group;
    }
}

impl Scroll {
    /// Look at the largest group of neighbouring free cells of one height that is whole (of all, once the belt has
    /// `ended`). What lies beside a larger group that is not whole waits for that one.
    pub fn look_at_beginning(&mut self, ended: bool) -> Option<Group> {
        let mut found = self.groups();
        found.sort_unstable_by_key(|group| (Reverse(group.cells), group.plane, group.start));
        let mut waiting: heapless::Vec<Extent, GROUPS_MAX> = heapless::Vec::new();
        let chosen = found.iter().find(|group| {
            let is_beside = waiting.iter().any(|other| group.extent.is_beside(other));
            let waits = is_beside || !(ended || self.is_whole(&group.extent));
            if waits {
                // As many as there are groups.
                let _ = waiting.push(group.extent);
            }
            !waits
        })?;
        self.mark_plane(chosen.plane);
        self.connect(chosen.start, GAP);
        Some(self.group())
    }

    /// All groups of free cells of one height.
    fn groups(&mut self) -> heapless::Vec<Found, GROUPS_MAX> {
        let mut usable = 0;
        for i in 0..self.len() {
            if self.free[i] && self.is_raised(i) {
                self.usable[usable] = i as u32;
                usable += 1;
            }
        }
        let count = self.len();
        self.here[..count].fill(false);
        let planes = ((self.height_max_mm - HEIGHT_MIN_MM) / PLANE_STEP_MM) as usize;
        let mut found = heapless::Vec::new();
        for plane in 0..planes {
            for k in 0..usable {
                let i = self.usable[k] as usize;
                self.here[i] = self.is_on(plane, i);
            }
            for k in 0..usable {
                let start = self.usable[k] as usize;
                if self.here[start] {
                    self.connect(start, GAP);
                    if self.member_count >= self.cells_min() {
                        let (cells, extent) = (self.member_count, self.extent());
                        keep(&mut found, Found { cells, start, plane, extent });
                    }
                }
            }
        }
        found
    }

    fn mark_plane(&mut self, plane: usize) {
        for i in 0..self.len() {
            self.here[i] = self.free[i] && self.is_raised(i) && self.is_on(plane, i);
        }
    }

    fn is_on(&self, plane: usize, i: usize) -> bool {
        let height_mm = HEIGHT_MIN_MM + 1.0 + PLANE_STEP_MM * plane as f32;
        (self.cells[i].height_mm - height_mm).abs() <= TOLERANCE_MM
    }

    /// Look at a piece of raised cells that none of the `faces` explains and that has passed `end_mm`, X less the
    /// belt's travel.
    pub fn look_at_left_over<'a>(
        &mut self,
        faces: &(impl Iterator<Item = &'a Face> + Clone),
        end_mm: f64,
    ) -> Option<Group> {
        for i in 0..self.len() {
            let [x_mm, y_mm] = self.place_mm(i);
            let near = |face: &Face| face.rectangle.outside_mm(x_mm, y_mm) < HALO_MM;
            self.here[i] = self.open[i] && self.is_raised(i) && !faces.clone().any(near);
        }
        for start in 0..self.len() {
            if !self.here[start] {
                continue;
            }
            self.connect(start, 1);
            let extent = self.extent();
            let Extent([_, last, ..]) = extent;
            let is_whole = end_mm == f64::NEG_INFINITY || self.is_whole(&extent);
            let has_passed = self.place_mm(last * self.rows())[0] > end_mm;
            if is_whole && has_passed && self.member_count >= self.cells_min() {
                return Some(self.group());
            }
        }
        None
    }

    /// Cells of the smallest group that begins something.
    fn cells_min(&self) -> usize {
        (AREA_MIN_MM2 / (self.side_mm() * self.side_mm())).ceil() as usize
    }

    /// Whether a group is whole: none of it reaches the newest columns.
    fn is_whole(&self, &Extent([_, last, ..]): &Extent) -> bool {
        last + WAIT_COLUMNS < self.columns
    }

    /// What is looked at, as a group.
    fn group(&mut self) -> Group {
        let count = self.member_count;
        let mut around_mm = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for i in self.members() {
            for ([low, high], mm) in around_mm.iter_mut().zip(self.place_mm(i)) {
                (*low, *high) = (low.min(mm), high.max(mm));
            }
        }
        let inside_mm = [0, 1].map(|k| {
            for j in 0..count {
                self.scratch[j] = self.place_mm(self.members[j] as usize)[k];
            }
            place_of(&mut self.scratch[..count], 0.5)
        });
        let height_mm = self.height_of(0.5, |_| true);
        Group { cells: count, around_mm, inside_mm, height_mm }
    }

    fn extent(&self) -> Extent {
        let all = self.members().fold([usize::MAX, 0, usize::MAX, 0], |[a, b, c, d], i| {
            let (column, row) = (i / self.rows(), i % self.rows());
            [a.min(column), b.max(column), c.min(row), d.max(row)]
        });
        Extent(all)
    }

    /// Look at the marked cells that are connected to one, with gaps of less than `gap` cells; their marks go.
    fn connect(&mut self, start: usize, gap: usize) {
        self.members[0] = start as u32;
        self.member_count = 1;
        self.here[start] = false;
        let mut next = 0;
        while next < self.member_count {
            let i = self.members[next] as usize;
            let (column, row) = (i / self.rows(), i % self.rows());
            next += 1;
            for c in column.saturating_sub(gap)..=(column + gap).min(self.columns - 1) {
                for r in row.saturating_sub(gap)..=(row + gap).min(self.rows() - 1) {
                    let i = c * self.rows() + r;
                    if self.here[i] {
                        self.here[i] = false;
                        self.members[self.member_count] = i as u32;
                        self.member_count += 1;
                    }
                }
            }
        }
    }
}
