//! Renders clean frames: belt, rails, soft shadows and cuboids with labels and tape.
//!
//! Every pixel is a ray through the scenario's lens, met with the belt plane once at start.
//! Edges are sampled 16 times over the pixel and the exposure, which is anti-aliasing and
//! motion blur at once; plain surfaces are sampled once. The belt's texture is smooth over
//! several mm, so its own motion blur is left out.

use super::belt::{TEXEL_MM, TILE, texture};
use super::lamps::{Shadow, hidden_share};
use super::scenario::{Material, Parcel, Scenario};
use super::solid::{NOTHING, Solid, TOP};
use crate::camera::{BeltView, Camera};
use crate::error::Result;
use crate::units::{BeltPx, RawPx};
use nalgebra::Vector3;

/// Samples of an edge pixel in each direction.
const SUB: usize = 4;
const RAIL_MM: f32 = 40.0;
/// Brightness falls by this much at a metre from the nadir.
const VIGNETTE: f32 = 0.25;

/// Renderer of one scenario.
pub struct Renderer {
    scenario: Scenario,
    camera: Camera,
    centre: [f32; 3],
    /// Point of the belt plane under each pixel; NaN where the ray misses it.
    ground: Vec<[f32; 2]>,
    tile: Vec<f32>,
    /// Surface seen by each pixel of the parcel being drawn.
    surface: Vec<u8>,
    /// The parcels in view; room for all of them.
    solids: Vec<Solid>,
    /// Light on the belt by each lamp, image after image, as a share of full brightness.
    lamp_light: Vec<f32>,
    /// Where shadows may lie; room for those of all parcels.
    shadows: Vec<Shadow>,
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
        let lamps = &scenario.light.lamps;
        let ground: Vec<[f32; 2]> = ground;
        let lamp_light = lamps
            .iter()
            .flat_map(|lamp| {
                ground.iter().map(|&[x, y]| lamp.irradiance([x, y, 0.0], [0.0, 0.0, 1.0]))
            })
            .collect();
        let shadows = Vec::with_capacity(lamps.len() * scenario.parcels().len());
        let tile = texture(scenario.seed, scenario.belt.texture_grey);
        Ok(Self {
            solids: Vec::with_capacity(scenario.parcels().len()),
            lamp_light,
            shadows,
            scenario,
            centre: [centre.x as f32, centre.y as f32, centre.z as f32],
            ground,
            tile,
            surface: vec![NOTHING; width * height],
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
        self.render_belt(travel_mm, light, frame);
        let solids = self.place_solids(travel_mm);
        for solid in &solids {
            self.cast_shadow(solid, frame);
        }
        self.cast_lamp_shadows(&solids, frame);
        for solid in &solids {
            self.classify(solid);
            self.draw(solid, light, blur_mm, frame);
        }
        self.solids = solids;
    }

    /// Which pixels of a belt view show a parcel in frame `index`: the true foreground. Row by row;
    /// a pixel is what its centre shows.
    pub fn parcel_mask(&mut self, index: u64, view: &BeltView, mask: &mut [bool]) {
        let travel_mm = self.scenario.travel_at_frame_mm(index);
        let solids = self.place_solids(travel_mm);
        let width = view.size_px[0];
        for (i, shows) in mask.iter_mut().enumerate() {
            let px = BeltPx { u: (i % width) as f64, v: (i / width) as f64 };
            let at = view.belt_point(px);
            let ground = [at.x as f32, at.y as f32];
            *shows = solids.iter().any(|s| s.meet(self.centre, ground, 0.0).is_some());
        }
        self.solids = solids;
    }

    fn render_belt(&self, travel_mm: f64, light: f32, frame: &mut [u16]) {
        let belt = &self.scenario.belt;
        let (grey, half_width) = (belt.grey as f32, 0.5 * belt.width_mm as f32);
        // The tile repeats, so only the travel within one tile matters.
        let tile_mm = f64::from(TEXEL_MM) * TILE as f64;
        let offset_mm = (travel_mm.rem_euclid(tile_mm)) as f32;
        let pattern = belt.pattern.as_ref();
        let shift_mm = pattern.map_or(0.0, |p| travel_mm.rem_euclid(p.pitch_mm)) as f32;
        let px_mm = self.px_mm();
        for (i, (out, &[x, y])) in frame.iter_mut().zip(&self.ground).enumerate() {
            let surface = if y.abs() <= half_width {
                let repeated = pattern.map_or(0.0, |p| p.grey(x - shift_mm, y, px_mm));
                (grey + self.texel(x - offset_mm, y) + repeated).max(0.0)
            } else if y.abs() <= half_width + RAIL_MM {
                120.0
            } else {
                12.0
            };
            *out = (surface * self.vignette(x, y) * light * self.lamps_on_belt(i)) as u16;
        }
    }

    /// Size of a pixel on the belt in the middle of the image.
    fn px_mm(&self) -> f32 {
        let [width, height] = self.camera.image_size_px;
        let i = height / 2 * width + width / 2;
        let [a, b] = [self.ground[i], self.ground[i + 1]];
        (a[0] - b[0]).hypot(a[1] - b[1])
    }

    /// Light on the belt at pixel `i` where no parcel is in the way; 1 without lamps.
    fn lamps_on_belt(&self, i: usize) -> f32 {
        let light = &self.scenario.light;
        if light.lamps.is_empty() {
            return 1.0;
        }
        let pixels = self.ground.len();
        let by_lamps = (0..light.lamps.len()).map(|k| self.lamp_light[k * pixels + i]);
        light.ambient as f32 + by_lamps.sum::<f32>()
    }

    /// Take away from the belt what the solids hide of the lamps.
    fn cast_lamp_shadows(&mut self, solids: &[Solid], frame: &mut [u16]) {
        let lamps = &self.scenario.light.lamps;
        let mut shadows = std::mem::take(&mut self.shadows);
        shadows.clear();
        for (k, lamp) in lamps.iter().enumerate() {
            let of_lamp = solids.iter().enumerate().map(|(n, s)| Shadow::new(k, lamp, n, s));
            shadows.extend(of_lamp);
        }
        let pixels = self.ground.len();
        for (i, &ground) in self.ground.iter().enumerate() {
            let mut hidden = 0.0;
            for (k, lamp) in lamps.iter().enumerate() {
                let near = shadows.iter().filter(|s| s.lamp == k && s.may_hold(ground));
                if near.clone().next().is_some() {
                    let share = hidden_share(lamp, ground, &near, solids);
                    hidden += share * self.lamp_light[k * pixels + i];
                }
            }
            if hidden > 0.0 {
                let left = (1.0 - hidden / self.lamps_on_belt(i)).max(0.0);
                frame[i] = (f32::from(frame[i]) * left) as u16;
            }
        }
        self.shadows = shadows;
    }

    /// Light on the top and the sides of a solid; 1 on the top and the usual shades of the sides
    /// without lamps.
    fn light_on(&self, solid: &Solid) -> [f32; 5] {
        let light = &self.scenario.light;
        if light.lamps.is_empty() {
            return [1.0, 0.45, 0.55, 0.5, 0.6];
        }
        let [x, y] = solid.centre;
        let (sin, cos) = (solid.sin, solid.cos);
        let (a, b) = (solid.half[0], solid.half[1]);
        let middle = 0.5 * solid.height;
        let faces = [
            ([x, y, solid.height], [0.0, 0.0, 1.0], 1.0),
            ([x - cos * a, y - sin * a, middle], [-cos, -sin, 0.0], 0.5),
            ([x + cos * a, y + sin * a, middle], [cos, sin, 0.0], 0.5),
            ([x + sin * b, y - cos * b, middle], [sin, -cos, 0.0], 0.5),
            ([x - sin * b, y + cos * b, middle], [-sin, cos, 0.0], 0.5),
        ];
        faces.map(|(at, normal, sky)| {
            let by_lamps: f32 = light.lamps.iter().map(|l| l.irradiance(at, normal)).sum();
            // A side sees half of the sky.
            light.ambient as f32 * sky + by_lamps
        })
    }

    /// Grey levels that the lamps' images add to a glossy top seen over a point of the belt.
    fn glare(&self, solid: &Solid, ground: [f32; 2]) -> f32 {
        if solid.parcel.material != Material::Glossy {
            return 0.0;
        }
        let s = 1.0 - solid.height / self.centre[2];
        let [x, y] = [0, 1].map(|k| self.centre[k] + s * (ground[k] - self.centre[k]));
        let lamps = self.scenario.light.lamps.iter();
        lamps.map(|l| l.glare(self.centre, [x, y, solid.height])).sum()
    }

    /// Bilinear texture at a point of the belt.
    fn texel(&self, x_mm: f32, y_mm: f32) -> f32 {
        // Far enough from 0 that truncation is floor.
        let shift = (64 * TILE) as f32;
        let (u, v) = (x_mm / TEXEL_MM + shift, y_mm / TEXEL_MM + shift);
        let (iu, iv) = (u as usize, v as usize);
        let (fu, fv) = (u - iu as f32, v - iv as f32);
        let at = |u: usize, v: usize| self.tile[(v % TILE) * TILE + u % TILE];
        let top = at(iu, iv) * (1.0 - fu) + at(iu + 1, iv) * fu;
        let bottom = at(iu, iv + 1) * (1.0 - fu) + at(iu + 1, iv + 1) * fu;
        top * (1.0 - fv) + bottom * fv
    }

    fn vignette(&self, x: f32, y: f32) -> f32 {
        let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
        (1.0 - VIGNETTE * 1e-6 * (dx * dx + dy * dy)).max(0.2)
    }

    /// The parcels in view, furthest from the nadir first: nearer ones lean over them. The list
    /// is lent, so that rendering allocates nothing.
    fn place_solids(&mut self, travel_mm: f64) -> Vec<Solid> {
        let mut solids = std::mem::take(&mut self.solids);
        solids.clear();
        solids.extend(self.scenario.parcels().iter().filter_map(|p| self.solid(p, travel_mm)));
        let distance =
            |s: &Solid| (s.centre[0] - self.centre[0]).hypot(s.centre[1] - self.centre[1]);
        solids.sort_unstable_by(|a, b| distance(b).total_cmp(&distance(a)));
        solids
    }

    fn solid(&self, parcel: &Parcel, travel_mm: f64) -> Option<Solid> {
        let (sin, cos) = parcel.yaw_deg.to_radians().sin_cos();
        let x_mm = parcel.x_mm + travel_mm;
        // Room for shadow and blur around the solid itself.
        let margin_mm = shadow_reach_mm(parcel.height_mm as f32) as f64 + 5.0;
        let mut bounds = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
        for k in 0..8 {
            let sign = |bit: i32| if k >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let z = if k & 4 == 4 { parcel.height_mm } else { 0.0 };
            let a = sign(0) * (0.5 * parcel.length_mm + margin_mm);
            let b = sign(1) * (0.5 * parcel.width_mm + margin_mm);
            let at = Vector3::new(x_mm + cos * a - sin * b, parcel.y_mm + sin * a + cos * b, z);
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
        let mut solid = Solid {
            parcel: *parcel,
            radius: self.scenario.edge_radius_mm.min(0.45 * parcel.height_mm) as f32,
            centre: [x_mm as f32, parcel.y_mm as f32],
            sin: sin as f32,
            cos: cos as f32,
            half: [0.5 * parcel.length_mm as f32, 0.5 * parcel.width_mm as f32],
            height: parcel.height_mm as f32,
            light: [1.0; 5],
            bounds,
        };
        solid.light = self.light_on(&solid);
        Some(solid)
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
            self.surface[i] =
                solid.meet(self.centre, self.ground[i], 0.0).map_or(NOTHING, |hit| hit.surface);
        }
    }

    fn draw(&self, solid: &Solid, light: f32, blur_mm: f32, frame: &mut [u16]) {
        let [u0, u1, v0, v1] = solid.bounds;
        let width = self.camera.image_size_px[0];
        // The outermost pixels were given a margin and show nothing.
        for v in v0 + 1..v1 - 1 {
            for u in u0 + 1..u1 - 1 {
                let i = v * width + u;
                let here = self.surface[i];
                let plain =
                    [i - 1, i + 1, i - width, i + width].iter().all(|&n| self.surface[n] == here);
                if plain && here == NOTHING {
                    continue;
                }
                let ground = self.ground[i];
                let shade = self.vignette(ground[0], ground[1]) * light;
                let sampled = if plain {
                    solid.meet(self.centre, ground, 0.0).map(|hit| hit.grey * shade)
                } else {
                    Some(self.supersample(solid, i, shade, blur_mm, f32::from(frame[i])))
                };
                if let Some(value) = sampled {
                    let glare = if here == TOP { self.glare(solid, ground) * shade } else { 0.0 };
                    frame[i] = (value + glare) as u16;
                }
            }
        }
    }

    /// Mean over the pixel's area and the exposure; `behind` shows where the solid does not.
    fn supersample(&self, solid: &Solid, i: usize, shade: f32, blur_mm: f32, behind: f32) -> f32 {
        let width = self.camera.image_size_px[0];
        let difference =
            |a: usize, b: usize| [0, 1].map(|k| 0.5 * (self.ground[a][k] - self.ground[b][k]));
        let (du, dv) = (difference(i + 1, i - 1), difference(i + width, i - width));
        let mut sum = 0.0;
        for k in 0..SUB * SUB {
            let place = |n: usize| (n as f32 + 0.5) / SUB as f32 - 0.5;
            let (a, b) = (place(k % SUB), place(k / SUB));
            let ground = [0, 1].map(|c| self.ground[i][c] + a * du[c] + b * dv[c]);
            // 7 is coprime to 16: times are spread evenly over every row and column.
            let time = ((k * 7 % (SUB * SUB)) as f32 + 0.5) / (SUB * SUB) as f32 - 0.5;
            sum += solid
                .meet_rounded(self.centre, ground, time * blur_mm)
                .map_or(behind, |grey| grey * shade);
        }
        sum / (SUB * SUB) as f32
    }
}

/// Shadows reach further from taller parcels.
fn shadow_reach_mm(height_mm: f32) -> f32 {
    8.0 + 0.35 * height_mm
}
