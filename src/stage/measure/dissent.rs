//! Profiles that tell another edge. A side's steps fall outward or rise, as most of its profiles have it. Where the
//! others have a step of the other direction beside it, and at a place of its own, the side may lie there: a bright
//! label that ends shortly before a dark parcel's edge hides the edge on its own stretch alone.

use super::model::N;
use nalgebra::SVector;

/// Sums over the profiles of one top edge.
#[derive(Clone, Copy, Debug, Default)]
pub struct Dissent {
    /// Of weight times derivative of the place by the parameters.
    rows: SVector<f64, N>,
    /// Of profiles with the step that is used, and of those with the other one alone.
    count: [usize; 2],
    /// Of how far these steps are outside of where the parameters have them, mm.
    residual: [f64; 2],
}

impl Dissent {
    /// A profile whose step is used, `residual` mm outside of where the parameters have it.
    pub fn add_used(&mut self, residual: f64, row: &SVector<f64, N>, weight: f64) {
        self.rows += row * weight;
        self.count[0] += 1;
        self.residual[0] += residual;
    }

    /// A profile that has the other step alone.
    pub fn add_other(&mut self, residual: f64) {
        self.count[1] += 1;
        self.residual[1] += residual;
    }

    /// How the normal equations' right side changes for each mm that the edge is off.
    pub fn rows(&self) -> &SVector<f64, N> {
        &self.rows
    }

    /// How far the edge would move, mm, if the others had their share in it.
    pub fn sigma_mm(&self) -> f64 {
        if self.count.contains(&0) {
            return 0.0;
        }
        let [used, other] = self.count.map(|count| count as f64);
        let off_mm = self.residual[1] / other - self.residual[0] / used;
        other / (used + other) * off_mm.abs()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dissent(used: usize, others: usize, off_mm: f64) -> Dissent {
        let mut dissent = Dissent::default();
        (0..used).for_each(|_| dissent.add_used(0.1, &SVector::zeros(), 1.0));
        (0..others).for_each(|_| dissent.add_other(0.1 + off_mm));
        dissent
    }

    #[test]
    fn where_all_agree_nothing_is_left_open() {
        assert!(dissent(200, 0, 0.0).sigma_mm().abs() < 1e-12);
        assert!(Dissent::default().sigma_mm().abs() < 1e-12);
    }

    #[test]
    fn others_count_by_their_share_and_their_distance() {
        assert!((dissent(120, 80, 5.0).sigma_mm() - 2.0).abs() < 1e-9);
        assert!((dissent(198, 2, -5.0).sigma_mm() - 0.05).abs() < 1e-9);
        // At the same place it is the same edge.
        assert!(dissent(120, 80, 0.0).sigma_mm().abs() < 1e-9);
    }
}
