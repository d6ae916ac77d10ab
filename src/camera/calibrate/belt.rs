//! The belt plane and the direction of travel from stills of a board lying on the belt.

use super::bundle::board_pose;
use super::least_squares::{DIFFERENCE, Normal, Numeric, minimise};
use super::{Pose, camera_over_belt, reprojection_error};
use crate::camera::chessboard::{BoardImage, Chessboard, Corner};
use crate::camera::{CalibratedLens, Camera, Lens};
use crate::error::{Error, Result};
use nalgebra::{DVector, Matrix3, Rotation2, Vector2, Vector3};

/// A still and what to call it in an error.
#[derive(Clone, Copy, Debug)]
pub struct BeltStill<'a> {
    /// File name.
    pub name: &'a str,
    /// The board in it.
    pub board: &'a BoardImage,
}

/// One still's part in a calibration.
#[derive(Clone, Debug)]
pub struct StillResult {
    /// Root mean square distance of its corners from where they should be, px.
    pub rms_px: f64,
    /// Each corner and its error (seen minus expected), px.
    pub residuals: Vec<(Corner, Vector2<f64>)>,
}

/// A camera over its belt.
#[derive(Clone, Debug)]
pub struct BeltCalibration {
    /// Lens and pose.
    pub camera: Camera,
    /// Root mean square distance of all corners from where they should be, px.
    pub rms_px: f64,
    /// Each still's part.
    pub stills: Vec<StillResult>,
    /// Standard deviation of the camera's height above the belt.
    pub sigma_height_mm: f64,
    /// Standard deviation of the belt plane's tilt (the larger of its two directions).
    pub sigma_tilt_deg: f64,
    /// Standard deviation of the direction of travel; `None` when it was assumed.
    pub sigma_travel_deg: Option<f64>,
    /// How far the board was carried from each still to the first, mm.
    pub travel_mm: Vec<f64>,
    /// What the technician should know, in plain words.
    pub warnings: Vec<String>,
}

/// A carried board does not turn: less than this is noise or slack.
const TURN_DEG_MAX: f64 = 0.5;
/// A carried board keeps to its line, as part of the way, and never better than mm.
const SIDEWAYS_MAX: f64 = 0.01;
const SIDEWAYS_MM_MAX: f64 = 1.5;
/// Estimates are taken for different when this many standard deviations apart.
const SIGMAS: f64 = 5.0;
/// A still's error, lying in the common plane, against that on its own.
const FLAT_RATIO: f64 = 2.0;
const FLAT_PX: f64 = 0.3;
/// Errors of all stills together against those of each alone: above this they share an error.
const SHARED_RATIO: f64 = 1.3;
/// Relative standard deviation of the height, and that of the tilt, that parcels can bear.
const HEIGHT_SIGMA_WANTED: f64 = 0.003;
const TILT_SIGMA_WANTED_DEG: f64 = 0.1;
/// A travel direction from a shorter way, in squares, is worth little.
const TRAVEL_SQUARES_WANTED: f64 = 4.0;
const STEPS_MAX: usize = 50;

/// The pose of the camera over the belt.
///
/// All stills are of the board lying flat: `carried`, in order of time, as the belt carries it,
/// and `elsewhere` at any other places, which make the plane surer. The board's printed face
/// lies `thickness_mm` above the belt. The height inherits the uncertainty of the focal length.
///
/// # Errors
/// No still; a board whose pose the lens does not give; stills that are not one pass of a board
/// lying flat and carried by the belt.
pub fn calibrate_belt(
    board: &Chessboard,
    lens: &CalibratedLens,
    carried: &[BeltStill<'_>],
    elsewhere: &[BeltStill<'_>],
    thickness_mm: f64,
) -> Result<BeltCalibration> {
    let pass = carried.len();
    if pass == 0 {
        return Err(Error::configuration("no still of the board").remedy("give at least one"));
    }
    let all = [carried, elsewhere].concat();
    for (k, still) in all.iter().enumerate() {
        if let Some(first) = all[..k].iter().find(|s| s.board.corners == still.board.corners) {
            return Err(Error::configuration(format!("the same still as {}", first.name))
                .at(still.name)
                .remedy("give every still once"));
        }
    }
    let stills = Stills::new(board, &lens.lens, &all);
    let (own_px, first, plane) = stills.lie_flat()?;
    let fit = if pass > 1 { stills.carried(first, &plane, pass)? } else { plane };
    // What the stills do not say on their own is an error that a still's corners share: a slip of
    // the board, the lens. It does not average out over them.
    let shared_px2 = fit.sigma_px().powi(2) - own_px * own_px;
    let corners_per_still = fit.corners() / fit.stills.len() as f64;
    let shares_an_error = fit.sigma_px() > SHARED_RATIO * own_px;
    let sigma_px = if shares_an_error {
        (fit.sigma_px().powi(2) + (corners_per_still - 1.0) * shared_px2).sqrt()
    } else {
        fit.sigma_px()
    };
    let covariance = fit
        .normal
        .covariance()
        .ok_or_else(|| Error::failure("the corners do not determine the belt plane"))?
        * (sigma_px * sigma_px);
    let camera_of = |x: &DVector<f64>| {
        let belt = belt_frame(first.stepped(x), fit.layout.direction(x), thickness_mm);
        camera_over_belt(&lens.lens, lens.image_size_px, belt)
    };
    let camera = camera_of(&fit.parameters);
    // Of a value computed from the parameters, by its slopes.
    let sigma = |value: &dyn Fn(&Camera) -> f64| {
        let slopes = DVector::from_fn(fit.parameters.len(), |k, _| {
            let moved = |sign: f64| {
                let mut parameters = fit.parameters.clone();
                parameters[k] += sign * DIFFERENCE;
                value(&camera_of(&parameters))
            };
            (moved(1.0) - moved(-1.0)) / (2.0 * DIFFERENCE)
        });
        (slopes.transpose() * &covariance * slopes)[0].max(0.0).sqrt()
    };
    // Small turns about the belt's axes: entries of the rotation against the one found.
    let turn_deg = |other: &Camera, row: usize, column: usize| {
        (camera.camera_from_belt.transpose() * other.camera_from_belt)[(row, column)].to_degrees()
    };
    let height_mm = camera.checked_height_mm()?;
    let ways_mm = fit.layout.ways(&fit.parameters);
    let sigma_height_mm = sigma(&|c| c.centre_in_belt().z).hypot(lens.focal_sigma() * height_mm);
    let sigma_tilt_deg = sigma(&|c| turn_deg(c, 0, 2)).max(sigma(&|c| turn_deg(c, 1, 2)));
    let mut warnings = warnings(board, &ways_mm);
    if shares_an_error {
        warnings.push(format!(
            "together the stills fit only to {:.2} px, each on its own to {own_px:.2} px: the board \
             slipped or does not lie flat, or --lens is not this camera's with this focus",
            fit.sigma_px()
        ));
    }
    if sigma_height_mm > HEIGHT_SIGMA_WANTED * height_mm || sigma_tilt_deg > TILT_SIGMA_WANTED_DEG {
        warnings.push(format!(
            "the belt is known only to {sigma_height_mm:.1} mm and {sigma_tilt_deg:.2} degrees: use a \
             larger board, more stills (also --elsewhere), and a better lens calibration"
        ));
    }
    Ok(BeltCalibration {
        rms_px: fit.rms_px(),
        sigma_height_mm,
        sigma_tilt_deg,
        sigma_travel_deg: (pass > 1).then(|| sigma(&|c| turn_deg(c, 1, 0))),
        warnings,
        travel_mm: ways_mm,
        stills: fit.stills,
        camera,
    })
}

fn warnings(board: &Chessboard, ways_mm: &[f64]) -> Vec<String> {
    let mut warnings = Vec::new();
    let way_mm = ways_mm.last().copied().unwrap_or(0.0);
    if ways_mm.len() == 1 {
        warnings.push(
            "the direction of travel is not known from one still: +X was laid along the image's rows, \
             left to right; let the belt carry the board and take two or more stills"
                .to_owned(),
        );
    } else if way_mm < TRAVEL_SQUARES_WANTED * board.square_mm {
        warnings.push(format!(
            "the board was carried only {way_mm:.0} mm: let it travel through the whole image"
        ));
    }
    if ways_mm.len() == 2 {
        warnings.push(
            "two stills cannot show whether the board kept to a straight line: take a third"
                .to_owned(),
        );
    }
    if ways_mm.len() > 1 && board.is_symmetric() {
        warnings.push(
            "this board looks the same after half a turn: make sure that it was not turned"
                .to_owned(),
        );
    }
    warnings
}

/// The parameters of a fit: the first board's turn and shift; of a pass its direction (rad, in
/// the first board's frame) and the way (mm) of every further still; of every other still its
/// shift x, y (mm) and turn (rad) in the plane.
#[derive(Clone, Copy)]
struct Layout {
    /// Stills of the pass; 1 when every still has its own place.
    pass: usize,
    stills: usize,
}

impl Layout {
    const DIRECTION: usize = 6;

    fn count(self) -> usize {
        self.free(self.stills)
    }

    /// First parameter of a still that is not of the pass.
    fn free(self, still: usize) -> usize {
        let of_pass = if self.pass > 1 { self.pass } else { 0 };
        Self::DIRECTION + of_pass + 3 * (still - self.pass)
    }

    fn direction(self, x: &DVector<f64>) -> Option<Vector2<f64>> {
        let angle = (self.pass > 1).then(|| x[Self::DIRECTION])?;
        Some(Vector2::new(angle.cos(), angle.sin()))
    }

    /// How far each still of the pass is from the first.
    fn ways(self, x: &DVector<f64>) -> Vec<f64> {
        (0..self.pass).map(|k| if k == 0 { 0.0 } else { x[Self::DIRECTION + k] }).collect()
    }

    /// Where a point of a still's board is in the first board's plane.
    fn place(self, x: &DVector<f64>, still: usize, point: Vector2<f64>) -> Vector2<f64> {
        match self.direction(x) {
            _ if still == 0 => point,
            Some(along) if still < self.pass => point + x[Self::DIRECTION + still] * along,
            _ => {
                let k = self.free(still);
                Rotation2::new(x[k + 2]) * point + Vector2::new(x[k], x[k + 1])
            }
        }
    }
}

/// A fit of stills with shared parameters.
struct Fit {
    layout: Layout,
    first: Pose,
    parameters: DVector<f64>,
    normal: Normal,
    stills: Vec<StillResult>,
}

impl Fit {
    fn corners(&self) -> f64 {
        self.stills.iter().map(|s| s.residuals.len()).sum::<usize>() as f64
    }

    fn rms_px(&self) -> f64 {
        (self.normal.cost / self.corners()).sqrt()
    }

    /// Of one coordinate.
    fn sigma_px(&self) -> f64 {
        (self.normal.cost / self.freedom()).sqrt()
    }

    fn freedom(&self) -> f64 {
        (2.0 * self.corners() - self.parameters.len() as f64).max(1.0)
    }
}

/// All stills, with one name for each corner.
struct Stills<'a> {
    board: &'a Chessboard,
    lens: &'a Lens,
    names: Vec<&'a str>,
    corners: Vec<Vec<Corner>>,
}

impl<'a> Stills<'a> {
    /// The corners of a symmetric board are named in every still as is nearest to the first.
    fn new(board: &'a Chessboard, lens: &'a Lens, stills: &[BeltStill<'a>]) -> Self {
        let first = stills.first().map(|s| board.direction(&s.board.corners));
        let towards = first.unwrap_or_default();
        let named = |s: &BeltStill<'_>| board.named_towards(&s.board.corners, towards);
        let names = stills.iter().map(|s| s.name).collect();
        Self { board, lens, names, corners: stills.iter().map(named).collect() }
    }

    /// Minimise the distances of all corners of `corners`.
    fn fit(
        &self,
        layout: Layout,
        first: Pose,
        corners: &[Vec<Corner>],
        start: DVector<f64>,
    ) -> Option<Fit> {
        let still_errors = |x: &DVector<f64>, still: usize| -> Option<Vec<f64>> {
            let pose = first.stepped(x);
            let mut errors = Vec::with_capacity(2 * corners[still].len());
            for corner in &corners[still] {
                let at = layout.place(x, still, self.board.place_mm(corner));
                errors.extend(reprojection_error(self.lens, pose.apply(at.push(0.0)), corner.at)?);
            }
            Some(errors)
        };
        let errors = |x: &DVector<f64>| {
            let all: Option<Vec<_>> = (0..corners.len()).map(|k| still_errors(x, k)).collect();
            Some(all?.concat())
        };
        let (fitted, normal) = minimise(Numeric { parameters: start, errors }, STEPS_MAX)?;
        let parameters = fitted.parameters;
        let result = |still: usize| {
            let errors = still_errors(&parameters, still)?;
            let squares: f64 = errors.iter().map(|e| e * e).sum();
            let residual = |(&corner, e): (&Corner, &[f64])| (corner, -Vector2::new(e[0], e[1]));
            Some(StillResult {
                rms_px: (squares / corners[still].len() as f64).sqrt(),
                residuals: corners[still]
                    .iter()
                    .zip(errors.chunks_exact(2))
                    .map(residual)
                    .collect(),
            })
        };
        let stills = (0..corners.len()).map(result).collect::<Option<_>>()?;
        Some(Fit { layout, first: first.stepped(&parameters), parameters, normal, stills })
    }

    /// One still's board on its own.
    fn own_fit(&self, still: usize) -> Result<Fit> {
        let corners = &self.corners[still];
        board_pose(self.board, self.lens, corners)
            .and_then(|start| {
                let layout = Layout { pass: 1, stills: 1 };
                let start_parameters = DVector::zeros(layout.count());
                self.fit(layout, start, std::slice::from_ref(corners), start_parameters)
            })
            .ok_or_else(|| {
                Error::configuration("the board's corners do not give its pose with this lens")
                    .at(self.names[still])
                    .remedy("check that --lens belongs to this camera and its images")
            })
    }

    /// Errors of the stills each on its own (standard deviation of a coordinate, px), the first
    /// board's own pose, and all boards in one plane, each anywhere and turned anyhow in it.
    fn lie_flat(&self) -> Result<(f64, Pose, Fit)> {
        let own: Vec<Fit> =
            (0..self.names.len()).map(|k| self.own_fit(k)).collect::<Result<_>>()?;
        let first = own[0].first;
        let layout = Layout { pass: 1, stills: own.len() };
        let mut start = DVector::zeros(layout.count());
        for (still, own) in own.iter().enumerate().skip(1) {
            let relative = first.rotation.transpose() * own.first.rotation;
            let shift = own.first.translation_mm - first.translation_mm;
            let shift = first.rotation.transpose() * shift;
            let turn = (relative.m21 - relative.m12).atan2(relative.m11 + relative.m22);
            let k = layout.free(still);
            start.rows_mut(k, 3).copy_from_slice(&[shift.x, shift.y, turn]);
        }
        let fit = self
            .fit(layout, first, &self.corners, start)
            .ok_or_else(|| Error::failure("the belt plane does not converge"))?;
        for (still, (fitted, own)) in self.names.iter().zip(fit.stills.iter().zip(&own)) {
            let (together_px, own_px) = (fitted.rms_px, own.rms_px());
            if together_px > FLAT_PX.max(FLAT_RATIO * own_px) {
                return Err(Error::configuration(format!(
                    "the board does not lie in one plane with the others: \
                     {together_px:.2} px off, {own_px:.2} px on its own"
                ))
                .at(still)
                .remedy(
                    "lay the board flat on the belt, do not hold it; do not move the camera \
                     between stills",
                ));
            }
        }
        // Of one coordinate, as Fit::sigma_px.
        let squares: f64 = own.iter().map(|f| f.normal.cost).sum();
        let freedom: f64 = own.iter().map(Fit::freedom).sum();
        Ok(((squares / freedom).sqrt(), first, fit))
    }

    /// The first `pass` boards on one straight way, turned alike.
    fn carried(&self, first: Pose, plane: &Fit, pass: usize) -> Result<Fit> {
        let ways = self.ways_of_one_pass(plane, pass)?;
        let last = ways[pass - 1];
        let layout = Layout { pass, stills: self.names.len() };
        let mut start = DVector::zeros(layout.count());
        start
            .rows_mut(0, Layout::DIRECTION)
            .copy_from(&plane.parameters.rows(0, Layout::DIRECTION));
        start[Layout::DIRECTION] = last.y.atan2(last.x);
        for (k, way) in ways.iter().enumerate().skip(1) {
            start[Layout::DIRECTION + k] = way.dot(&last.normalize());
        }
        for still in pass..self.names.len() {
            let from = plane.parameters.rows(plane.layout.free(still), 3);
            start.rows_mut(layout.free(still), 3).copy_from(&from);
        }
        self.fit(layout, first, &self.corners, start)
            .ok_or_else(|| Error::failure("the direction of travel does not converge"))
    }

    /// The way of each of the first `pass` stills from the first, checked to be one pass.
    fn ways_of_one_pass(&self, plane: &Fit, pass: usize) -> Result<Vec<Vector2<f64>>> {
        let not_a_pass = |still: usize, what: String| {
            Error::configuration(format!("these stills are not one pass of the board: {what}"))
                .at(self.names[still])
                .remedy(
                    "give the stills of one pass in order of time, of a board that the belt carries \
                     and nobody touches; stills of the board laid elsewhere go to --elsewhere",
                )
        };
        let covariance = plane
            .normal
            .covariance()
            .ok_or_else(|| Error::failure("the corners do not determine the belt plane"))?
            * plane.sigma_px().powi(2);
        let mut ways = vec![Vector2::zeros()];
        for still in 1..pass {
            let k = plane.layout.free(still);
            let turn_deg = plane.parameters[k + 2].to_degrees();
            let slack_deg = SIGMAS * covariance[(k + 2, k + 2)].sqrt().to_degrees();
            if turn_deg.abs() > TURN_DEG_MAX.max(slack_deg) {
                let what = format!("it is turned by {turn_deg:.1} degrees against the first still");
                return Err(not_a_pass(still, what));
            }
            ways.push(Vector2::new(plane.parameters[k], plane.parameters[k + 1]));
        }
        let way_mm = ways[pass - 1].norm();
        if way_mm < 0.5 * self.board.square_mm {
            let what = format!("it moved only {way_mm:.1} mm from the first still");
            return Err(not_a_pass(pass - 1, what));
        }
        let along = ways[pass - 1] / way_mm;
        for still in 1..pass {
            let k = plane.layout.free(still);
            let sideways_mm = along.perp(&ways[still]).abs();
            let sigma_mm = covariance[(k, k)].max(covariance[(k + 1, k + 1)]).sqrt();
            let slack_mm = SIDEWAYS_MM_MAX.max(SIDEWAYS_MAX * way_mm).max(SIGMAS * sigma_mm);
            if sideways_mm > slack_mm {
                let what =
                    format!("it is {sideways_mm:.1} mm beside the line from the first to the last");
                return Err(not_a_pass(still, what));
            }
            if ways[still].dot(&along) <= ways[still - 1].dot(&along) {
                let what = "it is not further along than the one before".to_owned();
                return Err(not_a_pass(still, what));
            }
        }
        Ok(ways)
    }
}

/// The belt's frame: X along travel, Y to the left, Z up, on the belt under the board.
///
/// A board's columns and rows turn clockwise in the image, so its third axis points down.
fn belt_frame(board: Pose, travel: Option<Vector2<f64>>, thickness_mm: f64) -> Pose {
    let up = -board.rotation.column(2);
    let x = match travel {
        Some(along) => board.rotation * along.push(0.0),
        // the image's rows, laid on the belt
        None => up.cross(&Vector3::y()).normalize(),
    };
    let y = up.cross(&x);
    Pose {
        rotation: Matrix3::from_columns(&[x, y, up]),
        translation_mm: board.translation_mm - up * thickness_mm,
    }
}
