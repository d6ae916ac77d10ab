//! What `calibrate` writes: a camera file, and how far it can be trusted.

use super::file::{LensTable, PoseTable};
use super::{Camera, Lens, LensSigmaTable};
use crate::error::{Error, Result};
use serde::Serialize;
use std::path::Path;

/// A camera file as written; [`super::CameraFile`] reads it.
#[derive(Clone, Debug, Serialize)]
pub struct CalibrationFile {
    image_size_px: [usize; 2],
    rms_px: f64,
    warnings: Vec<String>,
    lens: LensTable,
    #[serde(skip_serializing_if = "Option::is_none")]
    lens_sigma: Option<LensSigmaTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pose: Option<PoseTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    belt: Option<BeltTable>,
    image: Vec<ImageEntry>,
}

/// One image's part in a calibration.
#[derive(Clone, Debug, Serialize)]
pub struct ImageEntry {
    /// The file.
    pub file: String,
    /// Root mean square distance of its corners from where they should be.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_px: Option<f64>,
    /// Why it is not part of the result.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rejected: Option<String>,
    /// It was turned by 180 degrees against the others, and was turned back.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub turned_back: bool,
}

/// The belt under the camera, and how far it can be trusted: standard deviations.
#[derive(Clone, Debug, Serialize)]
pub struct BeltTable {
    /// Camera centre above the belt.
    pub camera_height_mm: f64,
    /// Optical axis against the belt's normal.
    pub camera_tilt_deg: f64,
    /// Of the camera's height.
    pub sigma_height_mm: f64,
    /// Of the belt plane's tilt.
    pub sigma_tilt_deg: f64,
    /// Of the direction of travel; absent when it was assumed along the image's rows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma_travel_deg: Option<f64>,
    /// How far the board was carried from each still to the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub travel_mm: Option<Vec<f64>>,
    /// The origin under the camera in the surveyor's coordinates.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surveyed_origin_mm: Option<[f64; 2]>,
}

impl CalibrationFile {
    /// A lens without a belt.
    pub fn lens(
        image_size_px: [usize; 2],
        lens: &Lens,
        sigma: Option<LensSigmaTable>,
        rms_px: f64,
        warnings: Vec<String>,
        image: Vec<ImageEntry>,
    ) -> Self {
        let lens = lens.into();
        Self {
            image_size_px,
            rms_px,
            warnings,
            lens,
            lens_sigma: sigma,
            pose: None,
            belt: None,
            image,
        }
    }

    /// The same over a belt.
    #[must_use]
    pub fn over_belt(mut self, camera: &Camera, belt: BeltTable) -> Self {
        self.pose = Some(camera.into());
        self.belt = Some(belt);
        self
    }

    /// Write it, whole or not at all.
    pub fn save(&self, path: &Path, made_by: &str) -> Result<()> {
        let failed = |e: &dyn std::fmt::Display| {
            Error::failure(format!("cannot write the calibration: {e}")).in_file(path)
        };
        let body = toml::to_string(self).map_err(|e| failed(&e))?;
        let text = format!(
            "# Camera calibration, written by `{made_by}`.\n\
             # Pixel centres as in OpenCV; X_camera = R X_belt + t; lengths in mm.\n{body}"
        );
        let beside = path.with_extension("toml.new");
        std::fs::write(&beside, text).and_then(|()| std::fs::rename(&beside, path)).map_err(|e| {
            let _ = std::fs::remove_file(&beside);
            failed(&e)
        })
    }
}
