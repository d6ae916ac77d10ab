//! A ready-made decoder and handshake in Structured Text (IEC 61131-3), from the same tables.

use super::registers::{COMMAND, MAP_VERSION, PARCEL_FIELDS, PARCEL_STRIDE, QUEUE_HEAD};
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
    let last = PARCEL_STRIDE - 1;
    let mut text = format!(
        "(* Beltgauge, register map {}.{}: printed from the tables in src/plc/registers.rs.\n   \
         Word order high first, base address 0. *)\n\nTYPE BeltgaugeParcel :\nSTRUCT\n",
        MAP_VERSION >> 8,
        MAP_VERSION & 0xff
    );
    for field in PARCEL_FIELDS {
        let (name, kind) = (name(field), type_of(field));
        let _ = writeln!(text, "    {name} : {kind}; (* {} *)", field.meaning);
    }
    let _ = write!(
        text,
        "END_STRUCT\nEND_TYPE\n\n\
         (* Decodes one parcel of {PARCEL_STRIDE} registers: the latest, the queue's or one of the ring's. *)\n\
         FUNCTION_BLOCK BeltgaugeDecode\n\
         VAR_INPUT\n    block : ARRAY[0..{last}] OF UINT;\nEND_VAR\n\
         VAR_OUTPUT\n    parcel : BeltgaugeParcel;\n    whole : BOOL; (* there is a parcel and it is not torn *)\nEND_VAR\n"
    );
    for field in PARCEL_FIELDS {
        let _ = writeln!(text, "parcel.{} := {};", name(field), expression(field));
    }
    let _ = write!(
        text,
        "whole := parcel.sequence > 0 AND parcel.sequence = parcel.sequence_end;\nEND_FUNCTION_BLOCK\n\n\
         (* The handshake with plc.queue = true. Every cycle of the Modbus client: read {PARCEL_STRIDE} holding\n   \
         registers from {QUEUE_HEAD} into `block`; write `heartbeat` to {COMMAND}, and while decode.whole, every cycle,\n   \
         `acknowledge` to {}. After a restart of either side parcels that were taken may come once more:\n   \
         keep `acknowledge` in retained memory. When `boots` does not rise over a restart of Beltgauge (no\n   \
         plc.state_file), numbers begin at 1: set `acknowledge` to 0. *)\n\
         PROGRAM BeltgaugeQueue\n\
         VAR\n    block : ARRAY[0..{last}] OF UINT; (* filled by the Modbus client *)\n    \
         heartbeat : UINT;\n    ahead : UINT;\n    decode : BeltgaugeDecode;\n    parcel : BeltgaugeParcel;\n    \
         new_parcel : BOOL; (* TRUE for one cycle: sort `parcel` *)\nEND_VAR\n\
         VAR RETAIN\n    acknowledge : UINT;\nEND_VAR\n\
         heartbeat := heartbeat + 1;\n\
         decode(block := block);\n\
         (* Later than the one that was taken last, numbers wrapping around. *)\n\
         ahead := UDINT_TO_UINT((decode.parcel.sequence MOD 65536 + 65536 - UINT_TO_UDINT(acknowledge)) MOD 65536);\n\
         new_parcel := decode.whole AND ahead > 0 AND ahead < 32768;\n\
         IF new_parcel THEN\n    parcel := decode.parcel;\n    \
         acknowledge := UDINT_TO_UINT(parcel.sequence MOD 65536);\nEND_IF;\nEND_PROGRAM\n",
        COMMAND + 1
    );
    text
}
