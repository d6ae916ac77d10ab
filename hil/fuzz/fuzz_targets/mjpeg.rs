//! Pictures of a camera in each of its formats; the first byte names the format.
#![no_main]

use beltgauge::fuzz::{PixelFormat, by_genicam};
use libfuzzer_sys::fuzz_target;

const SIZE_PX: [usize; 2] = [32, 24];
const GENICAM: [&str; 8] =
    ["Mono8", "Mono10", "Mono12", "Mono10p", "Mono12p", "Mono10Packed", "Mono12Packed", "BayerRG8"];

fuzz_target!(|bytes: &[u8]| {
    let Some((&format, picture)) = bytes.split_first() else { return };
    let mut grey = [0; SIZE_PX[0] * SIZE_PX[1]];
    // Most of them JPEG: the others have no form of their own.
    let format = match GENICAM.get(usize::from(format)) {
        Some(name) => by_genicam(name).expect("a known name").0,
        None => PixelFormat::Jpeg,
    };
    format.to_mono(picture, format.row_bytes(SIZE_PX[0]), SIZE_PX, &mut grey);
});
