//! What becomes of the parcels in view over a gap: frames missing for longer than the view can bridge
//! at the belt's speed, or time stamps that cannot be.
//!
//! A sorter needs each parcel once. So the travel over the gap is looked for, best witness first: the
//! encoder; the belt's texture, before and after; parcels that are where they were, or where the last
//! speed has carried them. With any of these parcels are followed on, or told as having left. Without,
//! what was in view is told as lost, and what is in view is new; but what the belt's texture does not
//! show to be new, and looks like a parcel from before, is that parcel, and is told once, when it leaves.

use super::{Pipeline, Reference};
use crate::event::{Flags, NotMeasured};
use crate::image::FrameTime;
use crate::stage::odometry::{Across, Motion};
use crate::stage::track::{Phase, Seen};

impl Pipeline {
    /// The belt's step over a gap of `dt_s`, which may be anything.
    pub(super) fn bridge(&mut self, by_encoder: Option<f64>, time: FrameTime, dt_s: f64) -> Motion {
        let grey = self.rectify.pixels();
        let seen = self.odometry.across(grey, &self.background, &self.covered, dt_s);
        self.riders.forget();
        let trusted = self.witnesses.over_gap(by_encoder, dt_s);
        let motion = trusted
            .map(|step_mm| Motion { step_mm, measured: true })
            .or_else(|| self.seen_over_gap(seen, dt_s))
            .unwrap_or_else(|| {
                self.lose_belt(seen, time, dt_s);
                Motion { step_mm: 0.0, measured: false }
            });
        self.stands_still &= motion.step_mm.abs() < self.site.view.mm_per_px;
        motion
    }

    /// What texture and silhouettes show.
    fn seen_over_gap(&self, seen: Across, dt_s: f64) -> Option<Motion> {
        let parcels = |step_mm: f64| self.tracker.where_expected(self.segment.blobs(), step_mm);
        match seen {
            // A belt that has come round shows the same texture, and other parcels.
            Across::Travel(step_mm) => {
                (parcels(step_mm) != Seen::Missing).then_some(Motion { step_mm, measured: true })
            }
            Across::Beyond(_) => None,
            Across::Unknown => {
                let assumed_mm = self.odometry.speed().0 * dt_s;
                [(0.0, true), (assumed_mm, false)]
                    .into_iter()
                    .find(|(step_mm, _)| parcels(*step_mm) == Seen::There)
                    .map(|(step_mm, measured)| Motion { step_mm, measured })
            }
        }
    }

    /// Nothing is known of the travel.
    fn lose_belt(&mut self, seen: Across, time: FrameTime, dt_s: f64) {
        let before = self.at;
        self.at.lose();
        let travel_max_mm = self.odometry.travel_max_mm(dt_s);
        for slot in 0..self.tracker.tracks().len() {
            let travel_min_mm = match seen {
                Across::Unknown => Some(0.0),
                Across::Beyond(mm) => Some(mm),
                // Refuted: the belt has come round.
                Across::Travel(_) => None,
            };
            let again = travel_min_mm.and_then(|travel_min_mm| {
                let travel_mm = travel_min_mm..=travel_max_mm;
                self.tracker.again(slot, self.segment.blobs(), travel_mm)
            });
            match (self.tracker.tracks()[slot].phase, again) {
                (Phase::Riding | Phase::Left, Some(bounds)) => {
                    self.tracker.restart(slot, bounds, self.at);
                    self.measure.begin(slot, self.at);
                    self.references[slot] =
                        Reference { began_s: time.t_s, time, at: self.at, fixed: false };
                }
                (Phase::Riding, None) => {
                    let at = std::mem::replace(&mut self.at, before);
                    self.tell(slot, Flags::LOST, NotMeasured::BeltMotionUnknown);
                    self.at = at;
                    self.tracker.drop_track(slot);
                }
                _ => self.tracker.drop_track(slot),
            }
        }
    }

    /// Before the belt is learned there are no parcels to lose.
    pub(super) fn lose_unlearned_belt(&mut self) {
        self.odometry.forget();
        self.at.lose();
    }

    /// Tell what the gap has carried out of the zone, before it is looked for in the picture.
    pub(super) fn depart(&mut self, step_mm: f64) {
        for slot in 0..self.tracker.tracks().len() {
            let rides = self.tracker.tracks()[slot].phase == Phase::Riding;
            if rides && self.trailing_x_mm(slot, step_mm) > self.zone.x_max_mm {
                self.leave(slot, Flags::default());
            }
        }
    }
}
