//! The yardstick: worlds drawn at random, by class of difficulty, and what is told of their parcels.
//!
//! `WORLDS=30 cargo test --release --test worlds -- --nocapture` judges so many of each class; the
//! table goes to `target/tmp/worlds.txt` too. `REPLAY=hard_light:3` writes the scenario, some frames
//! and every record of one world to `target/tmp/world`, and says which of its properties matters:
//! each in turn is drawn as in an easy world.

mod common;
#[path = "worlds/generator.rs"]
mod generator;
#[path = "worlds/judge.rs"]
mod judge;

use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::Synthetic;
use common::measure_scenario;
use generator::{Class, Property, World, draw};
use judge::{Verdict, judge};
use std::fmt::Write as _;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Worlds of each class that every run judges.
const WORLDS: usize = 2;

/// What is reached on those today: smallest share of parcels told right, most told silently wrong.
/// The first only rises, the second only falls.
const REACHED: [(f64, usize); 7] =
    [(1.0, 0), (1.0, 0), (0.6, 4), (0.81, 3), (1.0, 0), (0.6, 2), (0.0, 6)];

/// The verdict on one world.
fn run(world: World) -> Verdict {
    let World { scenario, site, .. } = world;
    judge(&scenario, &measure_scenario(&scenario, site))
}

#[test]
fn worlds_are_told_as_well_as_they_ever_were() {
    if let Ok(name) = std::env::var("REPLAY") {
        return replay(&name);
    }
    let count = std::env::var("WORLDS").map_or(WORLDS, |n| n.parse().expect("a number"));
    let jobs = Class::ALL.len() * count;
    let next = AtomicUsize::new(0);
    let verdicts = Mutex::new(vec![Verdict::default(); Class::ALL.len()]);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                loop {
                    let job = next.fetch_add(1, Ordering::Relaxed);
                    if job >= jobs {
                        break;
                    }
                    let (kind, seed) = (job / count, (job % count) as u64);
                    let (class, name) = Class::ALL[kind];
                    let verdict = run(draw(seed, |_| class));
                    eprintln!("{}", verdict.line(&format!("{name}:{seed}")));
                    verdicts.lock().expect("no panic")[kind].add(verdict);
                }
            });
        }
    });
    let verdicts = verdicts.into_inner().expect("no panic");
    let mut table = format!("{}\n", Verdict::HEADER);
    for ((_, name), verdict) in Class::ALL.iter().zip(&verdicts) {
        let _ = writeln!(table, "{}", verdict.line(name));
    }
    eprintln!("{table}");
    std::fs::write(concat!(env!("CARGO_TARGET_TMPDIR"), "/worlds.txt"), &table).expect("writable");
    if count == WORLDS {
        for (((_, name), verdict), (right, silent)) in Class::ALL.iter().zip(&verdicts).zip(REACHED)
        {
            let told = verdict.right_share();
            assert!(told >= right, "{name}: {told:.2} told right, {right} was reached");
            assert!(verdict.silent <= silent, "{name}: {} silently wrong", verdict.silent);
        }
    }
}

/// One world, `class:seed`, with its pictures, and which of its properties matters.
fn replay(name: &str) {
    let (class, seed) = name.split_once(':').expect("class:seed");
    let known = Class::ALL.iter().find(|(_, known)| *known == class);
    let (class, _) = *known.expect("a class of the table");
    let seed = seed.parse().expect("a seed");
    let folder = common::scratch("world");
    let World { text, scenario, site } = draw(seed, |_| class);
    std::fs::write(folder.join("scenario.toml"), text).expect("writable");
    let mut source = Synthetic::new(scenario.clone()).expect("renders");
    let [width, height] = source.size_px();
    let mut frame = vec![0; width * height];
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        if time.index.is_multiple_of(20) {
            let picture = folder.join(format!("{:04}.png", time.index));
            image::save_buffer(
                picture,
                &frame,
                width as u32,
                height as u32,
                image::ExtendedColorType::L8,
            )
            .expect("writable");
        }
    }
    let records = measure_scenario(&scenario, site);
    for record in &records {
        eprintln!("{record}");
    }
    eprintln!("{}\n{}", Verdict::HEADER, judge(&scenario, &records).line(name));
    for easy in Property::ALL {
        let verdict = run(draw(seed, |p| if p == easy { Class::Easy } else { class }));
        eprintln!("{}", verdict.line(&format!("{easy:?}")));
    }
    eprintln!("scenario and frames are in {}", folder.display());
}
