//! A recording gives the same records again, and the demo's own is all that a newcomer needs: measured
//! again, and its camera calibrated from its stills.

mod common;

use beltgauge::camera::{Camera, CameraFile};
use beltgauge::config::Site;
use beltgauge::event::ParcelRecord;
use beltgauge::image::Plane;
use beltgauge::plan::Block;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{FaultInjector, Faults, Feed, Next, Pace, Paced, Recorder};
use common::{beltgauge, run, scratch};
use nalgebra::Vector3;
use std::fs;
use std::path::Path;
use std::time::Duration;

/// What the stills' noise leaves of the camera, twice over: 0.24 px and 0.08 mm were reached.
const WORST_PX: f64 = 0.5;
const HEIGHT_MM: f64 = 0.2;

/// Every line of a record file.
fn records(path: &Path) -> Vec<serde_json::Value> {
    let text = fs::read_to_string(path).expect("records");
    text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
}

fn measure(folder: &Path, arguments: &[&str]) -> Vec<serde_json::Value> {
    let output = run(beltgauge()
        .current_dir(folder)
        .args(["measure", "recording.y4m", "--config", "beltgauge.toml"])
        .args(["--jsonl", "again.jsonl"])
        .args(arguments));
    assert!(output.status.success(), "{output:?}");
    records(&folder.join("again.jsonl"))
}

/// The demo's belt in a quarter of its pixels.
fn small() -> Scenario {
    let text = include_str!("../config/demo/scenario.toml")
        .replace("exposure_ms", "frames = 170\nexposure_ms")
        .replace("[1280, 800]", "[640, 400]")
        .replace("fx_px = 679.5", "fx_px = 339.7")
        .replace("fy_px = 679.9", "fy_px = 339.9")
        .replace("cx_px = 626.8", "cx_px = 313.1")
        .replace("cy_px = 399.4", "cy_px = 199.4");
    Scenario::parse(&text).expect("valid")
}

#[test]
fn a_recording_of_a_camera_that_lost_frames_gives_the_same_records_again() {
    let folder = scratch("recording");
    let scenario = small();
    let camera = camera_text(&scenario.camera().expect("valid"));
    fs::write(folder.join("camera.toml"), camera).expect("room");
    let config = folder.join("beltgauge.toml");
    fs::write(&config, include_str!("../config/demo/beltgauge.toml")).expect("room");
    let belt = Synthetic::new(scenario).expect("renders");
    let faults = Faults::parse("drop=0.2,late=3,seed=5").expect("valid");
    let mut source = FaultInjector::new(Box::new(belt), faults);
    let mut feed = Paced::new(&mut source, Pace::Unhurried);
    let path = folder.join("recording.y4m");
    let mut recorder = Recorder::create(&mut feed, &path, 8).expect("room");
    let mut buffer = Block::own(640 * 400).expect("small");
    let site = Site::load(&config).expect("valid");
    let (_, mut pipeline) = beltgauge::run::build(site).expect("fits");
    let mut live: Vec<ParcelRecord> = Vec::new();
    while let Next::Frame(taken) = recorder.next(&mut buffer).expect("renders") {
        let raw = Plane::packed(&buffer, 640, 400).expect("this size");
        pipeline.step(raw, taken.time, &mut |r| live.push(r)).expect("this size");
        // What the disk of a busy machine may need.
        std::thread::sleep(Duration::from_millis(3));
    }
    pipeline.finish(&mut |r| live.push(r));
    let recorded = recorder.finish().expect("room");
    assert_eq!(recorded.lost, 0, "the disk was too slow for this test");
    assert!(live.len() >= 3, "{} parcels", live.len());
    let live: Vec<_> = live.iter().map(|r| serde_json::to_value(r).expect("JSON")).collect();
    assert_eq!(measure(&folder, &[]), live);
    // Without the times beside it the gaps are not known, and it is measured otherwise.
    assert_ne!(measure(&folder, &["--fps", "30"]), live);
}

#[test]
fn damaged_times_are_told_by_line_and_what_was_measured_is_written() {
    let folder = scratch("recording-damaged");
    common::write_site(&folder, [320, 240]);
    let mut y4m = b"YUV4MPEG2 W320 H240 F25:1 Ip Cmono\n".to_vec();
    for _ in 0..4 {
        y4m.extend(b"FRAME\n");
        y4m.extend(vec![60; 320 * 240]);
    }
    fs::write(folder.join("recording.y4m"), y4m).expect("room");
    let head = "# frame number and seconds since the first frame, a line for every picture\n";
    for (times, word) in [
        ("0 0\n", "first line"),
        (&*format!("{head}0 0\n1 0.04\n1 0.08\n3 0.12\n"), "line 4"),
        (&format!("{head}0 0\n1 0.04\n2 x\n3 0.12\n"), "line 4"),
        (&format!("{head}0 0\n1 0.04\n2 inf\n3 0.12\n"), "line 4"),
        (&format!("{head}0 0\n1 0.04\n2 0.08\n"), "times end first"),
        (&format!("{head}0 0\n1 0.04\n2 0.08\n3 0.12\n4 0.16\n"), "pictures end first"),
    ] {
        fs::write(folder.join("recording.y4m.times"), times).expect("room");
        let output = run(beltgauge().current_dir(&folder).args([
            "measure",
            "recording.y4m",
            "--config",
            "beltgauge.toml",
        ]));
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{told}");
        assert!(told.contains(word) && told.contains("y4m.times"), "no {word} in {told}");
    }
}

#[test]
fn what_the_demo_records_is_measured_again_and_its_camera_calibrated() {
    let (folder, out) = (scratch("demo-record"), scratch("demo-record-out"));
    let demo = |seconds: &str| {
        run(beltgauge()
            .args(["demo", "--seconds", seconds, "--listen", "127.0.0.1:0", "--out"])
            .arg(&out)
            .arg("--record")
            .arg(&folder))
    };
    let output = demo("11");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && told.contains("frames recorded"), "{told}");
    let live = records(&out.join("parcels.jsonl"));
    assert!(live.len() >= 2, "{} parcels", live.len());
    // What a slow computer left out of the pipeline is in the recording all the same.
    let (_, left_out) = told.rsplit_once("dropped ").expect("how many were left out");
    if !told.contains("missing") && left_out.starts_with("0 ") {
        // The parcels that were inside at the end come after them. The configuration's camera has been
        // through text, which costs its last digits: a record's last digit, 0.01 mm, may be another.
        let again = measure(&folder, &[]);
        for (live, again) in live.iter().zip(&again) {
            for key in ["seq", "frame", "flags"] {
                assert_eq!(live[key], again[key], "{live} {again}");
            }
            let number = |v: &serde_json::Value, key: &str| v[key].as_f64().expect("a number");
            for key in ["length_mm", "width_mm", "height_mm", "x_mm", "y_mm", "t_s"] {
                let difference = (number(live, key) - number(again, key)).abs();
                assert!(difference < 0.0101, "{key}: {live} {again}");
            }
        }
        assert!(again.len() >= live.len());
    }
    // As README does it.
    let truth = CameraFile::load(&folder.join("camera.toml")).expect("written");
    let calibrate = |arguments: &[&str]| {
        let board = ["--board", "9x6", "--square-mm", "25"];
        let output =
            run(beltgauge().current_dir(&folder).arg("calibrate").args(arguments).args(board));
        assert!(output.status.success(), "{output:?}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let warnings = calibrate(&["lens", "views", "--out", "lens.toml"]);
    assert_eq!(warnings, "", "lens");
    let flat = ["--board-thickness-mm", "3", "--lens", "lens.toml", "--out", "camera.toml"];
    calibrate(&[&["belt", "pass", "--elsewhere", "elsewhere"][..], &flat].concat());
    let found = CameraFile::load(&folder.join("camera.toml")).expect("written");
    // Where the reached camera puts the points of the zone, at the height of a parcel too.
    let mut worst_px = 0.0f64;
    for (x, y, z) in (0..5 * 3 * 2).map(|k| {
        (f64::from(k % 5 - 2) * 290.0, f64::from(k / 5 % 3 - 1) * 350.0, f64::from(k / 15) * 250.0)
    }) {
        let at = Vector3::new(x, y, z);
        let (a, b) = (truth.project(at).expect("seen"), found.project(at).expect("seen"));
        worst_px = worst_px.max((a.x - b.x).hypot(a.y - b.y));
    }
    let height_mm = (truth.centre_in_belt().z - found.centre_in_belt().z).abs();
    eprintln!("zone within {worst_px:.2} px, camera height within {height_mm:.2} mm");
    assert!(worst_px < WORST_PX && height_mm < HEIGHT_MM, "{worst_px} px, {height_mm} mm");
    assert_eq!(demo("2").status.code(), Some(2), "an earlier recording is not overwritten");
}

fn camera_text(camera: &Camera) -> String {
    let row = |i: usize| {
        let r = camera.camera_from_belt.row(i);
        format!("[{}, {}, {}]", r[0], r[1], r[2])
    };
    let [fx, fy, cx, cy, k @ ..] = camera.lens.parameters();
    let t = camera.translation_mm;
    format!(
        "image_size_px = {:?}\n[lens]\nmodel = \"brown\"\nfx_px = {fx}\nfy_px = {fy}\ncx_px = {cx}\n\
         cy_px = {cy}\ndistortion = {:?}\n[pose]\nrotation = [{}, {}, {}]\ntranslation_mm = [{}, {}, {}]\n",
        camera.image_size_px,
        &k[..5],
        row(0),
        row(1),
        row(2),
        t.x,
        t.y,
        t.z
    )
}
