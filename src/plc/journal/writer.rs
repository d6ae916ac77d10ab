//! The thread that waits for the disk, so that nobody else does.

use super::slots::{self, Found, State};
use super::{Records, open_for_writing, prepare};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A disk that fails is tried again this often.
const RETRY: Duration = Duration::from_secs(1);
/// A disk that takes longer than this fails.
const PATIENCE: Duration = Duration::from_secs(2);

/// What is to be written.
#[derive(Clone, Debug)]
struct Snapshot {
    state: State,
    records: Records,
    noted: u64,
    /// Files whose contents are in it: see [`Writer::met`].
    met: u32,
}

/// What the thread and the journal share.
#[derive(Debug)]
struct Shared {
    /// The newest snapshot that was not taken yet, and whether the thread is to end.
    given: Mutex<(Option<Box<Snapshot>>, bool)>,
    wake: Condvar,
    /// What a file holds that was not there, or was another one, when the journal was opened.
    met: Mutex<Option<Box<Found>>>,
    /// How much of what was noted is on the disk.
    saved: AtomicU64,
    /// The last commit failed.
    failed: AtomicBool,
    /// When the commit that is under way began, ms since `start`; 0: none is.
    began_ms: AtomicU64,
    start: Instant,
}

/// The thread's handle.
#[derive(Debug)]
pub(super) struct Writer {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// `file`: none when it cannot be written at present. `read`: the generation of what the journal
    /// has read of it; none when it could not be read.
    pub(super) fn start(
        path: &Path,
        file: Option<File>,
        read: Option<u32>,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            given: Mutex::default(),
            wake: Condvar::new(),
            met: Mutex::default(),
            saved: AtomicU64::new(0),
            failed: AtomicBool::new(file.is_none()),
            began_ms: AtomicU64::new(0),
            start: Instant::now(),
        });
        let disk =
            Disk { path: path.to_owned(), file, generation: read, written: Records::new(), met: 0 };
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("journal".into())
            .spawn(move || write_all(&theirs, disk))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    pub(super) fn give(&self, state: &State, records: &Records, noted: u64, met: u32) {
        let snapshot = Snapshot { state: *state, records: records.clone(), noted, met };
        let mut given = self.shared.given.lock().unwrap_or_else(PoisonError::into_inner);
        given.0 = Some(Box::new(snapshot));
        self.shared.wake.notify_one();
    }

    /// What has turned up on the disk and must not be lost: once. Nothing is written until a snapshot
    /// comes that counts it.
    pub(super) fn met(&self) -> Option<Box<Found>> {
        self.shared.met.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    #[cfg(test)]
    pub(super) fn has_met(&self) -> bool {
        self.shared.met.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    pub(super) fn saved(&self) -> u64 {
        self.shared.saved.load(Ordering::Acquire)
    }

    /// Whether the last commit failed, or the present one takes too long.
    pub(super) fn is_failing(&self) -> bool {
        let began_ms = self.shared.began_ms.load(Ordering::Acquire);
        let now_ms = self.shared.start.elapsed().as_millis() as u64;
        let hangs = began_ms > 0 && now_ms > began_ms + PATIENCE.as_millis() as u64;
        hangs || self.shared.failed.load(Ordering::Acquire)
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.shared.given.lock().unwrap_or_else(PoisonError::into_inner).1 = true;
        self.shared.wake.notify_one();
        let hangs = self.is_failing();
        if let Some(thread) = self.thread.take().filter(|_| !hangs) {
            // What it was given is written; it has nothing else to say.
            let _ = thread.join();
        }
    }
}

/// The file, and what of it need not be written again.
struct Disk {
    path: PathBuf,
    file: Option<File>,
    /// Of the newest state in the file, as far as it is known.
    generation: Option<u32>,
    written: Records,
    /// Files that turned up.
    met: u32,
}

impl Disk {
    /// Open the file again, or for the first time. What it holds that this run did not write, nor
    /// read at its start, goes to the journal.
    fn open(&mut self, shared: &Shared) -> std::io::Result<File> {
        let file = open_for_writing(&self.path)?;
        // Whoever has taken it meanwhile keeps it.
        file.try_lock()?;
        let (file, found) = prepare(&self.path, file)?;
        let file = file.ok_or(std::io::ErrorKind::NotFound)?;
        let is_newer = |known: u32| slots::is_newer(found.generation, known);
        if found.state.is_some() && self.generation.is_none_or(is_newer) {
            tracing::warn!(
                path = %self.path.display(),
                "plc.state_file has turned up: what it holds is taken up"
            );
            self.met += 1;
            self.generation = Some(found.generation);
            *shared.met.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(found));
        } else if found.state.is_some() {
            // The last commit may not have come to be: the next one takes its slot.
            self.generation = Some(found.generation);
        }
        Ok(file)
    }

    fn write(&mut self, snapshot: &Snapshot, shared: &Shared) -> std::io::Result<()> {
        let file = match self.file.take() {
            Some(file) => file,
            None => self.open(shared)?,
        };
        let file = self.file.insert(file);
        if snapshot.met != self.met {
            return Err(std::io::Error::other("it holds what is to be taken up first"));
        }
        let is_new = |r: &&crate::event::ParcelRecord| !self.written.iter().any(|w| w.seq == r.seq);
        let generation = self.generation.unwrap_or(0).wrapping_add(1);
        let committed = slots::commit(
            file,
            snapshot.records.iter().filter(is_new),
            &snapshot.state,
            generation,
        );
        // Also when it failed: it may be there all the same.
        self.generation = Some(generation);
        match committed {
            Ok(()) => {
                self.written = snapshot.records.clone();
                Ok(())
            }
            Err(error) => {
                // Mounted again, it is another file.
                self.file = None;
                self.written = Records::new();
                Err(error)
            }
        }
    }
}

fn write_all(shared: &Shared, mut disk: Disk) {
    let mut unsaved: Option<Box<Snapshot>> = None;
    loop {
        let mut given = shared.given.lock().unwrap_or_else(PoisonError::into_inner);
        while given.0.is_none() && !given.1 {
            if unsaved.is_none() {
                given = shared.wake.wait(given).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            let (guard, waited) =
                shared.wake.wait_timeout(given, RETRY).unwrap_or_else(PoisonError::into_inner);
            given = guard;
            if waited.timed_out() {
                break;
            }
        }
        let (newest, ends) = (given.0.take(), given.1);
        drop(given);
        let Some(snapshot) = newest.or(unsaved.take()) else { return };
        let now_ms = shared.start.elapsed().as_millis() as u64;
        shared.began_ms.store(now_ms.max(1), Ordering::Release);
        let written = disk.write(&snapshot, shared);
        shared.began_ms.store(0, Ordering::Release);
        let failed_before = shared.failed.swap(written.is_err(), Ordering::AcqRel);
        match written {
            Ok(()) => {
                shared.saved.store(snapshot.noted, Ordering::Release);
                if failed_before {
                    tracing::warn!(path = %disk.path.display(), "plc.state_file is written again");
                }
            }
            Err(error) => {
                if !failed_before {
                    tracing::error!(path = %disk.path.display(), %error, "plc.state_file cannot be written");
                }
                unsaved = Some(snapshot);
                if ends {
                    return;
                }
                // New parcels do not make a broken disk busier.
                std::thread::sleep(RETRY);
            }
        }
    }
}
