//! The yardstick: worlds drawn at random, by class of difficulty, and what is told of their parcels.
//!
//! `WORLDS=30 cargo test --release --test worlds -- --nocapture` judges so many of each class (`CLASS=dense`:
//! of one); the table goes to `target/tmp/worlds.txt`, `PLOT=tests/worlds/worlds.svg` draws it. `REPLAY=hard_light:3` writes
//! the scenario, a recording with its site and some frames of one world to `target/tmp/world`, and says which of
//! its properties matters: each in turn is drawn as in an easy world (`BISECT=0`: files alone).

#[path = "worlds/class.rs"]
mod class;
mod common;
#[path = "worlds/generator.rs"]
mod generator;
#[path = "worlds/judge.rs"]
mod judge;
#[path = "worlds/plot.rs"]
mod plot;
#[path = "worlds/riders.rs"]
mod riders;

use beltgauge::event::ParcelRecord;
use beltgauge::source::synthetic::Synthetic;
use beltgauge::source::{FaultInjector, FrameSource};
use class::{Class, Property};
use generator::{World, draw};
use judge::{Verdict, judge};
use std::fmt::Write as _;
use std::fs::File;
use std::io::Write as _;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Worlds of each class that every run judges.
const WORLDS: usize = 1;

/// What is reached on those today: smallest share of parcels told right, most told silently wrong.
/// The first only rises, the second only falls.
const REACHED: [(f64, usize); Class::ALL.len()] = [
    (1.0, 0),
    (1.0, 0),
    (0.8, 0),
    (1.0, 0),
    (0.6, 0),
    (0.4, 0),
    (0.6, 0),
    (0.8, 0),
    (1.0, 0),
    (0.0, 0),
    (0.8, 0),
    (0.0, 0),
];

/// A world's frames as they arrive.
fn frames(world: &World) -> FaultInjector {
    let belt = Synthetic::new(world.scenario.clone()).expect("renders");
    FaultInjector::new(Box::new(belt), world.faults)
}

/// What is told of a world, and the verdict on it.
fn run(world: &World) -> (Vec<ParcelRecord>, Verdict) {
    let records = common::measure_frames(&mut frames(world), world.site.clone());
    let verdict = judge(&world.scenario, &records);
    (records, verdict)
}

/// Verdicts on so many worlds of each class.
fn judge_classes(classes: &[(Class, &'static str)], count: usize) -> Vec<Verdict> {
    let jobs = classes.len() * count;
    let next = AtomicUsize::new(0);
    let verdicts = Mutex::new(vec![Verdict::default(); classes.len()]);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                loop {
                    let job = next.fetch_add(1, Ordering::Relaxed);
                    if job >= jobs {
                        break;
                    }
                    let (kind, seed) = (job / count, (job % count) as u64);
                    let (class, name) = classes[kind];
                    let (_, verdict) = run(&draw(seed, |_| class));
                    eprintln!("{}", verdict.line(&format!("{name}:{seed}")));
                    verdicts.lock().expect("no panic")[kind].add(verdict);
                }
            });
        }
    });
    verdicts.into_inner().expect("no panic")
}

#[test]
fn worlds_are_told_as_well_as_they_ever_were() {
    if let Ok(name) = std::env::var("REPLAY") {
        return replay(&name);
    }
    let count = std::env::var("WORLDS").map_or(WORLDS, |n| n.parse().expect("a number"));
    let only = std::env::var("CLASS").ok();
    let classes: Vec<_> =
        Class::ALL.into_iter().filter(|(_, n)| only.as_deref().is_none_or(|o| o == *n)).collect();
    assert!(!classes.is_empty(), "CLASS is one of {:?}", Class::ALL.map(|(_, name)| name));
    let verdicts = judge_classes(&classes, count);
    let mut table = format!("{}\n", Verdict::HEADER);
    for ((_, name), verdict) in classes.iter().zip(&verdicts) {
        let _ = writeln!(table, "{}", verdict.line(name));
    }
    eprintln!("{table}");
    std::fs::write(concat!(env!("CARGO_TARGET_TMPDIR"), "/worlds.txt"), &table).expect("writable");
    if let Ok(path) = std::env::var("PLOT") {
        let bars: Vec<_> = classes.iter().map(|(_, name)| *name).zip(&verdicts).collect();
        std::fs::write(path, plot::svg(&bars, count)).expect("writable");
    }
    if count == WORLDS && only.is_none() {
        for (((_, name), verdict), (right, silent)) in classes.iter().zip(&verdicts).zip(REACHED) {
            let told = verdict.right_share();
            assert!(told >= right, "{name}: {told:.3} told right, {right} was reached");
            assert!(verdict.silent <= silent, "{name}: {} silently wrong", verdict.silent);
        }
    }
}

/// Words of a scenario that some world of a class must have: what the worlds are said to be made of.
const DRAWN: &[&str] = &[
    // light
    "[[light.lamp]]",
    "window = {",
    "[[light.step]]",
    "drift = 0.0",
    "flicker = 0.0",
    // belt
    "\"woven\"",
    "\"ribbed\"",
    "\"modular\"",
    "row_mm = 1",
    "texture_grey = 0\n",
    "texture_grey = 1",
    "[belt.dirt]",
    "[[belt.mark]]",
    "shine = 0.",
    "side_drift_mm",
    "ripple = 0.0",
    "stop = [",
    "back_mm = 1",
    // parcels
    "\"kraft\"",
    "\"white\"",
    "\"dark\"",
    "\"glossy\"",
    "\"printed\"",
    "\"tube\"",
    "\"bag\"",
    "\"tote\"",
    "\"stack\"",
    "\"envelope\"",
    "\"book\"",
    "straps = 1",
    "straps = 2",
    "tape = true",
    "wrap = 0.",
    "label_edge_mm = 1.",
    "edge_radius_mm = 0.",
    "edge_radius_mm = 3.",
    "crush_mm",
    "slide = [",
    "turn_deg_per_m",
    "[[intruder]]",
    "swing_mm",
    // camera
    "\"fisheye\"",
    "\"brown\"",
    "read_grey = 0.",
    "read_grey = 5.",
    "blur_px = 0.",
    "blur_px = 2.",
    "vibration_px = 0.4",
    "gamma = 0.",
    "denoise = 0.",
    "jpeg_quality = 8",
    "auto_exposure_grey = 5",
];

#[test]
fn every_property_is_drawn_over_its_range() {
    let worlds = || Class::ALL.into_iter().flat_map(|(class, _)| (0..40).map(move |k| (class, k)));
    let drawn: Vec<World> = worlds().map(|(class, seed)| draw(seed, |_| class)).collect();
    for word in DRAWN {
        assert!(drawn.iter().any(|world| world.text.contains(word)), "no world has {word}");
    }
    let between = |what: &str, of: &dyn Fn(&World) -> f64, [low, high]: [f64; 2]| {
        let (least, most) =
            drawn.iter().map(of).fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        assert!(least < low && most > high, "{what}: {least} to {most}");
    };
    let cameras = |world: &World| world.scenario.camera().expect("valid");
    between(
        "mm a pixel",
        &|w| {
            let camera = cameras(w);
            (camera.camera_from_belt.transpose() * camera.translation_mm).norm() / camera.lens.fx_px
        },
        [0.75, 2.6],
    );
    between("camera height", &|w| cameras(w).centre_in_belt().z, [900.0, 2800.0]);
    between("tilt", &|w| (-cameras(w).camera_from_belt[(2, 2)]).acos().to_degrees(), [1.0, 45.0]);
    between("drops", &|w| w.faults.drop, [1e-9, 0.15]);
    between("doubles", &|w| w.faults.double, [1e-9, 0.05]);
    between("swaps", &|w| w.faults.swap, [1e-9, 0.05]);
    between("lateness", &|w| w.faults.late_ms, [1e-9, 6.0]);
    between("codec", &|w| w.faults.codec_grey, [1e-9, 25.0]);
    let smear_mm = |w: &World| 1e-3 * w.scenario.exposure_ms * w.scenario.belt.speed_mm_per_s;
    between("way in an exposure, mm", &smear_mm, [0.4, 4.0]);
    let parcels = || drawn.iter().flat_map(|w| w.scenario.parcels());
    assert!(parcels().any(|p| p.length_mm > 700.0) && parcels().any(|p| p.width_mm < 25.0));
    assert!(parcels().any(|p| p.height_mm > 350.0) && parcels().any(|p| p.height_mm < 4.0));
}

/// A world as files that `beltgauge measure recording.y4m --config beltgauge.toml` takes, and every
/// twentieth frame as a picture.
fn write_world(world: &World, folder: &Path) {
    let scenario: toml::Table = toml::from_str(&world.text).expect("valid");
    let camera = toml::to_string(&scenario["camera"]).expect("a table");
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("writable");
    write("scenario.toml", &world.text);
    write("camera.toml", &camera);
    write("beltgauge.toml", &world.config);
    let mut source = frames(world);
    let [width, height] = source.size_px();
    // By hand: the product's recorder leaves frames out when the disk is slow, and a replay needs them all.
    let mut recording = File::create(folder.join("recording.y4m")).expect("writable");
    let mut times =
        "# frame number and seconds since the first frame, a line for every picture\n".to_owned();
    writeln!(recording, "YUV4MPEG2 W{width} H{height} F{}:1 Ip Cmono", source.fps())
        .expect("writable");
    let mut frame = vec![0; width * height];
    let mut number = 0u64;
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        recording
            .write_all(b"FRAME\n")
            .and_then(|()| recording.write_all(&frame))
            .expect("writable");
        let _ = writeln!(times, "{} {}", time.index, time.t_s);
        if number.is_multiple_of(20) {
            let picture = folder.join(format!("{:04}.png", time.index));
            let grey = image::ExtendedColorType::L8;
            image::save_buffer(picture, &frame, width as u32, height as u32, grey)
                .expect("writable");
        }
        number += 1;
    }
    write("recording.y4m.times", &times);
}

/// One world, `class:seed`, with its pictures, and which of its properties matters.
fn replay(name: &str) {
    let (class, seed) = name.split_once(':').expect("class:seed");
    let known = Class::ALL.iter().find(|(_, known)| *known == class);
    let (class, _) = *known.expect("a class of the table");
    let seed = seed.parse().expect("a seed");
    let folder = common::scratch("world");
    let world = draw(seed, |_| class);
    write_world(&world, &folder);
    eprintln!("scenario, recording and site are in {}; {:?}", folder.display(), world.faults);
    if std::env::var("BISECT").as_deref() == Ok("0") {
        return;
    }
    let (records, whole) = run(&world);
    for record in &records {
        eprintln!("{record}");
    }
    eprintln!("{}\n{}", Verdict::HEADER, whole.line(name));
    let mut helped = Vec::new();
    for easy in Property::ALL {
        let other = draw(seed, |p| if p == easy { Class::Easy } else { class });
        if other.text == world.text && other.faults == world.faults {
            continue;
        }
        let (_, verdict) = run(&other);
        eprintln!("{}", verdict.line(&format!("{easy:?}")));
        let better = verdict.right_share() - whole.right_share();
        helped.push((better, easy));
    }
    helped.sort_by(|a, b| b.0.total_cmp(&a.0));
    for (better, easy) in helped.iter().filter(|(better, _)| *better > 0.0) {
        eprintln!("with an easy {easy:?} {:.0} % more are right", 100.0 * better);
    }
}
