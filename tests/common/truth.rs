//! Truth files of recordings, and a site from them.

use serde_json::Value;
use std::path::{Path, PathBuf};

/// A parcel record or a truth entry.
pub type Json = Value;

pub fn number(value: &Json, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("no number {key} in {value}"))
}

pub fn load(path: &Path) -> Json {
    serde_json::from_str(&std::fs::read_to_string(path).expect("readable")).expect("JSON")
}

pub fn vector(value: &Json) -> [f64; 3] {
    let flat = |v: &Json| v.as_f64().or_else(|| v[0].as_f64()).expect("a number");
    std::array::from_fn(|i| flat(&value[i]))
}

pub fn camera_centre(truth: &Json) -> [f64; 3] {
    let rows: [[f64; 3]; 3] = std::array::from_fn(|i| vector(&truth["R_world_to_camera"][i]));
    let t = vector(&truth["t_world_to_camera_mm"]);
    std::array::from_fn(|i| -(0..3).map(|k| rows[k][i] * t[k]).sum::<f64>())
}

/// camera.toml with the true calibration, the origin under the camera as `calibrate` puts it,
/// and a configuration with a nominal speed.
pub fn write_site(folder: &Path, truth: &Json, nominal_mm_per_s: f64) -> PathBuf {
    let centre = camera_centre(truth);
    let t = vector(&truth["t_world_to_camera_mm"]);
    let shifted: [f64; 3] = std::array::from_fn(|i| {
        let row = vector(&truth["R_world_to_camera"][i]);
        t[i] + row[0] * centre[0] + row[1] * centre[1]
    });
    let k = &truth["camera_matrix"];
    let camera = format!(
        "image_size_px = {}\n[lens]\nmodel = \"brown\"\nfx_px = {}\nfy_px = {}\ncx_px = {}\ncy_px = {}\n\
         distortion = {}\n[pose]\nrotation = {}\ntranslation_mm = {shifted:?}\n",
        truth["image_size"],
        k[0][0],
        k[1][1],
        k[0][2],
        k[1][2],
        truth["dist_coeffs_k1_k2_p1_p2_k3"],
        truth["R_world_to_camera"],
    );
    std::fs::write(folder.join("camera.toml"), camera).expect("writable");
    let config = format!(
        "[camera]\ncalibration = \"camera.toml\"\n\
         [zone]\nx_min_mm = -600\nx_max_mm = 600\ny_min_mm = -380\ny_max_mm = 380\n\
         [belt]\nspeed_mm_per_s = {nominal_mm_per_s}\n"
    );
    let path = folder.join("beltgauge.toml");
    std::fs::write(&path, config).expect("writable");
    path
}
