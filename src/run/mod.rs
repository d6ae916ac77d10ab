//! The rooms that know source, pipeline and plc: offline measuring, the appliance, the demo,
//! calibration, the error budget.

mod annotate;
mod appliance;
pub mod budget;
pub mod calibrate;
pub mod demo;
mod memory;
pub mod offline;
mod realtime;
mod report;

pub use annotate::Annotator;
pub use appliance::{Appliance, Pace, Progress};
pub use memory::{build, plan};
