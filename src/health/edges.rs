//! Finding what stands: edge points that keep their place and contrast while the belt runs.
//!
//! In: raw frames that are far apart in belt travel, a band of rows of each. Out: the strongest edge of
//! each cell of the picture, one across its rows and one across its columns, that never was
//! hidden. Left out: the measuring zone, which is belt, and what runs along the travel beside it: that may be
//! a lane of the belt.

use super::geometry::{Motion, PARAMETERS, Rates, rates_px};
use super::profile::MARGIN_PX;
use crate::camera::Camera;
use crate::config::Site;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::gradient::keep_least;
use crate::plan::{Block, Memory, Plan};
use crate::units::{BeltMm, BeltRect, RawPx};
use nalgebra::{Vector2, Vector3};

/// Looks at each row: belt, seams, parcels have all moved by then.
const LOOKS: usize = 12;
/// Belt travel from one look to the next, mm, at least; each waits by so much more than the one before, so
/// that a belt that repeats itself is not seen in the same place.
const LOOK_MM: f64 = 40.0;
const LOOK_MORE_MM: f64 = 7.0;
/// One row in so many is looked at: edges are longer than that, and memory is dear.
const ROW_STEP: usize = 2;
/// One frame looks at one band of rows.
const BANDS: usize = 32;
/// Cells along and across the picture.
const CELLS: [usize; 2] = [16, 10];
/// Points at most: each cell has one of each axis.
pub(super) const POINTS_MAX: usize = 2 * CELLS[0] * CELLS[1];
/// The weakest edge: about 8 grey levels over 2 px (see the kernel's scale).
const GRADIENT_MIN: i8 = 4;
/// Half the side of the square that tells an edge's direction, px.
const DIRECTION_HALF_PX: usize = 2;
/// An edge within this of the travel, radians, runs along it.
const ALONG_TRAVEL_RAD: f64 = 0.2;

/// Which way a profile runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Axis {
    /// Along a row of the picture.
    #[default]
    Row,
    /// Along a column.
    Column,
}

/// The strongest edge of a cell so far.
#[derive(Clone, Copy, Debug, Default)]
struct Candidate {
    at: [u16; 2],
    strength: u8,
}

/// An edge that stands.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    /// Column and row.
    pub(super) at: [u16; 2],
    /// Its profile runs this way.
    pub(super) axis: Axis,
    /// When the picture moves by one px the other way, the edge in the profile moves by so much.
    pub(super) slope: f32,
    /// How the edge in the profile moves with each parameter of the camera's motion, px.
    rates: [f32; PARAMETERS],
}

impl Point {
    pub(super) const NONE: Self =
        Self { at: [0; 2], axis: Axis::Row, slope: 0.0, rates: [0.0; PARAMETERS] };

    /// How far the edge moves in its profile when the picture shifts along x and y, px.
    pub(super) fn shift_px(&self, [x, y]: [f32; 2]) -> f32 {
        match self.axis {
            Axis::Row => x + self.slope * y,
            Axis::Column => y + self.slope * x,
        }
    }

    /// How far it moves when the camera does, px.
    pub(super) fn moved_px(&self, motion: &Motion) -> f64 {
        self.rates().dot(motion)
    }

    pub(super) fn rates(&self) -> Motion {
        Motion::from(self.rates.map(f64::from))
    }
}

/// What finds them.
pub(super) struct Finder {
    size_px: [usize; 2],
    along: Block<i8>,
    across: Block<i8>,
    /// First and last column of the measuring zone in each row.
    zone: Block<[u16; 2]>,
    candidates: Block<Candidate>,
    look: usize,
    band: usize,
    /// Belt travel at which the next look may begin.
    due_mm: f64,
}

impl Finder {
    pub(super) fn plan([width, height]: [usize; 2], plan: &mut Plan) {
        let n = width * height.div_ceil(ROW_STEP);
        plan.add::<i8>("health.along", n, "least gradient along x of raw pixels");
        plan.add::<i8>("health.across", n, "least gradient along y of raw pixels");
        plan.add::<[u16; 2]>("health.zone", height, "where the zone lies in each raw row");
        plan.add::<Candidate>("health.candidates", POINTS_MAX, "two edges of each cell");
    }

    pub(super) fn new(site: &Site, memory: &mut Memory) -> Result<Self> {
        let size_px = site.camera.image_size_px;
        let (along, across) = (memory.take("health.along", 0)?, memory.take("health.across", 0)?);
        let mut zone = memory.take("health.zone", [u16::MAX, 0])?;
        mark_zone(&site.camera, &site.config.zone, &mut zone);
        let candidates = memory.take("health.candidates", Candidate::default())?;
        Ok(Self { size_px, along, across, zone, candidates, look: 0, band: 0, due_mm: 0.0 })
    }

    pub(super) fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    /// Look at a band of rows, or choose among its edges; whether all are chosen.
    pub(super) fn step(&mut self, raw: Plane<'_>, travel_mm: f64) -> bool {
        if self.band == 0 && self.look < LOOKS && travel_mm < self.due_mm {
            return false;
        }
        if self.band == 0 {
            self.due_mm = travel_mm + LOOK_MM + LOOK_MORE_MM * self.look as f64;
        }
        let rows = self.size_px[1].div_ceil(BANDS);
        let first = (self.band * rows).max(ROW_STEP).next_multiple_of(ROW_STEP);
        let end = (self.band * rows + rows).min(self.size_px[1] - ROW_STEP);
        for y in (first..end).step_by(ROW_STEP) {
            if self.look < LOOKS {
                self.look_at_row(raw, y);
            } else {
                self.choose_in_row(y);
            }
        }
        self.band = (self.band + 1) % BANDS;
        self.look += usize::from(self.band == 0);
        self.look > LOOKS
    }

    fn look_at_row(&mut self, raw: Plane<'_>, y: usize) {
        let width = self.size_px[0];
        let row = y / ROW_STEP * width..(y / ROW_STEP + 1) * width;
        let least = [&mut self.along[row.clone()], &mut self.across[row]];
        keep_least([raw.row(y - 1), raw.row(y), raw.row(y + 1)], least, self.look == 0);
    }

    /// Offer each edge of a row to its cell.
    fn choose_in_row(&mut self, y: usize) {
        let [width, height] = self.size_px;
        let [from, to] = self.zone[y].map(usize::from);
        let at = |plane: &[i8], x: usize, y: usize| plane[y / ROW_STEP * width + x].unsigned_abs();
        let room =
            |at: usize, size: usize| (MARGIN_PX..size.saturating_sub(MARGIN_PX)).contains(&at);
        for x in (1..width - 1).filter(|x| !(from..=to).contains(x)) {
            let (gx, gy) = (at(&self.along, x, y), at(&self.across, x, y));
            let strength = gx.max(gy);
            if strength < GRADIENT_MIN.unsigned_abs() {
                continue;
            }
            let axis = if gx >= gy { Axis::Row } else { Axis::Column };
            let (is_peak, fits) = match axis {
                Axis::Row => (
                    gx >= at(&self.along, x - 1, y) && gx > at(&self.along, x + 1, y),
                    room(x, width),
                ),
                Axis::Column => (
                    gy >= at(&self.across, x, y - ROW_STEP)
                        && gy > at(&self.across, x, y + ROW_STEP),
                    room(y, height),
                ),
            };
            let cell = (y * CELLS[1] / height) * CELLS[0] + x * CELLS[0] / width;
            let kept = &mut self.candidates[2 * cell + axis as usize];
            if is_peak && fits && strength > kept.strength {
                *kept = Candidate { at: [x as u16, y as u16], strength };
            }
        }
    }

    /// The edges found, in a frame that shows them; how many. `points` has room for all.
    pub(super) fn points(&self, site: &Site, raw: Plane<'_>, points: &mut [Point]) -> usize {
        let mut count = 0;
        for (i, candidate) in self.candidates.iter().enumerate().filter(|(_, c)| c.strength > 0) {
            let axis = if i % 2 == 0 { Axis::Row } else { Axis::Column };
            if let Some(point) = point(site, raw, candidate.at, axis) {
                points[count] = point;
                count += 1;
            }
        }
        count
    }
}

/// The zone's outline in the raw picture, row by row.
fn mark_zone(camera: &Camera, zone: &BeltRect, rows: &mut [[u16; 2]]) {
    const STEPS: usize = 256;
    let corners = zone.corners();
    let on_side = |k: usize| {
        let (a, b) = (corners[k / STEPS % 4], corners[(k / STEPS + 1) % 4]);
        let t = (k % STEPS) as f64 / STEPS as f64;
        camera.project(Vector3::new(a.x + t * (b.x - a.x), a.y + t * (b.y - a.y), 0.0))
    };
    for k in 0..4 * STEPS {
        let (Some(a), Some(b)) = (on_side(k), on_side(k + 1)) else { continue };
        let last = rows.len() as f64 - 1.0;
        let [first, end] =
            [a.y.min(b.y), a.y.max(b.y)].map(|y| y.round().clamp(0.0, last) as usize);
        for row in &mut rows[first..=end] {
            let [low, high] = [a.x.min(b.x), a.x.max(b.x)].map(|x| x.clamp(0.0, 65535.0) as u16);
            *row = [row[0].min(low), row[1].max(high)];
        }
    }
}

fn point(site: &Site, raw: Plane<'_>, at: [u16; 2], axis: Axis) -> Option<Point> {
    let [x, y] = at.map(usize::from);
    let normal = normal(raw, x, y)?;
    let px = RawPx { x: x as f64, y: y as f64 };
    if beside_zone_along_travel(site, px, normal) {
        return None;
    }
    let [own, other] = match axis {
        Axis::Row => [0, 1],
        Axis::Column => [1, 0],
    };
    let slope = normal[other] / normal[own];
    let rates: Rates = rates_px(&site.camera, px)?;
    let rates = rates.row(own) + rates.row(other) * slope;
    Some(Point { at, axis, slope: slope as f32, rates: std::array::from_fn(|k| rates[k] as f32) })
}

/// Direction across an edge, from the gradients around it.
fn normal(raw: Plane<'_>, x: usize, y: usize) -> Option<Vector2<f64>> {
    let half = DIRECTION_HALF_PX;
    let inside = |at: usize, size: usize| at > half && at + half + 1 < size;
    if !inside(x, raw.width()) || !inside(y, raw.height()) {
        return None;
    }
    let [mut xx, mut xy, mut yy] = [0i64; 3];
    for v in y - half..=y + half {
        for u in x - half..=x + half {
            let at = |u: usize, v: usize| i64::from(raw.at(u, v));
            let (gx, gy) = (at(u + 1, v) - at(u - 1, v), at(u, v + 1) - at(u, v - 1));
            (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
        }
    }
    let angle = 0.5 * (2.0 * xy as f64).atan2((xx - yy) as f64);
    (xx + yy > 0).then(|| Vector2::new(angle.cos(), angle.sin()))
}

/// Whether an edge runs along the travel where the belt may be: a lane of it, or its splice.
fn beside_zone_along_travel(site: &Site, px: RawPx, normal: Vector2<f64>) -> bool {
    let zone = &site.config.zone;
    let Some(at) = site.camera.belt_point(px) else { return false };
    let ahead = BeltMm { x: at.x + 1.0, y: at.y };
    let Some(ahead) = site.camera.project(Vector3::new(ahead.x, ahead.y, 0.0)) else {
        return false;
    };
    let travel = Vector2::new(ahead.x - px.x, ahead.y - px.y).normalize();
    (zone.y_min_mm..=zone.y_max_mm).contains(&at.y)
        && travel.dot(&normal).abs() < ALONG_TRAVEL_RAD.sin()
}
