//! The PLC's program as Structured Text, to be pasted into a project.

use super::iec::{Block, DataType, Shape, Variable, blocks, data_types};
use super::kits::map_version;
use std::fmt::Write;

/// The source.
pub fn document() -> String {
    let mut text = format!(
        "(* Beltgauge, register map {}: printed from the tables in src/plc/registers.rs.\n   \
         Word order high first, base address 0. *)\n\n",
        map_version()
    );
    for data_type in data_types() {
        write_type(&mut text, &data_type);
    }
    let blocks = blocks().map(|block| write_block(&block));
    text + &blocks.join("\n")
}

fn comment(text: &mut String, meaning: &str) {
    if !meaning.is_empty() {
        let _ = writeln!(text, "(* {} *)", meaning.replace('\n', "\n   "));
    }
}

fn declarations(text: &mut String, variables: &[Variable]) {
    for Variable { name, kind, meaning } in variables {
        let comment = if meaning.is_empty() { String::new() } else { format!(" (* {meaning} *)") };
        let _ = writeln!(text, "    {name} : {kind};{comment}");
    }
}

fn write_type(text: &mut String, DataType { name, meaning, shape }: &DataType) {
    comment(text, meaning);
    match shape {
        Shape::Array { last, of } => {
            let _ = writeln!(text, "TYPE {name} : ARRAY[0..{last}] OF {of};");
        }
        Shape::Struct(members) => {
            let _ = writeln!(text, "TYPE {name} :\nSTRUCT");
            declarations(text, members);
            text.push_str("END_STRUCT;\n");
        }
    }
    text.push_str("END_TYPE\n\n");
}

fn write_block(block: &Block) -> String {
    let mut text = String::new();
    comment(&mut text, &block.meaning);
    let _ = writeln!(text, "FUNCTION_BLOCK {}", block.name);
    for (kind, variables) in block.sections() {
        let _ = writeln!(text, "{kind}");
        declarations(&mut text, variables);
        text.push_str("END_VAR\n");
    }
    text + &block.body + "END_FUNCTION_BLOCK\n"
}
