//! Where the current texture lies on the key's.
//!
//! In: both textures, and what is known of the speed. Out: the best match, or why there is none: nothing to be seen, or several that
//! are as good.

use super::correlation::{Correlation, MATCH_MIN, Match, chance, match_min};
use super::peaks::{LIKE_HEIGHT, PEAK_HALF, PEAK_SHIFTS, Peaks, peak};
use super::{Knowledge, Odometry, PAIRS_MIN, SLOW, STILL, TEXTURE_GREY_MIN};
use crate::kernel::bands::{self, Jobs, rows_per_band};
use crate::kernel::scalar::texture::Sums;
use crate::kernel::simd::texture::correlate;

/// The step of a texture that repeats itself is known to this, px: it is a clear one.
const STEP_ERROR_PX: f64 = 0.5;
/// Steps of a belt that neither brakes nor starts differ by no more than this, px.
const STEADY_PX: f64 = 0.25;
/// Faster no belt is braked or started, but in an emergency: from 1 m/s in half a second.
const ACCELERATION_MAX_MM_PER_S2: f64 = 2000.0;
/// A belt brakes, or starts, within so many frames; what moves otherwise for longer is another of its texture's speeds.
const UNUSUAL_FRAMES_MAX: u32 = 60;
/// When locked, shifts this far around the prediction are tried.
const LOCKED_SEARCH_PX: f64 = 1.5;
/// Pixels of the rows that are searched over every speed.
const SCOUT_PX: usize = 12_000;
/// A speed far from the nominal one is believed when this many frames on end show it ...
const SCOUT_FRAMES: u32 = 3;
/// ... within this share.
const SCOUT_AGREE: f64 = 0.03;

impl Odometry {
    /// The best match: near the prediction when locked on a moving belt, else over every speed
    /// from standstill to the fastest allowed, else over all that the zone can show. What does not
    /// move with the belt (light, dirt on the lens, exposure) correlates at standstill, so motion
    /// wins over standstill wherever it is seen at all.
    pub(super) fn search(&mut self, last_px: f64, dt_s: f64) -> Option<Match> {
        self.knowledge = Knowledge::NoTexture;
        if last_px.abs() > self.shift_max_px() || !self.bridges(dt_s) {
            return None;
        }
        let px = |mm_per_s: f64| mm_per_s * dt_s / self.mm_per_px;
        let slow = px(SLOW * self.expected.nominal_mm_per_s);
        let predicted = last_px + px(self.speed_mm_per_s);
        if self.locked && self.repeats {
            self.knowledge = Knowledge::Ambiguous;
            return self.look_near(last_px, dt_s);
        }
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
            still.filter(|m| is_clear(m) && m.texture_grey >= TEXTURE_GREY_MIN).or(moving)
        };
        let (from, to) = (last_px - fastest, last_px + fastest);
        // A few rows are too few to show its rivals.
        let every = self.scout_every() as u32;
        let is_faint = found.as_ref().is_some_and(|m| {
            f64::from(LIKE_HEIGHT) * m.rho < chance(m.pairs / every).max(MATCH_MIN)
        });
        let peaks = if is_faint { self.faint_peaks(from, to) } else { self.peaks(from, to, None) };
        match (found, peaks) {
            (Some(found), peaks) if !peaks.rival_of(found.shift_px) => {
                self.repeats = false;
                Some(found)
            }
            (Some(_), _) => {
                self.knowledge = Knowledge::Ambiguous;
                self.look_near(last_px, dt_s)
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
            self.repeats = false;
            return Some(Match { missing, ..found });
        }
        let speed = shift as f64 * self.mm_per_px / self.key_age_s;
        // A shift is known to a px.
        let off = SCOUT_AGREE * speed.abs() + 2.0 * self.mm_per_px / self.key_age_s;
        if !self.is_agreed(speed, off) {
            return None;
        }
        let found = self.best(shift as f64 - 2.0, shift as f64 + 2.0)?;
        self.repeats = false;
        self.speed_mm_per_s = found.shift_px * self.mm_per_px / self.key_age_s;
        // The step of this frame alone: those before it were assumed.
        self.shift_px = Some(found.shift_px - self.speed_mm_per_s * dt_s / self.mm_per_px);
        Some(found)
    }

    /// Of a texture that fits itself at several shifts, the only one that a belt's masses allow after the last step; or, when that
    /// is not known, the only one at the configured speed, once several frames on end show the same step.
    fn look_near(&mut self, last_px: f64, dt_s: f64) -> Option<Match> {
        let found = self.only_one_near(last_px, dt_s);
        if self.locked {
            return found.filter(|found| self.may_go_on(found.shift_px - last_px, dt_s));
        }
        let Some(found) = found else {
            self.seen = None;
            return None;
        };
        let px_per_s = (found.shift_px - last_px) / dt_s;
        let off_px_per_s = STEADY_PX / dt_s;
        self.repeats = self.is_agreed(px_per_s * self.mm_per_px, off_px_per_s * self.mm_per_px);
        self.repeats.then_some(found)
    }

    fn only_one_near(&mut self, last_px: f64, dt_s: f64) -> Option<Match> {
        let nominal_mm_per_s = self.expected.nominal_mm_per_s;
        let (usual_mm_per_s, off_mm_per_s) = if self.locked {
            (self.last_mm_per_s, ACCELERATION_MAX_MM_PER_S2 * dt_s)
        } else {
            (nominal_mm_per_s, nominal_mm_per_s * self.expected.speed_error_max)
        };
        let [usual_px, off_px] =
            [usual_mm_per_s, off_mm_per_s].map(|speed| speed * dt_s / self.mm_per_px);
        let most = self.shift_max_px();
        let [from, to] = [-1.0, 1.0]
            .map(|side| (last_px + usual_px + side * (off_px + STEP_ERROR_PX)).clamp(-most, most));
        let in_range = |m: &Match| dt_s > 0.0 && (from..=to).contains(&m.shift_px);
        let found = self.best(from, to).filter(in_range)?;
        self.is_alone(&found, from, to).then_some(found)
    }

    /// Whether a texture that repeats itself may go on so: for long it moves at the configured speed, or stands.
    fn may_go_on(&mut self, step_px: f64, dt_s: f64) -> bool {
        let speed_mm_per_s = step_px * self.mm_per_px / dt_s;
        let nominal_mm_per_s = self.expected.nominal_mm_per_s;
        let off = (speed_mm_per_s / nominal_mm_per_s - 1.0).abs();
        let is_usual = off < self.expected.speed_error_max + STEP_ERROR_PX / step_px.abs().max(1.0)
            || speed_mm_per_s.abs() < STILL * nominal_mm_per_s;
        self.unusual_frames = if is_usual { 0 } else { self.unusual_frames + 1 };
        self.unusual_frames < UNUSUAL_FRAMES_MAX
    }

    /// Whether a match has no rival within a range, however near.
    fn is_alone(&mut self, found: &Match, from: f64, to: f64) -> bool {
        let (from, to) = (from.floor() as isize - 1, to.ceil() as isize + 1);
        let count = self.correlate_all(from, to, |c| c.pairs >= PAIRS_MIN);
        let like = LIKE_HEIGHT * found.rho as f32;
        let mut peaks = (from + 1..to).zip(self.scout[..count].windows(3));
        peaks.all(|(shift, rho)| {
            let is_peak = rho[1] >= rho[0] && rho[1] >= rho[2] && rho[1] > like;
            !is_peak || (shift as f64 - found.shift_px).abs() <= 1.0
        })
    }

    /// Whether enough frames on end have shown a speed, mm/s, that differs by no more than `off`.
    fn is_agreed(&mut self, speed: f64, off: f64) -> bool {
        let agreed = match self.seen {
            Some((before, frames)) if (speed - before).abs() < off => frames + 1,
            _ => 1,
        };
        self.seen = Some((speed, agreed));
        agreed >= SCOUT_FRAMES
    }

    /// Of so many rows one is searched over every speed.
    fn scout_every(&self) -> usize {
        (self.current.len() / SCOUT_PX).max(1)
    }

    /// Peaks of the correlation on a few rows, over a range of shifts, but for those near `without`.
    pub(super) fn peaks(&mut self, from: f64, to: f64, without: Option<isize>) -> Peaks {
        let most = self.shift_max_px();
        let (from, to) = (from.max(-most).floor() as isize, to.min(most).ceil() as isize);
        let n = Self::blocks(&self.columns).len();
        let every = self.scout_every();
        let rows = self.key.texture().chunks_exact(n).zip(self.current.chunks_exact(n));
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
        let shows = |c: &Correlation| c.pairs >= PAIRS_MIN && c.rho > 0.5 * match_min(c.pairs);
        let count = self.correlate_all(from, to, shows);
        Peaks::of(&self.scout[..count], from, None)
    }

    /// Correlations on all rows over a range of shifts, 0 where they do not show anything. Returns how many.
    fn correlate_all(
        &mut self,
        from: isize,
        to: isize,
        shows: impl Fn(&Correlation) -> bool,
    ) -> usize {
        let count = ((to - from + 1).max(0) as usize).min(self.scout.len());
        for first in (0..count).step_by(PEAK_SHIFTS) {
            let correlations = self.correlations(from + first as isize);
            for (out, c) in self.scout[first..count].iter_mut().zip(correlations) {
                *out = if shows(&c) { c.rho as f32 } else { 0.0 };
            }
        }
        count
    }

    /// The best interior shift of a range, to a hundredth of a pixel.
    pub(super) fn best(&self, from: f64, to: f64) -> Option<Match> {
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
    pub(super) fn correlations(&self, first: isize) -> [Correlation; PEAK_SHIFTS] {
        let n = Self::blocks(&self.columns).len();
        let part = rows_per_band(self.current.len() / n, self.bands) * n;
        let parts = self.key.texture().chunks(part).zip(self.current.chunks(part));
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
