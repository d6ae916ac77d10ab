//! The rooms that know source, pipeline and plc: offline measuring, the appliance, the demo.

mod annotate;
mod appliance;
pub mod demo;
mod memory;
pub mod offline;

pub use annotate::Annotator;
pub use appliance::{Appliance, Pace, Progress};
pub use memory::{build, plan};
