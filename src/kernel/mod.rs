//! The pixel kernels: slices and numbers only, no state, no allocation.
//!
//! [`scalar`] is the specification. Integer kernels must give the same bits at every
//! instruction level; the faster levels are tested against it.

pub mod scalar;
