//! The instrument watches itself: each thing that goes wrong with it is told, and nothing where nothing is.

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::error::Result;
use beltgauge::health::{Condition, Level, REGIONS, Ride, Watch, Watching};
use beltgauge::image::{FrameTime, Plane};
use beltgauge::plan::Plan;
use beltgauge::plc::registers::Status;
use beltgauge::run::Appliance;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{FrameSource, Pace, Paced};
use beltgauge::units::RawPx;
use common::truth::{Json, load, write_site};
use std::process::Command;

/// A recording that is played again and again, back and forth.
struct Recording {
    site: Site,
    frames: Vec<Vec<u8>>,
    fps: f64,
    step_mm: f64,
}

/// One of the shared recordings; `None`: it is not there.
fn recording(name: &str) -> Option<Recording> {
    let folder = common::shared_data(&format!("data/rendered/{name}"))?;
    let truth: Json = load(&folder.join("truth.json"));
    let scratch = common::scratch(&format!("health_{name}"));
    let displacement = truth["belt_displacement_mm"].as_array().expect("a list");
    let travel_mm: Vec<f64> = displacement.iter().map(|mm| mm.as_f64().expect("mm")).collect();
    let count = travel_mm.len();
    let fps = truth["fps"].as_f64().expect("a number");
    let step_mm = (travel_mm[count - 1] - travel_mm[0]) / (count - 1) as f64;
    let config = write_site(&scratch, &truth, step_mm * fps);
    let site = Site::load(&config).expect("valid");
    let bytes = Command::new("ffmpeg")
        .args(["-v", "error", "-i"])
        .arg(folder.join(format!("{name}.mkv")))
        .args(["-pix_fmt", "gray", "-f", "rawvideo", "-"])
        .output()
        .expect("ffmpeg is installed")
        .stdout;
    let [width, height] = site.camera.image_size_px;
    let frames = bytes.chunks_exact(width * height).map(<[u8]>::to_vec).collect();
    Some(Recording { site, frames, fps, step_mm })
}

impl Recording {
    /// What is known after each look of a watch that sees these frames for so long, then others.
    fn watched(&self, before_s: f64, then: &[Vec<u8>], then_s: f64) -> Vec<Condition> {
        let mut plan = Plan::default();
        Watch::plan(&self.site, &mut plan);
        let mut memory = plan.reserve(256).expect("small");
        let mut watch = Watch::new(&self.site, &mut memory).expect("planned");
        memory.seal().expect("all taken");
        let [width, height] = self.site.camera.image_size_px;
        let mut told = vec![watch.condition()];
        for k in 0..((before_s + then_s) * self.fps) as usize {
            let frames = if (k as f64) < before_s * self.fps { &self.frames } else { then };
            let there = frames.len();
            let at = k % (2 * there);
            let frame = &frames[if at < there { at } else { 2 * there - 1 - at }];
            let raw = Plane::packed(frame, width, height).expect("a frame");
            let travel_mm = k as f64 * self.step_mm;
            watch.step(
                &self.site,
                raw,
                Ride { covered: &[], travel_mm, moving_s: Some(1.0 / self.fps) },
            );
            let now = watch.condition();
            if told.last() != Some(&now) {
                told.push(now);
            }
        }
        told
    }

    /// The frames, changed.
    fn changed(&self, change: impl Fn(&[u8], [usize; 2]) -> Vec<u8>) -> Vec<Vec<u8>> {
        self.frames.iter().map(|frame| change(frame, self.site.camera.image_size_px)).collect()
    }
}

/// Of four pixels, for the place `t` of the way from the second to the third.
fn weights(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// A picture moved along x and y, by bicubic interpolation; its border is repeated.
fn moved(frame: &[u8], [width, height]: [usize; 2], [dx, dy]: [f64; 2]) -> Vec<u8> {
    let pass = |from: &[f64], along_x: bool, by: f64| -> Vec<f64> {
        let (whole, weights) = ((-by).floor(), weights(-by - (-by).floor()));
        let at = |i: usize, k: usize, n: usize| {
            (i as f64 + whole + k as f64 - 1.0).clamp(0.0, n as f64 - 1.0) as usize
        };
        (0..width * height)
            .map(|i| {
                let (x, y) = (i % width, i / width);
                let value = |k: usize| {
                    if along_x {
                        from[y * width + at(x, k, width)]
                    } else {
                        from[at(y, k, height) * width + x]
                    }
                };
                (0..4).map(|k| weights[k] * value(k)).sum()
            })
            .collect()
    };
    let frame: Vec<f64> = frame.iter().map(|v| f64::from(*v)).collect();
    let moved = pass(&pass(&frame, true, dx), false, dy);
    moved.into_iter().map(|v| v.round().clamp(0.0, 255.0) as u8).collect()
}

#[test]
fn nothing_is_told_of_recordings_in_which_nothing_is() {
    for name in ["public_a", "public_b", "public_c", "public_d"] {
        let Some(recording) = recording(name) else { return };
        let told = recording.watched(90.0, &[], 0.0);
        let last = told.last().expect("one");
        eprintln!("{name}: {last:?}");
        assert_eq!(last.place.watching, Watching::Both, "{name}");
        for now in &told {
            let levels = [now.place.level, now.sharpness.level, now.light.level];
            assert_eq!(levels, [Level::Good; 3], "{name}: {now:?}");
        }
    }
}

/// The frames as the camera sees them when it has turned about its axes, degrees, and how far the picture
/// has then moved in the zone, px.
fn turned(recording: &Recording, degrees: [f64; 3]) -> (Vec<Vec<u8>>, f64) {
    let camera = &recording.site.camera;
    let [width, height] = camera.image_size_px;
    let angles = nalgebra::Vector3::from(degrees.map(f64::to_radians));
    let turn = nalgebra::Rotation3::from_scaled_axis(angles);
    // Where in the picture as it was a pixel of the turned one was seen.
    let from = |x: usize, y: usize| {
        let ray = camera.lens.unproject(RawPx { x: x as f64, y: y as f64 })?;
        camera.lens.project(turn.inverse() * ray)
    };
    let map: Vec<Option<RawPx>> = (0..width * height).map(|i| from(i % width, i / width)).collect();
    let seen = |frame: &[u8], _: [usize; 2]| -> Vec<u8> {
        map.iter().map(|px| px.map_or(0, |px| cubic(frame, [width, height], px))).collect()
    };
    let zone = recording.site.config.zone;
    let mut moved_px = Vec::new();
    for k in 0..9 {
        let at = |from: f64, to: f64, k: usize| from + (to - from) * k as f64 / 2.0;
        let x = at(zone.x_min_mm, zone.x_max_mm, k % 3);
        let y = at(zone.y_min_mm, zone.y_max_mm, k / 3);
        let on_belt = nalgebra::Vector3::new(x, y, 0.0);
        let before = camera.project(on_belt).expect("in view");
        let in_camera = turn * (camera.camera_from_belt * on_belt + camera.translation_mm);
        let after = camera.lens.project(in_camera).expect("in view");
        moved_px.push((after.x - before.x).hypot(after.y - before.y));
    }
    (recording.changed(seen), moved_px.iter().sum::<f64>() / 9.0)
}

/// Grey between pixels.
fn cubic(frame: &[u8], [width, height]: [usize; 2], px: RawPx) -> u8 {
    let [x, y] = [px.x.floor(), px.y.floor()];
    let ([wx, wy], mut sum) = ([weights(px.x - x), weights(px.y - y)], 0.0);
    let at =
        |at: f64, k: usize, n: usize| (at + k as f64 - 1.0).clamp(0.0, n as f64 - 1.0) as usize;
    for (j, wy) in wy.iter().enumerate() {
        let row = at(y, j, height) * width;
        for (i, wx) in wx.iter().enumerate() {
            sum += wx * wy * f64::from(frame[row + at(x, i, width)]);
        }
    }
    sum.round().clamp(0.0, 255.0) as u8
}

#[test]
fn a_camera_that_was_knocked_is_told_with_how_far() {
    // A turn about the picture's axes by a degree is 12 px and more; about the optical one, and a little.
    for (name, degrees, level) in [
        ("public_c", [0.03, -0.03, 0.0], Level::Warning),
        ("public_c", [0.0, 0.0, 0.1], Level::Warning),
        ("public_d", [0.0, 0.04, 0.0], Level::Warning),
        ("public_d", [-0.25, 0.0, 0.02], Level::Fault),
        ("public_c", [2.0, 2.5, 0.0], Level::Fault),
    ] {
        let Some(recording) = recording(name) else { return };
        let (knocked, true_px) = turned(&recording, degrees);
        let last = recording.watched(40.0, &knocked, 60.0).last().expect("one").place;
        eprintln!("{name}, turned by {degrees:?} degrees, {true_px:.2} px: {last:?}");
        assert_eq!((last.level, last.watching), (level, Watching::Both), "{name} {degrees:?}");
        // Large motions are told as if they were small ones: a turn by 2.5 degrees, seen 35 degrees off the axis, is wrong
        // by tan 2.5 * tan 35 = 3 %, and a third of that for where the edges happen to lie.
        let off_px = (last.moved.picture_px - true_px).abs();
        assert!(off_px < 0.05 + 0.04 * true_px, "{name} {degrees:?}: off by {off_px} px");
    }
}

/// A synthetic belt between rails, with a gantry over its ends, that is seen otherwise for a while.
struct Changed {
    belt: Synthetic,
    frames: std::ops::Range<u64>,
    change: fn(&[u8], [usize; 2]) -> Vec<u8>,
}

impl FrameSource for Changed {
    fn size_px(&self) -> [usize; 2] {
        self.belt.size_px()
    }

    fn fps(&self) -> f64 {
        self.belt.fps()
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        let time = self.belt.next_into(frame)?;
        if time.is_some_and(|time| self.frames.contains(&time.index)) {
            let changed = (self.change)(frame, self.belt.size_px());
            frame.copy_from_slice(&changed);
        }
        Ok(time)
    }
}

const GANTRY: &str = "[[intruder]]\nfrom_s = 0\nto_s = 1e9\nvelocity_mm_per_s = [0, 0, 0]\n\
    rod = [{ from_mm = [-640, -500, 60], to_mm = [-640, 500, 60], radius_mm = 20, grey = 150 }, \
    { from_mm = [640, -500, 60], to_mm = [640, 500, 60], radius_mm = 20, grey = 150 }]\n";

/// Run the appliance on it; all codes of each status that is new, and the last status.
fn told(gantry: &str, change: fn(&[u8], [usize; 2]) -> Vec<u8>) -> (Vec<Vec<u16>>, Status) {
    let text = format!(
        "seed = 3\nfps = 50\nframes = 2400\nexposure_ms = 1\n{}[belt]\n\
         speed_mm_per_s = 300\nwidth_mm = 800\ngrey = 45\ntexture_grey = 2\n{gantry}",
        common::camera_above([768, 480], 540.0, 1200.0, [0.0; 5])
    );
    let config = "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 300\n\
         [zone]\nx_min_mm = -500\nx_max_mm = 500\ny_min_mm = -300\ny_max_mm = 300\n\
         [health]\nevery_s = 3\nmoved_fault_mm = 20\n[modbus]\nlisten = \"127.0.0.1:0\"\n";
    let scenario = Scenario::parse(&text).expect("valid");
    let camera = scenario.camera().expect("valid");
    let site = Site::new(Config::parse(config).expect("valid"), camera).expect("in view");
    let belt = Synthetic::new(scenario).expect("renders");
    // As it was again at the end.
    let mut source = Changed { belt, frames: 1000..1650, change };
    let mut feed = Paced::new(&mut source, Pace::Unhurried);
    let appliance = Appliance::new(site).expect("a free port");
    let (mut told, mut last) = (Vec::<Vec<u16>>::new(), Status::default());
    let ended = appliance.run(&mut feed, |progress, _| {
        last = Status { running: true, vision: progress.status, ..Status::default() };
        let codes: Vec<u16> = last.reasons().filter(|code| *code >= 21).collect();
        if told.last() != Some(&codes) {
            told.push(codes);
        }
        true
    });
    ended.expect("runs to the end");
    eprintln!("{told:?} {:?}", last.vision.health);
    (told, last)
}

#[test]
fn a_knock_is_told_to_the_plc_until_it_is_undone() {
    let (codes, last) = told(GANTRY, |frame, size| moved(frame, size, [0.6, 0.0]));
    assert_eq!(codes, [vec![], vec![21], vec![]]);
    assert_eq!(last.vision.health.camera_watch, Watching::Both as u16);
    let (codes, last) = told(GANTRY, |frame, size| moved(frame, size, [-20.0, 5.0]));
    // The mean over the knock itself may be a warning first.
    assert!(codes.contains(&vec![22]) && codes.last() == Some(&vec![]), "{codes:?}");
    assert!(last.vision.health.camera_error_mm < 0.05);
}

#[test]
fn where_only_rails_stand_a_knock_along_them_is_not_said_to_be_watched() {
    let (codes, last) = told("", |frame, size| moved(frame, size, [0.0, 0.4]));
    assert_eq!(codes, [vec![], vec![21], vec![]]);
    assert_eq!(last.vision.health.camera_watch, Watching::Across as u16);
}

/// A picture blurred by this standard deviation, px.
fn blurred(frame: &[u8], [width, height]: [usize; 2], sigma_px: f64) -> Vec<u8> {
    let reach = (3.5 * sigma_px).ceil() as isize;
    let weight = |k: isize| (-0.5 * (k as f64 / sigma_px).powi(2)).exp();
    let total: f64 = (-reach..=reach).map(weight).sum();
    let weights: Vec<f32> = (-reach..=reach).map(|k| (weight(k) / total) as f32).collect();
    let pass = |from: &[f32], along_x: bool| -> Vec<f32> {
        (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as isize, (i / width) as isize);
                let value = |k: isize| {
                    let u = if along_x { x + k } else { x }.clamp(0, width as isize - 1);
                    let v = if along_x { y } else { y + k }.clamp(0, height as isize - 1);
                    from[v as usize * width + u as usize]
                };
                (-reach..=reach).zip(&weights).map(|(k, weight)| weight * value(k)).sum()
            })
            .collect()
    };
    let frame: Vec<f32> = frame.iter().map(|v| f32::from(*v)).collect();
    pass(&pass(&frame, true), false).into_iter().map(|v| v.round() as u8).collect()
}

#[test]
fn a_lens_out_of_focus_is_told() {
    for (name, sigma_px, level) in [
        ("public_c", 2.0, Level::Warning),
        ("public_d", 2.0, Level::Warning),
        ("public_c", 3.0, Level::Fault),
    ] {
        let Some(recording) = recording(name) else { return };
        let unsharp = recording.changed(|frame, size| blurred(frame, size, sigma_px));
        let told = recording.watched(40.0, &unsharp, 40.0);
        let before = told.iter().find_map(|now| now.sharpness.blur_px).expect("known");
        let last = told.last().expect("one");
        eprintln!("{name}, {sigma_px} px: {before:.2}, then {last:?}");
        assert_eq!((last.sharpness.level, last.place.level), (level, Level::Good), "{name}");
        let after = last.sharpness.blur_px.expect("known");
        let expected = before.hypot(sigma_px);
        assert!((after / expected - 1.0).abs() < 0.2, "{name}: {after}, expected {expected}");
        // In use from the start it is told as well.
        let from_start = Recording { frames: unsharp, ..recording };
        let told = from_start.watched(40.0, &[], 0.0);
        assert_eq!(told.last().expect("one").sharpness.level, level, "{name}");
    }
}

#[test]
fn a_lamp_that_fails_is_told_with_the_place() {
    for (name, gain) in [("public_c", 0.5), ("public_d", 1.6)] {
        let Some(recording) = recording(name) else { return };
        let darker = recording.changed(|frame, [width, _]| {
            let lit = |(i, v): (usize, &u8)| {
                let gain = if i % width < width / 2 { gain } else { 1.0 };
                (f64::from(*v) * gain).round().min(255.0) as u8
            };
            frame.iter().enumerate().map(lit).collect()
        });
        let told = recording.watched(40.0, &darker, 40.0);
        let last = told.last().expect("one");
        eprintln!("{name}, gain {gain}: {last:?}");
        assert_eq!((last.light.level, last.place.level), (Level::Warning, Level::Good), "{name}");
        let columns = u8::try_from(REGIONS[0]).expect("few");
        assert!((last.light.region - 1) % columns < columns / 2, "{name}: {:?}", last.light);
    }
}

#[test]
fn blur_and_light_are_told_to_the_plc_until_they_are_as_before() {
    let (codes, _) = told(GANTRY, |frame, size| blurred(frame, size, 1.7));
    assert_eq!(codes, [vec![], vec![23], vec![]]);
    let (codes, _) = told(GANTRY, |frame, size| blurred(frame, size, 3.0));
    assert!(codes.contains(&vec![24]) && codes.last() == Some(&vec![]), "{codes:?}");
    let (codes, last) = told(GANTRY, |frame, [width, _]| {
        let lit = |(i, v): (usize, &u8)| if i % width < width / 2 { v / 2 } else { *v };
        frame.iter().enumerate().map(lit).collect()
    });
    assert_eq!(codes, [vec![], vec![25], vec![]]);
    assert!(last.vision.health.light_change.abs() < 0.1);
}

#[test]
fn the_parcels_themselves_show_a_lens_out_of_focus_before_ten_have_passed() {
    for name in ["public_a", "public_b", "public_c", "public_d"] {
        let Some(recording) = recording(name) else { return };
        let unsharp = recording.changed(|frame, size| blurred(frame, size, 2.0));
        let (_, mut pipeline) = beltgauge::run::build(recording.site.clone()).expect("fits");
        let [width, height] = recording.site.camera.image_size_px;
        let (mut passed, mut told_after) = (0, None);
        let count = recording.frames.len();
        for (k, frame) in recording.frames.iter().chain(&unsharp).enumerate() {
            let raw = Plane::packed(frame, width, height).expect("a frame");
            let time = FrameTime { index: k as u64, t_s: k as f64 / recording.fps };
            let mut left = 0;
            pipeline.step(raw, time, &mut |_| left += 1).expect("steps");
            let now = pipeline.condition().sharpness;
            if k < count {
                assert_eq!(now.level, Level::Good, "{name}: {now:?}");
                continue;
            }
            passed += left;
            if now.level > Level::Good && told_after.is_none() {
                eprintln!("{name}: {now:?} after {passed} parcels");
                told_after = Some(passed);
            }
        }
        assert!(told_after.is_some_and(|passed| passed < 10), "{name}: {told_after:?}");
    }
}
