//! What does not ride and comes into the picture all the same: a hand, a sleeve, a hanging cable.

use nalgebra::Vector3;
use serde::Deserialize;

/// `[[intruder]]`: rods with round ends, above the belt, that move as one.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intruder {
    /// There from then on.
    pub from_s: f64,
    /// Until then.
    pub to_s: f64,
    /// How fast it moves.
    pub velocity_mm_per_s: [f64; 3],
    /// How far it swings beside that, along x, y and z.
    #[serde(default)]
    pub swing_mm: [f64; 3],
    /// Period of that.
    #[serde(default = "swing_period_s")]
    pub swing_period_s: f64,
    /// Its parts: a sleeve and fingers, say.
    #[serde(rename = "rod")]
    pub rods: Vec<Rod>,
}

fn swing_period_s() -> f64 {
    1.0
}

/// `[[intruder.rod]]`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rod {
    /// One end when it comes: x, y, z.
    pub from_mm: [f64; 3],
    /// The other.
    pub to_mm: [f64; 3],
    /// Half its thickness.
    pub radius_mm: f64,
    /// Grey level where it faces up, in full light.
    pub grey: f64,
}

impl Intruder {
    /// Whether it can be rendered.
    pub(super) fn is_usable(&self) -> bool {
        self.swing_period_s > 0.0 && self.rods.iter().all(|rod| rod.radius_mm > 0.0)
    }

    /// How far it has moved at a time; `None` while it is not there.
    pub(super) fn moved_mm(&self, t_s: f64) -> Option<Vector3<f64>> {
        let since_s = t_s - self.from_s;
        let phase = std::f64::consts::TAU * since_s / self.swing_period_s;
        let moved = Vector3::from(self.velocity_mm_per_s) * since_s
            + Vector3::from(self.swing_mm) * phase.sin();
        (self.from_s..self.to_s).contains(&t_s).then_some(moved)
    }
}

/// A rod in one frame, ready to be met by rays.
pub(super) struct PlacedRod {
    from: Vector3<f64>,
    along: Vector3<f64>,
    rod: Rod,
}

impl PlacedRod {
    pub(super) fn new(rod: Rod, moved_mm: Vector3<f64>) -> Self {
        let from = Vector3::from(rod.from_mm);
        Self { from: from + moved_mm, along: Vector3::from(rod.to_mm) - from, rod }
    }

    /// Its ends.
    pub(super) fn ends(&self) -> [Vector3<f64>; 2] {
        [self.from, self.from + self.along]
    }

    pub(super) fn radius_mm(&self) -> f64 {
        self.rod.radius_mm
    }

    /// Whether it is in the way from one point to another.
    pub(super) fn hides(&self, from: [f32; 3], to: [f32; 3]) -> bool {
        let [from, to] = [from, to].map(|p| Vector3::from(p.map(f64::from)));
        let ray = to - from;
        // The shortest way between the two stretches. Source: Ericson 2005, 5.1.9.
        let between = from - self.from;
        let (rr, aa, ra) = (ray.dot(&ray), self.along.dot(&self.along), ray.dot(&self.along));
        let (rb, ab) = (ray.dot(&between), self.along.dot(&between));
        let determinant = rr * aa - ra * ra;
        let mut far = if determinant > 0.0 { (ra * ab - rb * aa) / determinant } else { 0.0 };
        far = far.clamp(0.0, 1.0);
        let share = ((ra * far + ab) / aa.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        far = ((ra * share - rb) / rr.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        (from + far * ray - self.from - share * self.along).norm() < self.rod.radius_mm
    }

    /// How much of a pixel it covers on the ray from the camera, and the grey level there.
    pub(super) fn cover(
        &self,
        camera: Vector3<f64>,
        ray: Vector3<f64>,
        px_rad: f64,
    ) -> Option<[f64; 2]> {
        // Nearest points of the ray and of the rod's axis. Source: Ericson 2005, 5.1.9.
        let between = camera - self.from;
        let (rr, aa, ra) = (ray.dot(&ray), self.along.dot(&self.along), ray.dot(&self.along));
        let (rb, ab) = (ray.dot(&between), self.along.dot(&between));
        let determinant = rr * aa - ra * ra;
        let share = if determinant > 0.0 { (rr * ab - ra * rb) / determinant } else { 0.0 };
        let share = share.clamp(0.0, 1.0);
        let on_axis = self.from + share * self.along;
        let far = (on_axis - camera).dot(&ray) / rr;
        if far <= 0.0 {
            return None;
        }
        let miss = (camera + far * ray - on_axis).norm();
        let px_mm = far * rr.sqrt() * px_rad;
        let radius = self.rod.radius_mm;
        let cover = ((radius - miss) / px_mm + 0.5).clamp(0.0, 1.0);
        // Round: darker to its sides.
        let up = (1.0 - (miss / radius).powi(2)).max(0.0).sqrt();
        (cover > 0.0).then_some([cover, self.rod.grey * (0.4 + 0.6 * up)])
    }
}
