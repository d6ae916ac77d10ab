//! What a PLC may command, and what may become of it.

/// What a PLC asks of the vision thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// The belt is empty: forget the background and learn it anew.
    Learn,
    /// Report parcels, or do not.
    Report(bool),
}

/// Codes of the commands and their meanings.
pub const COMMANDS: [(u16, &str); 5] = [
    (1, "acknowledge parcels up to sequence number `argument`, as register `acknowledge` does"),
    (2, "learn the empty belt anew: takes background.learn_frames, parcels in view are forgotten"),
    (3, "start: report parcels"),
    (4, "stop: report none until started"),
    (5, "round dimensions to multiples of `argument` tenths of a mm, 1 to 500"),
];

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
}

impl Outcome {
    /// Codes and meanings.
    pub const ALL: [(Self, &str); 5] = [
        (Self::None, "no command yet"),
        (Self::Done, "done"),
        (Self::Unknown, "no such command"),
        (Self::Argument, "argument out of range: nothing was changed"),
        (Self::Busy, "busy with earlier commands: try again"),
    ];
}
