//! Belts as they are: woven, plain, seen by a noisy camera. What passes on them is told, once.

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::event::ParcelRecord;
use beltgauge::source::synthetic::Scenario;
use common::measure_scenario;
use std::fmt::Write as _;

/// A 640 x 400 camera 1 m above the belt, 2 mm a pixel, straight down.
const CAMERA: &str = r#"
[camera]
image_size_px = [640, 400]
[camera.lens]
model = "brown"
fx_px = 512.0
fy_px = 512.0
cx_px = 319.5
cy_px = 199.5
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[camera.pose]
rotation = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
translation_mm = [0.0, 0.0, 1000.0]
"#;

const SIZE_MM: [f64; 3] = [200.0, 120.0, 80.0];
const SPEED_MM_PER_S: f64 = 500.0;

/// Boxes half a metre apart, on a belt of this texture, with `tables` besides.
fn boxes(count: u32, grey: f64, texture_grey: f64, tables: &str) -> Scenario {
    let [l, w, h] = SIZE_MM;
    let frames = 105 + 30 * count;
    let mut text = format!(
        "seed = 3\nfps = 30\nframes = {frames}\nexposure_ms = 1\n{CAMERA}\
         [belt]\nspeed_mm_per_s = {SPEED_MM_PER_S}\nwidth_mm = 800\ngrey = {grey}\n\
         texture_grey = {texture_grey}\n{tables}\n"
    );
    for k in 0..count {
        let x_mm = -1000.0 - 500.0 * f64::from(k);
        let _ = writeln!(
            text,
            "[[parcel]]\nlength_mm = {l}\nwidth_mm = {w}\nheight_mm = {h}\nyaw_deg = 8\n\
             x_mm = {x_mm}\ny_mm = 20\nmaterial = \"white\""
        );
    }
    Scenario::parse(&text).expect("a valid scenario")
}

fn site(scenario: &Scenario, nominal_mm_per_s: f64) -> Site {
    let config = format!(
        "[camera]\ncalibration = \"the scenario's\"\n\
         [zone]\nx_min_mm = -500\nx_max_mm = 500\ny_min_mm = -300\ny_max_mm = 300\n\
         [belt]\nspeed_mm_per_s = {nominal_mm_per_s}\n"
    );
    let camera = scenario.camera().expect("a valid camera");
    Site::new(Config::parse(&config).expect("valid"), camera).expect("a zone in view")
}

fn is_right(record: &ParcelRecord) -> bool {
    let sides_mm = [record.length_mm, record.width_mm, record.height_mm];
    sides_mm.iter().zip(SIZE_MM).all(|(side, truth)| (side - truth).abs() <= 2.0)
}

#[test]
fn boxes_on_a_woven_belt_are_measured() {
    for (grey, texture_grey) in [(60.0, 4.5), (70.0, 8.0), (80.0, 12.0)] {
        let scenario = boxes(2, grey, texture_grey, "");
        let records = measure_scenario(&scenario, site(&scenario, 490.0));
        assert!(
            records.len() == 2 && records.iter().all(|r| is_right(r) && r.may_be_used),
            "{texture_grey}: {records:#?}"
        );
    }
}
