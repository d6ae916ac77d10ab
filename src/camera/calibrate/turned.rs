//! Stills turned by half a turn among others that were not: of a camera mounted the other way
//! round, or turned by a program that obeyed or ignored what the file says of its orientation.
//!
//! The lens mirrors its principal point and its tangential distortion in such a picture. Poses hide
//! most of that, so that a turned view's error stays small while it bends the lens of all: no view can be
//! judged alone. What a view says of the lens, its pose eliminated, is a parabola, and the turned view's
//! another: for any choice of sides the best lens, and its error, follow from their sum. The choice with
//! the least error is found by changing sides, one view or two at a time.

use super::bundle::{Bundle, Observation, View, board_pose};
use super::least_squares::{Numeric, Problem, minimise};
use super::lens::Fitted;
use super::{Pose, reprojection_error};
use crate::camera::chessboard::{BoardImage, Chessboard, Corner};
use crate::camera::{LENS_PARAMETERS, Lens};
use crate::units::RawPx;
use nalgebra::{DMatrix, DVector, SMatrix, SVector, Vector2, Vector3};

/// A difference of so many variances is no chance: five standard deviations.
const DECIDED_VARIANCES: f64 = 25.0;
/// Fits with sides chosen anew until the choice stays; seen: two or three.
const ROUNDS_MAX: usize = 6;
/// A pose converges in far fewer.
const STEPS_MAX: usize = 30;
/// Errors of so many times that of all lose their weight: a view with another fault decides nothing.
const ROBUST: f64 = 3.0;
/// Principal points that choices start from: as far from the middle of the image, as part of its width,
/// in half of all directions; the others mirror them.
const START_OFFSETS: [f64; 3] = [0.01, 0.03, 0.1];
const START_DIRECTIONS: usize = 4;

/// How the board may be bent, in whole: terms of second to fourth order. A wrong choice of sides would
/// else be laid on the board's shape, and the right one not be seen.
const BENDS: usize = 12;
const BEND_POWERS: [[i32; 2]; BENDS] = [
    [2, 0],
    [1, 1],
    [0, 2],
    [3, 0],
    [2, 1],
    [1, 2],
    [0, 3],
    [4, 0],
    [3, 1],
    [2, 2],
    [1, 3],
    [0, 4],
];
/// What all views share: the lens, and how the board is bent.
const SHARED: usize = LENS_PARAMETERS + BENDS;

type Parameters = SVector<f64, SHARED>;

/// Which views are turned against most of the others; of two halves those unlike the first.
///
/// `refit` fits other pictures of the same views from a lens.
pub(super) fn turned_views(
    board: &Chessboard,
    image_size_px: [usize; 2],
    images: &[BoardImage],
    first: &Fitted,
    refit: &dyn Fn(&[BoardImage], &Lens) -> Option<Fitted>,
) -> Option<Vec<bool>> {
    let backs: Vec<BoardImage> =
        images.iter().map(|image| turned_back(board, image_size_px, image)).collect();
    let flat = vec![Vector3::zeros(); board.corner_count()];
    let opinions = |lens: &Lens, shape: &[Vector3<f64>], fitted: &Fitted| {
        let shape = if shape.is_empty() { &flat } else { shape };
        let of = |v: usize| {
            let of = |image| Opinion::new(board, lens, shape, fitted, v, image);
            Some([of(&images[v])?, of(&backs[v])?])
        };
        (0..images.len()).map(of).collect::<Option<Vec<[Opinion; 2]>>>()
    };
    // Of pictures of both kinds the first fit's principal point is somewhere between: the middle of the
    // image treats both alike.
    let middle = in_the_middle(&first.lens, image_size_px);
    let of_all = opinions(&middle, &[], first)?;
    let mut is_back = least(&of_all, starts(&of_all, image_size_px));
    let mut lens = middle;
    for _ in 0..ROUNDS_MAX {
        let chosen = |v: usize| if is_back[v] { &backs[v] } else { &images[v] }.clone();
        let chosen: Vec<BoardImage> = (0..images.len()).map(chosen).collect();
        let fitted = refit(&chosen, &lens)?;
        let of_all = opinions(&fitted.lens, &fitted.shape_mm, &fitted)?;
        let next = least(&of_all, vec![is_back.clone()]);
        if next == is_back {
            return Some(fewer(&of_all, &is_back, &fitted));
        }
        (is_back, lens) = (next, fitted.lens);
    }
    None
}

/// Of the views whose side is no chance, those on the side of fewer.
fn fewer(of_all: &[[Opinion; 2]], is_back: &[bool], fitted: &Fitted) -> Vec<bool> {
    // Of one coordinate of a corner.
    let variance = 0.5 * fitted.rms_px * fitted.rms_px;
    let cost = least_cost(of_all, is_back);
    let is_decided = |v: usize| {
        let mut other = is_back.to_vec();
        other[v] = !other[v];
        least_cost(of_all, &other) - cost > DECIDED_VARIANCES * variance
    };
    let decided: Vec<bool> = (0..is_back.len()).map(is_decided).collect();
    let count =
        |side: bool| (0..is_back.len()).filter(|&v| decided[v] && is_back[v] == side).count();
    let turned_side = match count(true).cmp(&count(false)) {
        std::cmp::Ordering::Less => true,
        std::cmp::Ordering::Greater => false,
        std::cmp::Ordering::Equal => !is_back[0],
    };
    (0..is_back.len()).map(|v| decided[v] && is_back[v] == turned_side).collect()
}

/// What a view says of lens and board: a parabola of its error around some of both, with the best pose
/// for each.
#[derive(Clone)]
struct Opinion {
    cost: f64,
    gradient: Parameters,
    matrix: SMatrix<f64, SHARED, SHARED>,
}

impl Opinion {
    /// Of a picture of view `v` of those that were fitted; corners left out there are left out here.
    fn new(
        board: &Chessboard,
        lens: &Lens,
        shape_mm: &[Vector3<f64>],
        fitted: &Fitted,
        v: usize,
        image: &BoardImage,
    ) -> Option<Self> {
        let seen = fitted.views[v].observations.iter().zip(&image.corners);
        let inliers: Vec<Corner> =
            seen.filter(|(o, _)| !o.is_outlier).map(|(_, corner)| *corner).collect();
        let pose = best_pose(board, lens, shape_mm, &inliers)?;
        let observation = |corner| Observation { corner, is_outlier: false };
        let view = [View { observations: inliers.into_iter().map(observation).collect() }];
        let bundle = Bundle {
            board,
            views: &view,
            lens: lens.clone(),
            poses: vec![pose],
            shape_mm: shape_mm.to_vec(),
            robust_px: ROBUST * fitted.rms_px,
        };
        let normal = bundle.normal()?;
        // Of all the corners' places only the bends.
        let first = bundle.pose_column(0);
        let mut choose = DMatrix::zeros(first + 6, SHARED + 6);
        for k in 0..LENS_PARAMETERS {
            choose[(k, k)] = 1.0;
        }
        for k in 0..6 {
            choose[(first + k, SHARED + k)] = 1.0;
        }
        let middle = |count: usize| 0.5 * (count as f64 - 1.0);
        for row in 0..board.rows {
            for column in 0..board.columns {
                let at = RawPx { x: 0.0, y: 0.0 };
                let z = LENS_PARAMETERS + 3 * board.index(&Corner { column, row, at }) + 2;
                let x = column as f64 / middle(board.columns) - 1.0;
                let y = row as f64 / middle(board.rows) - 1.0;
                for (k, [i, j]) in BEND_POWERS.into_iter().enumerate() {
                    choose[(z, LENS_PARAMETERS + k)] = x.powi(i) * y.powi(j);
                }
            }
        }
        let all = choose.transpose() * normal.matrix * &choose;
        let slope = choose.transpose() * normal.gradient;
        // Schur complement: the pose follows the rest.
        let by_pose = all.view((SHARED, SHARED), (6, 6)).into_owned().cholesky()?;
        let mixed = all.view((0, SHARED), (SHARED, 6)).into_owned();
        let pose_slope = slope.rows(SHARED, 6).into_owned();
        let followed = by_pose.solve(&pose_slope);
        let matrix = all.view((0, 0), (SHARED, SHARED)).into_owned()
            - &mixed * by_pose.solve(&mixed.transpose());
        let gradient = slope.rows(0, SHARED).into_owned() - &mixed * &followed;
        Some(Self {
            cost: normal.cost - pose_slope.dot(&followed),
            gradient: Parameters::from_iterator(gradient.iter().copied()),
            matrix: SMatrix::from_iterator(matrix.iter().copied()),
        })
    }

    fn at(&self, step: &Parameters) -> f64 {
        self.cost + 2.0 * self.gradient.dot(step) + step.dot(&(self.matrix * step))
    }
}

/// The error of all views with the lens that is best for this choice of sides.
fn least_cost(of_all: &[[Opinion; 2]], is_back: &[bool]) -> f64 {
    let (mut cost, mut gradient, mut matrix) = (0.0, Parameters::zeros(), SMatrix::zeros());
    for (opinions, is_back) in of_all.iter().zip(is_back) {
        let opinion = &opinions[usize::from(*is_back)];
        cost += opinion.cost;
        gradient += opinion.gradient;
        matrix += opinion.matrix;
    }
    for k in 0..SHARED {
        // A fisheye has one parameter less; what hardly matters must not go far.
        matrix[(k, k)] += 1e-9 * matrix[(k, k)] + f64::MIN_POSITIVE.sqrt();
    }
    matrix.cholesky().map_or(f64::INFINITY, |m| cost - gradient.dot(&m.solve(&gradient)))
}

/// The choice with the least error that is reached from these by changing one side or two at a time.
fn least(of_all: &[[Opinion; 2]], starts: Vec<Vec<bool>>) -> Vec<bool> {
    let count = of_all.len();
    let descend = |mut choice: Vec<bool>| {
        let mut cost = least_cost(of_all, &choice);
        loop {
            let pairs = (0..count).flat_map(|a| (a..count).map(move |b| (a, b)));
            let changed = pairs.map(|(a, b)| {
                let mut next = choice.clone();
                next[a] = !next[a];
                if b != a {
                    next[b] = !next[b];
                }
                (least_cost(of_all, &next), next)
            });
            match changed.min_by(|a, b| a.0.total_cmp(&b.0)) {
                // A gain that is none but for rounding would go round for ever.
                Some((lower, next)) if lower < cost - 1e-9 * cost.abs() => {
                    (cost, choice) = (lower, next);
                }
                _ => return (cost, choice),
            }
        }
    };
    let reached = starts.into_iter().map(descend).min_by(|a, b| a.0.total_cmp(&b.0));
    reached.map_or_else(|| vec![false; count], |(_, choice)| choice)
}

/// Choices to start from: all as they are, and each view as it fits a principal point.
fn starts(of_all: &[[Opinion; 2]], [width, _]: [usize; 2]) -> Vec<Vec<bool>> {
    let mut starts = vec![vec![false; of_all.len()]];
    for part in START_OFFSETS {
        for k in 0..START_DIRECTIONS {
            let angle = std::f64::consts::PI * k as f64 / START_DIRECTIONS as f64;
            let mut step = Parameters::zeros();
            (step[2], step[3]) =
                (part * width as f64 * angle.cos(), part * width as f64 * angle.sin());
            starts.push(
                of_all.iter().map(|[as_it_is, back]| back.at(&step) < as_it_is.at(&step)).collect(),
            );
        }
    }
    starts
}

/// The lens that takes a picture and the same turned alike.
fn in_the_middle(lens: &Lens, [width, height]: [usize; 2]) -> Lens {
    let [fx, fy, _, _, a, b, mut c, mut d, e] = lens.parameters();
    if lens.model == crate::camera::LensModel::Brown {
        (c, d) = (0.0, 0.0);
    }
    let centre = [0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0)];
    Lens::new(lens.model, [fx, fy], centre, [a, b, c, d, e])
}

/// A board as found in the picture turned by half a turn, its corners named as the finder would there.
pub(super) fn turned_back(
    board: &Chessboard,
    [width, height]: [usize; 2],
    image: &BoardImage,
) -> BoardImage {
    let turned = |c: &Corner| Corner {
        at: RawPx { x: width as f64 - 1.0 - c.at.x, y: height as f64 - 1.0 - c.at.y },
        ..*c
    };
    let turned: Vec<Corner> = image.corners.iter().map(turned).collect();
    let corners = board.named_towards(&turned, Vector2::x());
    BoardImage { corners, ..image.clone() }
}

/// The pose that fits corners best for a lens and the board's shape.
fn best_pose(
    board: &Chessboard,
    lens: &Lens,
    shape_mm: &[Vector3<f64>],
    corners: &[Corner],
) -> Option<Pose> {
    let start = board_pose(board, lens, corners)?;
    let place = |c: &Corner| {
        let shape = shape_mm.get(board.index(c)).copied().unwrap_or_default();
        board.place_mm(c).push(0.0) + shape
    };
    let errors = |x: &DVector<f64>| {
        let pose = start.stepped(x);
        let error = |c: &Corner| reprojection_error(lens, pose.apply(place(c)), c.at);
        let errors: Option<Vec<[f64; 2]>> = corners.iter().map(error).collect();
        errors.map(|errors| errors.concat())
    };
    let (found, _) = minimise(Numeric { parameters: DVector::zeros(6), errors }, STEPS_MAX)?;
    Some(start.stepped(&found.parameters))
}
