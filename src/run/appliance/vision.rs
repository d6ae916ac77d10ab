//! The vision thread: frames in, records out, requests and encoder counts from the PLC in between.

use super::{Frame, PARK, RECORD_RING, Shared};
use crate::belt::Encoder;
use crate::config::Realtime;
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::health::{Condition, Level};
use crate::image::Plane;
use crate::pipeline::{Health, Pipeline};
use crate::plan::Block;
use crate::plc::command::Request;
use crate::plc::health::{Concern, HealthStatus};
use crate::plc::registers::BeltStatus;
use crate::run::desk::Photographer;
use crate::run::realtime;
use crate::source::Taken;
use crate::stage::odometry::Knowledge;
use heapless::spsc::{Consumer, Producer};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// The vision thread.
pub(super) struct Vision<'a> {
    pub(super) pipeline: Pipeline,
    pub(super) ready: Consumer<'a, Frame>,
    pub(super) free: Producer<'a, Block<u8>>,
    /// To the PLC, each with the belt's travel; and to the observer.
    pub(super) records: (Producer<'a, (ParcelRecord, f64)>, Producer<'a, ParcelRecord>),
    /// With the instant that its time counts from.
    pub(super) encoder: Option<(Encoder, Instant)>,
    pub(super) counts: Consumer<'a, (u32, Instant)>,
    pub(super) requests: Consumer<'a, Request>,
    pub(super) photographer: Photographer<'a>,
    pub(super) shared: &'a Shared,
}

impl Vision<'_> {
    /// On a thread of its own, or, with several workers, on a pool of as many.
    pub(super) fn run_on(mut self, settings: &Realtime) -> Result<()> {
        let result = if settings.workers == 1 {
            realtime::enter(settings, 0).and_then(|()| self.frames())
        } else {
            rayon::ThreadPoolBuilder::new()
                .num_threads(settings.workers)
                .thread_name(|worker| format!("vision {worker}"))
                .build()
                .map_err(|e| Error::failure(format!("cannot start the vision workers: {e}")))
                .and_then(|pool| {
                    let entered = pool.broadcast(|c| realtime::enter(settings, c.index()));
                    entered.into_iter().collect::<Result<Vec<()>>>()?;
                    pool.install(|| self.frames())
                })
        };
        self.shared.vision_ended.store(true, Ordering::Release);
        result
    }

    fn frames(&mut self) -> Result<()> {
        self.shared.vision.get_or_init(std::thread::current);
        let [width, height] = self.pipeline.site().camera.image_size_px;
        let mut overflows = 0;
        loop {
            self.shared.beats.vision.beat();
            let Some(frame) = self.ready.dequeue() else {
                // Asked before the ring: what was captured before the end is processed.
                if self.shared.source_ended.load(Ordering::Acquire) && self.ready.is_empty() {
                    return Ok(());
                }
                // A gap in the frames is none in the encoder's counts.
                self.take_counts();
                std::thread::park_timeout(PARK);
                continue;
            };
            let began = Instant::now();
            self.obey();
            let Taken { time, captured, stride } = frame.taken;
            self.read_encoder(captured);
            let raw = Plane::new(&frame.pixels, width, height, stride)
                .ok_or_else(|| Error::failure("a frame of another size"))?;
            let mut left = heapless::Vec::<ParcelRecord, RECORD_RING>::new();
            self.pipeline.step(raw, time, &mut |record| {
                overflows += u64::from(left.push(record).is_err());
            })?;
            let travel_mm = self.pipeline.belt_position().travel_mm;
            let (plc, observer) = &mut self.records;
            for record in left {
                overflows += u64::from(plc.enqueue((record, travel_mm)).is_err());
                // An observer that does not look misses records; the PLC never does.
                let _ = observer.enqueue(record);
            }
            if self.photographer.look(&self.pipeline, raw, time) {
                self.shared.wake_desk();
            }
            self.publish(time.t_s, began.elapsed(), overflows);
            let _ = self.free.enqueue(frame.pixels);
        }
    }

    /// Do what the PLC asked for.
    fn obey(&mut self) {
        while let Some(request) = self.requests.dequeue() {
            match request {
                Request::Learn => self.pipeline.learn(),
                Request::Report(reporting) => self.pipeline.report_parcels(reporting),
                Request::MmPerCount(mm_per_count) => {
                    if let Some((encoder, _)) = &mut self.encoder {
                        encoder.set_mm_per_count(mm_per_count);
                    }
                    self.pipeline.forget_encoder();
                }
            }
        }
    }

    fn take_counts(&mut self) {
        let Some((encoder, start)) = &mut self.encoder else { return };
        while let Some((count, at)) = self.counts.dequeue() {
            encoder.count(count, at.saturating_duration_since(*start).as_secs_f64());
        }
    }

    /// Tell the pipeline where the belt was when a frame was exposed.
    fn read_encoder(&mut self, captured: Instant) {
        self.take_counts();
        let Some((encoder, start)) = &mut self.encoder else { return };
        let captured_s = captured.saturating_duration_since(*start).as_secs_f64();
        if let Some(position_mm) = encoder.position_mm(captured_s) {
            self.pipeline.encoder(position_mm);
        }
    }

    fn publish(&self, time_s: f64, frame_time: Duration, overflows: u64) {
        let (speed, measured) = self.pipeline.belt_motion();
        // Never waits: while a reader holds the lock, it sees the frame before.
        let Ok(mut progress) = self.shared.progress.try_lock() else { return };
        let status = &mut progress.status;
        status.counters = self.pipeline.counters();
        status.counters.event_overflows = overflows;
        status.ready = self.pipeline.ready();
        status.belt_speed_mm_per_s = speed.max(0.0);
        status.by_encoder = self.pipeline.by_encoder();
        status.belt_measured = measured || status.by_encoder;
        status.belt_travel_mm = self.pipeline.belt_position().travel_mm;
        status.time_s = time_s;
        status.belt = belt_status(&self.pipeline.health());
        status.health = health_status(&self.pipeline.condition());
        progress.frame_time_max = progress.frame_time_max.max(frame_time);
    }
}

/// In the words of the PLC's interface.
fn belt_status(health: &Health) -> BeltStatus {
    BeltStatus {
        seen_mm_per_s: health.belt_seen_mm_per_s,
        not_as_configured: health.belt_not_as_configured,
        ambiguous: health.texture == Knowledge::Ambiguous,
        hides_parcels: health.belt_hides_parcels,
        encoder_ratio: health.encoder_ratio.map(|(ratio, _)| ratio),
        encoder_disagrees: health.encoder_disagrees,
    }
}

fn health_status(condition: &Condition) -> HealthStatus {
    let Condition { place, sharpness, light } = condition;
    HealthStatus {
        camera_watch: place.watching as u16,
        camera_moved_px: place.moved.picture_px,
        camera_error_mm: place.moved.error_mm,
        camera: concern(place.level),
        blur_px: sharpness.blur_px,
        blur: concern(sharpness.level),
        light_region: u16::from(light.region),
        light_change: light.change,
        light: concern(light.level),
    }
}

fn concern(level: Level) -> Concern {
    match level {
        Level::Good => Concern::None,
        Level::Warning => Concern::Warning,
        Level::Fault => Concern::Fault,
    }
}
