//! The appliance: capture, vision and PLC threads, with rings between them.
//!
//! ```text
//! source -> [ready ring] -> pipeline -> [records] -> link: Modbus, CAN
//!    ^------ [free ring] <-----'  ^  |     '-------> observer (console)
//!                                 |  '-- [shots] --> desk: page, archive -> fleet
//!                                 '--- [counts, requests] --- link -- [published] --> desk
//! ```
//! A frame buffer is always in exactly one place. When no buffer is free the frame is dropped
//! and counted; when a record ring is full the record is counted; vision never waits.

mod attendance;
mod capture;
mod plc;
mod vision;

use super::desk::{self, Desk, Insight, Papers, Rings};
use super::fleet::{self as fleet_side, Lane};
use super::memory::Carved;
use super::realtime;
use super::watchdog::{Beats, Watchdog};
use crate::belt::Encoder;
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::fleet;
use crate::plan::Block;
use crate::plc::clients::ClientList;
use crate::plc::command::Request;
use crate::plc::journal::Journal;
use crate::plc::link::Commanded;
use crate::plc::modbus;
use crate::plc::registers::{ImportStatus, VisionStatus};
use crate::source::{Feed, FeedStatus, Taken};
use crate::web::{self, Board};
use capture::Capture;
use heapless::spsc::Queue;
use plc::PlcThread;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, TryLockError};
use std::time::{Duration, Instant};
use vision::Vision;

/// Frame buffers that a ring holds: the largest `limits.frames_queued_max`, and one.
const FRAME_RING: usize = 16;
/// Records that wait for the PLC thread; at 2 ms a visit it is nearly always empty.
const RECORD_RING: usize = 64;
/// Stack of the threads for page and archive: locked memory counts all of it.
const SERVICE_STACK_BYTES: usize = 512 * 1024;
/// Encoder counts on their way to vision, and one: two frames at 1000 counts a second.
const COUNT_RING: usize = 128;
/// Requests on their way to vision, and one.
const REQUEST_RING: usize = 16;
/// Commands on their way to the desk, and one.
const COMMAND_RING: usize = 64;
/// How long a thread sleeps when a ring is empty and nobody has woken it.
const PARK: Duration = Duration::from_millis(50);
/// The ends of the threads are looked for this often.
const ENDING: Duration = Duration::from_millis(5);
/// The last parcels reach disk and CAN bus within this, or not at all.
const FAREWELL: Duration = Duration::from_secs(1);
/// An encoder that moves faster than the belt's nominal speed by this factor was set anew.
const ENCODER_SPEED_MAX: f64 = 5.0;

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
    taken: Taken,
}

/// What importing a configuration came to, from whoever knows to the PLC.
pub type ImportBoard = Arc<Mutex<ImportStatus>>;

/// The appliance, before it runs.
pub struct Appliance {
    site: Site,
    listener: std::net::TcpListener,
    journal: Journal,
    imports: ImportBoard,
    watchdog: Watchdog,
    page: Option<web::Listening>,
    keeper: Option<Arc<dyn web::Keeper>>,
}

/// What the threads share.
#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    source_ended: AtomicBool,
    vision_ended: AtomicBool,
    /// Vision and PLC have ended: nothing more comes to the desk.
    over: AtomicBool,
    /// The thread that makes pictures, once it runs.
    desk: OnceLock<std::thread::Thread>,
    /// The thread that takes the frames, once it runs.
    vision: OnceLock<std::thread::Thread>,
    /// Of the threads, for the watchdog.
    beats: Beats,
    frames_dropped: AtomicU64,
    frames_lost: AtomicU64,
    frames_torn: AtomicU64,
    frames_missing: AtomicBool,
    feed: Mutex<FeedStatus>,
    imports: ImportBoard,
    progress: Mutex<Progress>,
}

/// What is behind the locks, as it was known last.
#[derive(Clone, Copy, Debug, Default)]
struct Known {
    progress: Progress,
    feed: FeedStatus,
    import: ImportStatus,
}

/// Look at what is behind a lock, unless somebody holds it.
fn renew<T: Copy>(known: &mut T, mutex: &Mutex<T>) {
    match mutex.try_lock() {
        Ok(now) => *known = *now,
        Err(TryLockError::Poisoned(now)) => *known = *now.into_inner(),
        Err(TryLockError::WouldBlock) => {}
    }
}

/// The contents of a lock, whatever happened to who held it.
fn lock<T: Copy>(mutex: &Mutex<T>) -> T {
    *mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

impl Shared {
    fn wake_vision(&self) {
        if let Some(vision) = self.vision.get() {
            vision.unpark();
        }
    }

    fn wake_desk(&self) {
        if let Some(desk) = self.desk.get() {
            desk.unpark();
        }
    }

    fn end_all(&self) {
        self.stop.store(true, Ordering::Relaxed);
        self.over.store(true, Ordering::Release);
    }

    fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// For a thread that may wait.
    fn progress(&self) -> Progress {
        let (progress, feed) = (lock(&self.progress), lock(&self.feed));
        self.together(Known { progress, feed, import: lock(&self.imports) })
    }

    /// For a thread that waits for nobody: what is locked stays as it was known.
    fn renew(&self, known: &mut Known) {
        renew(&mut known.progress, &self.progress);
        renew(&mut known.feed, &self.feed);
        renew(&mut known.import, &self.imports);
    }

    fn together(&self, Known { mut progress, feed, import }: Known) -> Progress {
        let status = &mut progress.status;
        status.source_ended = self.source_ended.load(Ordering::Relaxed);
        status.frames_dropped = self.frames_dropped.load(Ordering::Relaxed) + feed.late;
        status.frames_lost = self.frames_lost.load(Ordering::Relaxed);
        status.frames_torn = self.frames_torn.load(Ordering::Relaxed);
        status.frames_missing = self.frames_missing.load(Ordering::Relaxed);
        (status.camera_absent, status.camera_losses) = (feed.absent, feed.losses);
        status.import = import;
        progress
    }
}

impl Appliance {
    /// Bind the PLC's socket, read what a PLC was told before; nothing runs yet.
    pub fn new(site: Site) -> Result<Self> {
        fleet_side::check(&site.config)?;
        let listener = modbus::bind(&site.config.modbus)?;
        let journal = site.config.plc.state_file.as_deref().map(Journal::open).transpose()?;
        let journal = journal.unwrap_or_default();
        let (imports, watchdog) = (ImportBoard::default(), Watchdog::default());
        // An address that is taken is no reason not to measure: it is told, and tried again.
        let page = site.config.web.enabled.then(|| web::listen(&site.config.web));
        Ok(Self { site, listener, journal, imports, watchdog, page, keeper: None })
    }

    /// Let whoever signs in to the page change the site.
    #[must_use]
    pub fn kept_by(mut self, keeper: Arc<dyn web::Keeper>) -> Self {
        self.keeper = Some(keeper);
        self
    }

    /// Where the page is served, if it is.
    pub fn page_address(&self) -> Option<std::net::SocketAddr> {
        self.page.as_ref()?.as_ref().ok()?.local_addr().ok()
    }

    /// Watch the threads, and tell the PLC of imports, which the observer puts on this board.
    #[must_use]
    pub fn supervised(mut self, watchdog: Watchdog) -> (Self, ImportBoard) {
        self.watchdog = watchdog;
        let imports = Arc::clone(&self.imports);
        (self, imports)
    }

    /// Run until the source ends or `observe` returns false. `observe` is called a few times a
    /// second on the calling thread, with the records since its last call.
    pub fn run(
        self,
        feed: &mut dyn Feed,
        mut observe: impl FnMut(&Progress, &mut dyn Iterator<Item = ParcelRecord>) -> bool,
    ) -> Result<Progress> {
        self.site.check_image_size(feed.size_px())?;
        let config = self.site.config.clone();
        let (listener, journal, mut watchdog) = (self.listener, self.journal, self.watchdog);
        let clients = ClientList::new(config.modbus.connections_max);
        let (papers, room) = (Papers::of(&self.site)?, clients.room());
        let insight = Arc::new(Insight::new(config.clone(), papers, feed.size_px(), room));
        let (page, keeper, board) = (self.page, self.keeper, desk::board());
        let encoder = encoder(&config);
        let Carved { buffers, pipeline, shots } = super::memory::carve(self.site)?;
        realtime::lock_memory(&config.realtime)?;
        let shared = Shared { imports: self.imports, ..Shared::default() };
        let (mut free, mut ready) =
            (Queue::<Block<u8>, FRAME_RING>::new(), Queue::<Frame, FRAME_RING>::new());
        let (mut to_plc, mut to_observer) = (
            Queue::<(ParcelRecord, f64), RECORD_RING>::new(),
            Queue::<ParcelRecord, RECORD_RING>::new(),
        );
        let (mut counts, mut requests) =
            (Queue::<(u32, Instant), COUNT_RING>::new(), Queue::<Request, REQUEST_RING>::new());
        let ((count_in, count_out), (request_in, request_out)) = (counts.split(), requests.split());
        let ((mut free_in, free_out), (ready_in, ready_out)) = (free.split(), ready.split());
        let ((plc_in, plc_out), (observer_in, mut observer_out)) =
            (to_plc.split(), to_observer.split());
        // Large: a shot holds all that is drawn into it.
        let mut rings = Box::new(Rings::new());
        let (photographer, album) = rings.split();
        let mut to_desk = Queue::<ParcelRecord, RECORD_RING>::new();
        let (published_in, published) = to_desk.split();
        let mut to_desk = Queue::<Commanded, COMMAND_RING>::new();
        let (commanded_in, commanded) = to_desk.split();
        for buffer in buffers {
            // limits.frames_queued_max is below FRAME_RING.
            let _ = free_in.enqueue(buffer);
        }
        std::thread::scope(|scope| {
            let (shared, config) = (&shared, &config);
            // However this closure is left, the threads must end, or the scope waits for ever.
            let stop = StopOnDrop { shared, board: &board };
            let mut services = Vec::new();
            if desk::shots::wanted(pipeline.site()) {
                let (insight, board) = (Arc::clone(&insight), Arc::clone(&board));
                let desk = Desk::new(
                    pipeline.site(),
                    shots,
                    album,
                    (published, commanded),
                    insight,
                    board,
                )?;
                let desk = move || {
                    shared.desk.get_or_init(std::thread::current);
                    desk.run(&|| shared.over.load(Ordering::Acquire));
                    Ok(())
                };
                services.push(spawn_service(scope, "desk", shared, desk)?);
            }
            services.extend(spawn_page(scope, config, page, (&board, &insight, keeper), shared)?);
            services.extend(spawn_fleet(scope, config, &insight, shared)?);
            let vision = Vision {
                pipeline,
                ready: ready_out,
                free: free_in,
                records: (plc_in, observer_in),
                encoder: encoder.map(|encoder| (encoder, Instant::now())),
                counts: count_out,
                requests: request_out,
                photographer,
                shared,
            };
            let vision = spawn(scope, "vision", move || vision.run_on(&config.realtime))?;
            let capture = Capture::new(feed, free_out, ready_in, shared);
            let capture = spawn(scope, "capture", move || capture.run())?;
            let plc = PlcThread {
                config,
                listener,
                clients,
                journal,
                records: plc_out,
                counts: count_in,
                requests: request_in,
                published: published_in,
                commanded: commanded_in,
                insight: Arc::clone(&insight),
                shared,
            };
            let plc = spawn(scope, "plc", move || plc.run())?;
            let measuring = [capture, vision, plc];
            while !measuring.iter().chain(&services).any(Handle::is_finished) {
                std::thread::park_timeout(PARK);
                watchdog.look(&shared.beats, [true; 3]);
                let mut records = std::iter::from_fn(|| observer_out.dequeue());
                if !observe(&shared.progress(), &mut records) {
                    break;
                }
            }
            let measured = end_in_order(measuring, &mut watchdog, shared);
            observe(&shared.progress(), &mut std::iter::from_fn(|| observer_out.dequeue()));
            watchdog.disarm();
            drop(stop);
            measured.and(services.into_iter().try_for_each(join)).map(|()| shared.progress())
        })
    }
}

fn encoder(config: &Config) -> Option<Encoder> {
    let encoder = &config.encoder;
    let speed_max_mm_per_s = ENCODER_SPEED_MAX * config.belt.speed_mm_per_s;
    let of = |mm| Encoder::new(mm, encoder.bits, encoder.timeout_s, speed_max_mm_per_s);
    encoder.mm_per_count.map(of)
}

/// Lets every thread end.
struct StopOnDrop<'a> {
    shared: &'a Shared,
    board: &'a Board,
}

impl Drop for StopOnDrop<'_> {
    fn drop(&mut self) {
        self.shared.end_all();
        self.shared.wake_desk();
        // However the desk has ended.
        self.board.close();
        self.shared.source_ended.store(true, Ordering::Release);
        self.shared.vision_ended.store(true, Ordering::Release);
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

/// Start a thread that nobody waits for. One that ends before all is over ends the run: a page or an
/// archive that is dead for good looks like one where nothing happens.
fn spawn_service<'scope, 'env>(
    scope: &'scope std::thread::Scope<'scope, 'env>,
    name: &'static str,
    shared: &'scope Shared,
    body: impl FnOnce() -> Result<()> + Send + 'scope,
) -> Result<Handle<'scope>> {
    let told = move || {
        realtime::stand_back();
        let ended = body();
        if shared.over.load(Ordering::Acquire) {
            return ended;
        }
        Err(ended.err().unwrap_or_else(|| Error::failure(format!("the {name} thread has ended"))))
    };
    std::thread::Builder::new()
        .name(name.to_owned())
        .stack_size(SERVICE_STACK_BYTES)
        .spawn_scoped(scope, told)
        .map_err(|e| Error::failure(format!("cannot start the {name} thread: {e}")))
}

/// Start the page's thread, if there is a page.
fn spawn_page<'scope>(
    scope: &'scope std::thread::Scope<'scope, '_>,
    config: &'scope Config,
    page: Option<web::Listening>,
    (board, insight, keeper): (&Arc<Board>, &Arc<Insight>, Option<Arc<dyn web::Keeper>>),
    shared: &'scope Shared,
) -> Result<Option<Handle<'scope>>> {
    let Some(page) = page else { return Ok(None) };
    let (insight, board) = (Arc::clone(insight), Arc::clone(board));
    let web = move || web::serve(&config.web, page, &board, insight, keeper);
    spawn_service(scope, "web", shared, web).map(Some)
}

/// Start the fleet's thread, if there is a fleet.
fn spawn_fleet<'scope>(
    scope: &'scope std::thread::Scope<'scope, '_>,
    config: &'scope Config,
    insight: &Arc<Insight>,
    shared: &'scope Shared,
) -> Result<Option<Handle<'scope>>> {
    let (Some(_), Some(folder)) = (config.fleet.broker, &config.archive.folder) else {
        return Ok(None);
    };
    let lane = Lane { insight: Arc::clone(insight), archive: folder.clone() };
    let lane: Arc<dyn fleet::Machine> = Arc::new(lane);
    let over = || shared.over.load(Ordering::Acquire);
    let fleet = move || fleet::serve(&config.fleet, folder, &lane, &over);
    spawn_service(scope, "fleet", shared, fleet).map(Some)
}

/// They end in the order of the flow, so that every frame and record arrives.
fn end_in_order(threads: [Handle<'_>; 3], watchdog: &mut Watchdog, shared: &Shared) -> Result<()> {
    shared.stop.store(true, Ordering::Relaxed);
    watch_the_end(threads.each_ref(), watchdog, &shared.beats);
    // Every one is joined, however the one before has ended.
    threads.map(join).into_iter().collect()
}

/// Watch the threads until all have ended.
fn watch_the_end(threads: [&Handle<'_>; 3], watchdog: &mut Watchdog, beats: &Beats) {
    loop {
        let alive = threads.map(|thread| !thread.is_finished());
        if alive == [false; 3] {
            return;
        }
        watchdog.look(beats, alive);
        std::thread::sleep(ENDING);
    }
}

/// Wait for a thread; a panic in it is a broken invariant and goes on here.
fn join(handle: Handle<'_>) -> Result<()> {
    handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_that_ends_before_all_is_over_ends_the_run() {
        let shared = Shared::default();
        std::thread::scope(|scope| {
            let ended = |result: Result<()>| {
                join(spawn_service(scope, "desk", &shared, || result).expect("starts"))
            };
            assert!(ended(Ok(())).is_err_and(|e| e.to_string().contains("the desk thread")));
            let failed = ended(Err(Error::failure("no more of it")));
            assert!(failed.is_err_and(|e| e.to_string().contains("no more of it")));
            shared.end_all();
            assert!(ended(Ok(())).is_ok());
        });
    }

    #[test]
    fn what_is_locked_stays_as_it_was_known_and_nobody_waits() {
        let (shared, mut known) = (Shared::default(), Known::default());
        lock_of(&shared.feed).losses = 1;
        shared.renew(&mut known);
        let mut held = (lock_of(&shared.feed), lock_of(&shared.progress), lock_of(&shared.imports));
        (held.0.losses, held.2.count) = (2, 9);
        // It would wait for ever.
        shared.renew(&mut known);
        assert_eq!((known.feed.losses, known.import.count), (1, 0));
        drop(held);
        shared.renew(&mut known);
        let status = shared.together(known).status;
        assert_eq!((status.camera_losses, status.import.count), (2, 9));
    }

    fn lock_of<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
        mutex.lock().expect("whole")
    }
}
