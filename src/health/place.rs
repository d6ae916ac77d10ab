//! Where the camera is, against where it was: a robust fit of its motion to what stands.

use super::edges::Point;
use super::geometry::{Motion, PARAMETERS, PRIOR_SIGMA};
use super::profile::Match;
use nalgebra::SMatrix;

/// Iterations of the reweighted fit.
const ITERATIONS: usize = 12;
/// From here on what lies far off counts nothing (Tukey); before that less (Huber).
const TUKEY_FROM: usize = 6;
/// In units of the residuals' spread.
const HUBER: f64 = 1.5;
const TUKEY: f64 = 4.7;
/// The residuals are never taken to be better than this, px.
const SPREAD_MIN_PX: f64 = 0.03;
/// An error that all profiles may share, in any pattern, px: lens model, depth, light.
const SHARED_PX: f64 = 0.02;
/// How far a camera that stands well turns or shifts, radians: about a fifth of a pixel.
const STILL_RAD: f64 = 2e-4;
/// How large a parameter may well be against the largest.
const MOVED_SHARE: f64 = 0.5;
/// The median of absolute residuals over their standard deviation.
const MEDIAN_TO_SIGMA: f64 = 1.4826;
/// A point that is nearer to the fit agrees with it: px, and a share of its motion, for it may be nearer or
/// further than the belt.
const AGREES_PX: f64 = 0.5;
const AGREES_SHARE: f64 = 0.1;

type Normal = SMatrix<f64, PARAMETERS, PARAMETERS>;

/// The camera's motion.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fitted {
    pub(super) motion: Motion,
    pub(super) covariance: Normal,
    /// Points that were found again.
    pub(super) found: usize,
    /// Of these, points that agree.
    pub(super) agree: usize,
    /// Of these, points that have not moved.
    pub(super) still: usize,
}

/// Fit the motion to the points. `scratch` has room for all of them.
pub(super) fn fit<'a>(
    points: &(impl Iterator<Item = (&'a Point, Option<&'a Match>)> + Clone),
    scratch: &mut [f32],
) -> Fitted {
    let found = || points.clone().filter_map(|(point, found)| found.map(|found| (point, found)));
    let count = found().count();
    let loose = Motion::from(PRIOR_SIGMA);
    let residual = |motion: &Motion, point: &Point, found: &Match| {
        f64::from(found.shift_px) - point.moved_px(motion)
    };
    let mut fitted = Fitted {
        motion: Motion::zeros(),
        covariance: Normal::from_diagonal(&loose.component_mul(&loose)),
        found: count,
        agree: 0,
        still: found().filter(|(_, found)| found.shift_px.abs() < AGREES_PX as f32).count(),
    };
    // What all of them share does not become less with their number.
    let shared_px = SHARED_PX * (count as f64).sqrt();
    let mut spread_px = f64::INFINITY;
    for iteration in 0..ITERATIONS {
        let motion = &fitted.motion;
        // A motion that little speaks for is none, unless the others are as large.
        let likely = STILL_RAD.max(MOVED_SHARE * motion.amax());
        let prior = Motion::repeat(likely.powi(-2));
        let noise_px = if spread_px.is_finite() { spread_px.hypot(shared_px) } else { 1.0 };
        let (mut seen, mut vector) = (Normal::zeros(), -prior.component_mul(motion));
        for (point, found) in found() {
            let row = point.rates();
            let off = residual(motion, point, found);
            // The first time all count alike: a shift of the whole picture is no outlier.
            let far = (off / spread_px).abs();
            let weight = if iteration < TUKEY_FROM {
                HUBER / far.max(HUBER)
            } else if far < TUKEY {
                (1.0 - (far / TUKEY).powi(2)).powi(2)
            } else {
                0.0
            };
            let weight = weight / (noise_px * noise_px);
            seen.ger(weight, &row, &row, 1.0);
            vector.axpy(weight * off, &row, 1.0);
        }
        let with = |prior: Motion| (seen + Normal::from_diagonal(&prior)).cholesky();
        let (Some(factor), Some(alone)) = (with(prior), with(loose.map(|s| s.powi(-2)))) else {
            break;
        };
        fitted.motion += factor.solve(&vector);
        fitted.covariance = alone.inverse();
        for ((point, found), into) in found().zip(&mut *scratch) {
            *into = residual(&fitted.motion, point, found).abs() as f32;
        }
        if count > 0 {
            let (_, median, _) = scratch[..count].select_nth_unstable_by(count / 2, f32::total_cmp);
            spread_px = (MEDIAN_TO_SIGMA * f64::from(*median)).max(SPREAD_MIN_PX);
        }
    }
    let agree = found().filter(|(point, found)| {
        let near_px = AGREES_PX + AGREES_SHARE * f64::from(found.shift_px).abs();
        residual(&fitted.motion, point, found).abs() < near_px
    });
    fitted.agree = agree.count();
    fitted
}
