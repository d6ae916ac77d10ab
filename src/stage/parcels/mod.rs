//! Which parts of the scroll are a parcel.
//!
//! In: the decided part of the scroll, and the views. Out: upright rectangles at a height. A top face is
//! flat: neighbouring cells of one height begin it, be they its border or only a label on it. The views
//! stacked on the plane of that height show its whole border sharp; the rectangle around the beginning
//! whose four sides are explained best is the face. Edges tell the cuboid then, and the cells within tell whether it is
//! one: where they are higher than its top, it is the outline of a bag or a stack; where they lie on the belt, it
//! is nothing, but for a face so flat that only its edges tell it; where a surface at its height goes on beyond its border,
//! it is a line on something larger. What is raised and belongs to no face, as a tube, is enclosed as it is.

mod content;
mod enclosing;
mod face;
mod groups;
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
use content::{Content, HIGHEST_SHARE};
use enclosing::Side;
use face::is_border;
use groups::Group;
use rectangle::{CROP_MM, GRID_MM, RectangleSearch};
use scroll::{HEIGHT_MIN_MM, Scroll};
use stack::{Stack, WINDOW_MAX_MM, Window};
use steps::{Scale, Steps};
use still::Still;

pub use face::{Cuboid, Face, NARROWER};
pub use rectangle::Rectangle;

/// What is looked at around a beginning, mm.
const REACH_MM: f64 = 420.0;
/// The plane of the sharpest border is sought in such steps from the cells' height, mm, ...
const HEIGHT_STEPS_MM: [f64; 2] = [5.0, 2.5];
/// ... each at most so often.
const HEIGHT_STEPS_MAX: u32 = 3;
/// Times that the border is sought anew on the plane where it was sharpest.
const LOOKS: usize = 2;
/// Rectangles found in coarse pictures that are looked at in fine ones: a beginning's two best directions.
const CANDIDATES: usize = 2;
/// What is looked at around a known border, mm.
const NEAR_MM: f64 = 40.0;
/// Parcels on the way to the zone's end, and behind it, at most: more are counted.
const FACES_MAX: usize = 64;
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
        let steps = Steps::new(view, scale, level, seen, memory)?;
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
    waiting: heapless::Vec<Face, FACES_MAX>,
    /// Passed on; their cells may still come.
    gone: heapless::Vec<Face, FACES_MAX>,
    /// Those for which there was no room.
    overflows: u64,
}

impl Parcels {
    /// Memory for a site.
    pub fn plan(view: &BeltView, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Scroll::plan(Evidence::cells_max(view, zone, height_max_mm), plan);
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
            scroll: Scroll::new(evidence, height_max_mm, memory)?,
            height_max_mm,
            fine: Layer::new(view, Scale::Fine, zone, level, seen, memory)?,
            coarse: Layer::new(view, Scale::Coarse, zone, level, seen, memory)?,
            search: RectangleSearch::new(memory)?,
            waiting: heapless::Vec::new(),
            gone: heapless::Vec::new(),
            overflows: 0,
        })
    }

    /// A view more.
    pub fn add(&mut self, views: &Views, place: usize) {
        self.fine.add(views, place);
        self.coarse.add(views, place);
    }

    /// Parcels that were found and for which there was no room.
    pub fn overflows(&self) -> u64 {
        self.overflows
    }

    /// Take over what is decided of the scroll.
    pub fn take_columns(&mut self, evidence: &Evidence) {
        self.scroll.take_columns(evidence, self.waiting.iter().chain(&self.gone));
        let first_mm = self.scroll.first_mm();
        self.gone.retain(|face| face.rectangle.trailing_mm() < first_mm);
    }

    /// Another belt begins, after the last one's parcels were passed on.
    pub fn forget(&mut self) {
        self.scroll.forget();
        self.waiting.clear();
        self.gone.clear();
    }

    /// Whether a face on its way to the zone's end, and a place, lie on each other.
    pub fn waits_at(&self, place: &Rectangle) -> bool {
        self.waiting.iter().any(|face| face.rectangle.overlaps(place))
    }

    /// Whether the cells at a place tell the belt rather than something of this height, mm.
    pub fn shows_belt(&mut self, place: &Rectangle, height_mm: f64) -> bool {
        let face = Face::cuboid(place, height_mm);
        !face.is_low() && self.scroll.content(&face).shows_belt()
    }

    /// Whether the cells at a place are not those of a cuboid with that border and height, mm.
    pub fn contradict(&mut self, place: &Rectangle, height_mm: f64) -> bool {
        let face = Face::cuboid(place, height_mm);
        let others = self.waiting.iter().chain(&self.gone);
        !face.is_low() && self.scroll.content(&face).shows_belt()
            || self.scroll.goes_on_beyond(&face, &others)
    }

    /// Look at what most cells begin (of all, once the belt has `ended`). Returns whether there was anything. `fit`: the
    /// cuboid that the edges around a face show, if it lies over the belt.
    pub fn look(
        &mut self,
        views: &Views,
        ended: bool,
        fit: impl FnMut(&Face) -> Option<Cuboid>,
    ) -> bool {
        let Some(group) = self.scroll.look_at_beginning(ended) else { return false };
        self.scroll.take();
        let fresh = self.face(&group, views).filter(|found| !self.is_known(found));
        if let Some(face) = fresh.and_then(|fresh| self.parcel(views, &fresh, fit)) {
            self.scroll.claim(&face);
            self.keep(&face);
        }
        true
    }

    /// The next parcel whose trailing end has passed `end_mm`, X less the belt's travel. What is not told of it then is
    /// left over.
    pub fn next_passed(&mut self, end_mm: f64) -> Option<Face> {
        let has_passed = |face: &Face| face.rectangle.trailing_mm() > end_mm;
        loop {
            let place = self.waiting.iter().position(has_passed)?;
            let face = self.waiting.remove(place);
            let others = self.waiting.iter().chain(&self.gone);
            // What a border within something larger belongs to is left over.
            if !face.is_cuboid || !self.scroll.goes_on_beyond(&face, &others) {
                return Some(face);
            }
        }
    }

    /// The next thing that has passed `end_mm` and that no face explains.
    pub fn next_left_over(&mut self, views: &Views, end_mm: f64) -> Option<Face> {
        loop {
            let known = self.waiting.iter().chain(&self.gone);
            let group = self.scroll.look_at_left_over(&known, end_mm)?;
            let found = self.enclose(views, &group);
            self.scroll.settle();
            if found.is_some() {
                return found;
            }
        }
    }

    /// A parcel was told: what comes of its cells is known.
    pub fn told(&mut self, face: &Face) {
        if self.gone.is_full() {
            self.gone.remove(0);
        }
        // There is room.
        let _ = self.gone.push(*face);
    }

    /// The face that a beginning belongs to.
    fn face(&mut self, group: &Group, views: &Views) -> Option<Face> {
        let Group { cells, around_mm: around, inside_mm: inside, height_mm } = *group;
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
        is_border(&best).then(|| self.with_rivals(views, best, top_mm, cells))
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

    /// The plane on which a border is sharpest, and the border there: uphill, in steps of half the last size.
    fn sharpest(&mut self, views: &Views, border: Rectangle, height_mm: f64) -> (Rectangle, f64) {
        let (mut best, mut top_mm) = (border, height_mm);
        for step_mm in HEIGHT_STEPS_MM {
            for step_mm in [step_mm, -step_mm] {
                let (from_mm, mut steps) = (top_mm, 0);
                while steps < HEIGHT_STEPS_MAX {
                    let trial_mm = from_mm + f64::from(steps + 1) * step_mm;
                    let Some(found) = self.near(views, &best, trial_mm) else { break };
                    if found.score_mm <= best.score_mm {
                        break;
                    }
                    (best, top_mm) = (found, trial_mm);
                    steps += 1;
                }
                if steps > 0 {
                    break;
                }
            }
        }
        (best, top_mm)
    }

    /// A known border on another plane.
    fn near(&mut self, views: &Views, border: &Rectangle, height_mm: f64) -> Option<Rectangle> {
        if !(f64::from(HEIGHT_MIN_MM)..self.height_max_mm).contains(&height_mm) {
            return None;
        }
        self.fine.fill(views, height_mm, border_of(border, NEAR_MM));
        let middle = [border.x_mm as f32, border.y_mm as f32];
        self.search.near(&self.fine.stack, middle, border.yaw as f32)
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
        mut fit: impl FnMut(&Face) -> Option<Cuboid>,
    ) -> Option<Face> {
        let content = self.scroll.content(found);
        if let Some(cuboid) = fit(found) {
            let (rectangle, height_mm) = (cuboid.rectangle, cuboid.height_mm);
            let fitted = Face { rectangle, height_mm, is_cuboid: true, ..*found };
            let within = self.scroll.content(&fitted);
            if cuboid.is_box && (within.is_top() || fitted.is_flat() && within.is_low()) {
                return Some(fitted);
            }
            let others = self.waiting.iter().chain(&self.gone);
            if content.is_top() && !self.scroll.goes_on_beyond(found, &others) {
                return Some(self.widened(views, found, &content));
            }
        }
        content.is_heap().then(|| self.widened(views, found, &content))
    }

    /// A thing without a top face: it is as high as what is raised within, and each side is where the edges are at the
    /// height of the cells there: a tube is widest at half its height.
    fn widened(&mut self, views: &Views, found: &Face, content: &Content) -> Face {
        let around = found.rectangle.shrunk(-enclosing::REACH_MM);
        self.scroll.look_within(&around);
        let excess_mm = Side::all(&around)
            .map(|side| self.side_excess_mm(views, &side).unwrap_or(enclosing::REACH_MM));
        let rectangle = around.moved_in(excess_mm, found.rectangle.sides);
        Face { rectangle, height_mm: content.highest_mm, ..*found }
    }

    /// How far a side is outside of its outermost line of edges, at the height of the cells there that are looked at.
    fn side_excess_mm(&mut self, views: &Views, side: &Side<'_>) -> Option<f64> {
        let height_mm = self.scroll.height_of(0.5, |at_mm| side.has(at_mm));
        self.fine.fill(views, height_mm, border_of(side.rectangle(), enclosing::REACH_MM));
        side.excess_mm(self.fine.stack.edges(), self.fine.stack.px_mm())
    }

    /// What encloses the raised cells that are looked at, if they are around it on all sides.
    fn enclose(&mut self, views: &Views, group: &Group) -> Option<Face> {
        let around = self.scroll.smallest_rectangle();
        if around.length_mm.min(around.width_mm) < SIDE_MIN_MM {
            return None;
        }
        let sides = Side::all(&around);
        let excess_mm = sides
            .each_ref()
            .map(|side| self.side_excess_mm(views, side).unwrap_or(enclosing::SPREAD_MM));
        let covered = sides.each_ref().map(|side| {
            let places = self.scroll.members().map(|i| self.scroll.place_mm(i));
            side.covered(places, self.scroll.side_mm())
        });
        let rectangle = around.moved_in(excess_mm, covered);
        let height_mm = self.scroll.height_of(HIGHEST_SHARE, |_| true);
        let (narrower, cells) = ([None; NARROWER], group.cells);
        let face = Face { rectangle, narrower, height_mm, cells, is_cuboid: false };
        let is_wide = rectangle.length_mm.min(rectangle.width_mm) > SIDE_MIN_MM;
        let is_thing = is_wide && is_border(&rectangle) && !self.scroll.content(&face).is_belt();
        is_thing.then_some(face)
    }

    /// Whether a border found is that of a cuboid that is already known.
    fn is_known(&self, found: &Face) -> bool {
        self.waiting.iter().chain(&self.gone).any(|known| known.is_cuboid && known.is_same(found))
    }

    /// Keep a face beside those that wait: of those at one place the best.
    fn keep(&mut self, face: &Face) {
        let same = |other: &Face| face.excludes(other);
        if self.gone.iter().any(same) {
            return;
        }
        let rivals = self.waiting.iter().filter(|other| same(other));
        if face.worth() > rivals.map(Face::worth).sum() {
            self.waiting.retain(|other| !same(other));
            self.overflows += u64::from(self.waiting.push(*face).is_err());
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
