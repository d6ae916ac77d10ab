//! The fit on a pass that lies before one as a whole: no view was spoiled by an early, wrong estimate.

use super::corners::TopMotion;
use super::fit::{DISPUTED_SIGMA, Estimate, GATES_PX, Problem, Silhouette};
use super::model::{HEIGHT, LENGTH, Outline, Params, Rounding, SCALE, WIDTH, X, Y, YAW};
use super::observe::{Frame, PassView};
use super::{BOX_EDGE_SHARE_MIN, EDGE_COUNT_MIN, Measured};
use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::scalar::bits::words;
use crate::plan::{Block, Memory, Plan};
use crate::stage::parcels::{Cuboid, Face, NARROWER, Rectangle};
use crate::stage::views::{Kept, VIEWS_MAX, Views};
use crate::units::BeltRect;

/// A face's height from the evidence is good to this, mm.
const FACE_HEIGHT_SIGMA_MM: f64 = 6.0;
/// The sides of a face that is no cuboid's are good to this, mm.
const FACE_SIDE_SIGMA_MM: f64 = 5.0;
/// A border is the better one beyond doubt when the share of the edges that it explains is so much more.
const CLEARLY_BETTER: f64 = 0.03;
/// Lower than this is the belt, mm.
const HEIGHT_MIN_MM: f64 = 2.4;
/// Narrower than this is no parcel, mm.
const LINE_MM: f64 = 6.0;
/// Times that the profiles are taken anew, where the last fit has the edges.
const ROUNDS: usize = 3;
/// The same for a cuboid that was fitted before its pass was whole.
const ROUNDS_AGAIN: usize = 2;
/// The same for a border further inside, until it is seen to explain nearly as much.
const ROUNDS_RIVAL: usize = 1;

/// The fit, and its memory.
pub struct WholePass {
    geometry: BeltView,
    zone: BeltRect,
    height_max_mm: f64,
    rounding: Rounding,
    /// Bit mask of the view's pixels that the camera sees.
    seen: Block<u64>,
    /// Profiles in the views of one pass.
    pass: Block<PassView>,
}

impl WholePass {
    /// Memory for a view.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let mask = words(view.size_px[0]) * view.size_px[1];
        plan.add::<u64>("whole_pass.seen", mask, "bit: the camera sees it");
        plan.add::<PassView>("whole_pass.pass", VIEWS_MAX, "profiles in the views of one pass");
    }

    /// For a site. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        height_max_mm: f64,
        rounding: Rounding,
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        let mut mask = memory.take("whole_pass.seen", 0)?;
        mask.copy_from_slice(seen);
        let pass = memory.take("whole_pass.pass", PassView::EMPTY)?;
        let (geometry, zone) = (view.clone(), *zone);
        Ok(Self { geometry, zone, height_max_mm, rounding, seen: mask, pass })
    }

    /// Measure the parcel of a face from the views of its pass; X holds at the newest view's belt position. With it the
    /// first view that has any of it. None if the face is a cuboid's and the edges, now that all are seen, are none. What
    /// is no cuboid is as large as the face found of it.
    pub fn measure(&mut self, views: &Views, face: &Face) -> Option<(Measured, Kept)> {
        if face.is_cuboid {
            let mut fitted = self.fit(views, face).filter(|(measured, _)| measured.is_box)?;
            // It was over the belt by the views until then.
            fitted.0.disputed |= fitted.0.estimate.params[HEIGHT] < HEIGHT_MIN_MM;
            Some(fitted)
        } else {
            self.enclose(views, face)
        }
    }

    /// The cuboid that the edges around a face show, if it lies over the belt.
    pub fn cuboid(&mut self, views: &Views, face: &Face) -> Option<Cuboid> {
        let (measured, _) = self.fit_border(views, &face.rectangle, face.height_mm, ROUNDS)?;
        let p = &measured.estimate.params;
        // What lies on the belt itself, its texture or a label stuck to it, is no parcel.
        if p[HEIGHT] < HEIGHT_MIN_MM {
            return None;
        }
        let rectangle = Rectangle {
            x_mm: p[X] - views.kept(views.newest()?).at.travel_mm,
            y_mm: p[Y],
            yaw: p[YAW],
            length_mm: p[LENGTH],
            width_mm: p[WIDTH],
            ..face.rectangle
        };
        Some(Cuboid { rectangle, height_mm: p[HEIGHT], is_box: measured.is_box })
    }

    /// Fit a cuboid: of the borders that may be the face's the outermost, unless clearly more edges confirm another. Of
    /// those that nearly as many confirm, the one that differs most is its rival.
    fn fit(&mut self, views: &Views, face: &Face) -> Option<(Measured, Kept)> {
        let share = |(measured, _): &(Measured, Kept)| measured.estimate.edge_share;
        let mut fit = |border, rounds| self.fit_border(views, border, face.height_mm, rounds);
        let mut best = fit(&face.rectangle, ROUNDS_AGAIN);
        let mut others = heapless::Vec::<Estimate, NARROWER>::new();
        for border in face.narrower.iter().flatten() {
            let known = best.as_ref().map_or(0.0, share);
            if fit(border, ROUNDS_RIVAL).is_none_or(|first| share(&first) <= known - CLEARLY_BETTER)
            {
                continue;
            }
            let mut other = fit(border, ROUNDS);
            if other.as_ref().is_some_and(|other| share(other) > known + CLEARLY_BETTER) {
                std::mem::swap(&mut other, &mut best);
            }
            if let Some((other, _)) = other {
                // There are as many at most as there are borders.
                let _ = others.push(other.estimate);
            }
        }
        let mut best = best?;
        let least = (share(&best) - CLEARLY_BETTER).max(BOX_EDGE_SHARE_MIN);
        let off_mm = |other: &Estimate| best.0.estimate.off_mm(other);
        let rivals = others.into_iter().filter(|other| other.edge_share > least);
        let rival = rivals.max_by(|a, b| off_mm(a).total_cmp(&off_mm(b)));
        best.0.rival = rival;
        Some(best)
    }

    fn enclose(&mut self, views: &Views, face: &Face) -> Option<(Measured, Kept)> {
        let newest = views.kept(views.newest()?).at;
        let params = Self::params_of(&face.rectangle, face.height_mm, newest.travel_mm);
        let (_, first) = self.look(views, &params, newest.travel_mm);
        let mut sigma = Params::zeros();
        for k in [X, Y, LENGTH, WIDTH] {
            sigma[k] = FACE_SIDE_SIGMA_MM;
        }
        sigma[HEIGHT] = FACE_HEIGHT_SIGMA_MM;
        let estimate = Estimate {
            params,
            sigma,
            edge_share: face.rectangle.support(),
            edge_count: 0,
            edge_contrast: 0.0,
            reach_error: 0.0,
        };
        let measured =
            Measured { estimate, is_box: false, has_edges: true, disputed: false, rival: None };
        Some((measured, first?))
    }

    /// The cuboid of a face when the belt has travelled so far.
    fn params_of(border: &Rectangle, height_mm: f64, travel_mm: f64) -> Params {
        let mut params = Params::zeros();
        params[X] = border.x_mm + travel_mm;
        params[Y] = border.y_mm;
        params[YAW] = border.yaw;
        params[LENGTH] = border.length_mm;
        params[WIDTH] = border.width_mm;
        params[HEIGHT] = height_mm;
        params[SCALE] = 1.0;
        params
    }

    fn fit_border(
        &mut self,
        views: &Views,
        border: &Rectangle,
        height_mm: f64,
        rounds: usize,
    ) -> Option<(Measured, Kept)> {
        let newest = views.kept(views.newest()?).at;
        let mut params = Self::params_of(border, height_mm, newest.travel_mm);
        let m = self.geometry.magnification(height_mm);
        let sigma = m * m / self.geometry.camera_height_mm * FACE_HEIGHT_SIGMA_MM;
        // The face's height was found with the same travel: it is as wrong as that.
        let top_motion = |travel_sigma: f64| TopMotion {
            ratio: m,
            sigma: sigma.hypot(m * travel_sigma),
            highest: m,
        };
        let geometry = self.geometry.clone();
        let zone = self.zone;
        let mut problem = Problem {
            geometry: &geometry,
            zone: &zone,
            height_max_mm: self.height_max_mm,
            rounding: self.rounding,
            reference_travel_mm: newest.travel_mm,
            travel_sigma: 1.0,
            silhouette: Silhouette::Whole,
            enclosing: false,
            top_motion: None,
            view_stride: 1,
        };
        let mut best: Option<(Estimate, Kept)> = None;
        for round in 0..rounds {
            let (count, first) = self.look(views, &params, newest.travel_mm);
            let (pass, first) = (&self.pass[..count], first?);
            problem.travel_sigma = newest.sigma_since(&first.at);
            problem.top_motion = Some(top_motion(problem.travel_sigma));
            let fitted = if round == 0 {
                problem.refine_edges(pass, params, &GATES_PX)
            } else {
                problem.fit_edges(pass, params)
            };
            let Some(fitted) = fitted else { break };
            params = fitted.params;
            best = Some((fitted, first));
        }
        let (estimate, first) = best.filter(|(estimate, _)| estimate.edge_count > 0)?;
        // What has shrunk to a line was one: the border of a shadow, a seam.
        if estimate.params[LENGTH].min(estimate.params[WIDTH]) < LINE_MM {
            return None;
        }
        let has_edges = estimate.edge_count >= EDGE_COUNT_MIN;
        let is_box = estimate.edge_share >= BOX_EDGE_SHARE_MIN;
        let off_mm = (estimate.params[HEIGHT] - height_mm).abs();
        let disputed = off_mm > DISPUTED_SIGMA * FACE_HEIGHT_SIGMA_MM.hypot(estimate.sigma[HEIGHT]);
        Some((Measured { estimate, is_box, has_edges, disputed, rival: None }, first))
    }

    /// Take profiles across a cuboid's edges in every view that has any of it in the zone. Returns how many these are,
    /// and the first of them.
    fn look(
        &mut self,
        views: &Views,
        params: &Params,
        reference_travel_mm: f64,
    ) -> (usize, Option<Kept>) {
        let (mut count, mut first) = (0, None);
        for place in views.places() {
            let travel_mm = views.kept(place).at.travel_mm;
            let outline = Outline::new(&self.geometry, params, travel_mm - reference_travel_mm);
            let frame = Frame {
                view: &self.geometry,
                zone: &self.zone,
                grey: views.grey(place),
                seen: &self.seen,
                dark: &[],
            };
            let view = &mut self.pass[count];
            *view = PassView::EMPTY;
            view.travel_mm = travel_mm;
            frame.sample_edges(&outline, view);
            if !view.samples().is_empty() {
                count += 1;
                first = Some(views.kept(place));
            }
        }
        (count, first)
    }
}
