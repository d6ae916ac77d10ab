//! What one frame tells about one parcel: how far its blob reaches, and where edges are.

use super::model::{DIRECTIONS, EDGES, EdgeId, Outline, direction};
use crate::camera::BeltView;
use crate::image::Plane;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::profile::{Step, sample, steps};
use crate::kernel::scalar::runs::Run;
use crate::units::{BeltMm, BeltPx, BeltRect};
use nalgebra::Vector2;

/// Places on each edge where a profile is taken.
pub const SAMPLES_PER_EDGE: usize = 8;
/// Steps kept of one profile.
pub const STEPS: usize = 6;
/// Profiles reach this far to both sides of the predicted edge, px.
const SEARCH_PX: usize = 32;
/// Profiles are the mean of this many neighbours to both sides.
const PROFILE_HALF_WIDTH: i32 = 1;
/// Weaker steps than this, grey levels a px, drown in sensor noise.
const SLOPE_MIN: f32 = 0.8;

/// A step as it is kept: half the bytes, and finer than it can be found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct KeptStep {
    /// Offset from the anchor along `outward`, px, Q10.
    at_q10: i16,
    /// Grey levels a px, Q6.
    slope_q6: i16,
}

impl KeptStep {
    /// A step at `at_px` from the anchor.
    pub fn new(at_px: f32, slope: f32) -> Self {
        Self { at_q10: (at_px * 1024.0).round() as i16, slope_q6: (slope * 64.0).round() as i16 }
    }
}

/// A profile across a predicted edge.
#[derive(Clone, Copy, Debug)]
pub struct EdgeSample {
    /// The edge that was predicted here.
    pub edge: EdgeId,
    /// The predicted place, mm on the belt plane.
    pub anchor: [f32; 2],
    /// Outward direction of the profile.
    pub outward: [f32; 2],
    /// Steps found. Unused: slope 0.
    steps: [KeptStep; STEPS],
}

impl EdgeSample {
    /// None.
    pub const EMPTY: Self = Self {
        edge: EdgeId(0),
        anchor: [0.0; 2],
        outward: [0.0; 2],
        steps: [KeptStep { at_q10: 0, slope_q6: 0 }; STEPS],
    };
}

impl EdgeSample {
    /// The steps found: offset from the anchor along `outward`, mm, and slope, grey levels a px.
    pub fn steps(&self, mm_per_px: f64) -> impl Iterator<Item = (f64, f32)> + '_ {
        let found = self.steps.iter().filter(|step| step.slope_q6 != 0);
        found.map(move |step| {
            let at_px = f64::from(step.at_q10) / 1024.0;
            (at_px * mm_per_px, f32::from(step.slope_q6) / 64.0)
        })
    }

    /// A profile with these steps.
    #[cfg(test)]
    pub fn with_steps(steps: [KeptStep; 2]) -> Self {
        let mut sample = Self::EMPTY;
        sample.steps[..2].copy_from_slice(&steps);
        sample
    }
}

/// One frame's share of a pass.
#[derive(Clone, Copy, Debug)]
pub struct PassView {
    /// Belt travel since start, mm.
    pub travel_mm: f64,
    /// Reach of the blob in each direction, mm on the belt plane; NaN where not seen. First of
    /// the whole blob, then of it without its dark parts, which may be shadow.
    pub reach_mm: [[f32; DIRECTIONS]; 2],
    /// Edge profiles; empty before a first estimate exists.
    samples: [EdgeSample; EDGES * SAMPLES_PER_EDGE],
    sample_count: u8,
}

impl PassView {
    /// Nothing seen.
    pub const EMPTY: Self = Self {
        travel_mm: 0.0,
        reach_mm: [[f32::NAN; DIRECTIONS]; 2],
        samples: [EdgeSample::EMPTY; EDGES * SAMPLES_PER_EDGE],
        sample_count: 0,
    };

    /// The profiles taken.
    pub fn samples(&self) -> &[EdgeSample] {
        &self.samples[..usize::from(self.sample_count)]
    }

    /// Which directions were seen, as bits, for both silhouettes.
    pub fn directions(&self) -> [u32; 2] {
        let bit = |(k, reach): (usize, &f32)| u32::from(reach.is_finite()) << k;
        self.reach_mm.map(|reach| reach.iter().enumerate().map(bit).sum())
    }

    /// How many directions were seen, for both silhouettes.
    pub fn reach_count(&self) -> [usize; 2] {
        self.directions().map(|seen| seen.count_ones() as usize)
    }
}

/// The furthest pixel in each direction so far.
struct Furthest {
    directions: [Vector2<f64>; DIRECTIONS],
    at: [(f64, BeltPx); DIRECTIONS],
}

impl Furthest {
    fn new() -> Self {
        let at = [(f64::NEG_INFINITY, BeltPx::default()); DIRECTIONS];
        Self { directions: std::array::from_fn(direction), at }
    }

    fn add(&mut self, v: u16, start: u16, end: u16) {
        let v = f64::from(v);
        for u in [f64::from(start), f64::from(end) - 1.0] {
            for (d, best) in self.directions.iter().zip(&mut self.at) {
                let along = d.x * u - d.y * v; // v grows to -y
                if along > best.0 {
                    *best = (along, BeltPx { u, v });
                }
            }
        }
    }
}

/// Geometry shared by all observations.
pub struct Frame<'a> {
    /// Geometry of the belt view.
    pub view: &'a BeltView,
    /// The measuring zone.
    pub zone: &'a BeltRect,
    /// The grey belt view.
    pub grey: Plane<'a>,
    /// Bit-packed: pixels that the camera sees.
    pub seen: &'a [u64],
    /// Bit-packed: foreground that may be a deep shadow.
    pub dark: &'a [u64],
}

impl Frame<'_> {
    /// Reach of the runs in every direction, whole and without their dark ends. A direction
    /// whose furthest pixel lies at the border of what is seen, or beyond the zone along the
    /// belt, tells nothing: the parcel may go on there.
    pub fn reach<'r>(&self, runs: impl Iterator<Item = &'r Run>) -> [[f32; DIRECTIONS]; 2] {
        let mut whole = Furthest::new();
        let mut bright = Furthest::new();
        for run in runs {
            whole.add(run.v, run.start, run.end);
            if let Some((start, end)) = self.without_dark_ends(run) {
                bright.add(run.v, start, end);
            }
        }
        [self.reach_of(&whole), self.reach_of(&bright)]
    }

    fn reach_of(&self, furthest: &Furthest) -> [f32; DIRECTIONS] {
        std::array::from_fn(|k| {
            let (along, px) = furthest.at[k];
            if !along.is_finite() || !self.tells(px) {
                return f32::NAN;
            }
            let at = self.view.belt_point(px);
            // The blob's border runs half a pixel outside its outermost pixel centres.
            (direction(k).dot(&Vector2::new(at.x, at.y)) + 0.5 * self.view.mm_per_px) as f32
        })
    }

    /// A run between its first and last stretch of three pixels that are not dark.
    fn without_dark_ends(&self, run: &Run) -> Option<(u16, u16)> {
        let row = &self.dark[usize::from(run.v) * words(self.view.size_px[0])..];
        let bright = |u: u16| !bits::get(row, usize::from(u));
        let stretch = |u: &u16| (*u..*u + 3).all(bright);
        let mut places = run.start..run.end.saturating_sub(2);
        let first = places.find(stretch)?;
        let last = (first..run.end - 2).rfind(stretch)?;
        Some((first, last + 3))
    }

    fn tells(&self, px: BeltPx) -> bool {
        let at = self.view.belt_point(px);
        let in_zone = (self.zone.x_min_mm..=self.zone.x_max_mm).contains(&at.x);
        let [width, height] = self.view.size_px;
        let (u, v) = (px.u as usize, px.v as usize);
        let inside =
            (2..width.saturating_sub(2)).contains(&u) && (2..height.saturating_sub(2)).contains(&v);
        let is_seen = |u: usize, v: usize| bits::get(&self.seen[v * words(width)..], u);
        in_zone
            && inside
            && [(u - 2, v), (u + 2, v), (u, v - 2), (u, v + 2)]
                .into_iter()
                .all(|(u, v)| is_seen(u, v))
    }

    /// Take profiles across the visible edges of a predicted outline.
    pub fn sample_edges(&self, outline: &Outline, into: &mut PassView) {
        let mut count = 0;
        for edge in (0..EDGES as u8).map(EdgeId).filter(|&e| outline.visible(e)) {
            let ends = outline.ends(edge);
            for i in 0..SAMPLES_PER_EDGE {
                let t = (i as f64 + 0.5) / SAMPLES_PER_EDGE as f64;
                let over_belt = ends[0].over_belt + (ends[1].over_belt - ends[0].over_belt) * t;
                if !self.zone.contains(over_belt.x, over_belt.y) {
                    continue;
                }
                let anchor = ends[0].image + (ends[1].image - ends[0].image) * t;
                if let Some(found) = self.sample_edge(edge, anchor, outline.normals[edge.face()]) {
                    into.samples[count] = found;
                    count += 1;
                }
            }
        }
        into.sample_count = count as u8;
    }

    /// One profile; `None` where it leaves the view.
    fn sample_edge(
        &self,
        edge: EdgeId,
        anchor: Vector2<f64>,
        outward: Vector2<f64>,
    ) -> Option<EdgeSample> {
        let px = self.view.px(BeltMm { x: anchor.x, y: anchor.y });
        // In pixels the y axis points down.
        let step = [outward.x as f32, -outward.y as f32];
        let start =
            [px.u as f32 - SEARCH_PX as f32 * step[0], px.v as f32 - SEARCH_PX as f32 * step[1]];
        let mut profile = [0.0; 2 * SEARCH_PX + 1];
        sample(self.grey, start, step, PROFILE_HALF_WIDTH, &mut profile)?;
        let mut found = [Step::default(); STEPS];
        // A profile without a step counts: it shows that no edge is here.
        let count = steps(&profile, SLOPE_MIN, &mut found);
        let mut kept = EdgeSample::EMPTY.steps;
        for (kept, step) in kept.iter_mut().zip(&found[..count]) {
            *kept = KeptStep::new(step.at - SEARCH_PX as f32, step.slope);
        }
        Some(EdgeSample {
            edge,
            anchor: [anchor.x as f32, anchor.y as f32],
            outward: [outward.x as f32, outward.y as f32],
            steps: kept,
        })
    }
}

impl PassView {
    /// What a perfect camera sees of a cuboid; `distort` moves each step, px, by sample index.
    pub(super) fn of(
        outline: &Outline,
        travel_mm: f64,
        mut distort: impl FnMut(usize) -> f32,
    ) -> Self {
        let mut view = Self { travel_mm, ..Self::EMPTY };
        let reach =
            std::array::from_fn(|k| outline.support(direction(k)).image.dot(&direction(k)) as f32);
        view.reach_mm = [reach; 2];
        let mut count = 0;
        for edge in (0..EDGES as u8).map(EdgeId).filter(|&e| outline.visible(e)) {
            let [a, b] = outline.ends(edge);
            let outward = outline.normals[edge.face()];
            for i in 0..SAMPLES_PER_EDGE {
                let t = (i as f64 + 0.5) / SAMPLES_PER_EDGE as f64;
                let anchor = a.image + (b.image - a.image) * t;
                let mut sample = EdgeSample {
                    edge,
                    anchor: [anchor.x as f32, anchor.y as f32],
                    outward: [outward.x as f32, outward.y as f32],
                    ..EdgeSample::EMPTY
                };
                sample.steps[0] = KeptStep::new(distort(count), -20.0);
                view.samples[count] = sample;
                count += 1;
            }
        }
        view.sample_count = count as u8;
        view
    }
}
