//! A configuration, and whether it goes with the camera of the example.
#![no_main]

use beltgauge::camera::CameraFile;
use beltgauge::config::{Config, Site};
use libfuzzer_sys::fuzz_target;

const CAMERA: &str = include_str!("../../../config/example/camera.toml");

fuzz_target!(|text: &str| {
    let Ok(config) = Config::parse(text) else { return };
    let camera = CameraFile::parse(CAMERA).and_then(CameraFile::into_camera).expect("the example");
    let memory_mib_max = config.limits.memory_mib_max;
    if let Ok(site) = Site::new(config, camera) {
        let plan = beltgauge::run::plan(&site);
        // Planned, not reserved: what the limit refuses must not be counted wrongly.
        let _ = plan.check_limit(memory_mib_max);
    }
});
