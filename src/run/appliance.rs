//! The appliance: capture, vision and PLC threads, with rings between them.
//!
//! ```text
//! source -> [ready ring] -> pipeline -> [records] -> link: Modbus, CAN
//!    ^------ [free ring] <-----'  ^        '-------> observer (console, pictures)
//!                                 '--- [counts, requests] --- link
//! ```
//! A frame buffer is always in exactly one place. When no buffer is free the frame is dropped
//! and counted; when a record ring is full the record is counted; vision never waits.

use super::realtime;
use crate::belt::Encoder;
use crate::config::{Realtime, Site};
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::image::{FrameTime, Plane};
use crate::pipeline::Pipeline;
use crate::plan::Block;
use crate::plc::can::CanLink;
use crate::plc::command::Request;
use crate::plc::journal::Journal;
use crate::plc::link::Link;
use crate::plc::modbus;
use crate::plc::registers::VisionStatus;
use crate::source::FrameSource;
use heapless::spsc::{Consumer, Producer, Queue};
use socketcan::CanFdSocket;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

/// Frame buffers that a ring holds: the largest `limits.frames_queued_max`, and one.
const FRAME_RING: usize = 16;
/// Records that wait for the PLC thread; at 2 ms a visit it is nearly always empty.
const RECORD_RING: usize = 64;
/// Encoder counts on their way to vision, and one: two frames at 1000 counts a second.
const COUNT_RING: usize = 128;
/// Requests on their way to vision, and one.
const REQUEST_RING: usize = 16;
/// How long a thread sleeps when a ring is empty and nobody has woken it.
const PARK: Duration = Duration::from_millis(50);
/// The last parcels reach disk and CAN bus within this, or not at all.
const FAREWELL: Duration = Duration::from_secs(1);
/// An encoder that moves faster than the belt's nominal speed by this factor was set anew.
const ENCODER_SPEED_MAX: f64 = 5.0;

/// When frames are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// The source blocks until a frame is due, as a camera does.
    Source,
    /// At the source's frame rate by the clock; a frame that is late is left out.
    RealTime,
}

/// What an observer sees while the appliance runs.
#[derive(Clone, Copy, Debug, Default)]
pub struct Progress {
    /// As the PLC sees it.
    pub status: VisionStatus,
    /// The slowest frame so far, in the pipeline alone.
    pub frame_time_max: Duration,
}

/// A frame on its way.
struct Frame {
    pixels: Block<u8>,
    time: FrameTime,
    /// When it was exposed, by the clock that encoder counts are timed by.
    captured: Instant,
}

/// The appliance, before it runs.
pub struct Appliance {
    site: Site,
    pace: Pace,
    listener: std::net::TcpListener,
    journal: Journal,
}

/// What the threads share.
#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    source_ended: AtomicBool,
    vision_ended: AtomicBool,
    /// The thread that takes the frames, once it runs.
    vision: OnceLock<std::thread::Thread>,
    frames_dropped: AtomicU64,
    progress: Mutex<Progress>,
}

impl Shared {
    fn wake_vision(&self) {
        if let Some(vision) = self.vision.get() {
            vision.unpark();
        }
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn progress(&self) -> Progress {
        let mut progress = *self.progress.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        progress.status.source_ended = self.source_ended.load(Ordering::Relaxed);
        progress.status.frames_dropped = self.frames_dropped.load(Ordering::Relaxed);
        progress
    }
}

impl Appliance {
    /// Bind the PLC's socket, read what a PLC was told before; nothing runs yet.
    pub fn new(site: Site, pace: Pace) -> Result<Self> {
        let listener = modbus::bind(&site.config.modbus)?;
        let journal = site.config.plc.state_file.as_deref().map(Journal::open).transpose()?;
        Ok(Self { site, pace, listener, journal: journal.unwrap_or_default() })
    }

    /// Run until the source ends or `observe` returns false. `observe` is called a few times a
    /// second on the calling thread, with the records since its last call.
    pub fn run(
        self,
        source: &mut dyn FrameSource,
        mut observe: impl FnMut(&Progress, &mut dyn Iterator<Item = ParcelRecord>) -> bool,
    ) -> Result<Progress> {
        self.site.check_image_size(source.size_px())?;
        let config = self.site.config.clone();
        let (pace, listener, journal) = (self.pace, self.listener, self.journal);
        let encoder = config.encoder.mm_per_count.map(|mm| {
            let speed_max_mm_per_s = ENCODER_SPEED_MAX * config.belt.speed_mm_per_s;
            Encoder::new(mm, config.encoder.bits, config.encoder.timeout_s, speed_max_mm_per_s)
        });
        let (buffers, pipeline) = super::memory::build(self.site)?;
        realtime::lock_memory(&config.realtime)?;
        let shared = Shared::default();
        let (mut free, mut ready) =
            (Queue::<Block<u8>, FRAME_RING>::new(), Queue::<Frame, FRAME_RING>::new());
        let (mut to_plc, mut to_observer) = (
            Queue::<(ParcelRecord, f64), RECORD_RING>::new(),
            Queue::<ParcelRecord, RECORD_RING>::new(),
        );
        let (mut counts, mut requests) =
            (Queue::<(u32, Instant), COUNT_RING>::new(), Queue::<Request, REQUEST_RING>::new());
        let ((mut count_in, count_out), (mut request_in, request_out)) =
            (counts.split(), requests.split());
        let ((mut free_in, free_out), (ready_in, ready_out)) = (free.split(), ready.split());
        let ((plc_in, mut plc_out), (observer_in, mut observer_out)) =
            (to_plc.split(), to_observer.split());
        for buffer in buffers {
            // limits.frames_queued_max is below FRAME_RING.
            let _ = free_in.enqueue(buffer);
        }
        std::thread::scope(|scope| {
            let shared = &shared;
            // However this closure is left, the threads must end, or the scope waits for ever.
            let _stop = StopOnDrop(shared);
            let config = &config;
            let vision = Vision {
                pipeline,
                ready: ready_out,
                free: free_in,
                records: (plc_in, observer_in),
                encoder: encoder.map(|encoder| (encoder, Instant::now())),
                counts: count_out,
                requests: request_out,
                shared,
            };
            let vision = spawn(scope, "vision", move || vision.run_on(&config.realtime))?;
            let capture = Capture { source, pace, free: free_out, ready: ready_in, shared };
            let capture = spawn(scope, "capture", move || capture.run())?;
            let plc = spawn(scope, "plc", move || {
                let now = Instant::now();
                let encoder_timeout = config.encoder.mm_per_count.map(|_| config.encoder.timeout_s);
                let encoder_timeout = encoder_timeout.map(Duration::from_secs_f64);
                let mut can = CanLink::<CanFdSocket>::new(config.can.clone(), now);
                let sends = config.can.interface.is_some();
                let order = config.modbus.word_order;
                let link = Link::new(config.plc.clone(), order, sends, journal, now);
                let mut ended_at = None;
                modbus::serve(listener, &config.modbus, link, |link| {
                    // Asked before the ring is emptied: what came before the end is published.
                    let ended = shared.vision_ended.load(Ordering::Acquire);
                    while let Some((record, travel_mm)) = plc_out.dequeue() {
                        link.record(record, travel_mm);
                    }
                    let now = Instant::now();
                    if ended {
                        link.flush();
                        ended_at.get_or_insert(now);
                    }
                    link.update(&shared.progress().status, &can.status(), encoder_timeout, now);
                    can.step(link, now);
                    // A ring that is full has enough of them: vision has not looked for long.
                    while let Some(count) = link.next_count() {
                        let _ = count_in.enqueue(count);
                    }
                    while request_in.ready()
                        && let Some(request) = link.next_request()
                    {
                        let _ = request_in.enqueue(request);
                    }
                    let all_told = link.is_idle() && can.is_idle();
                    ended_at.is_none_or(|at| !all_told && now - at < FAREWELL)
                })
            })?;
            while !(capture.is_finished() || vision.is_finished() || plc.is_finished()) {
                std::thread::park_timeout(PARK);
                let mut records = std::iter::from_fn(|| observer_out.dequeue());
                if !observe(&shared.progress(), &mut records) {
                    break;
                }
            }
            // In the order of the flow, so that every frame and record arrives.
            shared.stop.store(true, Ordering::Relaxed);
            let captured = join(capture);
            let seen = join(vision);
            let served = join(plc);
            observe(&shared.progress(), &mut std::iter::from_fn(|| observer_out.dequeue()));
            captured.and(seen).and(served).map(|()| shared.progress())
        })
    }
}

/// Lets every thread end.
struct StopOnDrop<'a>(&'a Shared);

impl Drop for StopOnDrop<'_> {
    fn drop(&mut self) {
        self.0.stop.store(true, Ordering::Relaxed);
        self.0.source_ended.store(true, Ordering::Release);
        self.0.vision_ended.store(true, Ordering::Release);
    }
}

type Handle<'scope> = std::thread::ScopedJoinHandle<'scope, Result<()>>;

fn spawn<'scope, 'env>(
    scope: &'scope std::thread::Scope<'scope, 'env>,
    name: &str,
    body: impl FnOnce() -> Result<()> + Send + 'scope,
) -> Result<Handle<'scope>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn_scoped(scope, body)
        .map_err(|e| Error::failure(format!("cannot start the {name} thread: {e}")))
}

/// Wait for a thread; a panic in it is a broken invariant and goes on here.
fn join(handle: Handle<'_>) -> Result<()> {
    handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// The capture thread.
struct Capture<'a> {
    source: &'a mut dyn FrameSource,
    pace: Pace,
    free: Consumer<'a, Block<u8>>,
    ready: Producer<'a, Frame>,
    shared: &'a Shared,
}

impl Capture<'_> {
    fn run(mut self) -> Result<()> {
        let result = self.frames();
        self.shared.source_ended.store(true, Ordering::Release);
        self.shared.wake_vision();
        result
    }

    fn frames(&mut self) -> Result<()> {
        let start = Instant::now();
        let period_s = 1.0 / self.source.fps();
        let mut taken = 0u64;
        while !self.shared.stopped() {
            if self.pace == Pace::RealTime {
                taken += self.wait_until_due(start, taken, period_s);
            }
            let Some(mut pixels) = self.free.dequeue() else {
                self.drop_frames(1);
                taken += 1;
                if self.pace == Pace::Source {
                    std::thread::sleep(Duration::from_secs_f64(period_s));
                }
                continue;
            };
            let due = start + Duration::from_secs_f64(taken as f64 * period_s);
            let Some(time) = self.source.next_into(&mut pixels)? else { return Ok(()) };
            let captured = if self.pace == Pace::RealTime { due } else { Instant::now() };
            taken += 1;
            // There are no more frames than places in the ring.
            let _ = self.ready.enqueue(Frame { pixels, time, captured });
            self.shared.wake_vision();
        }
        Ok(())
    }

    /// Sleep until frame `taken` is due; frames that are over already are dropped and counted.
    fn wait_until_due(&mut self, start: Instant, taken: u64, period_s: f64) -> u64 {
        let due = start + Duration::from_secs_f64(taken as f64 * period_s);
        let now = Instant::now();
        if due > now {
            std::thread::sleep(due - now);
            return 0;
        }
        let late = ((now - due).as_secs_f64() / period_s) as u64;
        self.drop_frames(late);
        late
    }

    fn drop_frames(&mut self, count: u64) {
        if count > 0 {
            self.source.skip(count);
            self.shared.frames_dropped.fetch_add(count, Ordering::Relaxed);
        }
    }
}

/// The vision thread.
struct Vision<'a> {
    pipeline: Pipeline,
    ready: Consumer<'a, Frame>,
    free: Producer<'a, Block<u8>>,
    /// To the PLC, each with the belt's travel; and to the observer.
    records: (Producer<'a, (ParcelRecord, f64)>, Producer<'a, ParcelRecord>),
    /// With the instant that its time counts from.
    encoder: Option<(Encoder, Instant)>,
    counts: Consumer<'a, (u32, Instant)>,
    requests: Consumer<'a, Request>,
    shared: &'a Shared,
}

impl Vision<'_> {
    /// On a thread of its own, or, with several workers, on a pool of as many.
    fn run_on(mut self, settings: &Realtime) -> Result<()> {
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
            let Some(frame) = self.ready.dequeue() else {
                // Asked before the ring: what was captured before the end is processed.
                if self.shared.source_ended.load(Ordering::Acquire) && self.ready.is_empty() {
                    return Ok(());
                }
                std::thread::park_timeout(PARK);
                continue;
            };
            let began = Instant::now();
            self.obey();
            self.read_encoder(frame.captured);
            let raw = Plane::packed(&frame.pixels, width, height)
                .ok_or_else(|| Error::failure("a frame of another size"))?;
            let mut left = heapless::Vec::<ParcelRecord, RECORD_RING>::new();
            self.pipeline.step(raw, frame.time, &mut |record| {
                overflows += u64::from(left.push(record).is_err());
            })?;
            let travel_mm = self.pipeline.belt_position().travel_mm;
            let (plc, observer) = &mut self.records;
            for record in left {
                overflows += u64::from(plc.enqueue((record, travel_mm)).is_err());
                // An observer that does not look misses records; the PLC never does.
                let _ = observer.enqueue(record);
            }
            self.publish(frame.time.t_s, began.elapsed(), overflows);
            let _ = self.free.enqueue(frame.pixels);
        }
    }

    /// Do what the PLC asked for.
    fn obey(&mut self) {
        while let Some(request) = self.requests.dequeue() {
            match request {
                Request::Learn => self.pipeline.learn(),
                Request::Report(reporting) => self.pipeline.report_parcels(reporting),
            }
        }
    }

    /// Tell the pipeline where the belt was when a frame was exposed.
    fn read_encoder(&mut self, captured: Instant) {
        let Some((encoder, start)) = &mut self.encoder else { return };
        let seconds = |at: Instant| at.saturating_duration_since(*start).as_secs_f64();
        while let Some((count, at)) = self.counts.dequeue() {
            encoder.count(count, seconds(at));
        }
        if let Some(position_mm) = encoder.position_mm(seconds(captured)) {
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
        progress.frame_time_max = progress.frame_time_max.max(frame_time);
    }
}
