//! The committed register map is the one in the code.

use beltgauge::plc::registers;

#[test]
fn the_committed_register_map_is_current() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/config/REGISTERS.md");
    let current = registers::document();
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(path, &current).expect("writable");
    }
    let committed = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        committed == current,
        "config/REGISTERS.md is out of date: BLESS=1 cargo test --test registers"
    );
}
