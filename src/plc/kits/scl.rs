//! The PLC's program as a source of Siemens' SCL, for TIA Portal.

use super::map_version;
use crate::plc::iec::{Block, Shape, Variable, blocks, data_types};
use std::fmt::Write;

/// The source.
pub fn document() -> String {
    let mut text = format!(
        "// Beltgauge, register map {}: printed from the tables in src/plc.\n\
         // NOT COMPILED BY US: TIA Portal was not to be had. The statements are those of config/plc.st.\n\
         // TIA Portal: External source files, Add new external file, then Generate blocks from source.\n\
         // For S7-1200 and S7-1500. Read the registers with MB_CLIENT. Word order high first, base address 0.\n\n",
        map_version()
    );
    for data_type in data_types() {
        // Arrays have no name in SCL: they are written where they are used.
        let Shape::Struct(members) = &data_type.shape else { continue };
        let _ = writeln!(text, "TYPE \"{}\"\nVERSION : 0.1\n    STRUCT", data_type.name);
        declarations(&mut text, "        ", members);
        text.push_str("    END_STRUCT;\nEND_TYPE\n\n");
    }
    for block in blocks() {
        write_block(&mut text, &block);
    }
    text
}

/// A type as SCL writes it.
fn type_of(kind: &str) -> String {
    let elementary = match kind {
        "BOOL" => "Bool",
        "INT" => "Int",
        "UINT" => "UInt",
        "DINT" => "DInt",
        "UDINT" => "UDInt",
        "REAL" => "Real",
        _ => "",
    };
    let named = data_types().into_iter().find(|data_type| data_type.name == kind);
    match named.map(|data_type| data_type.shape) {
        Some(Shape::Array { last, of }) => format!("Array[0..{last}] of {}", type_of(of)),
        _ if elementary.is_empty() => format!("\"{kind}\""),
        _ => elementary.to_owned(),
    }
}

fn declarations(text: &mut String, indent: &str, variables: &[Variable]) {
    for Variable { name, kind, meaning } in variables {
        let comment = if meaning.is_empty() { String::new() } else { format!("   // {meaning}") };
        let _ = writeln!(text, "{indent}{name} : {};{comment}", type_of(kind));
    }
}

fn write_block(text: &mut String, block: &Block) {
    for line in block.meaning.lines() {
        let _ = writeln!(text, "// {line}");
    }
    let _ = writeln!(
        text,
        "FUNCTION_BLOCK \"{}\"\n{{ S7_Optimized_Access := 'TRUE' }}\nVERSION : 0.1",
        block.name
    );
    for (kind, variables) in block.sections() {
        let _ = writeln!(text, "{kind}");
        declarations(text, "    ", variables);
        text.push_str("END_VAR\n");
    }
    text.push_str("BEGIN\n");
    for line in block.body.lines() {
        if !line.trim_start().starts_with("(*") {
            let _ = writeln!(text, "    {}", with_marks(line, block));
        }
    }
    text.push_str("END_FUNCTION_BLOCK\n\n");
}

/// A statement with the mark of local variables; members and the names of parameters have none.
fn with_marks(line: &str, block: &Block) -> String {
    let is_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let (mut marked, mut rest) = (String::new(), line);
    while let Some(first) = rest.chars().next() {
        let end = rest.find(|c| is_word(c) != is_word(first)).unwrap_or(rest.len());
        let (word, after) = rest.split_at(end);
        let is_local =
            block.sections().any(|(_, variables)| variables.iter().any(|v| v.name == word));
        let is_parameter = marked.ends_with('(') && after.starts_with(" :=");
        if is_local && !marked.ends_with('.') && !is_parameter {
            marked.push('#');
        }
        marked.push_str(word);
        rest = after;
    }
    marked
}
