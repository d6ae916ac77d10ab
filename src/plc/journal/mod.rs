//! What a PLC was told, kept over restarts: boots, the last parcels, what was acknowledged, the last
//! command.
//!
//! In: what is to be kept. Out: how much of it is on the disk. Owns: the parcels' numbers. A thread of
//! its own waits for the disk; what comes meanwhile is written together with the next commit.
//!
//! A number is never given twice. It is on the disk before anybody sees it. When the disk fails, the
//! belt goes on: numbers then come from another block, drawn at random, that no later run will reach
//! by counting on from what the disk has. The fault is told, and the disk is tried again every second.
//! A file that turns up then is taken up before it is written.
//!
//! Cost: one wait for the disk and two blocks written a parcel, and the same for an acknowledgment. A
//! parcel a second, each acknowledged, is 63 million commits or 0.5 TB in blocks of 4 KiB a year.

pub(crate) mod slots;
mod writer;

pub use slots::{Override, State};

use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::plc::link::QUEUE_PARCELS;
use heapless::Deque;
use slots::Found;
use std::fs::{File, OpenOptions};
use std::hash::{BuildHasher, RandomState};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::{Duration, Instant};
use writer::Writer;

/// A process that was killed lets go of the file within this.
const LOCK_PATIENCE: Duration = Duration::from_secs(2);
const LOCK_RETRY: Duration = Duration::from_millis(20);

/// Where numbers are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Keeping {
    /// In memory only: `plc.state_file` is not set.
    #[default]
    Memory,
    /// On the disk.
    Disk,
    /// The disk fails.
    Failing,
}

/// The last parcels, oldest first.
type Records = Deque<ParcelRecord, QUEUE_PARCELS>;

/// The journal, on a disk or in memory only.
#[derive(Debug, Default)]
pub struct Journal {
    state: State,
    records: Records,
    /// What was noted, counted, and how much of it was given to the writer.
    noted: u64,
    given: u64,
    /// Numbers come from a block that the disk knows nothing of.
    elsewhere: bool,
    /// Files that turned up after the start and were taken up.
    met: u32,
    writer: Option<Writer>,
}

impl Journal {
    /// Read what is there and count the boot. A disk that fails is told by [`Journal::keeping`] and is
    /// no error. A path that is no file, or a file that another process uses, is one.
    pub fn open(path: &Path) -> Result<Self> {
        let (file, found, read) = match open_file(path)? {
            Ok((file, found)) => {
                let read = Some(found.generation);
                (file, found, read)
            }
            Err(error) => {
                tracing::error!(path = %path.display(), %error, "plc.state_file cannot be used");
                (None, Found { damaged: true, ..Found::default() }, None)
            }
        };
        let mut journal = Self {
            state: State::default(),
            records: Records::new(),
            noted: 1,
            given: 0,
            elsewhere: found.damaged,
            met: 0,
            writer: None,
        };
        journal.take_up(found);
        journal.state.boots = journal.state.boots.wrapping_add(1);
        if journal.elsewhere {
            journal.state.sequence = another_block(journal.state.sequence, UNREAD_BLOCKS);
        }
        journal.writer = Some(
            Writer::start(path, file, read)
                .map_err(|e| Error::failure(format!("cannot start the journal's thread: {e}")))?,
        );
        journal.save();
        Ok(journal)
    }

    fn take_up(&mut self, found: Found) {
        self.state = found.state.unwrap_or_default();
        // A kill between a parcel and the state that counts it.
        let numbers = found.records.iter().map(|r| r.seq).chain(found.unknown.iter().copied());
        let ahead = |number: &u32| number.wrapping_sub(self.state.sequence);
        let newest = numbers.filter(|n| ahead(n) < AHEAD_MAX).max_by_key(ahead);
        self.state.sequence = newest.unwrap_or(self.state.sequence);
        let age = |number: u32| self.state.sequence.wrapping_sub(number);
        let mut records = found.records;
        records.retain(|record| age(record.seq) < u32::MAX / 2);
        records.sort_by_key(|record| age(record.seq));
        // The newest, also when the disk failed in between and they are of two blocks.
        records.truncate(QUEUE_PARCELS);
        for record in records.into_iter().rev() {
            let _ = self.records.push_back(record); // invariant: no more than there is room for
        }
        for number in found.unknown.iter().filter(|n| age(**n) < QUEUE_PARCELS as u32) {
            tracing::error!(number, "a parcel in plc.state_file is of another version: left out");
        }
    }

    /// Take up a file that could not be read at the start and has turned up since. What this run has
    /// given and was told goes on; numbers continue beyond both. Returns the parcels in it that
    /// nobody has acknowledged, oldest first, once.
    pub fn meet(&mut self) -> Option<Vec<ParcelRecord>> {
        let found = self.writer.as_ref()?.met()?;
        let (ours, our_records) = (self.state, std::mem::take(&mut self.records));
        self.take_up(*found);
        let theirs = self.state;
        let unacknowledged = self.records.iter().filter(|r| is_after(r.seq, theirs.acknowledged));
        let unacknowledged = unacknowledged.copied().collect();
        for record in our_records {
            if self.records.is_full() {
                self.records.pop_front();
            }
            let _ = self.records.push_back(record); // invariant: there is room
        }
        let first_block = another_block(theirs.sequence, 1) & 0xffff_0000;
        self.state = State {
            boots: theirs.boots.wrapping_add(1),
            sequence: if is_after(theirs.sequence, ours.sequence) {
                // An acknowledgment is of this block or of what this run has given so far.
                first_block | u32::from(ours.sequence as u16 ^ 0x8000)
            } else {
                ours.sequence
            },
            acknowledged: if ours.acknowledged == 0 {
                theirs.acknowledged
            } else {
                ours.acknowledged
            },
            sent: if ours.sent == 0 { theirs.sent } else { ours.sent },
            scale_interval_mm: ours.scale_interval_mm.or(theirs.scale_interval_mm),
            mm_per_count: ours.mm_per_count.or(theirs.mm_per_count),
            // A command of this run is newer.
            ..if ours.ticket == 0 { theirs } else { ours }
        };
        self.met += 1;
        self.noted += 1;
        Some(unacknowledged)
    }

    /// What is kept besides the parcels.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The last parcels, oldest first.
    pub fn records(&self) -> &Records {
        &self.records
    }

    /// Where it is kept.
    pub fn keeping(&self) -> Keeping {
        match &self.writer {
            None => Keeping::Memory,
            Some(writer) if writer.is_failing() => Keeping::Failing,
            Some(_) => Keeping::Disk,
        }
    }

    /// Give a parcel its number, the disk failing or not. Once [`Journal::is_kept`] says so of what is
    /// returned with it, no restart forgets it.
    pub fn number(&mut self, mut record: ParcelRecord, failing: bool) -> (ParcelRecord, u64) {
        if failing && !self.elsewhere {
            self.state.sequence = another_block(self.state.sequence, 1);
        }
        self.elsewhere = failing;
        // 0 is no parcel.
        self.state.sequence = self.state.sequence.wrapping_add(1).max(1);
        record.seq = self.state.sequence;
        if self.records.is_full() {
            self.records.pop_front();
        }
        let _ = self.records.push_back(record); // invariant: there is room
        self.noted += 1;
        (record, self.noted)
    }

    /// Take back the newest `count` numbers: nobody has seen them, and it is not known whether the disk
    /// has them.
    pub fn take_back(&mut self, count: usize) {
        for _ in 0..count {
            self.records.pop_back();
        }
    }

    /// Whether the last number is of a block that the disk knows nothing of.
    pub fn is_elsewhere(&self) -> bool {
        self.elsewhere
    }

    /// Whether the disk fails at this moment. Another thread finds that out: whoever does several
    /// things by it asks once.
    pub fn is_failing(&self) -> bool {
        self.keeping() == Keeping::Failing
    }

    /// Change the state. Returns a number for [`Journal::is_kept`].
    pub fn change(&mut self, change: impl FnOnce(&mut State)) -> u64 {
        change(&mut self.state);
        self.noted += 1;
        self.noted
    }

    /// Note that a parcel was sent over CAN. It is written with what comes next: after a restart the
    /// last ones are sent again anyway.
    pub fn sent(&mut self, sequence: u32) {
        self.state.sent = sequence;
    }

    /// Note that nobody need acknowledge a parcel. It is written with what comes next.
    pub fn taken(&mut self, sequence: u32) {
        self.state.acknowledged = sequence;
    }

    /// Have the disk take what was noted; does not wait for it.
    pub fn save(&mut self) {
        if self.given < self.noted
            && let Some(writer) = &self.writer
        {
            writer.give(&self.state, &self.records, self.noted, self.met);
            self.given = self.noted;
        }
    }

    /// Whether what was noted is on the disk; in memory only, it is as good as that.
    pub fn is_on_disk(&self, noted: u64) -> bool {
        self.writer.as_ref().is_none_or(|writer| noted <= writer.saved())
    }

    /// Whether what was noted is as safe as it gets: on the disk, or the disk fails.
    pub fn is_kept(&self, noted: u64) -> bool {
        self.is_on_disk(noted) || self.is_failing()
    }
}

impl Drop for Journal {
    /// What was to be written with what comes next.
    fn drop(&mut self) {
        self.noted += 1;
        self.save();
    }
}

/// Parcels that a commit may write before the state that counts them, and one.
const AHEAD_MAX: u32 = QUEUE_PARCELS as u32 + 1;

/// A run that could not read its file begins this many blocks on: it is beyond what a parcel a second
/// has counted to in eight years, and within reach of [`is_after`].
const UNREAD_BLOCKS: u32 = 0x1000;

/// Another block of 2^16 numbers, at least `blocks` further on, drawn at random, half a turn away in
/// its low word: an acknowledgment, which is a low word, is of one block or the other and never of both.
fn another_block(sequence: u32, blocks: u32) -> u32 {
    let random = RandomState::new().hash_one(Instant::now()) as u32;
    // Less than half of all numbers on, so that what comes later is later.
    sequence.wrapping_add((blocks + random % 0x3fff) << 16) ^ 0x8000
}

/// Whether sequence number `a` was given after `b`, numbers wrapping around.
pub(super) fn is_after(a: u32, b: u32) -> bool {
    a != b && a.wrapping_sub(b) < u32::MAX / 2
}

/// A file, if it may be written, and what it holds.
type Opened = std::io::Result<(Option<File>, Found)>;

/// Open and lock a file, or say why the disk does not let us. The outer error is the owner's mistake.
fn open_file(path: &Path) -> Result<Opened> {
    let file = match open_for_writing(path) {
        Ok(file) => file,
        // What cannot be written can perhaps be read.
        Err(error) => match File::open(path) {
            Ok(file) if file.metadata().is_ok_and(|m| m.is_file()) => {
                lock(&file, path)?;
                tracing::error!(path = %path.display(), %error, "plc.state_file cannot be written");
                return Ok(slots::read(&file).map(|found| (None, found)));
            }
            _ => return Ok(Err(error)),
        },
    };
    let is_file = file.metadata().map(|m| m.is_file());
    if !is_file.unwrap_or(false) {
        return Err(Error::configuration("plc.state_file is no regular file")
            .in_file(path)
            .allowed("a file, or a name that is not taken in an existing folder")
            .remedy("choose another name"));
    }
    lock(&file, path)?;
    Ok(prepare(path, file))
}

fn open_for_writing(path: &Path) -> std::io::Result<File> {
    let mut options = OpenOptions::new();
    // Opening a pipe would wait for ever.
    let no_wait = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    options.read(true).write(true).create(true).truncate(false).custom_flags(no_wait).open(path)
}

/// Two processes would give the same numbers.
fn lock(file: &File, path: &Path) -> Result<()> {
    let begun = Instant::now();
    while file.try_lock().is_err() {
        if begun.elapsed() > LOCK_PATIENCE {
            return Err(Error::configuration("plc.state_file is used by another process")
                .in_file(path)
                .allowed("a file for this process alone")
                .remedy("end the other process, or give each a file of its own"));
        }
        std::thread::sleep(LOCK_RETRY);
    }
    Ok(())
}

/// Read a file, and give it its blocks if it is new. One that is no journal is set aside as
/// `.damaged`.
fn prepare(path: &Path, file: File) -> Opened {
    let found = slots::read(&file)?;
    if found.damaged {
        let aside = path.with_extension("damaged");
        tracing::error!(
            path = %path.display(), aside = %aside.display(),
            "plc.state_file is damaged: set aside; numbers go on in another block"
        );
        std::fs::rename(path, aside)?;
        let file = open_for_writing(path)?;
        file.try_lock()?;
        slots::allocate(&file)?;
        return Ok((Some(file), found));
    }
    if file.metadata()?.len() < slots::FILE_BYTES as u64 {
        // New, or killed when it was: nothing has been numbered yet.
        slots::allocate(&file)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        File::open(folder.unwrap_or(Path::new(".")))?.sync_all()?;
    }
    Ok((Some(file), found))
}

#[cfg(test)]
mod tests;
