//! CAN messages, laid out from the tables of the register map: the same values, names and scales.
//!
//! Big-endian, standard identifiers counted from `can.base_id`. A classical frame that carries
//! part of a block has the low byte of the sequence number (or a counter) first, then the number
//! of its segment, then up to six bytes of values, none of them split. A parcel is whole when all
//! its segments have come with the same first byte; where one is missing, it is fetched over
//! Modbus or counted as lost. With CAN FD a parcel is one frame, without these two bytes.

use super::registers::{PARCEL_FIELDS, STATUS_FIELDS, Status};
use super::table::Field;
pub use super::table::Type;
use crate::event::ParcelRecord;
use heapless::Vec;
use std::time::Duration;

/// Bytes of a classical frame.
const CLASSICAL_BYTES: usize = 8;
/// Sequence and segment number.
const SEGMENT_HEAD: usize = 2;
/// Bytes of a CAN FD frame.
const FD_BYTES: usize = 64;

/// A message, by its distance from `can.base_id`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Message {
    /// Heartbeat, status, fault and reason, ten times a second.
    Heartbeat = 0,
    /// The rest of the status block in segments, once a second.
    Status = 1,
    /// A parcel in segments.
    Parcel = 2,
    /// A parcel in a CAN FD frame.
    ParcelFd = 3,
    /// What became of a command.
    Result = 4,
    /// From the PLC: ticket, command, argument.
    Command = 8,
    /// From the PLC: count of the encoder.
    Encoder = 9,
    /// From the PLC: its heartbeat.
    PlcHeartbeat = 10,
}

/// Between two heartbeats.
pub const HEARTBEAT_PERIOD: Duration = Duration::from_millis(100);
/// Between two tellings of the status, all its segments in turn.
pub const STATUS_PERIOD: Duration = Duration::from_secs(1);

impl Message {
    /// All of them, by number.
    pub const ALL: [Self; 8] = [
        Self::Heartbeat,
        Self::Status,
        Self::Parcel,
        Self::ParcelFd,
        Self::Result,
        Self::Command,
        Self::Encoder,
        Self::PlcHeartbeat,
    ];

    /// What it tells, for documents.
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::Heartbeat => "heartbeat, status, fault and reason, ten times a second",
            Self::Status => "the rest of the status block in segments, once a second",
            Self::Parcel => {
                "a parcel in segments with the same first byte, when it has left the zone: whole when all have come"
            }
            Self::ParcelFd => "a parcel in one CAN FD frame, instead of the segments",
            Self::Result => "what became of a command, when it is carried out or refused",
            Self::Command => {
                "from the PLC: ticket, command, argument; a ticket is carried out once"
            }
            Self::Encoder => "from the PLC: count of the encoder, as often as it can",
            Self::PlcHeartbeat => "from the PLC: any number that changes, to show that it is alive",
        }
    }

    /// How often it comes by itself; `None`: when there is something to tell.
    pub const fn period(self) -> Option<Duration> {
        match self {
            Self::Heartbeat => Some(HEARTBEAT_PERIOD),
            Self::Status => Some(STATUS_PERIOD),
            _ => None,
        }
    }
}

/// Bytes of a frame.
pub type Payload = Vec<u8, FD_BYTES>;

/// A frame to be sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Which message.
    pub message: Message,
    /// Its bytes.
    pub payload: Payload,
}

/// Names of the status fields in the heartbeat message.
const HEARTBEAT: [&str; 4] = ["heartbeat", "status", "fault", "reason"];
/// Names of the status fields in the result message.
const RESULT: [&str; 2] = ["ticket_done", "result"];
/// Constants that check the wiring of registers; on CAN the DBC does.
const NOT_ON_CAN: [&str; 3] = ["identity", "test_u32", "test_i16"];

fn bytes_of<S>(field: &Field<S>) -> usize {
    2 * usize::from(field.kind.registers())
}

/// A field's place in a message.
pub struct Place<'a, S> {
    /// Which field.
    pub field: &'a Field<S>,
    /// Number of the segment.
    pub segment: u8,
    /// First byte in the frame.
    pub byte: usize,
}

/// Fields in order, from `head` on, as many in a frame of `size` bytes as fit whole.
fn lay_out<'a, S: 'a>(
    fields: impl Iterator<Item = &'a Field<S>>,
    head: usize,
    size: usize,
) -> impl Iterator<Item = Place<'a, S>> {
    let mut next = (0u8, head);
    fields.map(move |field| {
        let bytes = bytes_of(field);
        if next.1 + bytes > size {
            next = (next.0 + 1, head);
        }
        let (segment, byte) = next;
        next.1 += bytes;
        Place { field, segment, byte }
    })
}

/// Fields that say the same as the frame's own head.
fn parcel_fields() -> impl Iterator<Item = &'static Field<ParcelRecord>> {
    PARCEL_FIELDS.iter().filter(|field| field.name != "sequence_end")
}

/// Places of the heartbeat message.
pub fn heartbeat_places() -> impl Iterator<Item = Place<'static, Status>> {
    named(&HEARTBEAT)
}

/// Places of the result message.
pub fn result_places() -> impl Iterator<Item = Place<'static, Status>> {
    named(&RESULT)
}

fn named(names: &'static [&str]) -> impl Iterator<Item = Place<'static, Status>> {
    let fields = names.iter().filter_map(|name| STATUS_FIELDS.iter().find(|f| f.name == *name));
    lay_out(fields, 0, CLASSICAL_BYTES)
}

/// Places of the status message.
pub fn status_places() -> impl Iterator<Item = Place<'static, Status>> {
    let elsewhere = |name: &str| {
        HEARTBEAT.contains(&name) || RESULT.contains(&name) || NOT_ON_CAN.contains(&name)
    };
    let fields = STATUS_FIELDS.iter().filter(move |field| !elsewhere(field.name));
    lay_out(fields, SEGMENT_HEAD, CLASSICAL_BYTES)
}

/// Places of a parcel in classical frames.
pub fn parcel_places() -> impl Iterator<Item = Place<'static, ParcelRecord>> {
    lay_out(parcel_fields(), SEGMENT_HEAD, CLASSICAL_BYTES)
}

/// Places of a parcel in a CAN FD frame.
pub fn parcel_fd_places() -> impl Iterator<Item = Place<'static, ParcelRecord>> {
    lay_out(parcel_fields(), 0, FD_BYTES)
}

/// Fill frames with values; `head` is their first byte where they have segments.
fn encode<S: 'static>(
    message: Message,
    places: impl Iterator<Item = Place<'static, S>>,
    source: &S,
    head: Option<u8>,
    mut emit: impl FnMut(Frame),
) {
    let begin = |segment: u8| {
        let mut payload = Payload::new();
        // invariant: an empty payload has room for its head
        let _ =
            payload.extend_from_slice(head.map(|head| [head, segment]).as_slice().as_flattened());
        Frame { message, payload }
    };
    // Segments are filled up, so that every one is as long as the DBC says.
    let mut emit = |mut frame: Frame| {
        if head.is_some() {
            let _ = frame.payload.resize(CLASSICAL_BYTES, 0); // invariant: has room
        }
        emit(frame);
    };
    let (mut at, mut frame) = (0, begin(0));
    for Place { field, segment, .. } in places {
        if segment != at {
            emit(std::mem::replace(&mut frame, begin(segment)));
            at = segment;
        }
        let bits = field.bits(source).to_be_bytes();
        // invariant: fields were laid out so that they fit
        let _ = frame.payload.extend_from_slice(&bits[4 - bytes_of(field)..]);
    }
    emit(frame);
}

/// The heartbeat message.
pub fn heartbeat(status: &Status, emit: impl FnMut(Frame)) {
    encode(Message::Heartbeat, heartbeat_places(), status, None, emit);
}

/// The status message, its segments headed by a counter.
pub fn status(status: &Status, counter: u8, emit: impl FnMut(Frame)) {
    encode(Message::Status, status_places(), status, Some(counter), emit);
}

/// The result message.
pub fn result(status: &Status, emit: impl FnMut(Frame)) {
    encode(Message::Result, result_places(), status, None, emit);
}

/// A parcel, in classical frames or one CAN FD frame.
pub fn parcel(record: &ParcelRecord, fd: bool, mut emit: impl FnMut(Frame)) {
    if fd {
        encode(Message::ParcelFd, parcel_fd_places(), record, None, |mut frame| {
            // CAN FD knows no other lengths beyond 8: what is left over is 0.
            let lengths = [8, 12, 16, 20, 24, 32, 48, FD_BYTES];
            let length = lengths.into_iter().find(|n| *n >= frame.payload.len());
            let _ = frame.payload.resize(length.unwrap_or(FD_BYTES), 0); // invariant: has room
            emit(frame);
        });
    } else {
        encode(Message::Parcel, parcel_places(), record, Some(record.seq as u8), emit);
    }
}

/// What a PLC sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// Ticket, command, argument.
    Command(u16, u16, u32),
    /// Count of the encoder.
    Encoder(u32),
    /// The PLC's heartbeat.
    Heartbeat(u16),
}

/// Read a frame of identifier `base_id + offset`; `None` when it is none of ours or too short.
pub fn decode(offset: u16, payload: &[u8]) -> Option<Received> {
    let word = |at: usize| payload.get(at..at + 2).map(|b| u16::from_be_bytes([b[0], b[1]]));
    let long = |at: usize| Some(u32::from(word(at)?) << 16 | u32::from(word(at + 2)?));
    match offset {
        o if o == Message::Command as u16 => Some(Received::Command(word(0)?, word(2)?, long(4)?)),
        o if o == Message::Encoder as u16 => Some(Received::Encoder(long(0)?)),
        o if o == Message::PlcHeartbeat as u16 => Some(Received::Heartbeat(word(0)?)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::record;

    fn frames(make: impl FnOnce(&mut dyn FnMut(Frame))) -> std::vec::Vec<Frame> {
        let mut frames = std::vec::Vec::new();
        make(&mut |frame| frames.push(frame));
        frames
    }

    #[test]
    fn a_parcel_in_segments_is_headed_by_its_sequence_number() {
        let frames = frames(|emit| parcel(&record(0x1_2345), false, emit));
        assert_eq!(frames[0].payload[..], [0x45, 0, 0, 1, 0x23, 0x45, 0, 0b1011]);
        // flags, length, width
        assert_eq!(frames[1].payload[..], [0x45, 1, 0, 0, 0x09, 0x2f, 0x04, 0xe0]);
        for (i, frame) in frames.iter().enumerate() {
            assert_eq!(frame.message, Message::Parcel);
            assert_eq!(frame.payload[..2], [0x45, i as u8]);
            assert_eq!(frame.payload.len(), CLASSICAL_BYTES);
        }
    }

    #[test]
    fn a_parcel_fits_one_can_fd_frame_of_a_length_that_exists() {
        let frames = frames(|emit| parcel(&record(7), true, emit));
        assert_eq!((frames.len(), frames[0].payload.len()), (1, FD_BYTES));
        assert_eq!(frames[0].payload[..4], [0, 0, 0, 7]);
    }

    #[test]
    fn the_status_block_is_told_in_full() {
        let told = heartbeat_places().chain(status_places()).chain(result_places()).count();
        assert_eq!(told + NOT_ON_CAN.len(), STATUS_FIELDS.len());
        let heartbeat = frames(|emit| heartbeat(&Status::default(), emit));
        assert_eq!(heartbeat[0].payload[..], [0, 0, 0, 0, 0, 0, 0, 2]);
        assert!(frames(|emit| status(&Status::default(), 3, emit)).len() > 3);
    }

    #[test]
    fn frames_of_the_plc_are_read_and_short_or_foreign_ones_are_not() {
        assert_eq!(decode(8, &[0, 1, 0, 2, 0, 0, 0, 3]), Some(Received::Command(1, 2, 3)));
        assert_eq!(decode(9, &[1, 2, 3, 4]), Some(Received::Encoder(0x0102_0304)));
        assert_eq!(decode(10, &[0, 9, 7]), Some(Received::Heartbeat(9)));
        for (offset, bytes) in [(8, 7), (9, 3), (10, 1), (0, 8), (11, 8), (u16::MAX, 8)] {
            assert_eq!(decode(offset, &[1; 8][..bytes]), None);
        }
    }
}
