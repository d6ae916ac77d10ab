//! Lamps, and the sun through a window: fall-off, glare, and shadows with penumbra.

use super::solid::Solid;
use serde::Deserialize;

/// Lamps of a scenario: what a hall has over a belt, and the sun.
pub(super) const LAMPS_MAX: usize = 8;
/// Points of a lamp's disc that a shadow is tried with; some of them decide where they agree.
const POINTS: usize = 32;
const FIRST_POINTS: usize = 8;
/// Grey levels of a lamp's image in a glossy face.
const GLARE_GREY: f32 = 220.0;
/// Films are not flat: a lamp's image is wider than the lamp by this much.
const GLARE_SPREAD_MM: f32 = 60.0;

/// `[[light.lamp]]`: a horizontal disc that shines downwards. The sun is one far away, behind a window.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lamp {
    /// Its centre along travel.
    pub x_mm: f64,
    /// Its centre across the belt.
    pub y_mm: f64,
    /// Its height over the belt. Above every parcel.
    pub z_mm: f64,
    /// Radius of the disc: small makes hard shadows.
    pub radius_mm: f64,
    /// Share of full brightness that it adds on the belt right under it.
    pub strength: f64,
    /// It reaches only this patch of the belt, and what its light passes on the way there.
    pub window: Option<Window>,
}

/// `[light.lamp.window]`: the patch of the belt that light through a window reaches.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Window {
    /// Its middle along travel.
    pub x_mm: f64,
    /// Its middle across the belt.
    pub y_mm: f64,
    /// One side.
    pub length_mm: f64,
    /// The other side.
    pub width_mm: f64,
    /// The first side against +X.
    pub yaw_deg: f64,
    /// How wide its border is.
    pub edge_mm: f64,
}

impl Window {
    /// Share of the light that reaches a point of the belt plane.
    fn share(&self, [x, y]: [f32; 2]) -> f32 {
        let (sin, cos) = (self.yaw_deg.to_radians() as f32).sin_cos();
        let (dx, dy) = (x - self.x_mm as f32, y - self.y_mm as f32);
        let (a, b) = (cos * dx + sin * dy, cos * dy - sin * dx);
        let inside =
            (0.5 * self.length_mm as f32 - a.abs()).min(0.5 * self.width_mm as f32 - b.abs());
        (inside / self.edge_mm.max(1.0) as f32 + 0.5).clamp(0.0, 1.0)
    }
}

impl Lamp {
    /// Whether it can be rendered.
    pub(super) fn is_usable(&self) -> bool {
        let window = self.window.is_none_or(|w| w.length_mm > 0.0 && w.width_mm > 0.0);
        self.radius_mm >= 0.0 && self.strength >= 0.0 && window
    }

    /// Light at a point of a surface with a normal, as a share of full brightness.
    pub(super) fn irradiance(&self, at: [f32; 3], normal: [f32; 3]) -> f32 {
        let to = [self.x_mm as f32 - at[0], self.y_mm as f32 - at[1], self.z_mm as f32 - at[2]];
        let square: f32 = to.iter().map(|d| d * d).sum();
        let cosine = to.iter().zip(normal).map(|(d, n)| d * n).sum::<f32>() / square.sqrt();
        let height = self.z_mm as f32;
        let light = self.strength as f32 * cosine.max(0.0) * height * height / square;
        let window = self.window.as_ref();
        light * window.map_or(1.0, |window| window.share(self.on_belt(at)))
    }

    /// Where light of its centre that passes a point meets the belt.
    fn on_belt(&self, at: [f32; 3]) -> [f32; 2] {
        let height = self.z_mm as f32;
        let throw = height / (height - at[2]).max(1.0);
        let centre = [self.x_mm as f32, self.y_mm as f32];
        [0, 1].map(|k| centre[k] + (at[k] - centre[k]) * throw)
    }

    /// Point `k` of the disc. Source: Vogel 1979, the sunflower.
    fn point(&self, k: usize) -> [f32; 3] {
        const GOLDEN_RAD: f32 = 2.399_963_3;
        let radius = self.radius_mm as f32 * ((k as f32 + 0.5) / POINTS as f32).sqrt();
        let (sin, cos) = (k as f32 * GOLDEN_RAD).sin_cos();
        [self.x_mm as f32 + radius * cos, self.y_mm as f32 + radius * sin, self.z_mm as f32]
    }

    /// Grey levels that a glossy horizontal face at `at` throws into a camera at `camera`.
    pub(super) fn glare(&self, camera: [f32; 3], at: [f32; 3]) -> f32 {
        // The camera's ray goes on upwards as steeply as it came down.
        let rise = (self.z_mm as f32 - at[2]) / (camera[2] - at[2]);
        let miss = [0, 1].map(|k| {
            let lamp = [self.x_mm, self.y_mm][k] as f32;
            at[k] + rise * (at[k] - camera[k]) - lamp
        });
        let reach = self.radius_mm as f32 + GLARE_SPREAD_MM;
        let far = (miss[0] * miss[0] + miss[1] * miss[1]) / (reach * reach);
        GLARE_GREY * self.strength as f32 * (-far).exp()
    }
}

/// Where on the belt the shadow of a solid from a lamp may lie.
pub(super) struct Shadow {
    pub(super) solid: usize,
    /// Smallest and largest x, then y.
    bounds: [f32; 4],
}

impl Shadow {
    pub(super) fn new(table: &Lamp, solid: usize, body: &Solid) -> Self {
        let mut bounds = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
        let height = table.z_mm as f32;
        let throw = height / (height - body.height).max(1.0);
        let radius = table.radius_mm as f32;
        for corner in body.corners() {
            for side in [-radius, radius] {
                for (k, centre) in [table.x_mm, table.y_mm].into_iter().enumerate() {
                    let from = centre as f32 + side;
                    let at = from + (corner[k] - from) * throw;
                    bounds[2 * k] = bounds[2 * k].min(at).min(corner[k]);
                    bounds[2 * k + 1] = bounds[2 * k + 1].max(at).max(corner[k]);
                }
            }
        }
        Self { solid, bounds }
    }

    /// Whether light that meets the belt in a square may have been hidden.
    pub(super) fn may_hold(&self, [x, y]: [f32; 2], spread: f32) -> bool {
        let [x0, x1, y0, y1] = self.bounds;
        x >= x0 - spread && x <= x1 + spread && y >= y0 - spread && y <= y1 + spread
    }
}

impl Lamp {
    /// Where light that passes a point meets the belt: that of its centre, and how far from there that of
    /// its rim.
    pub(super) fn footprint(&self, at: [f32; 3]) -> ([f32; 2], f32) {
        if at[2] == 0.0 {
            return ([at[0], at[1]], 0.0);
        }
        let spread = self.radius_mm as f32 * at[2] / (self.z_mm as f32 - at[2]).max(1.0);
        (self.on_belt(at), spread)
    }
}

/// Share of a lamp's disc that solids hide from a point. `shadows`: those that may.
pub(super) fn hidden_share<'a>(
    lamp: &Lamp,
    at: [f32; 3],
    shadows: &(impl Iterator<Item = &'a Shadow> + Clone),
    solids: &[Solid],
) -> f32 {
    let hidden = |k: usize| {
        let from = lamp.point(k);
        shadows.clone().any(|s| solids[s.solid].hides(from, at))
    };
    // Every fourth point, from the middle to the rim.
    let stride = POINTS / FIRST_POINTS;
    let first = (0..FIRST_POINTS).filter(|k| hidden(k * stride + stride - 1)).count();
    if first == 0 || first == FIRST_POINTS {
        return (first / FIRST_POINTS) as f32;
    }
    (0..POINTS).filter(|&k| hidden(k)).count() as f32 / POINTS as f32
}
