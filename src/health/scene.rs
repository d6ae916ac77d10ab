//! What stands in the picture, as it was and as it is: its mean profiles, window by window.
//!
//! In: raw frames while the belt runs. Out: for each edge point how it has moved since the reference, the
//! first window. Spread over the frames: each adds a part of the points, each compares a part.

use super::blur::Edge;
use super::edges::{Finder, POINTS_MAX, Point};
use super::geometry::Motion;
use super::profile::{self, Match, Profile, SAMPLES, SHIFT_MAX_PX};
use crate::config::Site;
use crate::error::Result;
use crate::image::Plane;
use crate::plan::{Block, Memory, Plan};

/// A frame adds one of so many parts of the points.
const PARTS: usize = 16;
/// And compares so many of them.
const COMPARED: usize = 10;
/// A mean is of so many frames, at least: noise and what passes by.
const FRAMES_MIN: u32 = 6;
/// Shifts that a profile may have, both ways.
const SHIFTS: usize = 2 * SHIFT_MAX_PX as usize - 1;
/// Below this share of the points that are found again, the picture has moved further than was looked for.
const FOUND_MIN: f64 = 0.5;
/// Fewer sharp steps tell none either.
const SHARP_MIN: usize = 12;
/// Steps of the search for a far shift, px.
const STRIDE_PX: i32 = 2;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    /// Finding what stands.
    Find,
    /// Adding up profiles.
    Gather,
    /// Comparing points from here on with the reference.
    Compare { next: usize, is_last: bool },
    /// How alike each point is at every shift.
    Search { next: usize },
}

/// What stands.
pub(super) struct Scene {
    finder: Finder,
    points: Block<Point>,
    count: usize,
    sums: Block<u32>,
    means: Block<f32>,
    reference: Block<f32>,
    has_reference: bool,
    /// Which points showed a clean step when they were learned.
    is_step: Block<bool>,
    /// Standard deviation of the blur of each, px; NaN: not known.
    widths: Block<f32>,
    /// How alike each point is at every shift, -1 to 1 in 127 steps.
    alike: Block<i8>,
    matches: Block<Option<Match>>,
    phase: Phase,
    /// The camera's motion as it was lately.
    expected: Motion,
    /// The picture's shift as the search found it, px.
    searched_px: [f32; 2],
    /// Frames that were added of each part.
    frames: [u32; PARTS],
    part: usize,
    /// How long the window already is.
    window_s: f64,
}

/// What a frame has brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum News {
    /// Nothing yet.
    None,
    /// The reference is there.
    Learned,
    /// All points have been compared.
    Compared,
}

impl Scene {
    pub(super) fn plan(size_px: [usize; 2], plan: &mut Plan) {
        Finder::plan(size_px, plan);
        let samples = POINTS_MAX * SAMPLES;
        plan.add::<Point>(
            "health.points",
            POINTS_MAX,
            "edges that stand, two a cell of the picture",
        );
        plan.add::<u32>("health.sums", samples, "a profile of each in this window");
        plan.add::<f32>("health.means", samples, "the same of the last window");
        plan.add::<f32>("health.reference", samples, "the same when it was learned");
        plan.add::<bool>("health.is_step", POINTS_MAX, "a clean step when it was learned");
        plan.add::<f32>("health.widths", POINTS_MAX, "how blurred each is");
        plan.add::<i8>("health.alike", POINTS_MAX * SHIFTS, "each at every shift");
        plan.add::<Option<Match>>("health.matches", POINTS_MAX, "how each has moved");
    }

    pub(super) fn new(site: &Site, memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            finder: Finder::new(site, memory)?,
            points: memory.take("health.points", Point::NONE)?,
            count: 0,
            sums: memory.take("health.sums", 0)?,
            means: memory.take("health.means", 0.0)?,
            reference: memory.take("health.reference", 0.0)?,
            has_reference: false,
            is_step: memory.take("health.is_step", false)?,
            widths: memory.take("health.widths", f32::NAN)?,
            alike: memory.take("health.alike", 0)?,
            matches: memory.take("health.matches", None)?,
            phase: Phase::Find,
            expected: Motion::zeros(),
            searched_px: [0.0; 2],
            frames: [0; PARTS],
            part: 0,
            window_s: 0.0,
        })
    }

    /// A frame of a belt that runs and has moved by `dt_s` of time since the last one.
    pub(super) fn step(
        &mut self,
        site: &Site,
        raw: Plane<'_>,
        travel_mm: f64,
        dt_s: f64,
        window_s: f64,
    ) -> News {
        match self.phase {
            Phase::Find => {
                if self.finder.step(raw, travel_mm) {
                    self.count = self.finder.points(site, raw, &mut self.points);
                    self.phase = Phase::Gather;
                }
                News::None
            }
            Phase::Gather => self.gather(raw, dt_s, window_s),
            Phase::Compare { next, is_last } => self.compare(next, is_last),
            Phase::Search { next } => {
                self.search(next);
                News::None
            }
        }
    }

    fn gather(&mut self, raw: Plane<'_>, dt_s: f64, window_s: f64) -> News {
        let (points, sums) = (&self.points[..self.count], &mut self.sums);
        let of_part = points.iter().zip(sums.chunks_exact_mut(SAMPLES));
        for (point, sums) in of_part.skip(self.part).step_by(PARTS) {
            profile::add(raw, point, sums);
        }
        self.frames[self.part] += 1;
        self.part = (self.part + 1) % PARTS;
        self.window_s += dt_s;
        if self.window_s < window_s || self.frames[PARTS - 1] < FRAMES_MIN {
            return News::None;
        }
        for (i, (sums, means)) in self
            .sums
            .chunks_exact_mut(SAMPLES)
            .zip(self.means.chunks_exact_mut(SAMPLES))
            .enumerate()
        {
            let frames = self.frames[i % PARTS] as f32;
            means.iter_mut().zip(&*sums).for_each(|(mean, sum)| *mean = *sum as f32 / frames);
            sums.fill(0);
        }
        (self.frames, self.window_s) = ([0; PARTS], 0.0);
        if !self.has_reference {
            self.reference.copy_from_slice(&self.means);
        }
        self.phase = Phase::Compare { next: 0, is_last: false };
        News::None
    }

    /// So many points from `next` on are compared in a frame.
    fn part_from(&self, next: usize) -> std::ops::Range<usize> {
        next..(next + COMPARED).min(self.count)
    }

    fn compare(&mut self, next: usize, is_last: bool) -> News {
        let part = self.part_from(next);
        for i in part.clone() {
            let point = self.points[i];
            let expected_px = if is_last {
                point.shift_px(self.searched_px)
            } else {
                point.moved_px(&self.expected) as f32
            };
            let now = self.now(i);
            let found = profile::find(self.reference_of(i), &now, expected_px);
            let edge = found.and_then(|found| now.edge(found.shift_px));
            self.matches[i] = found;
            self.widths[i] = edge.map_or(f32::NAN, |edge| edge.sigma_px / point.slope.hypot(1.0));
            if !self.has_reference {
                self.is_step[i] = edge.is_some_and(Edge::is_clean);
            }
        }
        if part.end < self.count {
            self.phase = Phase::Compare { next: part.end, is_last };
            return News::None;
        }
        let found = self.matches[..self.count].iter().flatten().count();
        if (found as f64) < FOUND_MIN * self.count as f64 && !is_last {
            self.phase = Phase::Search { next: 0 };
            return News::None;
        }
        self.phase = Phase::Gather;
        if !self.has_reference {
            self.has_reference = true;
            return News::Learned;
        }
        News::Compared
    }

    /// How alike points are at every shift; after the last one: where most of them agree.
    fn search(&mut self, next: usize) {
        let part = self.part_from(next);
        for i in part.clone() {
            for k in 0..SHIFTS {
                let shift = k as i32 - SHIFT_MAX_PX + 1;
                let alike = profile::alike(self.reference_of(i), &self.now(i), shift);
                self.alike[i * SHIFTS + k] = (127.0 * alike.max(0.0)) as i8;
            }
        }
        self.phase = Phase::Search { next: part.end };
        if part.end >= self.count {
            self.searched_px = self.vote();
            self.phase = Phase::Compare { next: 0, is_last: true };
        }
    }

    /// The shift of the picture at which its points are most alike.
    fn vote(&self) -> [f32; 2] {
        let shifts = || (1 - SHIFT_MAX_PX..SHIFT_MAX_PX).step_by(STRIDE_PX as usize);
        let (mut best, mut most) = ([0.0; 2], i32::MIN);
        for dy in shifts() {
            for dx in shifts() {
                let votes = self.points[..self.count].iter().enumerate().map(|(i, point)| {
                    let shift_px = point.shift_px([dx as f32, dy as f32]);
                    let k = shift_px.round() as i32 + SHIFT_MAX_PX - 1;
                    let known = usize::try_from(k).ok().filter(|k| *k < SHIFTS);
                    known.map_or(0, |k| i32::from(self.alike[i * SHIFTS + k]))
                });
                let sum: i32 = votes.sum();
                if sum > most {
                    (best, most) = ([dx as f32, dy as f32], sum);
                }
            }
        }
        best
    }

    fn reference_of(&self, i: usize) -> &[f32] {
        &self.reference[i * SAMPLES..][..SAMPLES]
    }

    fn now(&self, i: usize) -> Profile<'_> {
        let size_px = self.finder.size_px();
        let inside = profile::inside(&self.points[i], size_px);
        Profile { mean: &self.means[i * SAMPLES..][..SAMPLES], inside }
    }

    /// The points with how they have moved.
    pub(super) fn compared(&self) -> impl Iterator<Item = (&Point, Option<&Match>)> + Clone {
        let matches = self.matches[..self.count].iter().map(Option::as_ref);
        self.points[..self.count].iter().zip(matches)
    }

    /// Standard deviation of the blur of the sharpest quarter of the steps, px; `None`: there are too few.
    /// `scratch` has room for all.
    pub(super) fn blur_px(&self, scratch: &mut [f32]) -> Option<f64> {
        let all = self.widths[..self.count].iter().zip(&self.is_step[..self.count]);
        let known = all.filter(|(width, is_step)| **is_step && width.is_finite());
        let count = known.zip(&mut *scratch).fold(0, |n, ((width, _), into)| {
            *into = *width;
            n + 1
        });
        (count >= SHARP_MIN).then(|| {
            let (_, quartile, _) =
                scratch[..count].select_nth_unstable_by(count / 4, f32::total_cmp);
            f64::from(*quartile)
        })
    }

    /// How the camera was found to have moved: what stands is looked for there again.
    pub(super) fn look_near(&mut self, motion: &Motion) {
        self.expected = *motion;
    }

    /// Edges that stand; none before they are found.
    pub(super) fn count(&self) -> usize {
        self.count
    }
}
