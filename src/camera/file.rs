//! `camera.toml`: lens and pose as `calibrate` writes them and as a technician may by hand.

use super::calibrate::nearest_rotation;
use super::{Camera, LENS_PARAMETERS, Lens, LensModel};
use crate::error::{Error, Result};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The file as written. Unknown keys are allowed: calibration reports add to it.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct CameraFile {
    image_size_px: [usize; 2],
    lens: LensTable,
    lens_sigma: Option<LensSigmaTable>,
    pose: Option<PoseTable>,
}

#[derive(Clone, Debug, Deserialize, Serialize)]
pub(super) struct LensTable {
    model: LensModel,
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
    distortion: Vec<f64>,
}

/// Standard deviations of the lens's parameters.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct LensSigmaTable {
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
    distortion: Vec<f64>,
}

#[derive(Clone, Debug, Deserialize, Serialize)]
pub(super) struct PoseTable {
    rotation: [[f64; 3]; 3],
    translation_mm: [f64; 3],
}

/// Six written digits leave this much; a wrong sign or a swapped row leaves more than 1.
const ROTATION_ERROR_MAX: f64 = 1e-3;
/// Sides of images that are accepted.
pub const IMAGE_SIDE_PX: std::ops::RangeInclusive<usize> = 64..=16384;

impl CameraFile {
    /// Read and validate a camera file with a pose.
    pub fn load(path: &Path) -> Result<Camera> {
        Self::read(
            path,
            "set camera.calibration to a file with [lens] and [pose], as `beltgauge calibrate belt` writes it",
        )?
        .into_camera()
        .map_err(|e| e.in_file(path))
    }

    /// Read and validate a camera file for its lens alone.
    pub fn load_lens(path: &Path) -> Result<CalibratedLens> {
        let file =
            Self::read(path, "give the file that `beltgauge calibrate lens` wrote with --lens")?;
        let lens = file.checked_lens().map_err(|e| e.in_file(path))?;
        if let Some(sigma) = &file.lens_sigma {
            sigma.check(lens.model).map_err(|e| e.in_file(path))?;
        }
        Ok(CalibratedLens { image_size_px: file.image_size_px, lens, sigma: file.lens_sigma })
    }

    fn read(path: &Path, remedy: &str) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| {
            Error::configuration(format!("cannot read the camera calibration: {e}"))
                .in_file(path)
                .remedy(remedy)
        })?;
        Self::parse(&text).map_err(|e| e.in_file(path))
    }

    /// Parse the text of a camera file.
    pub fn parse(text: &str) -> Result<Self> {
        toml::from_str(text).map_err(|e| {
            Error::configuration(format!("not a camera calibration: {}", e.to_string().trim_end()))
                .remedy("correct the line shown; config/example has a whole file")
        })
    }

    /// Validate.
    pub fn into_camera(self) -> Result<Camera> {
        let lens = self.checked_lens()?;
        let pose = self.pose.ok_or_else(|| {
            Error::configuration("[pose] is missing: a lens alone does not know the belt").remedy(
                "run `beltgauge calibrate belt` with this file as --lens, or add rotation and \
                 translation_mm of the camera over the belt as in config/example",
            )
        })?;
        let (camera_from_belt, translation_mm) = pose.into_transform()?;
        let camera =
            Camera { image_size_px: self.image_size_px, lens, camera_from_belt, translation_mm };
        camera.checked_height_mm()?;
        Ok(camera)
    }

    fn checked_lens(&self) -> Result<Lens> {
        let [width, height] = self.image_size_px;
        if !IMAGE_SIDE_PX.contains(&width) || !IMAGE_SIDE_PX.contains(&height) {
            return Err(Error::configuration(format!("image_size_px = [{width}, {height}]"))
                .allowed(format!("{} to {} px", IMAGE_SIDE_PX.start(), IMAGE_SIDE_PX.end()))
                .remedy("give width and height of the camera's image in pixels"));
        }
        self.lens.to_lens(self.image_size_px)
    }
}

/// A lens, as its calibration file has it.
#[derive(Clone, Debug)]
pub struct CalibratedLens {
    /// Width and height of the images it was calibrated on.
    pub image_size_px: [usize; 2],
    /// The lens.
    pub lens: Lens,
    /// How far it can be trusted; `None` when the file does not say.
    pub sigma: Option<LensSigmaTable>,
}

impl CalibratedLens {
    /// Relative standard deviation of the focal length; 0 when unknown.
    pub fn focal_sigma(&self) -> f64 {
        self.sigma.as_ref().map_or(0.0, |s| s.fx_px.max(s.fy_px) / self.lens.fx_px)
    }
}

impl LensSigmaTable {
    fn check(&self, model: LensModel) -> Result<()> {
        let all = [self.fx_px, self.fy_px, self.cx_px, self.cy_px];
        let good = |s: &f64| s.is_finite() && *s >= 0.0;
        if all.iter().chain(&self.distortion).all(good)
            && self.distortion.len() == model.distortion_count()
        {
            return Ok(());
        }
        Err(Error::configuration("lens_sigma is not a table of standard deviations")
            .allowed("finite numbers, 0 or more, as many as the lens has parameters")
            .remedy("copy the table as `beltgauge calibrate lens` wrote it, or leave it out"))
    }

    /// From standard deviations in the order of [`Lens::parameters`].
    pub fn new(model: LensModel, sigma: [f64; LENS_PARAMETERS]) -> Self {
        let [fx_px, fy_px, cx_px, cy_px, ..] = sigma;
        let distortion = sigma[4..4 + model.distortion_count()].to_vec();
        Self { fx_px, fy_px, cx_px, cy_px, distortion }
    }
}

impl From<&Camera> for CameraFile {
    /// The camera alone: what the calibration knew beside it is not in it.
    fn from(camera: &Camera) -> Self {
        Self {
            image_size_px: camera.image_size_px,
            lens: (&camera.lens).into(),
            lens_sigma: None,
            pose: Some(camera.into()),
        }
    }
}

impl From<&Lens> for LensTable {
    fn from(lens: &Lens) -> Self {
        let Lens { model, fx_px, fy_px, cx_px, cy_px, .. } = *lens;
        let distortion = lens.distortion[..model.distortion_count()].to_vec();
        Self { model, fx_px, fy_px, cx_px, cy_px, distortion }
    }
}

impl From<&Camera> for PoseTable {
    fn from(camera: &Camera) -> Self {
        let rotation = camera.camera_from_belt;
        Self {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| rotation[(i, j)])),
            translation_mm: camera.translation_mm.into(),
        }
    }
}

impl LensTable {
    fn to_lens(&self, [width, height]: [usize; 2]) -> Result<Lens> {
        for (key, value, end) in [
            ("fx_px", self.fx_px, 100 * width),
            ("fy_px", self.fy_px, 100 * height),
            ("cx_px", self.cx_px, width),
            ("cy_px", self.cy_px, height),
        ] {
            if !(value > 0.0 && value < end as f64) {
                return Err(Error::configuration(format!("lens.{key} = {value}"))
                    .allowed(format!("above 0, below {end} px"))
                    .remedy("give focal length and principal point in pixels, not mm"));
            }
        }
        let count = self.distortion.len();
        let expected: &[usize] = match self.model {
            LensModel::Brown => &[4, 5],
            LensModel::Fisheye => &[4],
        };
        if !expected.contains(&count) || self.distortion.iter().any(|k| !k.is_finite()) {
            return Err(Error::configuration(format!("lens.distortion has {count} coefficients"))
                .allowed("brown: k1 k2 p1 p2 k3; fisheye: k1 k2 k3 k4; finite numbers")
                .remedy("write absent coefficients as 0"));
        }
        let mut distortion = [0.0; 5];
        distortion[..count].copy_from_slice(&self.distortion);
        Ok(Lens::new(self.model, [self.fx_px, self.fy_px], [self.cx_px, self.cy_px], distortion))
    }
}

impl PoseTable {
    /// The rotation is made exactly orthonormal: the nearest one in the Frobenius norm.
    fn into_transform(self) -> Result<(Matrix3<f64>, Vector3<f64>)> {
        let rows = self.rotation.concat();
        let written = Matrix3::from_row_slice(&rows);
        let error = (written * written.transpose() - Matrix3::identity()).amax();
        let determinant = written.determinant();
        // A comparison with NaN must refuse.
        if !(error <= ROTATION_ERROR_MAX && determinant > 0.0) {
            return Err(Error::configuration(format!(
                "pose.rotation is not a rotation: |R R' - I| = {error:.3e}, determinant {determinant:.4}"
            ))
            .allowed(format!(
                "orthonormal rows within {ROTATION_ERROR_MAX:e}, determinant +1 (right-handed)"
            ))
            .remedy("copy all nine numbers with at least 5 digits; check row order and signs"));
        }
        let rotation = nearest_rotation(&written).ok_or_else(|| {
            Error::configuration("pose.rotation has no singular value decomposition")
        })?;
        let translation = Vector3::from(self.translation_mm);
        if !translation.iter().all(|t| t.is_finite()) {
            return Err(Error::configuration("pose.translation_mm is not finite"));
        }
        Ok((rotation, translation))
    }
}
