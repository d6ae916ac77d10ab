//! In worlds drawn at random nothing happens to camera, lens and lamps: nothing is told of them.
//!
//! `WORLDS=10 cargo test --release --test health_worlds -- --nocapture` looks at so many of each class.
#![allow(dead_code)] // the worlds are made for another test

#[path = "worlds/class.rs"]
mod class;
mod common;
#[path = "worlds/generator.rs"]
mod generator;
#[path = "worlds/riders.rs"]
mod riders;

use beltgauge::health::{Condition, Level};
use beltgauge::image::{FrameTime, Plane};
use beltgauge::source::synthetic::Synthetic;
use beltgauge::source::{FaultInjector, FrameSource};
use class::Class;
use generator::{World, draw};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The same frames come again and again, until so many have come: what stands has been learned and looked at.
const FRAMES: u64 = 600;

/// What is known at the end, and the worst that was told on the way.
fn told(mut world: World) -> (Condition, [Level; 3]) {
    let belt = Synthetic::new(world.scenario.clone()).expect("renders");
    let mut source = FaultInjector::new(Box::new(belt), world.faults);
    let [width, height] = source.size_px();
    let mut frames = Vec::new();
    let mut frame = vec![0; width * height];
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        frames.push((time, frame.clone()));
    }
    world.site.config.health.every_s = 2.0;
    let (_, mut pipeline) = beltgauge::run::build(world.site).expect("fits");
    let mut worst = [Level::Good; 3];
    let last = frames.last().expect("some").0;
    for round in 0..FRAMES.div_ceil(last.index + 1) {
        for (time, frame) in &frames {
            let time = FrameTime {
                index: time.index + round * (last.index + 1),
                t_s: time.t_s + round as f64 * (last.t_s + 1.0 / source.fps()),
            };
            let raw = Plane::packed(frame, width, height).expect("a frame");
            pipeline.step(raw, time, &mut |_| {}).expect("steps");
            let now = pipeline.condition();
            for (worst, level) in
                worst.iter_mut().zip([now.place.level, now.sharpness.level, now.light.level])
            {
                *worst = level.max(*worst);
            }
        }
    }
    (pipeline.condition(), worst)
}

/// What is told of a world that must not be, and a line about it.
fn judge(class: Class, name: &str, seed: u64) -> Option<String> {
    let world = draw(seed, |_| class);
    let frames = world.scenario.frames;
    let (last, worst) = told(world);
    let (place, light) = (last.place, last.light);
    eprintln!(
        "{name}:{seed}: {frames} frames, {:?} {:.3} px {:.3} mm, blur {:?}, light {:+.2} in {}: {worst:?}",
        place.watching,
        place.moved.picture_px,
        place.moved.error_mm,
        last.sharpness.blur_px,
        light.change,
        light.region
    );
    // A noisy camera's picture is blurred from the start there, and so is a squeezed one.
    (worst[0].max(worst[2]) > Level::Good).then(|| format!("{name}:{seed}: {worst:?}"))
}

#[test]
fn nothing_is_told_where_nothing_is() {
    let count = std::env::var("WORLDS").map_or(1, |n| n.parse().expect("a number"));
    let of_each = |(class, name): (Class, &'static str)| (0..count).map(move |k| (class, name, k));
    let worlds: Vec<_> = Class::ALL.into_iter().flat_map(of_each).collect();
    let next = AtomicUsize::new(0);
    let told_of = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while let Some(&(class, name, seed)) =
                    worlds.get(next.fetch_add(1, Ordering::Relaxed))
                {
                    let told = judge(class, name, seed);
                    told_of.lock().expect("no panic").extend(told);
                }
            });
        }
    });
    let told_of = told_of.into_inner().expect("no panic");
    assert!(told_of.is_empty(), "{told_of:#?}");
}
