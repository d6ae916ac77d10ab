//! One row of the track table.

use crate::belt::BeltPosition;
use crate::stage::segment::PxBox;

/// Fewer shared frames than this do not harm a pass.
const MERGED_FRAMES: u32 = 3;

/// Where a track is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// The slot is empty.
    Free,
    /// Seen, but not yet known to ride on the belt.
    Candidate,
    /// A parcel on its way through the zone.
    Riding,
    /// Reported; followed until it is out of view, so that it is not found again.
    Left,
}

/// One parcel candidate.
#[derive(Clone, Copy, Debug)]
pub struct Track {
    /// Life phase.
    pub phase: Phase,
    /// Box of its blobs, or the prediction while unseen.
    pub bounds: PxBox,
    /// Belt position when first seen.
    pub first: BeltPosition,
    /// Frames it has been followed.
    pub frames: u32,
    /// It shares its blob with another track in this frame.
    pub merged: bool,
    /// Frames in which it did, other than with pieces of itself.
    pub(super) merged_frames: u32,
    /// Frames on end that it has been inside a larger track's blob.
    pub(super) inside_frames: u32,
    /// Travel, px, since it was last seen.
    pub(super) unseen_px: f64,
    /// Travel, px, over which its blobs were several parcels'.
    pub(super) split_px: f64,
    pub(super) first_bounds: PxBox,
}

pub(super) const FREE: Track = Track {
    phase: Phase::Free,
    bounds: PxBox { u0: 0.0, u1: 0.0, v0: 0.0, v1: 0.0 },
    first: BeltPosition { travel_mm: 0.0, measured_mm: 0.0, coded_mm: 0.0, breaks: 0 },
    frames: 0,
    merged: false,
    merged_frames: 0,
    inside_frames: 0,
    unseen_px: 0.0,
    split_px: 0.0,
    first_bounds: PxBox { u0: 0.0, u1: 0.0, v0: 0.0, v1: 0.0 },
};

impl Track {
    /// Whether the track holds the background under it.
    pub fn is_parcel(&self) -> bool {
        matches!(self.phase, Phase::Riding | Phase::Left)
    }

    /// Whether it ran together with another parcel for long enough to matter.
    pub fn was_merged(&self) -> bool {
        self.merged_frames >= MERGED_FRAMES
    }

    /// How far the blob's ends have moved with a belt that runs this way, px: the better of both,
    /// as one end may be clipped.
    pub(super) fn followed_px(&self, forward: bool) -> f32 {
        let ends = [self.bounds.u0 - self.first_bounds.u0, self.bounds.u1 - self.first_bounds.u1];
        if forward { ends[0].max(ends[1]) } else { -ends[0].min(ends[1]) }
    }
}
