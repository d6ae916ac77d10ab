//! `beltgauge import`: what a USB stick brings is taken whole or not at all.

mod common;

use common::{beltgauge, run, scratch, write_site};
use minisign::KeyPair;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::time::Duration;

const SIZE: [usize; 2] = [320, 240];

/// A stick with a valid site, and an empty store.
fn stick_and_store(name: &str) -> (PathBuf, PathBuf) {
    let root = scratch(name);
    let (stick, store) = (root.join("stick"), root.join("store"));
    fs::create_dir_all(stick.join("beltgauge")).expect("room");
    write_site(&stick.join("beltgauge"), SIZE);
    (stick, store)
}

fn import(stick: &Path, store: &Path) -> Output {
    run(beltgauge().arg("import").arg(stick).arg("--store").arg(store))
}

fn accepted(stick: &Path, store: &Path) {
    let output = import(stick, store);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report = fs::read_to_string(stick.join("beltgauge/report.txt")).expect("left on the stick");
    assert!(report.contains("is in force"), "{report}");
    assert_eq!(report, fs::read_to_string(store.join("report.txt")).expect("kept"));
}

/// It is refused with these words, and what was in force stays.
fn refused(stick: &Path, store: &Path, words: &[&str]) {
    let before = fs::read_to_string(store.join("current/beltgauge.toml")).ok();
    let output = import(stick, store);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{words:?}: {text}");
    for word in words {
        assert!(text.contains(word), "no {word:?} in:\n{text}");
    }
    assert!(!text.contains("panicked"), "{text}");
    assert_eq!(fs::read_to_string(store.join("current/beltgauge.toml")).ok(), before);
    let report = fs::read_to_string(store.join("report.txt")).expect("kept");
    assert!(report.starts_with("Refused"), "{report}");
}

fn edit(stick: &Path, from: &str, to: &str) {
    let path = stick.join("beltgauge/beltgauge.toml");
    let text = fs::read_to_string(&path).expect("there");
    assert!(text.contains(from), "{from}");
    fs::write(&path, text.replace(from, to)).expect("room");
}

#[test]
fn a_site_is_put_in_force_and_taken_back() {
    let (stick, store) = stick_and_store("import-good");
    accepted(&stick, &store);
    let check = |speed: &str| {
        let output = run(beltgauge().args(["check", "--store"]).arg(&store));
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let text = fs::read_to_string(store.join("current/beltgauge.toml")).expect("in force");
        assert!(text.contains(speed), "{text}");
    };
    check("= 500");
    edit(&stick, "speed_mm_per_s = 500", "speed_mm_per_s = 800");
    accepted(&stick, &store);
    check("= 800");
    for speed in ["= 500", "= 800"] {
        let back = run(beltgauge().args(["import", "--roll-back", "--store"]).arg(&store));
        assert!(back.status.success());
        check(speed);
    }
    let record = fs::read_to_string(store.join("import.toml")).expect("kept");
    assert!(record.contains("count = 4") && record.contains("rolled_back"), "{record}");
}

#[test]
fn garbage_is_refused_with_its_reason_and_harms_nothing() {
    let (stick, store) = stick_and_store("import-garbage");
    let folder = stick.join("beltgauge");
    accepted(&stick, &store);
    let good = fs::read(folder.join("beltgauge.toml")).expect("there");
    let with = |name: &str, bytes: &[u8], words: &[&str]| {
        let path = folder.join(name);
        let before = fs::read(&path).expect("there");
        fs::write(&path, bytes).expect("room");
        refused(&stick, &store, words);
        fs::write(&path, before).expect("room");
    };
    with("beltgauge.toml", b"", &["missing field"]);
    with("beltgauge.toml", &[0xfe; 99], &["not UTF-8", "remedy"]);
    with("beltgauge.toml", &vec![b' '; 300 << 10], &["too large", "262144 bytes"]);
    with("camera.toml", b"image_size_px = [320, 240]\n", &["camera.toml"]);
    for (from, to, words) in [
        ("= -300", "= -90000", &["zone.x_min_mm"][..]),
        ("\"camera.toml\"", "\"/etc/passwd\"", &["camera.calibration", "beside"]),
        ("\"camera.toml\"", "\"../camera.toml\"", &["camera.calibration", "beside"]),
        ("\"camera.toml\"", "\"beltgauge.toml\"", &["camera.calibration"]),
        ("\"camera.toml\"", "\"gone.toml\"", &["gone.toml", "cannot open"]),
        ("[belt]", "[plc]\nstate_file = \"/tmp/x\"\n[belt]", &["plc.state_file", "leave it out"]),
        ("[belt]", "[limits]\nmemory_mib_max = 1\n[belt]", &["memory plan"]),
        ("[belt]", "[import]\npublic_key = \"no key\"\n[belt]", &["import.public_key", "minisign"]),
    ] {
        edit(&stick, from, to);
        refused(&stick, &store, words);
        fs::write(folder.join("beltgauge.toml"), &good).expect("room");
    }
    // Links out of the folder, to files and folders.
    fs::remove_file(folder.join("camera.toml")).expect("there");
    symlink(store.join("current/camera.toml"), folder.join("camera.toml")).expect("room");
    refused(&stick, &store, &["camera.toml", "plain files"]);
    fs::rename(&folder, stick.join("elsewhere")).expect("same disk");
    symlink("elsewhere", &folder).expect("room");
    refused(&stick, &store, &["there is no folder to import"]);
    fs::remove_file(&folder).expect("a link");
    refused(&stick, &store, &["there is no folder to import"]);
    // A deep tree and a crowd are not walked.
    let mut deep = folder.clone();
    (0..200).for_each(|_| deep.push("d"));
    fs::create_dir_all(&deep).expect("room");
    (0..3000).for_each(|i| fs::write(folder.join(format!("{i}.png")), "").expect("room"));
    refused(&stick, &store, &["beltgauge.toml", "cannot open"]);
}

/// Sign a file of the stick.
fn sign(keys: &KeyPair, stick: &Path, name: &str) {
    let path = stick.join("beltgauge").join(name);
    let bytes = fs::read(&path).expect("there");
    let signature =
        minisign::sign(Some(&keys.pk), &keys.sk, &bytes[..], None, None).expect("signs");
    fs::write(path.with_file_name(format!("{name}.minisig")), signature.into_string())
        .expect("room");
}

#[test]
fn with_a_key_in_force_only_what_is_signed_is_accepted() {
    let (stick, store) = stick_and_store("import-signed");
    let (keys, strangers) =
        [0, 1].map(|_| KeyPair::generate_unencrypted_keypair().expect("keys")).into();
    let key = format!("[import]\npublic_key = \"{}\"\n[belt]", keys.pk.to_base64());
    // The first one need not be signed: there is no key yet.
    edit(&stick, "[belt]", &key);
    accepted(&stick, &store);
    refused(&stick, &store, &["beltgauge.toml.minisig is not there"]);
    let sign_all =
        |keys: &KeyPair| ["beltgauge.toml", "camera.toml"].map(|n| sign(keys, &stick, n));
    sign_all(&strangers);
    refused(&stick, &store, &["signature is not right"]);
    sign_all(&keys);
    accepted(&stick, &store);
    // One byte more in either file.
    for name in ["camera.toml", "beltgauge.toml"] {
        let path = stick.join("beltgauge").join(name);
        let before = fs::read(&path).expect("there");
        fs::write(&path, [&before[..], b"\n"].concat()).expect("room");
        refused(&stick, &store, &["signature is not right", name]);
        fs::write(&path, before).expect("room");
    }
    // A configuration in force that cannot be read opens no door.
    fs::write(store.join("current/beltgauge.toml"), "[import]").expect("room");
    refused(&stick, &store, &["current/beltgauge.toml"]);
}

/// The process killed at any instant: the store holds one of the two, whole.
#[test]
fn an_import_that_is_killed_leaves_the_old_or_the_new_configuration() {
    let (stick, store) = stick_and_store("import-killed");
    accepted(&stick, &store);
    let (mut seed, mut completed) = (1u32, 0);
    for round in 0..100 {
        let [from, to] = if round % 2 == 0 { ["= 500", "= 800"] } else { ["= 800", "= 500"] };
        edit(&stick, &format!("speed_mm_per_s {from}"), &format!("speed_mm_per_s {to}"));
        let mut import = beltgauge()
            .arg("import")
            .arg(&stick)
            .arg("--store")
            .arg(&store)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("starts");
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        // An import takes some 10 ms.
        std::thread::sleep(Duration::from_micros(u64::from(seed >> 16) % 12_000));
        let _ = import.kill();
        completed += u32::from(import.wait().is_ok_and(|status| status.success()));
        let check = run(beltgauge().args(["check", "--store"]).arg(&store));
        assert!(check.status.success(), "{}", String::from_utf8_lossy(&check.stderr));
    }
    println!("{completed} of 100 imports were faster than the kill");
    accepted(&stick, &store);
}
