//! The rooms that know source, pipeline and plc: offline measuring, the appliance, the demo.

mod annotate;
pub mod offline;

pub use annotate::Annotator;
