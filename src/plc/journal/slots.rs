//! The journal's file: slots of a fixed size at fixed places, each with a check sum.
//!
//! The file is written whole once. After that slots are overwritten where they are, so that a disk
//! without room does no harm, and a commit costs the blocks that it changes and one wait for the disk.
//! The state has two slots that take turns; a parcel's slot follows from its number. A power cut in
//! the middle of a commit leaves the state before it, and the parcels that were published.

use crate::event::ParcelRecord;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{Error, ErrorKind, Read};
use std::os::unix::fs::FileExt;

/// Bytes of a slot.
const SLOT_BYTES: usize = 512;
/// The two slots of the state are on pages of their own: a torn page damages one.
const STATE_STRIDE: usize = 4096;
const STATES: usize = 2;
/// More than are ever shown again, so that a torn slot is one of no use any more. A divisor of
/// 2^16, so that the places go on where the numbers do.
const RECORDS: usize = 64;
const RECORDS_START: usize = STATES * STATE_STRIDE;
/// Bytes of the file.
pub const FILE_BYTES: usize = RECORDS_START + RECORDS * SLOT_BYTES;
/// Magic with the layout's version, kind, payload bytes, number, check sum.
const HEAD_BYTES: usize = 16;
const MAGIC: [u8; 4] = *b"BGJ1";
const STATE: u8 = 1;
const RECORD: u8 = 2;

/// A value that a command has set in place of the configuration's. It holds while the configuration
/// says the same as it did then.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Override {
    /// What the configuration said.
    pub configured: f64,
    /// What the command said.
    pub set: f64,
}

impl Override {
    /// The value that holds, given what the configuration says now.
    pub fn of(value: Option<Self>, configured: f64) -> f64 {
        // Both were read from the same text, if nothing has changed.
        value
            .filter(|v| v.configured.to_bits() == configured.to_bits())
            .map_or(configured, |v| v.set)
    }
}

/// What is kept besides the parcels. New fields go to the end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// Starts of the appliance.
    pub boots: u16,
    /// Number of the latest parcel.
    pub sequence: u32,
    /// Number up to which parcels were acknowledged.
    pub acknowledged: u32,
    /// Number up to which parcels were sent over CAN.
    pub sent: u32,
    /// The last command: ticket, code, argument, and what became of it.
    pub ticket: u16,
    /// See [`crate::plc::command::COMMANDS`].
    pub command: u16,
    /// Of the command.
    pub argument: u32,
    /// See [`crate::plc::command::Outcome`].
    pub outcome: u16,
    /// Parcels are not reported, by command.
    pub stopped: bool,
    /// Scale interval, mm.
    pub scale_interval_mm: Option<Override>,
    /// Belt travel of an encoder's count, mm.
    pub mm_per_count: Option<Override>,
}

/// What a file holds.
#[derive(Debug, Default)]
pub struct Found {
    /// The newest state that is whole; none: the file is new, or damaged.
    pub state: Option<State>,
    /// Generation of that state.
    pub generation: u32,
    /// Every parcel that is whole, in no order.
    pub records: Vec<ParcelRecord>,
    /// Numbers of parcels that are whole but of a form that this program does not know.
    pub unknown: Vec<u32>,
    /// There is something that is no slot of a journal.
    pub damaged: bool,
}

/// Read a file. Slots that are not whole are left out.
pub fn read(mut file: &File) -> std::io::Result<Found> {
    let mut bytes = Vec::with_capacity(FILE_BYTES);
    Read::by_ref(&mut file).take(FILE_BYTES as u64).read_to_end(&mut bytes)?;
    Ok(parse(&bytes))
}

/// Read the bytes of a file.
pub fn parse(bytes: &[u8]) -> Found {
    let mut found = Found::default();
    let slot = |at: usize| bytes.get(at..at + SLOT_BYTES).unwrap_or_default();
    for i in 0..STATES {
        let Some((generation, payload)) = open(slot(i * STATE_STRIDE), STATE) else { continue };
        let newer = found.state.is_none() || is_newer(generation, found.generation);
        if let Ok((state, _)) = postcard::take_from_bytes(payload)
            && newer
        {
            (found.state, found.generation) = (Some(state), generation);
        }
    }
    for i in 0..RECORDS {
        let Some((number, payload)) = open(slot(RECORDS_START + i * SLOT_BYTES), RECORD) else {
            continue;
        };
        match postcard::take_from_bytes::<ParcelRecord>(payload) {
            Ok((record, _)) => found.records.push(ParcelRecord { seq: number, ..record }),
            Err(_) => found.unknown.push(number),
        }
    }
    found.damaged = found.state.is_none() && bytes.iter().any(|byte| *byte != 0);
    found
}

/// Whether a generation came after another, both wrapping around.
pub fn is_newer(generation: u32, than: u32) -> bool {
    generation != than && generation.wrapping_sub(than) < 1 << 31
}

/// The number and the payload of a slot that is whole.
fn open(slot: &[u8], kind: u8) -> Option<(u32, &[u8])> {
    let (head, rest) = slot.split_at_checked(HEAD_BYTES)?;
    let long = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    let payload = rest.get(..usize::from(u16::from_le_bytes([head[6], head[7]])))?;
    let whole =
        head[..4] == MAGIC && head[4] == kind && long(12) == check_sum(&head[..12], payload);
    whole.then(|| (long(8), payload))
}

fn check_sum(head: &[u8], payload: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(head);
    hasher.update(payload);
    hasher.finalize()
}

fn close(kind: u8, number: u32, value: &impl Serialize) -> std::io::Result<[u8; SLOT_BYTES]> {
    let mut slot = [0; SLOT_BYTES];
    let (head, rest) = slot.split_at_mut(HEAD_BYTES);
    let too_long = |e| Error::new(ErrorKind::InvalidData, format!("a slot is too short: {e}"));
    let length = postcard::to_slice(value, rest).map_err(too_long)?.len();
    head[..4].copy_from_slice(&MAGIC);
    head[4] = kind;
    head[6..8].copy_from_slice(&(length as u16).to_le_bytes());
    head[8..12].copy_from_slice(&number.to_le_bytes());
    let sum = check_sum(&head[..12], &rest[..length]);
    head[12..].copy_from_slice(&sum.to_le_bytes());
    Ok(slot)
}

/// Give a new file its size, in blocks that the disk has set aside.
pub fn allocate(file: &File) -> std::io::Result<()> {
    file.write_all_at(&vec![0; FILE_BYTES], 0)?;
    file.sync_all()
}

/// Write parcels, then the state that counts them, and wait for the disk.
pub fn commit<'a>(
    file: &File,
    records: impl Iterator<Item = &'a ParcelRecord>,
    state: &State,
    generation: u32,
) -> std::io::Result<()> {
    for record in records {
        let at = RECORDS_START + record.seq as usize % RECORDS * SLOT_BYTES;
        file.write_all_at(&close(RECORD, record.seq, record)?, at as u64)?;
    }
    let at = generation as usize % STATES * STATE_STRIDE;
    file.write_all_at(&close(STATE, generation, state)?, at as u64)?;
    file.sync_data()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::record;

    #[test]
    fn a_slot_is_whole_or_not_there() {
        let state = State { boots: 7, sequence: 70_000, ..State::default() };
        let slot = close(STATE, 3, &state).expect("fits");
        let (number, payload) = open(&slot, STATE).expect("whole");
        assert_eq!((number, postcard::from_bytes(payload)), (3, Ok(state)));
        assert!(open(&slot, RECORD).is_none());
        for byte in 0..HEAD_BYTES + payload.len() {
            let mut torn = slot;
            torn[byte] ^= 0x10;
            assert!(open(&torn, STATE).is_none(), "byte {byte}");
        }
        assert!(open(&slot[..HEAD_BYTES + 4], STATE).is_none());
    }

    #[test]
    fn the_longest_record_fits_into_a_slot() {
        let record = ParcelRecord { frame: u64::MAX, ..record(u32::MAX) };
        assert!(close(RECORD, 1, &record).is_ok());
    }
}
