//! The yardstick: worlds drawn at random, by class of difficulty, and what is told of their parcels.
//!
//! `WORLDS=30 cargo test --release --test worlds -- --nocapture` judges so many of each class (`CLASS=dense`:
//! of one); the table goes to `target/tmp/worlds.txt`, `PLOT=tests/worlds/worlds.svg` draws it. `REPLAY=hard_light:3` writes
//! the scenario, some frames and every record of one world to `target/tmp/world`, and says which of its
//! properties matters: each in turn is drawn as in an easy world (`BISECT=0`: pictures alone).

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
    (1.0, 0),
    (0.875, 0),
    (0.0, 0),
    (0.2, 0),
    (0.6, 3),
    (0.8, 1),
    (0.8, 0),
    (0.2, 0),
    (0.6, 1),
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

/// Every twentieth frame of a world, and its last one, as pictures.
fn write_pictures(world: &World, folder: &Path) {
    let mut source = frames(world);
    let [width, height] = source.size_px();
    let mut frame = vec![0; width * height];
    let mut number = 0u64;
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        if number.is_multiple_of(20) {
            let picture = folder.join(format!("{:04}.png", time.index));
            let grey = image::ExtendedColorType::L8;
            image::save_buffer(picture, &frame, width as u32, height as u32, grey)
                .expect("writable");
        }
        number += 1;
    }
}

/// One world, `class:seed`, with its pictures, and which of its properties matters.
fn replay(name: &str) {
    let (class, seed) = name.split_once(':').expect("class:seed");
    let known = Class::ALL.iter().find(|(_, known)| *known == class);
    let (class, _) = *known.expect("a class of the table");
    let seed = seed.parse().expect("a seed");
    let folder = common::scratch("world");
    let world = draw(seed, |_| class);
    std::fs::write(folder.join("scenario.toml"), &world.text).expect("writable");
    write_pictures(&world, &folder);
    eprintln!("scenario and frames are in {}; {:?}", folder.display(), world.faults);
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
