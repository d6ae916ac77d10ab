//! Peers that the project did not write, driven against the real binary.
