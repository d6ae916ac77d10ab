//! Camera geometry: lens, pose over the belt, the belt view, and how to find them with a
//! chessboard. Pure functions, no state.
//!
//! Frames: `camera` is x right, y down, z forward; `belt` is [`crate::units::BeltMm`] plus
//! height above the belt. A transform is named `target_from_source`.
//! Source: Hartley and Zisserman, Multiple View Geometry, chapter 6; `OpenCV`'s conventions.

pub mod calibrate;
mod calibration_file;
pub mod chessboard;
mod file;
pub mod focus;
mod lens;
mod view;

pub use calibration_file::{BeltTable, CalibrationFile, ImageEntry};
pub use file::{CalibratedLens, CameraFile, IMAGE_SIDE_PX, LensSigmaTable};
pub use lens::{LENS_PARAMETERS, Lens, LensModel, Projection};
pub use view::BeltView;

use crate::error::{Error, Result};
use crate::units::{BeltMm, RawPx};
use nalgebra::{Matrix3, Vector3};

/// Where a camera over a belt can be.
const HEIGHT_MM: std::ops::RangeInclusive<f64> = 50.0..=20_000.0;

/// A calibrated camera above a belt.
#[derive(Clone, Debug)]
pub struct Camera {
    /// Width and height of the raw image.
    pub image_size_px: [usize; 2],
    /// Projection from the camera frame to raw pixels.
    pub lens: Lens,
    /// Rotation of `X_camera = R X_belt + t`.
    pub camera_from_belt: Matrix3<f64>,
    /// Translation of the same, mm.
    pub translation_mm: Vector3<f64>,
}

impl Camera {
    /// Camera centre in the belt frame, mm. z is its height above the belt.
    pub fn centre_in_belt(&self) -> Vector3<f64> {
        -(self.camera_from_belt.transpose() * self.translation_mm)
    }

    /// The camera's height above the belt, mm.
    ///
    /// # Errors
    /// Where no camera can be, as below the belt.
    pub fn checked_height_mm(&self) -> Result<f64> {
        let height_mm = self.centre_in_belt().z;
        if !HEIGHT_MM.contains(&height_mm) {
            return Err(Error::configuration(format!(
                "the camera would be {height_mm:.1} mm above the belt"
            ))
            .allowed(format!("{} to {} mm, Z up from the belt", HEIGHT_MM.start(), HEIGHT_MM.end()))
            .remedy("X_camera = R X_belt + t, lengths in mm: check units, order and signs of what was given"));
        }
        Ok(height_mm)
    }

    /// Image of a point of the belt frame; `None` behind the camera or beyond the lens model.
    pub fn project(&self, in_belt: Vector3<f64>) -> Option<RawPx> {
        self.lens.project(self.camera_from_belt * in_belt + self.translation_mm)
    }

    /// Where the ray of a raw pixel meets the belt plane; `None` when it does not.
    pub fn belt_point(&self, px: RawPx) -> Option<BeltMm> {
        let ray_in_camera = self.lens.unproject(px)?;
        let ray_in_belt = self.camera_from_belt.transpose() * ray_in_camera;
        let centre = self.centre_in_belt();
        let scale = -centre.z / ray_in_belt.z;
        (scale.is_finite() && scale > 0.0).then(|| BeltMm {
            x: centre.x + scale * ray_in_belt.x,
            y: centre.y + scale * ray_in_belt.y,
        })
    }

    /// Whether a raw pixel lies between the outermost pixel centres.
    pub fn sees(&self, px: RawPx) -> bool {
        let [width, height] = self.image_size_px;
        px.x >= 0.0 && px.y >= 0.0 && px.x <= (width - 1) as f64 && px.y <= (height - 1) as f64
    }

    /// Size of a raw pixel on the belt plane at `at`, mm: the geometric mean of both directions.
    pub fn mm_per_px(&self, at: BeltMm) -> Option<f64> {
        const STEP_MM: f64 = 0.5;
        let raw = |x: f64, y: f64| self.project(Vector3::new(x, y, 0.0));
        let (a, b) = (raw(at.x - STEP_MM, at.y)?, raw(at.x + STEP_MM, at.y)?);
        let (c, d) = (raw(at.x, at.y - STEP_MM)?, raw(at.x, at.y + STEP_MM)?);
        let px2_per_mm2 = ((b.x - a.x) * (d.y - c.y) - (b.y - a.y) * (d.x - c.x)).abs()
            / (4.0 * STEP_MM * STEP_MM);
        (px2_per_mm2 > 0.0).then(|| px2_per_mm2.sqrt().recip())
    }
}
