//! A panic in any thread ends the process at once, with a status of its own.
//!
//! The test starts itself as another process, which runs an appliance and panics where it is told to.

use beltgauge::error::Result;
use beltgauge::image::FrameTime;
use beltgauge::run::{Appliance, demo, end_on_panic};
use beltgauge::source::synthetic::Synthetic;
use beltgauge::source::{FrameSource, Pace, Paced};
use std::process::{Command, Stdio};
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

/// Panic so many times in each place.
fn panic_everywhere(times: u32) {
    let this = std::env::current_exe().expect("a path");
    for place in ["capture", "main", "any other"] {
        for run in 0..times {
            let mut process = Command::new(&this)
                .args(["--exact", "an_appliance_that_panics", "--ignored", "--nocapture"])
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
