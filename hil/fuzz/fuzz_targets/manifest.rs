//! What a stick says of itself: the manifest with its signature, and the board of its stills. Parts
//! are separated by a byte 0.
#![no_main]

use beltgauge::config::public_key;
use beltgauge::fuzz::Board;
use beltgauge::store::manifest::Manifest;
use libfuzzer_sys::fuzz_target;

/// Of a key that nobody has.
const KEY: &str = "RWQf6LRCGA9i53mlYecO4IzT51TGPpvWucNSCh1CBM0QTaLn73Y7GFO3";

fuzz_target!(|text: &str| {
    let mut parts = text.split('\0');
    let first = parts.next().unwrap_or_default();
    if let Ok(manifest) = Manifest::parse(first) {
        let again = Manifest::parse(&manifest.to_text()).expect("its own text");
        assert!(again.files().eq(manifest.files()));
    }
    let _ = Board::parse(first);
    let _ = public_key(first);
    if let Some(signature) = parts.next() {
        let key = public_key(KEY).expect("a key");
        let verified = Manifest::verified(first.as_bytes(), signature.as_bytes(), &key);
        assert!(verified.is_err(), "nobody can sign for this key");
    }
});
