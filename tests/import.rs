//! `beltgauge import`: what a USB stick brings is taken whole or not at all.

mod common;

use beltgauge::store::{ImportResult, Store};
use common::{beltgauge, run, scratch, write_site};
use minisign::KeyPair;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

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

/// What the report on the stick says.
fn report(stick: &Path) -> String {
    fs::read_to_string(stick.join("beltgauge/report.txt")).expect("left on the stick")
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
        ("\"camera.toml\"", "\"gone.toml\"", &["gone.toml", "neither on the stick"]),
        ("[belt]", "[plc]\nstate_file = \"/tmp/x\"\n[belt]", &["plc.state_file", "leave it out"]),
        ("[belt]", "[limits]\nmemory_mib_max = 1\n[belt]", &["memory plan"]),
        ("[belt]", "[import]\npublic_key = \"no key\"\n[belt]", &["import.public_key", "minisign"]),
    ] {
        edit(&stick, from, to);
        refused(&stick, &store, words);
        fs::write(folder.join("beltgauge.toml"), &good).expect("room");
    }
    // Links out of the folder, to files and folders; what would wait for ever.
    fs::remove_file(folder.join("camera.toml")).expect("there");
    symlink(store.join("current/camera.toml"), folder.join("camera.toml")).expect("room");
    refused(&stick, &store, &["camera.toml", "plain files"]);
    for name in ["camera.toml", "beltgauge.toml"] {
        let _ = fs::remove_file(folder.join(name));
        let pipe = Command::new("mkfifo").arg(folder.join(name)).status();
        assert!(pipe.is_ok_and(|status| status.success()));
        refused(&stick, &store, &[name, "plain file"]);
        fs::remove_file(folder.join(name)).expect("there");
        fs::write(folder.join("beltgauge.toml"), &good).expect("room");
    }
    fs::remove_file(folder.join("beltgauge.toml")).expect("there");
    // A deep tree and a crowd are not walked.
    let mut deep = folder.clone();
    (0..200).for_each(|_| deep.push("d"));
    fs::create_dir_all(&deep).expect("room");
    (0..3000).for_each(|i| fs::write(folder.join(format!("{i}.png")), "").expect("room"));
    refused(&stick, &store, &["there is no file beltgauge.toml"]);
}

#[test]
fn a_stick_without_a_folder_of_ours_is_somebody_elses() {
    let (stick, store) = stick_and_store("import-nothing");
    fs::rename(stick.join("beltgauge"), stick.join("elsewhere")).expect("same disk");
    for link in [false, true] {
        if link {
            symlink("elsewhere", stick.join("beltgauge")).expect("room");
        }
        let output = import(&stick, &store);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains("there is no folder to import"), "{text}");
        assert!(!store.join("import.toml").exists() && !stick.join("report.txt").exists());
        assert!(!stick.join("elsewhere/report.txt").exists());
    }
}

#[test]
fn what_is_nearly_ours_is_told_by_name() {
    let (stick, store) = stick_and_store("import-nearly");
    let folder = stick.join("beltgauge");
    fs::rename(folder.join("beltgauge.toml"), folder.join("beltgauge.toml.txt"))
        .expect("same disk");
    refused(&stick, &store, &["no file beltgauge.toml", "exactly this name", "Windows"]);
    let said = report(&stick);
    assert!(said.contains("In the folder beltgauge of the stick: beltgauge.toml.txt, camera.toml"));
    assert!(said.contains("Expected: beltgauge.toml"), "{said}");
    fs::rename(folder.join("beltgauge.toml.txt"), folder.join("beltgauge.toml"))
        .expect("same disk");
    let nearly = stick.join("Beltgauge (1)");
    fs::rename(&folder, &nearly).expect("same disk");
    refused(&stick, &store, &["is called Beltgauge (1)", "rename it"]);
    let said = fs::read_to_string(nearly.join("report.txt")).expect("left there");
    assert!(said.contains("In the folder Beltgauge (1)"), "{said}");
    // A folder with a system alone is told the same.
    let system = stick.join("beltgauge-old");
    fs::create_dir(&system).expect("room");
    fs::write(system.join("beltgauge.efi"), "MZ").expect("room");
    fs::rename(&nearly, stick.join("aside")).expect("same disk");
    refused(&stick, &store, &["is called beltgauge-old"]);
    fs::remove_dir_all(&system).expect("there");
    fs::rename(stick.join("aside"), &nearly).expect("same disk");
    // Another case is no other name: FAT does not know it.
    fs::rename(&nearly, stick.join("BeltGauge")).expect("same disk");
    assert!(import(&stick, &store).status.success());
    assert!(stick.join("BeltGauge/report.txt").exists());
}

#[test]
fn a_stick_with_settings_alone_keeps_the_camera_in_force() {
    let (stick, store) = stick_and_store("import-settings");
    let camera = stick.join("beltgauge/camera.toml");
    let original = fs::read(&camera).expect("there");
    fs::remove_file(&camera).expect("there");
    refused(&stick, &store, &["camera.toml is neither on the stick nor in force"]);
    fs::write(&camera, &original).expect("room");
    accepted(&stick, &store);
    fs::remove_file(&camera).expect("there");
    edit(&stick, "speed_mm_per_s = 500", "speed_mm_per_s = 800");
    accepted(&stick, &store);
    assert!(report(&stick).contains("camera.toml is not on the stick: the one in force is used"));
    assert_eq!(fs::read(store.join("current/camera.toml")).expect("there"), original);
    // With a camera in force that cannot be read, nothing waits for it.
    fs::remove_file(store.join("current/camera.toml")).expect("there");
    let pipe = Command::new("mkfifo").arg(store.join("current/camera.toml")).status();
    assert!(pipe.is_ok_and(|status| status.success()));
    refused(&stick, &store, &["neither on the stick nor in force"]);
    let check = run(beltgauge().args(["check", "--store"]).arg(&store));
    let text = String::from_utf8_lossy(&check.stderr).into_owned();
    assert!(check.status.code() == Some(2) && text.contains("not a plain file"), "{text}");
}

#[test]
fn pipes_and_folders_in_the_store_make_nobody_wait() {
    let (stick, store) = stick_and_store("import-pipes");
    accepted(&stick, &store);
    let names = ["lock", "staging", "current.new", "import.toml", "report.txt", "trust.toml"];
    for name in names.into_iter().chain(["current/beltgauge.toml", "current/camera.toml"]) {
        for folder in [false, true] {
            let path = store.join(name);
            let _ = fs::remove_file(&path);
            let _ = fs::remove_dir_all(&path);
            if folder {
                fs::create_dir(&path).expect("room");
            } else {
                let pipe = Command::new("mkfifo").arg(&path).status();
                assert!(pipe.is_ok_and(|status| status.success()));
            }
            // It ends, one way or the other, and says so.
            let output = import(&stick, &store);
            let said = [output.stdout, output.stderr].concat();
            assert!(!said.is_empty(), "{name}");
            let _ = fs::remove_file(&path);
            let _ = fs::remove_dir_all(&path);
        }
    }
    accepted(&stick, &store);
}

#[test]
fn a_stick_that_cannot_be_written_is_imported_all_the_same() {
    let (stick, store) = stick_and_store("import-read-only");
    // A folder in its place: neither removed nor written.
    fs::create_dir(stick.join("beltgauge/report.txt")).expect("room");
    let output = import(&stick, &store);
    assert!(output.status.success());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("report.txt cannot be left on the stick"), "{text}");
    assert_eq!(Store::new(&store).last_import().result, ImportResult::Applied);
}

/// List and sign what is on the stick.
fn sign(keys: &KeyPair, stick: &Path, counter: u32) {
    let listed =
        run(beltgauge().arg("manifest").arg(stick).args(["--counter", &counter.to_string()]));
    assert!(listed.status.success(), "{}", String::from_utf8_lossy(&listed.stderr));
    let path = stick.join("beltgauge/manifest.toml");
    let bytes = fs::read(&path).expect("there");
    let signature =
        minisign::sign(Some(&keys.pk), &keys.sk, &bytes[..], None, None).expect("signs");
    fs::write(path.with_extension("toml.minisig"), signature.into_string()).expect("room");
}

fn key_pair() -> KeyPair {
    KeyPair::generate_unencrypted_keypair().expect("keys")
}

fn key_table(keys: &KeyPair) -> String {
    format!("[import]\npublic_key = \"{}\"\n[belt]", keys.pk.to_base64())
}

#[test]
fn with_a_key_in_force_only_whole_signed_sets_are_accepted() {
    let (stick, store) = stick_and_store("import-signed");
    let (keys, strangers) = (key_pair(), key_pair());
    // The first one need not be signed: there is no key yet.
    edit(&stick, "[belt]", &key_table(&keys));
    accepted(&stick, &store);
    refused(&stick, &store, &["what is not signed is refused", "manifest.toml is not there"]);
    sign(&strangers, &stick, 1);
    refused(&stick, &store, &["signature is not right"]);
    sign(&keys, &stick, 1);
    accepted(&stick, &store);
    let folder = stick.join("beltgauge");
    // One byte more, one byte else, one file less, one file more.
    for name in ["camera.toml", "beltgauge.toml"] {
        let path = folder.join(name);
        let before = fs::read_to_string(&path).expect("there");
        fs::write(&path, format!("{before}\n")).expect("room");
        refused(&stick, &store, &["not the one in the signed manifest", name]);
        fs::write(&path, before.replace("500", "501")).expect("room");
        refused(&stick, &store, &["not the one in the signed manifest", name]);
        fs::remove_file(&path).expect("there");
        refused(&stick, &store, &["a file of the signed manifest is not there", name]);
        fs::write(&path, before).expect("room");
    }
    let camera = fs::read(folder.join("camera.toml")).expect("there");
    fs::remove_file(folder.join("camera.toml")).expect("there");
    sign(&keys, &stick, 2);
    accepted(&stick, &store);
    fs::write(folder.join("camera.toml"), &camera).expect("room");
    refused(&stick, &store, &["the file is not in the signed manifest", "camera.toml"]);
    // The manifest itself.
    let manifest = folder.join("manifest.toml");
    let text = fs::read_to_string(&manifest).expect("there");
    fs::write(&manifest, text.replace("counter = 2", "counter = 9")).expect("room");
    refused(&stick, &store, &["signature is not right"]);
}

#[test]
fn an_older_signed_set_is_refused_and_rolling_back_stays_possible() {
    let (stick, store) = stick_and_store("import-counter");
    let keys = key_pair();
    edit(&stick, "[belt]", &key_table(&keys));
    accepted(&stick, &store);
    sign(&keys, &stick, 5);
    accepted(&stick, &store);
    accepted(&stick, &store);
    edit(&stick, "speed_mm_per_s = 500", "speed_mm_per_s = 800");
    for (counter, words) in [
        (5, "another set with the counter 5"),
        (4, "counter is 4, and one with 5 was taken before"),
    ] {
        sign(&keys, &stick, counter);
        refused(&stick, &store, &[words, "allowed", "--roll-back"]);
    }
    sign(&keys, &stick, 6);
    accepted(&stick, &store);
    let back = run(beltgauge().args(["import", "--roll-back", "--store"]).arg(&store));
    assert!(back.status.success());
    let text = fs::read_to_string(store.join("current/beltgauge.toml")).expect("in force");
    assert!(text.contains("= 500"), "{text}");
    let zero = run(beltgauge().arg("manifest").arg(&stick).args(["--counter", "0"]));
    assert_eq!(zero.status.code(), Some(2));
}

#[test]
fn a_key_outlives_the_configuration_and_only_its_owner_changes_it() {
    let (stick, store) = stick_and_store("import-key");
    let (keys, next) = (key_pair(), key_pair());
    let plain = fs::read_to_string(stick.join("beltgauge/beltgauge.toml")).expect("there");
    edit(&stick, "[belt]", &key_table(&keys));
    // As a flashed image has it: in force without an import.
    fs::create_dir_all(&store).expect("room");
    fs::rename(stick.join("beltgauge"), store.join("site-1")).expect("same disk");
    symlink("site-1", store.join("current")).expect("room");
    Store::new(&store).settle();
    fs::create_dir(stick.join("beltgauge")).expect("room");
    write_site(&stick.join("beltgauge"), SIZE);
    let refused_unsigned = || {
        let output = import(&stick, &store);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(text.contains("what is not signed is refused"), "{text}");
    };
    let in_force = store.join("current/beltgauge.toml");
    fs::write(&in_force, "[import]").expect("room");
    refused_unsigned();
    fs::remove_dir_all(store.join("site-1")).expect("there");
    refused_unsigned();
    fs::remove_file(store.join("current")).expect("there");
    refused_unsigned();
    // And what is signed repairs it. A set without a key leaves the key.
    sign(&keys, &stick, 1);
    accepted(&stick, &store);
    assert!(report(&stick).contains("the key in force stays"));
    refused_after_change(&stick, &store);
    // Another key comes with a set signed with the old one, and then the old one is worth nothing.
    let path = stick.join("beltgauge/beltgauge.toml");
    fs::write(&path, plain.replace("[belt]", &key_table(&next))).expect("room");
    sign(&next, &stick, 2);
    refused(&stick, &store, &["signature is not right"]);
    sign(&keys, &stick, 2);
    accepted(&stick, &store);
    sign(&keys, &stick, 3);
    refused(&stick, &store, &["signature is not right"]);
    sign(&next, &stick, 1);
    accepted(&stick, &store);
    // What is trusted being damaged opens no door.
    fs::write(store.join("trust.toml"), "public_").expect("room");
    let output = import(&stick, &store);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && text.contains("whom to trust is not known"), "{text}");
}

/// The configuration on the stick, changed after it was signed.
fn refused_after_change(stick: &Path, store: &Path) {
    edit(stick, "speed_mm_per_s = 500", "speed_mm_per_s = 501");
    refused(stick, store, &["not the one in the signed manifest"]);
    edit(stick, "speed_mm_per_s = 501", "speed_mm_per_s = 500");
}

#[test]
fn without_a_key_a_damaged_configuration_is_replaced() {
    let (stick, store) = stick_and_store("import-repair");
    accepted(&stick, &store);
    for damage in [&b"[import]"[..], &[0xff; 100]] {
        fs::write(store.join("current/beltgauge.toml"), damage).expect("room");
        accepted(&stick, &store);
        let check = run(beltgauge().args(["check", "--store"]).arg(&store));
        assert!(check.status.success());
    }
}

/// The process killed at any instant: the store holds one of the two, whole, and after the next
/// start it says which.
#[test]
fn an_import_that_is_killed_is_old_or_new_and_its_result_is_known() {
    let (stick, store) = stick_and_store("import-killed");
    let start = Instant::now();
    accepted(&stick, &store);
    // A little longer than one takes.
    let kill_us = 3 * start.elapsed().as_micros() as u64 / 2;
    let kept = Store::new(&store);
    let (mut seed, mut results, mut cut_off) = (1u32, [0; 3], 0);
    for round in 0..60 {
        let [from, to] = if round % 2 == 0 { ["= 500", "= 800"] } else { ["= 800", "= 500"] };
        edit(&stick, &format!("speed_mm_per_s {from}"), &format!("speed_mm_per_s {to}"));
        let before = fs::read(kept.config()).expect("in force");
        let count = kept.last_import().count;
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
        std::thread::sleep(Duration::from_micros(u64::from(seed) % kill_us));
        let _ = import.kill();
        let _ = import.wait();
        let noted = || fs::read_to_string(store.join("import.toml")).expect("kept");
        let is_cut_off = noted().contains("under_way");
        cut_off += u32::from(is_cut_off);
        // As every start does.
        kept.settle();
        assert!(!noted().contains("under_way"));
        kept.site().expect("whole");
        let now = fs::read(kept.config()).expect("in force");
        let record = kept.last_import();
        let on_stick = fs::read(stick.join("beltgauge/beltgauge.toml")).expect("there");
        let begun = record.count != count;
        assert!(record.count <= count + 1 && (begun || !is_cut_off), "{record:?}");
        let result = if begun { record.result } else { ImportResult::None };
        match result {
            ImportResult::Applied => assert_eq!(now, on_stick),
            _ => assert_eq!(now, before),
        }
        results[result as usize] += 1;
        let report = fs::read_to_string(store.join("report.txt")).expect("kept");
        assert_eq!(report.contains("is in force"), record.result == ImportResult::Applied);
        let mut names: Vec<String> = fs::read_dir(&store)
            .expect("there")
            .map(|entry| entry.expect("readable").file_name().into_string().expect("UTF-8"))
            .filter(|name| !name.starts_with("site-"))
            .collect();
        names.sort();
        // One is there after the first configuration, the other once a stick was taken whole.
        names.retain(|name| !["previous", "access.toml"].contains(&name.as_str()));
        assert_eq!(names, ["current", "import.toml", "lock", "report.txt", "trust.toml"]);
    }
    println!("not begun, applied, refused: {results:?}; {cut_off} of them ended by the next start");
    assert!(cut_off > 0, "every kill came too early or too late");
    accepted(&stick, &store);
}

/// The image cannot be written, or the process is killed while it is: every system stays.
#[test]
fn an_update_that_is_cut_off_leaves_every_system() {
    let (stick, store) = stick_and_store("update-killed");
    let mut image = vec![0; 300 << 10];
    image[..2].copy_from_slice(b"MZ");
    image[0x3c] = 0x80;
    image[0x80..0x84].copy_from_slice(b"PE\0\0");
    let machine = if cfg!(target_arch = "aarch64") { 0xaa64u16 } else { 0x8664 };
    image[0x84..0x86].copy_from_slice(&machine.to_le_bytes());
    fs::write(stick.join("beltgauge/beltgauge.efi"), image).expect("room");
    let boot = stick.with_file_name("boot");
    fs::create_dir(&boot).expect("room");
    let old = ["beltgauge-3.efi", "beltgauge-4+2-1.efi"];
    for name in old {
        fs::write(boot.join(name), name).expect("room");
    }
    // A limit on the size of files ends the process with a signal, or the write with an error.
    for limit in ["ulimit -f 64", "trap '' XFSZ; ulimit -f 64"] {
        let command = format!("{limit}; exec \"$0\" update \"$1\" --store \"$2\" --to \"$3\"");
        let program = env!("CARGO_BIN_EXE_beltgauge");
        let mut shell = Command::new("sh");
        let output = run(shell.arg("-c").arg(command).arg(program).args([&stick, &store, &boot]));
        assert!(!output.status.success());
        for name in old {
            assert_eq!(fs::read(boot.join(name)).expect("still there"), name.as_bytes());
        }
    }
    let update = run(beltgauge()
        .arg("update")
        .arg(&stick)
        .arg("--store")
        .arg(&store)
        .arg("--to")
        .arg(&boot));
    assert!(update.status.success(), "{}", String::from_utf8_lossy(&update.stderr));
    let mut names: Vec<_> =
        fs::read_dir(&boot).expect("there").map(|e| e.expect("readable").file_name()).collect();
    names.sort();
    assert_eq!(names, ["beltgauge-3.efi", "beltgauge-5+3.efi"]);
}
