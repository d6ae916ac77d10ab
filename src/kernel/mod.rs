//! The pixel kernels: slices and numbers only, no state, no allocation.
//!
//! [`scalar`] is the specification, [`simd`] the same for every pixel of every frame in vectors:
//! integer kernels give the same bits at every instruction level.

pub mod bands;
pub mod scalar;
pub mod simd;

pub use fearless_simd::Level;
