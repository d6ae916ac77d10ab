//! Frames on the CAN bus, and what the PLC's commands do: two bytes of identifier, one of length,
//! the payload, and so on.
#![no_main]

use beltgauge::config::{Plc, WordOrder};
use beltgauge::plc::command::Sender;
use beltgauge::plc::frames::{Received, decode};
use beltgauge::plc::journal::Journal;
use beltgauge::plc::link::Link;
use beltgauge::plc::registers::{CanStatus, VisionStatus};
use libfuzzer_sys::fuzz_target;
use std::time::Instant;

fuzz_target!(|bytes: &[u8]| {
    let now = Instant::now();
    let plc = Plc { queue: true, ..Plc::default() };
    let mut link = Link::new(plc, WordOrder::LowFirst, true, Journal::default(), now);
    let mut rest = bytes;
    while let Some((&[high, low, length], after)) = rest.split_first_chunk() {
        let payload = &after[..after.len().min(usize::from(length % 65))];
        rest = &after[payload.len()..];
        match decode(u16::from_be_bytes([high, low]), payload) {
            Some(Received::Command(ticket, command, argument)) => {
                link.command(ticket, command, argument, Sender::Can);
            }
            Some(Received::Encoder(count)) => link.count(count, now),
            Some(Received::Heartbeat(value)) => link.heartbeat(value, now),
            None => {}
        }
        // Bit 7: time for the link to take it up.
        if length & 0x80 != 0 {
            link.update(&VisionStatus::default(), &CanStatus::default(), None, now);
            while link.next_request().is_some() {}
        }
    }
});
