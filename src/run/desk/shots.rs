//! Pictures for people, on their way from vision to the desk and back: pixels in planned memory.
//!
//! An empty shot is the request. Vision fills it from the frame it has just processed and hands it
//! over; when it has none, it has nothing to do. So nobody who looks can hold vision up, and while
//! nobody looks there is no work.

use crate::config::Site;
use crate::error::Result;
use crate::image::{FrameTime, Plane};
use crate::pipeline::{Pipeline, Sight};
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltPx;
use heapless::Vec;
use heapless::spsc::{Consumer, Producer, Queue};

/// Live pictures on their way: one of each kind.
pub const LIVE: usize = 3;
/// Pictures of single parcels on their way.
const PARCELS: usize = 6;
/// Frames of parcels that no shot was left for, on their way, and one.
const MISSED: usize = 64;
/// Places in the rings: any shot may be in any of them.
const RING: usize = LIVE + PARCELS + 1;
/// Sides of a live picture, at most: a frame is shrunk by whole factors until it fits.
const LIVE_SIDES_PX: [usize; 2] = [1024, 1024];
/// Sides of a parcel's picture, at most.
const PARCEL_SIDES_PX: [usize; 2] = [400, 320];
/// Around a parcel this much of its size is shown.
const MARGIN_SHARE: f64 = 0.12;
const MARGIN_PX: f64 = 8.0;
/// Parcels that are drawn into a live picture; more are measured all the same.
const SIGHTS_MAX: usize = 32;

/// What a picture is of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Subject {
    /// The camera's picture, shrunk.
    #[default]
    Raw,
    /// The belt view.
    Belt,
    /// The camera's picture, every pixel of it.
    Whole,
    /// The belt view around one parcel that passes the middle of the zone.
    Parcel,
}

/// A picture.
pub struct Shot {
    pixels: Block<u8>,
    /// What it shows, or is to show.
    pub framing: Framing,
    /// The parcels in view; of a parcel's picture that parcel.
    pub sights: Vec<Sight, SIGHTS_MAX>,
}

/// What a picture shows, and where.
#[derive(Clone, Copy, Debug)]
pub struct Framing {
    /// What it is of.
    pub subject: Subject,
    /// Its frame.
    pub time: FrameTime,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Its first pixel in the picture that it was taken from.
    pub origin_px: [usize; 2],
    /// Pixels of that picture for each of its own, along both sides.
    pub shrunk_by: usize,
}

/// Both ends of the shots' way.
pub struct Rings {
    asked: Queue<Shot, RING>,
    taken: Queue<Shot, RING>,
    spare: Queue<Shot, RING>,
    missed: Queue<u64, MISSED>,
}

/// Vision's end.
pub struct Photographer<'a> {
    asked: Consumer<'a, Shot>,
    spare: Consumer<'a, Shot>,
    taken: Producer<'a, Shot>,
    missed: Producer<'a, u64>,
}

/// The desk's end.
pub struct Album<'a> {
    /// Empty shots of the whole picture: to be taken of the next frame.
    pub asked: Producer<'a, Shot>,
    /// Empty shots for parcels.
    pub spare: Producer<'a, Shot>,
    /// Filled ones.
    pub taken: Consumer<'a, Shot>,
    /// Numbers of frames with a parcel that no shot was left for.
    pub missed: Consumer<'a, u64>,
}

/// The factor that brings sides within a limit.
fn factor(size_px: [usize; 2], most_px: [usize; 2]) -> usize {
    size_px[0].div_ceil(most_px[0]).max(size_px[1].div_ceil(most_px[1])).max(1)
}

fn live_bytes(site: &Site) -> usize {
    let bytes = |size_px: [usize; 2]| {
        let by = factor(size_px, LIVE_SIDES_PX);
        (size_px[0] / by) * (size_px[1] / by)
    };
    bytes(site.camera.image_size_px).max(bytes(site.view.size_px))
}

/// Whether somebody may look.
pub fn wanted(site: &Site) -> bool {
    site.config.web.enabled || site.config.archive.folder.is_some()
}

/// Memory for the shots of a site.
pub fn plan(site: &Site, plan: &mut Plan) {
    if wanted(site) {
        plan.add::<u8>("desk.live", 2 * live_bytes(site), "a live picture of camera and belt");
        let [width, height] = site.camera.image_size_px;
        plan.add::<u8>("desk.whole", width * height, "the camera's picture, to set it up by");
        let bytes = PARCELS * PARCEL_SIDES_PX[0] * PARCEL_SIDES_PX[1];
        plan.add::<u8>(
            "desk.parcels",
            bytes,
            "pictures of parcels on their way to web and archive",
        );
    }
}

/// Take it.
pub fn shots(site: &Site, memory: &mut Memory) -> Result<std::vec::Vec<Shot>> {
    if !wanted(site) {
        return Ok(std::vec::Vec::new());
    }
    let mut blocks = memory.take_parts("desk.live", 2, 0)?;
    blocks.push(memory.take("desk.whole", 0)?);
    blocks.extend(memory.take_parts("desk.parcels", PARCELS, 0)?);
    let live = [Subject::Raw, Subject::Belt, Subject::Whole];
    let subjects = live.into_iter().chain(std::iter::repeat(Subject::Parcel));
    Ok(blocks
        .into_iter()
        .zip(subjects)
        .map(|(pixels, subject)| Shot::new(pixels, subject))
        .collect())
}

impl Rings {
    /// Nothing is on its way.
    pub fn new() -> Self {
        Self { asked: Queue::new(), taken: Queue::new(), spare: Queue::new(), missed: Queue::new() }
    }

    /// Both ends.
    pub fn split(&mut self) -> (Photographer<'_>, Album<'_>) {
        let ((asked_in, asked), (spare_in, spare)) = (self.asked.split(), self.spare.split());
        let (taken, taken_out) = self.taken.split();
        let (missed, missed_out) = self.missed.split();
        (
            Photographer { asked, spare, taken, missed },
            Album { asked: asked_in, spare: spare_in, taken: taken_out, missed: missed_out },
        )
    }
}

impl Photographer<'_> {
    /// Take the pictures that are asked for, and those of parcels that pass the middle of the zone.
    /// Whether there were any.
    pub fn look(&mut self, pipeline: &Pipeline, raw: Plane<'_>, time: FrameTime) -> bool {
        let mut any = false;
        while let Some(mut shot) = self.asked.dequeue() {
            let is_whole = shot.framing.subject == Subject::Whole;
            let from = if shot.framing.subject == Subject::Belt { pipeline.view() } else { raw };
            let size_px = [from.width(), from.height()];
            let by = if is_whole { 1 } else { factor(size_px, LIVE_SIDES_PX) };
            shot.take(from, [[0, 0], size_px], by, time);
            for sight in pipeline.sights() {
                let _ = shot.sights.push(sight);
            }
            any |= self.taken.enqueue(shot).is_ok();
        }
        for sight in pipeline.passing_middle() {
            any |= self.of_parcel(sight, pipeline.view(), time);
        }
        any
    }

    fn of_parcel(&mut self, sight: Sight, view: Plane<'_>, time: FrameTime) -> bool {
        let Some(mut shot) = self.spare.dequeue() else {
            // There is no picture of it: the desk is told why.
            let _ = self.missed.enqueue(time.index);
            return false;
        };
        let region = around(&sight, [view.width(), view.height()]);
        let size_px = [0, 1].map(|i| region[1][i] - region[0][i]);
        shot.take(view, region, factor(size_px, PARCEL_SIDES_PX), time);
        let _ = shot.sights.push(sight);
        self.taken.enqueue(shot).is_ok()
    }
}

/// The pixels of a view around a parcel: the first, and that after the last.
fn around(sight: &Sight, size_px: [usize; 2]) -> [[usize; 2]; 2] {
    let [first, last]: [BeltPx; 2] = sight.bounds;
    let side = |from: f64, to: f64, size: usize| {
        let margin = MARGIN_SHARE * (to - from).max(0.0) + MARGIN_PX;
        let from = ((from - margin).max(0.0) as usize).min(size - 1);
        // Never empty, whatever the bounds.
        (from, ((to + margin).clamp(0.0, size as f64) as usize + 1).clamp(from + 1, size))
    };
    let ((u0, u1), (v0, v1)) =
        (side(first.u, last.u, size_px[0]), side(first.v, last.v, size_px[1]));
    [[u0, v0], [u1, v1]]
}

impl Framing {
    /// Where a pixel of the picture that it was taken from is in it.
    pub fn px(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let by = self.shrunk_by as f64;
        let px = |at: f64, origin: usize| (at - origin as f64 + 0.5) / by - 0.5;
        [px(x, self.origin_px[0]), px(y, self.origin_px[1])]
    }
}

impl Shot {
    fn new(pixels: Block<u8>, subject: Subject) -> Self {
        let time = FrameTime { index: 0, t_s: 0.0 };
        let framing = Framing { subject, time, size_px: [0; 2], origin_px: [0; 2], shrunk_by: 1 };
        Self { pixels, framing, sights: Vec::new() }
    }

    /// Its pixels, row by row.
    pub fn pixels(&self) -> &[u8] {
        let [width, height] = self.framing.size_px;
        &self.pixels[..width * height]
    }

    /// Fill it with a region, shrunk by a whole factor.
    fn take(&mut self, from: Plane<'_>, region: [[usize; 2]; 2], by: usize, time: FrameTime) {
        let [origin_px, end_px] = region;
        let size = |i: usize| ((end_px[i] - origin_px[i]) / by).max(1);
        let [width, height] = [size(0), size(1)];
        let subject = self.framing.subject;
        self.framing =
            Framing { subject, time, size_px: [width, height], origin_px, shrunk_by: by };
        self.sights.clear();
        shrink(from, region, by, &mut self.pixels);
    }
}

/// A region shrunk by a whole factor, row by row; what is left over at its end is not shown.
pub(super) fn shrink(from: Plane<'_>, region: [[usize; 2]; 2], by: usize, into: &mut [u8]) {
    let [[x0, y0], [x1, y1]] = region;
    let [width, height] = [((x1 - x0) / by).max(1), ((y1 - y0) / by).max(1)];
    for (row, into) in into.chunks_exact_mut(width).take(height).enumerate() {
        let at = |k: usize| &from.row((y0 + row * by + k).min(from.height() - 1))[x0..x1];
        match by {
            1 => into.copy_from_slice(&at(0)[..width]),
            2 => halve(at(0), at(1), into),
            _ => thin(at(by / 2 - 1), at(by / 2), by, into),
        }
    }
}

/// The mean of each two by two pixels.
fn halve(above: &[u8], below: &[u8], into: &mut [u8]) {
    for ((into, a), b) in into.iter_mut().zip(above.chunks_exact(2)).zip(below.chunks_exact(2)) {
        let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
        *into = ((sum + 2) / 4) as u8;
    }
}

/// The mean of the two by two pixels in the middle of each block: enough for the eye, and as cheap.
fn thin(above: &[u8], below: &[u8], by: usize, into: &mut [u8]) {
    let middle = by / 2 - 1;
    for ((into, a), b) in into.iter_mut().zip(above.chunks(by)).zip(below.chunks(by)) {
        let pair = |row: &[u8]| {
            let at = |i: usize| u16::from(row[i.min(row.len() - 1)]);
            at(middle) + at(middle + 1)
        };
        *into = ((pair(a) + pair(b) + 2) / 4) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(size: [usize; 2], region: [[usize; 2]; 2], by: usize) -> Shot {
        let mut plan = Plan::default();
        plan.add::<u8>("pixels", 4096, "test");
        let mut memory = plan.reserve(1).expect("small");
        let mut shot = Shot::new(memory.take("pixels", 0).expect("planned"), Subject::Belt);
        // Grey is x + 10 y.
        let pixels: std::vec::Vec<u8> =
            (0..size[0] * size[1]).map(|i| (i % size[0] + 10 * (i / size[0])) as u8).collect();
        let plane = Plane::packed(&pixels, size[0], size[1]).expect("fits");
        shot.take(plane, region, by, FrameTime { index: 7, t_s: 0.5 });
        shot
    }

    #[test]
    fn a_shrunk_pixel_is_the_mean_of_what_it_covers_and_lies_in_its_middle() {
        for by in 1..=5 {
            let shot = taken([15, 12], [[2, 1], [14, 11]], by);
            assert_eq!(shot.framing.size_px, [12 / by, 10 / by], "by {by}");
            for (i, &grey) in shot.pixels().iter().enumerate() {
                let width = shot.framing.size_px[0];
                let [x, y] = [i % width, i / width];
                // The grey rises evenly, so the mean is that of the middle; odd factors take a pair
                // beside it, half a pixel off both ways: 5.5 grey levels.
                let middle = |k: usize, origin: usize| {
                    origin as f64 + k as f64 * by as f64 + (by as f64 - 1.0) / 2.0
                };
                let (u, v) = (middle(x, 2), middle(y, 1));
                let off = (f64::from(grey) - (u + 10.0 * v)).abs();
                assert!(off <= if by > 2 && by % 2 == 1 { 6.0 } else { 0.5 }, "by {by}: {off}");
                let back = shot.framing.px([u, v]);
                assert!((back[0] - x as f64).abs() < 1e-9 && (back[1] - y as f64).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_parcel_that_no_shot_is_left_for_is_told_with_its_frame() {
        let bounds = [BeltPx { u: 1.0, v: 1.0 }, BeltPx { u: 4.0, v: 4.0 }];
        let sight = Sight { slot: 0, riding: true, told: false, bounds, cuboid: None };
        let view = Plane::packed(&[0; 64], 8, 8).expect("fits");
        let mut rings = Rings::new();
        let (mut photographer, mut album) = rings.split();
        let _ = album.spare.enqueue(taken([8, 8], [[0, 0], [8, 8]], 1));
        for index in [5, 6] {
            photographer.of_parcel(sight, view, FrameTime { index, t_s: 0.0 });
        }
        assert_eq!(album.taken.dequeue().map(|shot| shot.framing.time.index), Some(5));
        assert_eq!((album.missed.dequeue(), album.missed.dequeue()), (Some(6), None));
    }

    #[test]
    fn a_picture_around_a_parcel_is_never_empty_and_never_outside() {
        let px = |u: f64, v: f64| BeltPx { u, v };
        for bounds in [
            [px(10.0, 10.0), px(30.0, 20.0)],
            [px(-50.0, -9.0), px(500.0, 900.0)],
            [px(99.0, 99.0), px(0.0, 0.0)],
            [px(f64::NAN, 0.0), px(f64::INFINITY, f64::NEG_INFINITY)],
        ] {
            let sight = Sight { slot: 0, riding: true, told: false, bounds, cuboid: None };
            let [from, to] = around(&sight, [100, 80]);
            assert!(from[0] < to[0] && from[1] < to[1], "{bounds:?}");
            assert!(to[0] <= 100 && to[1] <= 80, "{bounds:?}");
        }
    }
}
