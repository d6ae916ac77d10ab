//! The synthetic belt.
