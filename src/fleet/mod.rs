//! Where one machine ends: parcels, health and events to the site's MQTT 5 broker.
//!
//! ```text
//! archive -> Entries -> feed -> [messages in flight] -> client -> broker
//!               ^                     '-- acknowledged --> Cursor, on the disk
//!               '------ replays <---- cmd/replay <--------'
//! ```
//! On a thread of its own behind the archive: it may wait, fail and allocate, and nobody waits for it. What
//! it tells of parcels and events it reads from the archive, from behind the last entry that the broker has
//! acknowledged; so nothing is left out over losses of the network, of the broker or of power, and what
//! comes twice has the same id. A broker may lose what it has acknowledged: then it is asked for again by
//! `cmd/replay`, the only topic that this machine listens to.

mod client;
mod command;
mod cursor;
mod feed;
mod outbox;
mod payload;
mod tls;
mod topics;

pub use outbox::serve;
pub use payload::{Clock, Figures, Parcel, parcel_schema};

/// What is kept in the archive, as the fleet reads it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Its number, which only rises.
    pub number: u64,
    /// When, ms since 1970.
    pub utc_ms: u64,
    /// What it is of.
    pub kind: Kind,
    /// JSON.
    pub text: String,
}

/// What an entry is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A parcel.
    Parcel,
    /// Something that happened.
    Event,
    /// Entries that the disk did not take.
    Gap,
}

/// Entries of the archive, one after the other. May wait for the disk.
pub trait Entries: Send {
    /// At most so many of the next ones; fewer: there are no more yet. What it returns no power cut takes
    /// back.
    fn next(&mut self, limit: usize) -> Result<Vec<Entry>, String>;
}

/// The machine, as the fleet sees it.
pub trait Machine: Send + Sync + 'static {
    /// Starts of this machine; none: not known yet. With the number of a parcel it is unique.
    fn boots(&self) -> Option<u16>;
    /// Its condition, in figures. Waits for nobody.
    fn figures(&self) -> Figures;
    /// The entries after number `number`. May wait for the disk.
    fn entries_after(&self, number: u64) -> Box<dyn Entries>;
    /// Time of an entry, if it is there, and the number of the newest. May wait for the disk.
    fn entry_time(&self, number: u64) -> Result<(Option<u64>, u64), String>;
}
