//! What rode with the belt, decided when its pass is whole.
//!
//! In: the belt view of each frame and the belt's position. Out: each parcel once its trailing end has passed the
//! zone. Owns: the views, the scroll of heights, the search for parcels in it, the fit. A frame's work is bounded: at
//! most one beginning is looked at; a third of the zone is left for that, from where columns are decided.

use super::evidence::Evidence;
use super::measure::{Measured, Rounding, WholePass};
use super::parcels::{Face, Parcels};
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
/// Before any column: they begin anywhere.
const NONE_TAKEN: i64 = i64::MIN / 2;

/// A parcel whose pass is over.
pub struct Passed {
    /// What was seen of it from above.
    pub face: Face,
    /// Its cuboid, X at the newest view's belt position.
    pub measured: Measured,
    /// Relative standard uncertainty of the belt's travel over the pass.
    pub travel_sigma: f64,
    /// The newest view.
    pub newest: Kept,
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
    breaks: u32,
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
        let (taken, busy, breaks) = (NONE_TAKEN, false, 0);
        Ok(Self { zone: *zone, views, evidence, parcels, fit, taken, busy, breaks })
    }

    /// A frame more: its belt view, rows of [`crate::kernel::scalar::bits::stride`] pixels, and the belt's position.
    pub fn step(
        &mut self,
        pixels: &[u8],
        at: BeltPosition,
        time: FrameTime,
        emit: &mut dyn FnMut(&Passed),
    ) {
        if at.breaks != self.breaks {
            // What was before has no place in what comes.
            self.emit_all(emit);
            self.parcels.forget();
            (self.taken, self.breaks) = (NONE_TAKEN, at.breaks);
        }
        if self.views.offer(pixels, at, time)
            && let Some(place) = self.views.newest()
        {
            self.evidence.add(&self.views, place);
            self.parcels.add(&self.views, place);
        }
        self.evidence.advance(&self.views, at.travel_mm, at.breaks);
        let end_mm = self.zone.x_max_mm - at.travel_mm;
        let decided = self.evidence.decided();
        if !decided.is_empty() && decided.end - self.taken >= LOOK_COLUMNS {
            self.taken = decided.end;
            self.parcels.take_columns(&self.evidence);
            self.busy = true;
        }
        if self.busy {
            self.busy = self.look(false);
            if !self.busy {
                self.emit_left_over(end_mm, emit);
            }
        }
        self.emit_passed(end_mm, emit);
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

    /// Parcels that were found and for which there was no room.
    pub fn overflows(&self) -> u64 {
        self.parcels.overflows()
    }

    /// Heights of the belt.
    pub fn evidence(&self) -> &Evidence {
        &self.evidence
    }

    fn look(&mut self, ended: bool) -> bool {
        let Self { views, parcels, fit, .. } = self;
        parcels.look(views, ended, |face| fit.cuboid(views, face))
    }

    fn emit_passed(&mut self, end_mm: f64, emit: &mut dyn FnMut(&Passed)) {
        while let Some(face) = self.parcels.next_passed(end_mm) {
            self.measure(&face, emit);
        }
    }

    fn emit_left_over(&mut self, end_mm: f64, emit: &mut dyn FnMut(&Passed)) {
        while let Some(face) = self.parcels.next_left_over(&self.views, end_mm) {
            self.measure(&face, emit);
        }
    }

    fn measure(&mut self, face: &Face, emit: &mut dyn FnMut(&Passed)) {
        let newest = self.views.newest().map(|place| self.views.kept(place));
        if let Some((measured, travel_sigma)) = self.fit.measure(&self.views, face)
            && let Some(newest) = newest
        {
            self.parcels.told(face);
            emit(&Passed { face: *face, measured, travel_sigma, newest });
        }
    }
}
