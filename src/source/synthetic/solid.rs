//! A parcel in one frame: how rays meet it and what they see.

use super::parcel::Parcel;
use super::surface::{self, INSIDE, Surface};

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
    /// Shades of its top and its four sides where there are no lamps.
    pub(super) shades: [f32; 5],
    /// Pixels it may cover: first and one past last column and row.
    pub(super) bounds: [usize; 4],
}

/// Where a ray meets a solid: place and outward direction in the solid's own axes, and what is there.
#[derive(Clone, Copy)]
pub(super) struct Hit {
    pub(super) at: [f32; 3],
    pub(super) normal: [f32; 3],
    pub(super) surface: Surface,
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

/// Outward direction of a face.
fn outward(face: usize) -> [f32; 3] {
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]][face]
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

    /// A point and a direction of the parcel's own axes in those of the belt.
    pub(super) fn in_belt(&self, hit: &Hit) -> ([f32; 3], [f32; 3]) {
        let turned =
            |[a, b, z]: [f32; 3]| [self.cos * a - self.sin * b, self.sin * a + self.cos * b, z];
        let [x, y, z] = turned(hit.at);
        ([self.centre[0] + x, self.centre[1] + y, z], turned(hit.normal))
    }

    /// The way from a point above all solids to another, in the axes of the solid moved by `shift_mm`,
    /// and the part of it that is in the cuboid with sharp edges, from the face it enters by.
    pub(super) fn cross(&self, from: [f32; 3], to: [f32; 3], shift_mm: f32) -> Option<Crossing> {
        let start = self.local([from[0] - shift_mm, from[1]]);
        let end = self.local([to[0] - shift_mm, to[1]]);
        // Slab method; s runs from the one point (0) to the other (1). Source: Kay and Kajiya 1986.
        let drop = from[2] - to[2];
        let (mut enter, mut leave, mut face) = (1.0 - (self.height - to[2]) / drop, 1.0, 0);
        for axis in 0..2 {
            let along = end[axis] - start[axis];
            let at = |plane: f32| (plane - start[axis]) / along;
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
            from: [start[0], start[1], from[2]],
            along: [end[0] - start[0], end[1] - start[1], -drop],
            enter,
            leave,
            face,
        })
    }

    /// Whether its surface is that of its cuboid, but for rounded edges.
    fn is_plain(&self) -> bool {
        self.parcel.shape.is_box() && self.parcel.crush_mm == 0.0
    }

    /// Whether it is in the way from a point above it to another.
    pub(super) fn hides(&self, from: [f32; 3], to: [f32; 3]) -> bool {
        self.cross(from, to, 0.0).is_some_and(|ray| {
            let (shape, half, height) = (self.parcel.shape, self.half, self.height);
            let of_cuboids =
                || shape.is_met([ray.from, ray.along], [ray.enter, ray.leave], half, height);
            let met = if self.parcel.crush_mm == 0.0 { of_cuboids() } else { None };
            met.unwrap_or_else(|| self.reaches(&ray))
        })
    }

    /// Whether it is in the way from a point above it to a point of its own surface.
    pub(super) fn hides_itself(&self, from: [f32; 3], at: [f32; 3], normal: [f32; 3]) -> bool {
        // Off the surface by more than the ray's last step, so that a face is not in its own way.
        const OFF_MM: f32 = 3.0;
        let off = [0, 1, 2].map(|k| at[k] + OFF_MM * normal[k]);
        self.hides(from, off)
    }

    /// Where the camera's ray to a point of the belt meets the solid, as if its edges were sharp.
    pub(super) fn meet(&self, camera: [f32; 3], [x, y]: [f32; 2], shift_mm: f32) -> Option<Hit> {
        let ray = self.cross(camera, [x, y, 0.0], shift_mm)?;
        if self.is_plain() { Some(self.sharp(&ray)) } else { self.march(&ray) }
    }

    fn sharp(&self, ray: &Crossing) -> Hit {
        let at @ [a, b, z] = ray.at(ray.enter);
        let surface = if ray.face == 0 { self.top([a, b]) } else { self.side(ray.face, a, z) };
        Hit { at, normal: outward(ray.face), surface }
    }

    /// Where a ray meets the solid with its rounded edges: sphere tracing (Hart 1996) from the sharp
    /// cuboid's surface on.
    pub(super) fn meet_rounded(
        &self,
        camera: [f32; 3],
        [x, y]: [f32; 2],
        shift_mm: f32,
    ) -> Option<Hit> {
        const NEAR_MM: f32 = 0.02;
        const STEPS: usize = 16;
        let ray = self.cross(camera, [x, y, 0.0], shift_mm)?;
        if !self.is_plain() {
            return self.march(&ray);
        }
        let [a, b, _] = ray.at(ray.enter);
        let core = |k: usize, at: f32| at.abs() <= self.half[k] - self.radius;
        if self.radius == 0.0 || ray.face == 0 && core(0, a) && core(1, b) {
            return Some(self.sharp(&ray));
        }
        let length = ray.along.iter().map(|a| a * a).sum::<f32>().sqrt();
        let mut s = ray.enter;
        for _ in 0..STEPS {
            let p = ray.at(s);
            let (distance, outside) = self.rounded(p);
            if distance < NEAR_MM {
                let normal = [outside[0].copysign(p[0]), outside[1].copysign(p[1]), outside[2]];
                return Some(self.curved(p, normal));
            }
            s += distance / length;
            if s > ray.leave {
                return None;
            }
        }
        None
    }

    /// Distance from the cuboid with rounded edges, and how far beyond its core along each axis. It goes
    /// on below the belt, so that its bottom edges are not rounded.
    fn rounded(&self, p: [f32; 3]) -> (f32, [f32; 3]) {
        let core = [
            p[0].abs() - (self.half[0] - self.radius),
            p[1].abs() - (self.half[1] - self.radius),
            p[2] - (self.height - self.radius),
        ];
        let outside = core.map(|c| c.max(0.0));
        let distance = outside.iter().map(|c| c * c).sum::<f32>().sqrt() - self.radius
            + core[0].max(core[1]).max(core[2]).min(0.0);
        (distance, outside)
    }

    /// A bound on the distance of a point from its surface.
    fn distance(&self, p: [f32; 3]) -> f32 {
        let shape = self.parcel.shape;
        let whole = if shape.is_box() {
            self.rounded(p).0
        } else {
            shape.distance(p, self.half, self.height)
        };
        if self.parcel.crush_mm == 0.0 {
            return whole;
        }
        // A plane cuts the pressed corner off.
        let corner = self.half[0] + self.half[1] + self.height - self.parcel.crush_mm as f32;
        whole.max((p[0] + p[1] + p[2] - corner) / 3.0f32.sqrt())
    }

    /// Direction away from its surface near a point of it, of length 1.
    fn normal(&self, at: [f32; 3]) -> [f32; 3] {
        const STEP_MM: f32 = 0.1;
        let slope = [0, 1, 2].map(|k| {
            let moved = |by: f32| {
                let mut at = at;
                at[k] += by;
                self.distance(at)
            };
            moved(STEP_MM) - moved(-STEP_MM)
        });
        let length = slope.iter().map(|s| s * s).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
        slope.map(|s| s / length)
    }

    /// Whether a ray meets what is no plain cuboid, to a mm: shadows are no sharper.
    fn reaches(&self, ray: &Crossing) -> bool {
        const NEAR_MM: f32 = 1.0;
        const STEPS: usize = 24;
        let length = ray.along.iter().map(|a| a * a).sum::<f32>().sqrt();
        let mut s = ray.enter;
        for _ in 0..STEPS {
            let distance = self.distance(ray.at(s));
            if distance < NEAR_MM {
                return true;
            }
            s += distance / length;
            if s > ray.leave {
                return false;
            }
        }
        false
    }

    /// Where a ray meets what is no plain cuboid: sphere tracing through its cuboid.
    fn march(&self, ray: &Crossing) -> Option<Hit> {
        const NEAR_MM: f32 = 0.05;
        const STEPS: usize = 96;
        let length = ray.along.iter().map(|a| a * a).sum::<f32>().sqrt();
        let shape = self.parcel.shape;
        let mut s = ray.enter;
        for _ in 0..STEPS {
            let at = ray.at(s);
            let distance = self.distance(at);
            if distance < NEAR_MM {
                let mut hit = self.curved(at, self.normal(at));
                let open = shape.openness(at, self.half, self.height);
                if open < 1.0 {
                    hit.surface.id += INSIDE;
                    hit.surface.grey *= open;
                }
                return Some(hit);
            }
            s += distance / length;
            if s > ray.leave {
                return None;
            }
        }
        None
    }

    /// What is at a point of the surface with an outward direction of any length. Radiance goes from
    /// the top's to the side's with the cosine of its tilt, as under diffuse light.
    fn curved(&self, at: [f32; 3], normal: [f32; 3]) -> Hit {
        let [a, b, z] = at;
        let [x2, y2, z2] = normal.map(|n| n * n);
        if x2 + y2 == 0.0 {
            return Hit { at, normal: [0.0, 0.0, 1.0], surface: self.top([a, b]) };
        }
        let side_x = self.side(1 + usize::from(normal[0] > 0.0), a, z);
        let side_y = self.side(3 + usize::from(normal[1] > 0.0), a, z);
        let side_grey = (x2 * side_x.grey + y2 * side_y.grey) / (x2 + y2);
        let cosine = (z2 / (x2 + y2 + z2)).sqrt();
        let length = (x2 + y2 + z2).sqrt();
        let normal = normal.map(|n| n / length);
        // What hangs over sees the belt only.
        if cosine == 0.0 || normal[2] < 0.0 {
            let id = if x2 > y2 { side_x.id } else { side_y.id };
            return Hit { at, normal, surface: Surface { id, grey: side_grey } };
        }
        let top = self.top([a, b]);
        let grey = side_grey + cosine * (top.grey - side_grey);
        let id = if cosine > 0.5 {
            top.id
        } else if x2 > y2 {
            side_x.id
        } else {
            side_y.id
        };
        Hit { at, normal, surface: Surface { id, grey } }
    }

    fn top(&self, at: [f32; 2]) -> Surface {
        let surface = surface::top(&self.parcel, self.half, at);
        Surface { grey: surface.grey * self.shades[0], ..surface }
    }

    fn side(&self, face: usize, a: f32, z: f32) -> Surface {
        surface::side(&self.parcel, self.half, face, self.shades[face], [a, z / self.height])
    }
}
