//! Belt position over time, and how far it can be trusted.

/// Relative standard uncertainty of a nominal speed that may be off by 5 % (uniform).
const NOMINAL_SIGMA: f64 = 0.05 / 1.732;
/// What remains when the belt's texture was seen all along: interpolation and calibration.
const MEASURED_SIGMA: f64 = 0.0003;

/// Where the belt is: accumulated travel since start.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BeltPosition {
    /// Travel since start, mm.
    pub travel_mm: f64,
    /// The part of it that was measured rather than assumed from the speed.
    pub measured_mm: f64,
}

impl BeltPosition {
    /// One frame on.
    pub fn advance(&mut self, step_mm: f64, measured: bool) {
        self.travel_mm += step_mm;
        if measured {
            self.measured_mm += step_mm;
        }
    }

    /// Relative standard uncertainty of the travel since `start`.
    pub fn sigma_since(&self, start: &Self) -> f64 {
        let travel = self.travel_mm - start.travel_mm;
        let assumed = travel - (self.measured_mm - start.measured_mm);
        let share = if travel.abs() > 1e-6 { (assumed / travel).clamp(0.0, 1.0) } else { 1.0 };
        MEASURED_SIGMA.hypot(NOMINAL_SIGMA * share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uncertainty_grows_with_the_share_that_was_only_assumed() {
        let start = BeltPosition { travel_mm: 100.0, measured_mm: 40.0 };
        let mut all = start;
        all.advance(500.0, true);
        let mut half = start;
        half.advance(250.0, true);
        half.advance(250.0, false);
        assert!(all.sigma_since(&start) < 0.0004);
        assert!((half.sigma_since(&start) - NOMINAL_SIGMA / 2.0).abs() < 1e-4);
        assert!(start.sigma_since(&start) > 0.02, "no travel, nothing measured");
    }
}
