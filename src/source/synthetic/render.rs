//! Renders clean frames: belt, rails, soft shadows and cuboids with labels and tape.
//!
//! Every pixel is a ray through the scenario's lens, met with the belt plane once at start.
//! Edges are sampled 16 times over the pixel and the exposure, which is anti-aliasing and
//! motion blur at once; plain surfaces are sampled once. The belt's texture is smooth over
//! several mm, so its own motion blur is left out.

use super::random::Random;
use super::scenario::{Material, Parcel, Scenario};
use crate::camera::{BeltView, Camera};
use crate::error::Result;
use crate::units::{BeltPx, RawPx};
use nalgebra::Vector3;

/// Texture tile: side in texels (a power of two) and their size.
const TILE: usize = 1024;
const TEXEL_MM: f32 = 1.5;
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
}

/// No parcel surface.
const NOTHING: u8 = 0;

/// A parcel in one frame, ready to be met by rays.
struct Solid {
    parcel: Parcel,
    /// Of its edges.
    radius: f32,
    centre: [f32; 2],
    sin: f32,
    cos: f32,
    half: [f32; 2],
    height: f32,
    /// Pixels it may cover: first and one past last column and row.
    bounds: [usize; 4],
}

/// Where a ray meets a solid: surface identity and grey level.
struct Hit {
    surface: u8,
    grey: f32,
}

/// A ray through a solid; its places are `from + s * along`.
struct Crossing {
    from: [f32; 3],
    along: [f32; 3],
    enter: f32,
    leave: f32,
    /// 0: top; 1, 2: the sides across the length; 3, 4: the others.
    face: usize,
}

impl Crossing {
    fn at(&self, s: f32) -> [f32; 3] {
        [0, 1, 2].map(|k| self.from[k] + s * self.along[k])
    }
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
        let tile = texture(scenario.seed, scenario.belt.texture_grey);
        Ok(Self {
            solids: Vec::with_capacity(scenario.parcels().len()),
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
        for (out, &[x, y]) in frame.iter_mut().zip(&self.ground) {
            let surface = if y.abs() <= half_width {
                grey + self.texel(x - offset_mm, y)
            } else if y.abs() <= half_width + RAIL_MM {
                120.0
            } else {
                12.0
            };
            *out = (surface * self.vignette(x, y) * light) as u16;
        }
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
        (bounds[0] < bounds[1] && bounds[2] < bounds[3]).then_some(Solid {
            parcel: *parcel,
            radius: self.scenario.edge_radius_mm.min(0.45 * parcel.height_mm) as f32,
            centre: [x_mm as f32, parcel.y_mm as f32],
            sin: sin as f32,
            cos: cos as f32,
            half: [0.5 * parcel.length_mm as f32, 0.5 * parcel.width_mm as f32],
            height: parcel.height_mm as f32,
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
                    frame[i] = value as u16;
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

impl Solid {
    /// A belt point in the parcel's own axes.
    fn local(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
        [self.cos * dx + self.sin * dy, self.cos * dy - self.sin * dx]
    }

    /// The ray from the camera to `ground`, in the axes of the solid moved by `shift_mm`, and the
    /// part of it that is in the cuboid with sharp edges, from the face it enters by.
    fn cross(&self, camera: [f32; 3], ground: [f32; 2], shift_mm: f32) -> Option<Crossing> {
        let from = self.local([camera[0] - shift_mm, camera[1]]);
        let to = self.local([ground[0] - shift_mm, ground[1]]);
        // Slab method; s runs from the camera (0) to the belt (1). Source: Kay and Kajiya 1986.
        let (mut enter, mut leave, mut face) = (1.0 - self.height / camera[2], 1.0, 0);
        for axis in 0..2 {
            let along = to[axis] - from[axis];
            let at = |plane: f32| (plane - from[axis]) / along;
            let (near, far) = if along > 0.0 {
                (at(-self.half[axis]), at(self.half[axis]))
            } else {
                (at(self.half[axis]), at(-self.half[axis]))
            };
            if near > enter {
                enter = near;
                face = 1 + 2 * axis + usize::from(along < 0.0);
            }
            leave = f32::min(leave, far);
        }
        // A ray that misses the belt is NaN, and so is everything met by it.
        let hit = enter.partial_cmp(&leave) == Some(std::cmp::Ordering::Less);
        hit.then_some(Crossing {
            from: [from[0], from[1], camera[2]],
            along: [to[0] - from[0], to[1] - from[1], -camera[2]],
            enter,
            leave,
            face,
        })
    }

    /// Where a ray meets the solid as if its edges were sharp.
    fn meet(&self, camera: [f32; 3], ground: [f32; 2], shift_mm: f32) -> Option<Hit> {
        let ray = self.cross(camera, ground, shift_mm)?;
        Some(self.shade_sharp(&ray, ray.at(ray.enter)))
    }

    fn shade_sharp(&self, ray: &Crossing, [a, b, z]: [f32; 3]) -> Hit {
        if ray.face == 0 { self.top([a, b]) } else { self.side(ray.face, z) }
    }

    /// Grey level where a ray meets the solid with its rounded edges: sphere tracing (Hart 1996)
    /// from the sharp cuboid's surface on. Radiance goes from the top's to the side's with
    /// the cosine of the normal's tilt, as under diffuse light.
    fn meet_rounded(&self, camera: [f32; 3], ground: [f32; 2], shift_mm: f32) -> Option<f32> {
        const NEAR_MM: f32 = 0.02;
        const STEPS: usize = 16;
        let ray = self.cross(camera, ground, shift_mm)?;
        let [a, b, z] = ray.at(ray.enter);
        let core = |k: usize, at: f32| at.abs() <= self.half[k] - self.radius;
        if ray.face == 0 && core(0, a) && core(1, b) {
            return Some(self.top([a, b]).grey);
        }
        if self.radius == 0.0 {
            return Some(self.shade_sharp(&ray, [a, b, z]).grey);
        }
        let length = ray.along.iter().map(|a| a * a).sum::<f32>().sqrt();
        let mut s = ray.enter;
        for _ in 0..STEPS {
            let p = ray.at(s);
            // It goes on below the belt, so that its bottom edges are not rounded.
            let core = [
                p[0].abs() - (self.half[0] - self.radius),
                p[1].abs() - (self.half[1] - self.radius),
                p[2] - (self.height - self.radius),
            ];
            let outside = core.map(|c| c.max(0.0));
            let distance = outside.iter().map(|c| c * c).sum::<f32>().sqrt() - self.radius
                + core[0].max(core[1]).max(core[2]).min(0.0);
            if distance < NEAR_MM {
                return Some(self.shade(p, outside));
            }
            s += distance / length;
            if s > ray.leave {
                return None;
            }
        }
        None
    }

    /// Grey level at a point of the surface whose normal has the direction `normal` in the
    /// octant of the point.
    fn shade(&self, [a, b, z]: [f32; 3], normal: [f32; 3]) -> f32 {
        let [x2, y2, z2] = normal.map(|n| n * n);
        let top = || self.top([a, b]).grey;
        if x2 + y2 == 0.0 {
            return top();
        }
        let side_x = || self.side(1 + usize::from(a > 0.0), z).grey;
        let side_y = || self.side(3 + usize::from(b > 0.0), z).grey;
        let side = (x2 * side_x() + y2 * side_y()) / (x2 + y2);
        let cosine = (z2 / (x2 + y2 + z2)).sqrt();
        if cosine == 0.0 { side } else { side + cosine * (top() - side) }
    }

    /// Top face: plain, tape along the middle, label with bars.
    fn top(&self, [a, b]: [f32; 2]) -> Hit {
        let plain = match self.parcel.material {
            Material::Kraft => 105.0,
            Material::White => 190.0,
            Material::Dark => 20.0,
        };
        // A label in one quarter, up to 80 x 50 mm.
        let label = [(0.4 * self.half[0]).min(40.0), (0.4 * self.half[1]).min(25.0)];
        let (la, lb) = (a + 0.45 * self.half[0], b - 0.4 * self.half[1]);
        if la.abs() < label[0] && lb.abs() < label[1] {
            let bar = lb < 0.0 && ((la + label[0]) / 3.0) as u32 % 2 == 1;
            return if bar {
                Hit { surface: 3, grey: 40.0 }
            } else {
                Hit { surface: 2, grey: 215.0 }
            };
        }
        let tape_half = (0.25 * self.half[1]).min(25.0);
        if self.parcel.material == Material::Kraft && b.abs() < tape_half {
            return Hit { surface: 4, grey: 135.0 };
        }
        Hit { surface: 1, grey: plain }
    }

    /// Side face: darker than the top, and towards the belt.
    fn side(&self, face: usize, z_mm: f32) -> Hit {
        let top = match self.parcel.material {
            Material::Kraft => 105.0,
            Material::White => 190.0,
            Material::Dark => 20.0,
        };
        let turned = [0.45, 0.55, 0.5, 0.6][face - 1];
        let lower = 0.7 + 0.3 * (z_mm / self.height).clamp(0.0, 1.0);
        Hit { surface: 4 + face as u8, grey: top * turned * lower }
    }
}

/// Smooth belt texture with scratches, mean 0, standard deviation `sigma`.
fn texture(seed: u64, sigma: f64) -> Vec<f32> {
    let mut random = Random(seed ^ 0x7465_7874);
    let mut tile: Vec<f32> = (0..TILE * TILE).map(|_| random.normal() as f32).collect();
    for _ in 0..3 {
        tile = blurred(&tile);
    }
    for _ in 0..40 {
        let (mut u, mut v) = (random.unit() * TILE as f64, random.unit() * TILE as f64);
        let angle = random.between([-0.4, 0.4]);
        let depth = random.between([-0.5, 0.5]) as f32;
        for _ in 0..60 {
            tile[(v as usize % TILE) * TILE + u as usize % TILE] += depth;
            u += angle.cos();
            v = (v + angle.sin()).rem_euclid(TILE as f64);
        }
    }
    tile = blurred(&tile);
    let variance = tile.iter().map(|t| t * t).sum::<f32>() / tile.len() as f32;
    let scale = sigma as f32 / variance.sqrt().max(f32::MIN_POSITIVE);
    tile.iter().map(|t| t * scale).collect()
}

/// 3x3 mean on the torus.
fn blurred(tile: &[f32]) -> Vec<f32> {
    let at = |u: usize, v: usize| tile[(v % TILE) * TILE + u % TILE];
    let mut out = Vec::with_capacity(tile.len());
    for v in TILE..2 * TILE {
        for u in TILE..2 * TILE {
            let near = (v - 1..v + 2).flat_map(|v| (u - 1..u + 2).map(move |u| (u, v)));
            out.push(near.map(|(u, v)| at(u, v)).sum::<f32>() / 9.0);
        }
    }
    out
}
