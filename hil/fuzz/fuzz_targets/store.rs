//! The appliance's own notes of imports and of whom it trusts, damaged: `import.toml`, a byte 0,
//! `trust.toml`.
#![no_main]

use beltgauge::store::Store;
use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::LazyLock;

static ROOT: LazyLock<PathBuf> = LazyLock::new(|| {
    let root = std::env::temp_dir().join(format!("fuzz-store-{}", std::process::id()));
    std::fs::create_dir_all(&root).expect("room");
    root
});

fuzz_target!(|bytes: &[u8]| {
    let mut parts = bytes.splitn(2, |byte| *byte == 0);
    for name in ["import.toml", "trust.toml"] {
        std::fs::write(ROOT.join(name), parts.next().unwrap_or_default()).expect("room");
    }
    let store = Store::new(&ROOT);
    store.last_import();
    let _ = store.trust();
});
