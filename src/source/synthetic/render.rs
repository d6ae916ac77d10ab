//! Renders clean frames: belt, rails, shadows, parcels of all shapes, and what comes in between.
//!
//! Every pixel is a ray through the scenario's lens, met with the belt plane once at start.
//! Edges are sampled 16 times over the pixel and the exposure, which is anti-aliasing and
//! motion blur at once; plain surfaces are sampled once, the belt once a pixel of its way.

use super::belt::{Position, Surface};
use super::blocks::{BLOCK_PX, BlockPx, Filled, TILE_PX, alike};
use super::intruder::PlacedRod;
use super::lamps::{Casters, LAMPS_MAX, Lamp, On, Shadow};
use super::light::{Hidden, Light};
use super::parcel::Parcel;
use super::scenario::Scenario;
use super::solid::{Hit, Solid};
use super::surface::{NOTHING, face};
use crate::camera::{BeltView, Camera};
use crate::error::Result;
use crate::units::{BeltPx, RawPx};
use nalgebra::Vector3;

/// Samples of an edge pixel in each direction.
const SUB: usize = 4;
const RAIL_MM: f32 = 40.0;
/// Samples of the belt over an exposure.
const BLUR_SAMPLES_MAX: f32 = 4.0;
/// Brightness falls by this much at a metre from the nadir.
const VIGNETTE: f32 = 0.25;

/// Renderer of one scenario.
pub struct Renderer {
    scenario: Scenario,
    camera: Camera,
    centre: [f32; 3],
    /// Point of the belt plane under each pixel; NaN where the ray misses it.
    ground: Vec<[f32; 2]>,
    belt: Surface,
    /// Surface seen by each pixel of the parcel being drawn.
    surface: Vec<u8>,
    /// Where its ray meets that parcel.
    hits: Vec<Option<Hit>>,
    /// The parcels in view; room for all of them.
    solids: Vec<Solid>,
    /// Hands, sleeves and cables in view; room for all of them.
    rods: Vec<PlacedRod>,
    light: Light,
}

impl Renderer {
    /// Precompute rays and texture.
    pub fn new(scenario: Scenario) -> Result<Self> {
        let camera = scenario.camera()?;
        let [width, height] = camera.image_size_px;
        let centre = camera.centre_in_belt();
        let ground = (0..width * height)
            .map(|i| {
                let px = RawPx { x: (i % width) as f64, y: (i / width) as f64 };
                camera.belt_point(px).map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32])
            })
            .collect();
        let ground: Vec<[f32; 2]> = ground;
        let eye = [centre.x as f32, centre.y as f32, centre.z as f32];
        let parcels = scenario.parcels().len();
        let rods = scenario.intruders.iter().map(|intruder| intruder.rods.len()).sum();
        Ok(Self {
            light: Light::new(&scenario.light, eye, &ground, scenario.belt.shine, parcels + rods),
            rods: Vec::with_capacity(rods),
            belt: Surface::new(scenario.seed, &scenario.belt),
            solids: Vec::with_capacity(parcels),
            scenario,
            centre: eye,
            ground,
            surface: vec![NOTHING; width * height],
            hits: vec![None; width * height],
            camera,
        })
    }

    /// The scenario.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// Its camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Render frame `index` into `frame`, 1/256 grey levels, without noise.
    pub fn render(&mut self, index: u64, frame: &mut [u16]) {
        let t_s = index as f64 / self.scenario.fps;
        let travel_mm = self.scenario.travel_mm(t_s);
        let light = (self.scenario.brightness(t_s) * 256.0) as f32;
        let half_exposure_s = 0.5e-3 * self.scenario.exposure_ms;
        let blur_mm = (self.scenario.travel_mm(t_s + half_exposure_s)
            - self.scenario.travel_mm(t_s - half_exposure_s)) as f32;
        let at = Position { travel_mm, aside_mm: self.scenario.aside_mm(t_s) };
        self.belt.place(at);
        self.render_belt(light, blur_mm, frame);
        let solids = self.place_solids(at);
        for solid in &solids {
            self.cast_shadow(solid, frame);
        }
        let rods = self.place_rods(t_s);
        let casters = Casters { solids: &solids, rods: &rods };
        self.light.place_shadows(casters);
        self.cast_lamp_shadows(casters, frame);
        for (n, solid) in solids.iter().enumerate() {
            self.classify(solid);
            self.draw(n, casters, light, blur_mm, frame);
        }
        self.draw_intruders(&rods, light, frame);
        (self.solids, self.rods) = (solids, rods);
    }

    /// Which pixels of a belt view show a parcel in frame `index`: the true foreground. Row by row;
    /// a pixel is what its centre shows.
    pub fn parcel_mask(&mut self, index: u64, view: &BeltView, mask: &mut [bool]) {
        let t_s = index as f64 / self.scenario.fps;
        let (travel_mm, aside_mm) = (self.scenario.travel_mm(t_s), self.scenario.aside_mm(t_s));
        let solids = self.place_solids(Position { travel_mm, aside_mm });
        let width = view.size_px[0];
        for (i, shows) in mask.iter_mut().enumerate() {
            let px = BeltPx { u: (i % width) as f64, v: (i / width) as f64 };
            let at = view.belt_point(px);
            let ground = [at.x as f32, at.y as f32];
            *shows = solids.iter().any(|s| s.meet(self.centre, ground, 0.0).is_some());
        }
        self.solids = solids;
    }

    fn render_belt(&self, light: f32, blur_mm: f32, frame: &mut [u16]) {
        let half_width = 0.5 * self.scenario.belt.width_mm as f32;
        let px_mm = self.px_mm();
        // A shorter way than a pixel shows no more than the pixel itself.
        let samples = (blur_mm.abs() / px_mm).ceil().clamp(1.0, BLUR_SAMPLES_MAX);
        let grey = |[x, y]: [f32; 2]| {
            if samples < 2.0 {
                return self.belt.grey([x, y], px_mm);
            }
            let at = |k: f32| x + blur_mm * ((k + 0.5) / samples - 0.5);
            let sum: f32 =
                (0..samples as u8).map(|k| self.belt.grey([at(f32::from(k)), y], px_mm)).sum();
            sum / samples
        };
        for (i, (out, &[x, y])) in frame.iter_mut().zip(&self.ground).enumerate() {
            let (surface, shine) = if y.abs() <= half_width {
                (grey([x, y]), self.light.shine(i))
            } else if y.abs() <= half_width + RAIL_MM {
                (120.0, 0.0)
            } else {
                (12.0, 0.0)
            };
            let shade = self.vignette(x, y) * light;
            *out = (surface * shade * self.light.on_free_belt(i) + shine * shade) as u16;
        }
    }

    /// Size of a pixel on the belt in the middle of the image.
    fn px_mm(&self) -> f32 {
        let [width, height] = self.camera.image_size_px;
        let i = height / 2 * width + width / 2;
        let [a, b] = [self.ground[i], self.ground[i + 1]];
        (a[0] - b[0]).hypot(a[1] - b[1])
    }

    /// Take away from the belt what is hidden of the lamps. Most tiles of the picture have no shadow; in
    /// the others tiles, or blocks, are filled between their corners where those are nearly alike.
    fn cast_lamp_shadows(&self, casters: Casters<'_>, frame: &mut [u16]) {
        if self.scenario.light.lamps.is_empty() || casters.count() == 0 {
            return;
        }
        let [width, height] = self.camera.image_size_px;
        // A shadow may lie between the corners of a block that is as wide.
        let narrow_mm = |side_px: usize| 2.0 * side_px as f32 * self.px_mm();
        for tile in BlockPx::all([0, 0], [width, height], TILE_PX) {
            let mut reach = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
            for [x, y] in tile.pixels(width).map(|i| self.ground[i]) {
                reach = [reach[0].min(x), reach[1].max(x), reach[2].min(y), reach[3].max(y)];
            }
            let (has_shadow, has_narrow) =
                self.light.shadows_in(reach, [TILE_PX, BLOCK_PX].map(narrow_mm));
            if !has_shadow {
                continue;
            }
            let share = |i: usize| self.light.share_on_belt(i, self.ground[i], casters);
            let mut shade = |block: BlockPx, filled: Option<Filled<1>>| {
                for i in block.pixels(width) {
                    let left = filled.as_ref().map_or_else(|| share(i), |f| f.at(i, width)[0]);
                    frame[i] = (f32::from(frame[i]) * left) as u16;
                }
            };
            let between = |block: BlockPx| block.filled(block.corners(width).map(|i| [share(i)]));
            let whole = (!has_narrow[0]).then(|| between(tile)).flatten().filter(|filled| {
                tile.middles(width).iter().all(|&i| alike(share(i), filled.at(i, width)[0]))
            });
            if whole.is_some() {
                shade(tile, whole);
                continue;
            }
            for block in tile.parts() {
                shade(block, (!has_narrow[1]).then(|| between(block)).flatten());
            }
        }
    }

    fn vignette(&self, x: f32, y: f32) -> f32 {
        let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
        (1.0 - VIGNETTE * 1e-6 * (dx * dx + dy * dy)).max(0.2)
    }

    /// The parcels in view, furthest from the nadir first: nearer ones lean over them. The list
    /// is lent, so that rendering allocates nothing.
    fn place_solids(&mut self, at: Position) -> Vec<Solid> {
        let mut solids = std::mem::take(&mut self.solids);
        solids.clear();
        solids.extend(self.scenario.parcels().iter().filter_map(|p| self.solid(p, at)));
        let distance =
            |s: &Solid| (s.centre[0] - self.centre[0]).hypot(s.centre[1] - self.centre[1]);
        solids.sort_unstable_by(|a, b| distance(b).total_cmp(&distance(a)));
        solids
    }

    fn solid(&self, parcel: &Parcel, at: Position) -> Option<Solid> {
        let place = self.scenario.place(parcel, at.travel_mm, at.aside_mm);
        let (sin, cos) = place.yaw_deg.to_radians().sin_cos();
        // Room for shadow and blur around the solid itself.
        let margin_mm = shadow_reach_mm(parcel.height_mm as f32) as f64 + 5.0;
        let mut bounds = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
        for k in 0..8 {
            let sign = |bit: i32| if k >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let z = if k & 4 == 4 { parcel.height_mm } else { 0.0 };
            let a = sign(0) * (0.5 * parcel.length_mm + margin_mm);
            let b = sign(1) * (0.5 * parcel.width_mm + margin_mm);
            let at =
                Vector3::new(place.x_mm + cos * a - sin * b, place.y_mm + sin * a + cos * b, z);
            let px = self.camera.project(at)?;
            bounds = [
                bounds[0].min(px.x),
                bounds[1].max(px.x),
                bounds[2].min(px.y),
                bounds[3].max(px.y),
            ];
        }
        let [width, height] = self.camera.image_size_px;
        // Neighbours are needed for derivatives and edges.
        let clamp = |value: f64, n: usize| value.clamp(1.0, (n - 1) as f64) as usize;
        let bounds = [
            clamp(bounds[0] - 2.0, width),
            clamp(bounds[1] + 3.0, width),
            clamp(bounds[2] - 2.0, height),
            clamp(bounds[3] + 3.0, height),
        ];
        if bounds[0] >= bounds[1] || bounds[2] >= bounds[3] {
            return None;
        }
        Some(Solid {
            parcel: *parcel,
            radius: parcel
                .edge_radius_mm
                .unwrap_or(self.scenario.edge_radius_mm)
                .min(0.45 * parcel.height_mm.min(parcel.width_mm)) as f32,
            centre: [place.x_mm as f32, place.y_mm as f32],
            sin: sin as f32,
            cos: cos as f32,
            half: [0.5 * parcel.length_mm as f32, 0.5 * parcel.width_mm as f32],
            height: parcel.height_mm as f32,
            shades: self.light.shades(),
            bounds,
        })
    }

    /// Darken the belt around a footprint, less and less with the distance.
    fn cast_shadow(&self, solid: &Solid, frame: &mut [u16]) {
        let depth = self.scenario.light.shadow as f32;
        let reach = shadow_reach_mm(solid.height);
        let [u0, u1, v0, v1] = solid.bounds;
        let width = self.camera.image_size_px[0];
        for i in (v0..v1).flat_map(|v| v * width + u0..v * width + u1) {
            let [a, b] = solid.local(self.ground[i]);
            let (da, db) = ((a.abs() - solid.half[0]).max(0.0), (b.abs() - solid.half[1]).max(0.0));
            let far = (da * da + db * db).sqrt() / reach;
            if far < 1.0 {
                let near = 1.0 - far;
                frame[i] = (f32::from(frame[i]) * (1.0 - depth * near * near)) as u16;
            }
        }
    }

    /// Note which surface each pixel of the solid's bounds shows at its centre.
    fn classify(&mut self, solid: &Solid) {
        let [u0, u1, v0, v1] = solid.bounds;
        let width = self.camera.image_size_px[0];
        for i in (v0..v1).flat_map(|v| v * width + u0..v * width + u1) {
            self.hits[i] = solid.meet(self.centre, self.ground[i], 0.0);
            self.surface[i] = self.hits[i].map_or(NOTHING, |hit| hit.surface.id);
        }
    }

    /// Hands, sleeves and cables as they are at a time. The list is lent.
    fn place_rods(&mut self, t_s: f64) -> Vec<PlacedRod> {
        let mut rods = std::mem::take(&mut self.rods);
        rods.clear();
        for intruder in &self.scenario.intruders {
            let Some(moved_mm) = intruder.moved_mm(t_s) else { continue };
            rods.extend(intruder.rods.iter().map(|rod| PlacedRod::new(*rod, moved_mm)));
        }
        rods
    }

    /// Draw solid `n` of those in view.
    fn draw(&self, n: usize, casters: Casters<'_>, light: f32, blur_mm: f32, frame: &mut [u16]) {
        let solid = &casters.solids[n];
        let [u0, u1, v0, v1] = solid.bounds;
        let width = self.camera.image_size_px[0];
        // The outermost pixels were given a margin and show nothing.
        for block in BlockPx::all([u0 + 1, v0 + 1], [u1 - 1, v1 - 1], BLOCK_PX) {
            let filled = self.hidden_on_block(n, casters, block);
            for i in block.pixels(width) {
                let known = filled.as_ref().map(|filled| filled.at(i, width));
                self.draw_pixel(n, casters, i, known, [light, blur_mm], frame);
            }
        }
    }

    /// What is hidden of the lamps from a block that is all on one face, where its corners tell.
    fn hidden_on_block(
        &self,
        n: usize,
        casters: Casters<'_>,
        block: BlockPx,
    ) -> Option<Filled<{ LAMPS_MAX }>> {
        let width = self.camera.image_size_px[0];
        let corners = block.corners(width);
        let first = face(self.surface[corners[0]]);
        if first == NOTHING || !block.pixels(width).all(|i| face(self.surface[i]) == first) {
            return None;
        }
        let hits = corners.map(|i| self.hits[i]);
        if hits.iter().any(Option::is_none) {
            return None;
        }
        block.filled(
            hits.map(|hit| hit.map_or([0.0; LAMPS_MAX], |hit| self.hidden_at(n, casters, &hit))),
        )
    }

    fn hidden_at(&self, n: usize, casters: Casters<'_>, hit: &Hit) -> Hidden {
        let (at, normal) = casters.solids[n].in_belt(hit);
        self.light.hidden(at, On { solid: n, normal }, casters)
    }

    fn draw_pixel(
        &self,
        n: usize,
        casters: Casters<'_>,
        i: usize,
        known: Option<Hidden>,
        [light, blur_mm]: [f32; 2],
        frame: &mut [u16],
    ) {
        let (solid, width) = (&casters.solids[n], self.camera.image_size_px[0]);
        let here = self.surface[i];
        let plain = [i - 1, i + 1, i - width, i + width].iter().all(|&n| self.surface[n] == here);
        if plain && here == NOTHING {
            return;
        }
        let ground = self.ground[i];
        let shade = self.vignette(ground[0], ground[1]) * light;
        let hidden = |hit: &Hit| known.unwrap_or_else(|| self.hidden_at(n, casters, hit));
        let centre = self.hits[i].map(|hit| (hit, hidden(&hit)));
        let value = if plain {
            centre.map(|(hit, hidden)| self.radiance(solid, &hit, &hidden) * shade)
        } else {
            let (behind, known) = (f32::from(frame[i]), centre.map(|(_, hidden)| hidden));
            let hidden = |hit: &Hit| known.unwrap_or_else(|| hidden(hit));
            Some(self.supersample(solid, i, shade, blur_mm, behind, hidden))
        };
        if let Some(value) = value {
            let glare = centre.map_or(0.0, |(hit, hidden)| {
                self.light.glare(self.centre, solid, &hit, &hidden) * shade
            });
            frame[i] = (value + glare).min(65535.0) as u16;
        }
    }

    fn radiance(&self, solid: &Solid, hit: &Hit, hidden: &Hidden) -> f32 {
        hit.surface.grey * self.light.on_parcel(solid, hit, hidden)
    }

    /// Mean over the pixel's area and the exposure; `behind` shows where the solid does not. What is
    /// hidden of the lamps is the same all over a pixel.
    fn supersample(
        &self,
        solid: &Solid,
        i: usize,
        shade: f32,
        blur_mm: f32,
        behind: f32,
        hidden_at: impl Fn(&Hit) -> Hidden,
    ) -> f32 {
        let width = self.camera.image_size_px[0];
        let difference =
            |a: usize, b: usize| [0, 1].map(|k| 0.5 * (self.ground[a][k] - self.ground[b][k]));
        let (du, dv) = (difference(i + 1, i - 1), difference(i + width, i - width));
        let mut hidden = None;
        let mut sum = 0.0;
        for k in 0..SUB * SUB {
            let place = |n: usize| (n as f32 + 0.5) / SUB as f32 - 0.5;
            let (a, b) = (place(k % SUB), place(k / SUB));
            let ground = [0, 1].map(|c| self.ground[i][c] + a * du[c] + b * dv[c]);
            // 7 is coprime to 16: times are spread evenly over every row and column.
            let time = ((k * 7 % (SUB * SUB)) as f32 + 0.5) / (SUB * SUB) as f32 - 0.5;
            sum += solid.meet_rounded(self.centre, ground, time * blur_mm).map_or(behind, |hit| {
                let hidden = hidden.get_or_insert_with(|| hidden_at(&hit));
                self.radiance(solid, &hit, hidden) * shade
            });
        }
        sum / (SUB * SUB) as f32
    }

    /// Draw hands, sleeves and cables over everything: they are above what rides.
    fn draw_intruders(&self, rods: &[PlacedRod], light: f32, frame: &mut [u16]) {
        let eye = Vector3::from(self.centre.map(f64::from));
        let px_rad = f64::from(self.px_mm() / self.centre[2]);
        let casters = Casters { solids: &[], rods };
        for (n, rod) in rods.iter().enumerate() {
            let behind = Shadow::new(&Lamp::seen_from(self.centre), n, casters);
            for (out, &[x, y]) in frame.iter_mut().zip(&self.ground) {
                if !behind.may_hold([x, y], 0.0) {
                    continue;
                }
                let ray = Vector3::new(f64::from(x), f64::from(y), 0.0) - eye;
                let Some([cover, grey]) = rod.cover(eye, ray, px_rad) else { continue };
                let grey = grey * f64::from(self.vignette(x, y) * light);
                *out = (f64::from(*out) * (1.0 - cover) + cover * grey) as u16;
            }
        }
    }
}

/// Shadows reach further from taller parcels.
fn shadow_reach_mm(height_mm: f32) -> f32 {
    8.0 + 0.35 * height_mm
}
