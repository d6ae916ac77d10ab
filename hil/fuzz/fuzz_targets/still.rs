//! An image file: PNG, JPEG, PGM, BMP or TIFF. In the appliance a child process decodes those of a
//! stick.
#![no_main]

use beltgauge::fuzz::decode;
use libfuzzer_sys::fuzz_target;
use std::io::Cursor;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(still) = decode(Cursor::new(bytes)) {
        assert_eq!(still.pixels.len(), still.size_px[0] * still.size_px[1]);
    }
});
