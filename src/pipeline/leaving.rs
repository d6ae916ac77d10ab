//! One record a parcel, from two witnesses.
//!
//! Silhouettes (a track) show what differs from the empty belt; heights (a pass) show what rides over the belt. Each
//! fails where the other does not: silhouettes in hard shadow, between near neighbours, on parcels as grey as the
//! belt; heights on plain parcels a few mm high. What both saw at one place is one parcel: told is what is not in
//! doubt, and where they differ by more than their sigmas, the sigma spans both. What one of them saw alone is told.
//! A silhouette that is in doubt waits until all heights at its place are known: where these show the belt it was a
//! shadow, and where they show parcels it was theirs, run together, or a piece of them.

use super::agreement::{DISAGREE_SIGMA, agreed, is_sure, rises, spread};
use super::{PIECE_MARGIN_PX, Pipeline};
use crate::event::{Flags, ParcelRecord, Shape};
use crate::stage::measure::{self, Outline, Params};
use crate::stage::parcels::Rectangle;
use crate::stage::passes::Passed;
use crate::stage::track::Phase;
use nalgebra::Vector2;

/// Parcels that leave and are not told yet, of each witness; and places that were told last.
const LEAVING_MAX: usize = 64;
/// Records of one frame.
const DECISIONS_MAX: usize = 16;
/// Cuboids that together fill this share of one are what it was taken for: a gap is narrower than a label's rest.
const PARTS_SHARE_MIN: f64 = 0.8;

/// What the silhouettes showed of a parcel that has left.
#[derive(Clone, Copy)]
pub(super) struct Silhouette {
    /// Its record, without a number.
    pub record: ParcelRecord,
    /// Its footprint, or that of its image on the belt.
    pub place: Rectangle,
    /// Measured without a doubt, and the heights at its place do not contradict.
    pub is_certain: bool,
    /// Share of its edges that were found.
    pub edge_share: f64,
}

impl Silhouette {
    /// Whether it is of several parcels.
    fn is_run_together(&self) -> bool {
        self.record.not_measured.is_some() || self.record.flags.has(Flags::MERGED)
    }
}

/// A record, and what it was decided from.
#[derive(Clone, Copy)]
pub struct Decision {
    /// As it was told.
    pub record: ParcelRecord,
    /// What the silhouettes alone showed.
    pub silhouettes: Option<ParcelRecord>,
    /// What the heights alone showed.
    pub heights: Option<(ParcelRecord, Passed)>,
}

/// A parcel that was told: its footprint and height, mm.
#[derive(Clone, Copy)]
struct Told {
    place: Rectangle,
    height_mm: f64,
    is_certain: bool,
}

/// What is leaving.
#[derive(Default)]
pub(super) struct Leaving {
    silhouettes: heapless::Vec<Silhouette, LEAVING_MAX>,
    passes: heapless::Vec<Passed, LEAVING_MAX>,
    told: heapless::Vec<Told, LEAVING_MAX>,
    pub decisions: heapless::Vec<Decision, DECISIONS_MAX>,
    breaks: u32,
    /// Parcels for which there was no room.
    pub overflows: u64,
}

impl Leaving {
    /// A track has left.
    pub fn add_silhouette(&mut self, silhouette: Silhouette) {
        self.overflows += u64::from(self.silhouettes.push(silhouette).is_err());
    }

    /// A pass is over.
    pub fn add_pass(&mut self, passed: &Passed) {
        self.overflows += u64::from(self.passes.push(*passed).is_err());
    }

    /// Nothing that was in view comes.
    pub fn forget(&mut self) {
        self.silhouettes.clear();
        self.passes.clear();
        self.told.clear();
    }

    /// Frames at which the records of what is leaving hold.
    pub fn frames(&self) -> impl Iterator<Item = u64> + '_ {
        self.silhouettes.iter().map(|silhouette| silhouette.record.frame)
    }

    fn is_told(&self, place: &Rectangle) -> bool {
        self.told.iter().any(|told| told.place.overlaps(place))
    }

    fn tell(&mut self, place: Rectangle, record: &ParcelRecord) {
        if self.told.is_full() {
            self.told.remove(0);
        }
        // There is room.
        let (height_mm, is_certain) = (record.height_mm, is_sure(record));
        let _ = self.told.push(Told { place, height_mm, is_certain });
    }

    fn has_silhouette(&self, place: &Rectangle) -> bool {
        self.silhouettes.iter().any(|s| s.place.overlaps(place))
    }

    /// The silhouette that a place is a small part of.
    fn silhouette_around(&self, place: &Rectangle) -> Option<Silhouette> {
        let mut around = self.silhouettes.iter().filter(|s| place.is_detail_of(&s.place));
        around.next().copied()
    }

    /// The silhouette that something may be a label on: one parcel's, which holds the place and is as high.
    fn labelled(
        &self,
        place: &Rectangle,
        record: &ParcelRecord,
        sigma_max_mm: f64,
    ) -> Option<usize> {
        let is_measured = record.not_measured.is_none();
        self.silhouettes.iter().position(|s| {
            let holds = place.is_detail_of(&s.place) && !self.is_filled(&s.place, place);
            is_measured
                && holds
                && !s.is_run_together()
                && is_as_high(&s.record, record, sigma_max_mm)
        })
    }

    /// Whether a part of a place, with what passed and what was told inside it, fills it: then it is that of several.
    fn is_filled(&self, place: &Rectangle, part: &Rectangle) -> bool {
        let passes = self.passes.iter().map(|passed| &passed.face.rectangle);
        let others = passes.chain(self.told.iter().map(|told| &told.place));
        let parts = others.chain([part]).filter(|part| part.is_detail_of(place));
        parts.map(|part| place.share_inside(part)).sum::<f64>() > PARTS_SHARE_MIN
    }

    /// Whether silhouettes saw a part of a place as something as high as what was seen there.
    fn has_part(&self, place: &Rectangle, record: &ParcelRecord, sigma_max_mm: f64) -> bool {
        let mut parts = self.silhouettes.iter().filter(|s| s.place.is_detail_of(place));
        let is_raised = |s: &Silhouette| is_sure(&s.record) && rises(&s.record);
        parts.any(|s| is_raised(s) && is_as_high(&s.record, record, sigma_max_mm))
    }

    /// Remove the silhouette at the place of a pass.
    fn take_silhouette(&mut self, place: &Rectangle) -> Option<Silhouette> {
        let found = self.silhouettes.iter().position(|s| s.place.is_same_place(place))?;
        Some(self.silhouettes.remove(found))
    }

    /// Whether a place is that of several cuboids with hardly a gap, as the silhouettes show them.
    fn is_parted(&mut self, place: &Rectangle) -> bool {
        let is_part = |s: &Silhouette| s.record.shape == Shape::Box && s.place.is_detail_of(place);
        let parts = self.silhouettes.iter().filter(|s| is_part(s));
        let share: f64 = parts.clone().map(|s| place.share_inside(&s.place)).sum();
        let is_parted = parts.count() > 1 && share > PARTS_SHARE_MIN;
        for part in self.silhouettes.iter_mut().filter(|s| is_parted && is_part(s)) {
            part.record.flags.set(Flags::MERGED, true);
        }
        is_parted
    }
}

impl Pipeline {
    /// Tell what has left and is known. `all`: nothing more comes of it.
    pub(super) fn decide(&mut self, all: bool, emit: &mut dyn FnMut(ParcelRecord)) {
        let broken = self.is_broken();
        let all = all || broken;
        self.leaving.decisions.clear();
        self.decide_passes(all, emit);
        self.decide_silhouettes(all, emit);
        if broken {
            self.leaving.forget();
            self.leaving.breaks = self.at.breaks;
        }
    }

    /// Whether what is leaving was there before the belt's position broke.
    fn is_broken(&self) -> bool {
        self.leaving.breaks != self.at.breaks
    }

    fn decide_passes(&mut self, all: bool, emit: &mut dyn FnMut(ParcelRecord)) {
        let mut i = 0;
        while let Some(passed) = self.leaving.passes.get(i).copied() {
            let place = passed.face.rectangle;
            if !all {
                let lies_within = |track: &Rectangle| place.is_detail_of(track);
                let is_same = self.riding_at(|track| track.is_same_place(&place));
                let is_part = |track: &Rectangle| track.is_detail_of(&place);
                if self.riding_at(lies_within).is_some()
                    || is_same.is_none() && self.riding_at(is_part).is_some()
                {
                    i += 1;
                    continue;
                }
                if let Some(slot) = is_same {
                    self.leave(slot, Flags::default());
                }
            }
            self.leaving.passes.remove(i);
            // What was still in the zone when the belt's position broke is seen again after it.
            if passed.left || !self.is_broken() || self.leaving.has_silhouette(&place) {
                self.decide_pass(&passed, &place, emit);
            }
        }
    }

    /// A track in the zone, by its cuboid.
    fn riding_at(&self, is_meant: impl Fn(&Rectangle) -> bool) -> Option<usize> {
        let tracks = self.tracker.tracks().iter().enumerate();
        let mut riding = tracks.filter(|(_, t)| t.phase == Phase::Riding && !t.was_merged());
        riding.find_map(|(slot, _)| {
            let params = self.measure.params(slot, self.at)?;
            is_meant(&place_of(&params, self.at.travel_mm)).then_some(slot)
        })
    }

    fn decide_pass(
        &mut self,
        passed: &Passed,
        place: &Rectangle,
        emit: &mut dyn FnMut(ParcelRecord),
    ) {
        if self.leaving.is_told(place) || self.leaving.is_parted(place) {
            return;
        }
        let heights = self.record_of_pass(passed);
        if !self.counts([heights.length_mm, heights.width_mm]) {
            self.counters.slivers += 1;
            return;
        }
        if self.labelled(place, &heights).is_some_and(|outer| outer.record.shape == Shape::Box) {
            return;
        }
        let silhouettes = self.leaving.take_silhouette(place);
        let around = self.leaving.silhouette_around(place);
        let record = match (&silhouettes, around) {
            (Some(silhouettes), _) => {
                let mut seen = silhouettes.record;
                // What does not rise over the belt is no witness of a parcel.
                seen.flags.set(Flags::HEIGHT_DISPUTED, is_sure(&seen) && !rises(&seen));
                let edge_shares = [silhouettes.edge_share, passed.measured.estimate.edge_share];
                agreed(&seen, &heights, edge_shares, self.sigma_max_mm())
            }
            // A label, or glare, on what the silhouettes show.
            (None, Some(around)) if around.is_certain || !is_sure(&heights) => return,
            (None, Some(around)) if !around.is_run_together() => {
                self.leaving.silhouettes.retain(|s| !place.is_detail_of(&s.place));
                spread(heights, &around.record, self.sigma_max_mm())
            }
            (None, None)
                if !rises(&heights)
                    && !self.leaving.has_part(place, &heights, self.sigma_max_mm()) =>
            {
                return;
            }
            // What has neither a face nor a silhouette is noise.
            (None, None)
                if heights.shape != Shape::Box && !self.differs_from_belt(&heights, place) =>
            {
                return;
            }
            (None, _) => heights,
        };
        self.leaving.tell(*place, &record);
        let rival = passed.rival().map(|rival| self.record_of_pass(&rival));
        let record = rival.map_or(record, |rival| spread(record, &rival, self.sigma_max_mm()));
        let silhouettes = silhouettes.map(|silhouettes| silhouettes.record);
        let heights = Some((heights, *passed));
        self.emit_decision(Decision { record, silhouettes, heights }, emit);
    }

    /// The silhouette that something is a label on, if that will be told.
    fn labelled(&mut self, place: &Rectangle, record: &ParcelRecord) -> Option<&mut Silhouette> {
        let i = self.leaving.labelled(place, record, self.sigma_max_mm())?;
        let outer = self.leaving.silhouettes.get_mut(i)?;
        let is_shadow =
            !is_sure(&outer.record) && self.passes.shows_belt(&outer.place, outer.record.height_mm);
        (!is_shadow).then_some(outer)
    }

    fn sigma_max_mm(&self) -> f64 {
        self.site.config.measure.sigma_max_mm
    }

    /// Whether silhouettes that are not told yet showed anything of a parcel.
    fn differs_from_belt(&self, record: &ParcelRecord, place: &Rectangle) -> bool {
        let params = params_of(place, record.height_mm);
        let outline = Outline::new(&self.site.view, &params, self.at.travel_mm);
        let margin_mm = PIECE_MARGIN_PX * self.site.view.mm_per_px;
        let tracks = self.tracker.tracks().iter().enumerate();
        let mut tracked =
            tracks.filter(|(_, t)| matches!(t.phase, Phase::Candidate | Phase::Riding));
        self.leaving.has_silhouette(place)
            || tracked.any(|(slot, _)| {
                let middle = self.image_on_belt(slot);
                outline.covers(Vector2::new(middle.x, middle.y), margin_mm)
                    || self.place_of_image(slot).overlaps(place)
            })
    }

    fn decide_silhouettes(&mut self, all: bool, emit: &mut dyn FnMut(ParcelRecord)) {
        let mut i = 0;
        while let Some(silhouette) = self.leaving.silhouettes.get(i).copied() {
            if !all && self.heights_may_come(&silhouette) {
                i += 1;
            } else {
                self.leaving.silhouettes.remove(i);
                self.decide_silhouette(&silhouette, emit);
            }
        }
    }

    /// Whether heights may still tell what a silhouette was.
    fn heights_may_come(&self, silhouette: &Silhouette) -> bool {
        let place = &silhouette.place;
        self.leaving.passes.iter().any(|passed| passed.face.rectangle.overlaps(place))
            || self.passes.expects(place)
            || self.riding_at(|track| place.is_detail_of(track)).is_some()
            || !silhouette.is_certain && !self.passes.has_settled(place)
    }

    fn decide_silhouette(&mut self, silhouette: &Silhouette, emit: &mut dyn FnMut(ParcelRecord)) {
        let Silhouette { mut record, place, is_certain, .. } = *silhouette;
        if self.is_explained(silhouette) {
            return;
        }
        let sigma_max_mm = self.sigma_max_mm();
        if let Some(outer) = self.labelled(&place, &record) {
            // Of two borders at one height the outermost is the parcel's; if that is no cuboid's, either may be.
            if outer.record.shape != Shape::Box {
                outer.record = spread(outer.record, &record, sigma_max_mm);
                outer.is_certain = false;
            }
            return;
        }
        let is_measured = record.not_measured.is_none();
        if is_measured && !is_sure(&record) && self.passes.shows_belt(&place, record.height_mm) {
            self.counters.slivers += 1;
            return;
        }
        let is_doubted = is_sure(&record) && !(is_certain && rises(&record));
        record.flags.set(Flags::HEIGHT_DISPUTED, is_doubted);
        self.leaving.tell(place, &record);
        let silhouettes = Some(silhouette.record);
        self.emit_decision(Decision { record, silhouettes, heights: None }, emit);
    }

    /// Whether what was told explains a silhouette: it lies there, or is an image of that, or is in doubt and holds it.
    fn is_explained(&self, silhouette: &Silhouette) -> bool {
        let place = &silhouette.place;
        let told = self.leaving.told.iter();
        let share: f64 = told.clone().map(|told| place.share_inside(&told.place)).sum();
        let is_whole = !silhouette.is_run_together();
        let holds = |told: &Told| {
            !silhouette.is_certain && told.place.overlaps(place) && (told.is_certain || !is_whole)
        };
        let middle = Vector2::new(silhouette.record.x_mm, silhouette.record.y_mm);
        let margin_mm = PIECE_MARGIN_PX * self.site.view.mm_per_px;
        let is_image_of = |told: &Told| {
            let params = params_of(&told.place, told.height_mm);
            let outline = Outline::new(&self.site.view, &params, silhouette.record.belt_travel_mm);
            silhouette.record.not_measured.is_some() && outline.covers(middle, margin_mm)
        };
        share > Rectangle::MOST || told.clone().any(|told| holds(told) || is_image_of(told))
    }

    fn emit_decision(&mut self, mut decision: Decision, emit: &mut dyn FnMut(ParcelRecord)) {
        if !self.reporting {
            return;
        }
        let is_fit = self.condition().is_fit();
        let record = &mut decision.record;
        self.counters.parcels += 1;
        self.counters.unmeasured += u64::from(record.not_measured.is_some());
        self.counters.lost += u64::from(record.flags.has(Flags::LOST));
        record.seq = self.counters.parcels as u32;
        record.may_be_used = record.not_measured.is_none() && record.flags.is_empty() && is_fit;
        *record = record.rounded();
        emit(*record);
        // Only who asks for reasons misses one.
        let _ = self.leaving.decisions.push(decision);
    }
}

/// Whether two heights differ by no more than their sigmas, of which each counts to the largest that may be used.
fn is_as_high(one: &ParcelRecord, other: &ParcelRecord, sigma_max_mm: f64) -> bool {
    let [one_mm, other_mm] = [one, other].map(|r| r.sigma_height_mm.min(sigma_max_mm));
    let sigma_mm = one_mm.hypot(other_mm);
    (one.height_mm - other.height_mm).abs() <= DISAGREE_SIGMA * sigma_mm
}

/// The footprint of a cuboid that is there when the belt has travelled so far.
pub(super) fn place_of(params: &Params, travel_mm: f64) -> Rectangle {
    Rectangle {
        x_mm: params[measure::X] - travel_mm,
        y_mm: params[measure::Y],
        yaw: params[measure::YAW],
        length_mm: params[measure::LENGTH],
        width_mm: params[measure::WIDTH],
        ..Rectangle::default()
    }
}

/// A cuboid over a footprint, before any travel.
fn params_of(place: &Rectangle, height_mm: f64) -> Params {
    let mut params = Params::zeros();
    params[measure::X] = place.x_mm;
    params[measure::Y] = place.y_mm;
    params[measure::YAW] = place.yaw;
    params[measure::LENGTH] = place.length_mm;
    params[measure::WIDTH] = place.width_mm;
    params[measure::HEIGHT] = height_mm;
    params[measure::SCALE] = 1.0;
    params
}

#[cfg(test)]
mod tests {
    use super::super::agreement::tests::record;
    use super::*;

    /// Of a length along X, its middle at `x_mm`.
    fn silhouette(x_mm: f64, length_mm: f64, is_certain: bool) -> Silhouette {
        let place = Rectangle { x_mm, length_mm, width_mm: 150.0, ..Rectangle::default() };
        let record = record([length_mm, 150.0, 60.0], 0.5);
        Silhouette { record, place, is_certain, edge_share: 0.9 }
    }

    fn leaving(silhouettes: &[Silhouette]) -> Leaving {
        let mut leaving = Leaving::default();
        for silhouette in silhouettes {
            leaving.add_silhouette(*silhouette);
        }
        leaving
    }

    /// What the heights show of two cartons of one height, 10 mm apart.
    const BOTH: Rectangle = Rectangle {
        x_mm: 0.0,
        y_mm: 0.0,
        yaw: 0.0,
        length_mm: 410.0,
        width_mm: 150.0,
        score_mm: 0.0,
        sides: [1.0; 4],
    };

    #[test]
    fn two_cartons_that_hardly_part_are_two_and_say_merged() {
        let mut leaving =
            leaving(&[silhouette(-105.0, 200.0, true), silhouette(105.0, 200.0, true)]);
        assert!(leaving.is_parted(&BOTH));
        assert!(leaving.silhouettes.iter().all(|s| s.record.flags.has(Flags::MERGED)));
    }

    #[test]
    fn two_labels_on_a_carton_do_not_part_it() {
        let mut leaving = leaving(&[silhouette(-105.0, 90.0, true), silhouette(105.0, 90.0, true)]);
        assert!(!leaving.is_parted(&BOTH));
        assert!(leaving.silhouettes.iter().all(|s| s.record.flags.is_empty()));
    }

    #[test]
    fn a_silhouette_is_taken_by_the_pass_at_its_place_alone() {
        let (here, ahead) = (silhouette(0.0, 400.0, true), silhouette(900.0, 400.0, true));
        let mut leaving = leaving(&[here, ahead]);
        assert_eq!(leaving.take_silhouette(&BOTH).expect("there").place, here.place);
        assert!(leaving.take_silhouette(&BOTH).is_none());
        let label = Rectangle { x_mm: 900.0, length_mm: 80.0, ..BOTH };
        assert!(leaving.take_silhouette(&label).is_none());
        assert_eq!(leaving.silhouette_around(&label).expect("there").place, ahead.place);
    }

    const SIGMA_MAX_MM: f64 = 3.0;
    const LABEL: Rectangle = Rectangle { length_mm: 80.0, width_mm: 50.0, ..BOTH };

    #[test]
    fn a_label_is_on_what_holds_it_and_is_as_high() {
        let carton = silhouette(0.0, 400.0, true);
        let is_label = |on: Silhouette, place: &Rectangle, record: &ParcelRecord| {
            leaving(&[on]).labelled(place, record, SIGMA_MAX_MM).is_some()
        };
        let as_high = record([80.0, 50.0, 61.0], 0.5);
        assert!(is_label(carton, &LABEL, &as_high));
        // A smaller parcel on a larger one is none, nor is a parcel one on itself.
        let on_top = record([80.0, 50.0, 110.0], 0.5);
        assert!(!is_label(carton, &LABEL, &on_top));
        assert!(!is_label(carton, &carton.place, &carton.record));
        // A height that is hardly known is not as high as everything.
        let mut vague = carton;
        vague.record.sigma_height_mm = 30.0;
        assert!(!is_label(vague, &LABEL, &on_top));
        // What lies on several run together is none.
        let mut together = carton;
        together.record.flags.set(Flags::MERGED, true);
        assert!(!is_label(together, &LABEL, &as_high));
        // What could not be measured has no height.
        let mut low = carton;
        low.record.height_mm = 1.0;
        let brief = ParcelRecord {
            not_measured: Some(crate::event::NotMeasured::TooBrief),
            ..record([0.0; 3], 0.0)
        };
        assert!(!is_label(low, &LABEL, &brief));
    }

    #[test]
    fn two_cartons_seen_as_one_are_no_labels_on_it() {
        let mut leaving = leaving(&[silhouette(0.0, 410.0, true)]);
        let [first, second] =
            [-105.0, 105.0].map(|x_mm| Rectangle { x_mm, length_mm: 200.0, ..BOTH });
        let carton = record([200.0, 150.0, 60.0], 0.5);
        leaving.tell(first, &carton);
        assert!(leaving.labelled(&second, &carton, SIGMA_MAX_MM).is_none());
        assert!(leaving.labelled(&LABEL, &carton, SIGMA_MAX_MM).is_some());
    }

    #[test]
    fn what_is_flat_on_the_belt_is_part_of_nothing() {
        let flat = |height_mm| {
            let mut sticker = silhouette(0.0, 60.0, true);
            sticker.record = record([60.0, 60.0, height_mm], 1.0);
            sticker
        };
        let pass = record([410.0, 150.0, 4.0], 2.5);
        assert!(!leaving(&[flat(0.5)]).has_part(&BOTH, &pass, SIGMA_MAX_MM));
        assert!(leaving(&[flat(4.0)]).has_part(&BOTH, &pass, SIGMA_MAX_MM));
    }

    #[test]
    fn what_finds_no_room_is_counted() {
        let all = [silhouette(0.0, 100.0, true); LEAVING_MAX + 3];
        assert_eq!(leaving(&all).overflows, 3);
    }
}
