//! The register map as documents: Markdown to read, CSV to import.

use super::codes::REASONS;
use super::command::{COMMANDS, Outcome};
use super::frames;
use super::link::REPEATED;
use super::registers::{
    COMMAND, COMMAND_COUNT, COMMAND_FIELDS, COUNT, LATEST, MAP_VERSION, PARCEL_FIELDS,
    PARCEL_STRIDE, QUEUE_HEAD, RING, RING_PARCELS, STATUS_FIELDS,
};
use super::table::Field;
use crate::event::{Flags, NotMeasured};
use std::fmt::Write;

fn version(version: u16) -> String {
    format!("{}.{}", version >> 8, version & 0xff)
}

/// A value's range, in its unit.
fn range<S>(field: &Field<S>) -> String {
    let [low, high] = field.kind.range().map(|end| end / field.scale);
    format!("{low} to {high}")
}

/// The map as a Markdown document.
pub fn markdown() -> String {
    let mut text = format!(
        "# Beltgauge register map\n\n\
         Printed from the tables in `src/plc/registers.rs`; a test fails when they differ. The same as a list:\n\
         [registers.csv](registers.csv). The same over CAN: [beltgauge.dbc](beltgauge.dbc). Examples:\n\
         [plc.st](plc.st) (IEC 61131-3 Structured Text).\n\n\
         Map version {}. Modbus TCP, any unit identifier. Function codes 3 (holding) and 4 (input)\n\
         read the same {COUNT} registers, at most 125 at once; 6, 16 and 23 write the {COMMAND_COUNT} registers from {COMMAND} on,\n\
         elsewhere writes get exception 2; 1 (coils) and 2 (discrete inputs) read 32 bits: the 16 of\n\
         `status` from 0 on, the 16 of `fault` from 16 on; 43/14 identifies the device. All others: exception 1.\n\
         Addresses start at 0, or at `modbus.base_address`: decimal address 100 is 0x0064, holding register 40101\n\
         in the old notation. Two-register values have the high word first, unless `modbus.word_order` says\n\
         otherwise: `test_u32` shows. Value = register / scale, in the unit given; what does not fit shows the end\n\
         of the range. Addresses not listed read 0; beyond the map: exception 2.\n\
         Poll as fast as you like (10 to 50 ms is usual); a client silent for a minute is disconnected\n\
         (`modbus.idle_timeout_s`). With `plc.state_file` the sequence, the ring and the queue go on after a\n\
         restart, and `boots` rises; without, they begin anew. Time and travel always do.\n\n\
         ## Status, from address 0\n\n",
        version(MAP_VERSION)
    );
    table(&mut text, STATUS_FIELDS, 0);
    text.push_str("\nCodes of `reason`, the first that holds:\n\n| code | meaning |\n|---|---|\n");
    for (code, _, meaning) in REASONS {
        let _ = writeln!(text, "| {code} | {meaning} |");
    }
    let _ = writeln!(
        text,
        "\n## Commands, from address {COMMAND}; written by the PLC\n\n\
         Only addresses in `modbus.write_allow` may write (FC 6, 16, 23); others get exception 1. Every command is\n\
         logged with its sender. A write is answered when the disk has what it changed.\n\n\
         Two-register values are written whole. A request is carried out whole or refused whole: exception 2 for\n\
         an address, exception 3 for a value. In a write of several registers an acknowledgment of a parcel that\n\
         never was is left out instead: a PLC may hold a number from before a restart.\n\n\
         **Tickets.** Write command and argument before or together with `ticket`; the outcome is there when\n\
         `ticket_done` equals it. The same ticket with the same command again does nothing, so a write that was not\n\
         answered may be repeated, and a PLC may write its whole block all the time. Take `ticket_done` + 1 for the next\n\
         command (after 65535 comes 1). The last ticket is kept over a restart of Beltgauge, with `plc.state_file`. A PLC\n\
         that restarts goes on with the ticket of a command that was under way, or writes ticket 0 once: after that\n\
         any ticket is new. `plc.st` has it as a function block.\n"
    );
    table(&mut text, COMMAND_FIELDS, COMMAND);
    text.push_str("\n| command | what it does |\n|---|---|\n");
    for (code, _, meaning) in COMMANDS {
        let _ = writeln!(text, "| {code} | {meaning} |");
    }
    text.push_str("\n| result | meaning |\n|---|---|\n");
    for (outcome, _, meaning) in Outcome::ALL {
        let _ = writeln!(text, "| {} | {meaning} |", outcome as u16);
    }
    let _ = writeln!(
        text,
        "\n## Latest parcel, from address {LATEST}; queue, from address {QUEUE_HEAD}; ring of the last {RING_PARCELS}, from address {RING}\n\n\
         A parcel takes {PARCEL_STRIDE} registers. Parcel `n` is at {RING} + {PARCEL_STRIDE} * ((n - 1) mod {RING_PARCELS}).\n\
         A block read in one request is never torn; read in several, it is whole when `sequence` and\n\
         `sequence_end` are equal. With `plc.queue` the oldest parcel that was not acknowledged is at {QUEUE_HEAD}\n\
         (`sequence` 0: none); writing the low word of its sequence number to `acknowledge` brings the next.\n\
         Up to {RING_PARCELS} wait; one more, and the oldest goes and is counted in `queue_overflows`.\n\
         **Sort by the dimensions only when bit 0 of `valid` is set**: they were measured, nothing casts doubt on them,\n\
         and every standard deviation is within `measure.sigma_max_mm`. A parcel that could not be measured is in the\n\
         queue like any other: with its position, the reason in `not_measured`, dimensions 0 and that bit off. Where a parcel is now: x + (status `belt_travel` - its own `belt_travel`), the difference\n\
         taken in 32 bits, so that it survives the wrap.\n\
         Addresses below are of the latest parcel.\n"
    );
    table(&mut text, PARCEL_FIELDS, LATEST);
    text.push_str("\n## Flags of a parcel\n\n| bit | flag | meaning |\n|---|---|---|\n");
    for (flag, name, meaning) in Flags::ALL {
        let _ = writeln!(text, "| {} | {name} | {meaning} |", flag.bits().trailing_zeros());
    }
    text.push_str(
        "\n## Why a parcel was not measured\n\n| code | name | meaning |\n|---|---|---|\n",
    );
    for (reason, name, meaning) in NotMeasured::ALL {
        let _ = writeln!(text, "| {} | {name} | {meaning} |", reason as u8);
    }
    can(&mut text);
    text
}

fn can(text: &mut String) {
    let segments = frames::parcel_places().last().map_or(0, |place| place.segment + 1);
    let _ = writeln!(
        text,
        "\n## The same over CAN\n\n\
         Standard identifiers from `can.base_id` (0x500) on; all values big-endian, named and scaled as above. The layout of\n\
         every frame is in [beltgauge.dbc](beltgauge.dbc).\n\n\
         | identifier | message | when |\n|---|---|---|\n\
         | +0 | heartbeat, status, fault, reason | ten times a second |\n\
         | +1 | the rest of the status block, in segments | once a second |\n\
         | +2 | a parcel, in {segments} segments of 8 bytes | when it is published |\n\
         | +3 | with `can.fd`: a parcel in one frame of 64 bytes | when it is published |\n\
         | +4 | ticket and result of a command | after every command, a repeated one too |\n\
         | +8 | from the PLC: ticket, command, argument | |\n\
         | +9 | from the PLC: encoder count | as often as possible |\n\
         | +10 | from the PLC: its heartbeat | |\n\n\
         Segments: the first byte is the low byte of the sequence number, the second the number of the segment.\n\
         A parcel is whole when segments 0 to {} have come with the same first byte; if the first byte changes\n\
         before, one was lost. `sequence` in segment 0 tells how many parcels are missing; the ring has them.\n\
         After bus off, a lost interface or a restart the last {REPEATED} parcels are sent again: a sequence number that\n\
         was there before is a repetition.\n\
         Up to {RING_PARCELS} parcels wait while the bus is off or nobody acknowledges; then the oldest is dropped and\n\
         counted in `can_parcels_dropped`. After bus off the controller must be restarted by its driver:\n\
         `ip link set can0 type can bitrate 500000 restart-ms 100`.",
        segments - 1
    );
}

fn table<S>(text: &mut String, fields: &[Field<S>], base: u16) {
    text.push_str(
        "| address | hex | 4xxxx | name | type | unit | scale | range | since | meaning |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    for f in fields {
        let at = base + f.offset;
        let _ = writeln!(
            text,
            "| {at} | 0x{at:04X} | {} | {} | {:?} | {} | {} | {} | {} | {} |",
            40001 + u32::from(at),
            f.name,
            f.kind,
            f.unit,
            f.scale,
            range(f),
            version(f.since),
            f.meaning
        );
    }
}

/// The map as a list: one line a value; the ring's first block stands for all.
pub fn csv() -> String {
    let mut text =
        String::from("address,block,name,type,access,unit,scale,minimum,maximum,since,meaning\n");
    rows(&mut text, "status", STATUS_FIELDS, 0, "read");
    rows(&mut text, "command", COMMAND_FIELDS, COMMAND, "read and write");
    for (block, at) in [("latest", LATEST), ("queue", QUEUE_HEAD), ("ring", RING)] {
        rows(&mut text, block, PARCEL_FIELDS, at, "read");
    }
    text
}

fn rows<S>(text: &mut String, block: &str, fields: &[Field<S>], base: u16, access: &str) {
    for f in fields {
        let [low, high] = f.kind.range().map(|end| end / f.scale);
        let _ = writeln!(
            text,
            "{},{block},{},{:?},{access},{},{},{low},{high},{},\"{}\"",
            base + f.offset,
            f.name,
            f.kind,
            f.unit,
            f.scale,
            version(f.since),
            f.meaning.replace('"', "\"\"")
        );
    }
}
