//! What a track's silhouettes showed once its pass is over.

use super::Pipeline;
use super::leaving::{Silhouette, place_of};
use crate::event::{Flags, NotMeasured};
use crate::stage::measure::{self, Measured};
use crate::stage::parcels::Rectangle;
use crate::units::{BeltMm, BeltPx};

/// What rode this share of the zone with the belt is no hand, and no piece: those vanish sooner.
const RODE_SHARE: f64 = 0.5;
/// What is narrower than this many px cannot be told from a sliver of shadow.
const SIDE_MIN_PX: f64 = 4.0;
impl Pipeline {
    /// Why a track was not measured, if it was not.
    pub(super) fn reason(&self, slot: usize, flags: Flags) -> NotMeasured {
        let track = &self.tracker.tracks()[slot];
        if self.at.breaks != track.first.breaks {
            NotMeasured::BeltMotionUnknown
        } else if flags.has(Flags::LOST) {
            NotMeasured::Lost
        } else if track.was_merged() {
            NotMeasured::NeverAlone
        } else {
            NotMeasured::TooBrief
        }
    }

    /// What a track's silhouettes showed, with this reason if that is no size.
    pub(super) fn tell(&mut self, slot: usize, flags: Flags, reason: NotMeasured) {
        if self.passed_beside(slot) {
            return;
        }
        let reference = self.references[slot];
        let had_shape = self.measure.outline(slot, self.at).is_some();
        let measured = self.measure.finish(slot, reference.at);
        // A sliver of shadow or light is smaller than the smallest blob that counts.
        let is_sliver = |m: &Measured| {
            let p = &m.estimate.params;
            !self.counts([p[measure::LENGTH], p[measure::WIDTH]])
        };
        if measured.as_ref().is_some_and(is_sliver) {
            self.counters.slivers += 1;
            return;
        }
        // A pass that was cut short counts only if edges were found.
        let measured = measured.filter(|m| m.has_edges || flags == Flags::default());
        // What vanished, or was cut short, before it had a shape was a hand, or a piece that joined its parcel, unless
        // it has ridden through most of the zone, as large as a parcel: a sorter must know of it.
        let cut_short = reason == NotMeasured::Lost || flags.has(Flags::UNFINISHED);
        let vanished = measured.is_none() && cut_short && !had_shape;
        if vanished && !self.rode(slot) {
            return;
        }
        let edge_share = measured.map_or(0.0, |measured| measured.estimate.edge_share);
        let (record, place) = match measured {
            Some(measured) => (
                self.record_of_track(slot, &measured, reference, flags),
                place_of(&measured.estimate.params, reference.at.travel_mm),
            ),
            None => (self.record_without_size(slot, flags, reason), self.place_of_image(slot)),
        };
        let is_certain = record.not_measured.is_none()
            && record.flags.is_empty()
            && !self.passes.contradict(&place, record.height_mm);
        let silhouette = Silhouette { record, place, is_certain, edge_share };
        self.leaving.add_silhouette(silhouette);
    }

    /// Whether something of these sides is as large as the smallest parcel.
    pub(super) fn counts(&self, [length_mm, width_mm]: [f64; 2]) -> bool {
        let segment = &self.site.config.segment;
        let side_min_mm = segment.side_min_mm.unwrap_or(SIDE_MIN_PX * self.site.view.mm_per_px);
        length_mm * width_mm >= segment.area_min_mm2 && length_mm.min(width_mm) >= side_min_mm
    }

    /// Whether a track's image, as large as the smallest parcel, has ridden through most of the zone.
    fn rode(&self, slot: usize) -> bool {
        let track = &self.tracker.tracks()[slot];
        let sides_px = [track.bounds.u1 - track.bounds.u0, track.bounds.v1 - track.bounds.v0];
        let here_mm = self.image_on_belt(slot).x;
        let first_mm = here_mm - (self.at.travel_mm - track.first.travel_mm);
        let from_mm = here_mm.min(first_mm).max(self.zone.x_min_mm);
        let to_mm = here_mm.max(first_mm).min(self.zone.x_max_mm);
        self.counts(sides_px.map(|px| f64::from(px) * self.site.view.mm_per_px))
            && to_mm - from_mm > RODE_SHARE * self.zone.length_mm()
    }

    /// Where the middle of a track's image lies on the belt.
    pub(super) fn image_on_belt(&self, slot: usize) -> BeltMm {
        let b = &self.tracker.tracks()[slot].bounds;
        let middle = BeltPx { u: f64::from(b.u0 + b.u1) / 2.0, v: f64::from(b.v0 + b.v1) / 2.0 };
        self.site.view.belt_point(middle)
    }

    /// The rectangle around a track's image on the belt.
    pub(super) fn place_of_image(&self, slot: usize) -> Rectangle {
        let b = &self.tracker.tracks()[slot].bounds;
        let middle = self.image_on_belt(slot);
        let mm = |px: f32| f64::from(px) * self.site.view.mm_per_px;
        Rectangle {
            x_mm: middle.x - self.at.travel_mm,
            y_mm: middle.y,
            length_mm: mm(b.u1 - b.u0),
            width_mm: mm(b.v1 - b.v0),
            ..Rectangle::default()
        }
    }

    /// Whether nothing of a parcel was in the zone.
    fn passed_beside(&self, slot: usize) -> bool {
        let beside = |y_mm: &[f64]| {
            y_mm.iter().all(|&y| y < self.zone.y_min_mm)
                || y_mm.iter().all(|&y| y > self.zone.y_max_mm)
        };
        match self.measure.outline(slot, self.at) {
            Some(outline) => beside(&outline.base.map(|v| v.over_belt.y)),
            None => beside(&[self.image_on_belt(slot).y]),
        }
    }
}
