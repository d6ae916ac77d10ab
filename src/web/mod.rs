//! The page for people and the figures for machines: everything to be read by anyone, and the site to be
//! changed by whoever has signed in.
//!
//! ```text
//! run (desk) -> Board: live pictures, parcels, events, trend -> server -> browsers, Prometheus
//!       '-----> Machine: state, PLC, archive ------------------'  |
//!        <----- Keeper: files as on a stick, changes <------------'
//! ```
//! In: what `run` puts on the [`Board`] and tells as a [`Machine`]; what it lets be changed is a [`Keeper`].
//! Out: HTTP, on a thread of its own
//! that may be slow, refuse or fail without anybody noticing but its visitors. Live pictures are pulled,
//! one request each, and made only while somebody asks. Limits: connections, bytes and time of each, lists
//! of the last parcels, events and pieces of the trend.

mod api;
mod assets;
mod board;
mod bundle;
mod change;
mod guard;
mod metrics;
mod model;
mod server;

pub use board::{Board, Picture, View};
pub use model::{
    ArchiveState, Archived, BeltState, BoardSeen, BundleFile, BundleFiles, CameraState, Change,
    Client, Counts, Cuboid, Event, Field, Keeper, Lamp, Machine, NoPicture, Parcel, ParcelPicture,
    Piece, Plc, Point, Scene, Setup, SetupPlace, Sight, Site, SiteFile, State, Work, WorkState,
    Written,
};
pub use server::{Listening, listen, serve};
