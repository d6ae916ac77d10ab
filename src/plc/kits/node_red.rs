//! A flow for Node-RED on its core nodes and `modbus-serial`: `flow.json` with `flow.js`, and
//! what the tables say put in.

use super::{IDENTITY_REGISTERS, map_version, offset, status_address, status_constant};
use crate::event::{Flags, NotMeasured};
use crate::plc::codes::VALID_BITS;
use crate::plc::registers::{
    COMMAND, MAP_VERSION, PARCEL_FIELDS, PARCEL_STRIDE, QUEUE_HEAD, RING_PARCELS,
};
use crate::plc::table::{Field, Type};
use serde_json::Value;
use std::fmt::Write;

/// The flow, to be imported.
pub fn document() -> String {
    include_str!("flow.json").replace("\"@function@\"", &Value::from(function()).to_string())
}

fn function() -> String {
    let at = |name: &str| offset(PARCEL_FIELDS, name).to_string();
    let bit = |name: &str| {
        let bit = VALID_BITS.iter().position(|bit| *bit == name);
        bit.map_or(0, |bit| 1 << bit).to_string()
    };
    let list = |names: Vec<Value>| Value::from(names).to_string();
    let flags = Flags::ALL.iter().map(|(_, name, _)| Value::from(*name)).collect();
    // The codes of these begin at 1, in order.
    let not_measured = NotMeasured::ALL.iter().map(|(_, name, _)| Value::from(*name));
    let not_measured = std::iter::once(Value::Null).chain(not_measured).collect();
    [
        ("version", map_version()),
        ("map_major", (MAP_VERSION >> 8).to_string()),
        ("flags", list(flags)),
        ("not_measured", list(not_measured)),
        ("parcel", members()),
        ("valid", at("valid")),
        ("flags_at", at("flags")),
        ("not_measured_at", at("not_measured")),
        ("may_be_used", bit("may_be_used")),
        ("is_box", bit("is_box")),
        ("identity_at", status_address("identity").to_string()),
        ("identity", format!("0x{:X}", status_constant("identity"))),
        ("map_version_at", status_address("map_version").to_string()),
        ("test_u32_at", status_address("test_u32").to_string()),
        ("test_u32", format!("0x{:X}", status_constant("test_u32"))),
        ("identity_registers", IDENTITY_REGISTERS.to_string()),
        ("queue", QUEUE_HEAD.to_string()),
        ("parcel_registers", PARCEL_STRIDE.to_string()),
        ("plc_heartbeat", COMMAND.to_string()),
        ("ring_parcels", RING_PARCELS.to_string()),
    ]
    .iter()
    .fold(include_str!("flow.js").to_owned(), |text, (mark, value)| {
        text.replace(&format!("@{mark}@"), value)
    })
}

/// What a parcel has, but for the words that are put into lists.
fn members() -> String {
    let mut text = String::new();
    for field in PARCEL_FIELDS {
        if !["flags", "not_measured"].contains(&field.name) {
            let name = field.name_with_unit();
            let _ = writeln!(text, "        {name}: {},", expression(field));
        }
    }
    text.trim_end().to_owned()
}

fn expression<S>(field: &Field<S>) -> String {
    let at = field.offset;
    let stored = match field.kind {
        Type::U16 => format!("block[{at}]"),
        Type::I16 => format!("i16(block[{at}])"),
        Type::U32 => format!("u32(block, {at})"),
        Type::I32 => format!("i32(u32(block, {at}))"),
    };
    if field.scale > 1.0 { format!("{stored} / {}", field.scale) } else { stored }
}
