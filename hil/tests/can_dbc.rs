//! The frames that are sent, decoded by cantools with the committed DBC.

use beltgauge::event::{Flags, ParcelRecord};
use beltgauge::plc::frames::{self, Frame};
use beltgauge::plc::registers::{Status, VisionStatus};
use hil::project;
use hil::server::record;
use serde_json::{Map, Value};
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::{Command, Stdio};

/// What cantools makes of frames.
fn decode(frames: &[Frame]) -> Vec<Map<String, Value>> {
    let mut lines = String::new();
    for frame in frames {
        let _ = write!(lines, "{:x}#", 0x500 + frame.message as u16);
        for byte in &frame.payload {
            let _ = write!(lines, "{byte:02x}");
        }
        lines.push('\n');
    }
    let mut child = Command::new(project().join("target/hil-venv/bin/python"))
        .arg(project().join("hil/clients/decode_can.py"))
        .arg(project().join("config/beltgauge.dbc"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect(".ci/run makes the environment, with cantools");
    child.stdin.take().expect("piped").write_all(lines.as_bytes()).expect("reads");
    let output = child.wait_with_output().expect("ends");
    assert!(output.status.success());
    serde_json::from_slice(&output.stdout).expect("JSON")
}

fn all_signals(decoded: Vec<Map<String, Value>>) -> Map<String, Value> {
    decoded.into_iter().flatten().collect()
}

fn is(signals: &Map<String, Value>, name: &str, expected: f64) {
    let value = signals[name].as_f64().unwrap_or_else(|| panic!("no {name} in {signals:?}"));
    assert!((value - expected).abs() < 1e-6 * expected.abs().max(1.0), "{name}: {value}");
}

#[test]
fn cantools_reads_a_parcel_from_segments_and_from_one_can_fd_frame() {
    let mut flags = Flags::default();
    flags.set(Flags::CLIPPED, true);
    let parcel = ParcelRecord {
        yaw_deg: -12.34,
        x_mm: -61.3,
        y_mm: -240.3,
        belt_travel_mm: 171_234.5,
        by_encoder: true,
        flags,
        may_be_used: false,
        ..record(70_123)
    };
    for fd in [false, true] {
        let mut sent = Vec::new();
        frames::parcel(&parcel, fd, |frame| sent.push(frame));
        let signals = all_signals(decode(&sent));
        is(&signals, "sequence", 70_123.0);
        is(&signals, "length", parcel.length_mm);
        is(&signals, "width", parcel.width_mm);
        is(&signals, "height", 80.0);
        is(&signals, "yaw", -12.34);
        is(&signals, "x", -61.3);
        is(&signals, "y", -240.3);
        is(&signals, "sigma_height", 0.5);
        is(&signals, "belt_travel", 171_234.5);
        is(&signals, "valid", 14.0);
        is(&signals, "flags", 4.0);
    }
}

#[test]
fn cantools_reads_the_status_and_names_what_a_plc_may_send() {
    let vision =
        VisionStatus { ready: true, belt_speed_mm_per_s: 512.3, ..VisionStatus::default() };
    let status =
        Status { vision, heartbeat: 7, sequence: 9, boots: 3, ticket: 5, ..Status::default() };
    let mut sent = Vec::new();
    frames::heartbeat(&status, |frame| sent.push(frame));
    frames::status(&status, 1, |frame| sent.push(frame));
    frames::result(&status, |frame| sent.push(frame));
    let signals = all_signals(decode(&sent));
    for (name, expected) in [
        ("heartbeat", 7.0),
        ("status", 2.0),
        ("reason", 2.0),
        ("belt_speed", 512.3),
        ("parcels", 9.0),
        ("boots", 3.0),
        ("ticket_done", 5.0),
    ] {
        is(&signals, name, expected);
    }
}

#[test]
fn cantools_finds_comments_cycle_times_and_the_kind_of_bus() {
    let output = Command::new(project().join("target/hil-venv/bin/python"))
        .arg(project().join("hil/clients/describe_dbc.py"))
        .arg(project().join("config/beltgauge.dbc"))
        .output()
        .expect(".ci/run makes the environment, with cantools");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(told["bus"], "CAN FD");
    assert_eq!(told["nodes"]["Beltgauge"], "the measuring appliance");
    let messages = told["messages"].as_object().expect("messages");
    for (name, message) in messages {
        assert!(message["comment"].is_string(), "{name}");
        let period_ms = match name.as_str() {
            "Heartbeat" => 100,
            "Status" => 1000,
            _ => 0,
        };
        assert_eq!(message["cycle_time_ms"].as_u64().unwrap_or(0), period_ms, "{name}");
        assert_eq!(message["is_fd"], name == "ParcelFd", "{name}");
    }
    let parcel = &messages["Parcel"]["signals"];
    assert!(parcel["length"].is_string() && parcel["flags"].is_string(), "{parcel}");
    // The two bytes that head a segment have no row of their own in the table.
    let bare = parcel.as_object().expect("signals").values().filter(|c| c.is_null()).count();
    assert_eq!(bare, 2, "{parcel}");
}
