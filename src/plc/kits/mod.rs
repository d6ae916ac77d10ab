//! Kits: what connects a PLC, a PC or a flow to the registers, printed from the tables that encode them.

use super::registers::{MAP_VERSION, STATUS_FIELDS, Status};
use super::table::Field;

/// Registers from address 0 on that say whose they are.
pub const IDENTITY_REGISTERS: u16 = 5;

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

/// What a field means, where no table stands below.
pub fn meaning<S>(field: &Field<S>) -> String {
    field.meaning.replace(", see below", "")
}
