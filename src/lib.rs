//! Beltgauge: one fixed 2D camera over a conveyor, every parcel's size to the sorter PLC.
//!
//! The map of the crate, in the order a frame takes:
//!
//! ```text
//! source -> pipeline::step( rectify -> background -> segment -> odometry -> track -> measure )
//!        -> event::ParcelRecord -> plc
//! ```
//!
//! - [`units`], [`error`], [`image`]: what everything speaks.
//! - [`camera`]: lens, pose and belt view; their calibration from a chessboard. Pure.
//! - [`config`]: TOML to a checked [`config::Site`].
//! - [`plan`]: all memory of the vision path, named and reasoned, in one mapping.
//! - [`kernel`]: pixel loops on slices, a readable one and one in vectors. [`stage`]: the steps that own state.
//! - [`belt`]: where the belt is. [`health`]: whether the instrument is as it was. [`pipeline`]: the steps in order. [`event`]: what comes out.
//! - [`sandbox`]: child processes for what strangers bring.
//! - [`source`]: where frames come from, and what records them. [`plc`]: how records reach the PLC.
//! - [`store`]: the appliance's disk: configurations in force, sticks, whom it trusts.
//! - [`archive`]: parcels with pictures, and events, on the disk. [`web`]: the page that shows all this.
//! - [`fleet`]: the site's broker, which many machines report to.
//! - [`run`]: threads and rings; the only room that knows source, pipeline, plc, store, archive, web and fleet.
//!
//! Invariants: `pipeline::step` reads no clock and allocates nothing; every parcel is told once, also
//! over frames that are missing (`pipeline/gap.rs` says how); dependencies point one way
//! (`tests/tidy.rs` checks it).
//!
//! Deliberately absent: a framework, plug-ins, learning from data, any claim of legal metrology.

pub mod archive;
pub mod belt;
pub mod camera;
pub mod config;
pub mod error;
pub mod event;
pub mod fleet;
pub mod health;
pub mod image;
pub mod kernel;
pub mod pipeline;
pub mod plan;
pub mod plc;
pub mod run;
pub mod sandbox;
pub mod source;
pub mod stage;
pub mod store;
pub mod units;
pub mod web;

/// What `hil/fuzz` feeds with any bytes, and nobody else calls from outside.
#[doc(hidden)]
pub mod fuzz {
    pub use crate::plc::journal::slots::parse as parse_journal;
    pub use crate::run::calibrate::parse_points;
    pub use crate::run::import::Board;
    pub use crate::source::gige::assembly::{Assembly, RANGES};
    pub use crate::source::gige::features::describe;
    pub use crate::source::pixels::{PixelFormat, by_genicam};
    pub use crate::source::still::decode;
}
