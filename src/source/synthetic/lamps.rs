//! Lamps, and the sun through a window: fall-off, glare, and shadows with penumbra.

use super::intruder::PlacedRod;
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
    /// A point that sees: what it sees in front of the belt is what its light would not reach.
    pub(super) fn seen_from([x, y, z]: [f32; 3]) -> Self {
        let [x_mm, y_mm, z_mm] = [x, y, z].map(f64::from);
        Self { x_mm, y_mm, z_mm, radius_mm: 0.0, strength: 0.0, window: None }
    }

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

    /// A point of the disc, of those of the unit disc.
    fn point(&self, [x, y]: [f32; 2]) -> [f32; 3] {
        let radius = self.radius_mm as f32;
        [self.x_mm as f32 + radius * x, self.y_mm as f32 + radius * y, self.z_mm as f32]
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

/// Points evenly over the unit disc, from the middle to the rim. Source: Vogel 1979, the sunflower.
pub(super) struct Disc([[f32; 2]; POINTS]);

impl Default for Disc {
    fn default() -> Self {
        const GOLDEN_RAD: f32 = 2.399_963_3;
        Self(std::array::from_fn(|k| {
            let radius = ((k as f32 + 0.5) / POINTS as f32).sqrt();
            let (sin, cos) = (k as f32 * GOLDEN_RAD).sin_cos();
            [radius * cos, radius * sin]
        }))
    }
}

/// What throws shadows in a frame.
#[derive(Clone, Copy)]
pub(super) struct Casters<'a> {
    pub(super) solids: &'a [Solid],
    pub(super) rods: &'a [PlacedRod],
}

impl Casters<'_> {
    pub(super) fn count(&self) -> usize {
        self.solids.len() + self.rods.len()
    }
}

/// A place on a parcel: its solid, and its outward direction.
#[derive(Clone, Copy)]
pub(super) struct On {
    pub(super) solid: usize,
    pub(super) normal: [f32; 3],
}

/// Where on the belt the shadow from a lamp may lie.
pub(super) struct Shadow {
    /// What throws it: solids first, then rods.
    caster: usize,
    /// Smallest and largest x, then y.
    bounds: [f32; 4],
    /// From light to light across its narrower side, half of both penumbrae included.
    width_mm: f32,
}

impl Shadow {
    /// Of a lamp; or, of a point without size, what is in front of the belt as seen from it.
    pub(super) fn new(lamp: &Lamp, caster: usize, casters: Casters<'_>) -> Self {
        let bounds = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
        let mut shadow = Self { caster, bounds, width_mm: 0.0 };
        if let Some(body) = casters.solids.get(caster) {
            for corner in body.corners() {
                shadow.hold(corner);
                shadow.hold_thrown(lamp, [corner[0], corner[1], body.height]);
            }
            shadow.width_mm = 2.0 * body.half[1];
            return shadow;
        }
        let rod = &casters.rods[caster - casters.solids.len()];
        let radius = rod.radius_mm() as f32;
        let z = rod.ends().map(|end| end.z as f32);
        let throw = 1.0 / (lamp.z_mm as f32 - z[0].min(z[1])).max(1.0);
        shadow.width_mm =
            2.0 * (radius * lamp.z_mm as f32 + lamp.radius_mm as f32 * z[0].min(z[1])) * throw;
        for end in rod.ends() {
            for k in 0..8 {
                let side = |bit: usize| if k >> bit & 1 == 1 { radius } else { -radius };
                let corner = [0, 1, 2].map(|axis| end[axis] as f32 + side(axis));
                shadow.hold_thrown(lamp, corner);
            }
        }
        shadow
    }

    fn hold(&mut self, at: [f32; 2]) {
        for (k, at) in at.into_iter().enumerate() {
            self.bounds[2 * k] = self.bounds[2 * k].min(at);
            self.bounds[2 * k + 1] = self.bounds[2 * k + 1].max(at);
        }
    }

    /// Where light from the rim of a lamp that passes a point meets the belt.
    fn hold_thrown(&mut self, lamp: &Lamp, at: [f32; 3]) {
        let height = lamp.z_mm as f32;
        let throw = height / (height - at[2]).max(1.0);
        let radius = lamp.radius_mm as f32;
        for side in [-radius, radius] {
            let from = [lamp.x_mm as f32 + side, lamp.y_mm as f32 + side];
            self.hold([0, 1].map(|k| from[k] + (at[k] - from[k]) * throw));
        }
    }

    /// Whether it may lie anywhere in a rectangle: smallest and largest x, then y.
    pub(super) fn may_meet(&self, [x0, x1, y0, y1]: [f32; 4]) -> bool {
        let [a0, a1, b0, b1] = self.bounds;
        x1 >= a0 && x0 <= a1 && y1 >= b0 && y0 <= b1
    }

    /// Whether a square may lie in it without touching its border, or the other way round.
    pub(super) fn is_narrower_than(&self, width_mm: f32) -> bool {
        self.width_mm < width_mm
    }

    /// Whether what throws it is in the way from a point of the lamp.
    fn hides(&self, from: [f32; 3], at: [f32; 3], on: Option<On>, casters: Casters<'_>) -> bool {
        match casters.solids.get(self.caster) {
            Some(solid) => match on.filter(|on| on.solid == self.caster) {
                Some(on) => solid.hides_itself(from, at, on.normal),
                None => solid.hides(from, at),
            },
            None => casters.rods[self.caster - casters.solids.len()].hides(from, at),
        }
    }

    /// Whether it may hide light from what it is on: all but a parcel that is in its own light nowhere.
    pub(super) fn may_fall_on(&self, on: Option<On>, casters: Casters<'_>) -> bool {
        let own = on.filter(|on| on.solid == self.caster);
        own.is_none_or(|on| casters.solids[on.solid].parcel.shape.shades_itself())
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

/// Share of a lamp's disc that is hidden from a point. `shadows`: of what may be in the way.
pub(super) fn hidden_share<'a>(
    (lamp, disc): (&Lamp, &Disc),
    at: [f32; 3],
    on: Option<On>,
    shadows: &(impl Iterator<Item = &'a Shadow> + Clone),
    casters: Casters<'_>,
) -> f32 {
    let hidden = |k: usize| {
        let from = lamp.point(disc.0[k]);
        shadows.clone().any(|shadow| shadow.hides(from, at, on, casters))
    };
    // Every fourth point, from the middle to the rim.
    let stride = POINTS / FIRST_POINTS;
    let first = (0..FIRST_POINTS).filter(|k| hidden(k * stride + stride - 1)).count();
    if first == 0 || first == FIRST_POINTS {
        return (first / FIRST_POINTS) as f32;
    }
    (0..POINTS).filter(|&k| hidden(k)).count() as f32 / POINTS as f32
}
