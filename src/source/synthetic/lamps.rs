//! Lamps: fall-off, glare, and shadows with penumbra.

use super::solid::Solid;
use serde::Deserialize;

/// Points of a lamp's disc that a shadow is tried with; some of them decide where they agree.
const POINTS: usize = 32;
const FIRST_POINTS: usize = 8;
/// Grey levels of a lamp's image in a glossy face.
const GLARE_GREY: f32 = 220.0;
/// Films are not flat: a lamp's image is wider than the lamp by this much.
const GLARE_SPREAD_MM: f32 = 60.0;

/// `[[light.lamp]]`: a horizontal disc that shines downwards.
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
}

impl Lamp {
    /// Light at a point of a surface with a normal, as a share of full brightness.
    pub(super) fn irradiance(&self, at: [f32; 3], normal: [f32; 3]) -> f32 {
        let to = [self.x_mm as f32 - at[0], self.y_mm as f32 - at[1], self.z_mm as f32 - at[2]];
        let square: f32 = to.iter().map(|d| d * d).sum();
        let cosine = to.iter().zip(normal).map(|(d, n)| d * n).sum::<f32>() / square.sqrt();
        let height = self.z_mm as f32;
        self.strength as f32 * cosine.max(0.0) * height * height / square
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
    pub(super) lamp: usize,
    pub(super) solid: usize,
    /// Smallest and largest x, then y.
    bounds: [f32; 4],
}

impl Shadow {
    pub(super) fn new(lamp: usize, table: &Lamp, solid: usize, body: &Solid) -> Self {
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
        Self { lamp, solid, bounds }
    }

    pub(super) fn may_hold(&self, [x, y]: [f32; 2]) -> bool {
        let [x0, x1, y0, y1] = self.bounds;
        x >= x0 && x <= x1 && y >= y0 && y <= y1
    }
}

/// Share of a lamp's disc that solids hide from a point of the belt. `shadows`: those that may.
pub(super) fn hidden_share<'a>(
    lamp: &Lamp,
    ground: [f32; 2],
    shadows: &(impl Iterator<Item = &'a Shadow> + Clone),
    solids: &[Solid],
) -> f32 {
    let hidden = |k: usize| {
        let from = lamp.point(k);
        shadows.clone().any(|s| solids[s.solid].cross(from, ground, 0.0).is_some())
    };
    // Every fourth point, from the middle to the rim.
    let stride = POINTS / FIRST_POINTS;
    let first = (0..FIRST_POINTS).filter(|k| hidden(k * stride + stride - 1)).count();
    if first == 0 || first == FIRST_POINTS {
        return (first / FIRST_POINTS) as f32;
    }
    (0..POINTS).filter(|&k| hidden(k)).count() as f32 / POINTS as f32
}
