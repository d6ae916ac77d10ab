//! A camera's calibration, and whether the configuration of the example goes with it.
#![no_main]

use beltgauge::camera::CameraFile;
use beltgauge::config::{Config, Site};
use libfuzzer_sys::fuzz_target;

const CONFIG: &str = include_str!("../../../config/example/beltgauge.toml");

fuzz_target!(|text: &str| {
    let Ok(camera) = CameraFile::parse(text).and_then(CameraFile::into_camera) else { return };
    let config = Config::parse(CONFIG).expect("the example");
    if let Ok(site) = Site::new(config, camera) {
        assert!(site.height_max_mm.is_finite());
    }
});
