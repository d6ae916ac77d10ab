//! The belt views of the last passes: what the evidence and the fit look back at.
//!
//! In: the belt view of each frame, with the belt's position. Out: views about evenly spaced over the
//! belt's travel, newest first. Owns: the pictures. Limits: [`VIEWS_MAX`] views, over [`ZONES`] zones of
//! travel; the oldest make room.

use crate::belt::BeltPosition;
use crate::camera::BeltView;
use crate::error::Result;
use crate::image::{FrameTime, Plane};
use crate::kernel::scalar::bits::stride;
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltRect;

/// Views that a pass over the zone gives: more repeat what is known.
const VIEWS_PER_ZONE: usize = 40;
/// Zones of travel looked back at: a parcel as long as the zone is seen whole.
const ZONES: usize = 2;
/// Views kept.
pub const VIEWS_MAX: usize = VIEWS_PER_ZONE * ZONES;

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
            "belt views over two zones of travel",
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
        true
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
