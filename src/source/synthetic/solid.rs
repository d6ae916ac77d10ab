//! A parcel in one frame: how rays meet it and what they see.

use super::scenario::{Material, Parcel};

/// No parcel surface.
pub(super) const NOTHING: u8 = 0;
/// The top, where nothing is stuck or printed on it.
pub(super) const TOP: u8 = 1;
/// The first of the inks.
const PRINT: u8 = 16;

/// A parcel in one frame, ready to be met by rays.
pub(super) struct Solid {
    pub(super) parcel: Parcel,
    /// Of its edges.
    pub(super) radius: f32,
    pub(super) centre: [f32; 2],
    pub(super) sin: f32,
    pub(super) cos: f32,
    pub(super) half: [f32; 2],
    pub(super) height: f32,
    /// Light on its top and on its four sides.
    pub(super) light: [f32; 5],
    /// Pixels it may cover: first and one past last column and row.
    pub(super) bounds: [usize; 4],
}

/// Where a ray meets a solid: surface identity and grey level.
pub(super) struct Hit {
    pub(super) surface: u8,
    pub(super) grey: f32,
}

/// A ray through a solid; its places are `from + s * along`.
pub(super) struct Crossing {
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

impl Solid {
    /// The corners of the top, along and across the belt.
    pub(super) fn corners(&self) -> [[f32; 2]; 4] {
        [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)].map(|(i, j)| {
            let (a, b) = (i * self.half[0], j * self.half[1]);
            let (x, y) = (self.cos * a - self.sin * b, self.sin * a + self.cos * b);
            [self.centre[0] + x, self.centre[1] + y]
        })
    }

    /// A belt point in the parcel's own axes.
    pub(super) fn local(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (dx, dy) = (x - self.centre[0], y - self.centre[1]);
        [self.cos * dx + self.sin * dy, self.cos * dy - self.sin * dx]
    }

    /// The ray from the camera to `ground`, in the axes of the solid moved by `shift_mm`, and the
    /// part of it that is in the cuboid with sharp edges, from the face it enters by.
    pub(super) fn cross(
        &self,
        camera: [f32; 3],
        ground: [f32; 2],
        shift_mm: f32,
    ) -> Option<Crossing> {
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
    pub(super) fn meet(&self, camera: [f32; 3], ground: [f32; 2], shift_mm: f32) -> Option<Hit> {
        let ray = self.cross(camera, ground, shift_mm)?;
        Some(self.shade_sharp(&ray, ray.at(ray.enter)))
    }

    fn shade_sharp(&self, ray: &Crossing, [a, b, z]: [f32; 3]) -> Hit {
        if ray.face == 0 { self.top([a, b]) } else { self.side(ray.face, z) }
    }

    /// Grey level where a ray meets the solid with its rounded edges: sphere tracing (Hart 1996)
    /// from the sharp cuboid's surface on. Radiance goes from the top's to the side's with
    /// the cosine of the normal's tilt, as under diffuse light.
    pub(super) fn meet_rounded(
        &self,
        camera: [f32; 3],
        ground: [f32; 2],
        shift_mm: f32,
    ) -> Option<f32> {
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

    /// Grey level of the bare surface in full light.
    fn plain_grey(&self) -> f32 {
        match self.parcel.material {
            Material::Kraft => 105.0,
            Material::White | Material::Printed => 190.0,
            Material::Glossy => 150.0,
            Material::Dark => 20.0,
        }
    }

    /// Top face: plain, tape along the middle, label with bars.
    fn top(&self, [a, b]: [f32; 2]) -> Hit {
        let light = self.light[0];
        let plain = self.plain_grey() * light;
        // A label in one quarter, up to 80 x 50 mm.
        let label = [(0.4 * self.half[0]).min(40.0), (0.4 * self.half[1]).min(25.0)];
        let (la, lb) = (a + 0.45 * self.half[0], b - 0.4 * self.half[1]);
        if la.abs() < label[0] && lb.abs() < label[1] {
            let bar = lb < 0.0 && ((la + label[0]) / 3.0) as u32 % 2 == 1;
            return if bar {
                Hit { surface: 3, grey: 40.0 * light }
            } else {
                Hit { surface: 2, grey: 215.0 * light }
            };
        }
        let tape_half = (0.25 * self.half[1]).min(25.0);
        if self.parcel.material == Material::Kraft && b.abs() < tape_half {
            return Hit { surface: 4, grey: 135.0 * light };
        }
        if self.parcel.material == Material::Printed {
            // Blocks of ink, in no order that repeats soon.
            let (i, j) = ((a / 17.0).floor(), (b / 11.0).floor());
            let ink = (i * 12.9898 + j * 78.233).sin() * 43758.547;
            let step = ((ink - ink.floor()) * 4.0) as u8;
            return Hit { surface: PRINT + step, grey: plain * (1.0 - 0.2 * f32::from(step)) };
        }
        Hit { surface: TOP, grey: plain }
    }

    /// Side face: darker than the top, and towards the belt.
    fn side(&self, face: usize, z_mm: f32) -> Hit {
        let (top, turned) = (self.plain_grey(), self.light[face]);
        let lower = 0.7 + 0.3 * (z_mm / self.height).clamp(0.0, 1.0);
        Hit { surface: 4 + face as u8, grey: top * turned * lower }
    }
}
