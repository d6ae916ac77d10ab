//! `beltgauge run` on a machine without a camera: it waits for one, says so, and ends in order.

mod common;

use common::{beltgauge, scratch, write_site};
use std::fs;
use std::net::UdpSocket;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

const SIZE: [usize; 2] = [320, 240];

struct Run(Child);

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Start it with a camera that is not there.
fn start(folder: &Path, camera: &str, arguments: &[&str]) -> Run {
    let config = write_site(folder, SIZE);
    let text = fs::read_to_string(&config).expect("there");
    let text = text.replace("[zone]", &format!("{camera}\n[zone]"));
    fs::write(&config, text + "[modbus]\nlisten = \"127.0.0.1:0\"\n").expect("room");
    let log = fs::File::create(folder.join("log")).expect("room");
    let child = beltgauge()
        .args(arguments)
        .args(["run", "--config"])
        .arg(&config)
        .arg("--status")
        .arg(folder.join("status.json"))
        .stdout(Stdio::null())
        .stderr(log)
        .spawn();
    Run(child.expect("starts"))
}

/// Wait for words in a file; returns it.
fn wait_for(path: &Path, words: &[&str]) -> String {
    let start = Instant::now();
    loop {
        let text = fs::read_to_string(path).unwrap_or_default();
        if words.iter().all(|word| text.contains(word)) {
            return text;
        }
        assert!(start.elapsed() < Duration::from_secs(30), "{words:?} not in {text}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn terminate(run: &mut Run) -> Option<i32> {
    let pid = rustix::process::Pid::from_child(&run.0);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).expect("runs");
    status(run)
}

/// The exit status, soon.
fn status(run: &mut Run) -> Option<i32> {
    let start = Instant::now();
    loop {
        if let Some(status) = run.0.try_wait().expect("a child") {
            return status.code();
        }
        assert!(start.elapsed() < Duration::from_secs(20), "it does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn without_a_camera_it_says_so_waits_and_ends_in_order() {
    for (name, camera, words) in [
        ("run-v4l2", "device = \"/dev/video99\"", &["no camera", "/dev/video99", "remedy"][..]),
        ("run-named", "device = \"No Such Camera\"", &["no camera", "No Such Camera is not there"]),
        ("run-gige", "interface = \"gige\"\ndevice = \"127.0.0.77\"", &["no camera", "127.0.0.77"]),
    ] {
        let folder = scratch(name);
        let mut run = start(&folder, camera, &[]);
        wait_for(&folder.join("log"), words);
        wait_for(&folder.join("status.json"), &["\"camera_absent\":true", "\"frames\":0"]);
        assert_eq!(terminate(&mut run), Some(0), "{name}");
        let log = wait_for(&folder.join("log"), &["stopped"]);
        assert_eq!(log.matches("no camera").count(), 1, "not every second: {log}");
        assert!(!log.contains("panicked"), "{log}");
    }
}

#[test]
fn a_node_that_is_no_camera_is_told_as_such() {
    let folder = scratch("run-null");
    let _run = start(&folder, "device = \"/dev/null\"", &[]);
    wait_for(&folder.join("log"), &["no camera", "/dev/null"]);
}

#[test]
fn the_log_can_be_json() {
    let folder = scratch("run-json");
    let _run = start(&folder, "device = \"/dev/video99\"", &["--log", "json"]);
    let log = wait_for(&folder.join("log"), &["no camera"]);
    for line in log.lines() {
        let event: serde_json::Value = serde_json::from_str(line).expect("JSON");
        assert!(event["level"].is_string() && event["fields"]["message"].is_string(), "{line}");
    }
}

#[test]
fn without_a_configuration_it_ends_with_the_remedy() {
    let folder = scratch("run-nothing");
    let output = beltgauge().args(["run", "--store"]).arg(&folder).output().expect("starts");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("current/beltgauge.toml") && text.contains("remedy"), "{text}");
}

/// Features of this build; the tests are built with the same.
const MISSING: &[&str] = &[
    #[cfg(not(feature = "v4l2"))]
    "v4l2",
    #[cfg(not(feature = "aravis"))]
    "aravis",
];

#[test]
fn an_interface_that_is_not_built_in_ends_it_and_names_the_feature() {
    for feature in MISSING {
        let folder = scratch(&format!("run-without-{feature}"));
        let mut run = start(&folder, &format!("interface = \"{feature}\""), &[]);
        let log = wait_for(&folder.join("log"), &["camera.interface", "remedy"]);
        assert!(log.contains(&format!("--features {feature}")), "{log}");
        assert_eq!(status(&mut run), Some(2), "{log}");
        // On another machine the same configuration may be right.
        let config = folder.join("beltgauge.toml");
        let output = common::run(beltgauge().arg("check").arg("--config").arg(config));
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && text.contains("warning: camera.interface"), "{text}");
    }
}

/// What a thread of a process may do: lines of its status, by their names.
fn rights(status: &str) -> Vec<(&str, Vec<&str>)> {
    let names = ["Uid", "Gid", "Groups", "CapInh", "CapPrm", "CapEff", "CapAmb", "NoNewPrivs"];
    let lines = status.lines().filter_map(|line| line.split_once(':'));
    let wanted = lines.filter(|(name, _)| names.contains(name));
    wanted.map(|(name, values)| (name, values.split_whitespace().collect())).collect()
}

#[test]
fn every_thread_has_given_up_root() {
    if !rustix::process::geteuid().is_root() {
        eprintln!("skipped: only root has something to give up");
        return;
    }
    let folder = scratch("run-user");
    fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o777))
        .expect("ours");
    let tables =
        "device = \"/dev/video99\"\n[plc]\nstate_file = \"state\"\n[realtime]\nworkers = 2";
    let run = start(&folder, tables, &["--user", "65534"]);
    let log = wait_for(&folder.join("log"), &["no camera"]);
    // The state file is written by a thread of its own, which has no more rights than the others.
    wait_for(&folder.join("status.json"), &["\"camera_absent\":true"]);
    assert!(folder.join("state").exists(), "{log}");
    let tasks = Path::new("/proc").join(run.0.id().to_string()).join("task");
    let threads: Vec<String> = fs::read_dir(&tasks)
        .expect("it runs")
        .map(|task| fs::read_to_string(task.expect("a thread").path().join("status")))
        .collect::<Result<_, _>>()
        .expect("threads that stay");
    // Main, log, watchdog, capture, two of vision, PLC, journal.
    assert!(threads.len() >= 8, "{}", threads.len());
    // Bits of CAP_NET_BIND_SERVICE, CAP_NET_ADMIN, CAP_IPC_LOCK, CAP_SYS_NICE.
    let kept = format!("{:016x}", 1u64 << 10 | 1 << 12 | 1 << 14 | 1 << 23);
    let nothing = format!("{:016x}", 0);
    let expected = [
        ("Uid", vec!["65534"; 4]),
        ("Gid", vec!["65534"; 4]),
        ("Groups", vec![]),
        ("CapInh", vec![nothing.as_str()]),
        ("CapPrm", vec![kept.as_str()]),
        ("CapEff", vec![kept.as_str()]),
        ("CapAmb", vec![nothing.as_str()]),
        ("NoNewPrivs", vec!["1"]),
    ];
    for thread in &threads {
        assert_eq!(rights(thread), expected, "{thread}");
    }
}

/// A pipe that nobody reads, and that is full.
fn full_pipe() -> (std::io::PipeReader, std::io::PipeWriter) {
    use std::io::Write;
    let (reader, mut writer) = std::io::pipe().expect("a pipe");
    let flags = rustix::fs::fcntl_getfl(&writer).expect("ours");
    rustix::fs::fcntl_setfl(&writer, flags | rustix::fs::OFlags::NONBLOCK).expect("ours");
    while writer.write(&[b'x'; 4096]).is_ok() {}
    while writer.write(b"x").is_ok() {}
    rustix::fs::fcntl_setfl(&writer, flags).expect("ours");
    (reader, writer)
}

#[test]
fn a_log_that_nobody_reads_holds_nobody_up() {
    let folder = scratch("run-unread");
    let config = write_site(&folder, SIZE);
    let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr());
    let address = free.expect("a free port");
    let text = fs::read_to_string(&config).expect("there");
    let text = text.replace("[zone]", "device = \"/dev/video99\"\n[zone]");
    fs::write(&config, format!("{text}[modbus]\nlisten = \"{address}\"\n")).expect("room");
    let (_reader, writer) = full_pipe();
    let child = beltgauge()
        .args(["run", "--config"])
        .arg(&config)
        .arg("--status")
        .arg(folder.join("status.json"))
        .env("RUST_LOG", "trace")
        .stdout(Stdio::null())
        .stderr(writer)
        .spawn();
    let mut run = Run(child.expect("starts"));
    wait_for(&folder.join("status.json"), &["\"camera_absent\":true"]);
    // Every connection logs a line or two.
    for _ in 0..50 {
        let mut plc = std::net::TcpStream::connect(address).expect("the server listens");
        plc.set_read_timeout(Some(Duration::from_secs(5))).expect("a time");
        std::io::Write::write_all(&mut plc, &[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1]).expect("sent");
        let mut answer = [0; 11];
        std::io::Read::read_exact(&mut plc, &mut answer).expect("an answer");
        assert_eq!(answer[9..], [0x42, 0x47]);
    }
    assert_eq!(terminate(&mut run), Some(0));
}

#[test]
fn systemd_is_told_that_it_runs_that_it_lives_and_that_it_ends() {
    let folder = scratch("run-systemd");
    let config = write_site(&folder, SIZE);
    let text = fs::read_to_string(&config).expect("there");
    let text = text.replace("[zone]", "device = \"/dev/video99\"\n[zone]");
    fs::write(&config, text + "[modbus]\nlisten = \"127.0.0.1:0\"\n").expect("room");
    let systemd = std::os::unix::net::UnixDatagram::bind(folder.join("notify")).expect("a socket");
    systemd.set_read_timeout(Some(Duration::from_secs(30))).expect("a time");
    let told = || {
        let mut bytes = [0; 200];
        let count = systemd.recv(&mut bytes).expect("told in time");
        String::from_utf8_lossy(&bytes[..count]).into_owned()
    };
    let child = beltgauge()
        .arg("run")
        .arg(&config)
        .env("NOTIFY_SOCKET", folder.join("notify"))
        .stderr(Stdio::null())
        .spawn();
    let mut run = Run(child.expect("starts"));
    for _ in 0..2 {
        assert_eq!(told(), "READY=1\nWATCHDOG=1\n");
    }
    assert_eq!(terminate(&mut run), Some(0));
    let last = std::iter::repeat_with(told).find(|text| !text.contains("WATCHDOG"));
    assert_eq!(last.as_deref(), Some("STOPPING=1\n"));
}

#[test]
fn an_error_reaches_whoever_is_slow_to_read_it() {
    let (mut reader, writer) = full_pipe();
    let child = beltgauge().args(["check", "no-such-file.toml"]).stderr(writer).spawn();
    let mut check = Run(child.expect("starts"));
    // Longer than the log waits at its end for its reader.
    std::thread::sleep(Duration::from_secs(3));
    let mut text = Vec::new();
    std::io::Read::read_to_end(&mut reader, &mut text).expect("a pipe");
    let text = String::from_utf8_lossy(&text);
    assert!(text.contains("error: ") && text.contains("no-such-file.toml"), "lost");
    assert_eq!(status(&mut check), Some(2));
}

#[test]
fn a_collector_gets_the_log_and_one_that_goes_away_is_not_missed() {
    let folder = scratch("run-syslog");
    let collector = UdpSocket::bind("127.0.0.1:0").expect("a free port");
    collector.set_read_timeout(Some(Duration::from_secs(30))).expect("settable");
    let address = collector.local_addr().expect("bound");
    let camera = format!("device = \"/dev/video99\"\n[log]\nsyslog = \"{address}\"");
    let mut run = start(&folder, &camera, &[]);
    let mut line = [0; 4096];
    let mut received = || {
        let length = collector.recv(&mut line).expect("sent");
        String::from_utf8_lossy(&line[..length]).into_owned()
    };
    let told = std::iter::repeat_with(&mut received).find(|line| line.contains("/dev/video99"));
    let told = told.expect("endless");
    // An error of a system daemon, version 1, from a program of this name.
    assert!(told.starts_with("<27>1 20") && told.contains(" beltgauge "), "{told}");
    drop(collector);
    assert_eq!(terminate(&mut run), Some(0));
    wait_for(&folder.join("log"), &["stopped"]);
}
