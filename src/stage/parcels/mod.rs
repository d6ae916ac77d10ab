//! Which parts of the scroll are a parcel.
//!
//! In: the decided part of the scroll, and the views. Out: upright rectangles at a height. A top face is
//! flat: neighbouring cells of one height begin it, be they its border or only a label on it. The views
//! stacked on the plane of that height show its whole border sharp; the rectangle around the beginning
//! whose four sides are explained best is the face. Edges tell the cuboid then, and the cells within tell whether it is
//! one: where they are higher than its top, it is the outline of a bag or a stack; where they lie on the belt, it
//! is nothing. What is raised and belongs to no face, as a tube, is enclosed as it is.

mod enclosing;
mod face;
mod rectangle;
mod scroll;
mod stack;
mod steps;
mod still;

use super::evidence::Evidence;
use super::views::Views;
use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::Level;
use crate::plan::{Memory, Plan};
use crate::units::BeltRect;
use enclosing::Side;
use face::is_border;
use rectangle::{CROP_MM, GRID_MM, RectangleSearch};
use scroll::{CELLS_MIN, Content, HEIGHT_MIN_MM, HIGHEST_SHARE, Scroll};
use stack::{Stack, WINDOW_MAX_MM, Window};
use steps::{Scale, Steps};
use still::Still;

pub use face::{Cuboid, Face};
pub use rectangle::Rectangle;

/// What is looked at around a beginning, mm.
const REACH_MM: f64 = 420.0;
/// Where the plane of the sharpest border is sought around the cells' height, mm, coarse and fine.
const HEIGHT_OFFSETS_MM: [&[f64]; 2] = [&[-5.0, 5.0, -10.0, 10.0, -15.0, 15.0], &[-2.5, 2.5]];
/// Times that the border is sought anew on the plane where it was sharpest.
const LOOKS: usize = 2;
/// Rectangles found in coarse pictures that are looked at in fine ones: a beginning's two best directions.
const CANDIDATES: usize = 2;
/// What is looked at around a known border, mm.
const NEAR_MM: f64 = 40.0;
/// What no face explains is a thing if it is wider than this, mm: an edge alone spreads cells over 32 mm.
const SIDE_MIN_MM: f64 = 40.0;

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

    fn new(
        view: &BeltView,
        scale: Scale,
        zone: &BeltRect,
        level: Level,
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        let steps = Steps::new(view, scale, seen, memory)?;
        let still = Still::new(view, scale, memory)?;
        Ok(Self { steps, still, stack: Stack::new(view, scale, zone, level, memory)? })
    }

    fn add(&mut self, views: &Views, place: usize) {
        self.steps.add(views.grey(place), place);
        self.still.add(self.steps.picture(place).grey, self.steps.seen());
    }

    /// Stack the views on a window at a height: x and y, lowest and highest, mm.
    fn fill(&mut self, views: &Views, height_mm: f64, [x_mm, y_mm]: [[f64; 2]; 2]) {
        let window = Window { height_mm, x_mm, y_mm };
        self.stack.fill(views, &self.steps, self.still.usable(), &window);
    }
}

/// The search.
pub struct Parcels {
    scroll: Scroll,
    height_max_mm: f64,
    fine: Layer,
    coarse: Layer,
    search: RectangleSearch,
    /// Found, not yet passed on.
    waiting: Vec<Face>,
    /// Passed on; their cells may still come.
    gone: Vec<Face>,
}

impl Parcels {
    /// Memory for a site.
    pub fn plan(view: &BeltView, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Layer::plan(view, Scale::Fine, zone, height_max_mm, plan);
        Layer::plan(view, Scale::Coarse, zone, height_max_mm, plan);
        RectangleSearch::plan(zone, plan);
    }

    /// Nothing seen. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        evidence: &Evidence,
        height_max_mm: f64,
        level: Level,
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        Ok(Self {
            scroll: Scroll::new(evidence, height_max_mm),
            height_max_mm,
            fine: Layer::new(view, Scale::Fine, zone, level, seen, memory)?,
            coarse: Layer::new(view, Scale::Coarse, zone, level, seen, memory)?,
            search: RectangleSearch::new(memory)?,
            waiting: Vec::new(),
            gone: Vec::new(),
        })
    }

    /// A view more.
    pub fn add(&mut self, views: &Views, place: usize) {
        self.fine.add(views, place);
        self.coarse.add(views, place);
    }

    /// The parcels whose trailing end has passed `end_mm`, X less the belt's travel. `fit`: the cuboid
    /// that the edges around a face show, if it lies over the belt.
    pub fn passed(
        &mut self,
        evidence: &Evidence,
        views: &Views,
        end_mm: f64,
        fit: impl Fn(&Face) -> Option<Cuboid>,
    ) -> Vec<Face> {
        self.scroll.take_columns(evidence, self.waiting.iter().chain(&self.gone));
        let first_mm = self.scroll.first_mm();
        self.gone.retain(|face| face.rectangle.trailing_mm() < first_mm);
        for (members, height_mm) in self.scroll.beginnings(end_mm == f64::NEG_INFINITY) {
            let members = self.scroll.free_of(members);
            if members.len() < CELLS_MIN {
                continue;
            }
            let found = self.face(&members, height_mm, views);
            self.scroll.take(&members);
            if let Some(face) = found.and_then(|found| self.parcel(views, &found, &fit)) {
                self.scroll.claim(&face);
                self.keep(&face);
            }
        }
        let has_passed = |face: &mut Face| face.rectangle.trailing_mm() > end_mm;
        let mut passed: Vec<Face> = self.waiting.extract_if(.., has_passed).collect();
        let known = self.waiting.iter().chain(&self.gone).chain(&passed);
        for members in self.scroll.left_over(&known, end_mm) {
            passed.extend(self.enclose(views, &members));
        }
        self.gone.extend(&passed);
        passed
    }

    /// The face that a beginning belongs to.
    fn face(&mut self, members: &[usize], height_mm: f64, views: &Views) -> Option<Face> {
        let places = [0, 1]
            .map(|k| -> Vec<f64> { members.iter().map(|&i| self.scroll.place_mm(i)[k]).collect() });
        let around = places.each_ref().map(|mm| {
            mm.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], v| [a.min(*v), b.max(*v)])
        });
        let inside = places.map(|mut mm| place_of(&mut mm, 0.5));
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
        is_border(&best).then(|| self.with_rivals(views, best, top_mm, members.len()))
    }

    /// A face with the borders further inside that may be its own, too.
    fn with_rivals(
        &mut self,
        views: &Views,
        rectangle: Rectangle,
        height_mm: f64,
        cells: usize,
    ) -> Face {
        self.fine.fill(views, height_mm, border_of(&rectangle, NEAR_MM));
        let narrower = self.search.narrower(&self.fine.stack, &rectangle);
        Face { rectangle, narrower, height_mm, cells, is_cuboid: false }
    }

    /// The plane on which a border is sharpest, and the border there.
    fn sharpest(&mut self, views: &Views, border: Rectangle, height_mm: f64) -> (Rectangle, f64) {
        let (mut best, mut top_mm) = (border, height_mm);
        for offsets_mm in HEIGHT_OFFSETS_MM {
            let from_mm = top_mm;
            for offset_mm in offsets_mm {
                let trial_mm = from_mm + offset_mm;
                if !(f64::from(HEIGHT_MIN_MM)..self.height_max_mm).contains(&trial_mm) {
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

    /// What a border found belongs to, by its edges and the cells within: a cuboid's top face, or a thing without
    /// one. A bag's outline lies on the belt, a stack's is that of its lower part.
    fn parcel(
        &mut self,
        views: &Views,
        found: &Face,
        fit: impl Fn(&Face) -> Option<Cuboid>,
    ) -> Option<Face> {
        let content = self.scroll.content(found);
        if let Some(cuboid) = fit(found) {
            let (rectangle, height_mm) = (cuboid.rectangle, cuboid.height_mm);
            let fitted = Face { rectangle, height_mm, is_cuboid: true, ..*found };
            if cuboid.is_box && self.scroll.content(&fitted).is_top() {
                return Some(fitted);
            }
            if content.is_top() {
                return Some(self.widened(views, found, &content));
            }
        }
        content.is_heap().then(|| self.widened(views, found, &content))
    }

    /// A thing without a top face: it is as high as what is raised within, and each side is where the edges are at the
    /// height of the cells there: a tube is widest at half its height.
    fn widened(&mut self, views: &Views, found: &Face, content: &Content) -> Face {
        let around = found.rectangle.shrunk(-enclosing::REACH_MM);
        let cells = self.scroll.raised_within(&around);
        let sides = Side::all(&around).map(|side| self.side_excess_mm(views, &side, &cells));
        let excess_mm = sides.map(|found| found.unwrap_or(enclosing::REACH_MM));
        let rectangle = around.moved_in(excess_mm, found.rectangle.sides);
        Face { rectangle, height_mm: content.highest_mm, ..*found }
    }

    /// How far a side is outside of its outermost line of edges, at the height of the cells (X less the belt's travel,
    /// Y, height) there.
    fn side_excess_mm(
        &mut self,
        views: &Views,
        side: &Side<'_>,
        cells: &[[f64; 3]],
    ) -> Option<f64> {
        let here = cells.iter().filter(|[x_mm, y_mm, _]| side.has([*x_mm, *y_mm]));
        let mut heights_mm: Vec<f64> = here.map(|cell| cell[2]).collect();
        let height_mm = place_of(&mut heights_mm, 0.5);
        self.fine.fill(views, height_mm, border_of(side.rectangle(), enclosing::REACH_MM));
        side.excess_mm(self.fine.stack.edges(), self.fine.stack.px_mm())
    }

    /// What encloses cells that are raised in one piece, if they are around it on all sides.
    fn enclose(&mut self, views: &Views, members: &[usize]) -> Option<Face> {
        let cells: Vec<[f64; 3]> = members.iter().map(|&i| self.scroll.cell_mm(i)).collect();
        let points: Vec<[f64; 2]> = cells.iter().map(|[x_mm, y_mm, _]| [*x_mm, *y_mm]).collect();
        let around = enclosing::smallest_rectangle(&points);
        let sides = Side::all(&around);
        let excess_mm = sides
            .each_ref()
            .map(|side| self.side_excess_mm(views, side, &cells).unwrap_or(enclosing::SPREAD_MM));
        let covered = sides.each_ref().map(|side| side.covered(&points, self.scroll.side_mm()));
        let rectangle = around.moved_in(excess_mm, covered);
        let mut heights_mm: Vec<f64> = cells.iter().map(|cell| cell[2]).collect();
        let height_mm = place_of(&mut heights_mm, HIGHEST_SHARE);
        let narrower = [None; 4];
        let face = Face { rectangle, narrower, height_mm, cells: members.len(), is_cuboid: false };
        let is_wide = rectangle.length_mm.min(rectangle.width_mm) > SIDE_MIN_MM;
        let is_thing = is_wide && is_border(&rectangle) && !self.scroll.content(&face).is_belt();
        is_thing.then_some(face)
    }

    /// Keep a face beside those that wait: of those at one place the best.
    fn keep(&mut self, face: &Face) {
        let same = |other: &Face| face.excludes(other);
        if self.gone.iter().any(same) {
            return;
        }
        let rivals: Vec<Face> = self.waiting.extract_if(.., |other| same(other)).collect();
        if face.worth() > rivals.iter().map(Face::worth).sum() {
            self.waiting.push(*face);
        } else {
            self.waiting.extend(rivals);
        }
    }
}

/// A rectangle's extent and a margin: x and y, lowest and highest.
fn border_of(rectangle: &Rectangle, margin_mm: f64) -> [[f64; 2]; 2] {
    let (sin, cos) = rectangle.yaw.sin_cos();
    let y_reach_mm = 0.5 * (rectangle.length_mm * sin.abs() + rectangle.width_mm * cos.abs());
    let around = |middle: f64, reach: f64| [middle - reach - margin_mm, middle + reach + margin_mm];
    [around(rectangle.x_mm, rectangle.reach_mm()), around(rectangle.y_mm, y_reach_mm)]
}

/// The value below which a share of them lies; 0 if there are none.
fn place_of(values: &mut [f64], share: f64) -> f64 {
    let place = (share * values.len() as f64) as usize;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(place.min(values.len() - 1), f64::total_cmp).1
}
