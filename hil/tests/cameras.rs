//! Our receiver of GigE cameras, and Aravis when it is built in, against Aravis's fake camera, which
//! we did not write: the same tests for both.

use beltgauge::config::{CameraTable, Interface};
use beltgauge::plan::Block;
use beltgauge::sandbox;
use beltgauge::source::{Arrival, Driver, Feed, Live, Next, open_camera};
use hil::allocations;
use std::process::{Child, Command, Stdio};
use std::sync::Once;
use std::time::{Duration, Instant};

const SIZE: [usize; 2] = [512, 384];
const FPS: f64 = 25.0;

#[global_allocator]
static ALLOCATOR: allocations::Counting = allocations::Counting;

/// The fake camera, until it is dropped.
struct Fake(Child);

impl Fake {
    fn start(lost_per_mille: u32) -> Self {
        let child = Command::new("arv-fake-gv-camera-0.8")
            .args(["-i", "127.0.0.1", "-s", "BG01", "-r", &lost_per_mille.to_string()])
            .stdout(Stdio::null())
            .spawn()
            .expect("aravis-tools is installed");
        std::thread::sleep(Duration::from_millis(300));
        Self(child)
    }
}

impl Drop for Fake {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Both ways to a GigE camera.
fn interfaces() -> Vec<(Interface, &'static str)> {
    let mut interfaces = vec![(Interface::Gige, "127.0.0.1")];
    if cfg!(feature = "aravis") {
        interfaces.push((Interface::Aravis, "127.0.0.1"));
    } else {
        assert!(std::env::var_os("CI").is_none(), "CI tests Aravis too: --features aravis");
        println!("Aravis skipped: give --features aravis");
    }
    interfaces
}

fn settings(interface: Interface, device: &str) -> CameraTable {
    static PROGRAM: Once = Once::new();
    PROGRAM.call_once(|| sandbox::use_program(hil::beltgauge()));
    let mut settings = CameraTable::new("camera.toml".into());
    settings.interface = interface;
    settings.device = Some(device.to_owned());
    settings.fps = Some(FPS);
    // With these the fake camera's picture is a plain ramp.
    (settings.exposure_us, settings.gain) = (Some(10_000.0), Some(0.0));
    settings
}

fn buffer() -> Block<u8> {
    Block::own(SIZE[0] * SIZE[1]).expect("small")
}

/// The fake camera's picture: a diagonal ramp that moves by one a frame.
fn is_ramp(image: &[u8]) -> bool {
    let first = usize::from(image[0]);
    let rows = image.chunks_exact(SIZE[0]).enumerate();
    rows.flat_map(|(y, row)| row.iter().enumerate().map(move |(x, v)| (x, y, v)))
        .all(|(x, y, v)| usize::from(*v) == (x + y + first) % 255)
}

#[derive(Debug, Default)]
struct Tally {
    whole: u64,
    torn: u64,
    lost: u64,
    resends: u64,
    allocations: u64,
}

/// Take frames for so many frame times.
fn tally(driver: &mut dyn Driver, frames: u64) -> Tally {
    let (mut tally, mut buffer, mut numbers) = (Tally::default(), buffer(), Vec::new());
    numbers.reserve(1000);
    let until = Instant::now() + Duration::from_secs_f64(frames as f64 / FPS);
    let mut before = None;
    while Instant::now() < until {
        let arrival = driver.next(&mut buffer).expect("the camera stays");
        match arrival {
            Arrival::Frame { sequence, stride, .. } => {
                assert!(stride == SIZE[0] && is_ramp(&buffer), "a whole frame is whole");
                tally.whole += 1;
                numbers.push(sequence);
            }
            Arrival::Torn => tally.torn += 1,
            Arrival::Nothing => {}
        }
        // The first frames belong to the start.
        if tally.whole == 5 && before.is_none() {
            before = Some(allocations::count());
        }
    }
    tally.allocations = before.map_or(0, |before| allocations::count() - before);
    assert!(numbers.is_sorted_by(|a, b| a < b), "in order");
    let (first, last) = (numbers.first(), numbers.last());
    let span = last.zip(first).map_or(0, |(last, first)| last - first + 1);
    tally.lost = span.saturating_sub(tally.whole + tally.torn);
    tally.resends = driver.resends();
    tally
}

#[test]
fn frames_are_whole_or_torn_and_none_is_unaccounted_for() {
    const FRAMES: u64 = 150;
    println!("interface  lost packets  whole  torn  lost  asked again");
    for (interface, device) in interfaces() {
        for per_mille in [0, 2, 20] {
            let _fake = Fake::start(per_mille);
            let mut driver = open_camera(&settings(interface, device), SIZE).expect("it is there");
            let tally = tally(&mut *driver, FRAMES);
            let Tally { whole, torn, lost, resends, .. } = tally;
            println!("{interface:?}  {per_mille:9} ‰ {whole:9} {torn:5} {lost:5} {resends:9}");
            // A frame's leader and trailer are counted with its packets of 1464 bytes; the fake camera
            // sends none of them again.
            let packets = (SIZE[0] * SIZE[1]).div_ceil(1464) + 1;
            let expected = (1.0 - f64::from(per_mille) / 1000.0).powi(packets as i32);
            let all = (whole + torn + lost) as f64;
            // Start and end cost a few frames, a busy machine some more.
            assert!(all > 0.85 * FRAMES as f64 && all < 1.05 * FRAMES as f64, "{tally:?}");
            let sigma = (expected * (1.0 - expected) / all).sqrt();
            assert!((whole as f64 / all - expected).abs() < 4.0 * sigma + 0.03, "{tally:?}");
            assert!(lost as f64 <= 0.05 * all, "{tally:?}");
            if interface == Interface::Gige {
                assert_eq!(tally.allocations, 0, "nothing is allocated for a frame");
                // On a busy machine the camera pauses within a frame, and is asked without need.
                assert!(resends > 0 || per_mille == 0, "{tally:?}");
            }
        }
    }
}

#[test]
fn a_camera_is_found_by_address_and_by_serial_number() {
    let _fake = Fake::start(0);
    for (interface, _) in interfaces() {
        let by_serial = if interface == Interface::Gige { "BG01" } else { "Aravis-Fake-BG01" };
        for device in ["127.0.0.1", by_serial] {
            let opened = open_camera(&settings(interface, device), SIZE);
            let mut driver = opened.unwrap_or_else(|e| panic!("{interface:?} {device}: {e}"));
            // Aravis answers its own discovery by whichever interface heard the fake camera first, and
            // packets from the loopback to another interface do not arrive: there it is only opened.
            if (interface, device) != (Interface::Aravis, by_serial) {
                let tally = tally(&mut *driver, 50);
                assert!(tally.whole > 30, "{interface:?} {device}: {tally:?}");
            }
        }
        let error = open_camera(&settings(interface, "127.0.0.9"), SIZE).err();
        let error = error.expect("nobody is there").to_string();
        assert!(error.contains("127.0.0.9") && error.contains("remedy"), "{error}");
    }
}

#[test]
fn what_the_camera_does_not_do_is_named() {
    let _fake = Fake::start(0);
    for (interface, device) in interfaces() {
        let refused = |change: &dyn Fn(&mut CameraTable), size: [usize; 2]| {
            let mut settings = settings(interface, device);
            change(&mut settings);
            let error = open_camera(&settings, size).err();
            let error =
                error.unwrap_or_else(|| panic!("{interface:?} takes {settings:?} {size:?}"));
            assert_eq!(error.exit_status(), 2, "{error}");
            error.to_string()
        };
        let error = refused(&|_| {}, [99_999, 384]);
        assert!(error.contains("image_size_px"), "{error}");
        let error = refused(&|s| s.format = Some("Mono12Packed".into()), SIZE);
        assert!(error.contains("camera.format"), "{error}");
        let unknown = |s: &mut CameraTable| {
            s.controls.insert("NoSuchFeature".into(), 1.into());
        };
        let error = refused(&unknown, SIZE);
        assert!(error.contains("camera.controls.NoSuchFeature"), "{error}");
    }
}

#[test]
fn packets_have_the_size_of_the_configuration() {
    let _fake = Fake::start(0);
    for (interface, device) in interfaces() {
        let mut settings = settings(interface, device);
        for bytes in [576, 1500, 9000] {
            settings.packet_bytes = Some(bytes);
            let mut driver = open_camera(&settings, SIZE).expect("it takes them");
            let tally = tally(&mut *driver, 30);
            assert!(tally.whole > 20 && tally.torn == 0, "{interface:?} {bytes}: {tally:?}");
        }
    }
}

#[test]
fn features_are_set_in_the_order_of_the_configuration() {
    let _fake = Fake::start(0);
    for (interface, device) in interfaces() {
        // Waiting for a trigger that never comes: the order of the three matters to cameras.
        let mut settings = settings(interface, device);
        for (name, value) in [
            ("TriggerSelector", "FrameStart"),
            ("TriggerMode", "On"),
            ("TriggerSource", "Software"),
        ] {
            settings.controls.insert(name.into(), value.into());
        }
        let mut driver = open_camera(&settings, SIZE).expect("it has them");
        assert_eq!(tally(&mut *driver, 25).whole, 0, "{interface:?} waits for its trigger");
        settings.controls.insert("TriggerMode".into(), "Off".into());
        drop(driver);
        let mut driver = open_camera(&settings, SIZE).expect("it has them");
        assert!(tally(&mut *driver, 25).whole > 15, "{interface:?} runs free");
    }
}

#[test]
fn a_camera_that_was_lost_comes_back() {
    for (interface, device) in interfaces() {
        let mut fake = Some(Fake::start(0));
        let mut live = Live::new(settings(interface, device), SIZE, open_camera);
        let mut buffer = buffer();
        let mut frames = |live: &mut Live, count: u32, what: &str| {
            let (mut seen, start) = (0, Instant::now());
            while seen < count {
                let next = live.next(&mut buffer).expect("no end");
                seen += u32::from(matches!(next, Next::Frame(_)));
                assert!(start.elapsed() < Duration::from_secs(30), "{interface:?}: {what}");
            }
        };
        frames(&mut live, 20, "runs");
        for losses in 1..=2 {
            drop(fake.take());
            let start = Instant::now();
            let mut scrap = Block::own(SIZE[0] * SIZE[1]).expect("small");
            while !live.status().absent {
                let _ = live.next(&mut scrap);
                assert!(start.elapsed() < Duration::from_secs(20), "{interface:?}: loss unnoticed");
            }
            println!(
                "{interface:?}: loss {losses} noticed after {:.1} s",
                start.elapsed().as_secs_f64()
            );
            fake = Some(Fake::start(0));
            frames(&mut live, 20, "comes back");
            assert_eq!(live.status().losses, losses);
        }
    }
}

#[test]
fn the_binary_that_ships_has_no_aravis_and_names_the_feature() {
    let folder = hil::fleet::folder("no-aravis");
    let example = hil::project().join("config/example");
    std::fs::copy(example.join("camera.toml"), folder.join("camera.toml")).expect("committed");
    let text = std::fs::read_to_string(example.join("beltgauge.toml")).expect("committed");
    let text = text.replace("[zone]", "interface = \"aravis\"\n[zone]");
    let config = folder.join("beltgauge.toml");
    std::fs::write(&config, text).expect("room");
    let output = Command::new(hil::beltgauge()).arg("run").arg(&config).output().expect("starts");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("--features aravis") && text.contains("remedy"), "{text}");
}
