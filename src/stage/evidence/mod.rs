//! Height by known motion, cell by cell, without any segmentation.
//!
//! In: the views of a pass. Out: the scroll, belt-fixed cells of a few mm, each with the height at
//! which the views agree. In belt-fixed coordinates everything that rides stands still; projected on to the
//! plane z = h, what lies at height h is the same in all views, and everything else smears. Semblance
//! is the share of energy that adds up, `(sum w)^2 / (n sum w^2)`: 1 where all views agree, 1/n where
//! none do. A column of cells is decided when it has passed the zone.
//! Source: semblance, Neidell and Taner 1971; plane sweep, Collins 1996.

mod cells;

use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::Level;
use crate::kernel::scalar::semblance::{self, CELL_ONE, CellSums, Columns, FRACTION_ONE};
use crate::kernel::simd::semblance::add_cells;
use crate::plan::{Block, Memory, Plan};
use crate::stage::views::Views;
use crate::units::BeltRect;
use cells::Cells;

pub(super) use cells::DARK_GREY;

/// Trial planes of a pass over the zone are so far apart that their images part by this many cells
/// there: an eighth of the coarsest structure.
const PLANE_STEP_CELLS: f64 = 1.5;
/// Trial planes at most.
const PLANES_MAX: usize = 80;
/// The belt itself: one plane is below it.
const BELT_PLANE: usize = 1;
/// Columns whose sums are kept: the smoothing reaches two to either side.
const COLUMNS_KEPT: usize = 5;
/// Smoothing over neighbouring cells.
const SMOOTH: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
/// A cell seen in less than this share of the views of a whole pass tells nothing.
const VIEWS_SHARE_MIN: f32 = 0.4;
/// Fewer views than this agree by accident.
const VIEWS_MIN: f32 = 7.0;
/// Views agree on a height from this semblance on.
const SEMBLANCE_MIN: f32 = 0.4;
/// Structure below this, in units of a cell's value, is noise.
const STRENGTH_MIN: f32 = 2.85;
/// Heights whose semblance is this near to the best are possible too.
const POSSIBLE_SHARE: f32 = 0.85;
/// A column is decided when this share of the zone is still before it: what follows a parcel's label must
/// be known when the parcel leaves.
const AHEAD_SHARE: f64 = 0.35;

/// A cell of the scroll.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cell {
    /// The height at which the views agree.
    pub height_mm: f32,
    /// Heights that are possible too.
    pub possible_mm: [f32; 2],
    /// Structure there, in units of a cell's value; 0: nothing agrees.
    pub strength: f32,
    /// Semblance.
    pub semblance: f32,
}

/// The stage.
pub struct Evidence {
    geometry: BeltView,
    zone: BeltRect,
    cells: Cells,
    level: Level,
    cell_mm: f64,
    rows: usize,
    /// Heights of the trial planes, mm, rising, and their magnifications.
    planes: Block<[f64; 2]>,
    /// Sums over the views of one column, by plane and row of the views' cells.
    sum: Block<i16>,
    squares: Block<i32>,
    views: Block<i16>,
    /// Of the last columns: squared sum, and views times squares; by plane and row.
    sums: Block<[f32; 2]>,
    smooth: Block<[f32; 2]>,
    scroll: Block<Cell>,
    columns_max: usize,
    /// Views at the belt's plane, by kept column and row.
    views_seen: Block<f32>,
    /// Views of each kept column's whole pass.
    views_whole: [f32; COLUMNS_KEPT],
    /// The first column ever.
    first: i64,
    /// The next column to be summed up.
    next: Option<i64>,
    breaks: u32,
}

fn planes_of(view: &BeltView, zone: &BeltRect, height_max_mm: f64, cell_mm: f64) -> (usize, f64) {
    let step = PLANE_STEP_CELLS * cell_mm / zone.length_mm();
    let most = view.magnification(height_max_mm) - 1.0;
    let count = (most / step).ceil() as usize + 3;
    if count <= PLANES_MAX { (count, step) } else { (PLANES_MAX, most / (PLANES_MAX - 3) as f64) }
}

struct Sizes {
    rows: usize,
    view_rows: usize,
    planes: usize,
    columns: usize,
}

impl Evidence {
    fn cell_mm(view: &BeltView) -> f64 {
        cells::cell_px(view) as f64 * view.mm_per_px
    }

    fn sizes(view: &BeltView, zone: &BeltRect, height_max_mm: f64) -> Sizes {
        let cell_mm = Self::cell_mm(view);
        let rows = ((zone.y_max_mm - zone.y_min_mm) / cell_mm).ceil() as usize;
        let (planes, _) = planes_of(view, zone, height_max_mm, cell_mm);
        let columns = (2.0 * zone.length_mm() / cell_mm).ceil() as usize;
        Sizes { rows, view_rows: cells::rows(view), planes, columns }
    }

    /// Cells of the whole scroll.
    pub fn cells_max(view: &BeltView, zone: &BeltRect, height_max_mm: f64) -> usize {
        let Sizes { rows, columns, .. } = Self::sizes(view, zone, height_max_mm);
        rows * columns
    }

    /// Memory for a site.
    pub fn plan(view: &BeltView, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Cells::plan(view, plan);
        let Sizes { rows, view_rows, planes, columns } = Self::sizes(view, zone, height_max_mm);
        let n = rows * planes;
        plan.add::<[f64; 2]>("evidence.planes", planes, "height and magnification of each plane");
        plan.add::<i16>("evidence.sum", view_rows * planes, "a column's sum at each plane");
        plan.add::<i32>("evidence.squares", view_rows * planes, "its sum of squares");
        plan.add::<i16>("evidence.views", view_rows * planes, "its views");
        plan.add::<[f32; 2]>("evidence.sums", n * COLUMNS_KEPT, "energies of the last columns");
        plan.add::<[f32; 2]>("evidence.smooth", n, "energies, smoothed");
        plan.add::<f32>("evidence.views_seen", rows * COLUMNS_KEPT, "views of each cell");
        plan.add::<Cell>("evidence.scroll", rows * columns, "heights over two zones of belt");
    }

    /// Nothing seen. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        height_max_mm: f64,
        level: Level,
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        let Sizes { rows, columns, .. } = Self::sizes(view, zone, height_max_mm);
        let cell_mm = Self::cell_mm(view);
        let cells = Cells::new(view, level, seen, memory)?;
        let mut planes = memory.take("evidence.planes", [0.0; 2])?;
        let (_, step) = planes_of(view, zone, height_max_mm, cell_mm);
        for (k, plane) in planes.iter_mut().enumerate() {
            let magnification = 1.0 + step * (k as f64 - BELT_PLANE as f64);
            *plane = [view.camera_height_mm * (1.0 - 1.0 / magnification), magnification];
        }
        Ok(Self {
            geometry: view.clone(),
            zone: *zone,
            cells,
            cell_mm,
            rows,
            planes,
            level,
            sum: memory.take("evidence.sum", 0)?,
            squares: memory.take("evidence.squares", 0)?,
            views: memory.take("evidence.views", 0)?,
            sums: memory.take("evidence.sums", [0.0; 2])?,
            smooth: memory.take("evidence.smooth", [0.0; 2])?,
            views_seen: memory.take("evidence.views_seen", 0.0)?,
            views_whole: [0.0; COLUMNS_KEPT],
            first: 0,
            scroll: memory.take("evidence.scroll", Cell::default())?,
            columns_max: columns,
            next: None,
            breaks: 0,
        })
    }

    /// Side of a cell, mm.
    pub fn side_mm(&self) -> f64 {
        self.cell_mm
    }

    /// Rows of the scroll; row 0 is at the zone's left side seen along travel.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Belt-fixed place of a column's middle: X less the belt's travel, mm.
    pub fn column_mm(&self, column: i64) -> f64 {
        -(column as f64) * self.cell_mm
    }

    /// Y of a row's middle, mm.
    pub fn row_mm(&self, row: usize) -> f64 {
        self.zone.y_max_mm - (row as f64 + 0.5) * self.cell_mm
    }

    /// The cells of a decided column.
    pub fn column(&self, column: i64) -> &[Cell] {
        let place = column.rem_euclid(self.columns_max as i64) as usize;
        &self.scroll[place * self.rows..][..self.rows]
    }

    /// Columns that are decided and still kept: the oldest, and one past the newest.
    pub fn decided(&self) -> std::ops::Range<i64> {
        let Some(next) = self.next else { return 0..0 };
        let end = next - 2;
        (end - self.columns_max as i64 + 8).max(self.first)..end.max(self.first)
    }

    /// A view more.
    pub fn add(&mut self, views: &Views, place: usize) {
        self.cells.add(views.grey(place), place);
    }

    /// Decide what has passed most of the zone by now.
    pub fn advance(&mut self, views: &Views, travel_mm: f64, breaks: u32) {
        let end_mm = self.zone.x_max_mm - AHEAD_SHARE * self.zone.length_mm();
        let passed = self.last_behind(end_mm, travel_mm);
        if self.next.is_none() || breaks != self.breaks {
            self.breaks = breaks;
            self.next = Some(passed);
            self.first = passed;
            return;
        }
        self.decide_until(passed, views);
    }

    /// No more views come: decide what was seen at all.
    pub fn finish(&mut self, views: &Views) {
        let Some(place) = views.newest() else { return };
        let seen = self.last_behind(self.zone.x_min_mm, views.kept(place).at.travel_mm);
        self.decide_until(seen, views);
    }

    /// The last column whose middle is behind an X.
    fn last_behind(&self, x_mm: f64, travel_mm: f64) -> i64 {
        ((travel_mm - x_mm) / self.cell_mm).floor() as i64
    }

    fn decide_until(&mut self, last: i64, views: &Views) {
        while let Some(next) = self.next.filter(|&next| next <= last) {
            self.sum_up(views, next);
            self.decide(next - 2);
            self.next = Some(next + 1);
        }
    }

    fn sum_up(&mut self, views: &Views, column: i64) {
        self.sum.fill(0);
        self.squares.fill(0);
        self.views.fill(0);
        let mut whole = 0;
        for place in views.places().take(semblance::VIEWS_MAX) {
            let x_mm = self.column_mm(column) + views.kept(place).at.travel_mm;
            if x_mm < self.zone.x_min_mm {
                break;
            }
            whole += 1;
            self.add_view(place, x_mm);
        }
        let kept = column.rem_euclid(COLUMNS_KEPT as i64) as usize;
        self.views_whole[kept] = whole as f32;
        for plane in 0..self.planes.len() {
            self.take_energies(plane, kept);
        }
    }

    /// Add a view's cells at `x_mm`, for every plane.
    fn add_view(&mut self, place: usize, x_mm: f64) {
        let [columns, rows] = self.cells.size;
        let (values, seen) = (self.cells.view(place), self.cells.seen());
        let [first_mm, side_mm] = [self.first_cell_mm()[0], self.view_cell_mm()];
        let nadir_mm = self.geometry.nadir.x;
        for (plane, &[_, m]) in self.planes.iter().enumerate() {
            let u = (nadir_mm + m * (x_mm - nadir_mm) - first_mm) / side_mm;
            if u < 0.0 || u >= (columns - 1) as f64 {
                continue;
            }
            let left = u as usize * rows;
            let columns = Columns {
                values: [&values[left..][..rows], &values[left + rows..][..rows]],
                seen: [&seen[left..][..rows], &seen[left + rows..][..rows]],
                fraction: (u.fract() * f64::from(FRACTION_ONE)).round() as i16,
            };
            let here = plane * rows..(plane + 1) * rows;
            let mut sums = CellSums {
                sum: &mut self.sum[here.clone()],
                squares: &mut self.squares[here.clone()],
                views: &mut self.views[here],
            };
            add_cells(self.level, columns, &mut sums);
        }
    }

    /// Energies of a plane, from the rows of the views' cells to the scroll's.
    fn take_energies(&mut self, plane: usize, kept: usize) {
        let (view_rows, m) = (self.cells.size[1], self.planes[plane][1]);
        let here = plane * view_rows..(plane + 1) * view_rows;
        let (sum, squares) = (&self.sum[here.clone()], &self.squares[here.clone()]);
        let views = &self.views[here];
        let [_, first_mm] = self.first_cell_mm();
        let side_mm = self.view_cell_mm();
        let nadir_mm = self.geometry.nadir.y;
        let n = self.planes.len() * self.rows;
        for row in 0..self.rows {
            let v = (first_mm - (nadir_mm + m * (self.row_mm(row) - nadir_mm))) / side_mm;
            let inside = v >= 0.0 && v < (view_rows - 1) as f64;
            let (j, share) = if inside { (v as usize, v.fract() as f32) } else { (0, 0.0) };
            let energies = [j, j + 1].map(|j| {
                let [sum, squares] = [f32::from(sum[j]), squares[j] as f32];
                [sum * sum, f32::from(views[j]) * squares]
            });
            let between = |k: usize| energies[0][k] + share * (energies[1][k] - energies[0][k]);
            let energy = if inside { [between(0), between(1)] } else { [0.0; 2] };
            self.sums[kept * n + plane * self.rows + row] = energy;
            // Seen at the belt's plane is seen.
            if plane == BELT_PLANE {
                let seen = if inside { views[j].min(views[j + 1]) } else { 0 };
                self.views_seen[kept * self.rows + row] = f32::from(seen);
            }
        }
    }

    /// Middle of the view's first cell, mm.
    fn first_cell_mm(&self) -> [f64; 2] {
        let middle_mm = 0.5 * (self.cells.cell_px as f64 - 1.0) * self.geometry.mm_per_px;
        [self.geometry.origin.x + middle_mm, self.geometry.origin.y - middle_mm]
    }

    /// Side of the views' cells, mm.
    fn view_cell_mm(&self) -> f64 {
        self.cells.cell_px as f64 * self.geometry.mm_per_px
    }

    fn decide(&mut self, column: i64) {
        if column < self.first {
            return;
        }
        let (rows, planes) = (self.rows, self.planes.len());
        let n = planes * rows;
        for i in 0..n {
            let mut all = [0.0f32; 2];
            for (d, weight) in (-2..=2).zip(SMOOTH) {
                let kept = (column + d).max(self.first).rem_euclid(COLUMNS_KEPT as i64) as usize;
                let from = self.sums[kept * n + i];
                all[0] += weight * from[0];
                all[1] += weight * from[1];
            }
            self.smooth[i] = all;
        }
        for k in 0..planes {
            let line = &mut self.smooth[k * rows..][..rows];
            smooth_line(line);
        }
        let kept = column.rem_euclid(COLUMNS_KEPT as i64) as usize;
        let place = column.rem_euclid(self.columns_max as i64) as usize;
        let views_min = (VIEWS_SHARE_MIN * self.views_whole[kept]).max(VIEWS_MIN);
        for row in 0..rows {
            let seen = self.views_seen[kept * rows + row];
            let out = &mut self.scroll[place * rows + row];
            *out = Cell::default();
            if seen < views_min {
                continue;
            }
            let semblance = |k: usize| {
                let [p, q] = self.smooth[k * rows + row];
                p / (q + 1e-6)
            };
            let Some(best) = (0..planes).max_by(|&a, &b| semblance(a).total_cmp(&semblance(b)))
            else {
                continue;
            };
            let s = semblance(best);
            let sum = self.smooth[best * rows + row][0].sqrt() / f32::from(CELL_ONE);
            let strength = sum / seen;
            if s < SEMBLANCE_MIN || strength < STRENGTH_MIN || best == 0 || best + 1 == planes {
                continue;
            }
            let possible = |k: &usize| semblance(*k) > POSSIBLE_SHARE * s;
            let low = (0..best).rev().take_while(possible).last().unwrap_or(best);
            let high = (best + 1..planes).take_while(possible).last().unwrap_or(best);
            let (before, after) = (semblance(best - 1), semblance(best + 1));
            let offset = 0.5 * (before - after) / (before - 2.0 * s + after).min(-1e-9);
            let m = self.planes[best][1]
                + f64::from(offset.clamp(-0.5, 0.5)) * (self.planes[1][1] - self.planes[0][1]);
            *out = Cell {
                height_mm: (self.geometry.camera_height_mm * (1.0 - 1.0 / m)) as f32,
                possible_mm: [self.planes[low][0] as f32, self.planes[high][0] as f32],
                strength,
                semblance: s,
            };
        }
    }
}

fn smooth_line(line: &mut [[f32; 2]]) {
    let rows = line.len();
    let mut window = [line[0]; 5];
    window[3] = line[1.min(rows - 1)];
    window[4] = line[2.min(rows - 1)];
    for row in 0..rows {
        let mut all = [0.0f32; 2];
        for (value, weight) in window.iter().zip(SMOOTH) {
            all[0] += weight * value[0];
            all[1] += weight * value[1];
        }
        window.rotate_left(1);
        window[4] = line[(row + 3).min(rows - 1)];
        line[row] = all;
    }
}
