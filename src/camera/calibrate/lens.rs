//! A lens from views of a chessboard: Zhang's closed form, then everything jointly.

use super::Pose;
use super::bundle::{Bundle, Observation, View, board_pose};
use super::homography::{homography, zhang};
use super::least_squares::{Normal, minimise};
use super::turned::{turned_back, turned_views};
use super::verdict;
use crate::camera::chessboard::{BoardImage, Chessboard, Corner};
use crate::camera::{LENS_PARAMETERS, Lens, LensModel};
use crate::error::{Error, Result};
use nalgebra::{Vector2, Vector3};

/// What the fit starts from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LensStart {
    /// Zhang's closed form, and a range of focal lengths.
    Unknown,
    /// The data sheet's focal length, px; the principal point is the centre.
    FocalPx(f64),
}

/// Whether the board is taken as flat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BoardShape {
    /// Its corners are where they should be.
    Flat,
    /// Its shape is estimated too where the views show that it is not flat.
    Estimated,
}

/// One view's part in a calibration.
#[derive(Clone, Debug)]
pub struct ViewResult {
    /// Where the board was; of a rejected view by the closed form, `None` when that has none.
    pub pose: Option<Pose>,
    /// Root mean square distance of its corners from where they should be, px.
    pub rms_px: Option<f64>,
    /// Why it is not part of the result.
    pub rejected: Option<String>,
    /// It was turned by 180 degrees against the others, and is told of as turned back.
    pub is_turned: bool,
    /// Each corner and its error (seen minus expected), px; outliers included.
    pub residuals: Vec<(Corner, Vector2<f64>)>,
    /// Corners left out because they do not belong.
    pub outliers: usize,
}

/// A calibrated lens.
#[derive(Clone, Debug)]
pub struct LensCalibration {
    /// The result.
    pub lens: Lens,
    /// Standard deviations of its parameters, in the order of [`Lens::parameters`].
    pub sigma: [f64; LENS_PARAMETERS],
    /// Root mean square distance over all corners of all views kept, px.
    pub rms_px: f64,
    /// In the order of the views given.
    pub views: Vec<ViewResult>,
    /// How far each corner is from its place on a flat board, by row and column, mm; empty when
    /// the board was taken as flat.
    pub shape_mm: Vec<Vector3<f64>>,
    /// What the technician should know, in plain words.
    pub warnings: Vec<String>,
}

/// Fewer views cannot be told from a coincidence.
const VIEWS_MIN: usize = 3;
/// A corner further off than this many standard deviations, and this many px, is none.
const OUTLIER_SIGMAS: f64 = 8.0;
const OUTLIER_PX: f64 = 1.0;
/// A view with this many times the error of the middle view does not belong.
const VIEW_RATIO: f64 = 3.0;
/// Views as good as this are not worth the loss of their coverage.
const VIEW_RMS_PX: f64 = 0.5;
/// Edges smeared over more px in one direction than in the other: the board moved, and with a
/// rolling shutter its shape has changed.
const SMEAR_PX_MAX: f64 = 8.0;
/// The shape is estimated when it takes away this part of the error...
const SHAPE_GAIN: f64 = 0.25;
/// ...and there are enough views to tell shape from lens.
const SHAPE_VIEWS_MIN: usize = 6;
/// ...and so few corners that it takes seconds: each adds three parameters.
const SHAPE_CORNERS_MAX: usize = 200;
const STEPS_MAX: usize = 60;

/// Calibrate from what was found in each image.
///
/// # Errors
/// Fewer than three views, views that do not determine a lens, or a lens that cannot be.
pub fn calibrate_lens(
    board: &Chessboard,
    image_size_px: [usize; 2],
    images: &[BoardImage],
    model: LensModel,
    start: LensStart,
    shape: BoardShape,
) -> Result<LensCalibration> {
    let settle = |look| settle(board, image_size_px, images, model, start, shape, look);
    let mut settled = settle(LookForTurned::Yes)?;
    // Of another camera, or of no one lens at all, a view does not fit turned back either.
    if settled.is_turned.iter().zip(&settled.rejected).any(|(turned, why)| *turned && why.is_some())
    {
        settled = settle(LookForTurned::No)?;
    }
    let mut calibration = summarise(board, &settled)?;
    let Settled { seen, kept, is_turned, .. } = settled;
    verdict::check(board, image_size_px, &seen, &kept, start, &mut calibration)?;
    calibration.warnings.extend(verdict::turned_warning(&is_turned));
    Ok(calibration)
}

/// Whether views may have been turned by 180 degrees.
#[derive(Clone, Copy, PartialEq, Eq)]
enum LookForTurned {
    Yes,
    No,
}

/// A fit of what belongs together.
struct Settled {
    fitted: Fitted,
    /// What was seen in each view, turned back where it was turned.
    seen: Vec<BoardImage>,
    /// Which were.
    is_turned: Vec<bool>,
    /// Numbers of the views fitted.
    kept: Vec<usize>,
    /// Why others are not.
    rejected: Vec<Option<String>>,
}

/// Fit, reject the view that belongs least, and again, until all belong.
fn settle(
    board: &Chessboard,
    image_size_px: [usize; 2],
    images: &[BoardImage],
    model: LensModel,
    start: LensStart,
    shape: BoardShape,
    look: LookForTurned,
) -> Result<Settled> {
    let mut rejected = verdict::unusable(images, SMEAR_PX_MAX, VIEWS_MIN);
    let (mut seen, mut is_turned) = (images.to_vec(), vec![false; images.len()]);
    let mut found: Option<(Lens, Vec<Pose>)> = None;
    let mut look = look;
    loop {
        let kept: Vec<usize> = (0..images.len()).filter(|&v| rejected[v].is_none()).collect();
        if kept.len() < VIEWS_MIN {
            return Err(verdict::too_few_views(kept.len(), VIEWS_MIN));
        }
        let views: Vec<View> = kept.iter().map(|&v| View::all_of(&seen[v])).collect();
        let first = match found.take() {
            Some(found) => found,
            None => initial(board, image_size_px, &views, model, start)?,
        };
        let mut fitted = fit(board, views, first, shape)?;
        if std::mem::replace(&mut look, LookForTurned::No) == LookForTurned::Yes {
            let fitted_images: Vec<BoardImage> = kept.iter().map(|&v| seen[v].clone()).collect();
            let refit = |images: &[BoardImage], lens: &Lens| {
                let poses: Option<Vec<Pose>> =
                    images.iter().map(|i| board_pose(board, lens, &i.corners)).collect();
                let views = images.iter().map(View::all_of).collect();
                fit(board, views, (lens.clone(), poses?), shape).ok()
            };
            let turned = turned_views(board, image_size_px, &fitted_images, &fitted, &refit);
            let turned = turned.unwrap_or_default();
            for (&v, _) in kept.iter().zip(&turned).filter(|(_, turned)| **turned) {
                seen[v] = turned_back(board, image_size_px, &seen[v]);
                is_turned[v] = true;
            }
            if turned.contains(&true) {
                continue;
            }
        }
        let worst = verdict::worst_view(&fitted, VIEW_RATIO, VIEW_RMS_PX);
        match worst.filter(|_| kept.len() > VIEWS_MIN) {
            None => return Ok(Settled { fitted, seen, is_turned, kept, rejected }),
            Some((worst, reason)) => {
                rejected[kept[worst]] = Some(reason);
                fitted.poses.remove(worst);
                found = Some((fitted.lens, fitted.poses));
            }
        }
    }
}

impl View {
    fn all_of(image: &BoardImage) -> Self {
        let observation = |&corner| Observation { corner, is_outlier: false };
        Self { observations: image.corners.iter().map(observation).collect() }
    }
}

/// What a fit leaves behind.
pub(super) struct Fitted {
    pub(super) lens: Lens,
    pub(super) poses: Vec<Pose>,
    pub(super) shape_mm: Vec<Vector3<f64>>,
    pub(super) views: Vec<View>,
    pub(super) rms_px: f64,
    /// Of the robust fit.
    pub(super) view_rms_px: Vec<f64>,
    normal: Normal,
}

/// The best of several starts: closed form and focal lengths, each with the poses it implies.
fn initial(
    board: &Chessboard,
    image_size_px: [usize; 2],
    views: &[View],
    model: LensModel,
    start: LensStart,
) -> Result<(Lens, Vec<Pose>)> {
    let [width, height] = image_size_px.map(|s| s as f64);
    let centre = [0.5 * (width - 1.0), 0.5 * (height - 1.0)];
    let plain = |focal: [f64; 2], centre| Lens::new(model, focal, centre, [0.0; 5]);
    let candidates = match start {
        LensStart::FocalPx(focal) => vec![plain([focal; 2], centre)],
        LensStart::Unknown => {
            // From the widest lenses to a long telephoto lens, in steps of a sixth.
            let focal = |k: i32| width.max(height) * 0.2 * 1.17_f64.powi(k);
            let mut lenses: Vec<Lens> = (0..20).map(|k| plain([focal(k); 2], centre)).collect();
            if model == LensModel::Brown {
                lenses.extend(
                    closed_form(board, views, width, centre)
                        .map(|[fx, fy, cx, cy]| plain([fx, fy], [cx, cy])),
                );
            }
            lenses
        }
    };
    let mut best: Option<(f64, Lens, Vec<Pose>)> = None;
    for lens in candidates {
        let corners =
            |view: &View| view.observations.iter().map(|o| o.corner).collect::<Vec<Corner>>();
        let poses: Option<Vec<Pose>> =
            views.iter().map(|v| board_pose(board, &lens, &corners(v))).collect();
        let Some(poses) = poses else { continue };
        // A few robust steps tell which start leads down.
        let robust_px = 0.01 * width;
        let bundle = Bundle { board, views, lens, poses, shape_mm: Vec::new(), robust_px };
        let Some((bundle, normal)) = minimise(bundle, 5) else { continue };
        if best.as_ref().is_none_or(|(cost, ..)| normal.cost < *cost) {
            best = Some((normal.cost, bundle.lens, bundle.poses));
        }
    }
    let (_, lens, poses) = best.ok_or_else(|| {
        let data_sheet = match start {
            LensStart::Unknown => "give --focal-mm and --sensor-width-mm from the data sheet",
            LensStart::FocalPx(_) => "check --focal-mm and --sensor-width-mm, or leave them out",
        };
        Error::failure("no lens explains these views").remedy(format!(
            "check the board's size, and that all images are of one camera with one focus; {data_sheet}"
        ))
    })?;
    Ok((lens, poses))
}

fn closed_form(
    board: &Chessboard,
    views: &[View],
    width: f64,
    centre: [f64; 2],
) -> Option<[f64; 4]> {
    // Pixels from the image centre in units of its width.
    let homographies: Option<Vec<_>> = views
        .iter()
        .map(|view| {
            let (plane, rays): (Vec<_>, Vec<_>) = view
                .observations
                .iter()
                .map(|Observation { corner, .. }| {
                    let at = Vector3::new(corner.at.x - centre[0], corner.at.y - centre[1], width);
                    (board.place_mm(corner), at / width)
                })
                .unzip();
            homography(&plane, &rays)
        })
        .collect();
    let [fx, fy, cx, cy] = zhang(&homographies?)?;
    Some([fx * width, fy * width, cx * width + centre[0], cy * width + centre[1]])
}

/// Fit robustly, find the outliers, decide on the board's shape, fit plainly.
fn fit(
    board: &Chessboard,
    mut views: Vec<View>,
    (lens, poses): (Lens, Vec<Pose>),
    shape: BoardShape,
) -> Result<Fitted> {
    let diverged = || {
        Error::failure("the calibration does not converge").remedy(
            "photograph 10 to 20 views, tilted by 30 to 45 degrees to all sides, all over the image",
        )
    };
    let robust = |views: &[View], lens: Lens, poses: Vec<Pose>, shape_mm, robust_px| {
        let bundle = Bundle { board, views, lens, poses, shape_mm, robust_px };
        let (bundle, _) = minimise(bundle, STEPS_MAX)?;
        let sigma_px = sigma_px(&bundle);
        Some((bundle.lens, bundle.poses, bundle.shape_mm, sigma_px))
    };
    // The scale of the errors is not known yet: two passes find it.
    let (lens, poses, _, sigma) =
        robust(&views, lens, poses, Vec::new(), 1.0).ok_or_else(diverged)?;
    let (mut lens, mut poses, mut shape_mm, mut sigma) =
        robust(&views, lens, poses, Vec::new(), 2.0 * sigma).ok_or_else(diverged)?;
    if shape == BoardShape::Estimated
        && views.len() >= SHAPE_VIEWS_MIN
        && board.corner_count() <= SHAPE_CORNERS_MAX
    {
        let start = vec![Vector3::zeros(); board.corner_count()];
        let shaped = robust(&views, lens.clone(), poses.clone(), start, 2.0 * sigma);
        if let Some(shaped) = shaped.filter(|s| s.3 < (1.0 - SHAPE_GAIN) * sigma) {
            (lens, poses, shape_mm, sigma) = shaped;
        }
    }
    let limit_px = (OUTLIER_SIGMAS * sigma).max(OUTLIER_PX);
    let bundle = Bundle { board, views: &views, lens, poses, shape_mm, robust_px: f64::INFINITY };
    let is_outlier = |v: usize, o: &Observation| {
        bundle.residual(v, &o.corner).is_none_or(|r| r.norm() > limit_px)
    };
    let marks: Vec<Vec<bool>> = (0..views.len())
        .map(|v| views[v].observations.iter().map(|o| is_outlier(v, o)).collect())
        .collect();
    let Bundle { lens, poses, shape_mm, .. } = bundle;
    for (view, marks) in views.iter_mut().zip(marks) {
        // A view that does not fit at all is rejected as a whole, not corner by corner.
        let few = 4 * marks.iter().filter(|&&m| m).count() <= marks.len();
        for (observation, mark) in view.observations.iter_mut().zip(marks) {
            observation.is_outlier = mark && few;
        }
    }
    let bundle = Bundle { board, views: &views, lens, poses, shape_mm, robust_px: f64::INFINITY };
    // Before a view that does not belong can bend the plain fit to itself.
    let view_rms_px = (0..views.len()).map(|v| bundle.view_rms_px(v)).collect();
    let (bundle, normal) = minimise(bundle, STEPS_MAX).ok_or_else(diverged)?;
    let rms_px = rms_px(&bundle);
    let Bundle { lens, poses, shape_mm, .. } = bundle;
    Ok(Fitted { lens, poses, shape_mm, views, rms_px, view_rms_px, normal })
}

/// Robust standard deviation of the corners' distances: that of most, whatever the rest does.
fn sigma_px(bundle: &Bundle<'_>) -> f64 {
    let mut distances: Vec<f64> = residuals(bundle).map(|r| r.norm()).collect();
    distances.sort_by(f64::total_cmp);
    // The median of a Rayleigh distribution is 1.177 sigma.
    distances.get(distances.len() / 2).map_or(0.0, |d| d / 1.177)
}

fn rms_px(bundle: &Bundle<'_>) -> f64 {
    let (sum, count) =
        residuals(bundle).fold((0.0, 0.0), |(s, n), r| (s + r.norm_squared(), n + 1.0));
    (sum / f64::max(count, 1.0)).sqrt()
}

/// Of all observations but the outliers.
fn residuals<'a>(bundle: &'a Bundle<'_>) -> impl Iterator<Item = Vector2<f64>> + 'a {
    bundle.views.iter().enumerate().flat_map(move |(v, view)| {
        view.observations
            .iter()
            .filter(|o| !o.is_outlier)
            .filter_map(move |o| bundle.residual(v, &o.corner))
    })
}

fn summarise(board: &Chessboard, settled: &Settled) -> Result<LensCalibration> {
    let Settled { fitted, seen, is_turned, kept, rejected } = settled;
    let covariance = fitted.normal.covariance().ok_or_else(verdict::undetermined)?;
    let observations: usize =
        fitted.views.iter().map(|v| v.observations.iter().filter(|o| !o.is_outlier).count()).sum();
    let freedom = 2.0 * observations as f64 - fitted.normal.gradient.len() as f64;
    let variance = fitted.rms_px.powi(2) * observations as f64 / freedom.max(1.0);
    let sigma = std::array::from_fn(|k| (variance * covariance[(k, k)]).sqrt());
    let views = seen
        .iter()
        .enumerate()
        .map(|(v, image)| {
            let place = kept.iter().position(|&k| k == v);
            let pose = place
                .map(|p| fitted.poses[p])
                .or_else(|| board_pose(board, &fitted.lens, &image.corners));
            let view = [place.map_or_else(|| View::all_of(image), |p| fitted.views[p].clone())];
            let bundle = Bundle {
                board,
                views: &view,
                lens: fitted.lens.clone(),
                poses: pose.into_iter().collect(),
                shape_mm: fitted.shape_mm.clone(),
                robust_px: f64::INFINITY,
            };
            let residual = |o: &Observation| {
                pose.and_then(|_| Some((o.corner, bundle.residual(0, &o.corner)?)))
            };
            ViewResult {
                pose,
                rms_px: pose.map(|_| bundle.view_rms_px(0)).filter(|rms| rms.is_finite()),
                rejected: rejected[v].clone(),
                is_turned: is_turned[v],
                residuals: view[0].observations.iter().filter_map(residual).collect(),
                outliers: view[0].observations.iter().filter(|o| o.is_outlier).count(),
            }
        })
        .collect();
    Ok(LensCalibration {
        lens: fitted.lens.clone(),
        sigma,
        rms_px: fitted.rms_px,
        views,
        shape_mm: fitted.shape_mm.clone(),
        warnings: Vec::new(),
    })
}
