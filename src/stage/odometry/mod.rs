//! Belt motion from the belt's own texture: the witness that makes heights possible.
//!
//! In: belt view minus background, free belt only. Out: travel since the last frame, whether
//! it was measured. Owns: the texture of a key and of the current frame.
//! The current texture is matched with the key's, not with the last frame's, so errors do
//! not add up frame by frame; another frame is the key when the overlap gets small. Where noise is stronger than the
//! texture, the key moves on with the belt instead, and its noise is averaged. In the belt view all belt motion is
//! horizontal, so a match is one number.
//! While it is not locked, a few of the rows are searched over every speed in both directions, and
//! several frames must agree; but a whole multiple of the last step is one at once: frames are missing
//! whose time stamps do not tell. A texture fainter than the camera's noise is searched on all rows, in
//! every frame: a few show neither it nor its rivals. Of a texture that fits itself at several shifts, as a modular belt's,
//! that one is taken which is the only one near the configured speed, or near the last step; if there are more, it is
//! ambiguous, and silhouettes that move otherwise refute what the texture shows: neither is a measurement.
//! Cost: at most 250,000 pixels taken out, and as many products for each shift tried: 13 when locked on
//! a clear texture, every speed in both directions on a faint one; bounded by the zone, whatever the
//! time stamps say.
//! Source: normalised cross-correlation; its peak by Lanczos interpolation, because a parabola
//! through three shifts is off by 0.05 px, always towards the same side at the same speed.

mod across;
mod blocks;
mod correlation;
mod key;
mod peaks;
mod search;

pub use across::Across;

use blocks::Blocks;
use correlation::{MATCH_MIN, Match, chance};
use key::Key;

use crate::camera::BeltView;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::Level;
use crate::kernel::bands::{self, BANDS_MAX, Jobs, rows_per_band};
use crate::kernel::scalar::bits::{self, stride};
use crate::kernel::scalar::texture::{Belt, NO_TEXTURE, SUMS_BORDER};
use crate::kernel::simd::texture::extract;
use crate::plan::{Block, Memory, Plan};
use crate::stage::background::Background;
use crate::stage::riders::Ride;
use crate::units::{BeltMm, BeltRect};

/// At least every second row carries the texture: neighbouring rows repeat most of it ...
const ROW_STEP_MIN: usize = 2;
/// ... and so many pixels are enough: more cost time and tell next to nothing.
const TEXTURE_PX: usize = 250_000;
/// Pairs of textured pixels below which a match proves nothing.
const PAIRS_MIN: u32 = 4000;
/// Below this correlation noise is clearly stronger than the texture: two frames share less than a quarter of what either shows.
const NOISY: f64 = 0.25;
/// A new key, or the same further on, when the belt has moved by this share of the zone.
const KEY_TRAVEL: f64 = 0.45;

/// Shifts up to this share of the zone leave enough overlap.
const SHIFT_SHARE: f64 = 0.5;
/// A standstill, and a mean of frames, need texture of at least this, grey levels: what compression leaves of a plain
/// belt, frozen from frame to frame, is below 0.1, and what parcels and lamps cast on it 0.15.
const TEXTURE_GREY_MIN: f64 = 0.25;
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
    /// Of the last frame alone.
    last_mm_per_s: f64,
    /// The texture fits itself at other speeds, too.
    repeats: bool,
    key: Key,
    blocks: Blocks,
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
    /// Correlation of the last match, as of two single frames.
    rho: f64,
    /// Frames in which a texture that repeats itself moved neither as configured nor stood.
    unusual_frames: u32,
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
        Key::plan(n, plan);
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
        let key = Key::new(Self::blocks(&zone[0]).len(), memory)?;
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
            last_mm_per_s: expected.nominal_mm_per_s,
            repeats: false,
            key,
            blocks: Blocks::default(),
            current: memory.take("odometry.current", NO_TEXTURE)?,
            sums: memory.take("odometry.sums", 0)?,
            scout: memory.take("odometry.scout", 0.0)?,
            unit_grey: 0.0,
            shift_px: None,
            key_age_s: 0.0,
            seen: None,
            knowledge: Knowledge::default(),
            locked: false,
            rho: 0.0,
            unusual_frames: 0,
            misses: 0,
            untold_gaps: 0,
            proofs: 0,
            doubts: (0, false),
        })
    }

    /// A frame as it came from the camera.
    pub fn look_at_raw(&mut self, raw: Plane<'_>) {
        self.blocks.add(raw);
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
                self.last_mm_per_s = step_mm / dt_s;
                self.speed_mm_per_s += SPEED_FOLLOW * (self.last_mm_per_s - self.speed_mm_per_s);
            }
            self.knowledge = Knowledge::Measured;
            // Of a mean, next to noiseless, and a frame the correlation is the root.
            self.rho = if self.key.is_mean() { m.rho * m.rho } else { m.rho };
            self.misses = 0;
            self.shift_px = Some(m.shift_px);
            self.renew_key(&m);
        } else {
            self.misses += 1;
            self.shift_px = Some(last_px + step_px);
            // A parcel may hide the belt for a moment: the last speed bridges that. When
            // the texture stays away, only the nominal speed is known.
            if self.misses >= MISSES_MAX {
                self.speed_mm_per_s = self.expected.nominal_mm_per_s;
                self.take_key();
                self.misses = 0;
            } else if self.knowledge == Knowledge::Ambiguous {
                // Each step is looked at alone: no assumed one comes in.
                let seen = self.seen;
                self.take_key();
                self.seen = seen;
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
            // At another of its speeds it stands, too.
            Ride::Stands => {
                let still_mm_per_s = STILL * self.expected.nominal_mm_per_s;
                (false, self.repeats && speed_mm_per_s.abs() > still_mm_per_s)
            }
            Ride::Unknown => (false, false),
        };
        let as_expected = (speed_mm_per_s / self.expected.nominal_mm_per_s - 1.0).abs()
            < self.expected.speed_error_max;
        // A texture that repeats itself moves as expected because that was expected.
        if (agrees || as_expected) && !contradicts && pairs >= PROOF_PAIRS && !self.repeats {
            self.proofs += 1;
        }
        if agrees {
            self.doubts.0 = 0;
        }
        self.doubts.0 += u32::from(contradicts && !self.doubts.1);
        self.doubts.1 = contradicts;
        let is_proven = !self.repeats && self.proofs >= PROOF_FRAMES && self.doubts.0 < DOUBTS_MAX;
        let refuted = contradicts && !is_proven;
        if refuted {
            self.knowledge = Knowledge::Refuted;
            (self.proofs, self.seen) = (0, None);
        }
        refuted
    }

    /// The next frame follows no other: as at start, but for the speed.
    pub fn forget(&mut self) {
        (self.shift_px, self.seen, self.locked, self.misses) = (None, None, false, 0);
        self.repeats = false;
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

    /// Whether what a codec's blocks left of the texture was matched, which sticks to them more or less.
    pub fn follows_blocks(&self) -> bool {
        self.locked && self.rho < NOISY && self.blocks.are_seen()
    }

    /// Whether the belt is known to stand still (below a tenth of the nominal speed).
    pub fn stands_still(&self) -> bool {
        self.locked && self.speed_mm_per_s.abs() < STILL * self.expected.nominal_mm_per_s
    }

    fn take_key(&mut self) {
        self.key.replace(&mut self.current);
        (self.shift_px, self.key_age_s, self.seen) = (Some(0.0), 0.0, None);
    }

    /// After a match: the current frame is the key once the belt has moved on far. Where noise is stronger than the texture,
    /// the frame is added to the key instead.
    fn renew_key(&mut self, found: &Match) {
        let is_far = found.shift_px.abs() > KEY_TRAVEL * self.columns.len() as f64
            || found.pairs < PAIRS_MIN * 2;
        // What a codec leaves of the texture sticks to the picture's blocks: a mean would follow them.
        let is_averaged =
            self.rho < NOISY && found.texture_grey >= TEXTURE_GREY_MIN && !self.blocks.are_seen();
        if !is_averaged {
            if is_far {
                self.take_key();
            }
            return;
        }
        let mut shift_px = found.shift_px;
        if is_far {
            let whole = shift_px.round();
            self.key.move_on(whole as isize);
            shift_px -= whole;
            (self.shift_px, self.key_age_s, self.seen) = (Some(shift_px), 0.0, None);
        }
        self.key.add(self.level, &self.current, shift_px);
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
}
