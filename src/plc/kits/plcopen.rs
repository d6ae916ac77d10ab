//! The PLC's program as XML of PLCopen's technical committee 6.

use super::map_version;
use crate::plc::iec::{DataType, Shape, Variable, blocks, data_types};
use std::fmt::Write;

/// Which edition of the format, as its readers want it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Edition {
    /// 2.0: CODESYS, TwinCAT.
    Tc6V0200,
    /// 2.01: Beremiz, OpenPLC.
    Tc6V0201,
}

impl Edition {
    fn namespace(self) -> &'static str {
        match self {
            Self::Tc6V0200 => "http://www.plcopen.org/xml/tc6_0200",
            Self::Tc6V0201 => "http://www.plcopen.org/xml/tc6_0201",
        }
    }

    /// Text; each reader looks for another element.
    fn text(self, text: &str) -> String {
        let element = match self {
            Self::Tc6V0200 => "xhtml",
            Self::Tc6V0201 => "p",
        };
        let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
        format!("<xhtml:{element}>{text}</xhtml:{element}>")
    }

    fn documentation(self, meaning: &str) -> String {
        if meaning.is_empty() {
            return String::new();
        }
        format!("<documentation>{}</documentation>", self.text(meaning))
    }
}

/// The project, with data types and function blocks and without a configuration.
pub fn document(edition: Edition) -> String {
    let scaling = "<scaling x=\"1\" y=\"1\"/>";
    // The time is part of the format; a file that is printed again must not change.
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n\
         <!-- Beltgauge, register map {version}: printed from the tables in src/plc. Word order high first, base address 0. -->\n\
         <project xmlns=\"{}\" xmlns:xhtml=\"http://www.w3.org/1999/xhtml\">\n\
         <fileHeader companyName=\"Beltgauge\" productName=\"Beltgauge\" productVersion=\"{version}\" creationDateTime=\"2026-01-01T00:00:00\"/>\n\
         <contentHeader name=\"Beltgauge\">\n<coordinateInfo><fbd>{scaling}</fbd><ld>{scaling}</ld><sfc>{scaling}</sfc></coordinateInfo>\n</contentHeader>\n\
         <types>\n<dataTypes>\n",
        edition.namespace(),
        version = map_version()
    );
    for data_type in data_types() {
        write_type(&mut text, &data_type, edition);
    }
    text.push_str("</dataTypes>\n<pous>\n");
    for block in blocks() {
        let _ =
            writeln!(text, "<pou name=\"{}\" pouType=\"functionBlock\">\n<interface>", block.name);
        for (section, variables) in block.sections() {
            let element = match section {
                "VAR_INPUT" => "inputVars",
                "VAR_OUTPUT" => "outputVars",
                _ => "localVars",
            };
            let retain = if section == "VAR RETAIN" { " retain=\"true\"" } else { "" };
            let _ = writeln!(text, "<{element}{retain}>");
            declarations(&mut text, variables, edition);
            let _ = writeln!(text, "</{element}>");
        }
        let _ = writeln!(
            text,
            "</interface>\n<body><ST>{}</ST></body>\n{}\n</pou>",
            edition.text(&format!("\n{}", block.body)),
            edition.documentation(&block.meaning)
        );
    }
    text.push_str("</pous>\n</types>\n<instances><configurations/></instances>\n</project>\n");
    text
}

/// A type's element: elementary ones have their own.
fn type_of(kind: &str) -> String {
    match kind {
        "BOOL" | "INT" | "UINT" | "DINT" | "UDINT" | "REAL" => format!("<{kind}/>"),
        _ => format!("<derived name=\"{kind}\"/>"),
    }
}

fn declarations(text: &mut String, variables: &[Variable], edition: Edition) {
    for Variable { name, kind, meaning } in variables {
        let (kind, meaning) = (type_of(kind), edition.documentation(meaning));
        let _ = writeln!(text, "<variable name=\"{name}\"><type>{kind}</type>{meaning}</variable>");
    }
}

fn write_type(text: &mut String, data_type: &DataType, edition: Edition) {
    let _ = writeln!(text, "<dataType name=\"{}\">\n<baseType>", data_type.name);
    match &data_type.shape {
        Shape::Array { last, of } => {
            let of = type_of(of);
            let _ = writeln!(
                text,
                "<array><dimension lower=\"0\" upper=\"{last}\"/><baseType>{of}</baseType></array>"
            );
        }
        Shape::Struct(members) => {
            text.push_str("<struct>\n");
            declarations(text, members, edition);
            text.push_str("</struct>\n");
        }
    }
    let _ = writeln!(text, "</baseType>\n{}</dataType>", edition.documentation(data_type.meaning));
}
