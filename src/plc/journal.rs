//! What a PLC was told, kept over restarts: boots, the last parcels, what was acknowledged.
//!
//! A file is written beside the old one, brought to the disk and renamed over it, so that a power
//! cut leaves one or the other. A thread of its own does so: what waits for the disk would make
//! encoder counts late. A disk that fails is logged and does not stop the belt.

use super::link::QUEUE_PARCELS;
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::thread::JoinHandle;

/// The file's content.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct State {
    boots: u16,
    acknowledged: u32,
    sent: u32,
    records: Vec<ParcelRecord>,
}

/// The journal, on a disk or in memory only.
#[derive(Debug, Default)]
pub struct Journal {
    state: State,
    /// What was noted, counted, and how much of it was given to the writer.
    noted: u64,
    given: u64,
    writer: Option<Writer>,
}

/// The thread that waits for the disk, so that nobody else does.
#[derive(Debug)]
struct Writer {
    /// Ends the thread when it is dropped.
    states: Option<Sender<(State, u64)>>,
    /// How much of what was noted is on the disk.
    saved: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Journal {
    /// Read what is there and count the boot. A file that cannot be read is set aside as
    /// `.damaged`, and numbering begins anew.
    pub fn open(path: &Path) -> Result<Self> {
        let failure = |e: std::io::Error| {
            Error::failure(format!("plc.state_file cannot be written: {e}"))
                .in_file(path)
                .remedy("give a file in an existing folder that the process may write")
        };
        let mut state = match std::fs::read(path) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => State::default(),
            Err(e) => return Err(failure(e)),
            Ok(bytes) => match serde_json::from_slice::<State>(&bytes) {
                Ok(state) => state,
                Err(e) => {
                    tracing::error!(path = %path.display(), error = %e, "state file set aside");
                    std::fs::rename(path, path.with_extension("damaged")).map_err(failure)?;
                    State::default()
                }
            },
        };
        let surplus = state.records.len().saturating_sub(QUEUE_PARCELS);
        state.records.drain(..surplus);
        state.boots = state.boots.wrapping_add(1);
        write(path, &state).map_err(failure)?;
        let writer = Some(Writer::start(path.to_owned()).map_err(failure)?);
        Ok(Self { state, noted: 0, given: 0, writer })
    }

    /// Starts of the appliance.
    pub fn boots(&self) -> u16 {
        self.state.boots
    }

    /// Sequence number of the latest parcel.
    pub fn sequence(&self) -> u32 {
        self.state.records.last().map_or(0, |record| record.seq)
    }

    /// Sequence number up to which parcels were acknowledged.
    pub fn acknowledged(&self) -> u32 {
        self.state.acknowledged
    }

    /// The last parcels, oldest first.
    pub fn records(&self) -> &[ParcelRecord] {
        &self.state.records
    }

    /// Sequence number up to which parcels were sent over CAN.
    pub fn sent(&self) -> u32 {
        self.state.sent
    }

    /// Note a parcel. Returns a number: once [`Journal::saved`] has reached it, no restart forgets it.
    pub fn note(&mut self, record: &ParcelRecord) -> u64 {
        if self.state.records.len() == QUEUE_PARCELS {
            self.state.records.remove(0);
        }
        self.state.records.push(*record);
        self.noted += 1;
        self.noted
    }

    /// Note an acknowledgment.
    pub fn acknowledge(&mut self, sequence: u32) {
        self.state.acknowledged = sequence;
        self.noted += 1;
    }

    /// Note that a parcel was sent over CAN.
    pub fn send(&mut self, sequence: u32) {
        self.state.sent = sequence;
        self.noted += 1;
    }

    /// Have the disk take what was noted; does not wait for it.
    pub fn save(&mut self) {
        let Some(states) = self.writer.as_ref().and_then(|writer| writer.states.as_ref()) else {
            return;
        };
        if self.given < self.noted && states.send((self.state.clone(), self.noted)).is_ok() {
            self.given = self.noted;
        }
    }

    /// How much of what was noted is on the disk; in memory only, all of it is as safe as it gets.
    pub fn saved(&self) -> u64 {
        self.writer.as_ref().map_or(u64::MAX, |writer| writer.saved.load(Ordering::Acquire))
    }
}

impl Writer {
    fn start(path: PathBuf) -> std::io::Result<Self> {
        let (states, incoming) = channel::<(State, u64)>();
        let saved = Arc::<AtomicU64>::default();
        let done = Arc::clone(&saved);
        let mut failed = false;
        let thread = std::thread::Builder::new().name("journal".into()).spawn(move || {
            while let Ok(first) = incoming.recv() {
                // Of several states that wait, the last says it all.
                let (state, noted) = incoming.try_iter().last().unwrap_or(first);
                let written = write(&path, &state);
                if let Err(error) = &written
                    && !failed
                {
                    tracing::error!(path = %path.display(), %error, "state file cannot be written");
                }
                failed = written.is_err();
                // The belt goes on without a disk.
                done.store(noted, Ordering::Release);
            }
        })?;
        Ok(Self { states: Some(states), saved, thread: Some(thread) })
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.states = None;
        if let Some(thread) = self.thread.take() {
            // What it was given is written; it has nothing else to say.
            let _ = thread.join();
        }
    }
}

fn write(path: &Path, state: &State) -> std::io::Result<()> {
    let new = path.with_extension("new");
    let mut file = BufWriter::new(File::create(&new)?);
    serde_json::to_writer(&mut file, state)?;
    file.into_inner()?.sync_all()?;
    std::fs::rename(&new, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::record;

    fn folder(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("beltgauge-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).expect("writable");
        folder
    }

    #[test]
    fn a_restart_continues_where_the_last_run_ended_and_counts_itself() {
        let path = folder("journal").join("state.json");
        let mut journal = Journal::open(&path).expect("writable");
        assert_eq!((journal.boots(), journal.sequence()), (1, 0));
        let mut last = 0;
        (1..=40).for_each(|seq| last = journal.note(&record(seq)));
        assert!(journal.saved() < last, "nobody was told to save");
        journal.acknowledge(30);
        journal.send(35);
        journal.save();
        while journal.saved() < last {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        std::mem::forget(journal); // as a kill does: nothing is written at the end
        let journal = Journal::open(&path).expect("writable");
        assert_eq!((journal.boots(), journal.sequence()), (2, 40));
        assert_eq!((journal.acknowledged(), journal.sent()), (30, 35));
        assert!(journal.records().iter().map(|r| r.seq).eq(9..=40));
        assert_eq!(journal.records()[0], record(9));
    }

    #[test]
    fn a_damaged_file_is_set_aside_and_one_that_cannot_be_written_is_an_error() {
        let folder = folder("damaged");
        let path = folder.join("state.json");
        for damaged in [&b""[..], b"{\"boots\":1", &[0xff; 64]] {
            std::fs::write(&path, damaged).expect("writable");
            assert_eq!(Journal::open(&path).expect("writable").boots(), 1);
            assert_eq!(std::fs::read(folder.join("state.damaged")).expect("kept"), damaged);
        }
        let error = Journal::open(&folder.join("not/there.json")).expect_err("no folder");
        assert!(error.to_string().contains("plc.state_file"), "{error}");
    }
}
