//! Belt motion from what lies on it: a coarse witness that needs no texture.
//!
//! In: runs of the foreground. Out: how fast the silhouettes move, once several frames agree.
//! Owns: two profiles, the foreground pixels of each column. All motion is along rows, so the shift
//! that lays one profile on the other is the motion. Tops move faster than the belt, by up to the
//! view's magnification, so this witness cannot measure; it refutes, and it bridges.
//! What reaches beyond the picture does not count: an end that the picture cuts off does not move.
//! Cost: two thirds of the columns squared, in additions.

use crate::error::Result;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::runs::Run;
use crate::plan::{Block, Memory, Plan};

/// Less foreground than this on the belt is no witness.
const AREA_MIN_MM2: f64 = 1000.0;
/// Shifts up to this share of the view are tried, both ways.
const SHIFT_SHARE: usize = 3;
/// Silhouettes that have moved fit at their shift at least this much better than where they were.
const MOVED_SHARE: f64 = 0.5;
/// Standing ones fit where they were but for this share: the noise of their borders.
const STOOD_MISFIT: f64 = 0.02;
/// Speeds of neighbouring frames that agree differ by no more than this share.
const AGREE: f64 = 0.25;
/// So many frames on end make motion ...
const MOVING_FRAMES: u32 = 4;
/// ... and so many a standstill.
const STANDING_FRAMES: u32 = 8;
/// The speed follows single frames at this rate.
const FOLLOW: f64 = 0.3;

/// What the silhouettes do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ride {
    /// Nothing lies there, or the frames do not agree.
    Unknown,
    /// They stand.
    Stands,
    /// They move, mm/s on the belt plane: at the belt's speed or up to the magnification faster.
    Moves(f64),
}

/// The stage.
pub struct Riders {
    mm_per_px: f64,
    /// By label: the picture's border cuts this silhouette off.
    cut: Block<bool>,
    profile: Block<i32>,
    last: Block<i32>,
    speed_px_per_s: f64,
    moving_frames: u32,
    standing_frames: u32,
}

impl Riders {
    /// Memory for a view.
    pub fn plan([width, _]: [usize; 2], blobs_max: usize, plan: &mut Plan) {
        plan.add::<bool>("riders.cut", blobs_max, "limits.blobs_max");
        plan.add::<i32>("riders.profile", width + 1, "foreground pixels of each column");
        plan.add::<i32>("riders.last", width + 1, "the same of the last frame");
    }

    /// Nothing seen.
    pub fn new(mm_per_px: f64, memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            mm_per_px,
            cut: memory.take("riders.cut", false)?,
            profile: memory.take("riders.profile", 0)?,
            last: memory.take("riders.last", 0)?,
            speed_px_per_s: 0.0,
            moving_frames: 0,
            standing_frames: 0,
        })
    }

    /// One frame, `dt_s` after the last one. `seen`: bit mask of what the camera sees.
    pub fn step(&mut self, runs: &[Run], seen: &[u64], dt_s: f64) {
        std::mem::swap(&mut self.profile, &mut self.last);
        self.cut_off(runs, seen);
        fill(&mut self.profile, runs, &self.cut);
        let area_min_px = AREA_MIN_MM2 / (self.mm_per_px * self.mm_per_px);
        let area_px = |profile: &[i32]| profile.iter().map(|&n| f64::from(n)).sum::<f64>();
        if dt_s <= 0.0 || area_px(&self.profile).min(area_px(&self.last)) < area_min_px {
            return self.forget();
        }
        let here = misfit(&self.last, &self.profile, 0);
        let most = (self.profile.len() / SHIFT_SHARE) as isize;
        let best = (-most..=most)
            .map(|shift| (shift, misfit(&self.last, &self.profile, shift)))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        match best {
            _ if here < STOOD_MISFIT => {
                self.standing_frames += 1;
                self.moving_frames = 0;
            }
            Some((shift, misfit)) if shift != 0 && misfit < MOVED_SHARE * here => {
                let speed = shift as f64 / dt_s;
                let agrees = (speed - self.speed_px_per_s).abs() < AGREE * speed.abs();
                self.standing_frames = 0;
                if agrees {
                    self.moving_frames += 1;
                    self.speed_px_per_s += FOLLOW * (speed - self.speed_px_per_s);
                } else {
                    (self.moving_frames, self.speed_px_per_s) = (1, speed);
                }
            }
            _ => self.forget(),
        }
    }

    /// Find the silhouettes that reach beyond what the camera sees along the travel.
    fn cut_off(&mut self, runs: &[Run], seen: &[u64]) {
        let width = self.profile.len() - 1;
        let n = words(width);
        self.cut.fill(false);
        for run in runs {
            let row = &seen[usize::from(run.v) * n..][..n];
            let (start, end) = (usize::from(run.start), usize::from(run.end));
            let ends_inside =
                start > 0 && bits::get(row, start - 1) && end < width && bits::get(row, end);
            if let Some(cut) = self.cut.get_mut(run.label as usize) {
                *cut |= !ends_inside;
            }
        }
    }

    /// What the last frames agree on.
    pub fn ride(&self) -> Ride {
        if self.moving_frames >= MOVING_FRAMES {
            Ride::Moves(self.speed_px_per_s * self.mm_per_px)
        } else if self.standing_frames >= STANDING_FRAMES {
            Ride::Stands
        } else {
            Ride::Unknown
        }
    }

    /// Nothing agrees with what comes next.
    pub fn forget(&mut self) {
        (self.moving_frames, self.standing_frames) = (0, 0);
    }
}

/// Pixels of each column that belong to silhouettes which are seen whole.
fn fill(profile: &mut [i32], runs: &[Run], cut: &[bool]) {
    profile.fill(0);
    let whole = |run: &&Run| cut.get(run.label as usize) == Some(&false);
    for run in runs.iter().filter(whole) {
        profile[usize::from(run.start)] += 1;
        profile[usize::from(run.end)] -= 1;
    }
    let mut inside = 0;
    for n in profile {
        inside += *n;
        *n = inside;
    }
}

/// Share of the foreground that does not lie on itself when it has moved by `shift` columns; 1 when
/// less than half of it can.
fn misfit(last: &[i32], profile: &[i32], shift: isize) -> f64 {
    let all: i32 = last.iter().chain(profile).sum();
    let last = &last[(-shift).max(0) as usize..];
    let profile = &profile[shift.max(0) as usize..];
    let (mut apart, mut both) = (0, 0);
    for (a, b) in last.iter().zip(profile) {
        apart += (a - b).abs();
        both += a + b;
    }
    if 2 * both < all { 1.0 } else { f64::from(apart) / f64::from(both.max(1)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A parcel of 60 x 40 px whose left end is at each of `columns`, 40 frames a second.
    fn ride(columns: impl Iterator<Item = u16>) -> Ride {
        let mut plan = Plan::default();
        Riders::plan([400, 300], 4, &mut plan);
        let mut memory = plan.reserve(1).expect("small");
        let mut riders = Riders::new(2.0, &mut memory).expect("planned");
        // The camera sees all but the first and the last column.
        let row: [u64; words(400)] =
            std::array::from_fn(|w| if w == 0 { u64::MAX - 1 } else { u64::MAX });
        let mut seen = row.repeat(300);
        for row in seen.chunks_exact_mut(row.len()) {
            row[399 / 64] &= !(1 << (399 % 64));
        }
        for start in columns {
            let end = (start + 60).min(399);
            let runs = [0; 40].map(|_| Run { start: start.max(1), end, ..Run::default() });
            riders.step(&runs, &seen, 1.0 / 40.0);
        }
        riders.ride()
    }

    #[test]
    fn silhouettes_show_their_motion_both_ways() {
        assert_eq!(ride((0..8).map(|k| 10 + 7 * k)), Ride::Moves(560.0));
        assert_eq!(ride((0..8).map(|k| 300 - 7 * k)), Ride::Moves(-560.0));
    }

    #[test]
    fn one_that_leaves_the_picture_shows_no_motion() {
        // Its leading end stays at the border, so that its middle moves at half of its speed.
        assert_eq!(ride((0..8).map(|k| 338 + 2 * k)), Ride::Unknown);
        assert_eq!(ride((0..8).map(|k| 1 - k.min(1))), Ride::Unknown);
    }

    #[test]
    fn one_that_stands_stands_and_a_jump_is_no_motion() {
        assert_eq!(ride((0..10).map(|_| 100)), Ride::Stands);
        assert_eq!(ride([100, 100, 180, 180, 90, 200].into_iter()), Ride::Unknown);
    }
}
