//! What is wrong with a calibration, in plain words, and what to photograph next.

use super::lens::{Fitted, LensCalibration, LensStart};
use crate::camera::chessboard::{BoardImage, Chessboard, median};
use crate::error::{Error, Result};
use crate::units::RawPx;
use nalgebra::Vector3;

/// Fewer views leave the lens uncertain.
const VIEWS_WANTED: usize = 8;
/// Boards tilted against each other by less than this show the same thing: refused, warned.
const TILT_DEG_MIN: f64 = 4.0;
const TILT_DEG_WANTED: f64 = 20.0;
/// Relative standard deviation of the focal length: refused, warned. Heights inherit it.
const FOCAL_SIGMA_MAX: f64 = 0.02;
const FOCAL_SIGMA_WANTED: f64 = 0.002;
/// fy / fx of a camera with square pixels differs from 1 by less: refused, warned.
const ASPECT_MAX: f64 = 0.1;
const ASPECT_WANTED: f64 = 0.01;
/// The principal point is near the centre, as part of the image's side.
const CENTRE_WANTED: f64 = 0.1;
/// Part of the longer side: 1 px of the reference camera's 1920. Heights inherit angles, and sharp
/// images of a flat board reach a tenth of this.
const RMS_WANTED: f64 = 1.0 / 1920.0;
/// A data sheet is right to this part.
const DATA_SHEET: f64 = 0.1;
/// Scale of the hyperbolic tangent to the length of the ramp that motion makes: both have the
/// same standard deviation, pi / sqrt(12) b and L / sqrt(12).
const SMEAR_PER_BLUR: f64 = std::f64::consts::PI;

const TILT_REMEDY: &str = "photograph the board tilted by 30 to 45 degrees to the left, the right, \
                           towards the camera and away from it";

pub(super) fn too_few_views(kept: usize, views_min: usize) -> Error {
    Error::configuration(format!("{kept} usable views of the board"))
        .allowed(format!("at least {views_min}; 10 to 20 are good"))
        .remedy("photograph the whole board, sharp, in different places and tilted to all sides")
}

pub(super) fn undetermined() -> Error {
    Error::configuration("the views do not determine the lens: they are all alike")
        .remedy(TILT_REMEDY)
}

/// For each image why it is of no use: a copy of an earlier one, or blurred, as long as
/// `views_min` others remain.
pub(super) fn unusable(
    images: &[BoardImage],
    smear_px_max: f64,
    views_min: usize,
) -> Vec<Option<String>> {
    let smear_px = |image: &BoardImage| {
        let [a, b] = image.blur_px;
        SMEAR_PER_BLUR * (a * a - b * b).abs().sqrt()
    };
    let mut reasons: Vec<Option<String>> = images
        .iter()
        .map(|image| {
            let smear = smear_px(image);
            (smear > smear_px_max).then(|| {
                format!(
                    "smeared over {smear:.0} px by motion: hold board and camera still, or light more"
                )
            })
        })
        .collect();
    if reasons.iter().filter(|r| r.is_none()).count() < views_min {
        reasons.fill(None);
    }
    for (v, reason) in reasons.iter_mut().enumerate() {
        // Noise makes two photographs differ; a copy would only pretend to know more.
        if let Some(first) = (0..v).find(|&first| images[first].corners == images[v].corners) {
            *reason = Some(format!("a copy of view {}", first + 1));
        }
    }
    reasons
}

/// The view with the largest error, when it does not belong to the others, and why.
pub(super) fn worst_view(fitted: &Fitted, ratio: f64, rms_px_min: f64) -> Option<(usize, String)> {
    let rms = &fitted.view_rms_px;
    let worst = (0..rms.len()).max_by(|&a, &b| rms[a].total_cmp(&rms[b]))?;
    is_bad(rms, rms[worst], ratio, rms_px_min).then(|| (worst, does_not_belong(fitted, worst)))
}

/// Whether a view of such an error does not belong to the others.
pub(super) fn is_bad(all_px: &[f64], rms_px: f64, ratio: f64, rms_px_min: f64) -> bool {
    rms_px > (ratio * median(all_px.to_vec())).max(rms_px_min)
}

/// Of which kind there are more is the camera's way only if the technician says so.
pub(super) fn turned_warning(is_turned: &[bool]) -> Option<String> {
    let numbers: Vec<String> =
        (1..).zip(is_turned).filter(|(_, t)| **t).map(|(n, _): (usize, _)| n.to_string()).collect();
    (!numbers.is_empty()).then(|| {
        format!(
            "{} images are turned by 180 degrees against the others and were turned back: view {}. If the \
             camera delivers these and not the others, the principal point is mirrored: use images as it delivers \
             them, all of one mounting",
            numbers.len(),
            numbers.join(", ")
        )
    })
}

fn does_not_belong(fitted: &Fitted, view: usize) -> String {
    let rms = &fitted.view_rms_px;
    format!(
        "error of {:.2} px where the others have {:.2} px: moved, blurred, or not this board",
        rms[view],
        median(rms.clone())
    )
}

/// Refuse what cannot be, and add warnings about what is doubtful.
pub(super) fn check(
    board: &Chessboard,
    image_size_px: [usize; 2],
    images: &[BoardImage],
    kept: &[usize],
    start: LensStart,
    calibration: &mut LensCalibration,
) -> Result<()> {
    let mut warnings = Vec::new();
    check_views(images, kept, calibration, &mut warnings)?;
    check_lens(image_size_px, start, calibration, &mut warnings)?;
    check_coverage(image_size_px, images, kept, calibration, &mut warnings)?;
    check_rms(image_size_px, calibration, &mut warnings);
    check_board(board, calibration, &mut warnings);
    calibration.warnings = warnings;
    Ok(())
}

fn check_views(
    images: &[BoardImage],
    kept: &[usize],
    calibration: &LensCalibration,
    warnings: &mut Vec<String>,
) -> Result<()> {
    if 2 * kept.len() < images.len() {
        let reasons: Vec<String> = calibration
            .views
            .iter()
            .enumerate()
            .filter_map(|(v, view)| Some(format!("view {}: {}", v + 1, view.rejected.as_ref()?)))
            .collect();
        return Err(Error::configuration(format!(
            "{} of {} views are of no use: {}",
            reasons.len(),
            images.len(),
            reasons.join("; ")
        ))
        .remedy(
            "use images of one board from one camera with one focus and zoom; \
             keep the board flat and still",
        ));
    }
    if kept.len() < VIEWS_WANTED {
        warnings.push(format!(
            "only {} views: photograph the board 10 to 20 times, in all parts of the image",
            kept.len()
        ));
    }
    let normals: Vec<Vector3<f64>> = kept
        .iter()
        .filter_map(|&v| Some(calibration.views[v].pose?.rotation.column(2).into_owned()))
        .collect();
    let tilt_deg = normals
        .iter()
        .flat_map(|a| normals.iter().map(|b| a.angle(b).to_degrees()))
        .fold(0.0, f64::max);
    if tilt_deg < TILT_DEG_MIN {
        return Err(Error::configuration(format!(
            "the views are all alike: their boards are tilted by only {tilt_deg:.1} degrees to each other"
        ))
        .allowed(format!("{TILT_DEG_WANTED} degrees or more"))
        .remedy(TILT_REMEDY));
    }
    if tilt_deg < TILT_DEG_WANTED {
        warnings.push(format!(
            "the boards are tilted by only {tilt_deg:.0} degrees to each other: {TILT_REMEDY}"
        ));
    }
    Ok(())
}

fn check_lens(
    image_size_px: [usize; 2],
    start: LensStart,
    calibration: &LensCalibration,
    warnings: &mut Vec<String>,
) -> Result<()> {
    let lens = &calibration.lens;
    let sigma = calibration.sigma[0].max(calibration.sigma[1]) / lens.fx_px;
    if sigma.is_nan() || sigma >= FOCAL_SIGMA_MAX {
        return Err(Error::configuration(format!(
            "the views determine the focal length only to {:.1} %",
            100.0 * sigma
        ))
        .allowed(format!(
            "{} %; below {} % is good",
            100.0 * FOCAL_SIGMA_MAX,
            100.0 * FOCAL_SIGMA_WANTED
        ))
        .remedy(TILT_REMEDY));
    }
    if sigma > FOCAL_SIGMA_WANTED {
        warnings.push(format!(
            "the focal length is known only to {:.2} %, and heights to no better: {TILT_REMEDY}",
            100.0 * sigma
        ));
    }
    let aspect = lens.fy_px / lens.fx_px;
    if lens.fx_px <= 0.0 || lens.fy_px <= 0.0 {
        return Err(undetermined());
    }
    if (aspect - 1.0).abs() >= ASPECT_MAX {
        return Err(Error::configuration(format!("fy / fx = {aspect:.3}: no camera is like that"))
            .allowed(format!("{} to {}", 1.0 - ASPECT_MAX, 1.0 + ASPECT_MAX))
            .remedy(
                "use the images as the camera delivers them, not stretched, cropped or of several \
                 cameras; check that the squares are square; tilt the board to all sides",
            ));
    }
    if (aspect - 1.0).abs() > ASPECT_WANTED {
        warnings.push(format!(
            "fy / fx = {aspect:.4}: the images seem stretched, or the views do not determine the lens"
        ));
    }
    let [width, height] = image_size_px.map(|s| s as f64);
    let off = [lens.cx_px / width - 0.5, lens.cy_px / height - 0.5].map(f64::abs);
    if off[0].max(off[1]) >= 0.5 {
        return Err(Error::configuration(format!(
            "the optical axis would meet the image at ({:.0}, {:.0}), outside it",
            lens.cx_px, lens.cy_px
        ))
        .remedy(TILT_REMEDY));
    }
    if off[0].max(off[1]) > CENTRE_WANTED {
        warnings.push(format!(
            "the principal point ({:.0}, {:.0}) is far from the image centre: \
             the images seem cropped, or the views do not determine it",
            lens.cx_px, lens.cy_px
        ));
    }
    if let LensStart::FocalPx(focal) = start
        && (lens.fx_px / focal - 1.0).abs() > DATA_SHEET
    {
        warnings.push(format!(
            "the focal length found, {:.0} px, is not the data sheet's {focal:.0} px",
            lens.fx_px
        ));
    }
    Ok(())
}

/// Ninths of the image, by row.
const REGIONS: [&str; 9] = [
    "top left",
    "top",
    "top right",
    "left",
    "centre",
    "right",
    "bottom left",
    "bottom",
    "bottom right",
];

fn check_coverage(
    image_size_px: [usize; 2],
    images: &[BoardImage],
    kept: &[usize],
    calibration: &LensCalibration,
    warnings: &mut Vec<String>,
) -> Result<()> {
    let [width, height] = image_size_px.map(|s| s as f64);
    let corners = || kept.iter().flat_map(|&v| images[v].corners.iter().map(|c| c.at));
    let third = |value: f64, side: f64| ((3.0 * value / side) as usize).min(2);
    let empty: Vec<&str> = (0..9)
        .filter(|&k| !corners().any(|p| 3 * third(p.y, height) + third(p.x, width) == k))
        .map(|k| REGIONS[k])
        .collect();
    if !empty.is_empty() {
        warnings.push(format!(
            "no corners in the {} of the image: photograph the board there",
            empty.join(", ")
        ));
    }
    let lens = &calibration.lens;
    let radius = |p: RawPx| (p.x - lens.cx_px).hypot(p.y - lens.cy_px);
    let seen = corners().map(radius).fold(0.0, f64::max);
    let border = (0..=40).flat_map(|k| {
        let part = f64::from(k) / 40.0;
        let (x, y) = (part * (width - 1.0), part * (height - 1.0));
        [[x, 0.0], [x, height - 1.0], [0.0, y], [width - 1.0, y]].map(|[x, y]| RawPx { x, y })
    });
    let folded = border.filter(|&p| lens.unproject(p).is_none()).map(radius);
    let fold = folded.fold(f64::INFINITY, f64::min);
    if fold.is_finite() {
        let what =
            format!("the distortion folds back inside the image, {fold:.0} px from its centre");
        // Between the outermost corner and the border nothing was seen.
        if corners().any(|p| lens.unproject(p).is_none()) {
            return Err(Error::configuration(format!("{what}, where the board was seen")).remedy(
                "check the model (--model fisheye for very wide lenses) and the board's size",
            ));
        }
        warnings.push(format!(
            "{what}, where no board was seen (only up to {seen:.0} px): photograph it in the corners \
             of the image"
        ));
    }
    Ok(())
}

/// The error against what the image's resolution makes of it.
fn check_rms(
    [width, height]: [usize; 2],
    calibration: &LensCalibration,
    warnings: &mut Vec<String>,
) {
    let wanted_px = RMS_WANTED * width.max(height) as f64;
    if calibration.rms_px > wanted_px {
        warnings.push(format!(
            "the corners are off by {:.2} px (rms), too much for images of {width} x {height} px (below \
             {wanted_px:.2}; sharp ones of a flat board reach 0.1): check that it is flat, the focus \
             fixed, the model right, and that all images are of one camera, none scaled or turned",
            calibration.rms_px
        ));
    }
}

fn check_board(board: &Chessboard, calibration: &LensCalibration, warnings: &mut Vec<String>) {
    let outliers: usize = calibration.views.iter().map(|v| v.outliers).sum();
    if outliers > 0 {
        warnings.push(format!(
            "{outliers} corners were left out: they are far from where they should be"
        ));
    }
    let bends = || calibration.shape_mm.iter().map(|s| s.z);
    let bend_mm = bends().fold(f64::MIN, f64::max) - bends().fold(f64::MAX, f64::min);
    if bend_mm > 0.0 {
        warnings.push(format!(
            "the board is not flat: over its {} squares it bends by {bend_mm:.1} mm. Its shape \
             was estimated too; a board on glass or aluminium is better",
            board.in_order([board.columns + 1, board.rows + 1])
        ));
    }
}
