//! A Python client in one file, on pymodbus: `client.py`, with what the tables say put in.

use super::{
    IDENTITY_REGISTERS, Values, codes, field, map_version, meaning, offset, registers,
    status_address, status_constant,
};
use crate::plc::registers::{
    COMMAND, COMMAND_FIELDS, LATEST, MAP_VERSION, PARCEL_FIELDS, PARCEL_STRIDE, QUEUE_HEAD, RING,
    RING_PARCELS, STATUS_FIELDS,
};
use crate::plc::table::{Field, Type};
use std::fmt::Write;

/// The client.
pub fn document() -> String {
    include_str!("client.py")
        .replace("@version@", &map_version())
        .replace("@identity@", &format!("0x{:X}", status_constant("identity")))
        .replace("@test_u32@", &format!("0x{:X}", status_constant("test_u32")))
        .replace("@constants@", constants().trim_end())
        .replace("@codes@", enumerations().trim_end())
        .replace("@parcel@", members("Parcel", PARCEL_FIELDS).trim_end())
        .replace("@status@", members("Status", STATUS_FIELDS).trim_end())
        .replace("@travel_scale@", &field(PARCEL_FIELDS, "belt_travel").scale.to_string())
        .replace("@ring_parcels@", &RING_PARCELS.to_string())
}

fn constants() -> String {
    let mut text = String::new();
    for (name, value, comment) in [
        ("MAP_MAJOR", MAP_VERSION >> 8, "of the register map"),
        ("LATEST", LATEST, "address of the latest parcel"),
        ("QUEUE", QUEUE_HEAD, "of the oldest parcel that waits to be acknowledged"),
        ("RING", RING, "of the last parcels"),
        ("RING_PARCELS", RING_PARCELS, "how many they are"),
        ("PARCEL_REGISTERS", PARCEL_STRIDE, "registers of one parcel"),
        ("STATUS_REGISTERS", registers(STATUS_FIELDS), "of the status block, from address 0"),
        ("IDENTITY", status_address("identity"), "addresses of values"),
        ("MAP_VERSION", status_address("map_version"), ""),
        ("TEST_U32", status_address("test_u32"), ""),
        ("IDENTITY_REGISTERS", IDENTITY_REGISTERS, "from address 0, with all of these"),
        ("PARCELS", status_address("parcels"), ""),
        ("TICKET_DONE", status_address("ticket_done"), "the result is in the next register"),
        (
            "PLC_HEARTBEAT",
            COMMAND + offset(COMMAND_FIELDS, "plc_heartbeat"),
            "acknowledge is in the next register",
        ),
        (
            "TICKET",
            COMMAND + offset(COMMAND_FIELDS, "ticket"),
            "command and argument are in the next registers",
        ),
    ] {
        let comment = if comment.is_empty() { String::new() } else { format!("  # {comment}") };
        let _ = writeln!(text, "{name} = {value}{comment}");
    }
    text
}

fn enumerations() -> String {
    let mut text = String::new();
    for (name, about, values) in codes() {
        let (base, values) = match values {
            Values::Bits(values) => ("IntFlag", values),
            Values::Numbers(values) => ("IntEnum", values),
        };
        let _ = write!(text, "class {name}({base}):\n    \"\"\"{about}.\"\"\"\n\n");
        for (value, name, meaning) in values {
            let meaning = if meaning.is_empty() { String::new() } else { format!("  # {meaning}") };
            let _ = writeln!(text, "    {} = {value}{meaning}", name.to_uppercase());
        }
        text.push_str("\n\n");
    }
    text
}

/// The set of bits that a field is.
fn set_of<S>(field: &Field<S>) -> Option<&'static str> {
    match field.name {
        "valid" => Some("Valid"),
        "flags" => Some("Flag"),
        "status" => Some("StatusBit"),
        "fault" => Some("Fault"),
        _ => None,
    }
}

fn expression<S>(field: &Field<S>) -> String {
    let at = field.offset;
    let stored = match field.kind {
        Type::U16 => format!("block[{at}]"),
        Type::I16 => format!("_signed(block[{at}], 16)"),
        Type::U32 => format!("_u32(block, {at})"),
        Type::I32 => format!("_signed(_u32(block, {at}), 32)"),
    };
    match set_of(field) {
        Some(set) => format!("{set}({stored})"),
        None if field.scale > 1.0 => format!("{stored} / {}", field.scale),
        None => stored,
    }
}

/// The values of a block, and what decodes them.
fn members<S>(class: &str, fields: &[Field<S>]) -> String {
    let mut text = String::new();
    for field in fields {
        let kind = set_of(field).unwrap_or(if field.scale > 1.0 { "float" } else { "int" });
        let _ = writeln!(text, "    {}: {kind}  # {}", field.name_with_unit(), meaning(field));
    }
    let _ = write!(
        text,
        "\n    @classmethod\n    def decode(cls, block: list[int]) -> {class}:\n        \
         \"\"\"From the registers of its block.\"\"\"\n        return cls(\n"
    );
    for field in fields {
        let _ = writeln!(text, "            {}={},", field.name_with_unit(), expression(field));
    }
    text.push_str("        )\n");
    text
}
