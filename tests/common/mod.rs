//! What several tests share: the command, scratch folders and the shared data.
#![allow(dead_code)] // each test uses its part

pub mod page;
pub mod truth;

use beltgauge::config::{Config, Site};
use beltgauge::event::ParcelRecord;
use beltgauge::image::Plane;
use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The product's binary.
pub fn beltgauge() -> Command {
    Command::new(env!("CARGO_BIN_EXE_beltgauge"))
}

/// Run a command to its end.
pub fn run(command: &mut Command) -> Output {
    command.output().expect("the program starts")
}

/// A new, empty folder for a test.
pub fn scratch(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("writable");
    folder
}

/// Data with ground truth that lies beside a developer's clone, not in it.
///
/// `None`, and a note, when it is not there; with CI=true that is a failure.
pub fn shared_data(part: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared").join(part);
    if path.exists() {
        return Some(path);
    }
    assert!(std::env::var("CI").as_deref() != Ok("true"), "no {} although CI=true", path.display());
    eprintln!("skipped: no data ({})", path.display());
    None
}

/// A camera straight above the belt's origin as a camera file says it, the axis in the middle of the image.
pub fn camera_file(
    [width, height]: [usize; 2],
    focal_px: f64,
    height_mm: f64,
    distortion: [f64; 5],
) -> String {
    let [cx_px, cy_px] = [width, height].map(|n| 0.5 * (n as f64 - 1.0));
    format!(
        "image_size_px = [{width}, {height}]\n\
         [lens]\nmodel = \"brown\"\nfx_px = {focal_px}\nfy_px = {focal_px}\ncx_px = {cx_px}\n\
         cy_px = {cy_px}\ndistortion = {distortion:?}\n\
         [pose]\nrotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\ntranslation_mm = [0, 0, {height_mm}]\n"
    )
}

/// The same camera in a scenario.
pub fn camera_above(
    size_px: [usize; 2],
    focal_px: f64,
    height_mm: f64,
    distortion: [f64; 5],
) -> String {
    let file = camera_file(size_px, focal_px, height_mm, distortion);
    format!("[camera]\n{file}")
        .replace("[lens]", "[camera.lens]")
        .replace("[pose]", "[camera.pose]")
}

/// A camera straight above a belt, and a configuration for it, written into `folder`.
pub fn write_site(folder: &Path, image_size_px: [usize; 2]) -> PathBuf {
    let camera = camera_file(image_size_px, 500.0, 1500.0, [0.0; 5]);
    std::fs::write(folder.join("camera.toml"), camera).expect("writable");
    let config = "[camera]\ncalibration = \"camera.toml\"\n\
                  [zone]\nx_min_mm = -300\nx_max_mm = 300\ny_min_mm = -200\ny_max_mm = 200\n\
                  [belt]\nspeed_mm_per_s = 500\n";
    let path = folder.join("beltgauge.toml");
    std::fs::write(&path, config).expect("writable");
    path
}

/// A scenario's camera over a zone that reaches so far before and past the origin, and to its sides.
pub fn site_of(scenario: &Scenario, [x_mm, y_mm]: [f64; 2], nominal_mm_per_s: f64) -> Site {
    let config = format!(
        "[camera]\ncalibration = \"the scenario's\"\n\
         [zone]\nx_min_mm = -{x_mm}\nx_max_mm = {x_mm}\ny_min_mm = -{y_mm}\ny_max_mm = {y_mm}\n\
         [belt]\nspeed_mm_per_s = {nominal_mm_per_s}\n"
    );
    let camera = scenario.camera().expect("a valid camera");
    Site::new(Config::parse(&config).expect("valid"), camera).expect("a zone in view")
}

/// What the pipeline of a site reports of a synthetic belt.
pub fn measure_scenario(scenario: &Scenario, site: Site) -> Vec<ParcelRecord> {
    measure_frames(&mut Synthetic::new(scenario.clone()).expect("renders"), site)
}

/// What the pipeline of a site reports of frames.
pub fn measure_frames(source: &mut dyn FrameSource, site: Site) -> Vec<ParcelRecord> {
    let (mut frames, mut pipeline) = beltgauge::run::build(site).expect("fits");
    let mut frame = frames.pop().expect("planned");
    let [width, height] = source.size_px();
    let mut records = Vec::new();
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        let raw = Plane::packed(&frame, width, height).expect("this size");
        pipeline.step(raw, time, &mut |r| records.push(r)).expect("this size");
    }
    pipeline.finish(&mut |r| records.push(r));
    records
}
