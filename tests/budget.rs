//! The error budget against the scatter of synthetic runs.

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::source::synthetic::Scenario;
use beltgauge::stage::measure::budget::{Geometry, expected_sigma_mm};
use common::measure_scenario;
use std::fmt::Write as _;

const SIZE_MM: [f64; 3] = [235.0, 125.0, 70.0];
const YAW_DEG: f64 = 20.0;
const SPEED_MM_PER_S: f64 = 600.0;
const FPS: f64 = 30.0;

/// Twelve equal parcels in a row, a camera 1.5 m above them.
fn scenario() -> Scenario {
    let mut text = format!(
        "seed = 5\nfps = {FPS}\nframes = 420\nexposure_ms = 1.5\n{}\
         [belt]\nspeed_mm_per_s = {SPEED_MM_PER_S}\nwidth_mm = 900\ngrey = 45\ntexture_grey = 1.3\n",
        common::camera_above([1280, 800], 900.0, 1500.0, [-0.1, 0.02, 0.0, 0.0, 0.0])
    );
    let [l, w, h] = SIZE_MM;
    for i in 0..12 {
        let _ = writeln!(
            text,
            "[[parcel]]\nlength_mm = {l}\nwidth_mm = {w}\nheight_mm = {h}\nyaw_deg = {YAW_DEG}\n\
             x_mm = {}\ny_mm = {}\nmaterial = \"kraft\"",
            -1300.0 - 521.3 * f64::from(i),
            f64::from(i % 5) * 30.7 - 60.0
        );
    }
    Scenario::parse(&text).expect("valid")
}

#[test]
fn the_expected_sigma_is_that_of_synthetic_runs() {
    let scenario = scenario();
    let config = "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 590\n\
        [zone]\nx_min_mm = -500\nx_max_mm = 500\ny_min_mm = -350\ny_max_mm = 350\n";
    let camera = scenario.camera().expect("valid");
    let site = Site::new(Config::parse(config).expect("valid"), camera).expect("a zone in view");
    let geometry = Geometry {
        view: &site.view,
        zone: &site.config.zone,
        height_max_mm: site.height_max_mm,
        travel_per_frame_mm: SPEED_MM_PER_S / FPS,
    };
    // The parcels have tape and a label: texture.
    let expected = expected_sigma_mm(&geometry, SIZE_MM, YAW_DEG, true).expect("seen");

    let records = measure_scenario(&scenario, site.clone());
    assert_eq!(records.len(), 12);
    let rms = |error: &dyn Fn(usize) -> f64| {
        ((0..12).map(|i| error(i).powi(2)).sum::<f64>() / 12.0).sqrt()
    };
    let scatter = [
        rms(&|i| records[i].length_mm - SIZE_MM[0]),
        rms(&|i| records[i].width_mm - SIZE_MM[1]),
        rms(&|i| records[i].height_mm - SIZE_MM[2]),
    ];
    eprintln!("expected {expected:.3?} mm, rms error of 12 parcels {scatter:.3?} mm");
    for (scatter, expected) in scatter.into_iter().zip(expected) {
        // Twelve draws scatter by a fifth; the budget holds 0.3 mm for what a synthetic belt does
        // not have (lens model, edges of another radius), so it may be larger, but not by ten.
        assert!(scatter < 1.3 * expected && scatter > 0.1 * expected, "{scatter} {expected}");
    }
}
