//! The page for people and the figures for machines: everything to be read, nothing to be changed.
//!
//! ```text
//! run (desk) -> Board: live pictures, parcels, events, trend -> server -> browsers, Prometheus
//!       '-----> Machine: state, PLC, archive ------------------'
//! ```
//! In: what `run` puts on the [`Board`] and tells as a [`Machine`]. Out: HTTP, on a thread of its own
//! that may be slow, refuse or fail without anybody noticing but its visitors. Live pictures are pulled,
//! one request each, and made only while somebody asks. Limits: connections, bytes and time of each, lists
//! of the last parcels, events and pieces of the trend.

mod api;
mod assets;
mod board;
mod bundle;
mod guard;
mod metrics;
mod model;
mod server;

pub use board::{Board, Picture, View};
pub use model::{
    ArchiveState, Archived, BeltState, BoardSeen, BundleFile, BundleFiles, CameraState, Client,
    Counts, Cuboid, Event, Field, Lamp, Machine, NoPicture, Parcel, ParcelPicture, Piece, Plc,
    Point, Scene, Setup, SetupPlace, Sight, State, Written,
};
pub use server::{Listening, listen, serve};
