//! What is in view in the last frame, for pictures that people look at.

use super::Pipeline;
use crate::camera::BeltView;
use crate::stage::track::Phase;
use crate::units::{BeltMm, BeltPx};

/// A parcel in view.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// Its place in the table of tracks.
    pub slot: usize,
    /// It is on its way through the zone; else it is not yet known to ride, or was already told.
    pub riding: bool,
    /// It was told and is on its way out of view.
    pub told: bool,
    /// First and last pixel of its image in the view.
    pub bounds: [BeltPx; 2],
    /// Where the view shows the corners of its cuboid as it is estimated so far, on the belt plane:
    /// four of the base, then the four above them.
    pub cuboid: Option<[BeltMm; 8]>,
}

impl Sight {
    /// Where its top is in the belt view.
    pub(super) fn top(&self, view: &BeltView) -> Option<[BeltPx; 4]> {
        let cuboid = self.cuboid?;
        Some(std::array::from_fn(|k| view.px(cuboid[4 + k])))
    }
}

impl Pipeline {
    /// The parcels in view, in the order of their slots.
    pub fn sights(&self) -> impl Iterator<Item = Sight> + '_ {
        let tracks = self.tracker.tracks().iter().enumerate();
        tracks.filter(|(_, track)| track.phase != Phase::Free).map(|(slot, track)| {
            let b = &track.bounds;
            let px = |u: f32, v: f32| BeltPx { u: f64::from(u), v: f64::from(v) };
            let outline = self.measure.outline(slot, self.at);
            Sight {
                slot,
                riding: track.phase == Phase::Riding,
                told: track.phase == Phase::Left,
                bounds: [px(b.u0, b.v0), px(b.u1, b.v1)],
                cuboid: outline.map(|outline| {
                    std::array::from_fn(|k| {
                        let corners = if k < 4 { &outline.base } else { &outline.top };
                        let image = corners[k % 4].image;
                        BeltMm { x: image.x, y: image.y }
                    })
                }),
            }
        })
    }

    /// The parcels whose record will hold in the last frame: they are passing the middle of the zone.
    pub fn passing_middle(&self) -> impl Iterator<Item = Sight> + '_ {
        let now = self.last.map(|last| last.index);
        self.sights().filter(move |sight| {
            let reference = &self.references[sight.slot];
            sight.riding && reference.fixed && Some(reference.time.index) == now
        })
    }
}
