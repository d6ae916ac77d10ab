//! A table of surveyed points, and the pose that fits them.
#![no_main]

use beltgauge::camera::calibrate::calibrate_points;
use beltgauge::camera::{CalibratedLens, CameraFile};
use beltgauge::fuzz::parse_points;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

const CAMERA: &str = include_str!("../../../config/example/camera.toml");
/// The fit takes time with the number of points.
const POINTS_MAX: usize = 40;

fuzz_target!(|text: &str| {
    let Ok(points) = parse_points(text, Path::new("survey.csv")) else { return };
    if points.len() > POINTS_MAX {
        return;
    }
    let camera = CameraFile::parse(CAMERA).and_then(CameraFile::into_camera).expect("the example");
    let lens =
        CalibratedLens { image_size_px: camera.image_size_px, lens: camera.lens, sigma: None };
    if let Ok(calibration) = calibrate_points(&lens, &points) {
        assert!(calibration.sigma_height_mm.is_finite());
    }
});
