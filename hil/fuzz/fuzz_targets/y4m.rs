//! A Y4M recording.
#![no_main]

use beltgauge::source::{FrameSource, Y4m};
use libfuzzer_sys::fuzz_target;
use std::io::Cursor;

/// Larger frames than the input can hold need no buffer here.
const FRAME_BYTES_MAX: usize = 1 << 16;

fuzz_target!(|bytes: &[u8]| {
    let reader = Box::new(Cursor::new(bytes.to_vec()));
    let Ok(mut y4m) = Y4m::new(reader, "fuzz", None) else { return };
    let [width, height] = y4m.size_px();
    if width * height > FRAME_BYTES_MAX {
        return;
    }
    let mut frame = vec![0; width * height];
    while let Ok(Some(time)) = y4m.next_into(&mut frame) {
        assert!(time.t_s.is_finite());
    }
});
