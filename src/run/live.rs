//! `beltgauge run`: the appliance on a live camera, until it is told to stop.

use super::{Appliance, ImportBoard, Keeper, Progress, Watchdog, log, memory, syslog};
use crate::config::{Can, Site};
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::plc::interface;
use crate::plc::registers::ImportStatus;
use crate::source::{Feed, Live, Recorder, check_interface, open_camera};
use crate::store::{ImportRecord, Store};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Status file and imports are looked after this often.
const HOUSEKEEPING: Duration = Duration::from_secs(1);

/// What to run.
#[derive(Clone, Debug)]
pub struct Options<'a> {
    /// Configuration file; none given: the one in force in the store.
    pub config: Option<&'a Path>,
    /// Store of configurations.
    pub store: &'a Path,
    /// File to write the state to, every second.
    pub status: Option<&'a Path>,
    /// The hardware's watchdog.
    pub watchdog: Option<&'a Path>,
    /// Y4M file to record the frames to.
    pub record: Option<&'a Path>,
}

/// Run until SIGTERM or SIGINT; parcels that are inside then are lost.
pub fn run(options: &Options<'_>) -> Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop))
            .map_err(|e| Error::failure(format!("cannot wait for signals: {e}")))?;
    }
    let store = Store::new(options.store);
    if options.config.is_none() {
        store.settle();
    }
    let mut site = options.config.map_or_else(|| store.site(), Site::load)?;
    // To the end: then the last lines are sent.
    let _collector = site.config.log.syslog.map(syslog::start).transpose()?;
    check_interface(site.config.camera.interface)?;
    if options.config.is_none() {
        site.config.plc.state_file.get_or_insert_with(|| store.plc_state());
        site.config.archive.folder.get_or_insert_with(|| store.archive());
    }
    let can = CanSetUp { settings: site.config.can.clone(), done: None, complaint: None };
    let camera = site.config.camera.clone();
    let mut live = Live::new(camera, site.camera.image_size_px, open_camera);
    let mut recorder = None;
    let feed: &mut dyn Feed = match options.record {
        None => &mut live,
        Some(path) => {
            let mib = memory::room_for_recorder(&site)?;
            recorder.insert(Recorder::create(&mut live, path, mib)?)
        }
    };
    let listen = site.config.modbus.listen;
    let watchdog = Watchdog::new(options.watchdog)?;
    let (mut appliance, imports) = Appliance::new(site)?.supervised(watchdog);
    if options.config.is_none() {
        match Keeper::new(store.clone(), Arc::clone(&stop)) {
            Ok(keeper) => appliance = appliance.kept_by(Arc::new(keeper)),
            // A disk that is full or read-only is no reason not to measure.
            Err(e) => tracing::warn!("nothing can be changed through the page: {e}"),
        }
    }
    tracing::info!("measuring; Modbus TCP on {listen}");
    let seen_last = Arc::<Mutex<Progress>>::default();
    let housekeeping = Housekeeping {
        can,
        imports,
        store,
        status: options.status.map(Path::to_owned),
        progress: Arc::clone(&seen_last),
        log_lines_dropped: 0,
    };
    housekeeping.start()?;
    let mut seen = false;
    let result = appliance.run(feed, |progress, records| {
        records.for_each(|record| log_parcel(&record));
        if !seen && progress.status.counters.frames > 0 {
            seen = true;
            tracing::info!("the first frame was processed");
        }
        *seen_last.lock().unwrap_or_else(PoisonError::into_inner) = *progress;
        !stop.load(Ordering::Relaxed)
    });
    // However it ended: the recording may show why.
    if let Some(recorder) = recorder {
        match recorder.finish() {
            Ok(recorded) => tracing::info!("{recorded}"),
            Err(e) => tracing::error!("{e}"),
        }
    }
    tracing::info!("stopped; {}", result?.status.counters);
    Ok(())
}

/// What touches disks and interfaces now and then: on a thread of its own, which nobody waits for.
struct Housekeeping {
    can: CanSetUp,
    imports: ImportBoard,
    store: Store,
    status: Option<PathBuf>,
    progress: Arc<Mutex<Progress>>,
    log_lines_dropped: u64,
}

impl Housekeeping {
    fn start(mut self) -> Result<()> {
        tell(&self.imports, self.store.last_import());
        std::thread::Builder::new()
            .name("housekeeping".into())
            .spawn(move || {
                loop {
                    self.look();
                    std::thread::sleep(HOUSEKEEPING);
                }
            })
            .map(drop)
            .map_err(|e| Error::failure(format!("cannot start the housekeeping thread: {e}")))
    }

    fn look(&mut self) {
        self.can.try_now();
        tell(&self.imports, self.store.last_import());
        let dropped = log::lines_dropped();
        if dropped > self.log_lines_dropped {
            tracing::warn!("{dropped} log lines were dropped since start: nobody reads them");
            self.log_lines_dropped = dropped;
        }
        if let Some(path) = &self.status {
            let progress = *self.progress.lock().unwrap_or_else(PoisonError::into_inner);
            write_status(path, &progress);
        }
    }
}

/// The CAN interface, which may be plugged in later than the power, and again.
struct CanSetUp {
    settings: Can,
    /// The kernel's number of the interface that was set up.
    done: Option<u32>,
    complaint: Option<String>,
}

impl CanSetUp {
    fn try_now(&mut self) {
        let index = interface::index(&self.settings);
        if index.is_some() && index == self.done {
            return;
        }
        match interface::set_up(&self.settings) {
            Ok(()) => self.done = index,
            Err(e) => {
                // Once, not every second.
                let complaint = Some(e.to_string());
                if self.complaint != complaint {
                    tracing::error!("{e}");
                    self.complaint = complaint;
                }
            }
        }
    }
}

fn tell(board: &ImportBoard, ImportRecord { count, result }: ImportRecord) {
    let status = ImportStatus { count, result: result as u16 };
    *board.lock().unwrap_or_else(PoisonError::into_inner) = status;
}

fn log_parcel(record: &ParcelRecord) {
    tracing::info!(
        seq = record.seq,
        length_mm = record.length_mm,
        width_mm = record.width_mm,
        height_mm = record.height_mm,
        flags = %record.flags,
        "parcel"
    );
}

/// The status file.
#[derive(Serialize)]
struct StatusFile {
    version: &'static str,
    ready: bool,
    camera_absent: bool,
    camera_losses: u64,
    frames: u64,
    frames_dropped: u64,
    frames_lost: u64,
    frames_torn: u64,
    parcels: u64,
    belt_speed_mm_per_s: f64,
    belt_measured: bool,
    time_s: f64,
    frame_time_max_ms: f64,
    log_lines_dropped: u64,
    imports: u16,
    import_result: u16,
    camera_watch: u16,
    camera_moved_px: f64,
    camera_error_mm: f64,
    blur_px: Option<f64>,
    light_region: u16,
    light_change: f64,
}

/// Written beside and renamed, so that a reader sees all of it. One that cannot be written is no
/// reason to stop measuring.
fn write_status(path: &Path, progress: &Progress) {
    let status = &progress.status;
    let file = StatusFile {
        version: env!("CARGO_PKG_VERSION"),
        ready: status.ready,
        camera_absent: status.camera_absent,
        camera_losses: status.camera_losses,
        frames: status.counters.frames,
        frames_dropped: status.frames_dropped,
        frames_lost: status.frames_lost,
        frames_torn: status.frames_torn,
        parcels: status.counters.parcels,
        belt_speed_mm_per_s: status.belt_speed_mm_per_s,
        belt_measured: status.belt_measured,
        time_s: status.time_s,
        frame_time_max_ms: progress.frame_time_max.as_secs_f64() * 1e3,
        log_lines_dropped: log::lines_dropped(),
        imports: status.import.count,
        import_result: status.import.result,
        camera_watch: status.health.camera_watch,
        camera_moved_px: status.health.camera_moved_px,
        camera_error_mm: status.health.camera_error_mm,
        blur_px: status.health.blur_px,
        light_region: status.health.light_region,
        light_change: status.health.light_change,
    };
    let mut new = path.as_os_str().to_owned();
    new.push(".new");
    let new = PathBuf::from(new);
    let written = serde_json::to_string(&file)
        .map_err(std::io::Error::from)
        .and_then(|line| std::fs::write(&new, line + "\n"))
        .and_then(|()| std::fs::rename(&new, path));
    if let Err(e) = written {
        tracing::warn!("the status file {} cannot be written: {e}", path.display());
    }
}
