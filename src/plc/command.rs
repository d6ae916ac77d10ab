//! What a PLC may command, and what may become of it.

use std::fmt;
use std::net::IpAddr;

/// What a PLC asks of the vision thread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Request {
    /// The belt is empty: forget the background and learn it anew.
    Learn,
    /// Report parcels, or do not.
    Report(bool),
    /// A count of the encoder is so many mm of belt.
    MmPerCount(f64),
}

/// Codes of the commands and their meanings.
pub const COMMANDS: [(u16, &str); 6] = [
    (1, "acknowledge parcels up to sequence number `argument`, as register `acknowledge` does"),
    (2, "learn the empty belt anew: takes background.learn_frames, parcels in view are forgotten"),
    (3, "start: report parcels"),
    (4, "stop: report none until started"),
    (5, "round dimensions to multiples of `argument` tenths of a mm, 1 to 500"),
    (
        6,
        "correct the encoder's scale by the belt's texture: mm_per_count becomes mm_per_count_seen, for good; refused when they differ by more than 40 %",
    ),
];

/// Who gave a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sender {
    /// A Modbus client.
    Modbus(IpAddr),
    /// Somebody on the CAN bus, which knows no addresses.
    Can,
}

impl fmt::Display for Sender {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Modbus(address) => write!(f, "Modbus {address}"),
            Self::Can => write!(f, "CAN"),
        }
    }
}

/// What became of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// There was none.
    None,
    /// Done.
    Done,
    /// No such command.
    Unknown,
    /// The argument is out of range.
    Argument,
    /// Vision is busy with earlier ones: try again.
    Busy,
    /// The ticket is that of the last command, which was another one.
    TicketUsed,
    /// What it needs is not known at present.
    NotKnown,
}

impl Outcome {
    /// Codes and meanings.
    pub const ALL: [(Self, &str); 7] = [
        (Self::None, "no command yet"),
        (Self::Done, "done"),
        (Self::Unknown, "no such command"),
        (Self::Argument, "argument out of range: nothing was changed"),
        (Self::Busy, "busy with earlier commands: try again with the next ticket"),
        (
            Self::TicketUsed,
            "the last command, another one, had this ticket: nothing was done, take the next ticket",
        ),
        (
            Self::NotKnown,
            "what it needs is not known: no encoder, or the belt has not travelled far enough",
        ),
    ];
}
