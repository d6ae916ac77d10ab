//! The belt views of the last passes: what the evidence and the fit look back at.
//!
//! In: the belt view of each frame, with the belt's position. Out: views about evenly spaced over the
//! belt's travel, newest first. Owns: the pictures. Limits: [`VIEWS_MAX`] views, the oldest make
//! room.

use crate::belt::BeltPosition;
use crate::camera::BeltView;
use crate::error::Result;
use crate::image::{FrameTime, Plane};
use crate::kernel::scalar::bits::stride;
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltRect;

/// Views that a pass over the zone gives: more repeat what is known.
const VIEWS_PER_ZONE: usize = 40;
/// Views kept, over a zone of travel and a quarter: of a parcel up to that quarter long those that show any of it.
pub const VIEWS_MAX: usize = VIEWS_PER_ZONE + VIEWS_PER_ZONE / 4;

/// Measured travel after which what was only assumed before is set right, share of the zone: 0.05 % of
/// the speed, by steps that are good to 0.05 mm.
const REVISE_SHARE: f64 = 0.1;
/// The belt's speed over the one assumed, so that it is believed to have run so before.
const RATIO_REVISED: std::ops::RangeInclusive<f64> = 0.8..=1.25;
/// A stretch between two views was measured when this share of it was.
const MEASURED_SHARE: f64 = 0.5;

/// Where the belt was in a view.
#[derive(Clone, Copy, Debug, Default)]
pub struct Kept {
    /// The belt's position.
    pub at: BeltPosition,
    /// When it was taken.
    pub time: FrameTime,
}

/// The stage.
pub struct Views {
    size_px: [usize; 2],
    step_mm: f64,
    grey: Block<u8>,
    kept: Block<Kept>,
    /// Views ever kept; the newest is in place `(taken - 1) % VIEWS_MAX`.
    taken: usize,
    /// Views since the last break of the belt's position.
    whole: usize,
}

impl Views {
    /// Memory for a view's size.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let [width, height] = view.size_px;
        plan.add::<u8>(
            "views.grey",
            stride(width) * height * VIEWS_MAX,
            "belt views over a zone of travel and a quarter",
        );
        plan.add::<Kept>("views.kept", VIEWS_MAX, "the belt's position in each");
    }

    /// None yet.
    pub fn new(view: &BeltView, zone: &BeltRect, memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            size_px: view.size_px,
            step_mm: zone.length_mm() / VIEWS_PER_ZONE as f64,
            grey: memory.take("views.grey", 0)?,
            kept: memory.take("views.kept", Kept::default())?,
            taken: 0,
            whole: 0,
        })
    }

    /// Keep a view when the belt has moved on far enough. Returns whether it was kept.
    pub fn offer(&mut self, grey: &[u8], at: BeltPosition, time: FrameTime) -> bool {
        let last = self.newest().map(|i| self.kept[i].at);
        if last.is_some_and(|last| last.breaks != at.breaks) {
            self.whole = 0;
        }
        let moved_mm = last.filter(|_| self.whole > 0).map(|last| at.travel_mm - last.travel_mm);
        // Frames come at any distance: half a frame too early is as good as half a frame too late.
        if moved_mm.is_some_and(|mm| mm < 0.99 * self.step_mm) {
            return false;
        }
        let place = self.taken % VIEWS_MAX;
        let bytes = grey.len();
        self.grey[place * bytes..][..bytes].copy_from_slice(grey);
        self.kept[place] = Kept { at, time };
        self.taken += 1;
        self.whole = (self.whole + 1).min(VIEWS_MAX);
        self.revise();
        true
    }

    /// Set the travel right that was assumed before the belt's motion was first measured: it ran as fast as
    /// it runs now. The newest view keeps its position.
    fn revise(&mut self) {
        let stretches = || self.places().zip(self.places().skip(1));
        let is_measured = |&(newer, older): &(usize, usize)| {
            let [newer, older] = [newer, older].map(|place| self.kept[place].at);
            let travel_mm = newer.travel_mm - older.travel_mm;
            newer.measured_mm - older.measured_mm > MEASURED_SHARE * travel_mm
        };
        let Some((newest, _)) = stretches().next() else { return };
        let Some((first, _)) = stretches().find(|s| !is_measured(s)) else { return };
        if stretches().skip_while(is_measured).any(|s| is_measured(&s)) {
            return;
        }
        let [newest, first] = [newest, first].map(|place| self.kept[place]);
        let travel_mm = newest.at.travel_mm - first.at.travel_mm;
        if travel_mm < REVISE_SHARE * VIEWS_PER_ZONE as f64 * self.step_mm {
            return;
        }
        let speed_mm_per_s = travel_mm / (newest.time.t_s - first.time.t_s);
        let Some(oldest) = self.places().last().map(|place| self.kept[place]) else { return };
        let assumed_mm = first.at.travel_mm - oldest.at.travel_mm;
        let ratio = speed_mm_per_s * (first.time.t_s - oldest.time.t_s) / assumed_mm;
        // Beyond that, or without times, it did not run as it does now.
        if !RATIO_REVISED.contains(&ratio) {
            return;
        }
        let measured = stretches().take_while(is_measured).count();
        for place in self.places().skip(measured + 1) {
            let kept = &mut self.kept[place];
            let back_mm = speed_mm_per_s * (first.time.t_s - kept.time.t_s);
            kept.at.travel_mm = first.at.travel_mm - back_mm;
            kept.at.measured_mm = first.at.measured_mm - back_mm;
        }
    }

    /// Place of the newest view.
    pub fn newest(&self) -> Option<usize> {
        (self.whole > 0).then(|| (self.taken - 1) % VIEWS_MAX)
    }

    /// Places of all views, newest first.
    pub fn places(&self) -> impl Iterator<Item = usize> + Clone + use<> {
        let taken = self.taken;
        (1..=self.whole).map(move |back| (taken - back) % VIEWS_MAX)
    }

    /// Where the belt was in the view at a place.
    pub fn kept(&self, place: usize) -> Kept {
        self.kept[place]
    }

    /// The picture at a place.
    pub fn grey(&self, place: usize) -> Plane<'_> {
        let [width, height] = self.size_px;
        let bytes = stride(width) * height;
        Plane::new(&self.grey[place * bytes..][..bytes], width, height, stride(width))
            .unwrap_or_else(|| unreachable!("planned so"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::BeltMm;
    use nalgebra::Vector2;

    #[test]
    fn travel_assumed_before_the_belt_was_measured_is_set_right_and_a_gap_later_is_left() {
        let view = BeltView {
            camera_height_mm: 1500.0,
            nadir: Vector2::zeros(),
            origin: BeltMm { x: -600.0, y: 400.0 },
            mm_per_px: 50.0,
            size_px: [24, 16],
        };
        let zone =
            BeltRect { x_min_mm: -600.0, x_max_mm: 600.0, y_min_mm: -400.0, y_max_mm: 400.0 };
        let mut plan = Plan::default();
        Views::plan(&view, &mut plan);
        let mut memory = plan.reserve(1).expect("fits");
        let mut views = Views::new(&view, &zone, &mut memory).expect("planned");
        let grey = vec![0; stride(24) * 16];
        let (mut at, speed_mm_per_s) = (BeltPosition::default(), 500.0);
        let mut true_mm = 0.0;
        for index in 0..44 {
            // A nominal speed 2 % too high until the belt is measured, and once later.
            let measured = index > 15 && index != 35;
            if index > 0 {
                true_mm += 30.0;
                at.advance(if measured { 30.0 } else { 30.6 }, measured);
            }
            let time = FrameTime { index, t_s: true_mm / speed_mm_per_s };
            views.offer(&grey, at, time);
            let kept: Vec<Kept> = views.places().map(|place| views.kept(place)).collect();
            let (newest, oldest) = (kept[0], kept[kept.len() - 1]);
            let shown_mm = newest.at.travel_mm - oldest.at.travel_mm;
            let since_mm = speed_mm_per_s * (newest.time.t_s - oldest.time.t_s);
            let assumed_mm = match index {
                0..=18 => index.min(15) as f64 * 0.6,
                19..=34 => 0.0,
                _ => 0.6,
            };
            assert!((shown_mm - since_mm - assumed_mm).abs() < 1e-6, "{index}: {shown_mm}");
        }
    }
}
