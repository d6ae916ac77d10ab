//! Kits: what connects a PLC, a PC or a flow to the registers, printed from the tables that encode them.

pub mod c;
pub mod node_red;
pub mod plcopen;
pub mod python;
pub mod scl;

use self::plcopen::Edition;
use super::codes::{FAULT_BITS, REASONS, STATUS_BITS, VALID_BITS};
use super::command::{COMMANDS, Outcome};
use super::registers::{MAP_VERSION, STATUS_FIELDS, Status};
use super::table::Field;
use crate::event::{Flags, NotMeasured};

/// Registers from address 0 on that say whose they are.
pub const IDENTITY_REGISTERS: u16 = 5;

/// Every kit: its path below `config/kits`, and its text.
pub fn documents() -> Vec<(&'static str, String)> {
    vec![
        ("c/beltgauge.h", c::document()),
        ("python/beltgauge.py", python::document()),
        ("node-red/flow.json", node_red::document()),
        ("plcopen/beltgauge_tc6_0200.xml", plcopen::document(Edition::Tc6V0200)),
        ("plcopen/beltgauge_tc6_0201.xml", plcopen::document(Edition::Tc6V0201)),
        ("tia/beltgauge.scl", scl::document()),
    ]
}

/// The version of the register map.
pub fn map_version() -> String {
    format!("{}.{}", MAP_VERSION >> 8, MAP_VERSION & 0xff)
}

/// Where a value of the status block is.
pub fn status_address(name: &str) -> u16 {
    offset(STATUS_FIELDS, name)
}

/// A value of the status block that never changes, as its bits.
pub fn status_constant(name: &str) -> u32 {
    field(STATUS_FIELDS, name).bits(&Status::default())
}

/// Where a value is in its block.
fn offset<S>(fields: &[Field<S>], name: &str) -> u16 {
    field(fields, name).offset
}

fn field<'a, S>(fields: &'a [Field<S>], name: &str) -> &'a Field<S> {
    let found = fields.iter().find(|field| field.name == name);
    found.unwrap_or_else(|| panic!("no field {name}")) // invariant: the names are constants here
}

/// Registers from a block's first to its last value.
fn registers<S>(fields: &[Field<S>]) -> u16 {
    fields.iter().map(|field| field.offset + field.kind.registers()).max().unwrap_or(0)
}

/// What a field means, where no table stands below.
pub fn meaning<S>(field: &Field<S>) -> String {
    field.meaning.replace(", see below", "")
}

/// Value, name, meaning.
type Value = (u16, &'static str, &'static str);

/// What a register may hold.
enum Values {
    /// Any of these bits.
    Bits(Vec<Value>),
    /// One of these numbers.
    Numbers(Vec<Value>),
}

/// Every list of codes and bits: its name, what it is of, and its values.
fn codes() -> [(&'static str, &'static str, Values); 8] {
    let bits = |names: &[&'static str]| {
        let bit = |(bit, name): (usize, &&'static str)| (1 << bit, *name, "");
        Values::Bits(names.iter().enumerate().map(bit).collect())
    };
    let flags = Flags::ALL.map(|(flag, name, meaning)| (flag.bits(), name, meaning));
    let not_measured = NotMeasured::ALL.map(|(why, name, meaning)| (why as u16, name, meaning));
    let results = Outcome::ALL.map(|(outcome, name, meaning)| (outcome as u16, name, meaning));
    [
        ("StatusBit", "Bits of the status word", bits(&STATUS_BITS)),
        ("Fault", "Bits of the fault word", bits(&FAULT_BITS)),
        ("Valid", "Bits of a parcel's `valid`", bits(&VALID_BITS)),
        ("Flag", "Doubts about a parcel", Values::Bits(flags.to_vec())),
        (
            "NotMeasured",
            "Why a parcel has no dimensions; 0: it has",
            Values::Numbers(not_measured.to_vec()),
        ),
        ("Reason", "What matters most in the appliance's state", Values::Numbers(REASONS.to_vec())),
        ("Command", "What may be commanded", Values::Numbers(COMMANDS.to_vec())),
        ("Result", "What became of a command", Values::Numbers(results.to_vec())),
    ]
}
