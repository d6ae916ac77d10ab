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

/// Codes of the commands, their names in the kits and their meanings.
pub const COMMANDS: [(u16, &str, &str); 6] = [
    (
        1,
        "acknowledge",
        "acknowledge parcels up to sequence number `argument`, as register `acknowledge` does",
    ),
    (
        2,
        "learn",
        "learn the empty belt anew: takes background.learn_frames, parcels in view are forgotten",
    ),
    (3, "start", "start: report parcels"),
    (4, "stop", "stop: report none until started"),
    (5, "round", "round dimensions to multiples of `argument` tenths of a mm, 1 to 500"),
    (
        6,
        "correct_encoder",
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
    /// Codes, names in the kits, and meanings.
    pub const ALL: [(Self, &str, &str); 7] = [
        (Self::None, "none", "no command yet"),
        (Self::Done, "done", "done"),
        (Self::Unknown, "unknown_command", "no such command"),
        (Self::Argument, "argument_out_of_range", "argument out of range: nothing was changed"),
        (Self::Busy, "busy", "busy with earlier commands: try again with the next ticket"),
        (
            Self::TicketUsed,
            "ticket_used",
            "the last command, another one, had this ticket: nothing was done, take the next ticket",
        ),
        (
            Self::NotKnown,
            "not_known",
            "what it needs is not known: no encoder, or the belt has not travelled far enough",
        ),
    ];
}
