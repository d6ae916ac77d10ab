//! What the crate `v4l` needs of the kernel's `videodev2.h`, made by `board/v4l2-sys-mit/regenerate`.
//!
//! The interface is the kernel's stable one, and the same for x86-64 and ARM64. The sizes and offsets in
//! `bindings.rs` are checked by the compiler in every build.
#![allow(non_camel_case_types, non_snake_case, non_upper_case_globals, missing_docs, clippy::all)]

#[cfg(not(all(target_os = "linux", target_pointer_width = "64")))]
compile_error!("these bindings are of 64-bit Linux: build with --no-default-features elsewhere");

include!("bindings.rs");
