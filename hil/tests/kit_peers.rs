//! The kits in the languages that they are for, at the appliance's server: every parcel once and in order, whichever
//! side is restarted.

use hil::project;
use hil::server::{Server, record};
use serde_json::Value;
use std::io::Write;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const ANY_PORT: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);
const PARCELS: u32 = 200;
const RESTARTS: u32 = 20;
/// Of the restarts, one in so many is the client's.
const CLIENT_EVERY: u32 = 4;
/// Ten times what it takes.
const PATIENCE: Duration = Duration::from_mins(5);

fn folder(name: &str) -> PathBuf {
    let folder = project().join("target/hil-out").join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("writable");
    folder.canonicalize().expect("it is there")
}

/// A client that runs until it is dropped.
struct Client(Child);

impl Client {
    fn start(mut command: Command) -> Self {
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn();
        Self(child.unwrap_or_else(|error| panic!("{command:?}: {error}; .ci/run installs it")))
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        // As a power cut does.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The numbers and lengths that a client has written; a line that is not ended is none yet.
fn written(file: &Path, read: fn(&str) -> (u32, f64)) -> Vec<(u32, f64)> {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    whole.lines().filter(|line| !line.starts_with("utc")).map(read).collect()
}

/// Parcels leave the zone, a few more than were taken; server and client are restarted in turn. Returns what was
/// written.
fn take_all(
    name: &str,
    file: &Path,
    read: fn(&str) -> (u32, f64),
    start: impl Fn(SocketAddr) -> Client,
) -> Vec<(u32, f64)> {
    let state = folder(&format!("{name}-state")).join("state");
    let mut server = Server::start(ANY_PORT, Some(&state));
    let address = server.address;
    let mut client = start(address);
    let (begun, mut sent, mut restarts) = (Instant::now(), 0, 0);
    loop {
        let taken = written(file, read).last().map_or(0, |(sequence, _)| *sequence);
        assert!(begun.elapsed() < PATIENCE, "{taken} of {PARCELS} parcels, {restarts} restarts");
        if taken >= PARCELS && server.queued() == 0 {
            break;
        }
        while sent < PARCELS && sent < taken + 5 {
            sent += 1;
            server.parcel(sent);
        }
        std::thread::sleep(Duration::from_millis(20));
        let due = taken >= (restarts + 1) * PARCELS / (RESTARTS + 1);
        if restarts < RESTARTS && due && server.published() == sent {
            restarts += 1;
            if restarts % CLIENT_EVERY == 0 {
                drop(client);
                client = start(address);
            } else {
                drop(server);
                server = Server::start(address, Some(&state));
            }
        }
    }
    assert_eq!(restarts, RESTARTS);
    drop(client);
    written(file, read)
}

fn check(written: &[(u32, f64)]) {
    let expected: Vec<_> = (1..=PARCELS).map(|n| (n, record(n).length_mm)).collect();
    assert_eq!(written, expected);
}

fn python() -> Command {
    let mut python = Command::new(project().join("target/hil-venv/bin/python"));
    python.env("PYTHONDONTWRITEBYTECODE", "1").current_dir(project().join("config/kits/python"));
    python
}

fn csv_line(line: &str) -> (u32, f64) {
    let cells: Vec<&str> = line.split(',').collect();
    (cells[1].parse().expect("a number"), cells[4].parse().expect("a length"))
}

#[test]
fn the_python_logger_has_every_parcel_once_over_twenty_restarts() {
    let file = folder("kits-python").join("parcels.csv");
    let written = take_all("kits-python", &file, csv_line, |address| {
        let mut logger = python();
        logger.args(["beltgauge.py", "127.0.0.1", "--port", &address.port().to_string(), "--csv"]);
        logger.arg(&file);
        Client::start(logger)
    });
    check(&written);
}

#[test]
fn the_python_logger_that_watches_acknowledges_nothing() {
    let file = folder("kits-watch").join("parcels.csv");
    let server = Server::start(ANY_PORT, None);
    let watch = || {
        let mut logger = python();
        let port = server.address.port().to_string();
        logger.args(["beltgauge.py", "127.0.0.1", "--port", &port, "--watch", "--csv"]);
        logger.arg(&file);
        Client::start(logger)
    };
    let lines = |number: usize| {
        hil::wait_for("lines", || {
            let lines = written(&file, csv_line);
            (lines.len() >= number).then_some(lines)
        })
    };
    let logger = watch();
    (1..=10).for_each(|number| server.parcel(number));
    lines(10);
    drop(logger);
    // What a power cut may leave of a line.
    let mut torn = std::fs::OpenOptions::new().append(true).open(&file).expect("writable");
    torn.write_all(b"2026-11-27T12:00:00.000+00:00,11").expect("writable");
    (11..=20).for_each(|number| server.parcel(number));
    let _logger = watch();
    let numbers: Vec<u32> = lines(20).into_iter().map(|(sequence, _)| sequence).collect();
    assert!(numbers.into_iter().eq(1..=20));
    assert_eq!(server.queued(), 20);
}

#[test]
fn the_python_logger_leaves_the_files_of_others_alone() {
    let file = folder("kits-other-file").join("other.csv");
    for content in ["utc,weight\n", "a note without an end"] {
        std::fs::write(&file, content).expect("writable");
        let output = python().args(["beltgauge.py", "127.0.0.1", "--csv"]).arg(&file).output();
        let output = output.expect(".ci/run makes the environment, with pymodbus");
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && told.contains("has other columns"), "{told}");
        assert_eq!(std::fs::read_to_string(&file).expect("still there"), content);
    }
}

#[test]
fn python_commands_and_reads_the_state() {
    let server = Server::start(ANY_PORT, None);
    server.parcel(1);
    hil::wait_for("the parcel", || (server.published() == 1).then_some(()));
    let script = "\
import sys, beltgauge as kit
with kit.Beltgauge('127.0.0.1', int(sys.argv[1])) as gauge:
    assert gauge.command(kit.Command.ROUND, 50) == kit.Result.DONE
    assert gauge.command(kit.Command.ROUND, 5000) == kit.Result.ARGUMENT_OUT_OF_RANGE
    status = gauge.status()
    assert (status.scale_interval_mm, status.ticket_done, status.parcels) == (5.0, 2, 1), status
    assert kit.StatusBit.READY | kit.StatusBit.PARCELS_WAIT in status.status, status
    parcel = gauge.latest()
    assert parcel == gauge.recent(1) == gauge.waiting() and gauge.recent(2) is None
    assert parcel.may_be_used and parcel.is_box and parcel.sigma_height_mm == 0.5, parcel
    gauge.acknowledge(parcel)
    assert gauge.waiting() is None
";
    let output = python()
        .args(["-c", script, &server.address.port().to_string()])
        .output()
        .expect(".ci/run makes the environment, with pymodbus");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn node_red_takes_every_parcel_once_over_twenty_restarts() {
    fn line(line: &str) -> (u32, f64) {
        let parcel: Value = serde_json::from_str(line).expect("JSON");
        (
            parcel["sequence"].as_u64().expect("a number") as u32,
            parcel["length_mm"].as_f64().expect("mm"),
        )
    }
    let folder = folder("kits-node-red");
    let file = folder.join("parcels.jsonl");
    let flow = std::fs::read_to_string(project().join("config/kits/node-red/flow.json"))
        .expect("committed");
    let modules = project().join("target/hil-node/node_modules").canonicalize();
    let modules = modules.expect(".ci/run installs node-red and modbus-serial");
    // Where Node-RED looks for what function nodes ask for.
    std::os::unix::fs::symlink(&modules, folder.join("node_modules")).expect("writable");
    let settings = "module.exports = { uiHost: '127.0.0.1', uiPort: 0, externalModules: { autoInstall: false } };";
    std::fs::write(folder.join("settings.js"), settings).expect("writable");
    std::fs::write(
        folder.join("package.json"),
        r#"{"name": "flows", "dependencies": {"modbus-serial": "*"}}"#,
    )
    .expect("writable");
    let mut written = take_all("kits-node-red", &file, line, |address| {
        let flow = flow
            .replace("192.168.1.10", "127.0.0.1")
            .replace("\"502\"", &format!("\"{}\"", address.port()));
        std::fs::write(folder.join("flow.json"), flow).expect("writable");
        let mut node = Command::new("node");
        node.arg(modules.join("node-red/red.js")).arg("--userDir").arg(&folder);
        node.arg("--settings").arg(folder.join("settings.js")).arg(folder.join("flow.json"));
        node.current_dir(&folder);
        Client::start(node)
    });
    // Killed between writing and acknowledging, it gives the parcel once more, with the same number.
    let lines = written.len() as u32;
    written.dedup();
    assert!(lines <= PARCELS + RESTARTS / CLIENT_EVERY, "{lines} lines");
    check(&written);
}
