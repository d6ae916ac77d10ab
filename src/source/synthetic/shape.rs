//! Shapes of what rides, as distances: how far at least a point is from the surface, negative inside.
//!
//! Every shape touches all six faces of its cuboid: half sides `half` around the middle of the footprint,
//! from the belt to `height`. Source of the distances: Hart 1996.

use serde::Deserialize;

/// What a parcel's outline is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// A cuboid.
    #[default]
    Box,
    /// A cylinder that lies along its length.
    Tube,
    /// A full bag: round everywhere.
    Bag,
    /// An open box with walls.
    Tote,
    /// A smaller box on a larger one.
    Stack,
    /// A padded envelope: thick in the middle, thin at the rim.
    Envelope,
    /// Covers that stand over the pages on three sides.
    Book,
}

/// Walls and floor of a tote.
const WALL_MM: f32 = 4.0;
/// Where the lower box of a stack ends, and how large the upper one is.
const STACK_STEP: f32 = 0.55;
const STACK_UPPER: [f32; 2] = [0.62, 0.7];
/// How far a book's covers stand over.
const COVER_OVER_MM: f32 = 4.0;
/// Thickness of an envelope's rim, as a share.
const ENVELOPE_RIM: f32 = 0.35;
/// Where a bag is widest, as a share of its height.
const BAG_WAIST: f32 = 0.4;

/// A cuboid along the axes of a shape.
#[derive(Clone, Copy)]
struct Slab {
    low: f32,
    high: f32,
    half: [f32; 2],
    /// Its middle.
    aside: [f32; 2],
}

impl Slab {
    fn distance(self, [a, b, z]: [f32; 3]) -> f32 {
        let Self { low, high, half, aside } = self;
        let core = [
            (a - aside[0]).abs() - half[0],
            (b - aside[1]).abs() - half[1],
            (z - 0.5 * (low + high)).abs() - 0.5 * (high - low),
        ];
        let outside: f32 = core.iter().map(|c| c.max(0.0).powi(2)).sum();
        outside.sqrt() + core[0].max(core[1]).max(core[2]).min(0.0)
    }

    /// Where a ray enters and leaves it; the second is less than the first where it does not.
    fn crossed(self, from: [f32; 3], along: [f32; 3]) -> [f32; 2] {
        let Self { low, high, half: [a, b], aside: [u, v] } = self;
        let sides = [[u - a, u + a], [v - b, v + b], [low, high]];
        (0..3).fold([f32::MIN, f32::MAX], |[enter, leave], k| {
            let [one, other] = sides[k].map(|side| (side - from[k]) / along[k]);
            [enter.max(one.min(other)), leave.min(one.max(other))]
        })
    }
}

/// What a tote holds; it is open above.
fn cavity(half: [f32; 2], height: f32) -> Slab {
    let half = half.map(|h| (h - WALL_MM).max(0.0));
    Slab { low: WALL_MM, high: 2.0 * height, half, aside: [0.0; 2] }
}

fn stack(half: [f32; 2], height: f32) -> [Slab; 2] {
    let step = STACK_STEP * height;
    let upper = [half[0] * STACK_UPPER[0], half[1] * STACK_UPPER[1]];
    let aside = [0.2 * half[0], -0.15 * half[1]];
    [
        Slab { low: 0.0, high: step, half, aside: [0.0; 2] },
        Slab { low: step, high: height, half: upper, aside },
    ]
}

/// Pages and two covers; the spine is at one long side.
fn book(half: [f32; 2], height: f32) -> [Slab; 3] {
    let cover = (0.15 * height).min(3.0);
    let over = COVER_OVER_MM.min(0.2 * half[1]);
    let pages = [half[0] - over, half[1] - 0.5 * over];
    [
        Slab { low: 0.0, high: height, half: pages, aside: [0.0, -0.5 * over] },
        Slab { low: 0.0, high: cover, half, aside: [0.0; 2] },
        Slab { low: height - cover, high: height, half, aside: [0.0; 2] },
    ]
}

impl Shape {
    /// Whether it is a cuboid for whoever measures it.
    pub fn is_box(self) -> bool {
        matches!(self, Self::Box)
    }

    /// A bound on the distance of a point from the surface.
    pub(super) fn distance(self, [a, b, z]: [f32; 3], half: [f32; 2], height: f32) -> f32 {
        let at = [a, b, z];
        let nearest = |slabs: &[Slab]| {
            slabs.iter().map(|slab| slab.distance(at)).fold(f32::INFINITY, f32::min)
        };
        let whole = || Slab { low: 0.0, high: height, half, aside: [0.0; 2] }.distance(at);
        match self {
            Self::Box => whole(),
            Self::Tube => {
                // Squeezed to a circle of the smaller half side: a bound from below.
                let (tall, wide) = (0.5 * height, half[1]);
                let radius = tall.min(wide);
                let (across, up) = (b * radius / wide, (z - tall) * radius / tall);
                let round = (across * across + up * up).sqrt() - radius;
                round.max(a.abs() - half[0])
            }
            Self::Bag => {
                let waist = BAG_WAIST * height;
                let up = if z > waist { height - waist } else { waist };
                // Squarer than an ellipsoid, whose power is 2.
                let sum: f32 = [a / half[0], b / half[1], (z - waist) / up]
                    .iter()
                    .map(|c| c.abs() * c * c)
                    .sum();
                (sum.cbrt() - 1.0) * half[0].min(half[1]).min(up)
            }
            Self::Tote => whole().max(-cavity(half, height).distance(at)),
            Self::Stack => nearest(&stack(half, height)),
            Self::Envelope => {
                let rim = (a / half[0]).abs().max((b / half[1]).abs()).min(1.0);
                let top = height * (1.0 - (1.0 - ENVELOPE_RIM) * rim.powi(4));
                let steepest = 4.0 * (1.0 - ENVELOPE_RIM) * height / half[0].min(half[1]);
                whole().max((z - top) / (1.0 + steepest * steepest).sqrt())
            }
            Self::Book => nearest(&book(half, height)),
        }
    }

    /// Whether one part of it may be in another's light.
    pub(super) fn shades_itself(self) -> bool {
        matches!(self, Self::Tote | Self::Stack)
    }

    /// Whether the part of a ray from `enter` to `leave` meets it, of shapes that are made of cuboids; `None`
    /// of others. Places of the ray are `from + s * along`.
    pub(super) fn is_met(
        self,
        [from, along]: [[f32; 3]; 2],
        [enter, leave]: [f32; 2],
        half: [f32; 2],
        height: f32,
    ) -> Option<bool> {
        let within = |slab: Slab| {
            let [near, far] = slab.crossed(from, along);
            [near.max(enter), far.min(leave)]
        };
        let meets = |slab: Slab| {
            let [near, far] = within(slab);
            near < far
        };
        match self {
            Self::Box => Some(true),
            Self::Stack => Some(stack(half, height).into_iter().any(meets)),
            Self::Book => Some(book(half, height).into_iter().any(meets)),
            Self::Tote => {
                // Through the cavity alone, from the rim to the ray's end, nothing is met.
                let [near, far] = within(cavity(half, height));
                let rounding = 1e-4 * (leave - enter);
                Some(near > enter + rounding || far < leave - rounding)
            }
            Self::Tube | Self::Bag | Self::Envelope => None,
        }
    }

    /// Light that reaches a point from everywhere, as a share: little inside a tote.
    pub(super) fn openness(self, [a, b, z]: [f32; 3], half: [f32; 2], height: f32) -> f32 {
        let inside = self == Self::Tote
            && z < height - 1.0
            && a.abs() < half[0] - 0.5 * WALL_MM
            && b.abs() < half[1] - 0.5 * WALL_MM;
        if inside { 0.35 + 0.5 * (z / height).clamp(0.0, 1.0) } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Shape::{Bag, Book, Box, Envelope, Stack, Tote, Tube};

    /// Every shape fills its cuboid to all six sides and not beyond: the truth is the cuboid.
    #[test]
    fn the_smallest_cuboid_around_each_shape_is_its_own() {
        let (half, height) = ([120.0, 70.0], 60.0);
        for shape in [Box, Tube, Bag, Tote, Stack, Envelope, Book] {
            let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
            for i in -130..=130 {
                for j in -80..=80 {
                    for k in 0..=70 {
                        let at = [i as f32, j as f32, k as f32];
                        if shape.distance(at, half, height) <= 0.0 {
                            for axis in 0..3 {
                                low[axis] = low[axis].min(at[axis]);
                                high[axis] = high[axis].max(at[axis]);
                            }
                        }
                    }
                }
            }
            assert_eq!((low, high), ([-120.0, -70.0, 0.0], [120.0, 70.0, 60.0]), "{shape:?}");
        }
    }

    /// A ray that steps by it must not jump through a surface.
    #[test]
    fn the_distance_is_never_more_than_the_true_one() {
        let (half, height) = ([60.0, 40.0], 30.0);
        for shape in [Tube, Bag, Tote, Stack, Envelope, Book] {
            for k in 0..4000u32 {
                let unit = |n: u32| ((k.wrapping_mul(n) % 1009) as f32) / 1009.0;
                let at = [160.0 * unit(7) - 80.0, 120.0 * unit(61) - 60.0, 60.0 * unit(323)];
                let told = shape.distance(at, half, height);
                if told <= 0.2 {
                    continue;
                }
                // No point of a sphere with 0.95 of that radius is inside.
                for d in 0..64u32 {
                    let (z, turn) = ((d as f32 + 0.5) / 32.0 - 1.0, d as f32 * 2.399_963_3);
                    let flat = (1.0 - z * z).sqrt();
                    let way = [flat * turn.cos(), flat * turn.sin(), z].map(|c| 0.95 * told * c);
                    let there = [at[0] + way[0], at[1] + way[1], at[2] + way[2]];
                    assert!(shape.distance(there, half, height) > 0.0, "{shape:?} {at:?} {told}");
                }
            }
        }
    }

    /// A shadow is decided in one step; the picture by the distance.
    #[test]
    fn a_ray_meets_what_the_distance_says() {
        let (half, height) = ([60.0, 40.0], 30.0);
        let (mut met, mut missed) = (0, 0);
        for shape in [Tote, Stack, Book] {
            for k in 0..3000u32 {
                let unit = |n: u32| ((k.wrapping_mul(n) % 1009) as f32) / 1009.0;
                let from = [400.0 * unit(7) - 200.0, 400.0 * unit(61) - 200.0, 300.0];
                let to = [130.0 * unit(323) - 65.0, 90.0 * unit(911) - 45.0, 33.0 * unit(467)];
                let along = [0, 1, 2].map(|k| to[k] - from[k]);
                let samples = 3000u16;
                let nearest = (0..=samples)
                    .map(|s| f32::from(s) / f32::from(samples))
                    .map(|s| {
                        shape.distance([0, 1, 2].map(|k| from[k] + s * along[k]), half, height)
                    })
                    .fold(f32::MAX, f32::min);
                // Within the step of the samples nothing is decided.
                if nearest.abs() < 0.2 {
                    continue;
                }
                // As a solid calls it: the part within its cuboid, if there is any.
                let whole = Slab { low: 0.0, high: height, half, aside: [0.0; 2] };
                let [enter, leave] = whole.crossed(from, along);
                let leave = leave.min(1.0);
                let told = enter < leave
                    && shape.is_met([from, along], [enter, leave], half, height) == Some(true);
                assert_eq!(told, nearest < 0.0, "{shape:?} {from:?} {to:?} {nearest}");
                if told { met += 1 } else { missed += 1 }
            }
        }
        assert!(met > 1000 && missed > 500, "{met} met, {missed} missed");
    }
}
