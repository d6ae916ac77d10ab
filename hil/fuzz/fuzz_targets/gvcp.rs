//! Answers of a GigE camera's control port.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(ack) = viva_gencp::decode_ack(bytes) {
        assert_eq!(ack.payload.len(), usize::from(ack.header.length));
    }
});
