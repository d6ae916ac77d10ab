//! The program of a PLC in the terms of IEC 61131-3: data types and function blocks, for the formats that carry it.

use super::kits::{IDENTITY_REGISTERS, meaning, status_address, status_constant};
use super::registers::{
    COMMAND, MAP_VERSION, PARCEL_FIELDS, PARCEL_STRIDE, QUEUE_HEAD, RING_PARCELS,
};
use super::table::{Field, Type};
use std::fmt::Write;

/// A variable, or a member of a structure.
pub struct Variable {
    /// Name.
    pub name: String,
    /// Name of its type.
    pub kind: &'static str,
    /// What it means; may be empty.
    pub meaning: String,
}

fn variable(name: &str, kind: &'static str, meaning: &str) -> Variable {
    Variable { name: name.to_owned(), kind, meaning: meaning.to_owned() }
}

/// What a type is made of.
pub enum Shape {
    /// Elements from 0 to `last`.
    Array {
        /// Index of the last one.
        last: u16,
        /// Type of each.
        of: &'static str,
    },
    /// Members.
    Struct(Vec<Variable>),
}

/// A type with a name: strict compilers want a variable and a parameter of the same one.
pub struct DataType {
    /// Name.
    pub name: &'static str,
    /// What it is for; may be empty.
    pub meaning: &'static str,
    /// What it is made of.
    pub shape: Shape,
}

/// A function block.
pub struct Block {
    /// Name.
    pub name: &'static str,
    /// What it does, in lines.
    pub meaning: String,
    /// Given by the caller.
    pub inputs: Vec<Variable>,
    /// For the caller.
    pub outputs: Vec<Variable>,
    /// Its own.
    pub locals: Vec<Variable>,
    /// Its own, kept while the PLC is off.
    pub retained: Vec<Variable>,
    /// Statements.
    pub body: String,
}

impl Block {
    /// The parts of its declaration that it has, by their key words.
    pub fn sections(&self) -> impl Iterator<Item = (&'static str, &[Variable])> {
        [
            ("VAR_INPUT", &self.inputs[..]),
            ("VAR_OUTPUT", &self.outputs),
            ("VAR", &self.locals),
            ("VAR RETAIN", &self.retained),
        ]
        .into_iter()
        .filter(|(_, variables)| !variables.is_empty())
    }
}

/// All types.
pub fn data_types() -> [DataType; 4] {
    let member = |field: &Field<_>| Variable {
        name: field.name_as_kept(),
        kind: type_of(field),
        meaning: meaning(field),
    };
    [
        DataType {
            name: "BeltgaugeStart",
            meaning: "The first registers, which say whose they are.",
            shape: Shape::Array { last: IDENTITY_REGISTERS - 1, of: "UINT" },
        },
        DataType {
            name: "BeltgaugeBlock",
            meaning: "The registers of one parcel: one named type, so that a variable and a parameter are of the same.",
            shape: Shape::Array { last: PARCEL_STRIDE - 1, of: "UINT" },
        },
        DataType {
            name: "BeltgaugeTaken",
            meaning: "Numbers of the parcels that were taken last.",
            shape: Shape::Array { last: RING_PARCELS - 1, of: "UDINT" },
        },
        DataType {
            name: "BeltgaugeParcel",
            meaning: "",
            shape: Shape::Struct(PARCEL_FIELDS.iter().map(member).collect()),
        },
    ]
}

/// All function blocks, each after those that it uses.
pub fn blocks() -> [Block; 4] {
    [check(), decode(), queue(), command()]
}

fn type_of<S>(field: &Field<S>) -> &'static str {
    match field.kind {
        _ if !field.is_whole() => "REAL",
        Type::U16 => "UINT",
        Type::I16 => "INT",
        Type::U32 => "UDINT",
        Type::I32 => "DINT",
    }
}

/// A field's expression: its value in its unit.
fn expression<S>(field: &Field<S>) -> String {
    let at = field.offset;
    let words = format!("UINT_TO_UDINT(block[{at}]) * 65536 + UINT_TO_UDINT(block[{}])", at + 1);
    let (whole, real) = match field.kind {
        Type::U16 => (format!("block[{at}]"), "UINT"),
        // Two's complement by way of words of bits: what becomes of a number that is out of range differs.
        Type::I16 => (format!("WORD_TO_INT(UINT_TO_WORD(block[{at}]))"), "INT"),
        Type::U32 => (words, "UDINT"),
        Type::I32 => (format!("DWORD_TO_DINT(UDINT_TO_DWORD({words}))"), "DINT"),
    };
    if field.is_whole() { whole } else { format!("{real}_TO_REAL({whole}) / {:.1}", field.scale) }
}

fn check() -> Block {
    let [identity, version, test_u32, test_i16] =
        ["identity", "map_version", "test_u32", "test_i16"].map(status_address);
    let test = status_constant("test_u32");
    Block {
        name: "BeltgaugeCheck",
        meaning: format!(
            "Whether the registers are those of this program, in its word order. After every connect: read {IDENTITY_REGISTERS} holding\n\
             registers from 0 into `start`. While `known` is FALSE, use no other register: it is another device, another major\n\
             version of the map, or modbus.word_order is not \"high_first\"."
        ),
        inputs: vec![variable("start", "BeltgaugeStart", "filled by the Modbus client")],
        outputs: vec![variable("known", "BOOL", "")],
        locals: Vec::new(),
        retained: Vec::new(),
        body: format!(
            "\
known := (start[{identity}] = {}) AND ((start[{version}] / 256) = {});
known := known AND (start[{test_u32}] = {}) AND (start[{}] = {});
known := known AND (start[{test_i16}] = {});
",
            status_constant("identity"),
            MAP_VERSION >> 8,
            test >> 16,
            test_u32 + 1,
            test & 0xffff,
            status_constant("test_i16")
        ),
    }
}

fn decode() -> Block {
    let mut body = String::new();
    for field in PARCEL_FIELDS {
        let _ = writeln!(body, "parcel.{} := {};", field.name_as_kept(), expression(field));
    }
    body.push_str(
        "whole := (parcel.sequence > 0) AND (parcel.sequence = parcel.sequence_end);\n\
         may_be_used := whole AND ((parcel.valid MOD 2) = 1);\n",
    );
    Block {
        name: "BeltgaugeDecode",
        meaning: format!(
            "Decodes one parcel of {PARCEL_STRIDE} registers: the latest, the queue's or one of the ring's."
        ),
        inputs: vec![variable("block", "BeltgaugeBlock", "")],
        outputs: vec![
            variable("parcel", "BeltgaugeParcel", ""),
            variable("whole", "BOOL", "there is a parcel and it is not torn"),
            variable("may_be_used", "BOOL", "sort by its dimensions only when this is TRUE"),
        ],
        locals: Vec::new(),
        retained: Vec::new(),
        body,
    }
}

fn queue() -> Block {
    let last = RING_PARCELS - 1;
    Block {
        name: "BeltgaugeQueue",
        meaning: format!(
            "The handshake with plc.queue = true; this PLC's address is in modbus.write_allow. Every cycle of the\n\
             Modbus client: read {PARCEL_STRIDE} holding registers from {QUEUE_HEAD} into `block`; write `heartbeat` to {COMMAND}; while\n\
             acknowledging is TRUE, write `acknowledge` to {}. FC 23 does both in one request. After a restart of\n\
             either side parcels that were taken may come once more: they are known by their numbers.",
            COMMAND + 1
        ),
        inputs: vec![variable("block", "BeltgaugeBlock", "filled by the Modbus client")],
        outputs: vec![
            variable("heartbeat", "UINT", ""),
            variable("acknowledge", "UINT", ""),
            variable("acknowledging", "BOOL", ""),
            variable("parcel", "BeltgaugeParcel", ""),
            variable("new_parcel", "BOOL", "TRUE for one cycle: `parcel` has left the zone"),
            variable(
                "may_be_used",
                "BOOL",
                "sort by the dimensions of `parcel`; FALSE: its size is not known, its place is",
            ),
        ],
        locals: vec![
            variable("decode", "BeltgaugeDecode", ""),
            variable("known", "BOOL", ""),
            variable("i", "INT", ""),
        ],
        retained: vec![variable("taken", "BeltgaugeTaken", ""), variable("next", "INT", "")],
        body: format!(
            "\
heartbeat := (heartbeat + 1) MOD 65535;
decode(block := block);
acknowledging := decode.whole;
known := FALSE;
FOR i := 0 TO {last} DO
    IF taken[i] = decode.parcel.sequence THEN
        known := TRUE;
    END_IF;
END_FOR;
new_parcel := decode.whole AND (NOT known);
may_be_used := new_parcel AND decode.may_be_used;
IF new_parcel THEN
    parcel := decode.parcel;
    taken[next] := parcel.sequence;
    next := (next + 1) MOD {RING_PARCELS};
END_IF;
IF decode.whole THEN
    acknowledge := UDINT_TO_UINT(decode.parcel.sequence MOD 65536);
END_IF;
"
        ),
    }
}

fn command() -> Block {
    Block {
        name: "BeltgaugeCommand",
        meaning: format!(
            "Gives commands, each carried out once, whatever restarts. Every cycle of the Modbus client: read\n\
             `ticket_done` and `result` from {} and {}; while `busy`, write `ticket`, `code` and `argument` (high word first)\n\
             to {} in one request. A command that was under way at a restart of this PLC goes on with its ticket.",
            status_address("ticket_done"),
            status_address("result"),
            COMMAND + 4
        ),
        inputs: vec![
            variable("execute", "BOOL", "a rising edge gives the command"),
            variable("command", "UINT", ""),
            variable("command_argument", "UDINT", ""),
            variable("ticket_done", "UINT", ""),
            variable("result", "UINT", ""),
            variable("fresh", "BOOL", "`ticket_done` and `result` were read since the last call"),
        ],
        outputs: vec![
            variable("ticket", "UINT", ""),
            variable("code", "UINT", ""),
            variable("argument", "UDINT", ""),
            variable("busy", "BOOL", ""),
            variable("done", "BOOL", "TRUE for one cycle: `outcome` is that of the command"),
            variable("outcome", "UINT", ""),
        ],
        locals: vec![variable("before", "BOOL", "")],
        retained: vec![
            variable("under_way", "BOOL", ""),
            variable("kept_ticket", "UINT", ""),
            variable("kept_code", "UINT", ""),
            variable("kept_argument", "UDINT", ""),
        ],
        body: "\
done := FALSE;
IF under_way AND fresh AND (ticket_done = kept_ticket) THEN
    under_way := FALSE;
    done := TRUE;
    outcome := result;
END_IF;
IF execute AND (NOT before) AND fresh AND (NOT under_way) THEN
    (* The ticket after the last one, never 0. *)
    kept_ticket := UDINT_TO_UINT((UINT_TO_UDINT(ticket_done) MOD 65535) + 1);
    kept_code := command;
    kept_argument := command_argument;
    under_way := TRUE;
END_IF;
IF fresh OR (NOT execute) THEN
    before := execute;
END_IF;
ticket := kept_ticket;
code := kept_code;
argument := kept_argument;
busy := under_way;
"
        .to_owned(),
    }
}
