//! The pose from surveyed points, when no board is at hand.

use super::homography::{homography, pose_of_plane, pose_of_points};
use super::least_squares::{Normal, Numeric, minimise};
use super::{Pose, camera_over_belt, reprojection_error};
use crate::camera::{CalibratedLens, Camera, Lens};
use crate::error::{Error, Result};
use crate::units::RawPx;
use nalgebra::{DVector, Matrix3, Vector3};

/// A point with known place on or above the belt, and where the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurveyedPoint {
    /// X along travel, Y to the left, Z up from the belt, mm.
    pub in_belt_mm: Vector3<f64>,
    /// Its image.
    pub at: RawPx,
}

/// A camera from surveyed points.
#[derive(Clone, Debug)]
pub struct PointsCalibration {
    /// Lens and pose; the origin is under the camera.
    pub camera: Camera,
    /// Where that origin is in the surveyor's coordinates, mm.
    pub origin_mm: [f64; 2],
    /// Root mean square distance of the points from where they should be, px.
    pub rms_px: f64,
    /// Distance of each point, px.
    pub error_px: Vec<f64>,
    /// Standard deviation of the camera's height above the belt.
    pub sigma_height_mm: f64,
    /// Standard deviation of the tilt of the belt plane (the larger of its two directions).
    pub sigma_tilt_deg: f64,
    /// Standard deviation of the direction of travel.
    pub sigma_travel_deg: f64,
    /// What the technician should know.
    pub warnings: Vec<String>,
}

/// Points on one plane, and in space, that determine a pose.
const COPLANAR_MIN: usize = 4;
const GENERAL_MIN: usize = 6;
/// Points are on one plane (or line) when their spread across it is this part of that along.
const FLAT: f64 = 0.01;
/// A point is wrong when the others agree this much better without it, and it matters (px).
const WITHOUT_RATIO: f64 = 0.3;
const DISAGREEMENT_PX: f64 = 1.0;
/// Points that disagree by more, as part of the image's width, are not a survey.
const DISAGREEMENT_MAX: f64 = 0.01;
/// A height less certain than this part of it is none.
const HEIGHT_SIGMA_MAX: f64 = 0.02;
/// A point is picked in an image no better than this.
const POINTING_PX: f64 = 0.3;
const STEPS_MAX: usize = 50;

/// The pose that fits the points best.
///
/// # Errors
/// Too few points, points on one line, points that no pose explains, or one that disagrees with
/// the others.
pub fn calibrate_points(
    calibrated: &CalibratedLens,
    points: &[SurveyedPoint],
) -> Result<PointsCalibration> {
    let CalibratedLens { image_size_px, lens, .. } = calibrated;
    check_pixels(*image_size_px, points)?;
    let (pose, normal) = fit(lens, points)?;
    let rms_px = (normal.cost / points.len() as f64).sqrt();
    if rms_px > DISAGREEMENT_PX {
        check_each(lens, points, rms_px)?;
    }
    let disagreement_max_px = DISAGREEMENT_MAX * image_size_px[0] as f64;
    if rms_px > disagreement_max_px {
        return Err(Error::configuration(format!("the points disagree by {rms_px:.1} px (rms)"))
            .allowed(format!("{disagreement_max_px:.0} px; a careful survey reaches 0.5"))
            .remedy("check places, pixels and signs (X along travel, Y left, Z up), and --lens"));
    }
    let camera = camera_over_belt(lens, *image_size_px, pose);
    let height_mm = camera.checked_height_mm()?;
    let centre = -(pose.rotation.transpose() * pose.translation_mm);
    let error_px = points
        .iter()
        .filter_map(|p| reprojection_error(lens, pose.apply(p.in_belt_mm), p.at))
        .map(|[x, y]| x.hypot(y))
        .collect();
    let freedom = (2.0 * points.len() as f64 - 6.0).max(1.0);
    // Few points can agree by chance: they are no better than a hand that points at pixels.
    let variance = (normal.cost / freedom).max(POINTING_PX * POINTING_PX);
    let covariance = normal.covariance().ok_or_else(no_pose)? * variance;
    let axes: [Vector3<f64>; 3] = std::array::from_fn(|k| pose.rotation.column(k).into_owned());
    let turn_deg = |axis: &Vector3<f64>| {
        let turns = covariance.fixed_view::<3, 3>(0, 0);
        (axis.transpose() * turns * axis)[0].max(0.0).sqrt().to_degrees()
    };
    // The camera's height is -(R Z) . t; a turn moves it through t.
    let up = axes[2];
    let lever = up.cross(&pose.translation_mm);
    let slopes = DVector::from_iterator(6, lever.iter().chain(up.iter()).copied());
    let of_points = (slopes.transpose() * &covariance * &slopes)[0].max(0.0).sqrt();
    let sigma_height_mm = of_points.hypot(calibrated.focal_sigma() * height_mm);
    if sigma_height_mm > HEIGHT_SIGMA_MAX * height_mm {
        return Err(Error::configuration(format!(
            "the points determine the height only to {sigma_height_mm:.0} mm"
        ))
        .allowed(format!("{:.0} mm", HEIGHT_SIGMA_MAX * height_mm))
        .remedy("survey more points, spread over the whole zone, along and across the belt"));
    }
    let mut warnings = Vec::new();
    if points.len() <= COPLANAR_MIN {
        warnings.push("so few points cannot check each other: survey more".to_owned());
    } else if rms_px > DISAGREEMENT_PX {
        warnings.push(format!(
            "the points disagree by {rms_px:.1} px: check places, pixels and that --lens is this camera's"
        ));
    }
    Ok(PointsCalibration {
        camera,
        origin_mm: [centre.x, centre.y],
        rms_px,
        error_px,
        sigma_height_mm,
        sigma_tilt_deg: turn_deg(&axes[0]).max(turn_deg(&axes[1])),
        sigma_travel_deg: turn_deg(&axes[2]),
        warnings,
    })
}

fn no_pose() -> Error {
    Error::configuration("no pose explains these points")
        .remedy("check their order, unit (mm, px) and signs: X along travel, Y left, Z up")
}

/// Pixels must be in the image: swapped columns are often not.
fn check_pixels([width, height]: [usize; 2], points: &[SurveyedPoint]) -> Result<()> {
    let inside =
        |at: RawPx| (-0.5..width as f64).contains(&at.x) && (-0.5..height as f64).contains(&at.y);
    match points.iter().position(|p| !inside(p.at)) {
        None => Ok(()),
        Some(k) => Err(Error::configuration(format!(
            "point {} is at pixel ({}, {}), outside the image",
            k + 1,
            points[k].at.x,
            points[k].at.y
        ))
        .allowed(format!("u below {width}, v below {height}"))
        .remedy("give X, Y, Z in mm, then u (column) and v (row) in px")),
    }
}

/// Closed forms, then least squares in the image from each: the best.
fn fit(lens: &Lens, points: &[SurveyedPoint]) -> Result<(Pose, Normal)> {
    let errors_from = |start: Pose| {
        move |x: &DVector<f64>| {
            let pose = start.stepped(x);
            let each: Option<Vec<[f64; 2]>> = points
                .iter()
                .map(|p| reprojection_error(lens, pose.apply(p.in_belt_mm), p.at))
                .collect();
            Some(each?.concat())
        }
    };
    initial(lens, points)?
        .into_iter()
        .filter_map(|start| {
            let numeric = Numeric { parameters: DVector::zeros(6), errors: errors_from(start) };
            let (fitted, normal) = minimise(numeric, STEPS_MAX)?;
            Some((start.stepped(&fitted.parameters), normal))
        })
        .min_by(|a, b| a.1.cost.total_cmp(&b.1.cost))
        .ok_or_else(no_pose)
}

/// Name the point without which the others agree.
fn check_each(lens: &Lens, points: &[SurveyedPoint], rms_px: f64) -> Result<()> {
    let without = |k: usize| {
        let mut others = points.to_vec();
        others.remove(k);
        let (_, normal) = fit(lens, &others).ok()?;
        // One degree of freedom less, or none: then agreement says nothing.
        (2 * others.len() > 6 + 2).then(|| (normal.cost / others.len() as f64).sqrt())
    };
    let best = (0..points.len())
        .filter_map(|k| Some((k, without(k)?)))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .filter(|(_, rms)| *rms < WITHOUT_RATIO * rms_px);
    match best {
        Some((k, rms)) => Err(Error::configuration(format!(
            "point {} disagrees with the others: without it their error falls from {rms_px:.2} to {rms:.2} px",
            k + 1
        ))
        .remedy("check its X, Y, Z and its pixel, or leave it out")),
        None => Ok(()),
    }
}

/// Starts: the points taken as on their main plane, and the direct linear transform, which
/// needs them well off it.
fn initial(lens: &Lens, points: &[SurveyedPoint]) -> Result<Vec<Pose>> {
    let count = points.len();
    let places: Vec<Vector3<f64>> = points.iter().map(|p| p.in_belt_mm).collect();
    let centre = places.iter().sum::<Vector3<f64>>() / count.max(1) as f64;
    let moments: Matrix3<f64> =
        places.iter().map(|p| (p - centre) * (p - centre).transpose()).sum();
    let eigen = moments.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let [long, middle, short] = order.map(|k| eigen.eigenvalues[k].max(0.0).sqrt());
    let allowed = format!("{COPLANAR_MIN} points on one plane, or {GENERAL_MIN} in space");
    if count >= 2 && middle <= FLAT * long {
        return Err(Error::configuration(format!("{count} points on one line"))
            .allowed(allowed)
            .remedy("survey points spread over the whole zone, along and across the belt"));
    }
    let coplanar = short <= FLAT * middle;
    let needed = if coplanar { COPLANAR_MIN } else { GENERAL_MIN };
    if count < needed {
        let kind = if coplanar { "on one plane" } else { "in space" };
        return Err(Error::configuration(format!("{count} points {kind}"))
            .allowed(allowed)
            .remedy("survey more points, spread over the whole zone"));
    }
    let rays: Option<Vec<Vector3<f64>>> = points.iter().map(|p| lens.unproject(p.at)).collect();
    let rays = rays.ok_or_else(|| {
        Error::configuration("a point lies where the lens model does not hold")
            .remedy("check u and v against the image, and that --lens belongs to this camera")
    })?;
    // The plane need not be the belt.
    let axes = order.map(|k| eigen.eigenvectors.column(k).into_owned());
    let third = axes[0].cross(&axes[1]);
    let plane_from_belt = Matrix3::from_columns(&[axes[0], axes[1], third]).transpose();
    let plane: Vec<_> = places.iter().map(|p| (plane_from_belt * (p - centre)).xy()).collect();
    let flat = homography(&plane, &rays).and_then(|h| pose_of_plane(&h)).map(|pose| {
        let rotation = pose.rotation * plane_from_belt;
        Pose { rotation, translation_mm: pose.translation_mm - rotation * centre }
    });
    let general = if coplanar { None } else { pose_of_points(&places, &rays) };
    Ok(flat.into_iter().chain(general).collect())
}
