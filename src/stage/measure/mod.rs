//! The known-motion measurement: one cuboid fitted to a parcel's whole pass.
//!
//! In: for each frame, a track's runs and the grey belt view, with the belt's travel. Out: an
//! [`Estimate`] at any time, final when the parcel has left. Owns: the views of every pass.
//! Limits: `limits.views_per_track_max`; a full pass is thinned to every second view.
//! Cost: a few 10 us a frame and track; a refit of the silhouettes every fourth view; over the last
//! tenth of the zone a few jobs a frame of the search for the final fit's start; in the frame of
//! the exit that start refined on all views.

pub mod budget;
mod corners;
mod dissent;
mod fit;
mod model;
mod observe;
mod search;
mod shadow;
mod votes;
mod whole_pass;

pub use fit::{Estimate, canonical_estimate};
pub use model::{HEIGHT, LENGTH, Outline, Params, Rounding, SCALE, WIDTH, X, Y, YAW};
pub use observe::Frame;
pub use whole_pass::WholePass;

use crate::belt::BeltPosition;
use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::Level;
use crate::kernel::scalar::runs::Run;
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltRect;
use corners::{CORNERS, Corner, top_motion};
use fit::{Problem, Silhouette};
use observe::PassView;
use search::{Found, Search};

/// A first estimate needs this many views ...
const FIRST_FIT_VIEWS: usize = 4;
/// ... over this much travel, mm: height shows only in motion.
const FIRST_FIT_TRAVEL_MM: f64 = 50.0;
/// ... that together showed the parcel from this many of 32 directions.
const DIRECTIONS_MIN: u32 = 24;
/// The search for the final fit's start begins this share of the zone before the exit ...
const SEARCH_SHARE: f64 = 0.12;
/// ... and has ended a frame before it.
const FRAMES_SPARE: f64 = 1.0;
/// Refit after this many new views.
const REFIT_VIEWS: usize = 4;
/// Views that a pass over the zone gives, before thinning.
const VIEWS_PER_ZONE: f64 = 60.0;
/// Fewer profiles than this cannot carry the fit.
const EDGE_COUNT_MIN: usize = 60;

/// Below this share of profiles with an edge where the cuboid has one, it is no cuboid, ...
const BOX_EDGE_SHARE_MIN: f64 = 0.78;
/// ... unless its edges are faint (a dark parcel's): then this share will do ...
const FAINT_EDGE_SHARE_MIN: f64 = 0.5;
/// ... when the silhouettes agree with it to this mean square, in units of their sigma.
const FAINT_REACH_ERROR_MAX: f64 = 2.0;

/// Corners below the edges' top face with which the fit keeps less than this share of its score
/// are on a side.
const LED_AWAY_SCORE: f64 = 0.8;

/// The result of a pass.
#[derive(Clone, Copy, Debug)]
pub struct Measured {
    /// The cuboid, or the smallest one that holds what is none.
    pub estimate: Estimate,
    /// Its edges are those of a cuboid.
    pub is_box: bool,
    /// Edges were found, be they a cuboid's or not.
    pub has_edges: bool,
    /// Corners on the top face and its edges disagree about the height.
    pub disputed: bool,
    /// Another cuboid that explains the edges nearly as well, X at the newest view.
    pub rival: Option<Estimate>,
}

/// State of one track's pass.
#[derive(Clone, Copy)]
struct Pass {
    view_count: usize,
    /// Directions seen so far, as bits, and how often in all: of the whole blob, and of it
    /// without dark parts.
    directions: [u32; 2],
    reach_count: [usize; 2],
    first: BeltPosition,
    last: BeltPosition,
    view_step_mm: f64,
    since_fit: usize,
    estimate: Option<Estimate>,
    search: Search,
}

impl Pass {
    fn begin(at: BeltPosition, view_step_mm: f64) -> Self {
        Self {
            view_count: 0,
            directions: [0; 2],
            reach_count: [0; 2],
            first: at,
            last: BeltPosition { travel_mm: f64::NEG_INFINITY, ..at },
            view_step_mm,
            since_fit: 0,
            estimate: None,
            search: Search::NEW,
        }
    }
}

/// The measuring stage: a pass for every track slot.
pub struct Measure {
    geometry: BeltView,
    level: Level,
    zone: BeltRect,
    height_max_mm: f64,
    rounding: Rounding,
    views_per_track: usize,
    views: Block<PassView>,
    passes: Block<Pass>,
    corners: Block<Corner>,
}

impl Measure {
    /// Memory for `tracks_max` passes.
    pub fn plan(tracks_max: usize, views_per_track: usize, plan: &mut Plan) {
        plan.add::<PassView>(
            "measure.views",
            tracks_max * views_per_track,
            "limits.tracks_max x limits.views_per_track_max",
        );
        plan.add::<Pass>("measure.passes", tracks_max, "limits.tracks_max");
        plan.add::<Corner>("measure.corners", tracks_max * CORNERS, "20 for each track");
    }

    /// No passes yet.
    pub fn new(
        geometry: BeltView,
        level: Level,
        zone: BeltRect,
        height_max_mm: f64,
        rounding: Rounding,
        views_per_track: usize,
        memory: &mut Memory,
    ) -> Result<Self> {
        Ok(Self {
            geometry,
            level,
            zone,
            height_max_mm,
            rounding,
            views_per_track,
            views: memory.take("measure.views", PassView::EMPTY)?,
            passes: memory.take("measure.passes", Pass::begin(BeltPosition::default(), 0.0))?,
            corners: memory.take("measure.corners", Corner::EMPTY)?,
        })
    }

    /// Begin a pass.
    pub fn begin(&mut self, slot: usize, at: BeltPosition) {
        self.corners[slot * CORNERS..][..CORNERS].fill(Corner::EMPTY);
        self.passes[slot] = Pass::begin(at, self.zone.length_mm() / VIEWS_PER_ZONE);
    }

    /// What one frame shows of the parcel. `runs`: its blob, empty when it is not alone.
    pub fn observe<'r>(
        &mut self,
        slot: usize,
        at: BeltPosition,
        frame: &Frame<'_>,
        runs: impl Iterator<Item = &'r Run>,
    ) {
        let pass = &mut self.passes[slot];
        if at.travel_mm - pass.last.travel_mm < pass.view_step_mm {
            return;
        }
        let mut view = PassView::EMPTY;
        view.travel_mm = at.travel_mm;
        view.reach_mm = frame.reach(runs);
        if let Some(estimate) = &pass.estimate {
            let travel = at.travel_mm - pass.first.travel_mm;
            let outline = Outline::new(&self.geometry, &estimate.params, travel);
            frame.sample_edges(&outline, &mut view);
            let corners = &mut self.corners[slot * CORNERS..][..CORNERS];
            let ratio =
                estimate.params[SCALE] * self.geometry.magnification(estimate.params[HEIGHT]);
            corners::follow(corners, &self.geometry, frame.grey, at.travel_mm, ratio);
            // Chosen once the estimate is new: an early, wrong one predicts wrong places.
            if pass.since_fit == 0 {
                let view = (&self.geometry, self.level);
                corners::choose(corners, view, frame.grey, &outline, at.travel_mm);
            }
        }
        let reach_count = view.reach_count();
        if reach_count == [0; 2] && view.samples().is_empty() {
            return;
        }
        pass.last = at;
        pass.since_fit += 1;
        for (k, (seen, count)) in view.directions().into_iter().zip(reach_count).enumerate() {
            pass.directions[k] |= seen;
            pass.reach_count[k] += count;
        }
        let views = &mut self.views[slot * self.views_per_track..][..self.views_per_track];
        if pass.view_count == views.len() {
            for i in 0..views.len() / 2 {
                views[i] = views[2 * i];
            }
            pass.view_count = views.len() / 2;
            pass.view_step_mm *= 2.0;
        }
        views[pass.view_count] = view;
        pass.view_count += 1;
        self.refit(slot);
    }

    /// The running estimate, from silhouettes alone: it only has to predict where edges are, and
    /// cannot lock on to a wrong one.
    fn refit(&mut self, slot: usize) {
        let pass = &self.passes[slot];
        let travelled = pass.last.travel_mm - pass.first.travel_mm;
        let ready = match pass.estimate {
            None => {
                let seen = pass.directions.map(u32::count_ones);
                pass.view_count >= FIRST_FIT_VIEWS
                    && seen[0].max(seen[1]) >= DIRECTIONS_MIN
                    && travelled >= FIRST_FIT_TRAVEL_MM
            }
            Some(_) => pass.since_fit >= REFIT_VIEWS,
        };
        if ready {
            let start = pass.estimate.map(|e| e.params);
            // A shadow that runs out of sight leaves the whole blob without an end.
            let [whole, bright] = pass.reach_count;
            let silhouette =
                if 2 * whole >= bright { Silhouette::Whole } else { Silhouette::Bright };
            let problem = self.problem(slot, silhouette, true).on_some_of(self.views(slot));
            let estimate = problem.fit_reach(self.views(slot), start);
            let pass = &mut self.passes[slot];
            pass.estimate = estimate.or(pass.estimate);
            pass.since_fit = 0;
        }
    }

    /// One frame nearer to the exit, the belt having moved by `step_mm`: so much of the search for
    /// the final fit's start as is due.
    pub fn search(&mut self, slot: usize, at: BeltPosition, step_mm: f64) {
        let Some(outline) = self.outline(slot, at) else { return };
        let left_mm = self.zone.x_max_mm - outline.trailing_x_mm();
        if step_mm <= 0.0 || left_mm > SEARCH_SHARE * self.zone.length_mm() {
            return;
        }
        let frames = (left_mm / step_mm - FRAMES_SPARE).max(1.0) as usize;
        let jobs = self.passes[slot].search.jobs_left().div_ceil(frames);
        self.search_jobs(slot, jobs);
    }

    fn search_jobs(&mut self, slot: usize, jobs: usize) {
        let mut search = self.passes[slot].search;
        let running = self.passes[slot].estimate.map(|e| e.params);
        let problem = |silhouette, corners| self.problem(slot, silhouette, corners);
        for _ in 0..jobs {
            search.step(problem, self.views(slot), running, is_box);
        }
        self.passes[slot].search = search;
    }

    fn views(&self, slot: usize) -> &[PassView] {
        &self.views[slot * self.views_per_track..][..self.passes[slot].view_count]
    }

    fn problem(&self, slot: usize, silhouette: Silhouette, corners: bool) -> Problem<'_> {
        let pass = &self.passes[slot];
        let top_motion =
            top_motion(self.corners(slot), self.zone.length_mm(), self.geometry.mm_per_px);
        Problem {
            geometry: &self.geometry,
            zone: &self.zone,
            height_max_mm: self.height_max_mm,
            rounding: self.rounding,
            reference_travel_mm: pass.first.travel_mm,
            travel_sigma: pass.last.sigma_since(&pass.first),
            silhouette,
            enclosing: false,
            top_motion: top_motion.filter(|_| corners),
            view_stride: 1,
        }
    }

    fn corners(&self, slot: usize) -> &[Corner] {
        &self.corners[slot * CORNERS..][..CORNERS]
    }

    /// The cuboid at belt position `at`, by the current estimate.
    pub fn outline(&self, slot: usize, at: BeltPosition) -> Option<Outline> {
        let pass = &self.passes[slot];
        let estimate = pass.estimate.as_ref()?;
        Some(Outline::new(&self.geometry, &estimate.params, at.travel_mm - pass.first.travel_mm))
    }

    /// The cuboid at belt position `at` by the current estimate, as parameters.
    pub fn params(&self, slot: usize, at: BeltPosition) -> Option<Params> {
        let pass = &self.passes[slot];
        let mut params = pass.estimate.as_ref()?.params;
        params[X] += params[SCALE] * (at.travel_mm - pass.first.travel_mm);
        Some(params)
    }

    /// The final estimate, X at belt position `at`, length >= width.
    pub fn finish(&mut self, slot: usize, at: BeltPosition) -> Option<Measured> {
        // Nothing is left of a pass that ends as expected.
        while self.passes[slot].search.jobs_left() > 0 {
            self.search_jobs(slot, 1);
        }
        let (cuboid, disputed) = self.cuboid(slot);
        let mut result = match cuboid {
            Some(cuboid) if is_box(&cuboid) => {
                Measured { estimate: cuboid, is_box: true, has_edges: true, disputed, rival: None }
            }
            other => {
                let enclosing = self.enclosing(slot);
                let estimate = enclosing.or(other).or(self.passes[slot].estimate)?;
                let has_edges = other.is_some_and(|e| e.edge_count > 0);
                Measured { estimate, is_box: false, has_edges, disputed: false, rival: None }
            }
        };
        let travel = at.travel_mm - self.passes[slot].first.travel_mm;
        let params = &mut result.estimate.params;
        params[X] += params[SCALE] * travel;
        result.estimate = canonical_estimate(result.estimate);
        Some(result)
    }

    /// The cuboid that edges and corners show, and whether they dispute its height. Corners that
    /// lead away from the edges are not on the top face.
    fn cuboid(&self, slot: usize) -> (Option<Estimate>, bool) {
        let views = self.views(slot);
        let refine = |found: Found, corners: bool| {
            let problem = self.problem(slot, found.silhouette, corners);
            let start = found.estimate.params;
            let edges = problem.fit_edges(views, start);
            edges
                .filter(|e| e.edge_count >= EDGE_COUNT_MIN)
                .or_else(|| problem.fit_reach(views, Some(start)))
        };
        let search = &self.passes[slot].search;
        let Some(found) = search.with_corners() else { return (None, false) };
        let both = refine(found, true);
        let problem = self.problem(slot, found.silhouette, true);
        let (Some(both), Some(_)) = (both, problem.top_motion) else { return (both, false) };
        if is_box(&both) {
            let edges = self.problem(slot, found.silhouette, false).on_some_of(views);
            let edges = edges.fit_edges(views, both.params);
            return (Some(both), edges.is_some_and(|e| e.disputes_height(&both)));
        }
        // Texture above a box's top there is not: it is no box then.
        let edges = search.without_corners().and_then(|found| refine(found, false));
        let edges = edges.filter(|edges| {
            edges.edge_count > 0
                && both.params[HEIGHT] < edges.params[HEIGHT]
                && both.score() < LED_AWAY_SCORE * edges.score()
        });
        (edges.or(Some(both)), edges.is_some_and(|e| e.disputes_height(&both)))
    }

    /// The smallest cuboid that holds the whole blob, or its bright part, whichever fits better.
    fn enclosing(&self, slot: usize) -> Option<Estimate> {
        let fits = [Silhouette::Whole, Silhouette::Bright]
            .map(|silhouette| self.problem(slot, silhouette, true).fit_enclosing(self.views(slot)));
        fits.into_iter().flatten().max_by(|a, b| a.score().total_cmp(&b.score()))
    }
}

fn is_box(cuboid: &Estimate) -> bool {
    let faint =
        cuboid.edge_share >= FAINT_EDGE_SHARE_MIN && cuboid.reach_error <= FAINT_REACH_ERROR_MAX;
    cuboid.edge_share >= BOX_EDGE_SHARE_MIN || faint
}

#[cfg(test)]
mod tests {
    use super::fit::{Estimate, Problem, Silhouette, canonical_estimate};
    use super::*;
    use crate::units::BeltMm;
    use nalgebra::Vector2;

    const ZONE: BeltRect =
        BeltRect { x_min_mm: -600.0, x_max_mm: 600.0, y_min_mm: -400.0, y_max_mm: 400.0 };

    fn geometry() -> BeltView {
        BeltView {
            size_px: [1000, 600],
            mm_per_px: 1.5,
            origin: BeltMm { x: -750.0, y: 450.0 },
            nadir: Vector2::new(0.0, 0.0),
            camera_height_mm: 1500.0,
        }
    }

    /// Views of a pass of `truth` over the zone, X at the middle of the pass.
    fn pass(truth: &Params, distort: impl Fn(usize) -> f32) -> Vec<PassView> {
        let travels = (-20..=20).map(|i| f64::from(i) * 25.0);
        travels
            .enumerate()
            .map(|(n, travel)| {
                PassView::of(&Outline::new(&geometry(), truth, travel), travel, |i| {
                    distort(n * 64 + i)
                })
            })
            .collect()
    }

    fn problem(geometry: &BeltView, travel_sigma: f64) -> Problem<'_> {
        Problem {
            geometry,
            zone: &ZONE,
            height_max_mm: 400.0,
            rounding: Rounding::default(),
            reference_travel_mm: 0.0,
            travel_sigma,
            silhouette: Silhouette::Whole,
            enclosing: false,
            top_motion: None,
            view_stride: 1,
        }
    }

    fn fit(views: &[PassView], travel_sigma: f64) -> Option<Estimate> {
        let geometry = geometry();
        let problem = problem(&geometry, travel_sigma);
        let mut search = Search::NEW;
        while search.jobs_left() > 0 {
            search.step(|silhouette, _| Problem { silhouette, ..problem }, views, None, is_box);
        }
        let start = search.with_corners()?.estimate.params;
        problem.fit_edges(views, start).map(canonical_estimate)
    }

    fn assert_near(estimate: &Estimate, truth: &Params, tolerance_mm: f64) {
        let truth = model::canonical(*truth);
        for i in [X, Y, LENGTH, WIDTH, HEIGHT] {
            let error = estimate.params[i] - truth[i];
            assert!(error.abs() < tolerance_mm, "parameter {i}: {error:+.3} mm, {estimate:?}");
        }
    }

    /// Deterministic noise with a standard deviation of about 0.5 px.
    fn noise(i: usize) -> f32 {
        let bits = (i as u32).wrapping_mul(2_654_435_761) >> 8;
        (bits as f32 / (1 << 24) as f32 - 0.5) * 1.7
    }

    fn cuboid(y: f64, yaw_deg: f64, [l, w, h]: [f64; 3]) -> Params {
        Params::from([0.0, y, yaw_deg.to_radians(), l, w, h, 1.0])
    }

    // The only errors of a perfect pass are f32 storage (1e-4 mm) and the prior on the height.
    const EXACT_MM: f64 = 0.05;

    #[test]
    fn a_perfect_pass_is_fitted_exactly() {
        for yaw_deg in [-80.0, -35.0, 10.0, 45.0, 60.0] {
            let truth = cuboid(120.0, yaw_deg, [235.0, 125.0, 70.0]);
            let estimate = fit(&pass(&truth, |_| 0.0), 3e-4).expect("fits");
            assert_near(&estimate, &truth, EXACT_MM);
        }
    }

    #[test]
    fn noise_of_half_a_mm_leaves_tenths_and_the_sigma_says_so() {
        let truth = cuboid(-150.0, 25.0, [330.0, 105.0, 140.0]);
        let estimate = fit(&pass(&truth, noise), 3e-4).expect("fits");
        assert_near(&estimate, &truth, 0.3);
        assert!((0.3..1.5).contains(&estimate.sigma[HEIGHT]), "{estimate:?}");
    }

    #[test]
    fn a_wrong_belt_speed_is_found_from_base_and_top_edges() {
        let truth = cuboid(200.0, 30.0, [300.0, 200.0, 150.0]);
        let mut fast = truth;
        fast[SCALE] = 1.03;
        // The prior knows nothing better than 3 %.
        let estimate = fit(&pass(&fast, |_| 0.0), 0.03).expect("fits");
        assert!((estimate.params[SCALE] - 1.03).abs() < 0.002, "{estimate:?}");
        assert_near(&estimate, &fast, 3.0);
    }

    #[test]
    fn parallel_to_the_belt_is_no_special_case() {
        for yaw_deg in [0.0, 90.0] {
            let truth = cuboid(100.0, yaw_deg, [200.0, 150.0, 90.0]);
            assert_near(&fit(&pass(&truth, |_| 0.0), 3e-4).expect("fits"), &truth, EXACT_MM);
        }
    }

    #[test]
    fn a_square_footprint_has_some_yaw_and_the_right_size() {
        let truth = cuboid(100.0, 30.0, [60.0, 60.0, 15.0]);
        let estimate = fit(&pass(&truth, |_| 0.0), 3e-4).expect("fits");
        assert!((estimate.params[LENGTH] - 60.0).abs() < EXACT_MM);
        assert!((estimate.params[WIDTH] - 60.0).abs() < EXACT_MM);
    }

    #[test]
    fn an_envelope_is_measured() {
        let truth = cuboid(-190.0, -18.0, [240.0, 160.0, 4.0]);
        assert_near(&fit(&pass(&truth, |_| 0.0), 3e-4).expect("fits"), &truth, 0.2);
    }

    #[test]
    fn a_pass_right_under_the_camera_is_measured() {
        let truth = cuboid(0.0, 20.0, [200.0, 100.0, 50.0]);
        assert_near(&fit(&pass(&truth, |_| 0.0), 3e-4).expect("fits"), &truth, EXACT_MM);
    }

    #[test]
    fn a_quarter_of_wild_edges_does_no_harm() {
        let truth = cuboid(150.0, 40.0, [250.0, 150.0, 100.0]);
        let wild = |i: usize| if i.is_multiple_of(4) { 30.0 * noise(i) } else { 0.3 * noise(i) };
        assert_near(&fit(&pass(&truth, wild), 3e-4).expect("fits"), &truth, 0.5);
    }

    #[test]
    fn an_enclosing_cuboid_holds_what_fills_it_only_in_part() {
        let truth = cuboid(120.0, 30.0, [235.0, 125.0, 70.0]);
        let mut views = pass(&truth, |_| 0.0);
        // A round end: four of the directions reach 8 mm less.
        for reach in views.iter_mut().flat_map(|v| v.reach_mm.iter_mut()) {
            for k in [1, 2, 7, 8] {
                reach[k] -= 8.0;
            }
        }
        let geometry = geometry();
        let problem = Problem { top_motion: None, ..problem(&geometry, 3e-4) };
        let [filling, enclosing] = [problem.fit_reach(&views, None), problem.fit_enclosing(&views)]
            .map(|e| e.expect("fits"));
        let short = |e: &Estimate| {
            let e = canonical_estimate(*e);
            [LENGTH, WIDTH].map(|i| truth[i] - e.params[i]).into_iter().fold(0.0, f64::max)
        };
        assert!(short(&enclosing) < 1.0, "{enclosing:?}");
        assert!(short(&filling) > short(&enclosing) + 1.0, "{filling:?}");
        assert!(enclosing.sigma[LENGTH] > 3.0);
    }

    #[test]
    fn corners_decide_the_height_that_edges_leave_open() {
        let truth = cuboid(120.0, 30.0, [235.0, 125.0, 70.0]);
        let mut low = truth;
        low[HEIGHT] = 64.0;
        let geometry = geometry();
        let ratio = geometry.magnification(70.0);
        let top_motion = Some(corners::TopMotion::certain(ratio));
        let problem = Problem { top_motion, ..problem(&geometry, 3e-4) };
        let views = pass(&truth, |_| 0.0);
        let fit = |problem: &Problem<'_>, views: &[PassView]| {
            problem.fit_edges(views, truth).expect("fits")
        };
        let edges_alone = Problem { top_motion: None, ..problem };
        let both = fit(&problem, &views);
        assert!((both.params[HEIGHT] - 70.0).abs() < EXACT_MM);
        assert!(!both.disputes_height(&fit(&edges_alone, &views)));
        // Edges of a parcel 6 mm lower than its corners say: one of them is wrong.
        let views = pass(&low, |_| 0.0);
        let both = fit(&problem, &views);
        assert!(both.params[HEIGHT] > 66.0, "{both:?}");
        assert!(both.disputes_height(&fit(&edges_alone, &views)));
    }

    #[test]
    fn no_views_or_views_that_show_nothing_give_no_estimate() {
        assert!(fit(&[], 3e-4).is_none());
        assert!(fit(&vec![PassView::EMPTY; 5], 3e-4).is_none());
    }

    #[test]
    fn a_single_view_gives_no_false_certainty() {
        let truth = cuboid(150.0, 40.0, [250.0, 150.0, 100.0]);
        let one = &pass(&truth, |_| 0.0)[20..21];
        if let Some(estimate) = fit(one, 3e-4) {
            assert!(estimate.sigma[HEIGHT] > 3.0, "{estimate:?}");
        }
    }
}
