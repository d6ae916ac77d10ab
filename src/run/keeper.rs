//! The site, changed through the page: a browser brings what a stick would.
//!
//! ```text
//! page -> tray (a folder like a stick's) -> `beltgauge import`, a child process -> store -> restart
//! ```
//! There is one way into the store, with one set of checks: signatures, limits, calibration, roll back. The
//! child keeps a solver's memory and time away from the process that measures.

use crate::error::{Error, Result};
use crate::sandbox;
use crate::store::stick::{BELT_FOLDER, FOLDER, LENS_FOLDER, STILLS_MAX, is_plain_name};
use crate::store::{Session, Store, files};
use crate::web::{Change, Work, WorkState};
use crate::{config, web};
use std::fs::{self, File};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Bytes of all files on the tray: 60 stills of two megapixels.
const TRAY_BYTES_MAX: u64 = 144 << 20;
/// Files on it.
const TRAY_FILES_MAX: usize = 2 * STILLS_MAX + 8;
/// The tray leaves this much of its disk free, beside what it takes: the import copies the stills.
const FREE_BYTES_MIN: u64 = 64 << 20;
/// An import that takes longer is ended. Calibrating takes seconds a still on a small machine.
const IMPORT_MAX: Duration = Duration::from_mins(15);
/// The import's end is looked for this often.
const IMPORT_POLL: Duration = Duration::from_millis(50);
/// What it says is told up to this length.
const REPORT_BYTES_MAX: u64 = 64 << 10;
/// The page has this long to see how an import has ended, before the program ends.
const FAREWELL: Duration = Duration::from_secs(2);

/// Changes the site, for whoever has signed in.
pub struct Keeper {
    store: Store,
    tray: Mutex<Tray>,
    session: Mutex<Option<Session>>,
    work: Arc<Mutex<Work>>,
    /// Set to end the program, which whoever supervises it starts again: with the new site.
    end: Arc<AtomicBool>,
}

/// Files on their way into the store.
struct Tray {
    root: PathBuf,
    files: usize,
    bytes: u64,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Keeper {
    /// Of a store that is there. `end` is set once another site is in force.
    ///
    /// # Errors
    /// When the store cannot be written: then nobody could sign in.
    pub fn new(store: Store, end: Arc<AtomicBool>) -> Result<Self> {
        store.code()?;
        let meta = fs::metadata(store.root()).map_err(|e| {
            Error::failure(format!("cannot read the folder: {e}")).in_file(store.root())
        })?;
        // Always the same of one store, so that what was left before is found.
        let name = format!("beltgauge-tray-{:x}-{:x}", meta.dev(), meta.ino());
        let mut tray = Tray { root: std::env::temp_dir().join(name), files: 0, bytes: 0 };
        tray.clear()?;
        let session = Mutex::new(store.session());
        Ok(Self { store, tray: Mutex::new(tray), session, work: Arc::default(), end })
    }
}

impl web::Keeper for Keeper {
    fn sign_in(&self, code: &str) -> std::result::Result<Option<String>, String> {
        let signed_in = self.store.sign_in(code).map_err(|e| e.to_string())?;
        Ok(signed_in.map(|(secret, session)| {
            *lock(&self.session) = Some(session);
            secret
        }))
    }

    fn is_signed_in(&self, secret: &str) -> bool {
        lock(&self.session).as_ref().is_some_and(|session| session.is_of(secret))
    }

    fn sign_out(&self) -> std::result::Result<(), String> {
        *lock(&self.session) = None;
        self.store.sign_out().map_err(|e| e.to_string())
    }

    fn site(&self) -> web::Site {
        let text = fs::read_to_string(self.store.config()).ok();
        let camera = text.as_deref().and_then(|text| {
            let config = config::Config::parse(text).ok()?;
            let file = config.camera.calibration;
            let bytes = self.store.file_in_force(&file)?;
            let text = String::from_utf8(bytes).ok()?;
            Some(web::SiteFile { name: file.to_str()?.to_owned(), text })
        });
        web::Site {
            configuration: text,
            camera,
            can_go_back: self.store.can_go_back(),
            imports: self.store.last_import().count,
            report: self.store.last_report(),
            work: lock(&self.work).clone(),
        }
    }

    fn clear(&self) -> std::result::Result<(), String> {
        if lock(&self.work).state == WorkState::Busy {
            return Err(BUSY.to_owned());
        }
        lock(&self.tray).clear().map_err(|e| e.to_string())
    }

    fn put(&self, path: &str, bytes: &[u8]) -> std::result::Result<(), String> {
        if lock(&self.work).state == WorkState::Busy {
            return Err(BUSY.to_owned());
        }
        lock(&self.tray).put(path, bytes).map_err(|e| e.to_string())
    }

    fn change(&self, change: Change) -> std::result::Result<(), String> {
        let mut work = lock(&self.work);
        if work.state == WorkState::Busy {
            return Err(BUSY.to_owned());
        }
        let mut tray = lock(&self.tray);
        if change == Change::GoBack {
            tray.clear().map_err(|e| e.to_string())?;
        }
        let (tray, before) = (tray.root.clone(), self.store.in_force());
        let child = start(&self.store, &tray, change).map_err(|e| e.to_string())?;
        *work = Work { change: Some(change), state: WorkState::Busy, ..Work::default() };
        drop(work);
        let job = Job {
            before,
            store: self.store.clone(),
            tray,
            work: Arc::clone(&self.work),
            end: Arc::clone(&self.end),
        };
        std::thread::Builder::new()
            .name("keeper".into())
            .stack_size(STACK_BYTES)
            .spawn(move || job.finish(child))
            .map(drop)
            .map_err(|e| {
                *lock(&self.work) = Work::default();
                format!("cannot start a thread: {e}")
            })
    }
}

/// On the tray, beside the folder: what the import says.
const SAID: &str = "said.txt";
const BUSY: &str = "another change is at work: wait for it";
/// Stack of the thread that waits for an import: locked memory counts all of it.
const STACK_BYTES: usize = 128 << 10;

impl Tray {
    /// Empty it.
    fn clear(&mut self) -> Result<()> {
        files::remove(&self.root).map_err(|e| self.failed(&e))?;
        (self.files, self.bytes) = (0, 0);
        // Nobody else can have made it, or look into it.
        let mut private = fs::DirBuilder::new();
        private.mode(0o700);
        for folder in [self.root.clone(), self.folder()] {
            private.create(&folder).map_err(|e| self.failed(&e))?;
        }
        for name in [LENS_FOLDER, BELT_FOLDER] {
            private.create(self.folder().join(name)).map_err(|e| self.failed(&e))?;
        }
        Ok(())
    }

    fn folder(&self) -> PathBuf {
        self.root.join(FOLDER)
    }

    /// Put a file on it: `NAME`, `lens/NAME` or `belt/NAME`.
    fn put(&mut self, path: &str, bytes: &[u8]) -> Result<()> {
        let (folder, name) = path.split_once('/').unwrap_or(("", path));
        let is_ours = ["", LENS_FOLDER, BELT_FOLDER].contains(&folder);
        if !is_ours || !is_plain_name(Path::new(name)) || name.starts_with('.') || name.len() > 100
        {
            return Err(Error::configuration("no file of that name is taken")
                .allowed("a plain name, alone or behind lens/ or belt/"));
        }
        let len = bytes.len() as u64;
        if self.bytes + len > TRAY_BYTES_MAX || self.files == TRAY_FILES_MAX {
            return Err(Error::configuration("this is too much")
                .allowed(format!("{TRAY_FILES_MAX} files, {} MiB together", TRAY_BYTES_MAX >> 20))
                .remedy("keep fewer stills, or bring them on a stick"));
        }
        let folder = self.folder().join(folder);
        let disk = rustix::fs::statvfs(&folder).map_err(|e| self.failed(&e.into()))?;
        if disk.f_bavail * disk.f_frsize < 2 * len + FREE_BYTES_MIN {
            return Err(Error::failure("there is no room for more")
                .in_file(&self.root)
                .remedy("keep fewer stills, or bring them on a stick"));
        }
        files::replace(&folder.join(name), bytes).map_err(|e| self.failed(&e))?;
        self.files += 1;
        self.bytes += len;
        Ok(())
    }

    fn failed(&self, e: &std::io::Error) -> Error {
        Error::failure(format!("the files cannot be put there: {e}")).in_file(&self.root)
    }
}

/// Start the program over again, to do what it would do for a stick.
fn start(store: &Store, tray: &Path, change: Change) -> Result<Child> {
    let failed = |e: std::io::Error| Error::failure(format!("cannot start the import: {e}"));
    let said = File::create(tray.join(SAID)).map_err(failed)?;
    let mut command = Command::new(sandbox::program());
    command.arg("import").arg("--store").arg(store.root());
    match change {
        Change::Check => command.arg(tray).arg("--check"),
        Change::Apply => command.arg(tray),
        Change::GoBack => command.arg("--roll-back"),
    };
    let child = command
        .env_clear()
        .stdin(Stdio::null())
        .stdout(said.try_clone().map_err(failed)?)
        .stderr(said)
        .spawn()
        .map_err(failed)?;
    // When memory runs out it goes first.
    let _ = fs::write(format!("/proc/{}/oom_score_adj", child.id()), "1000");
    Ok(child)
}

/// An import that is at work.
struct Job {
    store: Store,
    tray: PathBuf,
    /// What was in force.
    before: Option<PathBuf>,
    work: Arc<Mutex<Work>>,
    end: Arc<AtomicBool>,
}

impl Job {
    /// Wait for its end and tell what it came to.
    fn finish(self, child: Child) {
        let ended = end_of(child);
        let report = files::read(&self.tray.join(SAID), REPORT_BYTES_MAX).unwrap_or_default();
        // Where the tray is says nothing to a visitor.
        let tray = format!("{}/", self.tray.display());
        let mut report = String::from_utf8_lossy(&report).replace(&tray, "");
        let is_good = ended.is_some_and(|status| status.success());
        if ended.is_none() {
            report.push_str("error: it took too long, and was ended\n");
        }
        // What was taken needs no room any more.
        let is_checked = lock(&self.work).change == Some(Change::Check);
        if is_good && !is_checked {
            let _ = files::remove(&self.tray.join(FOLDER));
        }
        let restarts = self.store.in_force() != self.before;
        {
            let mut work = lock(&self.work);
            work.state = if is_good { WorkState::Good } else { WorkState::Bad };
            (work.report, work.restarts) = (report, restarts);
        }
        if restarts {
            tracing::info!("another configuration is in force: the program starts again");
            std::thread::sleep(FAREWELL);
            self.end.store(true, Ordering::Relaxed);
        }
    }
}

/// How it has ended; `None`: it was ended.
fn end_of(mut child: Child) -> Option<ExitStatus> {
    let until = Instant::now() + IMPORT_MAX;
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Some(status),
            Ok(None) if Instant::now() < until => std::thread::sleep(IMPORT_POLL),
            _ => {
                let _ = child.kill();
                let _ = child.wait();
                return None;
            }
        }
    }
}
