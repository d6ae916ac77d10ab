//! What rode with the belt, decided when its pass is whole.
//!
//! In: the belt view of each frame and the belt's position. Out: each parcel once its trailing end has passed the
//! zone, and whether the belt itself shows at a place. Owns: the views, the scroll of heights, the search for parcels in it, the fit. A frame's work is bounded: at
//! most one beginning is looked at; a third of the zone is left for that, from where columns are decided.

use super::evidence::Evidence;
use super::measure::{Measured, Rounding, SCALE, WholePass, X};
use super::parcels::{Face, Parcels, Rectangle};
use super::views::{Kept, Views};
use crate::belt::BeltPosition;
use crate::camera::BeltView;
use crate::error::Result;
use crate::image::FrameTime;
use crate::kernel::Level;
use crate::plan::{Memory, Plan};
use crate::units::BeltRect;

/// Columns of cells between two looks for parcels.
const LOOK_COLUMNS: i64 = 8;
/// A silhouette in doubt waits so far behind the zone's end at most, share of the zone: looks need a frame each.
const LATE_MAX_SHARE: f64 = 0.1;
/// Before any column: they begin anywhere.
const NONE_TAKEN: i64 = i64::MIN / 2;

/// A parcel whose pass is over.
#[derive(Clone, Copy)]
pub struct Passed {
    /// What was seen of it from above.
    pub face: Face,
    /// Its cuboid, X at the reference view's belt position.
    pub measured: Measured,
    /// The first view that has any of it.
    pub first: Kept,
    /// The newest view.
    pub newest: Kept,
    /// The view in which its middle had just passed the zone's.
    pub reference: Kept,
    /// Its trailing end has passed the zone; else the belt, or what is known of it, ended before.
    pub left: bool,
}

impl Passed {
    /// Relative standard uncertainty of the belt's travel over the pass.
    pub fn travel_sigma(&self) -> f64 {
        self.newest.at.sigma_since(&self.first.at)
    }

    /// The same pass with the other cuboid that it may be; X is not moved to the reference view.
    pub fn rival(&self) -> Option<Self> {
        let estimate = self.measured.rival?;
        Some(Self { measured: Measured { estimate, rival: None, ..self.measured }, ..*self })
    }

    /// Mean speed of the belt over the pass, mm/s.
    pub fn speed_mm_per_s(&self) -> f64 {
        let elapsed_s = self.newest.time.t_s - self.first.time.t_s;
        let travel_mm = self.newest.at.travel_mm - self.first.at.travel_mm;
        self.measured.estimate.params[SCALE] * travel_mm / elapsed_s.max(1e-9)
    }
}

/// The stage.
pub struct Passes {
    zone: BeltRect,
    views: Views,
    evidence: Evidence,
    parcels: Parcels,
    fit: WholePass,
    /// Columns taken over from the scroll.
    taken: i64,
    /// Beginnings may be left in them.
    busy: bool,
    /// All parcels from here on, X less the belt's travel, were passed on.
    settled_mm: f64,
    at: BeltPosition,
}

impl Passes {
    /// Memory for a site.
    pub fn plan(view: &BeltView, zone: &BeltRect, height_max_mm: f64, plan: &mut Plan) {
        Views::plan(view, plan);
        Evidence::plan(view, zone, height_max_mm, plan);
        Parcels::plan(view, zone, height_max_mm, plan);
        WholePass::plan(view, plan);
    }

    /// Nothing seen. `seen`: bit mask of the view's pixels that the camera sees.
    pub fn new(
        view: &BeltView,
        zone: &BeltRect,
        height_max_mm: f64,
        rounding: Rounding,
        level: Level,
        seen: &[u64],
        memory: &mut Memory,
    ) -> Result<Self> {
        let views = Views::new(view, zone, memory)?;
        let evidence = Evidence::new(view, zone, height_max_mm, level, seen, memory)?;
        let parcels = Parcels::new(view, zone, &evidence, height_max_mm, level, seen, memory)?;
        let fit = WholePass::new(view, zone, height_max_mm, rounding, seen, memory)?;
        let (taken, busy, at) = (NONE_TAKEN, false, BeltPosition::default());
        let settled_mm = f64::INFINITY;
        Ok(Self { zone: *zone, views, evidence, parcels, fit, taken, busy, settled_mm, at })
    }

    /// A frame more: its belt view, rows of [`crate::kernel::scalar::bits::stride`] pixels, and the belt's position.
    pub fn step(
        &mut self,
        pixels: &[u8],
        at: BeltPosition,
        time: FrameTime,
        emit: &mut dyn FnMut(&Passed),
    ) {
        if at.breaks != self.at.breaks {
            // What was before has no place in what comes.
            self.emit_all(emit);
            self.parcels.forget();
            (self.taken, self.settled_mm) = (NONE_TAKEN, f64::INFINITY);
        }
        self.at = at;
        if self.views.offer(pixels, at, time)
            && let Some(place) = self.views.newest()
        {
            self.evidence.add(&self.views, place);
            self.parcels.add(&self.views, place);
        }
        self.evidence.advance(&self.views, at.travel_mm, at.breaks);
        let end_mm = self.end_mm();
        let decided = self.evidence.decided();
        if !decided.is_empty() && decided.end - self.taken >= LOOK_COLUMNS {
            self.taken = decided.end;
            self.parcels.take_columns(&self.evidence);
            self.busy = true;
        }
        // One of the two a frame: each costs as much as several frames.
        if !self.emit_passed(end_mm, emit) && self.busy {
            self.busy = self.look(false);
            if !self.busy {
                self.emit_left_over(end_mm, emit);
                self.settled_mm = end_mm;
            }
        }
    }

    /// The belt has ended: what was seen at all is all that comes.
    pub fn finish(&mut self, emit: &mut dyn FnMut(&Passed)) {
        self.evidence.finish(&self.views);
        self.emit_all(emit);
    }

    /// Emit what is decided by now, wherever it is.
    fn emit_all(&mut self, emit: &mut dyn FnMut(&Passed)) {
        self.taken = self.evidence.decided().end;
        self.parcels.take_columns(&self.evidence);
        while self.look(true) {}
        self.emit_passed(f64::NEG_INFINITY, emit);
        self.emit_left_over(f64::NEG_INFINITY, emit);
    }

    /// Whether a parcel on its way to the zone's end lies at a place.
    pub fn expects(&self, place: &Rectangle) -> bool {
        self.parcels.waits_at(place)
    }

    /// Whether the cells at a place tell the belt rather than something of this height, mm.
    pub fn shows_belt(&mut self, place: &Rectangle, height_mm: f64) -> bool {
        self.parcels.shows_belt(place, height_mm)
    }

    /// Whether the heights at a place are not those of a parcel with that border and height, mm.
    pub fn contradict(&mut self, place: &Rectangle, height_mm: f64) -> bool {
        self.parcels.contradict(place, height_mm)
    }

    /// Whether all parcels at a place were passed on. Nobody waits for more when it has left the zone where the belt comes
    /// in, or, past its end, when there is more to look at than there are frames.
    pub fn has_settled(&self, place: &Rectangle) -> bool {
        let leading_mm = place.x_mm + place.reach_mm();
        let late_mm = place.trailing_mm() - self.end_mm();
        place.trailing_mm() > self.settled_mm
            || leading_mm < self.zone.x_min_mm - self.at.travel_mm
            || late_mm > LATE_MAX_SHARE * self.zone.length_mm()
    }

    /// The zone's end, X less the belt's travel, mm.
    fn end_mm(&self) -> f64 {
        self.zone.x_max_mm - self.at.travel_mm
    }

    /// Parcels that were found and for which there was no room.
    pub fn overflows(&self) -> u64 {
        self.parcels.overflows()
    }

    /// Frames of the views that are kept.
    pub fn frames(&self) -> impl Iterator<Item = u64> + '_ {
        self.views.places().map(|place| self.views.kept(place).time.index)
    }

    /// Heights of the belt.
    pub fn evidence(&self) -> &Evidence {
        &self.evidence
    }

    fn look(&mut self, ended: bool) -> bool {
        let Self { views, parcels, fit, .. } = self;
        parcels.look(views, ended, |face| fit.cuboid(views, face))
    }

    /// Returns whether there was any.
    fn emit_passed(&mut self, end_mm: f64, emit: &mut dyn FnMut(&Passed)) -> bool {
        let mut any = false;
        while let Some(face) = self.parcels.next_passed(end_mm) {
            self.measure(&face, emit);
            any = true;
        }
        any
    }

    fn emit_left_over(&mut self, end_mm: f64, emit: &mut dyn FnMut(&Passed)) {
        while let Some(face) = self.parcels.next_left_over(&self.views, end_mm) {
            self.measure(&face, emit);
        }
    }

    fn measure(&mut self, face: &Face, emit: &mut dyn FnMut(&Passed)) {
        let Some(newest) = self.views.newest().map(|place| self.views.kept(place)) else { return };
        let Some((mut measured, first)) = self.fit.measure(&self.views, face) else { return };
        self.parcels.told(face);
        let reference = self.reference(face).unwrap_or(newest);
        let params = &mut measured.estimate.params;
        params[X] += params[SCALE] * (reference.at.travel_mm - newest.at.travel_mm);
        let left = face.rectangle.trailing_mm() > self.end_mm();
        emit(&Passed { face: *face, measured, first, newest, reference, left });
    }

    /// The oldest view in which a face's middle has passed the zone's.
    fn reference(&self, face: &Face) -> Option<Kept> {
        let middle_mm = self.zone.centre().x - face.rectangle.x_mm;
        let places = self.views.places().map(|place| self.views.kept(place));
        places.take_while(|kept| kept.at.travel_mm >= middle_mm).last()
    }
}
