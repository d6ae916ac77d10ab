//! What lies flat on the belt and moves with it: dirt, seams, labels that came off and stuck.

use super::random::Random;
use serde::Deserialize;

/// `[[belt.mark]]`: a rectangle of another grey, or a round spot.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mark {
    /// Its middle before the belt has moved.
    pub x_mm: f64,
    /// Its middle across the belt.
    pub y_mm: f64,
    /// One side.
    pub length_mm: f64,
    /// The other side.
    pub width_mm: f64,
    /// The first side against +X.
    #[serde(default)]
    pub yaw_deg: f64,
    /// Its grey level in full light.
    pub grey: f64,
    /// How much of the belt it covers, 0 to 1.
    #[serde(default = "opaque")]
    pub cover: f64,
    /// How wide its border is; as wide as it is: a spot of dirt.
    #[serde(default)]
    pub edge_mm: f64,
    /// An ellipse instead of a rectangle.
    #[serde(default)]
    pub round: bool,
}

fn opaque() -> f64 {
    1.0
}

/// `[belt.dirt]`: spots drawn at random.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DirtTable {
    /// Spots on a square metre.
    pub per_m2: f64,
    /// Their sizes.
    pub size_mm: [f64; 2],
    /// Their greys.
    pub grey: [f64; 2],
}

/// The dirtied stretch of the belt is as long as this, and comes again.
pub(super) const DIRT_LOOP_MM: f64 = 3000.0;
/// A belt under a carpet of spots is another belt.
const SPOTS_MAX: f64 = 2000.0;

impl Mark {
    /// Whether it can be rendered.
    pub(super) fn is_usable(&self) -> bool {
        let sides = self.length_mm > 0.0 && self.width_mm > 0.0 && self.edge_mm >= 0.0;
        sides && (0.0..=255.0).contains(&self.grey) && (0.0..=1.0).contains(&self.cover)
    }

    /// As far from its middle as anything of it is.
    pub(super) fn reach_mm(&self) -> f64 {
        0.5 * self.length_mm.hypot(self.width_mm) + self.edge_mm
    }

    /// Sine and cosine of its yaw.
    pub(super) fn turn(&self) -> [f32; 2] {
        let (sin, cos) = (self.yaw_deg.to_radians() as f32).sin_cos();
        [sin, cos]
    }

    /// Share of the belt that it covers at a place from its middle.
    pub(super) fn share(&self, [sin, cos]: [f32; 2], [dx, dy]: [f32; 2], px_mm: f32) -> f32 {
        let (a, b) = (cos * dx + sin * dy, cos * dy - sin * dx);
        let half = [0.5 * self.length_mm as f32, 0.5 * self.width_mm as f32];
        let inside = if self.round {
            (1.0 - (a / half[0]).hypot(b / half[1])) * half[0].min(half[1])
        } else {
            (half[0] - a.abs()).min(half[1] - b.abs())
        };
        let edge = (self.edge_mm as f32).max(px_mm);
        self.cover as f32 * (inside / edge + 0.5).clamp(0.0, 1.0)
    }
}

impl DirtTable {
    /// Whether it can be rendered.
    pub(super) fn is_usable(&self) -> bool {
        let rising = |[low, high]: [f64; 2]| low <= high;
        (0.0..=SPOTS_MAX).contains(&self.per_m2)
            && self.size_mm[0] > 0.0
            && rising(self.size_mm)
            && rising(self.grey)
    }

    /// Spots on one loop of a belt.
    pub(super) fn draw(&self, width_mm: f64, random: &mut Random) -> Vec<Mark> {
        let count = (self.per_m2 * 1e-6 * DIRT_LOOP_MM * width_mm) as usize;
        let spot = |random: &mut Random| {
            let length_mm = random.between(self.size_mm.map(f64::ln)).exp();
            let width_mm_of_it = length_mm * random.between([0.3, 1.0]);
            Mark {
                x_mm: random.between([0.0, DIRT_LOOP_MM]),
                y_mm: random.between([-0.5, 0.5]) * width_mm,
                length_mm,
                width_mm: width_mm_of_it,
                yaw_deg: random.between([-90.0, 90.0]),
                grey: random.between(self.grey),
                cover: random.between([0.2, 0.9]),
                edge_mm: 0.5 * width_mm_of_it * random.unit(),
                round: true,
            }
        };
        (0..count).map(|_| spot(random)).collect()
    }
}
