//! The journal's file: as it is, and with slots whose check sums are right around any contents, as a
//! later or an earlier program would have written them.
#![no_main]

use beltgauge::fuzz::parse_journal;
use beltgauge::plc::journal::Journal;
use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::LazyLock;

/// As in `plc::journal::slots`.
const SLOT_BYTES: usize = 512;
const HEAD_BYTES: usize = 16;
const PLACES: [usize; 6] = [0, 4096, 8192, 8192 + 512, 8192 + 1024, 8192 + 63 * 512];
const FILE_BYTES: usize = 8192 + 64 * SLOT_BYTES;

static FILE: LazyLock<PathBuf> =
    LazyLock::new(|| std::env::temp_dir().join(format!("fuzz-journal-{}", std::process::id())));

fuzz_target!(|bytes: &[u8]| {
    parse_journal(bytes);
    let mut file = vec![0; FILE_BYTES];
    let mut rest = bytes;
    for place in PLACES {
        let Some((head, after)) = rest.split_first_chunk::<5>() else { break };
        let payload = &after[..after.len().min(usize::from(head[0]))];
        rest = &after[payload.len()..];
        let slot = &mut file[place..][..SLOT_BYTES];
        slot[..4].copy_from_slice(b"BGJ1");
        slot[4] = if place < 8192 { 1 } else { 2 };
        slot[6] = payload.len() as u8;
        slot[8..12].copy_from_slice(&head[1..]);
        let mut sum = crc32fast::Hasher::new();
        sum.update(&slot[..12]);
        sum.update(payload);
        slot[12..HEAD_BYTES].copy_from_slice(&sum.finalize().to_le_bytes());
        slot[HEAD_BYTES..][..payload.len()].copy_from_slice(payload);
    }
    std::fs::write(&*FILE, &file).expect("room");
    let journal = Journal::open(&FILE).expect("a file that nobody else uses");
    assert!(journal.records().len() <= PLACES.len());
});
