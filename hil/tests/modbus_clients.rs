//! The register map read by clients that the project did not write: mbpoll and pymodbus.

use beltgauge::plc::registers::MAP_VERSION;
use hil::{Demo, project, wait_for};
use serde_json::Value;
use std::collections::HashMap;
use std::io::Write;
use std::net::{SocketAddr, TcpStream};
use std::process::Command;

/// Bit of the fault word: a busy computer leaves frames of the demo out.
const FRAMES_MISSING: u16 = 1 << 10;

/// Registers as mbpoll prints them; `kind` 4: holding, 3: input.
fn mbpoll(address: SocketAddr, kind: u32, first: u32, count: u32) -> HashMap<u32, u16> {
    let output = Command::new("mbpoll")
        .args(["-m", "tcp", "-p", &address.port().to_string(), "-0", "-1", "-q"])
        .args(["-t", &kind.to_string(), "-r", &first.to_string(), "-c", &count.to_string()])
        .arg(address.ip().to_string())
        .output()
        .expect("mbpoll is installed");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    let line = |line: &str| {
        let (at, value) = line.strip_prefix('[')?.split_once("]:")?;
        // Values above 32767 are followed by their signed reading in brackets.
        Some((at.parse().ok()?, value.split_whitespace().next()?.parse().ok()?))
    };
    text.lines().filter_map(line).collect()
}

/// What pymodbus reads, as `hil/clients/read_map.py` prints it.
fn pymodbus(address: SocketAddr) -> Value {
    let python = project().join("target/hil-venv/bin/python");
    let output = Command::new(&python)
        .arg(project().join("hil/clients/read_map.py"))
        .args([address.ip().to_string(), address.port().to_string()])
        .output()
        .unwrap_or_else(|e| panic!("{}: {e}; .ci/run makes it, with pymodbus", python.display()));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

/// A register of tenths of a mm is that of a record. The record's own last digit, a hundredth, may
/// lie on the other side of a tie.
fn assert_tenths(register: i64, record: &Value, key: &str) {
    let mm = record[key].as_f64().expect("a number");
    assert!((register as f64 - 10.0 * mm).abs() <= 0.55, "{key} is {register} of {record}");
}

fn wait_for_parcels(demo: &Demo, parcels: u16) {
    wait_for("parcels", || (mbpoll(demo.address, 4, 20, 1)[&20] >= parcels).then_some(()));
}

#[test]
fn mbpoll_reads_what_was_measured() {
    let demo = Demo::start("mbpoll", 14, false);
    let identity = mbpoll(demo.address, 4, 0, 5);
    assert_eq!(identity, mbpoll(demo.address, 3, 0, 5));
    assert_eq!(
        [0, 1, 2, 3, 4].map(|r| identity[&r]),
        [0x4247, MAP_VERSION, 0x1234, 0x5678, (-12345i16) as u16]
    );
    let empty = mbpoll(demo.address, 4, 100, 32);
    assert!(empty.values().all(|&v| v == 0), "no parcel yet: {empty:?}");
    let beat = mbpoll(demo.address, 4, 10, 1)[&10];
    wait_for_parcels(&demo, 2);
    assert_ne!(mbpoll(demo.address, 4, 10, 1)[&10], beat, "the heartbeat stands still");
    let status = mbpoll(demo.address, 4, 11, 2);
    let fault = status[&12] & !FRAMES_MISSING;
    assert_eq!((status[&11] & 3, fault), (3, 0), "running and ready, no fault");
    let latest = mbpoll(demo.address, 4, 100, 32);
    assert_eq!(latest[&101], latest[&131]);
    let seq = usize::from(latest[&101]);
    let records = demo.records();
    let record = &records[seq - 1];
    for (register, key) in [(104, "length_mm"), (105, "width_mm"), (106, "height_mm")] {
        assert_tenths(i64::from(latest[&register]), record, key);
    }
}

#[test]
fn pymodbus_reads_what_was_measured() {
    let demo = Demo::start("pymodbus", 14, false);
    wait_for_parcels(&demo, 3);
    let map = pymodbus(demo.address);
    assert_eq!(
        (&map["identity"], &map["test_u32"]),
        (&Value::from(0x4247), &Value::from(0x1234_5678))
    );
    let expected = [
        ("beyond the map", 2),
        ("across its end", 2),
        ("write one", 2),
        ("write many", 2),
        ("write across the command block's end", 2),
        ("acknowledge what never was", 3),
        ("bits beyond the words", 2),
        ("write a coil", 1),
    ];
    for (what, code) in expected {
        assert_eq!(map["exceptions"][what], code, "{what}");
    }
    assert_eq!(map["bits"], serde_json::json!([true, true]), "running and ready");
    assert_eq!(map["status"].as_u64().expect("a number") & 3, 3);
    assert_eq!(map["identification"], "Beltgauge");
    assert_eq!(map["heartbeat of the PLC"], 7);
    let ring = map["ring"].as_array().expect("a list");
    assert!(ring.len() >= 3 && ring.contains(&map["latest"]), "{map}");
    let records = demo.records();
    for block in ring {
        assert_eq!(block["seq"], block["seq_end"]);
        let record = &records[block["seq"].as_u64().expect("a number") as usize - 1];
        let may_be_used = block["valid"].as_u64().expect("bits") & 1 == 1;
        assert_eq!(record["may_be_used"], may_be_used, "{record}");
        for (name, key) in [
            ("length", "length_mm"),
            ("width", "width_mm"),
            ("height", "height_mm"),
            ("x", "x_mm"),
            ("y", "y_mm"),
        ] {
            assert_tenths(block[name].as_i64().expect("a number"), record, key);
        }
    }
}

#[test]
fn hostile_clients_harm_nobody() {
    let demo = Demo::start("hostile", 20, false);
    let connect = || TcpStream::connect(demo.address).expect("accepted");
    // More than there are places: none of them may keep a PLC out.
    let half_open: Vec<_> = (0..40).map(|_| connect()).collect();
    for attack in [
        &b"GET / HTTP/1.1\r\nHost: plc\r\n\r\n"[..],
        &[0xff; 4096],
        &[0, 1, 0, 0, 0, 6, 1, 3],
        &[0, 1, 0, 0, 0, 255, 1, 16, 0, 0, 255, 255, 255],
        &[0, 1, 0, 0, 0, 13, 1, 23, 0, 0, 0x80, 0, 0, 0, 0x80, 0, 4, 1, 2],
    ] {
        for _ in 0..20 {
            // The server may hang up in the middle of it: that is its right.
            let _ = connect().write_all(attack);
        }
    }
    let identity = mbpoll(demo.address, 4, 0, 1);
    assert_eq!(identity[&0], 0x4247);
    wait_for_parcels(&demo, 1);
    drop(half_open);
}
