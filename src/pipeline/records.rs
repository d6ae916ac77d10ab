//! The record of a parcel that leaves: its cuboid, and what makes it doubtful.

use super::{Pipeline, Reference};
use crate::event::{Flags, NotMeasured, ParcelRecord, Shape};
use crate::image::FrameTime;
use crate::stage::measure::{self, Measured};

/// Above this relative sigma the belt speed counts as assumed.
const SPEED_SIGMA_MAX: f64 = 0.01;

impl Pipeline {
    /// Where a parcel is that could not be measured.
    pub(super) fn record_without_size(
        &self,
        slot: usize,
        flags: Flags,
        reason: NotMeasured,
    ) -> ParcelRecord {
        let position = self.image_on_belt(slot);
        let now = self.last.unwrap_or(FrameTime { index: 0, t_s: 0.0 });
        ParcelRecord {
            seq: self.counters.parcels as u32,
            frame: now.index,
            t_s: now.t_s,
            length_mm: 0.0,
            width_mm: 0.0,
            height_mm: 0.0,
            yaw_deg: 0.0,
            x_mm: position.x,
            y_mm: position.y,
            sigma_length_mm: 0.0,
            sigma_width_mm: 0.0,
            sigma_height_mm: 0.0,
            belt_speed_mm_per_s: self.belt_motion().0,
            shape: Shape::Irregular,
            flags,
            not_measured: Some(reason),
            may_be_used: false,
            belt_travel_mm: self.at.travel_mm,
            by_encoder: self.by_encoder(),
        }
    }

    pub(super) fn record(
        &self,
        slot: usize,
        measured: &Measured,
        reference: Reference,
        flags: Flags,
    ) -> ParcelRecord {
        let track = &self.tracker.tracks()[slot];
        let (p, s) = (&measured.estimate.params, &measured.estimate.sigma);
        let travel_sigma = self.at.sigma_since(&track.first);
        let elapsed_s = self.last.map_or(0.0, |last| last.t_s - reference.began_s);
        let travel_mm = self.at.travel_mm - track.first.travel_mm;
        let shape = if measured.is_box { Shape::Box } else { Shape::Irregular };
        let mut record = ParcelRecord {
            seq: self.counters.parcels as u32,
            frame: reference.time.index,
            t_s: reference.time.t_s,
            length_mm: p[measure::LENGTH],
            width_mm: p[measure::WIDTH],
            height_mm: p[measure::HEIGHT],
            yaw_deg: p[measure::YAW].to_degrees(),
            x_mm: p[measure::X],
            y_mm: p[measure::Y],
            sigma_length_mm: s[measure::LENGTH],
            sigma_width_mm: s[measure::WIDTH],
            sigma_height_mm: s[measure::HEIGHT],
            belt_speed_mm_per_s: p[measure::SCALE] * travel_mm / elapsed_s.max(1e-9),
            shape,
            flags,
            not_measured: None,
            may_be_used: false,
            belt_travel_mm: reference.at.travel_mm,
            by_encoder: self.by_encoder(),
        };
        let sigma_max_mm = self.site.config.measure.sigma_max_mm;
        record.flags.set(Flags::MERGED, track.was_merged());
        record.flags.set(Flags::CLIPPED, self.reaches_out(p));
        record.flags.set(Flags::HEIGHT_UNCERTAIN, record.sigma_height_mm > sigma_max_mm);
        let footprint_sigma_mm = record.sigma_length_mm.max(record.sigma_width_mm);
        record.flags.set(Flags::FOOTPRINT_UNCERTAIN, footprint_sigma_mm > sigma_max_mm);
        record.flags.set(Flags::SPEED_ASSUMED, travel_sigma > SPEED_SIGMA_MAX);
        record.flags.set(Flags::TOO_TALL, record.height_mm > self.site.height_max_mm);
        record.flags.set(Flags::SILHOUETTE_ONLY, !measured.has_edges);
        record.flags.set(Flags::HEIGHT_DISPUTED, measured.disputed);
        // A standard deviation above the limit is a flag too.
        record.may_be_used = record.flags.is_empty();
        record
    }

    /// Whether a cuboid reaches over the side of the zone, where nothing of it is used.
    fn reaches_out(&self, params: &measure::Params) -> bool {
        let outline = measure::Outline::new(&self.site.view, params, 0.0);
        let zone = &self.zone;
        outline.base.iter().any(|v| !(zone.y_min_mm..=zone.y_max_mm).contains(&v.over_belt.y))
    }
}
