//! The stages of the pipeline: each owns its state, plans its memory and reads no clock.

pub mod background;
pub mod evidence;
pub mod measure;
pub mod odometry;
pub mod parcels;
pub mod passes;
pub mod rectify;
pub mod riders;
pub mod segment;
pub mod track;
pub mod views;
