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
use crate::plan::{Block, Memory, Plan};
use crate::stage::views::Views;
use crate::units::BeltRect;
use cells::{Cells, UNSEEN};

pub(super) use cells::DARK_GREY;

/// Trial planes of a pass over the zone are so far apart that their images part by this many cells
/// there: an eighth of the coarsest structure.
const PLANE_STEP_CELLS: f64 = 1.5;
/// Trial planes at most.
const PLANES_MAX: usize = 80;
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
const STRENGTH_MIN: f32 = 2.5;
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
    cell_mm: f64,
    rows: usize,
    /// Heights of the trial planes, mm, rising, and their magnifications.
    planes: Block<[f64; 2]>,
    sum: Block<f32>,
    squares: Block<f32>,
    seen: Block<f32>,
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
        Sizes { rows, planes, columns }
    }

    /// Memory for a site.
    pub fn plan(view: &BeltView, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Cells::plan(view, plan);
        let Sizes { rows, planes, columns } = Self::sizes(view, zone, height_max_mm);
        let n = rows * planes;
        plan.add::<[f64; 2]>("evidence.planes", planes, "height and magnification of each plane");
        plan.add::<f32>("evidence.sum", n, "a column's sum at each plane");
        plan.add::<f32>("evidence.squares", n, "its sum of squares");
        plan.add::<f32>("evidence.seen", n, "its views");
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
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        let Sizes { rows, columns, .. } = Self::sizes(view, zone, height_max_mm);
        let cell_mm = Self::cell_mm(view);
        let cells = Cells::new(view, seen, memory)?;
        let mut planes = memory.take("evidence.planes", [0.0; 2])?;
        let (_, step) = planes_of(view, zone, height_max_mm, cell_mm);
        for (k, plane) in planes.iter_mut().enumerate() {
            let magnification = 1.0 + step * (k as f64 - 1.0);
            *plane = [view.camera_height_mm * (1.0 - 1.0 / magnification), magnification];
        }
        Ok(Self {
            geometry: view.clone(),
            zone: *zone,
            cells,
            cell_mm,
            rows,
            planes,
            sum: memory.take("evidence.sum", 0.0)?,
            squares: memory.take("evidence.squares", 0.0)?,
            seen: memory.take("evidence.seen", 0.0)?,
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

    /// Decide what has passed the zone by now.
    pub fn advance(&mut self, views: &Views, travel_mm: f64, breaks: u32) {
        // The last column whose middle has passed the end of the zone.
        let end_mm = self.zone.x_max_mm - AHEAD_SHARE * self.zone.length_mm();
        let passed = ((travel_mm - end_mm) / self.cell_mm).floor() as i64;
        if self.next.is_none() || breaks != self.breaks {
            self.breaks = breaks;
            self.next = Some(passed);
            self.first = passed;
            return;
        }
        while let Some(next) = self.next.filter(|&next| next <= passed) {
            self.sum_up(views, next);
            self.decide(next - 2);
            self.next = Some(next + 1);
        }
    }

    fn sum_up(&mut self, views: &Views, column: i64) {
        let (rows, size) = (self.rows, self.cells.size);
        self.sum.fill(0.0);
        self.squares.fill(0.0);
        self.seen.fill(0.0);
        let cell_px = self.cells.cell_px as f64;
        // Middle of the view's first cell.
        let origin_mm = [
            self.geometry.origin.x + 0.5 * (cell_px - 1.0) * self.geometry.mm_per_px,
            self.geometry.origin.y - 0.5 * (cell_px - 1.0) * self.geometry.mm_per_px,
        ];
        let side_mm = cell_px * self.geometry.mm_per_px;
        let nadir = self.geometry.nadir;
        let mut whole = 0.0;
        for place in views.places() {
            let x_mm = self.column_mm(column) + views.kept(place).at.travel_mm;
            if x_mm < self.zone.x_min_mm {
                break;
            }
            whole += 1.0;
            let view = self.cells.view(place);
            for (k, &[_, m]) in self.planes.iter().enumerate() {
                let u = (nadir.x + m * (x_mm - nadir.x) - origin_mm[0]) / side_mm;
                if u < 0.0 || u >= (size[0] - 1) as f64 {
                    continue;
                }
                let (i, fu) = (u as usize, u.fract() as f32);
                let [left, right] = [i, i + 1].map(|c| &view[c * size[1]..][..size[1]]);
                let v0 = (origin_mm[1] - (nadir.y + m * (self.row_mm(0) - nadir.y))) / side_mm;
                let step = m * self.cell_mm / side_mm;
                let [sum, squares, seen] = [&mut self.sum, &mut self.squares, &mut self.seen]
                    .map(|b| &mut b[k * rows..][..rows]);
                for row in 0..rows {
                    let v = v0 + row as f64 * step;
                    if v < 0.0 || v >= (size[1] - 1) as f64 {
                        continue;
                    }
                    let (j, fv) = (v as usize, v.fract() as f32);
                    let [a, b, c, d] = [left[j], left[j + 1], right[j], right[j + 1]];
                    if a == UNSEEN || b == UNSEEN || c == UNSEEN || d == UNSEEN {
                        continue;
                    }
                    let [a, b, c, d] = [a, b, c, d].map(f32::from);
                    let (l, r) = (a + fv * (b - a), c + fv * (d - c));
                    let w = l + fu * (r - l);
                    sum[row] += w;
                    squares[row] += w * w;
                    seen[row] += 1.0;
                }
            }
        }
        let kept = column.rem_euclid(COLUMNS_KEPT as i64) as usize;
        self.views_whole[kept] = whole;
        let n = self.planes.len() * rows;
        let sums = &mut self.sums[kept * n..][..n];
        for (i, out) in sums.iter_mut().enumerate() {
            *out = [self.sum[i] * self.sum[i], self.seen[i] * self.squares[i]];
        }
        // Views of the plane of the belt, for the share.
        for row in 0..rows {
            self.views_seen[kept * rows + row] = self.seen[rows + row];
        }
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
            let strength = self.smooth[best * rows + row][0].sqrt() / seen;
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
