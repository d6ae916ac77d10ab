//! The committed configuration files tell the truth.

use beltgauge::config::{Config, Site};
use std::path::Path;

const SMALLEST: &str = "[camera]\ncalibration = \"camera.toml\"\n\
    [zone]\nx_min_mm = -600\nx_max_mm = 600\ny_min_mm = -380\ny_max_mm = 380\n\
    [belt]\nspeed_mm_per_s = 500\n";

fn committed(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name);
    std::fs::read_to_string(path).expect("committed")
}

#[test]
fn the_reference_states_the_defaults() {
    let reference = Config::parse(&committed("reference.toml")).expect("valid");
    assert_eq!(reference, Config::parse(SMALLEST).expect("valid"));
}

#[test]
fn the_reference_has_every_key() {
    let text = committed("reference.toml");
    // The debug form names every field of every table.
    let fields = format!("{:#?}", Config::parse(SMALLEST).expect("valid"));
    let keys = fields.lines().filter_map(|l| l.trim().split_once(": ")).map(|(key, _)| key);
    let mut count = 0;
    for key in keys {
        count += 1;
        let written = format!("{key} =");
        assert!(
            text.contains(&written)
                || text.contains(&format!("[{key}]"))
                || text.contains(&format!(".{key}]")),
            "{key} is not in it"
        );
    }
    assert!(count > 25, "only {count} keys were found");
}

#[test]
fn the_example_site_is_valid() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/example/beltgauge.toml");
    Site::load(&path).expect("valid");
}
