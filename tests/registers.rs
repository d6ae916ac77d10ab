//! The committed documents of the PLC interface are those of the code.

use beltgauge::plc::{dbc, document, kits, structured_text};

fn is_current(name: &str, current: &str) {
    let path = format!("{}/config/{name}", env!("CARGO_MANIFEST_DIR"));
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, current).expect("writable");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == current,
        "config/{name} is out of date: BLESS=1 cargo test --test registers"
    );
}

#[test]
fn the_committed_register_map_is_current() {
    is_current("REGISTERS.md", &document::markdown());
    is_current("registers.csv", &document::csv());
}

#[test]
fn the_committed_dbc_is_current() {
    is_current("beltgauge.dbc", &dbc::document(beltgauge::config::Can::default().base_id));
}

#[test]
fn the_committed_structured_text_is_current() {
    is_current("plc.st", &structured_text::document());
}

#[test]
fn the_committed_kits_are_current() {
    for (name, current) in kits::documents() {
        is_current(&format!("kits/{name}"), &current);
    }
}
