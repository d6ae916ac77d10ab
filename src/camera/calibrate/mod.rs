//! Calibration: a lens from chessboards, a pose from a board on the belt or surveyed points.
//!
//! Pure: corners and points in, a camera and how far to trust it out. Source: Zhang 2000, "A
//! flexible new technique for camera calibration"; Strobl and Hirzinger 2011 for the board that
//! is not flat.

mod belt;
mod bundle;
mod homography;
mod least_squares;
mod lens;
mod points;
mod turned;
mod verdict;

pub use belt::{BeltCalibration, BeltStill, StillResult, calibrate_belt};
pub(super) use homography::nearest_rotation;
pub use lens::{BoardShape, LensCalibration, LensStart, ViewResult, calibrate_lens};
pub use points::{PointsCalibration, SurveyedPoint, calibrate_points};

use super::{Camera, Lens};
use crate::units::RawPx;
use nalgebra::{DVector, Matrix3, Rotation3, Vector3};

/// Where a board or a belt is: `X_camera = R X + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// R.
    pub rotation: Matrix3<f64>,
    /// t, mm.
    pub translation_mm: Vector3<f64>,
}

impl Pose {
    /// A point in the camera frame.
    pub fn apply(&self, point: Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation_mm
    }

    /// Turned by a small rotation vector (rad) and shifted, both in the camera frame.
    fn moved(&self, turn: Vector3<f64>, shift: Vector3<f64>) -> Self {
        Self {
            rotation: Rotation3::new(turn) * self.rotation,
            translation_mm: self.translation_mm + shift,
        }
    }
}

impl Pose {
    /// [`Pose::moved`] by the first six parameters of a fit: turn, then shift.
    fn stepped(&self, x: &DVector<f64>) -> Self {
        self.moved(Vector3::new(x[0], x[1], x[2]), Vector3::new(x[3], x[4], x[5]))
    }
}

/// A camera whose belt plane is z = 0 of `pose`, with the belt's origin moved under it.
fn camera_over_belt(lens: &Lens, image_size_px: [usize; 2], pose: Pose) -> Camera {
    let centre = -(pose.rotation.transpose() * pose.translation_mm);
    Camera {
        image_size_px,
        lens: lens.clone(),
        camera_from_belt: pose.rotation,
        translation_mm: -(pose.rotation * Vector3::new(0.0, 0.0, centre.z)),
    }
}

/// Distance between where a point is seen and where it should be.
fn reprojection_error(lens: &Lens, in_camera: Vector3<f64>, seen: RawPx) -> Option<[f64; 2]> {
    let expected = lens.linearise(in_camera)?.px;
    Some([expected.x - seen.x, expected.y - seen.y])
}
