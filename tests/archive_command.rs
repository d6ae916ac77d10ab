//! `beltgauge archive` as a service desk uses it.

use beltgauge::archive::{Archive, Entry, Kind};
use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(30);

/// A folder with an archive of three entries, and the archive's place in it.
fn site(name: &str) -> (PathBuf, PathBuf) {
    let folder = std::env::temp_dir()
        .join(format!("beltgauge-archive-command-{name}-{}", std::process::id()));
    let _ = fs::remove_dir_all(&folder);
    let inside = folder.join("archive");
    let archive = Archive::start(&inside, 64 << 20).expect("starts");
    let entry = |kind, text: &str, picture: &[u8]| Entry {
        kind,
        utc_ms: 1_795_000_000_000,
        text: text.into(),
        picture: picture.to_vec(),
    };
    archive.put(entry(Kind::Event, r#"{"kind":"started","code":0,"detail":"0.1.0"}"#, b""));
    archive.put(entry(
        Kind::Parcel,
        r#"{"seq":7,"length_mm":235.1,"width_mm":124.8,"height_mm":70.2,"flags":["merged"],"not_measured":null}"#,
        b"a picture",
    ));
    archive.put(entry(
        Kind::Parcel,
        r#"{"seq":8,"length_mm":0,"width_mm":0,"height_mm":0,"flags":[],"not_measured":"lost"}"#,
        b"",
    ));
    let start = Instant::now();
    while archive.condition().written < 3 {
        assert!(start.elapsed() < PATIENCE, "{:?}", archive.condition());
        std::thread::yield_now();
    }
    archive.finish(PATIENCE);
    (folder, inside)
}

fn archive(what: &[&str], folder: &PathBuf) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_beltgauge"));
    command.arg("archive").args(what).arg("--folder").arg(folder).output().expect("runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn what_was_seen_is_listed_exported_and_verified() {
    let (folder, inside) = site("whole");
    let listed = text(&archive(&["list", "--last", "2"], &inside).stdout);
    let lines: Vec<&str> = listed.lines().collect();
    assert_eq!(lines.len(), 2, "{listed}");
    assert!(lines[0].ends_with("parcel #8 not measured: lost"), "{listed}");
    assert!(lines[1].ends_with("parcel #7 235.1 x 124.8 x 70.2 mm merged"), "{listed}");
    let path = |name: &str| folder.join(name).display().to_string();
    let (csv, jsonl, pictures) = (path("p.csv"), path("all.jsonl"), path("pictures"));
    let what = ["export", "--csv", &csv, "--jsonl", &jsonl, "--pictures", &pictures];
    let exported = archive(&what, &inside);
    assert_eq!(text(&exported.stdout).trim(), "3 entries, 2 of them parcels, 1 pictures");
    let lines = fs::read_to_string(&csv).expect("written");
    assert_eq!(lines.lines().count(), 3, "a header and two parcels");
    assert!(lines.contains(",7,235.1,124.8,70.2,"), "{lines}");
    for line in fs::read_to_string(&jsonl).expect("written").lines() {
        serde_json::from_str::<serde_json::Value>(line).expect("JSON");
    }
    assert_eq!(fs::read(folder.join("pictures/00000002.jpg")).expect("written"), b"a picture");
    let verified = archive(&["verify"], &inside);
    assert!(verified.status.success(), "{}", text(&verified.stderr));
    assert!(text(&verified.stdout).starts_with("whole: 3 entries, 1 to 3"));
}

#[test]
fn a_changed_archive_fails_and_an_export_into_it_is_refused() {
    let (folder, inside) = site("changed");
    let segment = inside.join(format!("{:020}.bga", 1));
    let mut bytes = fs::read(&segment).expect("there");
    for option in ["--csv", "--jsonl", "--pictures"] {
        let refused = archive(&["export", option, &segment.display().to_string()], &inside);
        assert_eq!(refused.status.code(), Some(2), "{option}");
        assert!(text(&refused.stderr).contains("is in the archive"), "{option}");
    }
    assert_eq!(fs::read(&segment).expect("there"), bytes, "untouched");
    let at = bytes.windows(5).position(|w| w == b"235.1").expect("written there");
    bytes[at] = b'9';
    fs::write(&segment, &bytes).expect("room");
    let verified = archive(&["verify"], &inside);
    assert_eq!(verified.status.code(), Some(1));
    assert!(text(&verified.stderr).contains("entry 2 was changed"), "{}", text(&verified.stderr));
    // What cannot be read any more is missing from the list, and the list says so.
    let head = bytes[..at].windows(4).rposition(|w| w == b"BGEN").expect("the entry's head");
    bytes[head] = b'X';
    fs::write(&segment, &bytes).expect("room");
    let listed = text(&archive(&["list"], &inside).stdout);
    let lines: Vec<&str> = listed.lines().collect();
    assert!(lines.len() == 2 && lines[0].contains("started"), "{listed}");
    assert_eq!(lines[1], "warning: 00000000000000000001.bga: damaged where entry 2 should be");
    assert_eq!(archive(&["list"], &folder.join("nowhere")).status.code(), Some(2));
}
