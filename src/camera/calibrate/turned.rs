//! Stills turned by half a turn among others that were not: of a camera mounted the other way
//! round, or turned by a program that obeyed or ignored what the file says of its orientation.
//!
//! The lens mirrors its principal point and its tangential distortion in such a picture. Poses hide
//! most of that, so that its error stays small while it bends the lens of all: it is told by fitting
//! it both ways.

use super::bundle::board_pose;
use super::least_squares::{Numeric, minimise};
use super::lens::Fitted;
use super::reprojection_error;
use crate::camera::chessboard::{BoardImage, Chessboard, Corner};
use crate::units::RawPx;
use nalgebra::{DVector, Vector2};

/// A gain of so many variances is no chance: five standard deviations.
const GAIN_VARIANCES: f64 = 25.0;
/// A pose converges in far fewer.
const STEPS_MAX: usize = 30;

/// A view that fits the lens turned back only.
pub(super) struct TurnedView {
    /// Its number among those fitted.
    pub(super) view: usize,
    /// Root mean square error as it is, and turned back, px.
    pub(super) rms_px: [f64; 2],
}

/// The view that gains most from being turned back, when that is no chance.
pub(super) fn turned_view(
    board: &Chessboard,
    image_size_px: [usize; 2],
    fitted: &Fitted,
) -> Option<TurnedView> {
    // Of one coordinate of a corner.
    let variance = 0.5 * fitted.rms_px * fitted.rms_px;
    let gain = |view: usize| {
        let corners: Vec<Corner> = fitted.views[view]
            .observations
            .iter()
            .filter(|o| !o.is_outlier)
            .map(|o| o.corner)
            .collect();
        let as_it_is = squares(board, fitted, &corners)?;
        let turned = squares(board, fitted, &turned_back(board, image_size_px, &corners))?;
        let rms_px = [as_it_is, turned].map(|sum| (sum / corners.len() as f64).sqrt());
        Some((as_it_is - turned, TurnedView { view, rms_px }))
    };
    let (gain, turned) =
        (0..fitted.views.len()).filter_map(gain).max_by(|a, b| a.0.total_cmp(&b.0))?;
    (gain > GAIN_VARIANCES * variance).then_some(turned)
}

/// Error of an image turned back, px, whether it was fitted or not.
pub(super) fn turned_back_rms_px(
    board: &Chessboard,
    image_size_px: [usize; 2],
    fitted: &Fitted,
    image: &BoardImage,
) -> Option<f64> {
    let corners = turned_back(board, image_size_px, &image.corners);
    Some((squares(board, fitted, &corners)? / corners.len() as f64).sqrt())
}

/// The corners in the picture turned by half a turn, named as the finder would there.
fn turned_back(board: &Chessboard, [width, height]: [usize; 2], corners: &[Corner]) -> Vec<Corner> {
    let turned = |c: &Corner| Corner {
        at: RawPx { x: width as f64 - 1.0 - c.at.x, y: height as f64 - 1.0 - c.at.y },
        ..*c
    };
    let turned: Vec<Corner> = corners.iter().map(turned).collect();
    board.named_towards(&turned, Vector2::x())
}

/// Sum of the squared distances at the best pose for the lens and board that were fitted.
fn squares(board: &Chessboard, fitted: &Fitted, corners: &[Corner]) -> Option<f64> {
    let start = board_pose(board, &fitted.lens, corners)?;
    let place = |c: &Corner| {
        let shape = fitted.shape_mm.get(board.index(c)).copied().unwrap_or_default();
        board.place_mm(c).push(0.0) + shape
    };
    let errors = |x: &DVector<f64>| {
        let pose = start.stepped(x);
        let error = |c: &Corner| reprojection_error(&fitted.lens, pose.apply(place(c)), c.at);
        let errors: Option<Vec<[f64; 2]>> = corners.iter().map(error).collect();
        errors.map(|errors| errors.concat())
    };
    let (_, normal) = minimise(Numeric { parameters: DVector::zeros(6), errors }, STEPS_MAX)?;
    Some(normal.cost)
}
