//! What a PLC was told, kept over restarts: boots, the last parcels, what was acknowledged.
//!
//! A file is written beside the old one, brought to the disk and renamed over it, so that a power
//! cut leaves one or the other. A disk that fails is logged and does not stop the belt.

use super::link::QUEUE_PARCELS;
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// The file's content.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct State {
    boots: u16,
    acknowledged: u32,
    records: Vec<ParcelRecord>,
}

/// The journal, on a disk or in memory only.
#[derive(Debug, Default)]
pub struct Journal {
    path: Option<PathBuf>,
    state: State,
    changed: bool,
    failed: bool,
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
        let journal = Self { path: Some(path.to_owned()), state, changed: false, failed: false };
        journal.write(path).map_err(failure)?;
        Ok(journal)
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

    /// Note a parcel.
    pub fn note(&mut self, record: &ParcelRecord) {
        if self.state.records.len() == QUEUE_PARCELS {
            self.state.records.remove(0);
        }
        self.state.records.push(*record);
        self.changed = true;
    }

    /// Note an acknowledgment.
    pub fn acknowledge(&mut self, sequence: u32) {
        self.state.acknowledged = sequence;
        self.changed = true;
    }

    /// Bring what has changed to the disk.
    pub fn save(&mut self) {
        let Some(path) = self.path.as_ref().filter(|_| self.changed) else { return };
        let written = self.write(path);
        if let Err(error) = &written
            && !self.failed
        {
            tracing::error!(path = %path.display(), %error, "state file cannot be written");
        }
        (self.failed, self.changed) = (written.is_err(), false);
    }

    fn write(&self, path: &Path) -> std::io::Result<()> {
        let new = path.with_extension("new");
        let mut file = BufWriter::new(File::create(&new)?);
        serde_json::to_writer(&mut file, &self.state)?;
        file.into_inner()?.sync_all()?;
        std::fs::rename(&new, path)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
    }
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
        (1..=40).for_each(|seq| journal.note(&record(seq)));
        journal.acknowledge(30);
        journal.save();
        drop(journal); // as a kill does: nothing is written at the end
        let journal = Journal::open(&path).expect("writable");
        assert_eq!((journal.boots(), journal.sequence(), journal.acknowledged()), (2, 40, 30));
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
