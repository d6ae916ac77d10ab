//! The rooms that know source, pipeline and plc: offline measuring, the appliance, the demo,
//! calibration, the error budget.

mod annotate;
mod appliance;
pub mod archive;
pub mod board;
pub mod budget;
pub mod calibrate;
pub mod demo;
mod demo_kit;
mod demo_results;
mod desk;
mod explain;
pub mod fleet;
pub mod import;
mod keeper;
pub mod live;
pub mod log;
mod memory;
pub mod offline;
pub mod outputs;
pub mod privileges;
mod realtime;
mod report;
mod syslog;
pub mod update;
mod watchdog;

pub use annotate::Annotator;
pub use appliance::{Appliance, ImportBoard, Progress};
pub use keeper::Keeper;
pub use memory::{build, plan};
pub use watchdog::{Watchdog, end_on_panic};
