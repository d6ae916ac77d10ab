//! What was seen, on the disk: parcels with their pictures, and events; bounded in bytes, chained.
//!
//! ```text
//! desk -> [ring of entries] -> writer thread -> segments 00000000000000000001.bga, ...
//!                                                   |-> Reader: page, `beltgauge archive`
//!                                                   '-> Follower: fleet
//! ```
//! A segment is a head and entries, one after the other; each entry ends with the SHA-256 of the one
//! before it and itself, over segments too. A power cut costs what was not yet synchronised, a second's
//! entries; what it left half-written is found by its sum and passed over. Whoever changes or takes out
//! an entry breaks the chain; whoever may write the disk can forge a whole new one, unless the last sum
//! was noted elsewhere. What is damaged or cannot be read is told and left as it is: a new segment goes
//! on behind it. A slow, full or broken disk costs entries, which are counted: nobody waits for it.

mod follow;
mod reader;
mod segment;
mod writer;

pub use follow::Follower;
pub use reader::{Page, Reader, Stored, Verdict};
pub use writer::{Archive, Condition};

/// What an entry is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A parcel, with its picture if there is one.
    Parcel = 1,
    /// Something that happened.
    Event = 2,
    /// Entries that the disk did not take.
    Gap = 3,
}

/// The writer's priority is lower than that of what measures.
const NICE: i32 = 10;

impl Kind {
    const ALL: [(Self, &'static str); 3] =
        [(Self::Parcel, "parcel"), (Self::Event, "event"), (Self::Gap, "gap")];

    fn of(code: u8) -> Option<Self> {
        Self::ALL.iter().find(|(kind, _)| *kind as u8 == code).map(|(kind, _)| *kind)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(kind, _)| *kind == self).map_or("", |(_, name)| *name)
    }
}

/// What is to be kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// What it is of.
    pub kind: Kind,
    /// When, ms since 1970.
    pub utc_ms: u64,
    /// JSON.
    pub text: String,
    /// JPEG, or nothing.
    pub picture: Vec<u8>,
}

#[cfg(test)]
mod tests;
