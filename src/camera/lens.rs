//! Lens models `brown` (Brown-Conrady, k1 k2 p1 p2 k3) and `fisheye` (Kannala-Brandt, k1..k4).
//!
//! Source: `OpenCV`'s calib3d and fisheye modules; Kannala and Brandt 2006, eq. 6.

use crate::units::RawPx;
use nalgebra::{Matrix2, Matrix2x3, SMatrix, Vector2, Vector3};

/// Which polynomial bends the rays.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LensModel {
    /// Radial k1 k2 k3 and tangential p1 p2 terms on the normalised image plane.
    Brown,
    /// Polynomial k1..k4 in the angle to the optical axis.
    Fisheye,
}

impl LensModel {
    /// Coefficients that are written down.
    pub fn distortion_count(self) -> usize {
        match self {
            Self::Brown => 5,
            Self::Fisheye => 4,
        }
    }
}

/// Parameters of a lens, in this order: fx, fy, cx, cy, then the five of the distortion.
pub const LENS_PARAMETERS: usize = 9;

/// A projected point and how it moves with the point and with the lens.
#[derive(Clone, Copy, Debug)]
pub struct Projection {
    /// The image.
    pub px: Vector2<f64>,
    /// Derivative by the point in the camera frame, px per mm.
    pub by_point: Matrix2x3<f64>,
    /// Derivative by the lens parameters.
    pub by_lens: SMatrix<f64, 2, LENS_PARAMETERS>,
}

/// Projection from camera coordinates to raw pixels.
#[derive(Clone, Debug)]
pub struct Lens {
    /// The distortion model.
    pub model: LensModel,
    /// Focal length along rows.
    pub fx_px: f64,
    /// Focal length along columns.
    pub fy_px: f64,
    /// Principal point, column.
    pub cx_px: f64,
    /// Principal point, row.
    pub cy_px: f64,
    /// `brown`: k1 k2 p1 p2 k3. `fisheye`: k1 k2 k3 k4 and an unused 0.
    pub distortion: [f64; 5],
    /// Largest radius (brown) or angle (fisheye) up to which the model is monotonic.
    reach: f64,
}

impl Lens {
    /// A lens; `reach` is found by walking outward until the model folds back.
    pub fn new(
        model: LensModel,
        focal_px: [f64; 2],
        centre_px: [f64; 2],
        distortion: [f64; 5],
    ) -> Self {
        let [[fx_px, fy_px], [cx_px, cy_px]] = [focal_px, centre_px];
        let mut lens = Self { model, fx_px, fy_px, cx_px, cy_px, distortion, reach: f64::INFINITY };
        // A 179 degree lens has tan = 115; 8 is 166 degrees, beyond any brown lens.
        let end = match model {
            LensModel::Brown => 8.0,
            LensModel::Fisheye => std::f64::consts::PI,
        };
        let steps = 4000;
        lens.reach = (1..=steps)
            .map(|i| end * f64::from(i) / f64::from(steps))
            .find(|&r| lens.radial_slope(r) <= 0.0)
            .unwrap_or(end);
        lens
    }

    /// Derivative of the distorted radius by radius (brown) or angle (fisheye).
    fn radial_slope(&self, r: f64) -> f64 {
        let [k1, k2, a, b, k3] = self.distortion;
        let r2 = r * r;
        match self.model {
            LensModel::Brown => 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)),
            LensModel::Fisheye => {
                1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * (7.0 * a + r2 * 9.0 * b)))
            }
        }
    }

    /// Raw pixel of a point in the camera frame; `None` where the model does not hold.
    pub fn project(&self, in_camera: Vector3<f64>) -> Option<RawPx> {
        let distorted = match self.model {
            LensModel::Brown => {
                if in_camera.z <= 0.0 {
                    return None;
                }
                let p = Vector2::new(in_camera.x, in_camera.y) / in_camera.z;
                if p.norm() >= self.reach {
                    return None;
                }
                self.distort_brown(p).0
            }
            LensModel::Fisheye => {
                let radius = in_camera.x.hypot(in_camera.y);
                let theta = radius.atan2(in_camera.z);
                if theta >= self.reach {
                    return None;
                }
                let scale = if radius > 0.0 { self.distort_angle(theta) / radius } else { 0.0 };
                Vector2::new(in_camera.x, in_camera.y) * scale
            }
        };
        Some(RawPx {
            x: self.fx_px * distorted.x + self.cx_px,
            y: self.fy_px * distorted.y + self.cy_px,
        })
    }

    /// Direction (not normalised) in the camera frame of a raw pixel's ray.
    pub fn unproject(&self, px: RawPx) -> Option<Vector3<f64>> {
        let target =
            Vector2::new((px.x - self.cx_px) / self.fx_px, (px.y - self.cy_px) / self.fy_px);
        match self.model {
            LensModel::Brown => {
                let p = self.undistort_brown(target)?;
                Some(Vector3::new(p.x, p.y, 1.0))
            }
            LensModel::Fisheye => {
                let radius = target.norm();
                let theta = self.undistort_angle(radius)?;
                let across = if radius > 0.0 { target / radius * theta.sin() } else { target };
                Some(Vector3::new(across.x, across.y, theta.cos()))
            }
        }
    }

    /// All parameters in the order of [`LENS_PARAMETERS`].
    pub fn parameters(&self) -> [f64; LENS_PARAMETERS] {
        let [a, b, c, d, e] = self.distortion;
        [self.fx_px, self.fy_px, self.cx_px, self.cy_px, a, b, c, d, e]
    }

    /// A lens from all its parameters.
    pub fn from_parameters(model: LensModel, all: [f64; LENS_PARAMETERS]) -> Self {
        let [fx, fy, cx, cy, a, b, c, d, e] = all;
        Self::new(model, [fx, fy], [cx, cy], [a, b, c, d, e])
    }

    /// Image of a point with its derivatives, also where the model folds back: a calibration
    /// on its way may pass there. `None` behind a brown lens and right behind a fisheye.
    pub fn linearise(&self, in_camera: Vector3<f64>) -> Option<Projection> {
        let focal = Matrix2::new(self.fx_px, 0.0, 0.0, self.fy_px);
        let (distorted, by_point, by_distortion) = match self.model {
            LensModel::Brown => self.linearise_brown(in_camera)?,
            LensModel::Fisheye => self.linearise_fisheye(in_camera)?,
        };
        let mut by_lens = SMatrix::<f64, 2, LENS_PARAMETERS>::zeros();
        by_lens[(0, 0)] = distorted.x;
        by_lens[(1, 1)] = distorted.y;
        by_lens[(0, 2)] = 1.0;
        by_lens[(1, 3)] = 1.0;
        by_lens.fixed_view_mut::<2, 5>(0, 4).copy_from(&(focal * by_distortion));
        Some(Projection {
            px: focal * distorted + Vector2::new(self.cx_px, self.cy_px),
            by_point: focal * by_point,
            by_lens,
        })
    }

    fn linearise_brown(
        &self,
        at: Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>, SMatrix<f64, 2, 5>)> {
        if at.z <= 0.0 {
            return None;
        }
        let p = at.xy() / at.z;
        let (distorted, jacobian) = self.distort_brown(p);
        let division = Matrix2x3::new(1.0, 0.0, -p.x, 0.0, 1.0, -p.y) / at.z;
        let r2 = p.norm_squared();
        let (xy, xx, yy) = (2.0 * p.x * p.y, r2 + 2.0 * p.x * p.x, r2 + 2.0 * p.y * p.y);
        let columns =
            [p * r2, p * (r2 * r2), Vector2::new(xy, yy), Vector2::new(xx, xy), p * (r2 * r2 * r2)];
        Some((distorted, jacobian * division, SMatrix::from_columns(&columns)))
    }

    fn linearise_fisheye(
        &self,
        at: Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>, SMatrix<f64, 2, 5>)> {
        let (radius, square) = (at.xy().norm(), at.norm_squared());
        if radius <= 1e-9 * square.sqrt() {
            // On the axis there is no direction to bend in.
            let by_point = Matrix2x3::identity() / at.z;
            return (at.z > 0.0).then(|| (at.xy() / at.z, by_point, SMatrix::zeros()));
        }
        let theta = radius.atan2(at.z);
        let outward = at.xy() / radius;
        let bent = self.distort_angle(theta);
        let slope = self.radial_slope(theta);
        // Radially the angle changes, tangentially only the direction.
        let theta_by_radius = at.z / square;
        let across = Matrix2::identity() - outward * outward.transpose();
        let by_xy =
            outward * outward.transpose() * (slope * theta_by_radius) + across * (bent / radius);
        let by_z = outward * (-slope * radius / square);
        let by_point = Matrix2x3::new(by_xy.m11, by_xy.m12, by_z.x, by_xy.m21, by_xy.m22, by_z.y);
        let t2 = theta * theta;
        let powers = [theta * t2, theta * t2 * t2, theta * t2.powi(3), theta * t2.powi(4), 0.0];
        let by_distortion = SMatrix::from_columns(&powers.map(|power| outward * power));
        Some((outward * bent, by_point, by_distortion))
    }

    /// Distorted normalised point and its Jacobian.
    fn distort_brown(&self, p: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3); // d radial / d r2
        let distorted = Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = Matrix2::new(
            radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (distorted, jacobian)
    }

    /// Newton from the distorted point; five steps reach 1e-12 on real lenses.
    fn undistort_brown(&self, target: Vector2<f64>) -> Option<Vector2<f64>> {
        let mut p = target;
        for _ in 0..30 {
            let (distorted, jacobian) = self.distort_brown(p);
            let error = distorted - target;
            if error.norm() < 1e-12 {
                return (p.norm() < self.reach).then_some(p);
            }
            p -= jacobian.try_inverse()? * error;
        }
        None
    }

    fn distort_angle(&self, theta: f64) -> f64 {
        let [k1, k2, k3, k4, _] = self.distortion;
        let t2 = theta * theta;
        theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    }

    fn undistort_angle(&self, radius: f64) -> Option<f64> {
        let mut theta = radius.min(0.9 * self.reach);
        for _ in 0..50 {
            let error = self.distort_angle(theta) - radius;
            if error.abs() < 1e-13 {
                return Some(theta);
            }
            theta -= error / self.radial_slope(theta);
            if !(0.0..self.reach).contains(&theta) {
                return None;
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BROWN_OPENCV: [f64; 2] = [1_239.015_263_615, 399.803_498_292];
    const FISHEYE_OPENCV: [f64; 2] = [1_121.612_494_575, 492.065_941_123];

    fn lenses() -> [Lens; 2] {
        [
            Lens::new(
                LensModel::Brown,
                [1019.3, 1019.9],
                [940.2, 599.1],
                [-0.181, 0.080, 0.0005, -0.0004, -0.008],
            ),
            Lens::new(
                LensModel::Fisheye,
                [560.0, 561.0],
                [960.0, 600.0],
                [0.02, -0.006, 0.001, -0.0002, 0.0],
            ),
        ]
    }

    #[test]
    fn project_inverts_unproject_over_the_whole_image() {
        for lens in lenses() {
            for y in (0..1200).step_by(50) {
                for x in (0..1920).step_by(60) {
                    let px = RawPx { x: f64::from(x), y: f64::from(y) };
                    let ray = lens.unproject(px).expect("inside the model");
                    let back = lens.project(ray).expect("inside the model");
                    // Newton stops at 1e-12 of the focal length, 1e-9 px.
                    assert!(
                        (back.x - px.x).hypot(back.y - px.y) < 1e-8,
                        "{lens:?} {px:?} {back:?}"
                    );
                }
            }
        }
    }

    /// Values that `cv::projectPoints` 5.0 prints for the point (300, -200, 1000).
    #[test]
    fn brown_matches_opencv() {
        let [brown, _] = lenses();
        let px = brown.project(Vector3::new(300.0, -200.0, 1000.0)).expect("in front");
        assert!((px.x - BROWN_OPENCV[0]).hypot(px.y - BROWN_OPENCV[1]) < 1e-6, "{px:?}");
    }

    /// Values that `cv::fisheye::projectPoints` 5.0 prints for the same point.
    #[test]
    fn fisheye_matches_opencv() {
        let [_, fisheye] = lenses();
        let px = fisheye.project(Vector3::new(300.0, -200.0, 1000.0)).expect("in front");
        assert!((px.x - FISHEYE_OPENCV[0]).hypot(px.y - FISHEYE_OPENCV[1]) < 1e-6, "{px:?}");
    }

    #[test]
    fn derivatives_are_those_of_the_projection() {
        for lens in lenses() {
            let at = Vector3::new(0.3, -0.45, 0.9);
            let here = lens.linearise(at).expect("in front");
            let projected = lens.project(at).expect("in front");
            assert!((here.px - Vector2::new(projected.x, projected.y)).norm() < 1e-9);
            // Central differences: their error is of the order of the step's square.
            let step = 1e-6;
            for k in 0..3 {
                let moved = |sign: f64| {
                    let mut point = at;
                    point[k] += sign * step;
                    lens.linearise(point).expect("in front").px
                };
                let slope = (moved(1.0) - moved(-1.0)) / (2.0 * step);
                assert!((slope - here.by_point.column(k)).norm() < 1e-4, "{lens:?} point {k}");
            }
            for k in 0..LENS_PARAMETERS {
                let moved = |sign: f64| {
                    let mut all = lens.parameters();
                    all[k] += sign * step;
                    let lens = Lens::from_parameters(lens.model, all);
                    lens.linearise(at).expect("in front").px
                };
                let slope = (moved(1.0) - moved(-1.0)) / (2.0 * step);
                assert!((slope - here.by_lens.column(k)).norm() < 1e-4, "{lens:?} parameter {k}");
            }
        }
    }

    #[test]
    fn a_point_behind_the_camera_has_no_image() {
        let [brown, _] = lenses();
        assert_eq!(brown.project(Vector3::new(0.0, 0.0, -1.0)), None);
        assert_eq!(brown.project(Vector3::new(1.0, 0.0, 0.0)), None);
    }

    #[test]
    fn a_ray_beyond_the_fold_has_no_image() {
        let lens =
            Lens::new(LensModel::Brown, [500.0; 2], [320.0, 240.0], [-0.3, 0.0, 0.0, 0.0, 0.0]);
        // r (1 - 0.3 r^2) turns back at r = 1 / sqrt(0.9) = 1.054.
        assert!(lens.project(Vector3::new(1.0, 0.0, 1.0)).is_some());
        assert_eq!(lens.project(Vector3::new(1.1, 0.0, 1.0)), None);
    }
}
