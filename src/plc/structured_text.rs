//! A ready-made decoder, handshake and commands in Structured Text (IEC 61131-3), from the same tables.

use super::registers::{
    COMMAND, MAP_VERSION, PARCEL_FIELDS, PARCEL_STRIDE, QUEUE_HEAD, RING_PARCELS, STATUS_FIELDS,
};
use super::table::{Field, Type};
use std::fmt::Write;

/// Whether it stays as it is stored: REAL has 24 bits, which a belt outruns in a day.
fn is_whole<S>(field: &Field<S>) -> bool {
    field.kind == Type::U32 || (field.scale - 1.0).abs() < f64::EPSILON
}

/// A field's expression: its value in its unit.
fn expression<S>(field: &Field<S>) -> String {
    let at = field.offset;
    let words = format!("UINT_TO_UDINT(block[{at}]) * 65536 + UINT_TO_UDINT(block[{}])", at + 1);
    let (whole, real) = match field.kind {
        Type::U16 => (format!("block[{at}]"), "UINT"),
        Type::I16 => (format!("UINT_TO_INT(block[{at}])"), "INT"),
        Type::U32 => (words, "UDINT"),
        Type::I32 => (format!("UDINT_TO_DINT({words})"), "DINT"),
    };
    if is_whole(field) { whole } else { format!("{real}_TO_REAL({whole}) / {:.1}", field.scale) }
}

fn type_of<S>(field: &Field<S>) -> &'static str {
    if !is_whole(field) {
        return "REAL";
    }
    match field.kind {
        Type::U16 => "UINT",
        Type::I16 => "INT",
        Type::U32 => "UDINT",
        Type::I32 => "DINT",
    }
}

/// A field's name with its unit: some bare ones, `time`, are key words.
fn name<S>(field: &Field<S>) -> String {
    match field.unit {
        "" | "bits" => field.name.to_owned(),
        "%" => format!("{}_percent", field.name),
        unit if is_whole(field) && field.scale > 1.0 => {
            format!("{}_{}_per_{}", field.name, field.scale, unit.replace('/', "_per_"))
        }
        unit => format!("{}_{}", field.name, unit.replace('/', "_per_")),
    }
}

/// The source, to be pasted into a project.
pub fn document() -> String {
    let mut text = format!(
        "(* Beltgauge, register map {}.{}: printed from the tables in src/plc/registers.rs.\n   \
         Word order high first, base address 0. *)\n\n",
        MAP_VERSION >> 8,
        MAP_VERSION & 0xff
    );
    types(&mut text);
    decode(&mut text);
    queue(&mut text);
    command(&mut text);
    text
}

fn types(text: &mut String) {
    let last = PARCEL_STRIDE - 1;
    let _ = write!(
        text,
        "(* The registers of one parcel: one named type, so that a variable and a parameter are of the same. *)\n\
         TYPE BeltgaugeBlock : ARRAY[0..{last}] OF UINT;\nEND_TYPE\n\n\
         (* Numbers of the parcels that were taken last. *)\n\
         TYPE BeltgaugeTaken : ARRAY[0..{}] OF UDINT;\nEND_TYPE\n\n\
         TYPE BeltgaugeParcel :\nSTRUCT\n",
        RING_PARCELS - 1
    );
    for field in PARCEL_FIELDS {
        let (name, kind) = (name(field), type_of(field));
        let _ = writeln!(text, "    {name} : {kind}; (* {} *)", field.meaning);
    }
    text.push_str("END_STRUCT;\nEND_TYPE\n\n");
}

fn decode(text: &mut String) {
    let _ = write!(
        text,
        "(* Decodes one parcel of {PARCEL_STRIDE} registers: the latest, the queue's or one of the ring's. *)\n\
         FUNCTION_BLOCK BeltgaugeDecode\n\
         VAR_INPUT\n    block : BeltgaugeBlock;\nEND_VAR\n\
         VAR_OUTPUT\n    parcel : BeltgaugeParcel;\n    \
         whole : BOOL; (* there is a parcel and it is not torn *)\n    \
         may_be_used : BOOL; (* sort by its dimensions only when this is TRUE *)\nEND_VAR\n"
    );
    for field in PARCEL_FIELDS {
        let _ = writeln!(text, "parcel.{} := {};", name(field), expression(field));
    }
    text.push_str(
        "whole := (parcel.sequence > 0) AND (parcel.sequence = parcel.sequence_end);\n\
         may_be_used := whole AND ((parcel.valid MOD 2) = 1);\nEND_FUNCTION_BLOCK\n\n",
    );
}

fn queue(text: &mut String) {
    let last = RING_PARCELS - 1;
    let _ = write!(
        text,
        "(* The handshake with plc.queue = true; this PLC's address is in modbus.write_allow. Every cycle of the\n   \
         Modbus client: read {PARCEL_STRIDE} holding registers from {QUEUE_HEAD} into `block`; write `heartbeat` to {COMMAND}; while\n   \
         acknowledging is TRUE, write `acknowledge` to {}. FC 23 does both in one request. After a restart of\n   \
         either side parcels that were taken may come once more: they are known by their numbers. *)\n\
         FUNCTION_BLOCK BeltgaugeQueue\n\
         VAR_INPUT\n    block : BeltgaugeBlock; (* filled by the Modbus client *)\nEND_VAR\n\
         VAR_OUTPUT\n    heartbeat : UINT;\n    acknowledge : UINT;\n    acknowledging : BOOL;\n    \
         parcel : BeltgaugeParcel;\n    \
         new_parcel : BOOL; (* TRUE for one cycle: `parcel` has left the zone *)\n    \
         may_be_used : BOOL; (* sort by the dimensions of `parcel`; FALSE: its size is not known, its place is *)\nEND_VAR\n\
         VAR\n    decode : BeltgaugeDecode;\n    known : BOOL;\n    i : INT;\nEND_VAR\n\
         VAR RETAIN\n    taken : BeltgaugeTaken;\n    next : INT;\nEND_VAR\n\
         heartbeat := (heartbeat + 1) MOD 65535;\n\
         decode(block := block);\n\
         acknowledging := decode.whole;\n\
         known := FALSE;\n\
         FOR i := 0 TO {last} DO\n    IF taken[i] = decode.parcel.sequence THEN\n        known := TRUE;\n    END_IF;\nEND_FOR;\n\
         new_parcel := decode.whole AND (NOT known);\n\
         may_be_used := new_parcel AND decode.may_be_used;\n\
         IF new_parcel THEN\n    parcel := decode.parcel;\n    taken[next] := parcel.sequence;\n    \
         next := (next + 1) MOD {RING_PARCELS};\nEND_IF;\n\
         IF decode.whole THEN\n    acknowledge := UDINT_TO_UINT(decode.parcel.sequence MOD 65536);\nEND_IF;\n\
         END_FUNCTION_BLOCK\n\n",
        COMMAND + 1
    );
}

fn command(text: &mut String) {
    let at = |name: &str| {
        let found = STATUS_FIELDS.iter().find(|field| field.name == name);
        found.map_or(0, |field| field.offset)
    };
    let _ = write!(
        text,
        "(* Gives commands, each carried out once, whatever restarts. Every cycle of the Modbus client: read\n   \
         `ticket_done` and `result` from {} and {}; while `busy`, write `ticket`, `code` and `argument` (high word first)\n   \
         to {} in one request. A command that was under way at a restart of this PLC goes on with its ticket. *)\n\
         FUNCTION_BLOCK BeltgaugeCommand\n\
         VAR_INPUT\n    execute : BOOL; (* a rising edge gives the command *)\n    \
         command : UINT;\n    command_argument : UDINT;\n    \
         ticket_done : UINT;\n    result : UINT;\n    \
         fresh : BOOL; (* `ticket_done` and `result` were read since the last call *)\nEND_VAR\n\
         VAR_OUTPUT\n    ticket : UINT;\n    code : UINT;\n    argument : UDINT;\n    \
         busy : BOOL;\n    done : BOOL; (* TRUE for one cycle: `outcome` is that of the command *)\n    outcome : UINT;\nEND_VAR\n\
         VAR\n    before : BOOL;\nEND_VAR\n\
         VAR RETAIN\n    under_way : BOOL;\n    kept_ticket : UINT;\n    kept_code : UINT;\n    kept_argument : UDINT;\nEND_VAR\n\
         done := FALSE;\n\
         IF under_way AND fresh AND (ticket_done = kept_ticket) THEN\n    \
         under_way := FALSE;\n    done := TRUE;\n    outcome := result;\nEND_IF;\n\
         IF execute AND (NOT before) AND fresh AND (NOT under_way) THEN\n    \
         (* The ticket after the last one, never 0. *)\n    \
         kept_ticket := UDINT_TO_UINT((UINT_TO_UDINT(ticket_done) MOD 65535) + 1);\n    \
         kept_code := command;\n    kept_argument := command_argument;\n    under_way := TRUE;\nEND_IF;\n\
         IF fresh OR (NOT execute) THEN\n    before := execute;\nEND_IF;\n\
         ticket := kept_ticket;\ncode := kept_code;\nargument := kept_argument;\nbusy := under_way;\n\
         END_FUNCTION_BLOCK\n",
        at("ticket_done"),
        at("result"),
        COMMAND + 4
    );
}
