//! A panic in any thread ends the process at once, with a status of its own.
//!
//! The test starts itself as another process, which runs an appliance and panics where it is told to.

use beltgauge::config::Web;
use beltgauge::error::Result;
use beltgauge::image::FrameTime;
use beltgauge::run::{Appliance, demo, end_on_panic};
use beltgauge::source::synthetic::Synthetic;
use beltgauge::source::{FrameSource, Pace, Paced};
use beltgauge::web::{self, Archived, Board, BundleFiles, Machine, Plc, State};
use std::io::{Read, Write};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Where to panic, for the other process.
const PLACE: &str = "BELTGAUGE_TEST_PANICS_IN";
/// Of `run::end_on_panic`.
const EXIT_PANICS: i32 = 4;
/// The figure that users rely on.
const GONE_WITHIN: Duration = Duration::from_secs(1);

/// A source that panics in the capture thread.
struct Broken {
    inner: Synthetic,
    panics: bool,
    frames: u64,
}

impl FrameSource for Broken {
    fn size_px(&self) -> [usize; 2] {
        self.inner.size_px()
    }

    fn fps(&self) -> f64 {
        self.inner.fps()
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        self.frames += 1;
        if self.panics && self.frames == 4 {
            panics();
        }
        self.inner.next_into(frame)
    }
}

/// Says when, for whoever measures how long the end takes.
fn panics() -> ! {
    println!("panics now");
    panic!("injected");
}

#[test]
#[ignore = "the other process of the test below"]
fn an_appliance_that_panics() {
    let Ok(place) = std::env::var(PLACE) else { return };
    end_on_panic();
    let scenario = demo::scenario().expect("committed");
    let mut site = demo::site(&scenario).expect("committed");
    site.config.modbus.listen = ([127, 0, 0, 1], 0).into();
    let inner = Synthetic::new(scenario).expect("renders");
    let mut source = Broken { inner, panics: place == "capture", frames: 0 };
    let mut calls = 0;
    let appliance = Appliance::new(site).expect("binds");
    let ended = appliance.run(&mut Paced::new(&mut source, Pace::RealTime), |_, _| {
        calls += 1;
        match place.as_str() {
            "main" if calls == 3 => panics(),
            // As vision, its workers, the PLC's thread and tasks, the journal and the log are.
            "any other" if calls == 3 => {
                std::thread::spawn(|| panics());
            }
            _ => {}
        }
        true
    });
    unreachable!("it ended in order: {ended:?}");
}

/// A machine that panics when its page is asked for its state.
struct Panicking;

impl Machine for Panicking {
    fn state(&self) -> State {
        panics()
    }
    fn plc(&self) -> Plc {
        Plc::default()
    }
    fn archived(&self, _: Option<u64>, _: usize) -> std::result::Result<Archived, String> {
        panics()
    }
    fn archived_picture(&self, _: u64) -> Option<Vec<u8>> {
        None
    }
    fn bundle(&self) -> BundleFiles {
        Box::new(std::iter::empty())
    }
}

#[test]
#[ignore = "another process of the test below"]
fn a_page_that_panics() {
    let Ok(place) = std::env::var(PLACE) else { return };
    end_on_panic();
    let path = if place == "page" { "/api/state" } else { "/api/archive" };
    let settings = Web { address: [127, 0, 0, 1].into(), port: 0, ..Web::default() };
    let listening = web::listen(&settings);
    let address = listening.as_ref().expect("bound").local_addr().expect("bound");
    std::thread::spawn(move || {
        let mut visitor = std::net::TcpStream::connect(address).expect("listens");
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        visitor.write_all(request.as_bytes()).expect("open");
        let _ = visitor.read_to_end(&mut Vec::new());
    });
    let board = Arc::new(Board::new(0));
    let ended = web::serve(&settings, listening, &board, Arc::new(Panicking), None);
    unreachable!("it ended in order: {ended:?}");
}

/// Panic so many times in each place.
fn panic_everywhere(times: u32) {
    let this = std::env::current_exe().expect("a path");
    for place in ["capture", "main", "any other", "page", "page's reader"] {
        let test = if place.starts_with("page") {
            "a_page_that_panics"
        } else {
            "an_appliance_that_panics"
        };
        for run in 0..times {
            let mut process = Command::new(&this)
                .args(["--exact", test, "--ignored", "--nocapture"])
                .env(PLACE, place)
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .expect("starts");
            let mut said = std::io::BufReader::new(process.stdout.take().expect("piped"));
            let mut line = String::new();
            while !line.contains("panics now") {
                line.clear();
                let read = std::io::BufRead::read_line(&mut said, &mut line).expect("readable");
                assert!(read > 0, "{place}, run {run}: it ended before");
            }
            let began = Instant::now();
            let status = process.wait().expect("ends");
            assert_eq!(status.code(), Some(EXIT_PANICS), "{place}, run {run}");
            assert!(began.elapsed() < GONE_WITHIN, "{place}, run {run}: {:?}", began.elapsed());
        }
    }
}

#[test]
fn a_panic_in_any_thread_ends_the_process_within_a_second() {
    panic_everywhere(4);
}

#[test]
#[ignore = "a minute or more"]
fn a_hundred_panics_end_the_process_within_a_second_each() {
    panic_everywhere(34);
}
