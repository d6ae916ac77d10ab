//! Parcels before and after a gap in the frames: whether they are the same.

use super::state::FREE;
use super::{OVERLAP_MIN, Phase, Track, Tracker};
use crate::belt::BeltPosition;
use crate::stage::segment::{Blob, PxBox};
use std::ops::RangeInclusive;

/// The belt carries along rows: the ends of a silhouette across them stay where they are but for
/// noise and a little of its shadow.
const SAME_PX: f32 = 4.0;
/// The length of a silhouette changes on its way through the view, as one sees more or less of its
/// ends: by less than this share.
const SAME_LENGTH: f32 = 0.3;

/// What is seen of the parcels that should be in view after a gap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seen {
    /// There are none that should be.
    None,
    /// Each is there.
    There,
    /// Some are.
    Some,
    /// None is.
    Missing,
}

impl Tracker {
    /// Whether the parcels in view before are where a belt that has moved by `step_mm` shows them.
    pub fn where_expected(&self, blobs: &[Blob], step_mm: f64) -> Seen {
        let step_px = (step_mm / self.mm_per_px) as f32;
        let most_px = step_px * self.magnification_max as f32;
        let end_px = self.width_px as f32;
        let (mut there, mut missing) = (0, 0);
        for track in self.tracks.iter().filter(|track| track.is_parcel()) {
            let expected = track.bounds.swept(step_px, most_px);
            // What may be cut off by the picture's border or be out of it proves nothing.
            if expected.u0 < 0.0 || expected.u1 >= end_px || !expected.u1.is_finite() {
                continue;
            }
            let is_it = |blob: &Blob| {
                let smaller = expected.area().min(blob.bounds.area());
                let stands = step_px != 0.0
                    || (blob.bounds.u0 - expected.u0).abs() < SAME_PX
                        && (blob.bounds.u1 - expected.u1).abs() < SAME_PX;
                stands
                    && is_as_wide(track, &blob.bounds)
                    && expected.overlap(&blob.bounds) > OVERLAP_MIN * smaller
            };
            if blobs.iter().any(is_it) { there += 1 } else { missing += 1 }
        }
        match (there, missing) {
            (0, 0) => Seen::None,
            (_, 0) => Seen::There,
            (0, _) => Seen::Missing,
            _ => Seen::Some,
        }
    }

    /// The box of what may be a track's parcel after it was carried on by a travel in
    /// this range, and is no other track's already.
    pub fn again(
        &self,
        slot: usize,
        blobs: &[Blob],
        travel_mm: RangeInclusive<f64>,
    ) -> Option<PxBox> {
        let track = &self.tracks[slot];
        if !track.is_parcel() {
            return None;
        }
        let least_px = (travel_mm.start() / self.mm_per_px) as f32 - SAME_PX;
        let most_px = (travel_mm.end() / self.mm_per_px * self.magnification_max) as f32 + SAME_PX;
        let length = |b: &PxBox| b.u1 - b.u0;
        let taken = |b: &PxBox| self.tracks[..slot].iter().any(|t| t.is_parcel() && t.bounds == *b);
        let may_be = |b: &&PxBox| {
            (least_px..=most_px).contains(&(b.u0 - track.bounds.u0))
                && is_as_wide(track, b)
                && (length(b) - length(&track.bounds)).abs() < SAME_LENGTH * length(&track.bounds)
                && !taken(b)
        };
        blobs.iter().map(|blob| &blob.bounds).find(may_be).copied()
    }

    /// A parcel from before the gap begins anew at this place.
    pub fn restart(&mut self, slot: usize, bounds: PxBox, at: BeltPosition) {
        let phase = self.tracks[slot].phase;
        self.tracks[slot] = Track { phase, bounds, first: at, first_bounds: bounds, ..FREE };
    }

    /// Follow a track no more.
    pub fn drop_track(&mut self, slot: usize) {
        self.tracks[slot].phase = Phase::Free;
    }
}

fn is_as_wide(track: &Track, bounds: &PxBox) -> bool {
    (track.bounds.v0 - bounds.v0).abs() < SAME_PX && (track.bounds.v1 - bounds.v1).abs() < SAME_PX
}
