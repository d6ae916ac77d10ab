//! Light on the belt and on parcels: from everywhere, and by the lamps that nothing hides.

use super::lamps::{Casters, Disc, LAMPS_MAX, On, Shadow, hidden_share};
use super::parcel::{Material, Parcel};
use super::scenario::LightTable;
use super::solid::{Hit, Solid};
use super::surface::{TOP, crease};

/// Shades of a parcel's top and its four sides where there are no lamps.
const SHADES: [f32; 5] = [1.0, 0.45, 0.55, 0.5, 0.6];
/// Grey levels of a crease of shrink-wrap that mirrors a lamp.
const CREASE_GREY: f32 = 150.0;

/// What of each lamp is hidden from a point, as a share.
pub(super) type Hidden = [f32; LAMPS_MAX];

/// The light of a scenario, image after image.
pub(super) struct Light {
    table: LightTable,
    disc: Disc,
    /// By each lamp on the belt where no parcel is in the way, as a share of full brightness.
    on_belt: Vec<f32>,
    /// Grey levels that the lamps' images add to a belt that shines.
    shine: Vec<f32>,
    pixels: usize,
    /// Where shadows may lie in this frame, lamp after lamp; room for those of all that throws any.
    shadows: Vec<Shadow>,
}

impl Light {
    pub(super) fn new(
        table: &LightTable,
        camera: [f32; 3],
        ground: &[[f32; 2]],
        shine: f64,
        casters: usize,
    ) -> Self {
        let lamps = &table.lamps;
        let on_belt = lamps.iter().flat_map(|lamp| {
            ground.iter().map(|&[x, y]| lamp.irradiance([x, y, 0.0], [0.0, 0.0, 1.0]))
        });
        let mirrored = |&[x, y]: &[f32; 2]| {
            shine as f32 * lamps.iter().map(|l| l.glare(camera, [x, y, 0.0])).sum::<f32>()
        };
        Self {
            on_belt: on_belt.collect(),
            shine: if shine > 0.0 { ground.iter().map(mirrored).collect() } else { Vec::new() },
            pixels: ground.len(),
            shadows: Vec::with_capacity(lamps.len() * casters),
            table: table.clone(),
            disc: Disc::default(),
        }
    }

    /// Shades of faces, before any lamp.
    pub(super) fn shades(&self) -> [f32; 5] {
        if self.table.lamps.is_empty() { SHADES } else { [1.0; 5] }
    }

    /// Grey levels that the lamps' images add to the belt at pixel `i`.
    pub(super) fn shine(&self, i: usize) -> f32 {
        self.shine.get(i).copied().unwrap_or_default()
    }

    /// Light on the belt at pixel `i` where no parcel is in the way; 1 without lamps.
    pub(super) fn on_free_belt(&self, i: usize) -> f32 {
        if self.table.lamps.is_empty() {
            return 1.0;
        }
        let by_lamps = (0..self.table.lamps.len()).map(|k| self.on_belt[k * self.pixels + i]);
        self.table.ambient as f32 + by_lamps.sum::<f32>()
    }

    /// Note where the shadows of this frame may lie.
    pub(super) fn place_shadows(&mut self, casters: Casters<'_>) {
        self.shadows.clear();
        for lamp in &self.table.lamps {
            let of_lamp = (0..casters.count()).map(|n| Shadow::new(lamp, n, casters));
            self.shadows.extend(of_lamp);
        }
    }

    /// Whether any shadow may lie in a rectangle of the belt, smallest and largest x, then y; and whether
    /// one that is narrower than each of two widths.
    pub(super) fn shadows_in(&self, rectangle: [f32; 4], widths_mm: [f32; 2]) -> (bool, [bool; 2]) {
        let met = || self.shadows.iter().filter(|shadow| shadow.may_meet(rectangle));
        let narrow = widths_mm.map(|width_mm| met().any(|s| s.is_narrower_than(width_mm)));
        (met().next().is_some(), narrow)
    }

    /// What is hidden of the lamps from a point of a solid.
    pub(super) fn hidden(&self, at: [f32; 3], on: On, casters: Casters<'_>) -> Hidden {
        let mut hidden = [0.0; LAMPS_MAX];
        for (k, hidden) in hidden.iter_mut().enumerate().take(self.table.lamps.len()) {
            *hidden = self.hidden_of(k, at, Some(on), casters);
        }
        hidden
    }

    /// The same of one lamp, on the belt or on a solid.
    fn hidden_of(&self, k: usize, at: [f32; 3], on: Option<On>, casters: Casters<'_>) -> f32 {
        let (lamp, count) = (&self.table.lamps[k], casters.count());
        let (middle, spread) = lamp.footprint(at);
        let of_lamp = &self.shadows[k * count..][..count];
        let near =
            of_lamp.iter().filter(|s| s.may_hold(middle, spread) && s.may_fall_on(on, casters));
        if near.clone().next().is_none() {
            return 0.0;
        }
        hidden_share((lamp, &self.disc), at, on, &near, casters)
    }

    /// What is left on the belt at pixel `i` of the light on the free belt.
    pub(super) fn share_on_belt(&self, i: usize, [x, y]: [f32; 2], casters: Casters<'_>) -> f32 {
        let lost = |k: usize| {
            let by_lamp = self.on_belt[k * self.pixels + i];
            // Beside the patch that a window lets it reach there is nothing to hide.
            if by_lamp > 0.0 {
                by_lamp * self.hidden_of(k, [x, y, 0.0], None, casters)
            } else {
                0.0
            }
        };
        let lost: f32 = (0..self.table.lamps.len()).map(lost).sum();
        if lost > 0.0 { (1.0 - lost / self.on_free_belt(i)).max(0.0) } else { 1.0 }
    }

    /// Light where a ray met a solid, as a share of full brightness; 1 without lamps.
    pub(super) fn on_parcel(&self, solid: &Solid, hit: &Hit, hidden: &Hidden) -> f32 {
        if self.table.lamps.is_empty() {
            return 1.0;
        }
        let (at, normal) = solid.in_belt(hit);
        // A side sees half of the sky.
        let sky = 0.5 + 0.5 * normal[2].max(0.0);
        let by_lamps = self.table.lamps.iter().zip(hidden);
        let by_lamps = by_lamps.map(|(lamp, hidden)| (1.0 - hidden) * lamp.irradiance(at, normal));
        self.table.ambient as f32 * sky + by_lamps.sum::<f32>()
    }

    /// Grey levels that the lamps' images add to what a ray met.
    pub(super) fn glare(&self, camera: [f32; 3], solid: &Solid, hit: &Hit, hidden: &Hidden) -> f32 {
        let parcel: &Parcel = &solid.parcel;
        let faces_up = hit.normal[2] > 0.5;
        let mirrors = parcel.material == Material::Glossy && hit.surface.id == TOP;
        if !(faces_up && (mirrors || parcel.wrap > 0.0)) {
            return 0.0;
        }
        let (at, _) = solid.in_belt(hit);
        let film = if mirrors {
            let lamps = self.table.lamps.iter().zip(hidden);
            lamps.map(|(lamp, hidden)| (1.0 - hidden) * lamp.glare(camera, at)).sum()
        } else {
            0.0
        };
        // Which creases mirror a lamp changes with the way.
        let turning = 0.5 + 0.5 * (0.013 * at[0] + 0.4 * hit.at[1]).cos();
        let creases = crease(parcel.x_mm as f32, [hit.at[0], hit.at[1]]);
        film + CREASE_GREY * parcel.wrap as f32 * turning * creases
    }
}
