//! The register map as a header of C99.

use super::{
    Values, codes, field, map_version, meaning, registers, status_address, status_constant,
};
use crate::event::Shape;
use crate::plc::registers::{
    COMMAND, COMMAND_FIELDS, LATEST, MAP_VERSION, PARCEL_FIELDS, PARCEL_STRIDE, QUEUE_HEAD, RING,
    RING_PARCELS, STATUS_FIELDS,
};
use crate::plc::table::{Field, Type};
use std::fmt::Write;

/// The header.
pub fn document() -> String {
    let mut text = format!(
        "/* Beltgauge, register map {}, for C99. Printed from the tables in src/plc: do not edit.\n \
         *\n \
         * Read the registers with any Modbus library into an array of uint16_t. Check the first registers with\n \
         * beltgauge_is_known() after every connect, then decode. Addresses are those of modbus.base_address = 0.\n \
         * The header needs no library, takes no memory and keeps no state. */\n\
         #ifndef BELTGAUGE_H\n#define BELTGAUGE_H\n\n#include <stdbool.h>\n#include <stdint.h>\n\n\
         #define BELTGAUGE_MAP_MAJOR {}u\n\
         #define BELTGAUGE_PARCEL_REGISTERS {PARCEL_STRIDE}u /* of one parcel */\n\
         #define BELTGAUGE_RING_PARCELS {RING_PARCELS}u\n\
         #define BELTGAUGE_STATUS_REGISTERS {}u /* of the status block, at most 125 in one request */\n\n",
        map_version(),
        MAP_VERSION >> 8,
        registers(STATUS_FIELDS)
    );
    addresses(&mut text);
    enumerations(&mut text);
    text.push_str(
        "/* Two registers, the high word first. */\n\
         static inline uint32_t beltgauge_u32(const uint16_t *registers)\n{\n    \
         return ((uint32_t)registers[0] << 16) | registers[1];\n}\n\n\
         /* Two's complement, without what C leaves to the compiler. */\n\
         static inline int16_t beltgauge_i16(uint16_t stored)\n{\n    \
         return (int16_t)((int32_t)stored - (stored > INT16_MAX ? 65536 : 0));\n}\n\n\
         static inline int32_t beltgauge_i32(uint32_t stored)\n{\n    \
         return (int32_t)((int64_t)stored - (stored > INT32_MAX ? INT64_C(4294967296) : 0));\n}\n\n",
    );
    structure(&mut text, "parcel", PARCEL_FIELDS);
    structure(&mut text, "status", STATUS_FIELDS);
    functions(&mut text);
    text.push_str("#endif\n");
    text
}

fn addresses(text: &mut String) {
    let _ = write!(
        text,
        "/* Where blocks begin. Parcels: the latest one, the oldest that waits to be acknowledged, the last {RING_PARCELS}. */\n\
         enum {{\n    BELTGAUGE_AT_STATUS_BLOCK = 0,\n    BELTGAUGE_AT_COMMAND_BLOCK = {COMMAND},\n    \
         BELTGAUGE_AT_LATEST = {LATEST},\n    BELTGAUGE_AT_QUEUE = {QUEUE_HEAD},\n    BELTGAUGE_AT_RING = {RING}\n}};\n\n"
    );
    text.push_str(
        "/* Where the values of the status block are: value = register / scale. */\nenum {\n",
    );
    address_lines(text, STATUS_FIELDS, 0);
    text.push_str("};\n\n/* Where a PLC writes, and what. */\nenum {\n");
    address_lines(text, COMMAND_FIELDS, COMMAND);
    text.push_str("};\n\n");
}

fn address_lines<S>(text: &mut String, fields: &[Field<S>], base: u16) {
    for field in fields {
        let scale = match (field.unit, field.scale) {
            ("" | "bits", 1.0) => String::new(),
            ("", scale) => format!(" scale {scale}:"),
            (unit, scale) => format!(" {unit}, scale {scale}:"),
        };
        let (at, kind) = (base + field.offset, field.kind);
        let name = field.name.to_uppercase();
        let _ = writeln!(
            text,
            "    BELTGAUGE_AT_{name} = {at}, /* {kind:?},{scale} {} */",
            meaning(field)
        );
    }
}

fn enumerations(text: &mut String) {
    for (name, about, values) in codes() {
        let _ = writeln!(text, "/* {about}. */\nenum {{");
        let (Values::Bits(values) | Values::Numbers(values)) = values;
        for (value, member, meaning) in values {
            let meaning =
                if meaning.is_empty() { String::new() } else { format!(" /* {meaning} */") };
            let name = upper_snake(name);
            let _ = writeln!(
                text,
                "    BELTGAUGE_{name}_{} = {value},{meaning}",
                member.to_uppercase()
            );
        }
        text.push_str("};\n\n");
    }
    text.push_str("/* What a parcel looks like. */\ntypedef enum {\n");
    for (shape, meaning) in [
        (Shape::Box, "a box"),
        (Shape::Irregular, "anything else, in the smallest upright box that holds it"),
    ] {
        let name = format!("{shape:?}").to_uppercase();
        let _ = writeln!(text, "    BELTGAUGE_SHAPE_{name}, /* {meaning} */");
    }
    text.push_str("} beltgauge_shape;\n\n");
}

/// `StatusBit` as `STATUS_BIT`.
fn upper_snake(name: &str) -> String {
    let mut upper = String::new();
    for c in name.chars() {
        if c.is_uppercase() && !upper.is_empty() {
            upper.push('_');
        }
        upper.push(c.to_ascii_uppercase());
    }
    upper
}

fn type_of<S>(field: &Field<S>) -> &'static str {
    match field.kind {
        _ if !field.is_whole() => "float",
        Type::U16 => "uint16_t",
        Type::I16 => "int16_t",
        Type::U32 => "uint32_t",
        Type::I32 => "int32_t",
    }
}

fn expression<S>(field: &Field<S>) -> String {
    let at = field.offset;
    let stored = match field.kind {
        Type::U16 => format!("block[{at}]"),
        Type::I16 => format!("beltgauge_i16(block[{at}])"),
        Type::U32 => format!("beltgauge_u32(&block[{at}])"),
        Type::I32 => format!("beltgauge_i32(beltgauge_u32(&block[{at}]))"),
    };
    if field.is_whole() { stored } else { format!("(float){stored} / {:.1}f", field.scale) }
}

/// A struct with the values of a block, and the function that fills it.
fn structure<S>(text: &mut String, name: &str, fields: &[Field<S>]) {
    text.push_str("typedef struct {\n");
    for field in fields {
        let (kind, member) = (type_of(field), field.name_as_kept());
        let _ = writeln!(text, "    {kind} {member}; /* {} */", meaning(field));
    }
    let _ = write!(
        text,
        "}} beltgauge_{name};\n\n\
         /* Decodes the registers of one block. */\n\
         static inline beltgauge_{name} beltgauge_decode_{name}(const uint16_t *block)\n{{\n    \
         beltgauge_{name} {name};\n"
    );
    for field in fields {
        let _ = writeln!(text, "    {name}.{} = {};", field.name_as_kept(), expression(field));
    }
    let _ = write!(text, "    return {name};\n}}\n\n");
}

fn functions(text: &mut String) {
    let [identity, version, test_u32, test_i16] =
        ["identity", "map_version", "test_u32", "test_i16"].map(status_address);
    let travel = field(PARCEL_FIELDS, "belt_travel");
    let (travel_name, travel_scale) = (travel.name_as_kept(), travel.scale);
    let _ = write!(
        text,
        "/* Whether the registers from address 0 on are those of this header, in this word order. If not, decode nothing:\n   \
         another device, another major version, or modbus.word_order = \"low_first\". */\n\
         static inline bool beltgauge_is_known(const uint16_t *status_block)\n{{\n    \
         return status_block[{identity}] == 0x{:X}u && status_block[{version}] >> 8 == BELTGAUGE_MAP_MAJOR\n        \
         && beltgauge_u32(&status_block[{test_u32}]) == UINT32_C(0x{:X})\n        \
         && status_block[{test_i16}] == 0x{:X}u;\n}}\n\n\
         /* There is a parcel, and it did not change between two requests. */\n\
         static inline bool beltgauge_is_whole(const beltgauge_parcel *parcel)\n{{\n    \
         return parcel->sequence != 0 && parcel->sequence == parcel->sequence_end;\n}}\n\n\
         /* Sort by the dimensions only when this is true. */\n\
         static inline bool beltgauge_may_be_used(const beltgauge_parcel *parcel)\n{{\n    \
         return beltgauge_is_whole(parcel) && (parcel->valid & BELTGAUGE_VALID_MAY_BE_USED) != 0;\n}}\n\n\
         static inline beltgauge_shape beltgauge_shape_of(const beltgauge_parcel *parcel)\n{{\n    \
         return (parcel->valid & BELTGAUGE_VALID_IS_BOX) != 0 ? BELTGAUGE_SHAPE_BOX : BELTGAUGE_SHAPE_IRREGULAR;\n}}\n\n\
         /* Address of a parcel among the last {RING_PARCELS}. `sequence` is at least 1. */\n\
         static inline uint16_t beltgauge_ring_address(uint32_t sequence)\n{{\n    \
         return (uint16_t)(BELTGAUGE_AT_RING + (sequence - 1u) % BELTGAUGE_RING_PARCELS * BELTGAUGE_PARCEL_REGISTERS);\n}}\n\n\
         /* Where the parcel's centre is along travel, by the belt travel that the status block shows now. */\n\
         static inline float beltgauge_x_now_mm(const beltgauge_parcel *parcel, const beltgauge_status *now)\n{{\n    \
         uint32_t travelled = now->{travel_name} - parcel->{travel_name}; /* survives the wrap */\n    \
         return parcel->x_mm + (float)beltgauge_i32(travelled) / {travel_scale:.1}f;\n}}\n\n\
         /* The ticket of the next command, after `ticket_done` of the status block: never 0. */\n\
         static inline uint16_t beltgauge_next_ticket(uint16_t ticket_done)\n{{\n    \
         return (uint16_t)(ticket_done % 65535u + 1u);\n}}\n\n",
        status_constant("identity"),
        status_constant("test_u32"),
        status_constant("test_i16")
    );
}
