//! The register map: one table that the server encodes from and the document is printed from.
//!
//! Input (FC 4) and holding (FC 3) registers are the same image. Two-register values have the
//! high word first. A parcel block carries its sequence number first and last, so that a
//! client that reads it in two requests can tell whether it changed in between.

use crate::event::{Counters, Flags, ParcelRecord, Shape};
use std::fmt::Write;

/// Version of the map, major.minor; a client checks the major one.
pub const MAP_VERSION: u16 = 0x0100;
/// Registers of one parcel block.
pub const PARCEL_STRIDE: u16 = 32;
/// Address of the latest parcel.
pub const LATEST: u16 = 100;
/// Address of the ring's first block.
pub const RING: u16 = 200;
/// Parcels in the ring; parcel `seq` is in block `(seq - 1) % RING_PARCELS`.
pub const RING_PARCELS: u16 = 32;
/// Registers in all.
pub const COUNT: u16 = RING + RING_PARCELS * PARCEL_STRIDE;

/// How a value is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    /// One register.
    U16,
    /// One register, two's complement.
    I16,
    /// Two registers, high word first.
    U32,
    /// Two registers, two's complement, high word first.
    I32,
}

/// One value of a block of type `S`.
pub struct Field<S> {
    /// Offset from the block's first register.
    pub offset: u16,
    /// Name.
    pub name: &'static str,
    /// Storage.
    pub kind: Type,
    /// Unit of the value, after scaling.
    pub unit: &'static str,
    /// Register value of one unit.
    pub scale: f64,
    /// Meaning.
    pub meaning: &'static str,
    /// The value, in units.
    pub value: fn(&S) -> f64,
}

/// What the status block shows, besides constants.
#[derive(Clone, Copy, Debug, Default)]
#[allow(clippy::struct_excessive_bools)] // they are the bits of two registers
pub struct Status {
    /// Rises ten times a second while frames arrive.
    pub heartbeat: u16,
    /// Frames arrive.
    pub running: bool,
    /// The empty belt has been learned.
    pub ready: bool,
    /// The belt's motion is measured, not assumed.
    pub belt_measured: bool,
    /// The frame source has ended or failed.
    pub source_ended: bool,
    /// Belt speed.
    pub belt_speed_mm_per_s: f64,
    /// Time of the newest frame since start.
    pub time_s: f64,
    /// Belt travel since start.
    pub belt_travel_mm: f64,
    /// Frames that came too late and were dropped.
    pub frames_dropped: u64,
    /// What the pipeline counts.
    pub counters: Counters,
}

type StatusField = Field<Status>;
type ParcelField = Field<ParcelRecord>;

/// Counters wrap at their register's size.
fn wrapped(count: u64) -> f64 {
    f64::from(count as u32)
}

/// Rows of the status block: `[offset, name, type, unit, scale, meaning, value]`.
macro_rules! fields {
    ($([$offset:expr, $name:expr, $kind:ident, $unit:expr, $scale:expr, $meaning:expr, $value:expr]),* $(,)?) => {
        &[$(Field {
            offset: $offset, name: $name, kind: Type::$kind, unit: $unit, scale: $scale,
            meaning: $meaning, value: $value,
        }),*]
    };
}

/// Identity, status and counters, at address 0.
#[rustfmt::skip]
pub const STATUS_FIELDS: &[StatusField] = fields![
    [0, "identity", U16, "", 1.0, "constant 0x4247, \"BG\"", |_| f64::from(0x4247)],
    [1, "map_version", U16, "", 1.0, "major in the high byte, minor in the low", |_| f64::from(MAP_VERSION)],
    [2, "test_u32", U32, "", 1.0, "constant 0x12345678: checks the word order", |_| f64::from(0x1234_5678)],
    [4, "test_i16", I16, "", 1.0, "constant -12345: checks the sign", |_| -12345.0],
    [10, "heartbeat", U16, "", 1.0, "rises ten times a second while frames arrive; wraps", |s| f64::from(s.heartbeat)],
    [11, "status", U16, "bits", 1.0, "bit 0 running, bit 1 ready (belt learned), bit 2 belt motion measured", |s| f64::from(u16::from(s.running) | u16::from(s.ready) << 1 | u16::from(s.belt_measured) << 2)],
    [12, "fault", U16, "bits", 1.0, "bit 0 frame source ended, bit 1 a table or queue has been full since start (see counters)", |s| f64::from(u16::from(s.source_ended) | u16::from(s.counters.segment_overflows + s.counters.track_overflows + s.counters.event_overflows > 0) << 1)],
    [13, "belt_speed", U32, "mm/s", 10.0, "belt speed", |s| s.belt_speed_mm_per_s],
    [15, "frames", U32, "", 1.0, "frames processed; wraps", |s| wrapped(s.counters.frames)],
    [17, "frames_dropped", U32, "", 1.0, "frames that came too late; wraps", |s| wrapped(s.frames_dropped)],
    [19, "parcels", U32, "", 1.0, "parcels reported = sequence number of the latest", |s| wrapped(s.counters.parcels)],
    [21, "parcels_unmeasured", U32, "", 1.0, "parcels that left without a size", |s| wrapped(s.counters.unmeasured)],
    [23, "parcels_lost", U32, "", 1.0, "parcels that vanished inside the view", |s| wrapped(s.counters.lost)],
    [25, "segment_overflows", U32, "", 1.0, "frames with more runs or blobs than the tables hold", |s| wrapped(s.counters.segment_overflows)],
    [27, "track_overflows", U32, "", 1.0, "blobs that found no free track", |s| wrapped(s.counters.track_overflows)],
    [29, "event_overflows", U32, "", 1.0, "records that found the queue to the PLC full", |s| wrapped(s.counters.event_overflows)],
    [31, "time", U32, "ms", 1.0, "time of the newest frame since start; wraps", |s| wrapped((s.time_s * 1000.0) as u64)],
    [33, "belt_travel", U32, "mm", 10.0, "belt travel since start; wraps after 429 km", |s| s.belt_travel_mm],
];

/// Quality 0 to 100 of a dimension: 100 at sigma 0, 0 from 5 mm on.
fn quality(sigma_mm: f64) -> f64 {
    (100.0 * (1.0 - sigma_mm / 5.0)).clamp(0.0, 100.0)
}

/// One parcel, at the latest address and in each block of the ring.
#[rustfmt::skip]
pub const PARCEL_FIELDS: &[ParcelField] = fields![
    [0, "sequence", U32, "", 1.0, "from 1; 0 = no parcel yet", |p| f64::from(p.seq)],
    [2, "valid", U16, "bits", 1.0, "bit 0 the block holds a parcel, bit 1 its shape is a box (else: no cuboid, its height cannot be trusted)", |p| f64::from(1 | u16::from(p.shape == Shape::Box) << 1)],
    [3, "flags", U16, "bits", 1.0, "doubts, see below", |p| f64::from(p.flags.bits())],
    [4, "length", U16, "mm", 10.0, "longer side of the footprint", |p| p.length_mm],
    [5, "width", U16, "mm", 10.0, "shorter side of the footprint", |p| p.width_mm],
    [6, "height", U16, "mm", 10.0, "height over the belt", |p| p.height_mm],
    [7, "yaw", I16, "deg", 100.0, "length axis against travel, counter-clockwise, (-90, 90]", |p| p.yaw_deg],
    [8, "x", I32, "mm", 10.0, "footprint centre along travel, at time", |p| p.x_mm],
    [10, "y", I32, "mm", 10.0, "footprint centre across, left positive", |p| p.y_mm],
    [12, "sigma_length", U16, "mm", 100.0, "standard deviation", |p| p.sigma_length_mm],
    [13, "sigma_width", U16, "mm", 100.0, "standard deviation", |p| p.sigma_width_mm],
    [14, "sigma_height", U16, "mm", 100.0, "standard deviation", |p| p.sigma_height_mm],
    [15, "quality_length", U16, "%", 1.0, "100 - 20 sigma/mm, at least 0", |p| quality(p.sigma_length_mm)],
    [16, "quality_width", U16, "%", 1.0, "100 - 20 sigma/mm, at least 0", |p| quality(p.sigma_width_mm)],
    [17, "quality_height", U16, "%", 1.0, "100 - 20 sigma/mm, at least 0", |p| quality(p.sigma_height_mm)],
    [18, "belt_speed", U32, "mm/s", 10.0, "mean over the pass", |p| p.belt_speed_mm_per_s],
    [20, "frame", U32, "", 1.0, "frame at which x and y hold; wraps", |p| wrapped(p.frame)],
    [22, "time", U32, "ms", 1.0, "time of that frame since start; wraps", |p| wrapped((p.t_s * 1000.0).round() as u64)],
    [24, "belt_travel", U32, "mm", 10.0, "belt travel since start at that frame", |p| p.belt_travel_mm],
    [30, "sequence_end", U32, "", 1.0, "equals sequence unless the block changed between two requests", |p| f64::from(p.seq)],
];

/// All registers, ready to be read.
pub struct RegisterImage {
    registers: [u16; COUNT as usize],
}

impl Default for RegisterImage {
    fn default() -> Self {
        let mut image = Self { registers: [0; COUNT as usize] };
        image.set_status(&Status::default());
        image
    }
}

impl RegisterImage {
    /// Write the status block.
    pub fn set_status(&mut self, status: &Status) {
        write_fields(STATUS_FIELDS, status, &mut self.registers);
    }

    /// Write a parcel as the latest and into its place of the ring.
    pub fn publish(&mut self, record: &ParcelRecord) {
        let slot = record.seq.saturating_sub(1) % u32::from(RING_PARCELS);
        let ring = RING + slot as u16 * PARCEL_STRIDE;
        for start in [LATEST, ring] {
            write_fields(PARCEL_FIELDS, record, &mut self.registers[usize::from(start)..]);
        }
    }

    /// `count` registers from `address`; `None` when any of them does not exist.
    pub fn read(&self, address: u16, count: u16) -> Option<&[u16]> {
        let start = usize::from(address);
        self.registers.get(start..start + usize::from(count))
    }
}

fn write_fields<S>(fields: &[Field<S>], source: &S, block: &mut [u16]) {
    for field in fields {
        let value = (field.value)(source) * field.scale;
        let at = usize::from(field.offset);
        // `as` saturates: out of range shows as the end of the range, NaN as 0.
        let words = match field.kind {
            Type::U16 => [value.round() as u16, 0],
            Type::I16 => [value.round() as i16 as u16, 0],
            Type::U32 => split(value.round() as u32),
            Type::I32 => split(value.round() as i32 as u32),
        };
        let size = field.kind.registers();
        block[at..at + size].copy_from_slice(&words[..size]);
    }
}

fn split(value: u32) -> [u16; 2] {
    [(value >> 16) as u16, value as u16]
}

impl Type {
    fn registers(self) -> usize {
        match self {
            Self::U16 | Self::I16 => 1,
            Self::U32 | Self::I32 => 2,
        }
    }
}

/// The map as a Markdown document.
pub fn document() -> String {
    let mut text = String::from(
        "# Beltgauge register map\n\n\
         Printed from the table in `src/plc/registers.rs`; a test fails when they differ.\n\n",
    );
    let _ = writeln!(
        text,
        "Map version {}.{}. Modbus TCP, any unit identifier. Function codes 3 (holding) and 4 (input)\n\
         read the same {COUNT} registers, at most 125 at once; every write is refused with exception 1.\n\
         Addresses start at 0: decimal address 100 is 0x0064, holding register 40101 in the old notation.\n\
         Two-register values have the high word first. Value = register / scale, in the unit given; what\n\
         does not fit shows the end of the range. Addresses not listed read 0; beyond the map: exception 2.\n\
         Poll as fast as you like (10 to 50 ms is usual); a client silent for a minute is disconnected\n\
         (`modbus.idle_timeout_s`). A restart clears everything: sequence, ring, time and travel begin anew.\n",
        MAP_VERSION >> 8,
        MAP_VERSION & 0xff,
    );
    text.push_str("## Status, from address 0\n\n");
    table(&mut text, STATUS_FIELDS, 0);
    let _ = writeln!(
        text,
        "\n## Latest parcel, from address {LATEST}; ring of the last {RING_PARCELS}, from address {RING}\n\n\
         A parcel takes {PARCEL_STRIDE} registers. Parcel `n` is at {RING} + {PARCEL_STRIDE} * ((n - 1) mod {RING_PARCELS}).\n\
         A block read in one request is never torn; read in several, it is whole when `sequence` and\n\
         `sequence_end` are equal. A parcel without a size gets no sequence number; `parcels_unmeasured`\n\
         counts it. Where a parcel is now: x + status `belt_travel` - its own `belt_travel`.\n\
         Addresses below are of the latest parcel.\n"
    );
    table(&mut text, PARCEL_FIELDS, LATEST);
    text.push_str("\n## Flags of a parcel\n\n| bit | flag | meaning |\n|---|---|---|\n");
    for (flag, name, meaning) in Flags::ALL {
        let _ = writeln!(text, "| {} | {name} | {meaning} |", flag.bits().trailing_zeros());
    }
    text
}

fn table<S>(text: &mut String, fields: &[Field<S>], base: u16) {
    text.push_str("| address | hex | 4xxxx | name | type | unit | scale | meaning |\n|---|---|---|---|---|---|---|---|\n");
    for f in fields {
        let at = base + f.offset;
        let _ = writeln!(
            text,
            "| {at} | 0x{at:04X} | {} | {} | {:?} | {} | {} | {} |",
            40001 + u32::from(at),
            f.name,
            f.kind,
            f.unit,
            f.scale,
            f.meaning
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(seq: u32) -> ParcelRecord {
        ParcelRecord {
            seq,
            frame: 137,
            t_s: 3.425,
            length_mm: 235.14,
            width_mm: 124.8,
            height_mm: 70.2,
            yaw_deg: -12.4,
            x_mm: 61.0,
            y_mm: -40.3,
            sigma_length_mm: 0.3,
            sigma_width_mm: 0.25,
            sigma_height_mm: 7.5,
            belt_speed_mm_per_s: 500.3,
            shape: Shape::Box,
            flags: Flags::default(),
            belt_travel_mm: 1712.5,
        }
    }

    fn fields_fit<S>(fields: &[Field<S>], end: u16) {
        let mut next = 0;
        for f in fields {
            assert!(f.offset >= next, "{} overlaps the field before it", f.name);
            next = f.offset + f.kind.registers() as u16;
        }
        assert!(next <= end);
    }

    #[test]
    fn fields_do_not_overlap_and_blocks_hold_them() {
        fields_fit(STATUS_FIELDS, LATEST);
        fields_fit(PARCEL_FIELDS, PARCEL_STRIDE);
        const { assert!(LATEST + PARCEL_STRIDE <= RING) }
    }

    #[test]
    fn a_parcel_is_encoded_as_the_map_says() {
        let mut image = RegisterImage::default();
        image.publish(&record(70_000));
        let latest = image.read(LATEST, PARCEL_STRIDE).expect("exists");
        assert_eq!(latest[..8], [1, 4464, 3, 0, 2351, 1248, 702, (-1240i16) as u16]);
        assert_eq!(latest[8..12], [0, 610, 0xffff, (-403i16) as u16]);
        assert_eq!(latest[12..18], [30, 25, 750, 94, 95, 0]);
        assert_eq!(latest[18..26], [0, 5003, 0, 137, 0, 3425, 0, 17125]);
        assert_eq!(latest[30..], [1, 4464]);
    }

    #[test]
    fn the_ring_keeps_the_last_32_in_their_places() {
        let mut image = RegisterImage::default();
        (1..=40).for_each(|seq| image.publish(&record(seq)));
        for seq in 9..=40u16 {
            let at = RING + (seq - 1) % RING_PARCELS * PARCEL_STRIDE;
            assert_eq!(image.read(at, 2), Some(&[0, seq][..]));
        }
    }

    #[test]
    fn values_out_of_range_saturate() {
        let mut image = RegisterImage::default();
        let huge =
            ParcelRecord { length_mm: 1e9, width_mm: -3.0, height_mm: f64::NAN, ..record(1) };
        image.publish(&huge);
        assert_eq!(image.read(LATEST + 4, 3), Some(&[65535, 0, 0][..]));
    }

    #[test]
    fn registers_beyond_the_map_do_not_exist() {
        let image = RegisterImage::default();
        assert!(image.read(COUNT - 1, 1).is_some());
        for (address, count) in [(COUNT, 1), (COUNT - 1, 2), (65535, 1), (65535, 65535)] {
            assert!(image.read(address, count).is_none());
        }
    }
}
