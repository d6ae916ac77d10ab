//! Blobs -> tracks: each parcel carried through the view by the belt's predicted motion.
//!
//! In: blobs, travel since the last frame. Out: which track owns which blob; new, lost and
//! departed tracks. Owns: the track table. Limits: `limits.tracks_max`; a parcel that finds
//! it full is counted. A track counts only once it has moved with the belt: a ghost in the
//! background or a hand does not. Neighbours that perspective or a shadow shows as one blob become
//! two tracks once they have been seen apart.

mod gap;
mod state;

pub use gap::Seen;
pub use state::{Phase, Track};

use super::segment::{Blob, PxBox};
use crate::belt::BeltPosition;
use crate::error::Result;
use crate::plan::{Block, Memory, Plan};
use state::FREE;

/// Overlap over union of a blob and a track's prediction that makes the blob the track's.
const SAME_MIN: f32 = 0.2;
/// Overlap, as a share of the smaller box, that makes a blob a piece of a track not measured
/// yet, or a track part of another's blob.
const OVERLAP_MIN: f32 = 0.3;
/// A blob must have followed the belt this far, px, before its track is believed ...
const CONFIRM_TRAVEL_PX: f64 = 15.0;
/// ... and by at least this share of the travel.
const CONFIRM_SHARE: f32 = 0.6;
/// A track that has not followed the belt over this travel is none, px.
const GIVE_UP_TRAVEL_PX: f64 = 90.0;
/// A track unseen over this travel is gone, px.
const UNSEEN_TRAVEL_PX: f64 = 120.0;
/// A fragment this young joins an older track instead of being merged with it, frames.
const YOUNG_FRAMES: u32 = 8;

/// A smaller track inside a larger one's blob for this many frames is a piece of it.
const FRAGMENT_FRAMES: u32 = 8;
/// The end of several pieces follows the belt by at least the rest of this share.
const LAG_SHARE: f32 = 0.5;
/// A track with several large blobs over this travel, px, is several parcels, ...
const SPLIT_TRAVEL_PX: f64 = 20.0;
/// ... those of more than this share of its bright pixels ...
const SPLIT_SHARE: f32 = 0.1;
/// ... that are bright by this share: other blobs may be shadows.
const SPLIT_BRIGHT_SHARE: f32 = 0.5;
/// A track that was measured while it was apart over this travel, px, is no mere piece of what it
/// now runs together with, ...
const APART_TRAVEL_PX: f32 = 80.0;
/// ... if its box is at least this share of it.
const APART_SHARE: f32 = 0.2;
/// Inside means this share of its box.
const INSIDE_SHARE: f32 = 0.8;

/// No owner.
pub const NOBODY: u16 = u16::MAX;

/// What happened to a track in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// A new candidate in this slot.
    Began,
    /// A parcel vanished inside the view; its slot is free again.
    Lost,
}

/// The tracking stage.
pub struct Tracker {
    mm_per_px: f64,
    magnification_max: f64,
    width_px: usize,
    tracks: Block<Track>,
    owners: Block<u16>,
    changes: heapless::Vec<(usize, Change), 512>,
    /// Blobs that found no free track.
    pub overflows: u64,
}

impl Tracker {
    /// Memory for the tables.
    pub fn plan(tracks_max: usize, blobs_max: usize, plan: &mut Plan) {
        plan.add::<Track>("track.tracks", tracks_max, "limits.tracks_max");
        plan.add::<u16>("track.owners", blobs_max, "limits.blobs_max: the track of each blob");
    }

    /// No tracks.
    pub fn new(
        mm_per_px: f64,
        magnification_max: f64,
        width_px: usize,
        memory: &mut Memory,
    ) -> Result<Self> {
        Ok(Self {
            mm_per_px,
            magnification_max,
            width_px,
            tracks: memory.take("track.tracks", FREE)?,
            owners: memory.take("track.owners", NOBODY)?,
            changes: heapless::Vec::new(),
            overflows: 0,
        })
    }

    /// Carry the tracks on by `step_mm` of belt travel and give them their blobs.
    /// `covers`: whether the middle of a box lies in the silhouette of the cuboid measured on a
    /// slot; `None` when nothing is measured there yet.
    pub fn step(
        &mut self,
        blobs: &[Blob],
        step_mm: f64,
        at: BeltPosition,
        covers: &dyn Fn(usize, &PxBox) -> Option<bool>,
    ) {
        self.changes.clear();
        self.owners.fill(NOBODY);
        let step_px = step_mm / self.mm_per_px;
        for track in self.tracks.iter_mut().filter(|t| t.phase != Phase::Free) {
            // The top moves faster than the belt. While nothing is seen of the parcel itself
            // the belt's own motion is the guess that does not grow.
            let hidden = track.merged || track.unseen_px > 0.0;
            let most = if hidden { step_px } else { step_px * self.magnification_max };
            track.bounds = track.bounds.swept(step_px as f32, most as f32);
            track.merged = false;
            track.frames = track.frames.saturating_add(1);
        }
        for blob in blobs {
            if let Some(owner) = self.owner_of(blob, covers) {
                self.owners[blob.label as usize] = owner as u16;
            }
        }
        for slot in 0..self.tracks.len() {
            let owns = |b: &Blob| self.owners[b.label as usize] == slot as u16;
            if self.tracks[slot].phase != Phase::Free && !blobs.iter().any(owns) {
                self.share(slot, blobs, step_px, covers);
            } else {
                self.tracks[slot].inside_frames = 0;
            }
        }
        self.gather(blobs, step_px);
        for blob in blobs {
            if self.owners[blob.label as usize] == NOBODY {
                self.begin(blob, at);
            }
        }
        for slot in 0..self.tracks.len() {
            self.split(slot, blobs, step_px, at);
        }
        self.judge(at);
    }

    /// The track that a blob belongs to: the parcel whose cuboid it is part of, the track
    /// whose prediction it matches, or the one, not measured yet, that it is a piece of.
    fn owner_of(
        &self,
        blob: &Blob,
        covers: &dyn Fn(usize, &PxBox) -> Option<bool>,
    ) -> Option<usize> {
        let claim = |slot: usize| {
            let track = &self.tracks[slot];
            if track.phase == Phase::Free {
                return 0.0;
            }
            let overlap = track.bounds.overlap(&blob.bounds);
            let (a, b) = (track.bounds.area(), blob.bounds.area());
            let same = overlap / (a + b - overlap);
            let piece = overlap / a.min(b) > OVERLAP_MIN;
            match covers(slot, &blob.bounds) {
                Some(true) => 3.0 + same,
                // An older track outbids the young one of a piece that was seen apart.
                None if piece && track.frames >= YOUNG_FRAMES => 2.0 + same,
                _ if same >= SAME_MIN => 1.0 + same,
                None if piece => same,
                _ => 0.0,
            }
        };
        let best = (0..self.tracks.len()).max_by(|&x, &y| claim(x).total_cmp(&claim(y)))?;
        (claim(best) > 0.0).then_some(best)
    }

    /// A track without a blob of its own: merged into the blob that hides it, or, when it lies
    /// in that blob's own parcel for long enough, a piece of that parcel.
    fn share(
        &mut self,
        slot: usize,
        blobs: &[Blob],
        step_px: f64,
        covers: &dyn Fn(usize, &PxBox) -> Option<bool>,
    ) {
        let bounds = self.tracks[slot].bounds;
        let hides = |b: &&Blob| {
            let smaller = bounds.area().min(b.bounds.area());
            self.owners[b.label as usize] != NOBODY
                && bounds.overlap(&b.bounds) > OVERLAP_MIN * smaller
        };
        let overlap = |b: &&Blob| bounds.overlap(&b.bounds);
        let hidden_by = blobs.iter().filter(hides).max_by(|a, b| overlap(a).total_cmp(&overlap(b)));
        let Some(blob) = hidden_by else { return };
        let owner = usize::from(self.owners[blob.label as usize]);
        let whole = self.tracks[owner].bounds.union(&blob.bounds);
        let was_apart = covers(slot, &bounds).is_some()
            && bounds.area() >= APART_SHARE * whole.area()
            && self.tracks[slot].followed_px(step_px >= 0.0) >= APART_TRAVEL_PX;
        let inside = covers(owner, &bounds) == Some(true)
            || !was_apart && whole.overlap(&bounds) >= INSIDE_SHARE * bounds.area();
        let track = &mut self.tracks[slot];
        track.inside_frames = if inside { track.inside_frames + 1 } else { 0 };
        let young = track.frames < YOUNG_FRAMES && track.phase == Phase::Candidate;
        if young || track.inside_frames >= FRAGMENT_FRAMES {
            // What looked like two parcels was one.
            track.phase = Phase::Free;
            self.tracks[owner].merged_frames = 0;
        } else {
            track.merged = true;
            self.tracks[owner].merged |= !inside;
        }
    }

    /// Each track's box becomes that of its blobs; the prediction stands when it has none, or
    /// shares one.
    fn gather(&mut self, blobs: &[Blob], step_px: f64) {
        for s in 0..self.tracks.len() {
            let track = &mut self.tracks[s];
            if track.phase == Phase::Free {
                continue;
            }
            let own = || blobs.iter().filter(|b| self.owners[b.label as usize] == s as u16);
            let mut seen = own().fold(PxBox::default(), |all, b| all.union(&b.bounds));
            if own().nth(1).is_some() {
                // A piece that stays behind, a ghost in the background, is soon out of the box.
                let largest = own().max_by_key(|b| b.area_px).map_or(seen, |b| b.bounds);
                let lagging = track.bounds.u0 - LAG_SHARE * step_px.max(0.0) as f32;
                seen.u0 = seen.u0.max(lagging).min(largest.u0);
            }
            if track.merged {
                track.merged_frames += 1;
                track.unseen_px = 0.0;
            } else if seen.u0.is_finite() {
                track.bounds = seen;
                track.unseen_px = 0.0;
            } else {
                track.unseen_px += step_px.abs();
            }
        }
    }

    /// A track whose blobs have been several parcels' for long enough becomes several tracks. What
    /// was seen of them together is of no use to any of them.
    fn split(&mut self, slot: usize, blobs: &[Blob], step_px: f64, at: BeltPosition) {
        let track = &mut self.tracks[slot];
        if !matches!(track.phase, Phase::Candidate | Phase::Riding) {
            return;
        }
        let bright = |b: &Blob| b.bright_px as f32;
        let owned = |owners: &[u16], b: &&Blob| owners[b.label as usize] == slot as u16;
        let total: f32 = blobs.iter().filter(|b| owned(&self.owners, b)).map(bright).sum();
        let is_parcel = |b: &&Blob| {
            bright(b) > SPLIT_SHARE * total && bright(b) >= SPLIT_BRIGHT_SHARE * b.area_px as f32
        };
        let parcels = || blobs.iter().filter(|b| owned(&self.owners, b)).filter(is_parcel);
        // The largest goes on; the others must show that they ride on the belt: one may be a ghost.
        let largest = parcels().max_by_key(|b| b.bright_px);
        let Some(first) = largest.filter(|_| parcels().nth(1).is_some()) else {
            track.split_px = 0.0;
            return;
        };
        track.split_px += step_px.abs();
        if track.split_px < SPLIT_TRAVEL_PX {
            return;
        }
        let (bounds, phase) = (first.bounds, track.phase);
        *track = Track { phase, bounds, first: at, first_bounds: bounds, ..FREE };
        let _ = self.changes.push((slot, Change::Began));
        for blob in blobs.iter().filter(is_parcel) {
            if owned(&self.owners, &blob) && blob.label != first.label {
                self.owners[blob.label as usize] = NOBODY;
                self.begin(blob, at);
            }
        }
    }

    fn begin(&mut self, blob: &Blob, at: BeltPosition) {
        let Some(slot) = self.tracks.iter().position(|t| t.phase == Phase::Free) else {
            self.overflows += 1;
            return;
        };
        self.tracks[slot] = Track {
            phase: Phase::Candidate,
            bounds: blob.bounds,
            first: at,
            first_bounds: blob.bounds,
            ..FREE
        };
        self.owners[blob.label as usize] = slot as u16;
        // 256 tracks can begin and be lost once each: 512 changes; more are split ones.
        let _ = self.changes.push((slot, Change::Began));
    }

    /// Confirm what rides on the belt, drop what does not, free what is out of view.
    fn judge(&mut self, at: BeltPosition) {
        for (slot, track) in self.tracks.iter_mut().enumerate() {
            let travel_px = (at.travel_mm - track.first.travel_mm) / self.mm_per_px;
            match track.phase {
                Phase::Candidate => {
                    let followed_px = track.followed_px(travel_px >= 0.0);
                    let travel_px = travel_px.abs();
                    let follows = followed_px >= CONFIRM_SHARE * travel_px as f32;
                    if travel_px >= CONFIRM_TRAVEL_PX && follows && track.unseen_px == 0.0 {
                        track.phase = Phase::Riding;
                    } else if travel_px > GIVE_UP_TRAVEL_PX || track.unseen_px > CONFIRM_TRAVEL_PX {
                        track.phase = Phase::Free;
                    }
                }
                Phase::Riding | Phase::Left if track.unseen_px > UNSEEN_TRAVEL_PX => {
                    if track.phase == Phase::Riding {
                        let _ = self.changes.push((slot, Change::Lost));
                    }
                    track.phase = Phase::Free;
                }
                Phase::Free | Phase::Riding | Phase::Left => {}
            }
        }
    }

    /// The track table; a track's slot is its index.
    pub fn tracks(&self) -> &[Track] {
        &self.tracks
    }

    /// The track of each blob label, or [`NOBODY`].
    pub fn owners(&self) -> &[u16] {
        &self.owners
    }

    /// What happened in the last step.
    pub fn changes(&self) -> &[(usize, Change)] {
        &self.changes
    }

    /// Follow nothing any more.
    pub fn forget(&mut self) {
        self.tracks.fill(FREE);
        self.changes.clear();
    }

    /// A riding parcel was reported.
    pub fn set_left(&mut self, slot: usize) {
        self.tracks[slot].phase = Phase::Left;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRACKS: usize = 3;
    /// Belt travel a frame; a pixel is a millimetre.
    const STEP_MM: f64 = 10.0;

    struct Belt {
        tracker: Tracker,
        at: BeltPosition,
    }

    impl Belt {
        fn new() -> Self {
            let mut plan = Plan::default();
            Tracker::plan(TRACKS, 16, &mut plan);
            let mut memory = plan.reserve(1).expect("small");
            let tracker = Tracker::new(1.0, 1.2, 400, &mut memory).expect("planned");
            Self { tracker, at: BeltPosition::default() }
        }

        /// One frame with boxes (u0, u1, v0, v1).
        fn frame(&mut self, step_mm: f64, boxes: &[[f32; 4]]) {
            self.at.advance(step_mm, true);
            let blobs: Vec<Blob> = boxes
                .iter()
                .enumerate()
                .map(|(label, &[u0, u1, v0, v1])| Blob {
                    label: label as u32,
                    bounds: PxBox { u0, u1, v0, v1 },
                    area_px: PxBox { u0, u1, v0, v1 }.area() as u32,
                    bright_px: PxBox { u0, u1, v0, v1 }.area() as u32,
                    ..Blob::default()
                })
                .collect();
            self.tracker.step(&blobs, step_mm, self.at, &|_, _| None);
        }

        fn phases(&self) -> [Phase; TRACKS] {
            std::array::from_fn(|s| self.tracker.tracks()[s].phase)
        }
    }

    fn at(u: f32, v: f32) -> [f32; 4] {
        [u, u + 60.0, v, v + 40.0]
    }

    #[test]
    fn what_rides_on_the_belt_becomes_a_parcel() {
        let mut belt = Belt::new();
        for i in 0..5u8 {
            belt.frame(STEP_MM, &[at(f32::from(i) * 10.0, 0.0)]);
        }
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Free, Phase::Free]);
    }

    #[test]
    fn what_stands_still_on_a_moving_belt_never_does() {
        let mut belt = Belt::new();
        for _ in 0..100 {
            belt.frame(STEP_MM, &[at(50.0, 0.0)]);
            assert!(belt.tracker.tracks().iter().all(|t| !t.is_parcel()));
        }
    }

    #[test]
    fn a_belt_stop_changes_nothing() {
        let mut belt = Belt::new();
        for i in 0..5u8 {
            belt.frame(STEP_MM, &[at(f32::from(i) * 10.0, 0.0)]);
        }
        for _ in 0..1000 {
            belt.frame(0.0, &[at(40.0, 0.0)]);
        }
        belt.frame(STEP_MM, &[at(50.0, 0.0)]);
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Free, Phase::Free]);
        assert!(belt.tracker.changes().is_empty());
    }

    #[test]
    fn a_parcel_unseen_for_a_moment_is_carried_on_and_found_again() {
        let mut belt = Belt::new();
        for i in 0..5u8 {
            belt.frame(STEP_MM, &[at(f32::from(i) * 10.0, 0.0)]);
        }
        for _ in 0..5 {
            belt.frame(STEP_MM, &[]);
        }
        belt.frame(STEP_MM, &[at(100.0, 0.0)]);
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Free, Phase::Free]);
        assert_eq!(belt.tracker.owners()[0], 0);
    }

    #[test]
    fn a_parcel_that_vanishes_is_lost_once() {
        let mut belt = Belt::new();
        for i in 0..5u8 {
            belt.frame(STEP_MM, &[at(f32::from(i) * 10.0, 0.0)]);
        }
        let mut lost = 0;
        for _ in 0..30 {
            belt.frame(STEP_MM, &[]);
            lost += belt.tracker.changes().iter().filter(|c| c.1 == Change::Lost).count();
        }
        assert_eq!((lost, belt.phases()), (1, [Phase::Free; TRACKS]));
    }

    #[test]
    fn two_parcels_whose_images_run_together_stay_two() {
        let mut belt = Belt::new();
        for i in 0..10u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[at(u, 0.0), at(u, 60.0)]);
        }
        for i in 10..14u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[[u, u + 60.0, 0.0, 100.0]]);
        }
        belt.frame(STEP_MM, &[at(140.0, 0.0), at(140.0, 60.0)]);
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Riding, Phase::Free]);
        assert!(belt.tracker.tracks()[..2].iter().any(Track::was_merged));
    }

    #[test]
    fn one_that_turns_out_to_be_two_becomes_two_and_is_measured_anew() {
        let mut belt = Belt::new();
        for i in 0..10u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[[u, u + 60.0, 0.0, 86.0]]);
        }
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Free, Phase::Free]);
        let mut began = 0;
        for i in 10..16u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[at(u, 0.0), at(u, 46.0)]);
            began += belt.tracker.changes().iter().filter(|c| c.1 == Change::Began).count();
        }
        assert_eq!((began, belt.phases()), (2, [Phase::Riding, Phase::Riding, Phase::Free]));
    }

    #[test]
    fn a_moment_apart_or_a_small_piece_splits_nothing() {
        let mut belt = Belt::new();
        for i in 0..30u8 {
            let u = f32::from(i) * 10.0;
            match i {
                20 => belt.frame(STEP_MM, &[at(u, 0.0), at(u, 46.0)]),
                21..30 => belt
                    .frame(STEP_MM, &[[u, u + 60.0, 0.0, 80.0], [u + 40.0, u + 46.0, 80.0, 86.0]]),
                _ => belt.frame(STEP_MM, &[[u, u + 60.0, 0.0, 86.0]]),
            }
        }
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Free, Phase::Free]);
    }

    #[test]
    fn a_piece_of_a_parcel_rejoins_it() {
        let mut belt = Belt::new();
        for i in 0..12u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[at(u, 0.0), [u + 62.0, u + 70.0, 0.0, 40.0]]);
        }
        assert_eq!(belt.phases(), [Phase::Riding, Phase::Riding, Phase::Free]);
        for i in 12..30u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[[u, u + 70.0, 0.0, 40.0]]);
        }
        assert_eq!(belt.phases().iter().filter(|p| **p == Phase::Riding).count(), 1);
    }

    #[test]
    fn a_ghost_touched_by_a_parcel_is_left_behind() {
        let mut belt = Belt::new();
        // Wider than a frame's travel: else it is out of the box at once.
        let ghost = [100.0, 130.0, 10.0, 15.0];
        for i in 0..30u8 {
            let parcel = at(f32::from(i) * 10.0, 0.0);
            // It comes to light while the parcel is over it.
            belt.frame(STEP_MM, &[parcel, ghost][..if i < 10 { 1 } else { 2 }]);
        }
        let riding: Vec<&Track> =
            belt.tracker.tracks().iter().filter(|t| t.phase == Phase::Riding).collect();
        assert_eq!(riding.len(), 1);
        assert!(riding[0].bounds.u0 > 280.0, "{:?}", riding[0].bounds);
    }

    #[test]
    fn a_full_table_is_counted() {
        let mut belt = Belt::new();
        for i in 0..5u8 {
            let u = f32::from(i) * 10.0;
            belt.frame(STEP_MM, &[at(u, 0.0), at(u, 100.0), at(u, 200.0), at(u, 300.0)]);
        }
        assert_eq!(belt.phases(), [Phase::Riding; TRACKS]);
        assert_eq!(belt.tracker.overflows, 5);
    }
}
