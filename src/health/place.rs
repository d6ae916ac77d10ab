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
/// The residuals are never taken to be better than this, px: profiles share their errors.
const SPREAD_MIN_PX: f64 = 0.03;
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
}

/// Fit the motion to the points. `scratch` has room for all of them.
pub(super) fn fit<'a>(
    points: impl Iterator<Item = (&'a Point, Option<&'a Match>)> + Clone,
    scratch: &mut [f32],
) -> Fitted {
    let found = || points.clone().filter_map(|(point, found)| found.map(|found| (point, found)));
    let prior = Motion::from(PRIOR_SIGMA).map(|sigma| sigma.powi(-2));
    let mut motion = Motion::zeros();
    let mut covariance = Normal::from_diagonal(&Motion::from(PRIOR_SIGMA).map(|s| s * s));
    let residual = |motion: &Motion, point: &Point, found: &Match| {
        f64::from(found.shift_px) - point.moved_px(motion)
    };
    // The first time all count alike: a shift of the whole picture is no outlier.
    let mut spread_px = f64::INFINITY;
    for iteration in 0..ITERATIONS {
        let mut normal = Normal::from_diagonal(&prior);
        let mut vector = -prior.component_mul(&motion);
        let noise_px = if spread_px.is_finite() { spread_px } else { 1.0 };
        for (point, found) in found() {
            let row = point.rates();
            let off = residual(&motion, point, found);
            let far = (off / spread_px).abs();
            let weight = if iteration < TUKEY_FROM {
                HUBER / far.max(HUBER)
            } else if far < TUKEY {
                (1.0 - (far / TUKEY).powi(2)).powi(2)
            } else {
                0.0
            };
            let weight = weight / (noise_px * noise_px);
            normal.ger(weight, &row, &row, 1.0);
            vector.axpy(weight * off, &row, 1.0);
        }
        let Some(factor) = normal.cholesky() else { break };
        motion += factor.solve(&vector);
        covariance = factor.inverse();
        let count = found().zip(&mut *scratch).fold(0, |n, ((point, found), into)| {
            *into = residual(&motion, point, found).abs() as f32;
            n + 1
        });
        if count > 0 {
            let (_, median, _) = scratch[..count].select_nth_unstable_by(count / 2, f32::total_cmp);
            spread_px = (MEDIAN_TO_SIGMA * f64::from(*median)).max(SPREAD_MIN_PX);
        }
    }
    let agree = found().filter(|(point, found)| {
        let near_px = AGREES_PX + AGREES_SHARE * f64::from(found.shift_px).abs();
        residual(&motion, point, found).abs() < near_px
    });
    Fitted { motion, covariance, found: found().count(), agree: agree.count() }
}
