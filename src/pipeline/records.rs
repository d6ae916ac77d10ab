//! The record of a parcel that leaves: its cuboid, and what makes it doubtful.

use super::{Pipeline, Reference};
use crate::config::Site;
use crate::event::{Flags, NotMeasured, ParcelRecord, Shape};
use crate::image::FrameTime;
use crate::stage::measure::{self, Measured, canonical_estimate};
use crate::stage::passes::Passed;
use crate::stage::views::Kept;

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
            seq: 0,
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

    /// What the silhouettes of a track showed.
    pub(super) fn record_of_track(
        &self,
        slot: usize,
        measured: &Measured,
        reference: Reference,
        flags: Flags,
    ) -> ParcelRecord {
        let track = &self.tracker.tracks()[slot];
        let elapsed_s = self.last.map_or(0.0, |last| last.t_s - reference.began_s);
        let travel_mm = self.at.travel_mm - track.first.travel_mm;
        let scale = measured.estimate.params[measure::SCALE];
        let mut record = ParcelRecord {
            belt_speed_mm_per_s: scale * travel_mm / elapsed_s.max(1e-9),
            flags,
            ..self.record(measured, Kept { at: reference.at, time: reference.time })
        };
        record.flags.set(doubts(&self.site, measured, self.at.sigma_since(&track.first)), true);
        record.flags.set(Flags::MERGED, track.was_merged());
        record
    }

    /// What the heights of a pass showed.
    pub(super) fn record_of_pass(&self, passed: &Passed) -> ParcelRecord {
        let mut measured = passed.measured;
        measured.estimate = canonical_estimate(measured.estimate);
        let mut record = ParcelRecord {
            belt_speed_mm_per_s: passed.speed_mm_per_s(),
            flags: doubts(&self.site, &measured, passed.travel_sigma()),
            ..self.record(&measured, passed.reference)
        };
        record.flags.set(Flags::UNFINISHED, !passed.left);
        record
    }

    /// A cuboid where it was in a view, without a doubt, a number and the belt's speed.
    fn record(&self, measured: &Measured, reference: Kept) -> ParcelRecord {
        let (p, s) = (&measured.estimate.params, &measured.estimate.sigma);
        ParcelRecord {
            seq: 0,
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
            belt_speed_mm_per_s: 0.0,
            shape: if measured.is_box { Shape::Box } else { Shape::Irregular },
            flags: Flags::default(),
            not_measured: None,
            may_be_used: false,
            belt_travel_mm: reference.at.travel_mm,
            by_encoder: self.by_encoder(),
        }
    }
}

/// What casts doubt on a cuboid. `travel_sigma`: relative, of the belt's travel over its pass.
fn doubts(site: &Site, measured: &Measured, travel_sigma: f64) -> Flags {
    let (p, s) = (&measured.estimate.params, &measured.estimate.sigma);
    let sigma_max_mm = site.config.measure.sigma_max_mm;
    let footprint_sigma_mm = s[measure::LENGTH].max(s[measure::WIDTH]);
    let mut flags = Flags::default();
    flags.set(Flags::CLIPPED, reaches_out(site, p));
    flags.set(Flags::HEIGHT_UNCERTAIN, s[measure::HEIGHT] > sigma_max_mm);
    flags.set(Flags::FOOTPRINT_UNCERTAIN, footprint_sigma_mm > sigma_max_mm);
    flags.set(Flags::SPEED_ASSUMED, travel_sigma > SPEED_SIGMA_MAX);
    flags.set(Flags::TOO_TALL, p[measure::HEIGHT] > site.height_max_mm);
    flags.set(Flags::SILHOUETTE_ONLY, !measured.has_edges);
    flags.set(Flags::HEIGHT_DISPUTED, measured.disputed);
    flags
}

/// Whether a cuboid reaches over the side of the zone, where nothing of it is used.
fn reaches_out(site: &Site, params: &measure::Params) -> bool {
    let outline = measure::Outline::new(&site.view, params, 0.0);
    let zone = &site.config.zone;
    outline.base.iter().any(|v| !(zone.y_min_mm..=zone.y_max_mm).contains(&v.over_belt.y))
}
