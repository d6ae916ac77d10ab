//! The fleet's committed documents are those of the code.

use beltgauge::fleet::parcel_schema;
use std::path::Path;

#[test]
fn the_schema_of_a_parcel_is_the_one_that_is_told() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/fleet/parcel.schema.json");
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, parcel_schema()).expect("writable");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == parcel_schema(),
        "config/fleet/parcel.schema.json is out of date: BLESS=1 cargo test --test fleet_documents"
    );
}
