//! Everything at once: the lens, the pose of every view and, if wanted, the shape of the board.

use super::Pose;
use super::homography::{homography, pose_of_plane};
use super::least_squares::{Normal, Problem};
use crate::camera::chessboard::{Chessboard, Corner};
use crate::camera::{LENS_PARAMETERS, Lens};
use nalgebra::{DVector, Vector2, Vector3};

/// A corner as seen in one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Observation {
    pub(super) corner: Corner,
    /// Left out of the fit: it does not belong.
    pub(super) is_outlier: bool,
}

/// One view's corners.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub(super) observations: Vec<Observation>,
}

/// A refined corner is good to this; it weighs corners against the board's expected flatness.
const CORNER_SIGMA_PX: f64 = 0.1;
/// How far the corners of a printed board may be from where they should be, as part of the
/// board's longer side: across the paper it bends (1 %), along it hardly stretches.
const BEND: f64 = 0.01;
const STRETCH: f64 = 0.002;

/// The state that is fitted.
#[derive(Clone)]
pub(super) struct Bundle<'a> {
    pub(super) board: &'a Chessboard,
    pub(super) views: &'a [View],
    pub(super) lens: Lens,
    pub(super) poses: Vec<Pose>,
    /// How far each corner is from its place on a flat board, by row and column, mm; empty for
    /// a flat board.
    pub(super) shape_mm: Vec<Vector3<f64>>,
    /// Errors far above this lose their weight (Cauchy); infinite for plain least squares.
    pub(super) robust_px: f64,
}

impl Bundle<'_> {
    /// Place of a corner in the board's frame, mm.
    fn place_mm(&self, corner: &Corner) -> Vector3<f64> {
        let flat = self.board.place_mm(corner).push(0.0);
        flat + self.shape_mm.get(self.board.index(corner)).copied().unwrap_or_default()
    }

    /// Seen minus expected, px.
    pub(super) fn residual(&self, view: usize, corner: &Corner) -> Option<Vector2<f64>> {
        let expected = self.lens.linearise(self.poses[view].apply(self.place_mm(corner)))?.px;
        Some(Vector2::new(corner.at.x, corner.at.y) - expected)
    }

    /// Root mean square of the distances in a view, outliers apart.
    pub(super) fn view_rms_px(&self, view: usize) -> f64 {
        let squares: Vec<f64> = self.views[view]
            .observations
            .iter()
            .filter(|o| !o.is_outlier)
            .map(|o| self.residual(view, &o.corner).map_or(f64::INFINITY, |r| r.norm_squared()))
            .collect();
        (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
    }

    pub(super) fn pose_column(&self, view: usize) -> usize {
        LENS_PARAMETERS + 3 * self.shape_mm.len() + 6 * view
    }

    fn add_observation(&self, normal: &mut Normal, view: usize, corner: &Corner) -> Option<()> {
        let place = self.place_mm(corner);
        let pose = &self.poses[view];
        let turned = pose.rotation * place;
        let projection = self.lens.linearise(turned + pose.translation_mm)?;
        let error = projection.px - Vector2::new(corner.at.x, corner.at.y);
        let relative = error.norm_squared() / (self.robust_px * self.robust_px);
        let weight = (1.0 + relative).recip();
        normal.cost += if relative > 0.0 {
            self.robust_px * self.robust_px * relative.ln_1p()
        } else {
            error.norm_squared()
        };
        let by_turn = -projection.by_point * turned.cross_matrix();
        let first_pose = self.pose_column(view);
        let mut columns: Vec<usize> =
            (0..LENS_PARAMETERS).chain(first_pose..first_pose + 6).collect();
        let by_shape = projection.by_point * pose.rotation;
        if !self.shape_mm.is_empty() {
            let first = LENS_PARAMETERS + 3 * self.board.index(corner);
            columns.extend(first..first + 3);
        }
        for axis in 0..2 {
            let slopes: Vec<f64> = projection
                .by_lens
                .row(axis)
                .iter()
                .chain(by_turn.row(axis).iter())
                .chain(projection.by_point.row(axis).iter())
                .chain(by_shape.row(axis).iter())
                .copied()
                .collect();
            // Of a flat board the last three have no column.
            normal.add(weight, error[axis], &columns, &slopes);
        }
        Some(())
    }

    /// The board is nearly flat: this also keeps its shape from taking over the poses' motion.
    fn add_flatness(&self, normal: &mut Normal) {
        let side_mm = self.board.square_mm * self.board.columns as f64;
        let weight = |part: f64| (CORNER_SIGMA_PX / (part * side_mm)).powi(2);
        let weights = [weight(STRETCH), weight(STRETCH), weight(BEND)];
        for (k, shape) in self.shape_mm.iter().enumerate() {
            for axis in 0..3 {
                normal.cost += weights[axis] * shape[axis] * shape[axis];
                normal.add(weights[axis], shape[axis], &[LENS_PARAMETERS + 3 * k + axis], &[1.0]);
            }
        }
    }
}

impl Problem for Bundle<'_> {
    fn normal(&self) -> Option<Normal> {
        let mut normal = Normal::zeros(self.pose_column(self.views.len()));
        for (index, view) in self.views.iter().enumerate() {
            for observation in view.observations.iter().filter(|o| !o.is_outlier) {
                self.add_observation(&mut normal, index, &observation.corner)?;
            }
        }
        self.add_flatness(&mut normal);
        normal.cost.is_finite().then_some(normal)
    }

    fn moved(&self, step: &DVector<f64>) -> Self {
        let mut next = self.clone();
        let lens = self.lens.parameters();
        let lens: [f64; LENS_PARAMETERS] = std::array::from_fn(|k| lens[k] + step[k]);
        next.lens = Lens::from_parameters(self.lens.model, lens);
        let triple = |first: usize| Vector3::new(step[first], step[first + 1], step[first + 2]);
        for (k, shape) in next.shape_mm.iter_mut().enumerate() {
            *shape += triple(LENS_PARAMETERS + 3 * k);
        }
        for (view, pose) in next.poses.iter_mut().enumerate() {
            let first = self.pose_column(view);
            *pose = pose.moved(triple(first), triple(first + 3));
        }
        next
    }
}

/// Pose of the board for a lens, from its corners' rays; `None` when they lie on one line or
/// behind the camera.
pub(super) fn board_pose(board: &Chessboard, lens: &Lens, corners: &[Corner]) -> Option<Pose> {
    let (plane, rays): (Vec<_>, Vec<_>) =
        corners.iter().filter_map(|c| Some((board.place_mm(c), lens.unproject(c.at)?))).unzip();
    let pose = pose_of_plane(&homography(&plane, &rays)?)?;
    plane.iter().all(|p| lens.linearise(pose.apply(p.push(0.0))).is_some()).then_some(pose)
}
