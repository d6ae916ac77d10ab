//! The PLC's program in PLCopen's XML and in SCL is that of `config/plc.st`.

use beltgauge::plc::iec::{Block, Shape, blocks, data_types};
use beltgauge::plc::kits::plcopen::{self, Edition};
use beltgauge::plc::kits::scl;
use beltgauge::plc::structured_text;
use quick_xml::Reader;
use quick_xml::events::Event;

/// An element that was read: the names from the root to it, with the attribute `name`, and its text.
#[derive(Debug, Default)]
struct Element {
    path: String,
    text: String,
}

/// All elements of a document that is well formed.
fn elements(xml: &str) -> Vec<Element> {
    let mut reader = Reader::from_str(xml);
    let (mut found, mut open): (Vec<Element>, Vec<usize>) = (Vec::new(), Vec::new());
    loop {
        let event = reader.read_event().unwrap_or_else(|error| {
            panic!("not well formed at byte {}: {error}", reader.buffer_position())
        });
        match event {
            Event::Start(ref start) | Event::Empty(ref start) => {
                let mut path =
                    open.last().map_or(String::new(), |&at| found[at].path.clone() + "/");
                path += start.name().as_ref();
                for attribute in start.attributes() {
                    let attribute = attribute.expect("well formed");
                    if ["name", "retain", "upper"].contains(&attribute.key.as_ref()) {
                        path.extend(["[", &*attribute.value, "]"]);
                    }
                }
                found.push(Element { path, text: String::new() });
                if matches!(event, Event::Start(_)) {
                    open.push(found.len() - 1);
                }
            }
            Event::End(_) => drop(open.pop()),
            Event::Text(text) => {
                if let Some(&at) = open.last() {
                    found[at].text += &text;
                }
            }
            Event::GeneralRef(reference) => {
                let character = match &*reference {
                    "lt" => '<',
                    "gt" => '>',
                    "amp" => '&',
                    other => panic!("&{other};"),
                };
                found[*open.last().expect("in an element")].text.push(character);
            }
            Event::Eof => break,
            _ => {}
        }
    }
    assert!(open.is_empty(), "{} elements are not ended", open.len());
    found
}

const ELEMENTARY: [&str; 6] = ["BOOL", "INT", "UINT", "DINT", "UDINT", "REAL"];

fn type_element(kind: &str) -> String {
    if ELEMENTARY.contains(&kind) { kind.to_owned() } else { format!("derived[{kind}]") }
}

#[test]
fn plcopen_xml_has_the_types_and_blocks_of_the_structured_text() {
    let source = structured_text::document();
    for (edition, text) in [(Edition::Tc6V0200, "xhtml:xhtml"), (Edition::Tc6V0201, "xhtml:p")] {
        let found = elements(&plcopen::document(edition));
        let has = |path: &str| {
            assert!(found.iter().any(|element| element.path == path), "{edition:?} lacks {path}");
        };
        for data_type in data_types() {
            let base = format!("project/types/dataTypes/dataType[{}]/baseType", data_type.name);
            match data_type.shape {
                Shape::Array { last, of } => {
                    has(&format!("{base}/array/dimension[{last}]"));
                    has(&format!("{base}/array/baseType/{of}"));
                    assert!(source.contains(&format!("ARRAY[0..{last}] OF {of};")));
                }
                Shape::Struct(members) => members.iter().for_each(|member| {
                    let kind = type_element(member.kind);
                    has(&format!("{base}/struct/variable[{}]/type/{kind}", member.name));
                    assert!(source.contains(&format!("{} : {};", member.name, member.kind)));
                }),
            }
        }
        for block in blocks() {
            let pou = format!("project/types/pous/pou[{}]", block.name);
            for (section, variables) in block.sections() {
                let element = match section {
                    "VAR_INPUT" => "inputVars",
                    "VAR_OUTPUT" => "outputVars",
                    "VAR" => "localVars",
                    _ => "localVars[true]",
                };
                for variable in variables {
                    let kind = type_element(variable.kind);
                    has(&format!(
                        "{pou}/interface/{element}/variable[{}]/type/{kind}",
                        variable.name
                    ));
                }
            }
            let body = format!("{pou}/body/ST/{text}");
            let body = found.iter().find(|element| element.path == body).expect("a body");
            assert!(body.text.len() > 100, "{}", block.name);
            assert!(source.contains(&body.text), "{} has other statements", block.name);
        }
    }
}

/// The statements of a block in SCL, without what SCL alone wants.
fn statements(source: &str, block: &Block) -> String {
    let begin = format!("FUNCTION_BLOCK \"{}\"", block.name);
    let (_, after) = source.split_once(&begin).expect("the block is there");
    let (_, body) = after.split_once("BEGIN\n").expect("it begins");
    let (body, _) = body.split_once("END_FUNCTION_BLOCK").expect("it ends");
    let lines = body.lines().map(|line| line.strip_prefix("    ").expect("indented"));
    lines.map(|line| line.replace('#', "") + "\n").collect()
}

#[test]
fn scl_has_the_types_and_blocks_of_the_structured_text() {
    let source = scl::document();
    assert!(source.contains("NOT COMPILED BY US"));
    for data_type in data_types() {
        let Shape::Struct(members) = data_type.shape else { continue };
        assert!(source.contains(&format!("TYPE \"{}\"\n", data_type.name)));
        for member in members {
            let declared = format!("{} : {};", member.name, member.kind).to_uppercase();
            assert!(source.to_uppercase().contains(&declared), "{declared}");
        }
    }
    for block in blocks() {
        let without_comments = |text: &str| -> String {
            let code = text.lines().filter(|line| !line.trim_start().starts_with("(*"));
            code.map(|line| line.to_owned() + "\n").collect()
        };
        assert_eq!(statements(&source, &block), without_comments(&block.body), "{}", block.name);
    }
}

/// TIA Portal takes a name without its mark for that of a global one.
#[test]
fn scl_marks_every_local_variable_and_nothing_else() {
    let source = scl::document();
    for line in [
        "#decode(block := #block);",
        "#parcel.x_mm := DINT_TO_REAL(DWORD_TO_DINT(UDINT_TO_DWORD(UINT_TO_UDINT(#block[8]) * 65536 + UINT_TO_UDINT(#block[9])))) / 10.0;",
        "IF #taken[#i] = #decode.parcel.sequence THEN",
        "FOR #i := 0 TO 31 DO",
        "#kept_ticket := UDINT_TO_UINT((UINT_TO_UDINT(#ticket_done) MOD 65535) + 1);",
        "#may_be_used := #whole AND ((#parcel.valid MOD 2) = 1);",
    ] {
        assert!(source.contains(line), "{line}");
    }
}
