//! Instructions that a pixel costs in each stage, counted by callgrind in the real binary: what no
//! noisy machine can change. A limit that is exceeded is a regression, or is to be raised here with
//! a reason.

use hil::scene::{FPS, Scene, camera_file};
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::Command;

const FRAMES: u64 = 60;

/// Inclusive limits in instructions a pixel of the belt view and frame: a quarter above what was
/// counted with AVX2, which is what valgrind's processor has.
const LIMITS: [(&str, f64); 5] = [
    // 201, and 143 of them, since heights over the whole pass are a witness of their own.
    ("beltgauge::pipeline::Pipeline::step", 250.0),
    ("beltgauge::stage::passes::Passes::step", 180.0),
    // 12.3 since variances reach belts of 32 grey levels.
    ("beltgauge::stage::background::Background::step", 15.0),
    ("beltgauge::stage::segment::Segment::step", 3.4),
    ("beltgauge::stage::odometry::Odometry::step", 24.0),
];

#[test]
fn no_stage_needs_more_instructions_than_its_limit() {
    let scene = Scene::reference(640, FRAMES);
    let folder = hil::project().join("target/hil-out/instructions");
    std::fs::create_dir_all(&folder).expect("writable");
    let [width, height] = scene.site.camera.image_size_px;
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.join(name), bytes).expect("writable");
    };
    let mut video = format!("YUV4MPEG2 W{width} H{height} F{}:1 Cmono\n", FPS as u32).into_bytes();
    for frame in &scene.frames {
        video.write_all(b"FRAME\n").expect("memory");
        video.write_all(frame).expect("memory");
    }
    write("pass.y4m", &video);
    write("camera.toml", camera_file(640).as_bytes());
    let zone = &scene.site.config.zone;
    let config = format!(
        "[camera]\ncalibration = \"camera.toml\"\n[belt]\nspeed_mm_per_s = 490\n[zone]\n\
         x_min_mm = {}\nx_max_mm = {}\ny_min_mm = {}\ny_max_mm = {}\n",
        zone.x_min_mm, zone.x_max_mm, zone.y_min_mm, zone.y_max_mm
    );
    write("beltgauge.toml", config.as_bytes());
    let run = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=callgrind.out"])
        .args(["--toggle-collect=beltgauge::pipeline::Pipeline::step*"])
        .arg(hil::beltgauge())
        .args(["measure", "pass.y4m", "--config", "beltgauge.toml", "--jsonl", "parcels.jsonl"])
        .current_dir(&folder)
        .output()
        .expect("valgrind is installed");
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let report = Command::new("callgrind_annotate")
        .args(["--inclusive=yes", "--threshold=100", "--show-percs=no", "callgrind.out"])
        .current_dir(&folder)
        .output()
        .expect("comes with valgrind");
    let report = String::from_utf8_lossy(&report.stdout);
    let [columns, rows] = scene.site.view.size_px;
    let pixels = (columns * rows * scene.frames.len()) as f64;
    let mut verdict = String::new();
    let mut exceeded = false;
    for (function, limit) in LIMITS {
        let line = report.lines().find(|line| line.contains(&format!(":{function}")));
        let line = line.unwrap_or_else(|| panic!("{function} was not seen:\n{report}"));
        let count = line.split_whitespace().next().expect("a count").replace(',', "");
        let each = count.parse::<f64>().expect("a count") / pixels;
        let _ = writeln!(verdict, "{function}: {each:.2} a pixel, limit {limit}");
        exceeded |= each > limit;
    }
    println!("{verdict}");
    assert!(!exceeded, "{verdict}");
}
