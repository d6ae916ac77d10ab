//! What the PLC link costs the vision thread: frame times without clients, with 16 of them polling
//! 125 registers 100 times a second, and with a flood of connections and bad requests, in turns:
//! `cargo bench --package hil --bench plc_load`.

use beltgauge::image::{FrameTime, Plane};
use hil::plc::Client;
use hil::scene::{FPS, Scene};
use hil::server::Server;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Frames of a turn; each phase has as many turns as fit.
const TURN: usize = 15;
const FRAMES: u64 = 360;
const PHASES: [&str; 3] = ["no clients", "16 clients at 100 Hz", "a flood"];

fn main() {
    let scene = Scene::reference(1920, FRAMES);
    let [width, height] = scene.site.camera.image_size_px;
    let (_, mut pipeline) = beltgauge::run::build(scene.site.clone()).expect("fits");
    let server = Server::start(([127, 0, 0, 1], 0).into(), None);
    let address = server.address;
    // The phase that clients work in; beyond the last one: the end.
    let phase = AtomicUsize::new(0);
    let mut times = [const { Vec::new() }; PHASES.len()];
    std::thread::scope(|scope| {
        for _ in 0..15 {
            scope.spawn(|| {
                let mut client = Client::connect(address).expect("accepted");
                while phase.load(Ordering::Relaxed) < PHASES.len() {
                    if phase.load(Ordering::Relaxed) == 1 {
                        // The flood may have taken its place.
                        if client.read(100, 125).is_err() {
                            client = Client::connect(address).expect("accepted");
                        }
                    }
                    std::thread::sleep(Duration::from_millis(10));
                }
            });
        }
        scope.spawn(|| {
            while phase.load(Ordering::Relaxed) < PHASES.len() {
                if phase.load(Ordering::Relaxed) == 2 {
                    let mut client = Client::connect(address).expect("accepted");
                    // Refused, and refused again.
                    let _ = client.request(&[23, 0, 0, 0x80, 0, 0, 0, 0x80, 0, 4, 1, 2]);
                } else {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        });
        for (n, frame) in scene.frames.iter().enumerate() {
            let turn = n / TURN % PHASES.len();
            phase.store(turn, Ordering::Relaxed);
            let raw = Plane::packed(frame, width, height).expect("this size");
            let time = FrameTime { index: n as u64, t_s: n as f64 / FPS };
            let start = Instant::now();
            pipeline.step(raw, time, &mut |_| {}).expect("this size");
            let elapsed = start.elapsed();
            if n >= 45 {
                times[turn].push(1e3 * elapsed.as_secs_f64());
            }
            // As a camera paces it.
            std::thread::sleep(Duration::from_secs_f64(1.0 / FPS).saturating_sub(elapsed));
        }
        phase.store(PHASES.len(), Ordering::Relaxed);
    });
    let medians = times.map(|mut times| {
        times.sort_unstable_by(f64::total_cmp);
        times[times.len() / 2]
    });
    for (name, median) in PHASES.iter().zip(medians) {
        println!("{name:24} {median:7.3} ms {:+6.1} %", 100.0 * (median / medians[0] - 1.0));
    }
}
