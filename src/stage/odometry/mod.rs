//! Belt motion from the belt's own texture: the witness that makes heights possible.
//!
//! In: belt view minus background, free belt only. Out: travel since the last frame, whether
//! it was measured. Owns: the texture of a key frame and of the current one.
//! The current texture is matched with the key's, not with the last frame's, so errors do
//! not add up frame by frame; a new key is taken when the overlap gets small. In the belt
//! view all belt motion is horizontal, so a match is one number.
//! While it is not locked, a few of the rows are searched over every speed in both directions, and
//! several frames must agree; but a whole multiple of the last step is one at once: frames are missing
//! whose time stamps do not tell. A texture fainter than the camera's noise is searched on all rows, in
//! every frame: a few show neither it nor its rivals. A texture that fits itself at several plausible
//! shifts is ambiguous, and silhouettes that move otherwise refute what the texture shows: neither is a
//! measurement.
//! Cost: at most 250,000 pixels taken out, and as many products for each shift tried: 13 when locked on
//! a clear texture, every speed in both directions on a faint one; bounded by the zone, whatever the
//! time stamps say.
//! Source: normalised cross-correlation; its peak by Lanczos interpolation, because a parabola
//! through three shifts is off by 0.05 px, always towards the same side at the same speed.

mod across;
mod correlation;
mod peaks;

pub use across::Across;

use correlation::{Correlation, MATCH_MIN, Match, chance, match_min};
use peaks::{LIKE_HEIGHT, PEAK_HALF, PEAK_SHIFTS, Peaks, peak};

use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::Level;
use crate::kernel::bands::{self, BANDS_MAX, Jobs, rows_per_band};
use crate::kernel::scalar::bits::{self, stride};
use crate::kernel::scalar::texture::{Belt, NO_TEXTURE, SUMS_BORDER, Sums};
use crate::kernel::simd::texture::{correlate, extract};
use crate::plan::{Block, Memory, Plan};
use crate::stage::background::Background;
use crate::stage::riders::Ride;
use crate::units::{BeltMm, BeltRect};

/// At least every second row carries the texture: neighbouring rows repeat most of it ...
const ROW_STEP_MIN: usize = 2;
/// ... and so many pixels are enough: more cost time and tell next to nothing.
const TEXTURE_PX: usize = 250_000;
/// When locked, shifts this far around the prediction are tried.
const LOCKED_SEARCH_PX: f64 = 1.5;
/// Pairs of textured pixels below which a match proves nothing.
const PAIRS_MIN: u32 = 4000;
/// A new key when the belt has moved on by this share of the zone.
const KEY_TRAVEL: f64 = 0.45;

/// Pixels of the rows that are searched over every speed.
const SCOUT_PX: usize = 12_000;
/// Shifts up to this share of the zone leave enough overlap.
const SHIFT_SHARE: f64 = 0.5;
/// A speed far from the nominal one is believed when this many frames on end show it ...
const SCOUT_FRAMES: u32 = 3;
/// ... within this share.
const SCOUT_AGREE: f64 = 0.03;
/// A standstill needs texture of at least this, grey levels: what compression leaves of a plain
/// belt, frozen from frame to frame, is below 0.1.
const STANDSTILL_GREY_MIN: f64 = 0.25;
/// Below this share of the nominal speed the belt stands.
const STILL: f64 = 0.1;
/// Silhouettes move at the belt's speed, or up to the magnification faster, with this margin.
const RIDE_MARGIN: f64 = 0.1;

/// A texture proves to be the belt's by moving as expected in so many frames ...
const PROOF_FRAMES: u32 = 8;
/// ... with so many pairs of pixels ...
const PROOF_PAIRS: u32 = 5 * PAIRS_MIN;
/// ... and is then refuted when things move otherwise so many times on end: once may be a hand.
const DOUBTS_MAX: u32 = 2;

/// Below this share of the nominal speed the belt counts as slow: stopping or starting.
const SLOW: f64 = 0.3;
/// The speed follows single frames, good to a few tenths of a px, at this rate.
const SPEED_FOLLOW: f64 = 0.3;
/// After this many frames without a match the key is given up.
const MISSES_MAX: u32 = 6;

/// What is known of the belt's motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Knowledge {
    /// Measured.
    Measured,
    /// The belt shows no texture that could tell.
    #[default]
    NoTexture,
    /// Its texture repeats itself: several speeds would explain it.
    Ambiguous,
    /// What lies on the belt moves otherwise than the texture.
    Refuted,
}

/// What is known of the motion beforehand.
#[derive(Clone, Copy, Debug)]
pub struct Expected {
    /// Configured speed.
    pub nominal_mm_per_s: f64,
    /// Largest relative error of it that is searched first.
    pub speed_error_max: f64,
    /// How much faster than the belt the highest top moves.
    pub magnification_max: f64,
}

/// What one frame told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Travel since the last frame, mm.
    pub step_mm: f64,
    /// Measured, or assumed from the last known speed.
    pub measured: bool,
}

/// The odometry stage.
pub struct Odometry {
    level: Level,
    bands: usize,
    mm_per_px: f64,
    width: usize,
    /// First and one-past-last column and row of the zone.
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
    row_step: usize,
    expected: Expected,
    /// Last known speed.
    speed_mm_per_s: f64,
    key: Block<i8>,
    current: Block<i8>,
    sums: Block<i32>,
    scout: Block<f32>,
    /// Grey levels of a unit of texture.
    unit_grey: f64,
    /// Travel from the key to the last frame, px; `None` before the first key.
    shift_px: Option<f64>,
    /// Time from the key to the last frame.
    key_age_s: f64,
    /// A speed that the last frames showed, and how many.
    seen: Option<(f64, u32)>,
    knowledge: Knowledge,
    locked: bool,
    /// The last match was fainter than [`MATCH_MIN`].
    faint: bool,
    /// Frames without a match since the last one.
    misses: u32,
    /// Frames that were missing though the time stamps did not tell.
    untold_gaps: u64,
    /// Frames in which the texture proved to be the belt's.
    proofs: u32,
    /// Times since then that what lies on the belt moved otherwise, and whether it does now.
    doubts: (u32, bool),
}

impl Odometry {
    fn zone_px(view: &BeltView, zone: &BeltRect) -> [std::ops::Range<usize>; 2] {
        let a = view.px(BeltMm { x: zone.x_min_mm, y: zone.y_max_mm });
        let b = view.px(BeltMm { x: zone.x_max_mm, y: zone.y_min_mm });
        let range = |from: f64, to: f64, n: usize| {
            (from.max(0.0) as usize).min(n)..((to.max(0.0) as usize) + 1).min(n)
        };
        [range(a.u, b.u, view.size_px[0]), range(a.v, b.v, view.size_px[1])]
    }

    /// Columns of the texture: those of the zone, in whole blocks of 64.
    fn blocks(columns: &std::ops::Range<usize>) -> std::ops::Range<usize> {
        columns.start / 64 * 64..columns.end.next_multiple_of(64)
    }

    fn row_step([columns, rows]: &[std::ops::Range<usize>; 2]) -> usize {
        (columns.len() * rows.len()).div_ceil(TEXTURE_PX).max(ROW_STEP_MIN)
    }

    /// Memory for a zone.
    pub fn plan(view: &BeltView, zone: &BeltRect, plan: &mut Plan) {
        let zone = Self::zone_px(view, zone);
        let row = Self::blocks(&zone[0]).len();
        let n = row * zone[1].len().div_ceil(Self::row_step(&zone));
        plan.add::<i8>("odometry.key", n, "belt texture of the key frame, some of the rows");
        plan.add::<i8>("odometry.current", n, "belt texture of the current frame");
        let sums = BANDS_MAX * (row + SUMS_BORDER);
        plan.add::<i32>("odometry.sums", sums, "running sums of a row, for each band");
        plan.add::<f32>("odometry.scout", 2 * row + 1, "correlation at every shift, few rows");
    }

    /// Not yet locked.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        expected: Expected,
        level: Level,
        bands: usize,
        memory: &mut Memory,
    ) -> Result<Self> {
        let zone = Self::zone_px(view, zone);
        let row_step = Self::row_step(&zone);
        let [columns, rows] = zone;
        Ok(Self {
            level,
            bands,
            row_step,
            mm_per_px: view.mm_per_px,
            width: view.size_px[0],
            columns,
            rows,
            expected,
            speed_mm_per_s: expected.nominal_mm_per_s,
            key: memory.take("odometry.key", NO_TEXTURE)?,
            current: memory.take("odometry.current", NO_TEXTURE)?,
            sums: memory.take("odometry.sums", 0)?,
            scout: memory.take("odometry.scout", 0.0)?,
            unit_grey: 0.0,
            shift_px: None,
            key_age_s: 0.0,
            seen: None,
            knowledge: Knowledge::default(),
            locked: false,
            faint: false,
            misses: 0,
            untold_gaps: 0,
            proofs: 0,
            doubts: (0, false),
        })
    }

    /// One frame, `dt_s` after the last one: `grey`, rows of [`stride`] pixels. `covered`: bit mask
    /// of pixels that are not belt. `ride`: what the silhouettes on it do.
    pub fn step(
        &mut self,
        grey: &[u8],
        background: &Background,
        covered: &[u64],
        ride: Ride,
        dt_s: f64,
    ) -> Motion {
        self.extract(grey, background, covered);
        let assumed_mm_per_s = self.assumed(ride);
        let Some(last_px) = self.shift_px else {
            self.take_key();
            return Motion { step_mm: assumed_mm_per_s * dt_s, measured: false };
        };
        self.key_age_s += dt_s;
        let found = self.search(last_px, dt_s);
        // A search far off may have found that the steps before were assumed wrongly.
        let last_px = self.shift_px.unwrap_or(last_px);
        let found = found.filter(|m| !self.refutes(ride, (m.shift_px - last_px) / dt_s, m.pairs));
        self.locked = found.is_some();
        let assumed_px = assumed_mm_per_s * dt_s / self.mm_per_px;
        let step_px = found.as_ref().map_or(assumed_px, |m| m.shift_px - last_px);
        let step_mm = step_px * self.mm_per_px;
        if let Some(m) = found {
            self.untold_gaps += u64::from(m.missing);
            self.key_age_s += dt_s * f64::from(m.missing);
            let dt_s = dt_s * f64::from(1 + m.missing);
            if dt_s > 0.0 {
                self.speed_mm_per_s += SPEED_FOLLOW * (step_mm / dt_s - self.speed_mm_per_s);
            }
            self.knowledge = Knowledge::Measured;
            self.faint = m.rho < MATCH_MIN;
            self.misses = 0;
            self.shift_px = Some(m.shift_px);
            let far = m.shift_px.abs() > KEY_TRAVEL * self.columns.len() as f64;
            if far || m.pairs < PAIRS_MIN * 2 {
                self.take_key();
            }
        } else {
            self.misses += 1;
            self.shift_px = Some(last_px + step_px);
            // A parcel may hide the belt for a moment: the last speed bridges that. When
            // the texture stays away, only the nominal speed is known.
            if self.misses >= MISSES_MAX {
                self.speed_mm_per_s = self.expected.nominal_mm_per_s;
                self.take_key();
                self.misses = 0;
            }
        }
        Motion { step_mm, measured: self.locked }
    }

    /// Speed while nothing measures it: the last known one, unless what lies on the belt shows
    /// another.
    fn assumed(&self, ride: Ride) -> f64 {
        match ride {
            Ride::Stands if !self.locked => 0.0,
            // The belt is slower than what it carries by half of the magnification, more or less.
            Ride::Moves(speed) if !self.may_carry(self.speed_mm_per_s, speed) => {
                2.0 * speed / (1.0 + self.expected.magnification_max)
            }
            _ => self.speed_mm_per_s,
        }
    }

    /// Whether silhouettes on a belt of this speed may move at that one.
    fn may_carry(&self, belt_mm_per_s: f64, ride_mm_per_s: f64) -> bool {
        let ratio = ride_mm_per_s / belt_mm_per_s;
        (1.0 - RIDE_MARGIN..=self.expected.magnification_max * (1.0 + RIDE_MARGIN)).contains(&ratio)
    }

    /// Whether what lies on the belt shows that it does not move so.
    fn refutes(&mut self, ride: Ride, px_per_s: f64, pairs: u32) -> bool {
        let speed_mm_per_s = px_per_s * self.mm_per_px;
        let steady = (speed_mm_per_s / self.speed_mm_per_s - 1.0).abs() < RIDE_MARGIN
            || speed_mm_per_s.abs() < STILL * self.expected.nominal_mm_per_s;
        let (agrees, contradicts) = match ride {
            Ride::Moves(ride) => {
                let agrees = self.may_carry(speed_mm_per_s, ride);
                (agrees, steady && !agrees)
            }
            Ride::Stands | Ride::Unknown => (false, false),
        };
        let as_expected = (speed_mm_per_s / self.expected.nominal_mm_per_s - 1.0).abs()
            < self.expected.speed_error_max;
        if (agrees || as_expected) && !contradicts && pairs >= PROOF_PAIRS {
            self.proofs += 1;
        }
        if agrees {
            self.doubts.0 = 0;
        }
        self.doubts.0 += u32::from(contradicts && !self.doubts.1);
        self.doubts.1 = contradicts;
        let is_proven = self.proofs >= PROOF_FRAMES && self.doubts.0 < DOUBTS_MAX;
        let refuted = contradicts && !is_proven;
        if refuted {
            self.knowledge = Knowledge::Refuted;
            self.proofs = 0;
        }
        refuted
    }

    /// The next frame follows no other: as at start, but for the speed.
    pub fn forget(&mut self) {
        (self.shift_px, self.seen, self.locked, self.misses) = (None, None, false, 0);
    }

    /// Shifts in px beyond which the zone does not show the motion.
    fn shift_max_px(&self) -> f64 {
        SHIFT_SHARE * self.columns.len() as f64
    }

    /// Whether the view can show the belt's motion over this time.
    pub fn bridges(&self, dt_s: f64) -> bool {
        let px =
            self.speed_mm_per_s.abs().max(self.expected.nominal_mm_per_s) * dt_s / self.mm_per_px;
        (0.0..=self.shift_max_px()).contains(&px)
    }

    /// The configured speed.
    pub fn nominal_mm_per_s(&self) -> f64 {
        self.expected.nominal_mm_per_s
    }

    /// How much faster than the belt the highest top moves.
    pub fn magnification_max(&self) -> f64 {
        self.expected.magnification_max
    }

    /// Frames that the belt's steps show to be missing, though the time stamps do not tell.
    pub fn untold_gaps(&self) -> u64 {
        self.untold_gaps
    }

    /// What is known of the belt's motion.
    pub fn knowledge(&self) -> Knowledge {
        self.knowledge
    }

    /// Speed of the belt, mm/s, and whether it is measured rather than assumed.
    pub fn speed(&self) -> (f64, bool) {
        (self.speed_mm_per_s, self.locked)
    }

    /// Whether the belt is known to stand still (below a tenth of the nominal speed).
    pub fn stands_still(&self) -> bool {
        self.locked && self.speed_mm_per_s.abs() < STILL * self.expected.nominal_mm_per_s
    }

    fn take_key(&mut self) {
        std::mem::swap(&mut self.key, &mut self.current);
        (self.shift_px, self.key_age_s, self.seen) = (Some(0.0), 0.0, None);
    }

    /// Belt texture of the zone: the view minus the background, where it is belt.
    fn extract(&mut self, grey: &[u8], background: &Background, covered: &[u64]) {
        let (words, stride) = (bits::words(self.width), stride(self.width));
        let belt = background.belt();
        self.unit_grey = f64::from(1u32 << belt.shift) / 128.0;
        let blocks = Self::blocks(&self.columns);
        let (columns, first, step) = (self.columns.clone(), self.rows.start, self.row_step);
        let rows = rows_per_band(self.current.len() / blocks.len(), self.bands);
        let parts = self.current.chunks_mut(rows * blocks.len());
        let sums = self.sums.chunks_exact_mut(blocks.len() + SUMS_BORDER);
        let mut jobs: Jobs<_> = parts.zip(sums).enumerate().collect();
        let level = self.level;
        bands::run(&mut jobs, &|(band, (texture, sums))| {
            for (i, out) in (*band * rows..).zip(texture.chunks_exact_mut(blocks.len())) {
                let v = first + i * step;
                let pixels = v * stride + blocks.start..v * stride + blocks.end;
                let covered = &covered[v * words..][blocks.start / 64..blocks.end / 64];
                let belt = Belt { mean: &belt.mean[pixels.clone()], ..belt };
                extract(level, &grey[pixels], belt, covered, sums, out);
                out[..columns.start - blocks.start].fill(NO_TEXTURE);
                out[columns.end - blocks.start..].fill(NO_TEXTURE);
            }
        });
    }

    /// The best match: near the prediction when locked on a moving belt, else over every speed
    /// from standstill to the fastest allowed, else over all that the zone can show. What does not
    /// move with the belt (light, dirt on the lens, exposure) correlates at standstill, so motion
    /// wins over standstill wherever it is seen at all.
    fn search(&mut self, last_px: f64, dt_s: f64) -> Option<Match> {
        self.knowledge = Knowledge::NoTexture;
        if last_px.abs() > self.shift_max_px() || !self.bridges(dt_s) {
            return None;
        }
        let px = |mm_per_s: f64| mm_per_s * dt_s / self.mm_per_px;
        let slow = px(SLOW * self.expected.nominal_mm_per_s);
        let predicted = last_px + px(self.speed_mm_per_s);
        if self.locked && self.speed_mm_per_s.abs() > SLOW * self.expected.nominal_mm_per_s {
            let near = self.best(predicted - LOCKED_SEARCH_PX, predicted + LOCKED_SEARCH_PX);
            // A faint one may be one of several, every time.
            if near.as_ref().is_some_and(|m| m.rho >= MATCH_MIN) {
                return near;
            }
        }
        let fastest =
            px(self.expected.nominal_mm_per_s) * (1.0 + self.expected.speed_error_max) + 2.0;
        let moving = self.best(last_px + slow, last_px + fastest);
        let is_clear = |m: &Match| m.rho >= MATCH_MIN;
        let found = if moving.as_ref().is_some_and(is_clear) {
            moving
        } else {
            let still = self.best(last_px - 2.0, last_px + slow + 1.0);
            still.filter(|m| is_clear(m) && m.texture_grey >= STANDSTILL_GREY_MIN).or(moving)
        };
        let (from, to) = (last_px - fastest, last_px + fastest);
        // A few rows are too few to show its rivals.
        let every = self.scout_every() as u32;
        let is_faint = found.as_ref().is_some_and(|m| {
            f64::from(LIKE_HEIGHT) * m.rho < chance(m.pairs / every).max(MATCH_MIN)
        });
        let peaks = if is_faint { self.faint_peaks(from, to) } else { self.peaks(from, to, None) };
        match (found, peaks) {
            (Some(found), peaks) if !peaks.rival_of(found.shift_px) => Some(found),
            (Some(_), _) => {
                self.knowledge = Knowledge::Ambiguous;
                None
            }
            (None, _) => self.look_far(last_px, dt_s),
        }
    }

    /// Frames missing before this one, when its step is a whole multiple of what the locked speed makes
    /// of its time: no belt doubles its speed from one frame to the next.
    fn missing(&self, step_px: f64, dt_s: f64) -> u32 {
        let usual_px = self.speed_mm_per_s * dt_s / self.mm_per_px;
        let moves = self.speed_mm_per_s.abs() > SLOW * self.expected.nominal_mm_per_s;
        let times = (step_px / usual_px).round();
        // A shift is known to a px.
        let whole = (step_px - times * usual_px).abs() < SCOUT_AGREE * step_px.abs() + 1.0;
        if self.locked && moves && whole && times >= 2.0 { times as u32 - 1 } else { 0 }
    }

    /// A speed far from the nominal one, in either direction, that several frames on end show, or the
    /// usual one over missing frames.
    fn look_far(&mut self, last_px: f64, dt_s: f64) -> Option<Match> {
        let most = self.shift_max_px();
        // What stands still in the picture is no motion.
        let peaks = self.peaks(-most, most, Some(0));
        let Some((shift, _)) = peaks.first.filter(|_| dt_s > 0.0) else {
            self.seen = None;
            return None;
        };
        if peaks.rival_of(shift as f64) {
            self.knowledge = Knowledge::Ambiguous;
            self.seen = None;
            return None;
        }
        let missing = self.missing(shift as f64 - last_px, dt_s);
        if missing > 0 {
            let found = self.best(shift as f64 - 2.0, shift as f64 + 2.0)?;
            return Some(Match { missing, ..found });
        }
        let speed = shift as f64 * self.mm_per_px / self.key_age_s;
        let agreed = match self.seen {
            // A shift is known to a px.
            Some((before, frames))
                if (speed - before).abs()
                    < SCOUT_AGREE * speed.abs() + 2.0 * self.mm_per_px / self.key_age_s =>
            {
                frames + 1
            }
            _ => 1,
        };
        self.seen = Some((speed, agreed));
        if agreed < SCOUT_FRAMES {
            return None;
        }
        let found = self.best(shift as f64 - 2.0, shift as f64 + 2.0)?;
        self.speed_mm_per_s = found.shift_px * self.mm_per_px / self.key_age_s;
        // The step of this frame alone: those before it were assumed.
        self.shift_px = Some(found.shift_px - self.speed_mm_per_s * dt_s / self.mm_per_px);
        Some(found)
    }

    /// Of so many rows one is searched over every speed.
    fn scout_every(&self) -> usize {
        (self.key.len() / SCOUT_PX).max(1)
    }

    /// Peaks of the correlation on a few rows, over a range of shifts, but for those near `without`.
    fn peaks(&mut self, from: f64, to: f64, without: Option<isize>) -> Peaks {
        let most = self.shift_max_px();
        let (from, to) = (from.max(-most).floor() as isize, to.min(most).ceil() as isize);
        let n = Self::blocks(&self.columns).len();
        let every = self.scout_every();
        let rows = self.key.chunks_exact(n).zip(self.current.chunks_exact(n));
        for (shift, out) in (from..=to).zip(&mut *self.scout) {
            let mut sums = Sums::default();
            for (key, current) in rows.clone().step_by(every) {
                correlate(self.level, key, current, shift, &mut sums);
            }
            let c = Correlation::of(&sums);
            *out = if c.rho > chance(c.pairs).max(MATCH_MIN) { c.rho as f32 } else { 0.0 };
        }
        let count = ((to - from + 1).max(0) as usize).min(self.scout.len());
        Peaks::of(&self.scout[..count], from, without)
    }

    /// The same on all rows, down to half of what a match needs.
    fn faint_peaks(&mut self, from: f64, to: f64) -> Peaks {
        let most = self.shift_max_px();
        let (from, to) = (from.max(-most).floor() as isize, to.min(most).ceil() as isize);
        let count = ((to - from + 1).max(0) as usize).min(self.scout.len());
        for first in (0..count).step_by(PEAK_SHIFTS) {
            let correlations = self.correlations(from + first as isize);
            for (out, c) in self.scout[first..count].iter_mut().zip(correlations) {
                let shows = c.pairs >= PAIRS_MIN && c.rho > 0.5 * match_min(c.pairs);
                *out = if shows { c.rho as f32 } else { 0.0 };
            }
        }
        Peaks::of(&self.scout[..count], from, None)
    }

    /// The best interior shift of a range, to a hundredth of a pixel.
    fn best(&self, from: f64, to: f64) -> Option<Match> {
        let (from, to) = (from.floor() as isize, to.ceil() as isize);
        // The peak is most often in the middle of a short range: then its surroundings are known.
        let start = from.min(from.midpoint(to) - PEAK_HALF);
        let mut best: Option<(isize, Correlation)> = None;
        let mut known = (start, self.correlations(start));
        for first in (start..=to).step_by(PEAK_SHIFTS) {
            if first != known.0 {
                known = (first, self.correlations(first));
            }
            for (shift, c) in (first..=to).zip(known.1) {
                let better = c.pairs >= PAIRS_MIN && best.is_none_or(|(_, b)| c.rho > b.rho);
                if shift >= from && better {
                    best = Some((shift, c));
                }
            }
        }
        let (shift, c) = best?;
        // A maximum at the end of the range is a slope, not a match.
        if c.rho < match_min(c.pairs) || shift == from || shift == to {
            return None;
        }
        if shift - PEAK_HALF != known.0 {
            known.1 = self.correlations(shift - PEAK_HALF);
        }
        let around = known.1.map(|c| c.rho);
        let texture_grey = self.unit_grey * c.covariance.max(0.0).sqrt();
        let shift_px = shift as f64 + peak(&around)?;
        Some(Match { shift_px, rho: c.rho, pairs: c.pairs, texture_grey, missing: 0 })
    }

    /// Normalised correlation of key and current texture, and the pixels that took part, the belt
    /// having moved by `first` px, `first + 1` and so on.
    fn correlations(&self, first: isize) -> [Correlation; PEAK_SHIFTS] {
        let n = Self::blocks(&self.columns).len();
        let part = rows_per_band(self.key.len() / n, self.bands) * n;
        let parts = self.key.chunks(part).zip(self.current.chunks(part));
        let mut jobs: Jobs<_> = parts.map(|part| (part, [Sums::default(); PEAK_SHIFTS])).collect();
        bands::run(&mut jobs, &|((key, current), sums)| {
            for (key, current) in key.chunks_exact(n).zip(current.chunks_exact(n)) {
                for (shift, sums) in (first..).zip(&mut *sums) {
                    correlate(self.level, key, current, shift, sums);
                }
            }
        });
        std::array::from_fn(|k| {
            let sums = jobs.iter().fold(Sums::default(), |all, (_, more)| all.plus(&more[k]));
            Correlation::of(&sums)
        })
    }
}
