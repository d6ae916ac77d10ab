//! The archive's writer: a thread of its own behind a bounded ring.

use super::segment::{self, Ending, HEAD_BYTES, Head, PART_BYTES_MAX, Segment, Sum, entries_max};
use super::{Entry, Kind};
use crate::error::{Error, Result};
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Entries that wait for the disk.
const RING: usize = 64;
/// What was written reaches the disk within this.
const SYNC_PERIOD: Duration = Duration::from_secs(1);
/// A disk that takes longer than this for an entry hangs.
const HANGS: Duration = Duration::from_secs(3);
/// A disk that failed is tried again after this.
const RETRY: Duration = Duration::from_secs(2);
/// A segment has at most this share of the archive, and at most so many bytes: it goes as a whole.
const SEGMENTS_MIN: u64 = 8;
const SEGMENT_BYTES_MAX: u64 = 8 << 20;
/// So much of the disk is left to others, who keep what matters more: this share, within these bounds.
/// What they need does not grow with the disk, so a large disk that others fill is not full for the archive.
const LEFT_SHARE: u64 = 10;
const LEFT_BYTES_MIN: u64 = 24 << 20;
const LEFT_BYTES_MAX: u64 = 256 << 20;
/// A file takes at least a block of the disk.
const BLOCK_BYTES: u64 = 4096;

/// How the archive is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Condition {
    /// Entries written since start.
    pub written: u64,
    /// Entries that were not: the ring was full, or the disk failed.
    pub lost: u64,
    /// On the disk.
    pub bytes: u64,
    /// It takes no more.
    pub bytes_max: u64,
    /// Why it cannot be written at present.
    pub fault: Option<String>,
    /// What was found damaged since start: the chain goes on behind it.
    pub damaged: Option<String>,
}

impl Condition {
    /// Whether somebody should look after it.
    pub fn is_bad(&self) -> bool {
        self.lost > 0 || self.fault.is_some() || self.damaged.is_some()
    }
}

/// A disk's size and what is free on it, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Space {
    pub(super) all: u64,
    pub(super) free: u64,
}

/// How a folder's disk is asked.
pub(super) type AskSpace = fn(&Path) -> io::Result<Space>;

fn ask_disk(folder: &Path) -> io::Result<Space> {
    let disk = rustix::fs::statvfs(folder)?;
    Ok(Space { all: disk.f_blocks * disk.f_frsize, free: disk.f_bavail * disk.f_frsize })
}

impl Space {
    fn has_room_for(self, bytes: u64) -> bool {
        self.free >= bytes + (self.all / LEFT_SHARE).clamp(LEFT_BYTES_MIN, LEFT_BYTES_MAX)
    }
}

/// What writer and owner share.
#[derive(Debug, Default)]
struct Shared {
    written: AtomicU64,
    lost: AtomicU64,
    bytes: AtomicU64,
    fault: Mutex<Option<String>>,
    damaged: Mutex<Option<String>>,
    /// Since when the writer waits for the disk.
    waits: Mutex<Option<Instant>>,
}

impl Shared {
    fn hangs(&self) -> bool {
        lock(&self.waits).is_some_and(|since| since.elapsed() > HANGS)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The archive, being written.
#[derive(Debug)]
pub struct Archive {
    entries: SyncSender<Entry>,
    ended: Receiver<()>,
    shared: Arc<Shared>,
    bytes_max: u64,
}

impl Archive {
    /// Start its writer. A folder that cannot be written is tried again and again.
    pub fn start(folder: &Path, bytes_max: u64) -> Result<Self> {
        Self::start_on(folder, bytes_max, ask_disk)
    }

    /// The same on a disk that is asked like this.
    pub(super) fn start_on(folder: &Path, bytes_max: u64, space: AskSpace) -> Result<Self> {
        let (entries, to_write) = sync_channel(RING);
        let (end, ended) = sync_channel(1);
        let shared = Arc::<Shared>::default();
        let writer = Writer {
            folder: folder.to_owned(),
            bytes_max,
            space,
            shared: Arc::clone(&shared),
            open: None,
            retry_at: None,
            told: 0,
            newest_ms: 0,
        };
        std::thread::Builder::new()
            .name("archive".into())
            .spawn(move || {
                let _ = rustix::process::setpriority_process(
                    Some(rustix::thread::gettid()),
                    super::NICE,
                );
                writer.run(&to_write);
                let _ = end.send(());
            })
            .map_err(|e| Error::failure(format!("cannot start the archive's thread: {e}")))?;
        Ok(Self { entries, ended, shared, bytes_max })
    }

    /// Have an entry written, or counted when too many wait.
    pub fn put(&self, entry: Entry) {
        if self.entries.try_send(entry).is_err() {
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// How it is.
    pub fn condition(&self) -> Condition {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Condition {
            written: count(&self.shared.written),
            lost: count(&self.shared.lost),
            bytes: count(&self.shared.bytes),
            bytes_max: self.bytes_max,
            fault: if self.shared.hangs() {
                Some("the disk does not answer".to_owned())
            } else {
                lock(&self.shared.fault).clone()
            },
            damaged: lock(&self.shared.damaged).clone(),
        }
    }

    /// Write what waits; a disk that hangs is left behind after `patience`.
    pub fn finish(self, patience: Duration) {
        drop(self.entries);
        let _ = self.ended.recv_timeout(patience);
    }
}

struct Writer {
    folder: PathBuf,
    bytes_max: u64,
    space: AskSpace,
    shared: Arc<Shared>,
    open: Option<Open>,
    retry_at: Option<Instant>,
    /// Of the entries lost, those that the chain tells of.
    told: u64,
    /// Time of the newest entry that came.
    newest_ms: u64,
}

/// The archive while the disk obeys.
struct Open {
    /// Held by one process.
    _lock: File,
    /// Bytes of every segment, oldest first.
    segments: Vec<(u64, u64)>,
    /// The newest, if it is written to.
    file: Option<File>,
    /// Number of the next entry.
    next: u64,
    sum: Sum,
    unsynced: Option<Instant>,
    /// What was found damaged, and is not told in the chain yet.
    damaged: Option<String>,
}

impl Writer {
    fn run(mut self, entries: &Receiver<Entry>) {
        loop {
            let wait = self
                .open
                .as_ref()
                .and_then(|open| open.unsynced)
                .map_or(RETRY, |since| SYNC_PERIOD.saturating_sub(since.elapsed()));
            let received = entries.recv_timeout(wait);
            *lock(&self.shared.waits) = Some(Instant::now());
            match received {
                Ok(entry) => self.take(&entry),
                Err(RecvTimeoutError::Timeout) => self.idle(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
            // Also when entries come without a pause.
            self.sync(SYNC_PERIOD);
            *lock(&self.shared.waits) = None;
        }
        self.tell_lost();
        self.sync(Duration::ZERO);
    }

    /// At the end: what was lost since the last entry.
    fn tell_lost(&mut self) {
        if self.retry_at.is_none()
            && let Err(e) = self.write_gap()
        {
            self.fail(&e);
        }
    }

    fn take(&mut self, entry: &Entry) {
        self.newest_ms = entry.utc_ms;
        if self.retry_at.is_some_and(|at| Instant::now() < at) {
            return self.lose();
        }
        match self.write(entry) {
            Ok(()) => {
                self.shared.written.fetch_add(1, Ordering::Relaxed);
                self.heal();
            }
            Err(e) => {
                // Who sees the count sees the reason.
                self.fail(&e);
                self.lose();
            }
        }
    }

    /// Nothing comes: see whether the disk is back.
    fn idle(&mut self) {
        if self.open.is_none() && self.retry_at.is_none_or(|at| Instant::now() >= at) {
            match self.opened() {
                Ok(_) => self.heal(),
                Err(e) => self.fail(&e),
            }
        }
    }

    fn lose(&self) {
        self.shared.lost.fetch_add(1, Ordering::Relaxed);
    }

    fn fail(&mut self, error: &io::Error) {
        self.retry_at = Some(Instant::now() + RETRY);
        // What is on the disk is found out anew.
        self.open = None;
        let mut fault = lock(&self.shared.fault);
        let text = error.to_string();
        if fault.as_deref() != Some(&text) {
            tracing::error!(folder = %self.folder.display(), %error, "the archive cannot be written");
            *fault = Some(text);
        }
    }

    fn heal(&mut self) {
        self.retry_at = None;
        let mut fault = lock(&self.shared.fault);
        if fault.take().is_some() {
            tracing::info!(folder = %self.folder.display(), "the archive is written again");
        }
    }

    fn opened(&mut self) -> io::Result<&mut Open> {
        let open = match self.open.take() {
            Some(open) => open,
            None => Open::new(&self.folder)?,
        };
        if open.damaged.is_some() {
            lock(&self.shared.damaged).clone_from(&open.damaged);
        }
        self.shared.bytes.store(open.bytes(), Ordering::Relaxed);
        Ok(self.open.insert(open))
    }

    fn write(&mut self, entry: &Entry) -> io::Result<()> {
        if entry.text.len().max(entry.picture.len()) > PART_BYTES_MAX {
            return Err(io::Error::new(ErrorKind::InvalidInput, "an entry is too large"));
        }
        self.write_gap()?;
        self.append(entry)
    }

    /// Tell in the chain what was lost, on the way to the disk and before it, or damaged on it, and not
    /// told yet.
    fn write_gap(&mut self) -> io::Result<()> {
        let lost = self.shared.lost.load(Ordering::Relaxed);
        let untold = lost - self.told;
        let damaged = self.opened()?.damaged.clone();
        if untold == 0 && damaged.is_none() {
            return Ok(());
        }
        let text = serde_json::json!({ "lost": untold, "damaged": damaged }).to_string();
        let (kind, utc_ms) = (Kind::Gap, self.newest_ms);
        self.append(&Entry { kind, utc_ms, text, picture: Vec::new() })?;
        self.told = lost;
        self.opened()?.damaged = None;
        Ok(())
    }

    fn append(&mut self, entry: &Entry) -> io::Result<()> {
        let limits = (self.bytes_max, self.space);
        let folder = self.folder.clone();
        let open = self.opened()?;
        open.append(&folder, limits, entry)?;
        let bytes = open.bytes();
        self.shared.bytes.store(bytes, Ordering::Relaxed);
        Ok(())
    }

    fn sync(&mut self, period: Duration) {
        let Some(open) = &mut self.open else { return };
        if open.unsynced.is_some_and(|since| since.elapsed() >= period) {
            open.unsynced = None;
            if let Err(e) = open.file.as_ref().map_or(Ok(()), File::sync_data) {
                self.fail(&e);
            }
        }
    }
}

impl Open {
    fn new(folder: &Path) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        let path = folder.join("lock");
        let lock = OpenOptions::new().create(true).truncate(false).write(true).open(path)?;
        if lock.try_lock().is_err() {
            let text =
                "another process writes the archive: end it, or give each a folder of its own";
            return Err(io::Error::new(ErrorKind::ResourceBusy, text));
        }
        let listed = segment::list(folder)?;
        let size = |path: &Path| fs::metadata(path).map(|m| m.len());
        let mut segments = Vec::with_capacity(listed.len());
        for (first, path) in &listed {
            segments.push((*first, size(path)?));
        }
        let TakenUp { file, next, sum, damaged } = take_up(&listed, &mut segments)?;
        let name =
            |path: &PathBuf| path.file_name().map(|name| name.to_string_lossy().into_owned());
        let damaged = damaged.as_ref().and_then(name);
        Ok(Self { _lock: lock, segments, file, next, sum, unsynced: None, damaged })
    }

    fn bytes(&self) -> u64 {
        self.segments.iter().map(|(_, bytes)| (*bytes).max(BLOCK_BYTES)).sum()
    }

    fn append(
        &mut self,
        folder: &Path,
        (bytes_max, space): (u64, AskSpace),
        entry: &Entry,
    ) -> io::Result<()> {
        let (bytes, sum) = segment::encode(entry, self.next, &self.sum);
        let segment_max = (bytes_max / SEGMENTS_MIN).min(SEGMENT_BYTES_MAX);
        let used = self.segments.last().map_or(0, |(_, bytes)| *bytes);
        if self.file.is_none() || used + bytes.len() as u64 > segment_max.max(HEAD_BYTES as u64 * 2)
        {
            // A full disk has no room for the head either.
            self.make_room(folder, (bytes_max, space), (bytes.len() + HEAD_BYTES) as u64)?;
            self.begin(folder)?;
        }
        self.make_room(folder, (bytes_max, space), bytes.len() as u64)?;
        let (Some(file), Some((_, used))) = (&mut self.file, self.segments.last_mut()) else {
            return Err(io::Error::other("no segment"));
        };
        if let Err(e) = file.write_all(&bytes) {
            // Half an entry is none. If that fails too, the next start passes over it.
            let _ = file.set_len(*used);
            return Err(e);
        }
        *used += bytes.len() as u64;
        self.sum = sum;
        self.next += 1;
        self.unsynced.get_or_insert_with(Instant::now);
        Ok(())
    }

    /// Begin a new segment.
    fn begin(&mut self, folder: &Path) -> io::Result<()> {
        if let Some(file) = self.file.take() {
            file.sync_data()?;
        }
        let path = segment::path(folder, self.next);
        let mut file = OpenOptions::new().append(true).create_new(true).open(&path)?;
        let head = Head { first: self.next, before: self.sum };
        let begun = file.write_all(&head.bytes()).and_then(|()| file.sync_data());
        if let Err(e) = begun.and_then(|()| File::open(folder)?.sync_all()) {
            let _ = fs::remove_file(&path);
            return Err(e);
        }
        self.segments.push((self.next, HEAD_BYTES as u64));
        self.file = Some(file);
        Ok(())
    }

    /// The oldest go, but never the one that is written.
    fn make_room(
        &mut self,
        folder: &Path,
        (bytes_max, space): (u64, AskSpace),
        bytes: u64,
    ) -> io::Result<()> {
        loop {
            let has_room = space(folder)?.has_room_for(bytes);
            if has_room && self.bytes() + bytes <= bytes_max {
                return Ok(());
            }
            if self.segments.len() <= 1 {
                let text = "the disk is nearly full: what is left is for what matters more";
                return if has_room {
                    Ok(())
                } else {
                    Err(io::Error::new(ErrorKind::StorageFull, text))
                };
            }
            let (first, _) = self.segments[0];
            fs::remove_file(segment::path(folder, first))?;
            self.segments.remove(0);
        }
    }
}

/// Where the chain goes on.
struct TakenUp {
    /// The newest segment, if it can be gone on with.
    file: Option<File>,
    next: u64,
    sum: Sum,
    damaged: Option<PathBuf>,
}

/// How far a segment is whole.
enum Look {
    /// Begun when the power went: nothing was in it.
    Empty,
    /// Up to the number that comes next, with the sum up to there.
    Whole { next: u64, sum: Sum, bytes: u64, ending: Ending },
    /// Not even its head.
    Damaged,
}

fn look(first: u64, path: &Path, length: u64) -> io::Result<Look> {
    let Some(mut segment) = Segment::open(path)? else {
        // The head reaches the disk before any entry does.
        return Ok(if length > HEAD_BYTES as u64 { Look::Damaged } else { Look::Empty });
    };
    if segment.head.first != first {
        return Ok(Look::Damaged);
    }
    let (mut sum, mut next, mut bytes) = (segment.head.before, first, HEAD_BYTES as u64);
    let ending = loop {
        match segment.next(&sum) {
            Ok(Some((head, _, [written, comes_out]))) => {
                if written != comes_out || head.number != next {
                    break Ending::Damaged;
                }
                (sum, next, bytes) = (written, next + 1, segment.offset);
            }
            Ok(None) => break segment.ending(next, length).unwrap_or(Ending::Damaged),
            // A sector that cannot be read.
            Err(_) => break Ending::Damaged,
        }
    };
    Ok(Look::Whole { next, sum, bytes, ending })
}

/// The chain goes on in the newest segment if that is whole, else in a new one. What is damaged stays as
/// it is, to be found by whoever verifies, and no number that may be in it is given again.
fn take_up(listed: &[(u64, PathBuf)], segments: &mut Vec<(u64, u64)>) -> io::Result<TakenUp> {
    let mut damaged: Option<PathBuf> = None;
    let mut next_min = 1;
    for (first, path) in listed.iter().rev() {
        let length = fs::metadata(path)?.len();
        let looked = look(*first, path, length).unwrap_or_else(|error| {
            tracing::error!(path = %path.display(), %error, "a segment of the archive cannot be read");
            Look::Damaged
        });
        let is_damaged =
            matches!(looked, Look::Damaged | Look::Whole { ending: Ending::Damaged, .. });
        if is_damaged {
            tracing::error!(path = %path.display(), "a segment of the archive is damaged");
            damaged.get_or_insert_with(|| path.clone());
        }
        match looked {
            Look::Empty => {
                tracing::warn!(path = %path.display(), "a segment of the archive was just begun");
                fs::remove_file(path)?;
                segments.retain(|(known, _)| known != first);
            }
            Look::Damaged => {
                next_min = next_min.max(first.saturating_add(1 + entries_max(length)));
            }
            Look::Whole { next, sum, bytes, ending } => {
                if ending == Ending::Damaged {
                    let lost = 1 + entries_max(length.saturating_sub(bytes));
                    next_min = next_min.max(next.saturating_add(lost));
                }
                let is_newest = damaged.is_none();
                // A segment of its name would begin with the same entry.
                let is_torn_off = ending == Ending::Torn && next == *first && is_newest;
                let mut file = None;
                if is_newest && (ending == Ending::Whole || is_torn_off) {
                    let opened = OpenOptions::new().append(true).open(path)?;
                    opened.set_len(bytes)?;
                    segments
                        .iter_mut()
                        .filter(|(known, _)| known == first)
                        .for_each(|s| s.1 = bytes);
                    file = Some(opened);
                }
                return Ok(TakenUp { file, next: next.max(next_min), sum, damaged });
            }
        }
    }
    Ok(TakenUp { file: None, next: next_min, sum: Sum::default(), damaged })
}
