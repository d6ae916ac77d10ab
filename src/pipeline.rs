//! `step()`: the whole algorithm, in order, for one frame.
//!
//! In: a raw frame and its time. Out: parcel records, at most one a track and frame.
//! Owns: every stage, in one mapping planned from the configuration. Reads no clock, draws no
//! random number, allocates nothing: a recording replays to the same records on every run.

mod agreement;
mod gap;
mod leaving;
mod motion;
mod records;
mod sight;
mod silhouettes;

pub use leaving::Decision;
pub use motion::Health;
pub use sight::Sight;

use crate::belt::BeltPosition;
use crate::config::Site;
use crate::error::{Error, Result};
use crate::event::{Counters, Flags, ParcelRecord};
use crate::health::{Condition, Ride, Watch};
use crate::image::{FrameTime, Plane};
use crate::kernel::Level;
use crate::kernel::scalar::bits::{self, Square, words};
use crate::plan::{Block, Memory, Plan};
use crate::stage::background::Background;
use crate::stage::evidence::Evidence;
use crate::stage::measure::{self, Frame, Measure};
use crate::stage::odometry::{Expected, Motion, Odometry};
use crate::stage::passes::{Passed, Passes};
use crate::stage::rectify::Rectify;
use crate::stage::riders::Riders;
use crate::stage::segment::{PxBox, Segment};
use crate::stage::track::{Change, NOBODY, Phase, Track, Tracker};
use crate::units::{BeltPx, BeltRect};
use leaving::Leaving;
use motion::Witnesses;
use nalgebra::Vector2;

/// A frame that is older than the last one by less than this, s, came out of order. A clock that was
/// set back further begins anew.
const LATE_MAX_S: f64 = 1.0;
/// Around a parcel this many px are not learned as background: its blurred border.
const HOLD_MARGIN_PX: usize = 2;
/// Around a parcel this many px are no witness of the belt's motion: blur and compression
/// carry the parcel's own, faster motion into them.
const COVER_MARGIN_PX: usize = 8;

/// Parcels that pass the middle of the zone in one frame, and are looked at.
const PASSING_MAX: usize = 4;

/// A blob whose middle is this near to a parcel's silhouette is a piece of that parcel.
const PIECE_MARGIN_PX: f64 = 8.0;

/// When and where a track passed the middle of the zone.
#[derive(Clone, Copy)]
struct Reference {
    /// When the track began.
    began_s: f64,
    time: FrameTime,
    at: BeltPosition,
    /// It has passed; before that it is just the newest frame.
    fixed: bool,
}

/// The pipeline.
pub struct Pipeline {
    site: Site,
    zone: BeltRect,
    rectify: Rectify,
    background: Background,
    odometry: Odometry,
    segment: Segment,
    riders: Riders,
    tracker: Tracker,
    measure: Measure,
    passes: Passes,
    leaving: Leaving,
    watch: Watch,
    /// Bit mask: parcels and their surroundings in the last frame.
    covered: Block<u64>,
    /// Bit mask: pixels that the background must not learn.
    hold: Block<u64>,
    scratch: Block<u64>,
    references: Block<Reference>,
    at: BeltPosition,
    witnesses: Witnesses,
    stands_still: bool,
    reporting: bool,
    last: Option<FrameTime>,
    counters: Counters,
}

impl Pipeline {
    /// Memory for a site.
    pub fn plan(site: &Site, plan: &mut Plan) {
        let (size, limits) = (site.view.size_px, &site.config.limits);
        Rectify::plan(&site.view, plan);
        Background::plan(size, plan);
        Odometry::plan(&site.view, &site.config.zone, plan);
        Segment::plan(size, limits, plan);
        Riders::plan(size, limits.blobs_max, plan);
        Tracker::plan(limits.tracks_max, limits.blobs_max, plan);
        Measure::plan(limits.tracks_max, limits.views_per_track_max, plan);
        Passes::plan(&site.view, &site.config.zone, site.height_max_mm, plan);
        Watch::plan(site, plan);
        let mask = words(size[0]) * size[1];
        plan.add::<u64>("pipeline.covered", mask, "bit: parcel or near one in the last frame");
        plan.add::<u64>("pipeline.hold", mask, "bit: not to be learned as background");
        plan.add::<u64>("pipeline.scratch", mask, "the other half of each dilation");
        plan.add::<Reference>("pipeline.references", limits.tracks_max, "limits.tracks_max");
    }

    /// Take the planned memory and compute the tables.
    pub fn new(site: Site, memory: &mut Memory) -> Result<Self> {
        let (zone, view, config) = (site.config.zone, &site.view, &site.config);
        let magnification_max = view.magnification(site.height_max_mm);
        let start = FrameTime { index: 0, t_s: 0.0 };
        let nowhere =
            Reference { began_s: 0.0, time: start, at: BeltPosition::default(), fixed: false };
        let (level, bands) = (Level::new(), config.realtime.workers);
        let rectify = Rectify::new(&site.camera, view, level, bands, memory)?;
        let background =
            Background::new(view.size_px, config.background.clone(), level, bands, memory)?;
        let odometry = Odometry::new(
            view,
            &zone,
            Expected {
                nominal_mm_per_s: config.belt.speed_mm_per_s,
                speed_error_max: config.odometry.speed_error_max,
                magnification_max,
            },
            level,
            bands,
            memory,
        )?;
        let segment =
            Segment::new(view.size_px, view.mm_per_px, config.segment.clone(), bands, memory)?;
        let riders = Riders::new(view.mm_per_px, memory)?;
        let tracker = Tracker::new(view.mm_per_px, magnification_max, view.size_px[0], memory)?;
        let measure = Measure::new(
            view.clone(),
            level,
            zone,
            site.height_max_mm,
            measure::Rounding::of_radius(config.measure.edge_radius_mm),
            config.limits.views_per_track_max,
            memory,
        )?;
        let passes = Passes::new(
            view,
            &zone,
            site.height_max_mm,
            measure::Rounding::of_radius(config.measure.edge_radius_mm),
            level,
            rectify.seen(),
            memory,
        )?;
        let watch = Watch::new(&site, memory)?;
        Ok(Self {
            rectify,
            background,
            odometry,
            segment,
            riders,
            tracker,
            measure,
            passes,
            leaving: Leaving::default(),
            watch,
            covered: memory.take("pipeline.covered", 0)?,
            hold: memory.take("pipeline.hold", 0)?,
            scratch: memory.take("pipeline.scratch", 0)?,
            references: memory.take("pipeline.references", nowhere)?,
            at: BeltPosition::default(),
            witnesses: Witnesses::default(),
            stands_still: false,
            reporting: true,
            last: None,
            counters: Counters::default(),
            zone,
            site,
        })
    }

    /// Process one frame; `emit` takes each parcel that has left the zone.
    pub fn step(
        &mut self,
        raw: Plane<'_>,
        time: FrameTime,
        emit: &mut dyn FnMut(ParcelRecord),
    ) -> Result<()> {
        let at_frame = |e: Error| e.at(format!("frame {}", time.index));
        self.site.check_image_size([raw.width(), raw.height()]).map_err(at_frame)?;
        let dt_s = self.last.map_or(0.0, |last| time.t_s - last.t_s);
        // What it shows is known from the frames around it.
        if (-LATE_MAX_S..0.0).contains(&dt_s) {
            return Ok(());
        }
        self.last = Some(time);
        self.counters.frames += 1;

        self.rectify.step(raw);
        self.odometry.look_at_raw(raw);
        self.hold_background();
        self.background.step(self.rectify.pixels(), self.rectify.seen(), &self.hold);
        let by_encoder = self.witnesses.encoder_step_mm();
        let gap = !self.odometry.bridges(dt_s);
        if !self.background.learned() {
            let dt_s = if gap { 0.0 } else { dt_s };
            if gap {
                self.lose_unlearned_belt();
            }
            let assumed_mm = self.odometry.speed().0 * dt_s;
            self.witnesses.encoder_alone(by_encoder, dt_s);
            self.at.advance(by_encoder.unwrap_or(assumed_mm), by_encoder.is_some());
            self.follow_passes(time);
            self.decide(false, emit);
            return Ok(());
        }
        let background = &self.background;
        self.segment.step(background.foreground(), background.strong(), background.dark());
        self.cover();
        let motion =
            if gap { self.bridge(by_encoder, time, dt_s) } else { self.motion(by_encoder, dt_s) };
        self.at.advance(motion.step_mm, motion.measured);
        if gap {
            self.depart(motion.step_mm);
        }
        self.track(motion.step_mm);
        self.measure_tracks(time, motion.step_mm);
        self.follow_passes(time);
        self.leave_zone();
        self.decide(false, emit);
        self.watch(raw, motion.step_mm, dt_s);
        self.counters.segment_overflows = self.segment.overflows;
        self.counters.track_overflows =
            self.tracker.overflows + self.leaving.overflows + self.passes.overflows();
        Ok(())
    }

    /// The belt's position at the next frame, mm from anywhere, as an encoder tells it. It outdoes
    /// the belt's texture; a frame without it falls back to that.
    pub fn encoder(&mut self, position_mm: f64) {
        self.witnesses.encoder(position_mm);
    }

    /// The encoder has another scale from here on: what it showed before is forgotten.
    pub fn forget_encoder(&mut self) {
        self.witnesses.forget_encoder();
    }

    /// The belt's step since the last frame.
    fn motion(&mut self, by_encoder: Option<f64>, dt_s: f64) -> Motion {
        self.riders.step(self.segment.runs(), self.rectify.seen(), dt_s);
        let ride = self.riders.ride();
        let grey = self.rectify.pixels();
        let texture = self.odometry.step(grey, &self.background, &self.covered, ride, dt_s);
        let decided = self.witnesses.decide(by_encoder, texture, &self.odometry, ride, dt_s);
        let by_texture = self.witnesses.encoder_speed_mm_per_s().is_none();
        if by_texture && self.odometry.follows_blocks() {
            self.at.doubt(decided.motion.step_mm);
        }
        if decided.changed {
            self.at.lose();
        }
        self.stands_still = decided.stands_still;
        decided.motion
    }

    /// The belt is empty: forget what it looked like, and the tracks in view, and learn it anew. Heights need no empty
    /// belt: what they have seen is told.
    pub fn learn(&mut self) {
        self.background.forget();
        self.tracker.forget();
        self.odometry.forget();
        self.riders.forget();
        self.leaving.forget();
        self.stands_still = false;
    }

    /// Report parcels, or let them pass.
    pub fn report_parcels(&mut self, reporting: bool) {
        self.reporting = reporting;
    }

    /// The input has ended: report what is still inside and had a shape, flagged unfinished.
    pub fn finish(&mut self, emit: &mut dyn FnMut(ParcelRecord)) {
        let Self { passes, leaving, .. } = self;
        passes.finish(&mut |passed| leaving.add_pass(passed));
        for slot in 0..self.tracker.tracks().len() {
            if self.tracker.tracks()[slot].phase == Phase::Riding {
                self.leave(slot, Flags::UNFINISHED);
            }
        }
        self.decide(true, emit);
    }

    /// Not to be learned: parcels, or the whole belt at a standstill, when its texture and
    /// whatever stands on it would become background.
    fn hold_background(&mut self) {
        if self.stands_still {
            self.hold.fill(u64::MAX);
            return;
        }
        let width = self.site.view.size_px[0];
        let n = words(width);
        self.hold.fill(0);
        for run in self.segment.runs() {
            let owner = self.tracker.owners().get(run.label as usize).copied().unwrap_or(NOBODY);
            let held = self.tracker.tracks().get(usize::from(owner)).is_some_and(Track::is_parcel);
            if held {
                bits::set(&mut self.hold[usize::from(run.v) * n..][..n], run.start, run.end);
            }
        }
        self.square(HOLD_MARGIN_PX).dilate(&mut self.hold, &mut self.scratch);
        for (hold, seen) in self.hold.iter_mut().zip(self.rectify.seen()) {
            *hold |= !seen;
        }
    }

    fn square(&self, radius: usize) -> Square {
        let (width, bands) = (self.site.view.size_px[0], self.site.config.realtime.workers);
        Square { width, radius, bands }
    }

    /// What is not free belt: every blob with its surroundings.
    fn cover(&mut self) {
        self.covered.copy_from_slice(self.segment.mask());
        self.square(COVER_MARGIN_PX).dilate(&mut self.covered, &mut self.scratch);
        for (covered, seen) in self.covered.iter_mut().zip(self.rectify.seen()) {
            *covered |= !seen;
        }
    }

    /// Whether the instrument is as it was.
    fn watch(&mut self, raw: Plane<'_>, step_mm: f64, dt_s: f64) {
        let tops: heapless::Vec<_, PASSING_MAX> = self
            .passing_middle()
            .filter_map(|sight| sight.top(&self.site.view))
            .take(PASSING_MAX)
            .collect();
        tops.iter().for_each(|top| self.watch.parcel(self.rectify.view(), top));
        let moves = !self.stands_still && step_mm != 0.0;
        let moving_s = moves.then_some(dt_s);
        let ride = Ride { covered: &self.covered, travel_mm: self.at.travel_mm, moving_s };
        self.watch.step(&self.site, raw, ride);
    }

    /// Give blobs to tracks. A piece beside a measured cuboid (a side face as grey as the belt
    /// cuts the shadow beyond it off) is part of that parcel.
    fn track(&mut self, step_mm: f64) {
        let Self { tracker, segment, measure, site, at, .. } = self;
        let covers = |slot: usize, b: &PxBox| {
            let centre =
                BeltPx { u: f64::from(b.u0 + b.u1) / 2.0, v: f64::from(b.v0 + b.v1) / 2.0 };
            let centre = site.view.belt_point(centre);
            let margin_mm = PIECE_MARGIN_PX * site.view.mm_per_px;
            let outline = measure.outline(slot, *at);
            outline.map(|o| o.covers(Vector2::new(centre.x, centre.y), margin_mm))
        };
        tracker.step(segment.blobs(), step_mm, *at, &covers);
    }

    fn measure_tracks(&mut self, time: FrameTime, step_mm: f64) {
        for &(slot, change) in self.tracker.changes() {
            if change == Change::Began {
                self.measure.begin(slot, self.at);
                self.references[slot] =
                    Reference { began_s: time.t_s, time, at: self.at, fixed: false };
            }
        }
        let frame = Frame {
            view: &self.site.view,
            zone: &self.zone,
            grey: self.rectify.view(),
            seen: self.rectify.seen(),
            dark: self.background.dark(),
        };
        let middle_mm = self.zone.centre().x;
        for (slot, track) in self.tracker.tracks().iter().enumerate() {
            if !matches!(track.phase, Phase::Candidate | Phase::Riding) {
                continue;
            }
            let owners = self.tracker.owners();
            let alone = self.segment.runs().iter().filter(|run| {
                !track.merged && owners.get(run.label as usize) == Some(&(slot as u16))
            });
            self.measure.observe(slot, self.at, &frame, alone);
            self.measure.search(slot, self.at, step_mm);
            let reference = &mut self.references[slot];
            if !reference.fixed {
                let outline = self.measure.outline(slot, self.at);
                let x_mm = outline.map_or(f64::NEG_INFINITY, |o| {
                    0.25 * o.base.iter().map(|v| v.over_belt.x).sum::<f64>()
                });
                *reference =
                    Reference { time, at: self.at, fixed: x_mm >= middle_mm, ..*reference };
            }
        }
    }

    /// What rides over the belt, by its height.
    fn follow_passes(&mut self, time: FrameTime) {
        let Self { passes, leaving, .. } = self;
        let mut add = |passed: &Passed| leaving.add_pass(passed);
        passes.step(self.rectify.pixels(), self.at, time, &mut add);
    }

    /// Tracks that have passed the end of the zone, or were lost on the way.
    fn leave_zone(&mut self) {
        for i in 0..self.tracker.changes().len() {
            let (slot, change) = self.tracker.changes()[i];
            if change == Change::Lost {
                self.tell(slot, Flags::LOST, self.reason(slot, Flags::LOST));
            }
        }
        for slot in 0..self.tracker.tracks().len() {
            if self.tracker.tracks()[slot].phase == Phase::Riding
                && self.trailing_x_mm(slot, 0.0) > self.zone.x_max_mm
            {
                self.leave(slot, Flags::default());
            }
        }
    }

    /// A track's pass is over.
    fn leave(&mut self, slot: usize, flags: Flags) {
        self.tell(slot, flags, self.reason(slot, flags));
        self.tracker.set_left(slot);
    }

    /// Where a parcel ends, by its cuboid, or by its image once that has moved on by `ahead_mm`.
    fn trailing_x_mm(&self, slot: usize, ahead_mm: f64) -> f64 {
        if let Some(outline) = self.measure.outline(slot, self.at) {
            return outline.trailing_x_mm();
        }
        let px = BeltPx { u: f64::from(self.tracker.tracks()[slot].bounds.u0), v: 0.0 };
        self.site.view.belt_point(px).x + ahead_mm
    }

    /// Frames at which a record that is still to come may hold.
    pub fn reference_frames(&self) -> impl Iterator<Item = u64> + '_ {
        let tracks = self.tracker.tracks().iter().enumerate();
        let riding = tracks.filter(|(_, t)| t.phase == Phase::Riding);
        riding
            .map(|(slot, _)| self.references[slot].time.index)
            .chain(self.leaving.frames())
            .chain(self.passes.frames())
    }

    /// What was told in the last frame, and what it was decided from.
    pub fn decisions(&self) -> &[Decision] {
        &self.leaving.decisions
    }

    /// Heights of the belt.
    pub fn evidence(&self) -> &Evidence {
        self.passes.evidence()
    }

    /// What happened so far.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// What the pipeline knows of its own condition.
    pub fn health(&self) -> Health {
        let contrast_min_grey = self.background.contrast_min_grey();
        self.witnesses.health(&self.odometry, self.riders.ride(), contrast_min_grey)
    }

    /// What the instrument knows of itself.
    pub fn condition(&self) -> Condition {
        self.watch.condition()
    }

    /// Frames that the belt's steps show to be missing, though their times do not tell.
    pub fn untold_gaps(&self) -> u64 {
        self.odometry.untold_gaps()
    }

    /// Whether the empty belt has been learned.
    pub fn ready(&self) -> bool {
        self.background.learned()
    }

    /// Where the belt is.
    pub fn belt_position(&self) -> BeltPosition {
        self.at
    }

    /// The belt's motion in the last frame, and whether it was measured.
    pub fn belt_motion(&self) -> (f64, bool) {
        match self.witnesses.encoder_speed_mm_per_s() {
            Some(speed_mm_per_s) => (speed_mm_per_s, true),
            None => self.odometry.speed(),
        }
    }

    /// The belt view of the last frame.
    pub fn view(&self) -> Plane<'_> {
        self.rectify.view()
    }

    /// The same, rows of [`bits::stride`] pixels.
    pub fn pixels(&self) -> &[u8] {
        self.rectify.pixels()
    }

    /// Bit mask of the view's pixels that the camera sees.
    pub fn seen(&self) -> &[u64] {
        self.rectify.seen()
    }

    /// Bit mask of the last frame's foreground.
    pub fn foreground(&self) -> &[u64] {
        self.background.foreground()
    }

    /// Whether that was by the encoder.
    pub fn by_encoder(&self) -> bool {
        self.witnesses.encoder_speed_mm_per_s().is_some()
    }

    /// The site it was built for.
    pub fn site(&self) -> &Site {
        &self.site
    }
}
