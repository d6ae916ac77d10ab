//! The committed kits read what the server encodes.

use beltgauge::config::WordOrder;
use beltgauge::event::{Flags, ParcelRecord, Shape};
use beltgauge::plc::registers::{PARCEL_STRIDE, QUEUE_HEAD, RegisterImage, Status, VisionStatus};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/kits")
}

/// A parcel with every sign and size of value.
fn parcel() -> ParcelRecord {
    let mut flags = Flags::default();
    flags.set(Flags::CLIPPED, true);
    ParcelRecord {
        seq: 70_123,
        frame: 123_456,
        t_s: 98.765,
        length_mm: 235.1,
        width_mm: 124.8,
        height_mm: 70.2,
        yaw_deg: -12.34,
        x_mm: 61.5,
        y_mm: -240.3,
        sigma_length_mm: 0.3,
        sigma_width_mm: 0.25,
        sigma_height_mm: 7.5,
        belt_speed_mm_per_s: 500.3,
        shape: Shape::Box,
        flags,
        not_measured: None,
        may_be_used: true,
        belt_travel_mm: 429_496_700.1,
        by_encoder: true,
    }
}

fn status() -> Status {
    let mut vision = VisionStatus { ready: true, ..VisionStatus::default() };
    vision.belt_travel_mm = 429_496_800.1;
    vision.belt.seen_mm_per_s = Some(-512.3);
    vision.health.light_change = -0.25;
    Status { vision, running: true, ticket: 65_535, sequence: 70_123, ..Status::default() }
}

/// What a client reads, up to the queue's parcel.
fn registers(order: WordOrder) -> Vec<u16> {
    let mut image = RegisterImage::new(order);
    image.set_status(&status());
    image.publish(&parcel());
    image.set_queue_head(Some(&parcel()));
    image.read(0, QUEUE_HEAD + PARCEL_STRIDE).expect("the map has them").to_vec()
}

/// What a kit must make of these registers.
const DECODED: &[(&str, f64)] = &[
    ("is_known", 1.0),
    ("running", 1.0),
    ("belt_seen_mm_per_s", -512.3),
    ("light_change_percent", -25.0),
    ("next_ticket", 1.0),
    ("is_whole", 1.0),
    ("may_be_used", 1.0),
    ("is_box", 1.0),
    ("by_encoder", 1.0),
    ("sequence", 70_123.0),
    ("clipped", 1.0),
    ("merged", 0.0),
    ("length_mm", 235.1),
    ("width_mm", 124.8),
    ("height_mm", 70.2),
    ("yaw_deg", -12.34),
    ("x_mm", 61.5),
    ("y_mm", -240.3),
    ("sigma_length_mm", 0.3),
    ("sigma_width_mm", 0.25),
    ("sigma_height_mm", 7.5),
    ("quality_length_percent", 94.0),
    ("quality_width_percent", 95.0),
    ("quality_height_percent", 0.0),
    ("belt_speed_mm_per_s", 500.3),
    ("frame", 123_456.0),
    ("time_ms", 98_765.0),
    ("not_measured", 0.0),
    // The belt travel wraps between the parcel and now.
    ("x_now_mm", 161.5),
    ("ring_address", 520.0),
];

/// What a kit tells is what was encoded, but for what it does not tell.
fn check(decoded: &BTreeMap<String, f64>, lacks: &[&str]) {
    for (name, expected) in DECODED.iter().filter(|(name, _)| !lacks.contains(name)) {
        let value = *decoded.get(*name).unwrap_or_else(|| panic!("{name} is not told"));
        // A float has 24 bits.
        let close = (value - expected).abs() < 1e-6 * expected.abs().max(1.0);
        assert!(close, "{name} is {value}, not {expected}");
    }
}

/// Whether the language of a kit is there, as it is in the whole run of the tests.
fn is_there(program: &str) -> bool {
    let there = Command::new(program).arg("--version").output().is_ok_and(|o| o.status.success());
    if !there {
        eprintln!("{program} is not installed: its kit is not run");
    }
    there
}

/// The lines `name value` that a program prints about registers.
fn ask(program: &mut Command, registers: &[u16]) -> BTreeMap<String, f64> {
    let mut child = program
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap_or_else(|error| panic!("{program:?}: {error}"));
    let text: Vec<String> = registers.iter().map(ToString::to_string).collect();
    child.stdin.take().expect("piped").write_all(text.join(" ").as_bytes()).expect("reads");
    let output = child.wait_with_output().expect("ends");
    assert!(output.status.success(), "{program:?}");
    let line = |line: &str| {
        let (name, value) = line.rsplit_once(' ').expect("a name and a value");
        (name.to_owned(), value.parse().expect("a number"))
    };
    String::from_utf8_lossy(&output.stdout).lines().map(line).collect()
}

#[test]
fn c_reads_what_the_server_encodes() {
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("kits_decode");
    let compiled = Command::new("cc")
        .args(["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-I"])
        .arg(folder().join("c"))
        .arg("-o")
        .arg(&program)
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kits/decode.c"))
        .status()
        .expect("a C compiler is installed");
    assert!(compiled.success());
    let decoded = ask(&mut Command::new(&program), &registers(WordOrder::HighFirst));
    check(&decoded, &[]);
    let other_order = ask(&mut Command::new(&program), &registers(WordOrder::LowFirst));
    assert!(other_order["is_known"] == 0.0, "the other word order must be noticed");
}

#[test]
fn python_reads_what_the_server_encodes() {
    if !is_there("python3") {
        return;
    }
    let decode = |order| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kits/decode.py");
        let mut python = Command::new("python3");
        ask(python.arg(script).arg(folder().join("python")), &registers(order))
    };
    check(&decode(WordOrder::HighFirst), &["next_ticket", "ring_address"]);
    assert!(decode(WordOrder::LowFirst)["is_known"] == 0.0, "the other word order must be noticed");
}

#[test]
fn the_flow_takes_a_parcel_once_and_acknowledges_it_when_it_is_kept() {
    if !is_there("node") {
        return;
    }
    let run = |order| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kits/run_flow.js");
        let mut node = Command::new("node");
        ask(node.arg(script).arg(folder().join("node-red/flow.json")), &registers(order))
    };
    let told = run(WordOrder::HighFirst);
    let lacks = [
        "running",
        "belt_seen_mm_per_s",
        "light_change_percent",
        "next_ticket",
        "is_whole",
        "by_encoder",
        "x_now_mm",
        "ring_address",
    ];
    check(&told, &lacks);
    for (name, expected) in [
        ("utc", true),
        ("given twice", false),
        ("acknowledged before it was taken", false),
        ("given when it was taken", false),
        ("acknowledged when it was taken", true),
    ] {
        assert_eq!(told[name] > 0.0, expected, "{name}");
    }
    let other_order = run(WordOrder::LowFirst);
    assert!(other_order["is_known"] == 0.0, "the other word order must be noticed");
}
