//! Belt motion from the belt's own texture: the witness that makes heights possible.
//!
//! In: belt view minus background, free belt only. Out: travel since the last frame, whether
//! it was measured. Owns: the texture of a key frame and of the current one.
//! The current texture is matched with the key's, not with the last frame's, so errors do
//! not add up frame by frame; a new key is taken when the overlap gets small. In the belt
//! view all belt motion is horizontal, so a match is one number.
//! Cost: at most 250,000 pixels taken out, and as many products for each shift tried, 13 when locked.
//! Source: normalised cross-correlation; its peak by Lanczos interpolation, because a parabola
//! through three shifts is off by 0.05 px, always towards the same side at the same speed.

use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::Level;
use crate::kernel::bands::{self, BANDS_MAX, Jobs, rows_per_band};
use crate::kernel::scalar::bits::{self, stride};
use crate::kernel::scalar::texture::{Belt, NO_TEXTURE, SUMS_BORDER, Sums};
use crate::kernel::simd::texture::{correlate, extract};
use crate::plan::{Block, Memory, Plan};
use crate::stage::background::Background;
use crate::units::{BeltMm, BeltRect};

/// At least every second row carries the texture: neighbouring rows repeat most of it ...
const ROW_STEP_MIN: usize = 2;
/// ... and so many pixels are enough: more cost time and tell next to nothing.
const TEXTURE_PX: usize = 250_000;
/// When locked, shifts this far around the prediction are tried.
const LOCKED_SEARCH_PX: f64 = 1.5;
/// The peak is interpolated from this many shifts to both sides.
const PEAK_HALF: isize = 4;
const PEAK_SHIFTS: usize = 2 * PEAK_HALF as usize + 1;
/// A correlation above this is a match: 200 x 800 px of pure noise stay below 0.02.
const MATCH_MIN: f64 = 0.08;
/// Pairs of textured pixels below which a match proves nothing.
const PAIRS_MIN: u32 = 4000;
/// A new key when the belt has moved on by this share of the zone.
const KEY_TRAVEL: f64 = 0.45;

/// Below this share of the nominal speed the belt counts as slow: stopping or starting.
const SLOW: f64 = 0.3;
/// The speed follows single frames, good to a few tenths of a px, at this rate.
const SPEED_FOLLOW: f64 = 0.3;
/// After this many frames without a match the key is given up.
const MISSES_MAX: u32 = 6;

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
    nominal_mm_per_s: f64,
    speed_error_max: f64,
    /// Last known speed.
    speed_mm_per_s: f64,
    key: Block<i8>,
    current: Block<i8>,
    sums: Block<i32>,
    /// Travel from the key to the last frame, px; `None` before the first key.
    shift_px: Option<f64>,
    locked: bool,
    /// Frames without a match since the last one.
    misses: u32,
}

struct Match {
    shift_px: f64,
    pairs: u32,
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
    }

    /// Not yet locked.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        nominal_mm_per_s: f64,
        speed_error_max: f64,
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
            nominal_mm_per_s,
            speed_error_max,
            speed_mm_per_s: nominal_mm_per_s,
            key: memory.take("odometry.key", NO_TEXTURE)?,
            current: memory.take("odometry.current", NO_TEXTURE)?,
            sums: memory.take("odometry.sums", 0)?,
            shift_px: None,
            locked: false,
            misses: 0,
        })
    }

    /// One frame, `dt_s` after the last one: `grey`, rows of [`stride`] pixels. `covered`: bit mask
    /// of pixels that are not belt.
    pub fn step(
        &mut self,
        grey: &[u8],
        background: &Background,
        covered: &[u64],
        dt_s: f64,
    ) -> Motion {
        self.extract(grey, background, covered);
        let Some(last_px) = self.shift_px else {
            self.take_key();
            return Motion { step_mm: self.speed_mm_per_s * dt_s, measured: false };
        };
        let found = self.search(last_px, dt_s);
        self.locked = found.is_some();
        let assumed_px = self.speed_mm_per_s * dt_s / self.mm_per_px;
        let step_px = found.as_ref().map_or(assumed_px, |m| m.shift_px - last_px);
        let step_mm = step_px * self.mm_per_px;
        if let Some(m) = found {
            if dt_s > 0.0 {
                self.speed_mm_per_s += SPEED_FOLLOW * (step_mm / dt_s - self.speed_mm_per_s);
            }
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
                self.speed_mm_per_s = self.nominal_mm_per_s;
                self.take_key();
            }
        }
        Motion { step_mm, measured: self.locked }
    }

    /// The next frame follows no other: as at start, but for the speed.
    pub fn forget(&mut self) {
        (self.shift_px, self.locked, self.misses) = (None, false, 0);
    }

    /// Speed of the belt, mm/s, and whether it is measured rather than assumed.
    pub fn speed(&self) -> (f64, bool) {
        (self.speed_mm_per_s, self.locked)
    }

    /// Whether the belt is known to stand still (below a tenth of the nominal speed).
    pub fn stands_still(&self) -> bool {
        self.locked && self.speed_mm_per_s.abs() < 0.1 * self.nominal_mm_per_s
    }

    fn take_key(&mut self) {
        std::mem::swap(&mut self.key, &mut self.current);
        self.shift_px = Some(0.0);
    }

    /// Belt texture of the zone: the view minus the background, where it is belt.
    fn extract(&mut self, grey: &[u8], background: &Background, covered: &[u64]) {
        let (words, stride) = (bits::words(self.width), stride(self.width));
        let belt = background.belt();
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
    /// from standstill to the fastest allowed. What does not move with the belt (light, dirt
    /// on the lens, exposure) correlates at standstill, so motion wins over standstill
    /// wherever it is seen at all.
    fn search(&self, last_px: f64, dt_s: f64) -> Option<Match> {
        let px = |mm_per_s: f64| mm_per_s * dt_s / self.mm_per_px;
        let slow = px(SLOW * self.nominal_mm_per_s);
        let predicted = last_px + px(self.speed_mm_per_s);
        if self.locked && self.speed_mm_per_s > SLOW * self.nominal_mm_per_s {
            let near = self.best(predicted - LOCKED_SEARCH_PX, predicted + LOCKED_SEARCH_PX);
            if near.is_some() {
                return near;
            }
        }
        let fastest = px(self.nominal_mm_per_s) * (1.0 + self.speed_error_max);
        self.best(last_px + slow, last_px + fastest + 2.0)
            .or_else(|| self.best(last_px - 2.0, last_px + slow + 1.0))
    }

    /// The best interior shift of a range, to a hundredth of a pixel.
    fn best(&self, from: f64, to: f64) -> Option<Match> {
        let (from, to) = (from.floor() as isize, to.ceil() as isize);
        // The peak is most often in the middle of a short range: then its surroundings are known.
        let start = from.min(from.midpoint(to) - PEAK_HALF);
        let mut best: Option<(isize, f64, u32)> = None;
        let mut known = (start, self.correlations(start));
        for first in (start..=to).step_by(PEAK_SHIFTS) {
            if first != known.0 {
                known = (first, self.correlations(first));
            }
            for (shift, (rho, pairs)) in (first..=to).zip(known.1) {
                let better = pairs >= PAIRS_MIN && best.is_none_or(|(_, r, _)| rho > r);
                if shift >= from && better {
                    best = Some((shift, rho, pairs));
                }
            }
        }
        let (shift, rho, pairs) = best?;
        // A maximum at the end of the range is a slope, not a match.
        if rho < MATCH_MIN || shift == from || shift == to {
            return None;
        }
        if shift - PEAK_HALF != known.0 {
            known.1 = self.correlations(shift - PEAK_HALF);
        }
        let around = known.1.map(|(rho, _)| rho);
        Some(Match { shift_px: shift as f64 + peak(&around)?, pairs })
    }

    /// Normalised correlation of key and current texture, and the pixels that took part, the belt
    /// having moved by `first` px, `first + 1` and so on.
    fn correlations(&self, first: isize) -> [(f64, u32); PEAK_SHIFTS] {
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
            let norm = (sums.aa as f64 * sums.bb as f64).sqrt();
            (if norm > 0.0 { sums.ab as f64 / norm } else { 0.0 }, sums.n)
        })
    }
}

/// The interpolated peak is looked for in steps of this many px.
const FINE_PX: f64 = 0.05;

/// Offset of the peak from the middle of correlations at neighbouring shifts; `None` when it
/// is not within a pixel.
fn peak(around: &[f64; PEAK_SHIFTS]) -> Option<f64> {
    use std::f64::consts::PI;
    let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
    let lanczos = |x: f64| sinc(x) * sinc(x / PEAK_HALF as f64);
    // Correlations of textures sampled finely enough are as smooth as the textures.
    let at = |offset: f64| -> f64 {
        let terms = around.iter().enumerate().map(|(k, rho)| {
            let x = offset - (k as isize - PEAK_HALF) as f64;
            if x.abs() < PEAK_HALF as f64 { rho * lanczos(x) } else { 0.0 }
        });
        terms.sum()
    };
    let best = (-19..=19)
        .map(|k| (k, at(f64::from(k) * FINE_PX)))
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(k, _)| f64::from(k) * FINE_PX)?;
    let (before, here, after) = (at(best - FINE_PX), at(best), at(best + FINE_PX));
    let curvature = before - 2.0 * here + after;
    let is_peak = curvature < 0.0 && before <= here && after <= here;
    is_peak.then(|| best + 0.5 * FINE_PX * (before - after) / curvature)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A parabola through the middle three shifts is off by up to 0.028 px here.
    #[test]
    fn the_peak_of_a_smooth_correlation_is_found_between_shifts() {
        for tenth in -4..=4 {
            let truth = f64::from(tenth) / 10.0;
            let around = std::array::from_fn(|k| {
                let x = (k as isize - PEAK_HALF) as f64 - truth;
                (-0.5 * (x / 1.3).powi(2)).exp()
            });
            let found = peak(&around).expect("a peak");
            // Four samples to each side leave 0.0015 px of this Gaussian.
            assert!((found - truth).abs() < 0.003, "{truth}: {found}");
        }
    }

    #[test]
    fn a_slope_has_no_peak() {
        assert_eq!(peak(&std::array::from_fn(|k| k as f64)), None);
    }
}
