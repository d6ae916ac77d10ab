//! Fitting the cuboid to a whole pass: damped Gauss-Newton, bounded, without heap.
//!
//! First the silhouettes alone (how far the blob reaches in each direction), from several
//! start heights; then the edges, each profile's step chosen by the model, within a gate that
//! closes. The silhouettes stay in with low weight: they guard the choice of edges.
//! Source: Nocedal and Wright, chapter 10; Huber 1964 and Tukey's biweight for outliers.

use super::corners::TopMotion;
use super::dissent::Dissent;
use super::model::{
    DIRECTIONS, EDGES, EdgeId, HEIGHT, LENGTH, N, Outline, Params, Rounding, SCALE, WIDTH, X, Y,
    YAW, canonical, direction,
};
use super::observe::{EdgeSample, PassView};
use super::shadow::DarkEdge;
use super::votes::{RISING_TRUST, SLOPE_ENOUGH, choose};
use crate::camera::BeltView;
use crate::units::BeltRect;
use nalgebra::{SMatrix, SVector, Vector2};

/// Blobs are good to a few mm: threshold, shadows, morphology.
const REACH_SIGMA_MM: f64 = 3.0;
/// When edges are there, blobs only guard.
const REACH_GUARD_SIGMA_MM: f64 = 12.0;
/// Edges are good to a third of a pixel; more is modelling error.
const EDGE_SIGMA_PX: f64 = 0.35;
/// The gate around a predicted edge, px, closing with the iterations.
pub(super) const GATES_PX: [f64; 12] = [6.0, 6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0];
/// From here on the gates suit a start that was found among others.
const NEAR_GATE: usize = 4;
/// An edge's polarity is settled once the gate is this narrow, px.
const POLARITY_GATE_PX: f64 = 5.0;
/// A base edge nearer than this to its top edge cannot be told from it.
pub(super) const SIDE_DEPTH_MIN_PX: f64 = 4.0;
/// A side narrower than this does not disturb its top edge.
const SIDE_DEPTH_NONE_PX: f64 = 0.3;
/// Contact shadows pull base edges outward by a pixel or two: they count this much.
const BASE_TRUST: f64 = 0.2;
/// In between, a top edge counts this much: enough when there is nothing better.
const NARROW_SIDE_TRUST: f64 = 0.05;
/// A step from a dark parcel's top straight to a brighter belt may be the border of its contact
/// shadow: it counts this much.
const SHADOW_TRUST: f64 = 0.2;
/// Views that are enough to choose the right start.
const SEARCH_VIEWS: usize = 20;
/// A mean square silhouette residual that costs half of a fit's contrast. Shadows alone make 10
/// of it.
const REACH_ERROR_HALVES: f64 = 50.0;
/// Where an enclosing cuboid is larger than what it encloses, that counts this much.
const INSIDE_WEIGHT: f64 = 0.1;
/// Profiles on neighbouring places and frames share their errors; this many count as one.
pub(super) const CORRELATED_SAMPLES: f64 = 20.0;
/// Below this no dimension is trusted, mm: lens model, edge rounding.
const SIGMA_FLOOR_MM: f64 = 0.3;
/// The height from edges alone depends twice as much on their rounding, and on shadows.
const EDGE_HEIGHT_SIGMA_MM: f64 = 0.8;
/// What a shape that is no box leaves open.
const ENCLOSING_SIGMA_MM: f64 = 4.0;
/// Witnesses of a height that differ by more than so many sigma do not mean the same top face.
pub(super) const DISPUTED_SIGMA: f64 = 3.0;
/// Dimensions below this are no parcel.
const SIDE_MIN_MM: f64 = 5.0;

/// What a fit needs besides the views.
#[derive(Clone, Copy, Debug)]
pub struct Problem<'a> {
    /// Belt view geometry.
    pub geometry: &'a BeltView,
    /// Only what is over this part of the belt is used.
    pub zone: &'a BeltRect,
    /// Upper bound of the height.
    pub height_max_mm: f64,
    /// What the edges' radius does to them.
    pub rounding: Rounding,
    /// Travel at which X holds.
    pub reference_travel_mm: f64,
    /// Relative standard uncertainty of the travel.
    pub travel_sigma: f64,
    /// Which silhouettes: of the whole blob, or without its dark parts.
    pub silhouette: Silhouette,
    /// The cuboid need not fill the silhouettes, but hold them.
    pub enclosing: bool,
    /// What corners on the top face tell.
    pub top_motion: Option<TopMotion>,
    /// Only every so many views are looked at.
    pub view_stride: usize,
}

/// Which of a view's reaches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Silhouette {
    /// The whole blob: right for dark parcels.
    Whole,
    /// Without dark parts: right for bright parcels with deep shadows.
    Bright,
}

/// A fitted cuboid.
#[derive(Clone, Copy, Debug)]
pub struct Estimate {
    /// The parameters, at the reference travel.
    pub params: Params,
    /// Standard deviations of the parameters.
    pub sigma: Params,
    /// Share of the profiles that have a step at the model's edge, 0 to 1.
    pub edge_share: f64,
    /// Profiles used.
    pub edge_count: usize,
    /// Contrast found where the model has edges: what tells a right fit from a wrong one.
    pub edge_contrast: f64,
    /// Weighted mean square of the silhouette residuals, in units of their sigma.
    pub reach_error: f64,
}

/// Sums of a least squares problem.
#[derive(Clone)]
struct Normal {
    matrix: SMatrix<f64, N, N>,
    vector: SVector<f64, N>,
    cost: f64,
}

impl Normal {
    fn new() -> Self {
        Self { matrix: SMatrix::zeros(), vector: SVector::zeros(), cost: 0.0 }
    }

    /// Add `weight * residual^2`; `row` is the derivative of the prediction.
    fn add(&mut self, residual: f64, row: &SVector<f64, N>, weight: f64) {
        for (mut column, &value) in self.matrix.column_iter_mut().zip(row) {
            column += row * (weight * value);
        }
        self.vector += row * (weight * residual);
        self.cost += weight * residual * residual;
    }

    /// Damped step.
    fn solve(&self, damping: f64) -> Option<SVector<f64, N>> {
        let mut damped = self.matrix;
        for i in 0..N {
            damped[(i, i)] *= 1.0 + damping;
        }
        damped.cholesky().map(|c| c.solve(&self.vector))
    }
}

/// Sums of the slopes' signs for each edge: above a hidden side, and above a visible one. A dark
/// parcel's edge is darker than the belt and brighter than the side under it.
type Polarity = [[f64; 2]; EDGES];

/// Statistics of the edges used in one iteration.
#[derive(Clone, Copy, Debug, Default)]
struct EdgeUse {
    offered: usize,
    used: usize,
    squares: f64,
    contrast: f64,
    /// For each edge.
    polarity: Polarity,
    /// For each edge of the top face.
    dark: [DarkEdge; EDGES / 2],
    /// For each edge of the top face.
    dissent: [Dissent; EDGES / 2],
}

impl Estimate {
    /// Whether another estimate puts the top face elsewhere, beyond what both leave open.
    pub fn disputes_height(&self, other: &Self) -> bool {
        let sigma_mm = self.sigma[HEIGHT].hypot(other.sigma[HEIGHT]);
        (self.params[HEIGHT] - other.params[HEIGHT]).abs() > DISPUTED_SIGMA * sigma_mm
    }

    /// How much another estimate of the same parcel is off in length, width and height together, mm.
    pub fn off_mm(&self, other: &Self) -> f64 {
        [LENGTH, WIDTH, HEIGHT].map(|k| (self.params[k] - other.params[k]).abs()).iter().sum()
    }

    /// What tells a right fit from a wrong one: contrast, less what the silhouettes disagree; of
    /// silhouettes alone, their agreement.
    pub fn score(&self) -> f64 {
        if self.edge_count == 0 {
            return -self.reach_error;
        }
        self.edge_contrast / (1.0 + self.reach_error / REACH_ERROR_HALVES)
    }
}

impl Problem<'_> {
    /// Where a view should show the edges of a cuboid.
    pub(super) fn outline(&self, view: &PassView, params: &Params) -> Outline {
        let travel_mm = view.travel_mm - self.reference_travel_mm;
        Outline::rounded(self.geometry, self.rounding, params, travel_mm)
    }

    /// The same on as many views as are enough to choose a start.
    pub(super) fn on_some_of(&self, views: &[PassView]) -> Self {
        Self { view_stride: (views.len() / SEARCH_VIEWS).max(1), ..*self }
    }

    /// The views with profiles.
    pub(super) fn sampled<'v>(&self, views: &'v [PassView]) -> impl Iterator<Item = &'v PassView> {
        views.iter().filter(|v| !v.samples().is_empty()).step_by(self.view_stride)
    }

    /// Fit silhouettes only, from `start`, near as it is, or from scratch.
    pub fn fit_reach(&self, views: &[PassView], start: Option<Params>) -> Option<Estimate> {
        let start = start.or_else(|| self.on_some_of(views).reach_start(views))?;
        let (_, params) = self.descend(views, start, 4);
        let (normal, reach_error) = self.reach_normal(views, &params);
        self.estimate(params, &normal, reach_error, &EdgeUse::default())
    }

    /// The best of starts of different height.
    fn reach_start(&self, views: &[PassView]) -> Option<Params> {
        let heights = [0.1, 0.35, 0.75].map(|share| share * self.height_max_mm);
        let starts = heights.into_iter().filter_map(|mm| self.start(views, mm));
        let ends = starts.map(|start| self.descend(views, start, 8));
        let finite = ends.filter(|(cost, _)| cost.is_finite());
        finite.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, params)| params)
    }

    /// The smallest upright cuboid that holds the silhouettes, as high as the highest texture.
    pub fn fit_enclosing(&self, views: &[PassView]) -> Option<Estimate> {
        let highest = |top: TopMotion| TopMotion { ratio: top.highest, ..top };
        let enclosing = Self { enclosing: true, top_motion: self.top_motion.map(highest), ..*self };
        let mut estimate = enclosing.fit_reach(views, None)?;
        for i in [X, Y, LENGTH, WIDTH, HEIGHT] {
            estimate.sigma[i] = estimate.sigma[i].hypot(ENCLOSING_SIGMA_MM);
        }
        Some(estimate)
    }

    /// Fit edges on all views from a start that was searched.
    pub fn fit_edges(&self, views: &[PassView], start: Params) -> Option<Estimate> {
        self.refine_edges(views, start, &GATES_PX[NEAR_GATE..])
    }

    /// Gauss-Newton on the edges, the gate closing.
    pub(super) fn refine_edges(
        &self,
        views: &[PassView],
        start: Params,
        gates_px: &[f64],
    ) -> Option<Estimate> {
        let mut params = start;
        let mut polarity = [[0.0; 2]; EDGES];
        let mut last = None;
        for &gate_px in gates_px {
            let gate_mm = gate_px * self.geometry.mm_per_px;
            let mut edges = self.priors(&params);
            let used = self.add_edges(views, &params, gate_mm, &polarity, &mut edges);
            let mut guarded = edges.clone();
            let reach_error = self.add_reach(views, &params, REACH_GUARD_SIGMA_MM, &mut guarded);
            if gate_px <= POLARITY_GATE_PX {
                polarity = used.polarity;
            }
            params = self.bounded(params, params + guarded.solve(1e-6)?);
            last = Some((edges, reach_error, used));
        }
        // Silhouettes are biased by shadows: they guide, but make nothing more certain.
        let (normal, reach_error, used) = last?;
        self.estimate(params, &normal, reach_error, &used)
    }

    /// The cuboid with its four faces moved outward.
    pub(super) fn moved(&self, params: Params, [front, left, back, right]: [f64; 4]) -> Params {
        let (sin, cos) = params[YAW].sin_cos();
        let (along, across) = (0.5 * (front - back), 0.5 * (left - right));
        let mut moved = params;
        moved[LENGTH] += front + back;
        moved[WIDTH] += left + right;
        moved[X] += cos * along - sin * across;
        moved[Y] += sin * along + cos * across;
        self.bounded(params, moved)
    }

    fn estimate(
        &self,
        params: Params,
        normal: &Normal,
        reach_error: f64,
        used: &EdgeUse,
    ) -> Option<Estimate> {
        if params.iter().any(|p| !p.is_finite()) {
            return None;
        }
        let covariance = normal.matrix.cholesky()?.inverse();
        // Residuals larger than assumed widen the result; smaller ones do not narrow it.
        let edge_sigma = EDGE_SIGMA_PX * self.geometry.mm_per_px;
        let excess = if used.used > 0 {
            (used.squares / used.used as f64 / (edge_sigma * edge_sigma)).max(1.0)
        } else {
            reach_error.max(1.0)
        };
        let mut variance = covariance.diagonal().map(|v| excess * v.max(0.0));
        let step_sigma = excess.sqrt() * edge_sigma;
        let by_shadow = |dark: &DarkEdge| {
            (*dark.rows(), dark.sigma_mm(params[HEIGHT], step_sigma, self.geometry.mm_per_px))
        };
        let by_others = |dissent: &Dissent| (*dissent.rows(), dissent.sigma_mm());
        let open = used.dark.iter().map(by_shadow).chain(used.dissent.iter().map(by_others));
        for (rows, open_mm) in open {
            let off = covariance * rows * open_mm / (CORRELATED_SAMPLES * edge_sigma * edge_sigma);
            variance += off.component_mul(&off);
        }
        let mut sigma = variance.map(f64::sqrt);
        for i in [X, Y, LENGTH, WIDTH, HEIGHT] {
            sigma[i] = sigma[i].hypot(SIGMA_FLOOR_MM);
        }
        if self.top_motion.is_none() {
            sigma[HEIGHT] = sigma[HEIGHT].hypot(EDGE_HEIGHT_SIGMA_MM);
        }
        Some(Estimate {
            params,
            sigma,
            edge_share: if used.offered > 0 { used.used as f64 / used.offered as f64 } else { 0.0 },
            edge_count: used.used,
            edge_contrast: used.contrast,
            reach_error,
        })
    }

    /// A start from all views: how far the parcel reaches in each direction, its motion taken
    /// out, and the direction of least bounding area. No view need show both ends.
    fn start(&self, views: &[PassView], height_mm: f64) -> Option<Params> {
        let m = self.geometry.magnification(height_mm);
        let reach = |k: usize| {
            let (k, d) = (k % DIRECTIONS, direction(k % DIRECTIONS));
            let (mut sum, mut count) = (0.0, 0);
            for view in views {
                let reach_mm = f64::from(view.reach_mm[self.silhouette as usize][k]);
                if reach_mm.is_finite() {
                    sum += reach_mm - m * d.x * (view.travel_mm - self.reference_travel_mm);
                    count += 1;
                }
            }
            sum / f64::from(count) // NaN without a view
        };
        let reaches: [f64; DIRECTIONS] = std::array::from_fn(reach);
        let extent =
            |k: usize| reaches[k % DIRECTIONS] + reaches[(k + DIRECTIONS / 2) % DIRECTIONS];
        let quarter = DIRECTIONS / 4;
        let area = |k: usize| extent(k) * extent(k + quarter);
        let k = (0..quarter)
            .filter(|&k| area(k).is_finite())
            .min_by(|&a, &b| area(a).total_cmp(&area(b)))?;
        let middle = |k: usize| 0.5 * (reaches[k] - reaches[k + DIRECTIONS / 2]);
        let image = direction(k) * middle(k) + direction(k + quarter) * middle(k + quarter);
        let centre = self.geometry.nadir + (image - self.geometry.nadir) / m;
        Some(Params::from([
            centre.x,
            centre.y,
            direction(k).y.atan2(direction(k).x),
            (extent(k) / m).max(SIDE_MIN_MM),
            (extent(k + quarter) / m).max(SIDE_MIN_MM),
            height_mm,
            1.0,
        ]))
    }

    /// Levenberg-Marquardt on the silhouettes.
    fn descend(&self, views: &[PassView], start: Params, iterations: usize) -> (f64, Params) {
        let (mut params, mut damping) = (start, 1e-3);
        let (mut normal, _) = self.reach_normal(views, &params);
        for _ in 0..iterations {
            let Some(step) = normal.solve(damping) else { break };
            let next = self.bounded(params, params + step);
            let (next_normal, _) = self.reach_normal(views, &next);
            if next_normal.cost < normal.cost {
                (params, normal, damping) = (next, next_normal, damping * 0.2);
            } else {
                damping *= 10.0;
            }
        }
        (normal.cost, params)
    }

    /// Keep a step inside what a parcel can be.
    fn bounded(&self, from: Params, to: Params) -> Params {
        let mut to = to;
        to[YAW] = from[YAW] + (to[YAW] - from[YAW]).clamp(-0.3, 0.3);
        for i in [LENGTH, WIDTH] {
            to[i] = to[i].clamp(SIDE_MIN_MM, 20_000.0);
        }
        to[HEIGHT] = to[HEIGHT].clamp(0.0, 1.1 * self.height_max_mm);
        to[SCALE] = to[SCALE].clamp(0.8, 1.25);
        to
    }

    /// What is known before anything is seen.
    fn priors(&self, params: &Params) -> Normal {
        let mut normal = Normal::new();
        let axis = |i: usize| SVector::<f64, N>::ith(i, 1.0);
        normal.add(1.0 - params[SCALE], &axis(SCALE), self.travel_sigma.powi(-2));
        // Keeps the height determined while the baseline is still short.
        let middle = 0.25 * self.height_max_mm;
        normal.add(middle - params[HEIGHT], &axis(HEIGHT), (4.0 * middle).powi(-2));
        if let Some(top) = &self.top_motion {
            let m = self.geometry.magnification(params[HEIGHT]);
            let mut row = axis(SCALE) * m;
            row[HEIGHT] = params[SCALE] * m * m / self.geometry.camera_height_mm;
            normal.add(top.ratio - params[SCALE] * m, &row, top.sigma.powi(-2));
        }
        // Next to nothing, so that what no edge shows is uncertain instead of singular.
        for i in [X, Y, YAW, LENGTH, WIDTH] {
            normal.add(0.0, &axis(i), 1e-5);
        }
        normal
    }

    /// Priors and silhouettes.
    fn reach_normal(&self, views: &[PassView], params: &Params) -> (Normal, f64) {
        let mut normal = self.priors(params);
        let mean_square = self.add_reach(views, params, REACH_SIGMA_MM, &mut normal);
        (normal, mean_square)
    }

    /// Silhouette residuals (Huber). Returns their mean square, in units of the blobs' sigma.
    fn add_reach(
        &self,
        views: &[PassView],
        params: &Params,
        sigma_mm: f64,
        normal: &mut Normal,
    ) -> f64 {
        let (mut squares, mut count) = (0.0, 0);
        for view in views.iter().step_by(self.view_stride) {
            let outline = self.outline(view, params);
            let reach = &view.reach_mm[self.silhouette as usize];
            for (k, &reach) in reach.iter().enumerate().filter(|(_, r)| r.is_finite()) {
                let d = direction(k);
                let vertex = outline.support(d);
                let residual = f64::from(reach) - vertex.image.dot(&d);
                let row = vertex.jacobian.transpose() * d;
                let inside = if self.enclosing && residual < 0.0 { INSIDE_WEIGHT } else { 1.0 };
                let huber = inside * (1.5 * sigma_mm / residual.abs().max(1e-9)).min(1.0);
                normal.add(residual, &row, huber / (CORRELATED_SAMPLES * sigma_mm * sigma_mm));
                squares += huber * residual * residual;
                count += 1;
            }
        }
        squares / f64::from(count.max(1)) / (REACH_SIGMA_MM * REACH_SIGMA_MM)
    }

    /// Edge residuals (biweight) with the step that each profile offers within the gate.
    fn add_edges(
        &self,
        views: &[PassView],
        params: &Params,
        gate_mm: f64,
        polarity: &Polarity,
        normal: &mut Normal,
    ) -> EdgeUse {
        let mut used = EdgeUse::default();
        let sigma_mm = EDGE_SIGMA_PX * self.geometry.mm_per_px;
        let dissent_mm = POLARITY_GATE_PX * self.geometry.mm_per_px;
        for view in self.sampled(views) {
            let outline = self.outline(view, params);
            let trust: [[f64; 2]; EDGES] =
                std::array::from_fn(|e| self.trust(&outline, EdgeId(e as u8)));
            for sample in view.samples() {
                let e = usize::from(sample.edge.0);
                if trust[e][0].max(trust[e][1]) <= 0.0 {
                    continue;
                }
                let Some((at, row)) = self.predict(&outline, sample) else { continue };
                used.offered += 1;
                let facing = outline.side_visible[sample.edge.face()];
                let known = polarity[e][usize::from(facing)];
                let rising = if facing && !sample.edge.is_base() { RISING_TRUST } else { 1.0 };
                let steps = || sample.steps(self.geometry.mm_per_px);
                let top = (!sample.edge.is_base()).then_some(sample.edge.face());
                let Some((residual, slope)) = choose(steps(), at, gate_mm, known, rising) else {
                    let other = choose(steps(), at, dissent_mm, -known, rising);
                    // Before the edge's direction is known none is the other one.
                    let other = other.filter(|_| known != 0.0);
                    if let (Some(face), Some((residual, _))) = (top, other) {
                        used.dissent[face].add_other(residual);
                    }
                    continue;
                };
                used.used += 1;
                used.squares += residual * residual;
                used.polarity[e][usize::from(facing)] += f64::from(slope.signum());
                let share = residual / gate_mm;
                let biweight = (1.0 - share * share).powi(2);
                used.contrast += biweight * f64::from(slope.abs().min(SLOPE_ENOUGH)).ln_1p();
                let weight = trust[e][usize::from(slope > 0.0)] * biweight;
                normal.add(residual, &row, weight / (CORRELATED_SAMPLES * sigma_mm * sigma_mm));
                if let Some(face) = top {
                    used.dissent[face].add_used(residual, &row, weight);
                    if slope > 0.0 {
                        used.dark[face].add(residual, &row, weight);
                    }
                }
            }
        }
        used
    }

    /// How much an edge counts in one view, when it falls outward and when it rises.
    fn trust(&self, outline: &Outline, edge: EdgeId) -> [f64; 2] {
        let depth_px = outline.side_depth_mm(edge.face()) / self.geometry.mm_per_px;
        // A narrow side blurs its two edges into one place that is neither.
        let wide = depth_px > SIDE_DEPTH_MIN_PX;
        match (edge.is_base(), outline.side_visible[edge.face()]) {
            (true, true) if wide => [BASE_TRUST; 2],
            (true, _) => [0.0; 2],
            (false, true) if !wide && depth_px > SIDE_DEPTH_NONE_PX => [NARROW_SIDE_TRUST; 2],
            (false, true) => [1.0; 2],
            (false, false) if wide => [1.0, SHADOW_TRUST],
            (false, false) => [1.0, NARROW_SIDE_TRUST],
        }
    }

    /// Where the model's edge crosses a profile: offset from the anchor along `outward`, and
    /// its derivative. `None` when the profile misses the edge or that part is not in the zone.
    pub(super) fn predict(
        &self,
        outline: &Outline,
        sample: &EdgeSample,
    ) -> Option<(f64, SVector<f64, N>)> {
        let [a, b] = outline.ends(sample.edge);
        let anchor = Vector2::from(sample.anchor.map(f64::from));
        let outward = Vector2::from(sample.outward.map(f64::from));
        let along = b.image - a.image;
        let length = along.norm();
        let normal = Vector2::new(along.y, -along.x) / length;
        let facing = normal.dot(&outward);
        let t = (anchor - a.image).dot(&along) / (length * length);
        let over_belt = a.over_belt + (b.over_belt - a.over_belt) * t;
        let in_zone = self.zone.contains(over_belt.x, over_belt.y);
        // Near a corner the neighbouring edge takes over.
        if !(0.04..=0.96).contains(&t) || facing < 0.9 || !in_zone {
            return None;
        }
        let at = normal.dot(&(a.image - anchor)) / facing;
        let jacobian = a.jacobian * (1.0 - t) + b.jacobian * t;
        Some((at, jacobian.transpose() * normal / facing))
    }
}

/// An estimate's parameters with length >= width, and the sigmas in the same order.
pub fn canonical_estimate(mut estimate: Estimate) -> Estimate {
    if estimate.params[LENGTH] < estimate.params[WIDTH] {
        estimate.sigma.swap_rows(LENGTH, WIDTH);
    }
    estimate.params = canonical(estimate.params);
    estimate
}
