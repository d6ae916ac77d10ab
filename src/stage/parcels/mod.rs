//! Which parts of the scroll are a parcel's top face.
//!
//! In: the decided part of the scroll, and the views. Out: upright rectangles at a height. A top face is
//! flat: neighbouring cells of one height begin it, be they its border or only a label on it. The views
//! stacked on the plane of that height show its whole border sharp; the rectangle around the beginning
//! whose four sides are explained best is the face. What is lower beside it is its sides; what is higher
//! on it stands on it.

mod rectangle;
mod stack;
mod steps;
mod still;

use super::evidence::{Cell, Evidence};
use super::views::Views;
use crate::camera::BeltView;
use crate::error::Result;
use crate::plan::{Memory, Plan};
use crate::units::BeltRect;
use rectangle::{CROP_MM, GRID_MM, RectangleSearch};
use stack::{Stack, WINDOW_MAX_MM, Window};
use steps::{Scale, Steps};
use still::Still;

pub use rectangle::Rectangle;

/// Trial planes are this far apart, mm.
const PLANE_STEP_MM: f32 = 3.0;
/// A cell belongs to a plane that is this near, mm.
const TOLERANCE_MM: f32 = 6.0;
/// Lower than this is the belt, mm: cells of the belt scatter by 1 mm.
const HEIGHT_MIN_MM: f32 = 2.4;
/// A cell whose possible heights span more than this, mm, tells none.
const NARROW_MM: f32 = 40.0;
/// Cells of one beginning are at most this far apart, cells.
const GAP: i32 = 2;
/// Columns behind a group that must be decided before it is whole.
const WAIT_COLUMNS: usize = 8;
/// A smaller group this near to a larger one that is not whole waits for it, cells.
const BESIDE_CELLS: usize = 6;
/// A beginning of fewer cells is an accident.
const CELLS_MIN: usize = 12;
/// What is looked at around a beginning, mm.
const REACH_MM: f64 = 420.0;
/// A border with less than this share of edge is an accident.
const SUPPORT_MIN: f64 = 0.65;
/// Each side has at least this share of edge.
const SIDE_SUPPORT_MIN: f64 = 0.25;
/// Lines that happen to lie right give this share.
const ACCIDENT_SUPPORT: f64 = 0.55;
/// Where the plane of the sharpest border is sought around the cells' height, mm, coarse and fine.
const HEIGHT_OFFSETS_MM: [&[f64]; 2] = [&[-5.0, 5.0, -10.0, 10.0, -15.0, 15.0], &[-2.5, 2.5]];
/// Times that the border is sought anew on the plane where it was sharpest.
const LOOKS: usize = 2;
/// Rectangles found in coarse pictures that are looked at in fine ones: a beginning's two best directions.
const CANDIDATES: usize = 2;
/// What is looked at around a known border, mm.
const NEAR_MM: f64 = 40.0;
/// Cells this far around a face are its own: its sides, mm.
const SIDE_MM: f64 = 10.0;
/// Two faces are one parcel's when this share of one lies inside the other.
const OVERLAP_SHARE: f64 = 0.3;
/// What lies on another has its border, and so has that one, for this share.
const STACK_SUPPORT: f64 = 0.75;
/// Faces whose heights differ by more are on top of each other, mm.
const STEP_MM: f64 = 12.0;

/// A parcel's top face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Its border.
    pub rectangle: Rectangle,
    /// For each side the border with a line further inside that may be it, too.
    pub narrower: [Option<Rectangle>; 4],
    /// Over the belt, mm.
    pub height_mm: f64,
    /// Cells that began it.
    pub cells: usize,
    /// Something lies on it: the height is that one's.
    pub stacked: bool,
}

/// The views of a pass at one scale, and what of them is looked at.
struct Layer {
    steps: Steps,
    still: Still,
    stack: Stack,
}

impl Layer {
    fn plan(view: &BeltView, scale: Scale, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Steps::plan(view, scale, plan);
        Still::plan(view, scale, plan);
        Stack::plan(view, scale, zone, height_max_mm, plan);
    }

    fn new(view: &BeltView, scale: Scale, zone: &BeltRect, memory: &mut Memory) -> Result<Self> {
        let steps = Steps::new(view, scale, memory)?;
        let still = Still::new(view, scale, memory)?;
        Ok(Self { steps, still, stack: Stack::new(view, scale, zone, memory)? })
    }

    fn add(&mut self, views: &Views, place: usize, seen: &[u64]) {
        self.steps.add(views.grey(place), seen, place);
        self.still.add(self.steps.picture(place).grey);
    }

    /// Stack the views on a window at a height: x and y, lowest and highest, mm.
    fn fill(&mut self, views: &Views, height_mm: f64, [x_mm, y_mm]: [[f64; 2]; 2]) {
        let window = Window { height_mm, x_mm, y_mm };
        self.stack.fill(views, &self.steps, self.still.usable(), &window);
    }
}

/// The undecided part of the scroll.
pub struct Parcels {
    /// First column that is looked at, and its cells and whether they are free.
    first: i64,
    cells: Vec<Cell>,
    free: Vec<bool>,
    rows: usize,
    cell_mm: f64,
    row_0_mm: f64,
    height_max_mm: f32,
    fine: Layer,
    coarse: Layer,
    search: RectangleSearch,
    /// Faces found, not yet passed on.
    waiting: Vec<Face>,
    /// Faces passed on whose cells may still come.
    gone: Vec<Face>,
}

impl Parcels {
    /// Memory for a site.
    pub fn plan(view: &BeltView, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Layer::plan(view, Scale::Fine, zone, height_max_mm, plan);
        Layer::plan(view, Scale::Coarse, zone, height_max_mm, plan);
        RectangleSearch::plan(zone, plan);
    }

    /// Nothing seen.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        evidence: &Evidence,
        height_max_mm: f64,
        memory: &mut Memory,
    ) -> Result<Self> {
        Ok(Self {
            first: 0,
            cells: Vec::new(),
            free: Vec::new(),
            rows: evidence.rows(),
            cell_mm: evidence.side_mm(),
            row_0_mm: evidence.row_mm(0),
            height_max_mm: height_max_mm as f32,
            fine: Layer::new(view, Scale::Fine, zone, memory)?,
            coarse: Layer::new(view, Scale::Coarse, zone, memory)?,
            search: RectangleSearch::new(memory)?,
            waiting: Vec::new(),
            gone: Vec::new(),
        })
    }

    /// A view more. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn add(&mut self, views: &Views, place: usize, seen: &[u64]) {
        self.fine.add(views, place, seen);
        self.coarse.add(views, place, seen);
    }

    /// The faces whose trailing end has passed `end_mm`, X less the belt's travel. `is_raised`: whether a face
    /// lies over the belt, by its edges; what lies on the belt itself carries no parcel as a stack does.
    pub fn passed(
        &mut self,
        evidence: &Evidence,
        views: &Views,
        end_mm: f64,
        is_raised: impl Fn(&Face) -> bool,
    ) -> Vec<Face> {
        self.take_columns(evidence);
        let ended = end_mm == f64::NEG_INFINITY;
        for (members, height_mm) in self.beginnings(ended) {
            let members: Vec<usize> = members.into_iter().filter(|&i| self.free[i]).collect();
            if members.len() < CELLS_MIN {
                continue;
            }
            let found = self.face(&members, height_mm, views);
            for &i in &members {
                self.free[i] = false;
            }
            if let Some(face) = found.filter(&is_raised) {
                self.claim(&face);
                self.keep(&face);
            }
        }
        let (passed, waiting): (Vec<Face>, Vec<Face>) =
            self.waiting.drain(..).partition(|face| face.rectangle.trailing_mm() > end_mm);
        self.waiting = waiting;
        self.gone.extend(&passed);
        passed
    }

    /// Columns decided since the last time; old ones go.
    fn take_columns(&mut self, evidence: &Evidence) {
        let decided = evidence.decided();
        if decided.start > self.first {
            let gone = ((decided.start - self.first) as usize * self.rows).min(self.cells.len());
            self.cells.drain(..gone);
            self.free.drain(..gone);
            self.first = decided.start;
            let first_mm = -(self.first as f64) * self.cell_mm;
            self.gone.retain(|face| face.rectangle.trailing_mm() < first_mm);
        }
        let known = self.first + (self.cells.len() / self.rows) as i64;
        for column in known..decided.end {
            self.cells.extend(evidence.column(column));
            self.free.extend(evidence.column(column).iter().map(Self::tells));
        }
        let fresh = (known - self.first).max(0) as usize * self.rows;
        for face in self.waiting.iter().chain(&self.gone) {
            for i in fresh..self.cells.len() {
                let (x_mm, y_mm) = self.place_mm(i);
                self.free[i] &= !owns(face, &self.cells[i], x_mm, y_mm);
            }
        }
    }

    /// Whether a cell tells a height.
    fn tells(cell: &Cell) -> bool {
        cell.strength > 0.0
            && cell.height_mm > HEIGHT_MIN_MM
            && cell.possible_mm[1] - cell.possible_mm[0] < NARROW_MM
    }

    /// X less travel, and Y, of a cell's middle.
    fn place_mm(&self, i: usize) -> (f64, f64) {
        let column = self.first + (i / self.rows) as i64;
        (-(column as f64) * self.cell_mm, self.row_0_mm - (i % self.rows) as f64 * self.cell_mm)
    }

    /// Groups of neighbouring free cells of one height that are whole, and their heights, largest first.
    /// What lies beside a larger group waits for that one.
    fn beginnings(&self, ended: bool) -> Vec<(Vec<usize>, f64)> {
        let columns = self.cells.len() / self.rows;
        let usable =
            |i: &usize| self.free[*i] && self.cells[*i].possible_mm[1] < self.height_max_mm;
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
                    let members = self.connected(start, &mut here);
                    if members.len() >= CELLS_MIN {
                        groups.push(members);
                    }
                }
            }
        }
        groups.sort_by_key(|members| std::cmp::Reverse(members.len()));
        // What still reaches the newest columns is not whole.
        let is_whole = |members: &[usize]| {
            ended || members.iter().all(|i| i / self.rows + WAIT_COLUMNS < columns)
        };
        let extent = |members: &[usize]| {
            let start = [usize::MAX, 0, usize::MAX, 0];
            members.iter().fold(start, |[a, b, c, d], i| {
                let (column, row) = (i / self.rows, i % self.rows);
                [a.min(column), b.max(column), c.min(row), d.max(row)]
            })
        };
        let mut waiting: Vec<[usize; 4]> = Vec::new();
        let mut whole = Vec::new();
        for members in groups {
            let here = extent(&members);
            let beside = |[a, b, c, d]: &[usize; 4]| {
                *a <= here[1] + BESIDE_CELLS
                    && here[0] <= b + BESIDE_CELLS
                    && *c <= here[3] + BESIDE_CELLS
                    && here[2] <= d + BESIDE_CELLS
            };
            if !is_whole(&members) || waiting.iter().any(beside) {
                waiting.push(here);
                continue;
            }
            let heights_mm = members.iter().map(|&i| f64::from(self.cells[i].height_mm));
            let height_mm = middle_of(heights_mm);
            whole.push((members, height_mm));
        }
        whole
    }

    /// Cells connected to one, taken out of `here`.
    fn connected(&self, start: usize, here: &mut [bool]) -> Vec<usize> {
        let columns = (self.cells.len() / self.rows) as i32;
        let mut members = vec![start];
        here[start] = false;
        let mut next = 0;
        while next < members.len() {
            let (column, row) =
                ((members[next] / self.rows) as i32, (members[next] % self.rows) as i32);
            next += 1;
            for c in (column - GAP).max(0)..=(column + GAP).min(columns - 1) {
                for r in (row - GAP).max(0)..=(row + GAP).min(self.rows as i32 - 1) {
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

    /// The face that a beginning belongs to.
    fn face(&mut self, members: &[usize], height_mm: f64, views: &Views) -> Option<Face> {
        let places: Vec<(f64, f64)> = members.iter().map(|&i| self.place_mm(i)).collect();
        let extent = |of: fn(&(f64, f64)) -> f64| {
            let start = [f64::INFINITY, f64::NEG_INFINITY];
            places.iter().map(of).fold(start, |[a, b], v| [a.min(v), b.max(v)])
        };
        let around = [extent(|place| place.0), extent(|place| place.1)];
        let inside = [middle_of(places.iter().map(|p| p.0)), middle_of(places.iter().map(|p| p.1))];
        let mut best = self.rectangle(views, height_mm, around, inside)?;
        let mut top_mm = height_mm;
        for _ in 0..LOOKS {
            (best, top_mm) = self.sharpest(views, best, top_mm);
            // On the right plane more of it may be sharp.
            let wider = self.rectangle(views, top_mm, around, inside);
            match wider.filter(|wider| wider.score_mm > best.score_mm + GRID_MM) {
                Some(wider) => best = wider,
                None => break,
            }
        }
        self.fine.fill(views, top_mm, border_of(&best, NEAR_MM));
        let narrower = self.search.narrower(&self.fine.stack, &best);
        let weakest = best.sides.iter().copied().fold(1.0, f64::min);
        let is_face = best.support() >= SUPPORT_MIN && weakest >= SIDE_SUPPORT_MIN;
        is_face.then_some(Face {
            rectangle: best,
            narrower,
            height_mm: top_mm,
            cells: members.len(),
            stacked: false,
        })
    }

    /// The plane on which a border is sharpest, and the border there.
    fn sharpest(&mut self, views: &Views, border: Rectangle, height_mm: f64) -> (Rectangle, f64) {
        let (mut best, mut top_mm) = (border, height_mm);
        for offsets_mm in HEIGHT_OFFSETS_MM {
            let from_mm = top_mm;
            for offset_mm in offsets_mm {
                let trial_mm = from_mm + offset_mm;
                if !(f64::from(HEIGHT_MIN_MM)..f64::from(self.height_max_mm)).contains(&trial_mm) {
                    continue;
                }
                self.fine.fill(views, trial_mm, border_of(&best, NEAR_MM));
                let middle = [best.x_mm as f32, best.y_mm as f32];
                let found = self.search.near(&self.fine.stack, middle, best.yaw as f32);
                if let Some(found) = found.filter(|found| found.score_mm > best.score_mm) {
                    (best, top_mm) = (found, trial_mm);
                }
            }
        }
        (best, top_mm)
    }

    fn rectangle(
        &mut self,
        views: &Views,
        height_mm: f64,
        [x_mm, y_mm]: [[f64; 2]; 2],
        inside_mm: [f64; 2],
    ) -> Option<Rectangle> {
        let mut best: Option<Rectangle> = None;
        let mut around = [x_mm, y_mm];
        for _ in 0..LOOKS {
            let window = around.map(|[low, high]| {
                let reach_mm = (0.5 * (WINDOW_MAX_MM - (high - low))).clamp(NEAR_MM, REACH_MM);
                [low - reach_mm, high + reach_mm]
            });
            self.coarse.fill(views, height_mm, window);
            let inside = inside_mm.map(|mm| mm as f32);
            let candidates = self.search.candidates(&self.coarse.stack, inside);
            let refined = candidates.iter().take(CANDIDATES).filter_map(|coarse| {
                self.fine.fill(views, height_mm, border_of(coarse, CROP_MM));
                self.search.refined(&self.fine.stack, inside, coarse)
            });
            let found = refined.max_by(|a, b| a.score_mm.total_cmp(&b.score_mm));
            let score_mm = best.map_or(0.0, |best| best.score_mm + GRID_MM);
            let Some(found) = found.filter(|found| found.score_mm > score_mm) else { break };
            best = Some(found);
            let near = border_of(&found, NEAR_MM);
            if near
                .iter()
                .zip(window)
                .all(|(near, window)| near[0] >= window[0] && near[1] <= window[1])
            {
                break;
            }
            // What the window cut off may be seen from there.
            for ([low, high], [from, to]) in around.iter_mut().zip(border_of(&found, 0.0)) {
                (*low, *high) = (low.min(from), high.max(to));
            }
        }
        best
    }

    /// The cells of a face are free no more.
    fn claim(&mut self, face: &Face) {
        for i in 0..self.cells.len() {
            let (x_mm, y_mm) = self.place_mm(i);
            self.free[i] &= !owns(face, &self.cells[i], x_mm, y_mm);
        }
    }

    /// Keep a face beside those that wait: of those at one place the best, or a stack.
    fn keep(&mut self, face: &Face) {
        let same = |other: &Face| {
            face.rectangle.share_inside(&other.rectangle) > OVERLAP_SHARE
                || other.rectangle.share_inside(&face.rectangle) > OVERLAP_SHARE
        };
        if self.gone.iter().any(same) {
            return;
        }
        let (rivals, others): (Vec<Face>, Vec<Face>) = self.waiting.drain(..).partition(same);
        self.waiting = others;
        if let [rival] = rivals[..]
            && let Some(stack) = stacked(face, &rival)
        {
            self.waiting.push(stack);
        } else if worth(face) > rivals.iter().map(worth).sum() {
            self.waiting.push(*face);
        } else {
            self.waiting.extend(rivals);
        }
    }
}

/// What a face explains: its border beyond what an accident has.
fn worth(face: &Face) -> f64 {
    let border_mm = 2.0 * (face.rectangle.length_mm + face.rectangle.width_mm);
    (face.rectangle.support() - ACCIDENT_SUPPORT) * border_mm
}

/// A stack, if one of two faces lies on the other.
fn stacked(one: &Face, other: &Face) -> Option<Face> {
    let (low, high) = if one.height_mm < other.height_mm { (one, other) } else { (other, one) };
    let on_top = high.height_mm - low.height_mm > STEP_MM
        && high.rectangle.share_inside(&low.rectangle) > 0.9
        && low.rectangle.support().min(high.rectangle.support()) > STACK_SUPPORT;
    on_top.then_some(Face { height_mm: high.height_mm, stacked: true, ..*low })
}

/// A rectangle's extent and a margin: x and y, lowest and highest.
fn border_of(rectangle: &Rectangle, margin_mm: f64) -> [[f64; 2]; 2] {
    let (sin, cos) = rectangle.yaw.sin_cos();
    let y_reach_mm = 0.5 * (rectangle.length_mm * sin.abs() + rectangle.width_mm * cos.abs());
    let around = |middle: f64, reach: f64| [middle - reach - margin_mm, middle + reach + margin_mm];
    [around(rectangle.x_mm, rectangle.reach_mm()), around(rectangle.y_mm, y_reach_mm)]
}

/// Whether a cell belongs to a face: on it, or lower and beside it.
fn owns(face: &Face, cell: &Cell, x_mm: f64, y_mm: f64) -> bool {
    f64::from(cell.height_mm) < face.height_mm + STEP_MM
        && face.rectangle.outside_mm(x_mm, y_mm) < SIDE_MM
}

fn middle_of(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}
