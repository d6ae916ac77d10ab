//! An encoder counts on while no frame comes: its travel over the gap is known, although more counts come
//! than wait for the vision thread.

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::error::Result;
use beltgauge::image::FrameTime;
use beltgauge::plan::Block;
use beltgauge::run::Appliance;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{Feed, FeedStatus, FrameSource, Next, Taken};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The nominal speed is another: what is assumed over the gap is 400 mm off.
const SPEED_MM_PER_S: f64 = 300.0;
const MM_PER_COUNT: f64 = 0.05;
const FPS: f64 = 25.0;
/// Frames before the gap, in the gap, and after it.
const BEFORE: u64 = 30;
const GAP: u64 = 50;
const AFTER: u64 = 25;
/// Counts come with jitter, and a busy machine adds to it: 100 ms of the belt.
const TRAVEL_MM: f64 = 30.0;

/// A camera by the clock that is silent for two seconds.
struct Gapped {
    belt: Synthetic,
    start: Instant,
    index: u64,
}

impl Feed for Gapped {
    fn size_px(&self) -> [usize; 2] {
        self.belt.size_px()
    }

    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Next> {
        if self.index == BEFORE {
            self.index += GAP;
        }
        if self.index == BEFORE + GAP + AFTER {
            return Ok(Next::End);
        }
        let due = self.start + Duration::from_secs_f64(self.index as f64 / FPS);
        let now = Instant::now();
        if due > now {
            std::thread::sleep((due - now).min(Duration::from_millis(20)));
            return Ok(Next::Nothing);
        }
        self.belt.render(self.index, buffer);
        let time = FrameTime { index: self.index, t_s: self.index as f64 / FPS };
        self.index += 1;
        Ok(Next::Frame(Taken { time, captured: due, stride: self.size_px()[0] }))
    }

    fn skip(&mut self) -> Result<u64> {
        Ok(0)
    }

    fn status(&self) -> FeedStatus {
        FeedStatus::default()
    }
}

/// The address of a register in the printed table.
fn register(name: &str) -> u16 {
    let table = include_str!("../config/registers.csv");
    let mut lines = table.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let line = lines.find(|fields| fields[1..3].join(".") == name).expect("in the table");
    line[0].parse().expect("an address")
}

/// Write counts, as a PLC does, some 500 a second, until `done`.
fn count(server: SocketAddr, start: Instant, done: &AtomicBool) {
    let mut stream = TcpStream::connect(server).expect("accepted");
    stream.set_nodelay(true).expect("a socket");
    let [high, low] = register("command.encoder_count").to_be_bytes();
    while !done.load(Ordering::Relaxed) {
        let mm = SPEED_MM_PER_S * start.elapsed().as_secs_f64();
        let count = ((mm / MM_PER_COUNT) as u32).to_be_bytes();
        // Function 16, two registers of the same transaction and unit.
        let head = [0, 1, 0, 0, 0, 11, 1, 16, high, low, 0, 2, 4];
        let sent = stream.write_all(&[&head[..], &count].concat());
        let mut answer = [0; 12];
        // At the end the server is gone.
        if sent.is_err() || stream.read_exact(&mut answer).is_err() {
            return;
        }
        assert_eq!(answer[7], 16, "refused: {answer:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn counts_that_come_while_no_frame_does_are_travel() {
    let text = format!(
        "seed = 3\nfps = {FPS}\nframes = 1000\nexposure_ms = 1\n{}[belt]\n\
         speed_mm_per_s = {SPEED_MM_PER_S}\nwidth_mm = 800\ngrey = 45\ntexture_grey = 0\n",
        common::camera_above([320, 200], 225.0, 1200.0, [0.0; 5])
    );
    let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = free.local_addr().expect("bound");
    drop(free);
    let config = format!(
        "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 500\n\
         [zone]\nx_min_mm = -500\nx_max_mm = 500\ny_min_mm = -300\ny_max_mm = 300\n\
         [modbus]\nlisten = \"{address}\"\nwrite_allow = [\"127.0.0.1\"]\n\
         [encoder]\nmm_per_count = {MM_PER_COUNT}\n"
    );
    let scenario = Scenario::parse(&text).expect("valid");
    let camera = scenario.camera().expect("valid");
    let site = Site::new(Config::parse(&config).expect("valid"), camera).expect("in view");
    let appliance = Appliance::new(site).expect("the port is free");
    let start = Instant::now();
    let belt = Synthetic::new(scenario).expect("renders");
    let mut feed = Gapped { belt, start, index: 0 };
    let done = AtomicBool::new(false);
    let mut travel_mm = Vec::new();
    std::thread::scope(|scope| {
        scope.spawn(|| count(address, start, &done));
        let ran = appliance.run(&mut feed, |progress, _| {
            let status = &progress.status;
            travel_mm.push((status.time_s, status.belt_travel_mm, status.by_encoder));
            true
        });
        done.store(true, Ordering::Relaxed);
        ran.expect("runs to the end");
    });
    // From well before the gap to well after it.
    let gap_s = [BEFORE, BEFORE + GAP].map(|n| n as f64 / FPS);
    let before = travel_mm.iter().rfind(|(t_s, ..)| *t_s < gap_s[0] - 0.1).expect("looked at");
    let after = travel_mm.last().expect("looked at");
    assert!(before.2 && after.2 && after.0 > gap_s[1] + 0.2, "{before:?} {after:?}");
    let (measured, truth) = (after.1 - before.1, SPEED_MM_PER_S * (after.0 - before.0));
    assert!((measured - truth).abs() < TRAVEL_MM, "{measured} mm of {truth} mm");
}
