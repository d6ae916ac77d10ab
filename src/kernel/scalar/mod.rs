//! Plain Rust, written to be read: what every faster kernel is compared with.

pub mod bits;
pub mod box_filter;
pub mod flow;
pub mod gradient;
pub mod mixture;
pub mod profile;
pub mod remap;
pub mod runs;
pub mod semblance;
pub mod steps;
pub mod texture;
