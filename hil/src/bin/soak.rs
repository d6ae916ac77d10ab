//! Hours on the belt: the appliance in a process of its own, and a PLC that takes and acknowledges
//! every parcel over the loopback.
//!
//! ```text
//! cargo run --release -p hil --no-default-features --bin soak            # a minute
//! cargo run --release -p hil --no-default-features --bin soak -- 28800   # seconds: a night
//! ```
//!
//! After warming up, memory must not grow, and descriptors and threads stay as many as they were. At
//! the end the PLC has every parcel that was measured, once and in order.

use beltgauge::run::{Appliance, demo};
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{Pace, Paced};
use hil::plc::Plc;
use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, TcpListener};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Of the PLC's program.
const CYCLE: Duration = Duration::from_millis(50);
/// A line is printed so often, in a short run six times.
const REPORT: Duration = Duration::from_mins(1);
/// By then every buffer has been used once; in a short run by its middle.
const WARM_UP: Duration = Duration::from_mins(2);
/// What the heap's own bookkeeping may come to after warming up.
const GROWTH_KIB_MAX: u64 = 2048;
/// The last parcel is taken within this.
const PATIENCE: Duration = Duration::from_secs(10);
/// A parcel comes at most so often; the demo's belt has one in 0.9 s.
const PARCELS_PER_S: u64 = 2;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["appliance", address, seconds] => appliance(
            address.parse().expect("the address that `soak` chose"),
            seconds.parse().expect("the seconds that `soak` was given"),
        ),
        [] => soak(Duration::from_mins(1)),
        [seconds] => soak(Duration::from_secs(seconds.parse().expect("soak [SECONDS]"))),
        _ => panic!("soak [SECONDS]"),
    }
}

/// The appliance until standard input ends; it prints the length of every parcel.
fn appliance(listen: SocketAddr, seconds: u64) {
    let parcels = (PARCELS_PER_S * seconds).clamp(500, 100_000);
    let scenario = std::fs::read_to_string(hil::project().join("config/demo/scenario.toml"))
        .expect("committed")
        .replace("count = 500", &format!("count = {parcels}"));
    let scenario = Scenario::parse(&scenario).expect("the demo's");
    let mut site = demo::site(&scenario).expect("the demo's");
    (site.config.modbus.listen, site.config.plc.queue) = (listen, true);
    let mut source = Synthetic::new(scenario).expect("the demo's");
    let appliance = Appliance::new(site).expect("the demo's");
    let (alive, ended) = channel::<()>();
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        drop(alive);
    });
    let run = appliance.run(&mut Paced::new(&mut source, Pace::RealTime), |_, new| {
        new.for_each(|record| println!("{}", record.length_mm));
        !matches!(ended.try_recv(), Err(std::sync::mpsc::TryRecvError::Disconnected))
    });
    run.expect("the appliance runs");
}

/// What a process takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Usage {
    resident_kib: u64,
    descriptors: usize,
    threads: usize,
}

impl Usage {
    fn of(process: u32) -> Self {
        let entries = |folder: &str| {
            std::fs::read_dir(format!("/proc/{process}/{folder}")).expect("it runs").count()
        };
        let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("it runs");
        let line = status.lines().find(|line| line.starts_with("VmRSS:")).expect("Linux");
        let kib = line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok());
        Self {
            resident_kib: kib.expect("a number"),
            descriptors: entries("fd"),
            threads: entries("task"),
        }
    }
}

/// Ends the appliance with this program.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn soak(time: Duration) {
    let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = free.local_addr().expect("bound");
    drop(free);
    let child = Command::new(std::env::current_exe().expect("this program"))
        .args(["appliance", &address.to_string(), &time.as_secs().to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("this program");
    let mut running = Running(child);
    let measured = lengths(running.0.stdout.take().expect("piped"));
    let mut plc = Plc::new(address);
    hil::wait_for("the Modbus server", || plc.cycle().ok());

    let process = running.0.id();
    let report = REPORT.min(time / 6);
    let start = Instant::now();
    let (mut next_report, mut warm, mut records) = (report, None::<Usage>, Vec::new());
    println!("  minute  parcels  resident MiB  descriptors  threads");
    while start.elapsed() < time {
        plc.cycle().expect("the server answers");
        assert!(plc.complaints.is_empty(), "{:?}", plc.complaints);
        records.extend(measured.try_iter());
        if start.elapsed() >= next_report {
            next_report += report;
            let usage = Usage::of(process);
            println!(
                "{:8.1} {:8} {:13.1} {:12} {:8}",
                start.elapsed().as_secs_f64() / 60.0,
                plc.taken.len(),
                usage.resident_kib as f64 / 1024.0,
                usage.descriptors,
                usage.threads
            );
            match warm {
                Some(warm) => check(warm, usage),
                None if start.elapsed() >= WARM_UP.min(time / 2) => warm = Some(usage),
                None => {}
            }
        }
        std::thread::sleep(CYCLE);
    }
    let end = Instant::now();
    while plc.taken.len() < records.len() {
        assert!(end.elapsed() < PATIENCE, "{} of {}", plc.taken.len(), records.len());
        plc.cycle().expect("the server answers");
        std::thread::sleep(CYCLE);
    }
    assert!(plc.complaints.is_empty(), "{:?}", plc.complaints);
    records.extend(measured.try_iter());
    assert!(!records.is_empty(), "no parcel came");
    for (number, ((parcel, _), length_mm)) in plc.taken.iter().zip(&records).enumerate() {
        let told_mm = parcel.size_mm[0];
        assert!(
            parcel.sequence[0] as usize == number + 1 && (told_mm - length_mm).abs() < 1.0,
            "parcel {number}: {parcel:?}, measured {length_mm} mm"
        );
    }
    println!("{} parcels, each once and in order", plc.taken.len());
    drop(running.0.stdin.take());
    assert!(running.0.wait().expect("a child").success(), "the appliance failed");
}

/// The lengths that the appliance prints, mm.
fn lengths(output: impl Read + Send + 'static) -> Receiver<f64> {
    let (send, receive) = channel();
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            if send.send(line.parse().expect("a length")).is_err() {
                return;
            }
        }
    });
    receive
}

fn check(warm: Usage, now: Usage) {
    let grown_kib = now.resident_kib.saturating_sub(warm.resident_kib);
    assert!(grown_kib <= GROWTH_KIB_MAX, "memory grew by {grown_kib} KiB");
    assert_eq!(
        (now.descriptors, now.threads),
        (warm.descriptors, warm.threads),
        "descriptors and threads"
    );
}
