//! Every stage and the whole chain beside `OpenCV` doing the same work, on the same pictures, in
//! the same run, one thread each: `cargo bench --package hil --bench rival`.
//!
//! Ours and theirs take turns, frame by frame, so that whatever else the machine does falls on
//! both; medians are compared. `OpenCV`'s best settings for the work are taken: fixed-point maps,
//! no shadows, 16-bit labels.

use beltgauge::image::{FrameTime, Plane};
use beltgauge::kernel::Level;
use beltgauge::kernel::scalar::bits::{Square, stride};
use beltgauge::kernel::scalar::runs::{Run, collect, resolve};
use beltgauge::kernel::simd::corners::{Area, minimum_eigenvalues};
use beltgauge::plan::Plan;
use beltgauge::stage::background::Background;
use beltgauge::stage::rectify::Rectify;
use beltgauge::stage::segment::Segment;
use hil::opencv_chain::Chain;
use hil::scene::{FPS, Scene};
use std::time::{Duration, Instant};

/// Frames that are timed, after the background is learned.
const FRAMES: u64 = 360;

/// Times of one step, ours and theirs.
#[derive(Default)]
struct Pair {
    name: &'static str,
    ours: Vec<Duration>,
    theirs: Vec<Duration>,
}

impl Pair {
    fn new(name: &'static str) -> Self {
        Self { name, ..Self::default() }
    }

    fn clear(&mut self) {
        self.ours.clear();
        self.theirs.clear();
    }
}

fn timed<T>(times: &mut Vec<Duration>, work: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = std::hint::black_box(work());
    times.push(start.elapsed());
    result
}

fn median_ms(times: &[Duration]) -> f64 {
    let mut ms: Vec<f64> = times.iter().map(|t| 1e3 * t.as_secs_f64()).collect();
    ms.sort_unstable_by(f64::total_cmp);
    ms[ms.len() / 2]
}

fn main() {
    opencv::core::set_num_threads(1).expect("OpenCV");
    let scene = Scene::reference(1920, FRAMES);
    let pairs = stages(&scene);
    for pair in pairs {
        let (ours, theirs) = (median_ms(&pair.ours), median_ms(&pair.theirs));
        println!("{:24} {ours:8.3} ms {theirs:8.3} ms {:6.1} x", pair.name, theirs / ours);
    }
    chain(&scene);
}

/// The stages one by one, each on what `OpenCV` or we made of the frame before it.
fn stages(scene: &Scene) -> Vec<Pair> {
    let site = &scene.site;
    let (size, level) = (site.view.size_px, Level::new());
    let mut plan = Plan::default();
    Rectify::plan(&site.view, &mut plan);
    Background::plan(size, &mut plan);
    Segment::plan(size, &site.config.limits, &mut plan);
    let mut memory = plan.reserve(256).expect("fits");
    let mut rectify =
        Rectify::new(&site.camera, &site.view, level, 1, &mut memory).expect("planned");
    let background = site.config.background.clone();
    let mut background = Background::new(size, background, level, 1, &mut memory).expect("planned");
    let segment = site.config.segment.clone();
    let mut segment =
        Segment::new(size, site.view.mm_per_px, segment, 1, &mut memory).expect("planned");
    let mut theirs = Chain::new(site);
    let mut pairs = [
        "rectification",
        "background",
        "morphology and labels",
        "labels alone",
        "corner scores",
        "model copied; learned",
    ]
    .map(Pair::new);
    // What a parcel covers is not learned, as in the pipeline.
    let mut hold: Vec<u64> = rectify.seen().iter().map(|seen| !seen).collect();
    let mut scratch = hold.clone();
    let square = Square { width: size[0], radius: 2, bands: 1 };
    let mut runs = vec![Run::default(); site.config.limits.runs_max];
    let all = Area { u: [0, size[0]], v: [0, size[1]] };
    let mut best = vec![0.0; size[0] * size[1]];
    let model = vec![7u8; stride(size[0]) * size[1] * 5];
    let mut copy = vec![0u8; model.len()];
    let [width, height] = site.camera.image_size_px;
    for (n, frame) in scene.frames.iter().enumerate() {
        let raw = Plane::packed(frame, width, height).expect("this size");
        let [remap, learn, label, connect, corners, floor] = &mut pairs;
        timed(&mut remap.ours, || rectify.step(raw));
        timed(&mut remap.theirs, || theirs.rectify(frame));
        timed(&mut learn.ours, || background.step(rectify.pixels(), rectify.seen(), &hold));
        timed(&mut learn.theirs, || theirs.subtract());
        let (foreground, strong) = (background.foreground(), background.strong());
        let dark = background.dark();
        timed(&mut label.ours, || segment.step(foreground, strong, dark));
        timed(&mut label.theirs, || theirs.label());
        timed(&mut connect.ours, || {
            let count = collect(segment.mask(), size[0], &mut runs);
            resolve(&mut runs[..count])
        });
        timed(&mut connect.theirs, || theirs.connect());
        timed(&mut corners.ours, || {
            minimum_eigenvalues(level, rectify.view(), all, |u, v, scores| {
                best[v * size[0] + u..][..scores.len()].copy_from_slice(scores);
            });
        });
        timed(&mut corners.theirs, || theirs.score_corners());
        hold.copy_from_slice(segment.mask());
        square.dilate(&mut hold, &mut scratch);
        for (hold, seen) in hold.iter_mut().zip(rectify.seen()) {
            *hold |= !seen;
        }
        timed(&mut floor.ours, || copy.copy_from_slice(&model));
        floor.theirs.push(*learn.ours.last().expect("timed"));
        if n < 40 {
            for pair in &mut pairs {
                pair.clear();
            }
        }
    }
    pairs.into()
}

fn chain(scene: &Scene) {
    let [width, height] = scene.site.camera.image_size_px;
    let (_, mut pipeline) = beltgauge::run::build(scene.site.clone()).expect("fits");
    let mut theirs = Chain::new(&scene.site);
    let mut pair = Pair::new("whole chain");
    let mut parcels = 0;
    for (n, frame) in scene.frames.iter().enumerate() {
        let raw = Plane::packed(frame, width, height).expect("this size");
        let time = FrameTime { index: n as u64, t_s: n as f64 / FPS };
        timed(&mut pair.ours, || {
            pipeline.step(raw, time, &mut |_| parcels += 1).expect("this size");
        });
        timed(&mut pair.theirs, || theirs.step(frame));
        if n < 40 {
            pair.clear();
        }
    }
    let (ours, other) = (median_ms(&pair.ours), median_ms(&pair.theirs));
    println!("{:24} {ours:8.3} ms {other:8.3} ms {:6.1} x", pair.name, other / ours);
    let mut slowest: Vec<(Duration, usize)> = pair.ours.iter().copied().zip(40..).collect();
    slowest.sort_unstable();
    println!("{parcels} parcels, slowest frames {:?}", &slowest[slowest.len().saturating_sub(6)..]);
}
