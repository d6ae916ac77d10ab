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
use crate::camera::Lens;
use crate::camera::chessboard::{BoardImage, Chessboard, Corner};
use crate::units::RawPx;
use nalgebra::{DVector, Vector2};

/// A difference of so many variances is no chance: five standard deviations.
const DECIDED_VARIANCES: f64 = 25.0;
/// Fits in which views change sides until none does; seen: two to four.
const ROUNDS_MAX: usize = 8;
/// A pose converges in far fewer.
const STEPS_MAX: usize = 30;

/// A view that is turned against most of the others.
pub(super) struct TurnedView {
    /// Its number among those fitted.
    pub(super) view: usize,
    /// Root mean square error as the others are, and turned back, px.
    pub(super) rms_px: [f64; 2],
}

/// The views that are turned against most of the others; of two halves those unlike the first.
///
/// A fit of pictures of both kinds lies between them, so that none of them stands out: the views are turned
/// as they fit better, and fitted anew by `refit` from a lens, until all are of one kind.
pub(super) fn turned_views(
    board: &Chessboard,
    image_size_px: [usize; 2],
    images: &[BoardImage],
    first: &Fitted,
    refit: &dyn Fn(&[BoardImage], &Lens) -> Option<Fitted>,
) -> Option<(Vec<TurnedView>, Vec<f64>)> {
    let turn = |image: &BoardImage| BoardImage {
        corners: turned_back(board, image_size_px, &image.corners),
        ..image.clone()
    };
    let backs: Vec<BoardImage> = images.iter().map(turn).collect();
    let mut refitted: Option<Fitted> = None;
    let mut is_back = vec![false; images.len()];
    for _ in 0..ROUNDS_MAX {
        let fitted = refitted.as_ref().unwrap_or(first);
        let fits_back = |v: usize| {
            let [as_it_is, back] =
                [images, &backs].map(|i| squares(board, fitted, &inliers(fitted, v, &i[v])));
            Some(back? < as_it_is?)
        };
        let next: Vec<bool> = (0..images.len()).map(fits_back).collect::<Option<_>>()?;
        if next == is_back {
            break;
        }
        is_back = next;
        let chosen = |v: usize| if is_back[v] { &backs[v] } else { &images[v] }.clone();
        let chosen: Vec<BoardImage> = (0..images.len()).map(chosen).collect();
        refitted = Some(refit(&chosen, &fitted.lens)?);
    }
    let fitted = refitted?;
    // Of one coordinate of a corner.
    let variance = 0.5 * fitted.rms_px * fitted.rms_px;
    // Sums of squares the other way, and the way it fits; where that is no chance.
    let decided = |v: usize| {
        let [as_it_is, back] =
            [images, &backs].map(|i| squares(board, &fitted, &inliers(&fitted, v, &i[v])));
        let sums = if is_back[v] { [as_it_is?, back?] } else { [back?, as_it_is?] };
        let count = inliers(&fitted, v, &images[v]).len() as f64;
        let rms_px = sums.map(|sum| (sum / count).sqrt());
        let turned = TurnedView { view: v, rms_px };
        (sums[0] - sums[1] > DECIDED_VARIANCES * variance).then_some((is_back[v], turned))
    };
    let (one, other): (Vec<_>, Vec<_>) =
        (0..images.len()).filter_map(decided).partition(|(back, _)| *back == is_back[0]);
    let fewer = if one.len() < other.len() { one } else { other };
    Some((fewer.into_iter().map(|(_, turned)| turned).collect(), fitted.view_rms_px))
}

/// The corners of a view that the fit did not leave out: one far off would outweigh the rest.
fn inliers(fitted: &Fitted, view: usize, image: &BoardImage) -> Vec<Corner> {
    let seen = fitted.views[view].observations.iter().zip(&image.corners);
    seen.filter(|(o, _)| !o.is_outlier).map(|(_, &corner)| corner).collect()
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
