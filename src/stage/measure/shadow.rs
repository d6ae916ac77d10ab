//! What a shadow leaves open. Beside a parcel that is darker than the belt lies its shadow, as dark as it: where one
//! ends and the other begins no profile tells, and an edge that is found there may be the border of the shadow. What
//! tells them apart is the motion: the border lies on the belt, the edge as high as the parcel.

use super::fit::CORRELATED_SAMPLES;
use super::model::{HEIGHT, N};
use nalgebra::SVector;

/// How far a shadow reaches for each mm of the parcel's height: lamps hang 45 degrees up, or more.
const REACH: f64 = 1.0;
/// A shadow that is wider than this shows its own border.
const WIDTH_MAX_PX: f64 = 2.0;
/// The motion tells an edge from a shadow's border at so many sigma.
const TOLD_SIGMA: f64 = 3.0;

/// Sums over the profiles of one top edge that have a step from dark to bright, outward.
#[derive(Clone, Copy, Debug, Default)]
pub struct DarkEdge {
    /// Of weight times derivative of the place by the parameters.
    rows: SVector<f64, N>,
    /// Of weights.
    weight: f64,
    /// Of weighted levers (derivatives by the height), residuals, and their products.
    lever: f64,
    residual: f64,
    lever_lever: f64,
    lever_residual: f64,
}

impl DarkEdge {
    /// A profile whose step is `residual` mm outside of where the parameters have it.
    pub fn add(&mut self, residual: f64, row: &SVector<f64, N>, weight: f64) {
        let lever = row[HEIGHT];
        self.rows += row * weight;
        self.weight += weight;
        self.lever += weight * lever;
        self.residual += weight * residual;
        self.lever_lever += weight * lever * lever;
        self.lever_residual += weight * lever * residual;
    }

    /// How the normal equations' right side changes for each mm that the edge is off.
    pub fn rows(&self) -> &SVector<f64, N> {
        &self.rows
    }

    /// Standard deviation of the edge's place, mm, that the shadow of a parcel of this height leaves open. `sigma_mm`: of
    /// one profile's step.
    pub fn sigma_mm(&self, height_mm: f64, sigma_mm: f64, mm_per_px: f64) -> f64 {
        if self.weight <= 0.0 || self.is_above_belt(height_mm, sigma_mm) {
            return 0.0;
        }
        // Anywhere between the edge and the shadow's border.
        (REACH * height_mm).min(WIDTH_MAX_PX * mm_per_px) / 12f64.sqrt()
    }

    /// Whether the edge's own motion is not that of a border on the belt. A regression of the residuals on the lever.
    fn is_above_belt(&self, height_mm: f64, sigma_mm: f64) -> bool {
        let spread = self.lever_lever - self.lever * self.lever / self.weight;
        let higher_mm = (self.lever_residual - self.lever * self.residual / self.weight) / spread;
        let sigma_mm = (CORRELATED_SAMPLES / spread).sqrt() * sigma_mm;
        // NaN without motion.
        height_mm + higher_mm > TOLD_SIGMA * sigma_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEIGHT_MM: f64 = 80.0;
    const STEP_SIGMA_MM: f64 = 0.4;
    const MM_PER_PX: f64 = 1.0;

    /// What the shadow of a parcel leaves open of an edge that is seen with these levers, `lower_mm` under its top face.
    fn left_open(height_mm: f64, levers: [f64; 2], lower_mm: f64) -> f64 {
        let mut edge = DarkEdge::default();
        for i in 0..400 {
            let lever = levers[0] + (levers[1] - levers[0]) * f64::from(i) / 399.0;
            let mut row = SVector::zeros();
            row[HEIGHT] = lever;
            edge.add(2.0 - lower_mm * lever, &row, 1.0);
        }
        edge.sigma_mm(height_mm, STEP_SIGMA_MM, MM_PER_PX)
    }

    /// Of the edges of a shadow this wide.
    fn anywhere_in(width_mm: f64) -> f64 {
        width_mm / 12f64.sqrt()
    }

    #[test]
    fn an_edge_that_moves_with_the_top_face_is_none_of_a_shadow() {
        assert!(left_open(HEIGHT_MM, [-0.3, 0.3], 0.0).abs() < 1e-9);
    }

    #[test]
    fn a_border_that_moves_with_the_belt_leaves_its_shadow_open() {
        let open = left_open(HEIGHT_MM, [-0.3, 0.3], HEIGHT_MM);
        assert!((open - anywhere_in(WIDTH_MAX_PX * MM_PER_PX)).abs() < 1e-9, "{open}");
    }

    #[test]
    fn a_low_parcel_s_shadow_is_narrow_and_no_motion_tells_it_from_the_edge() {
        let open = left_open(1.5, [-0.02, 0.02], 0.0);
        assert!((open - anywhere_in(1.5 * REACH)).abs() < 1e-9, "{open}");
    }

    #[test]
    fn an_edge_along_the_belt_moves_with_nothing() {
        assert!(left_open(HEIGHT_MM, [0.1, 0.1], 0.0) > 0.5);
        let unseen = DarkEdge::default().sigma_mm(HEIGHT_MM, STEP_SIGMA_MM, MM_PER_PX);
        assert!(unseen.abs() < 1e-9, "{unseen}");
    }
}
