//! Packets of a GigE camera's stream: one byte of length, a packet, and so on. Length 255 is a pause.
#![no_main]

use beltgauge::fuzz::{Assembly, RANGES};
use libfuzzer_sys::fuzz_target;
use std::time::{Duration, Instant};

const SIZE_PX: [usize; 2] = [20, 10];
const IMAGE_BYTES: usize = SIZE_PX[0] * SIZE_PX[1];
const DATAGRAM_BYTES: usize = 72;
const PAUSE: u8 = 255;
const PAUSE_TIME: Duration = Duration::from_millis(60);

fuzz_target!(|bytes: &[u8]| {
    let mut now = Instant::now();
    let mut assembly = Assembly::new(IMAGE_BYTES, DATAGRAM_BYTES, SIZE_PX).expect("a small image");
    let mut rest = bytes;
    while let Some((&length, after)) = rest.split_first() {
        if length == PAUSE {
            rest = after;
            now += PAUSE_TIME;
            let mut resends = heapless::Vec::<_, RANGES>::new();
            assembly.idle(now, &mut resends);
            continue;
        }
        let packet = &after[..after.len().min(usize::from(length))];
        rest = &after[packet.len()..];
        // An error is a camera that was set up otherwise.
        let _ = assembly.packet(packet, now);
    }
});
