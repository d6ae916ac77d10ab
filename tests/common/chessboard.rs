//! Pictures of a chessboard with known truth: the board seen through a lens, with blur, noise
//! and uneven light.
#![allow(dead_code)] // each test uses its part

use beltgauge::camera::calibrate::Pose;
use beltgauge::camera::chessboard::{BoardImage, Chessboard, Corner};
use beltgauge::camera::{Lens, LensModel};
use beltgauge::error::Result;
use beltgauge::source::Still;
use beltgauge::source::synthetic::Random;
use beltgauge::units::RawPx;
use nalgebra::{Rotation3, Vector3};

/// The lens of the reference camera: strong barrel distortion.
pub fn brown() -> Lens {
    Lens::new(
        LensModel::Brown,
        [1019.3, 1019.9],
        [940.2, 599.1],
        [-0.181, 0.080, 0.0005, -0.0004, -0.008],
    )
}

/// A refusal whose text has every one of `words`.
pub fn assert_refused<T: std::fmt::Debug>(result: Result<T>, words: &[&str]) {
    let error = result.expect_err("must be refused").to_string();
    for word in words {
        assert!(error.contains(word), "no {word:?} in: {error}");
    }
}

/// How a picture is taken.
#[derive(Clone, Copy)]
pub struct Shot {
    pub size_px: [usize; 2],
    /// Grey of dark and bright squares.
    pub greys: [f64; 2],
    /// Standard deviation of the noise, grey levels.
    pub noise: f64,
    /// Standard deviation of the blur, px.
    pub blur_px: f64,
    /// The light at the image's right end, as part of that at its left.
    pub light_right: f64,
}

impl Shot {
    pub fn sharp(size_px: [usize; 2]) -> Self {
        Self { size_px, greys: [30.0, 200.0], noise: 2.0, blur_px: 0.7, light_right: 1.0 }
    }
}

/// A board turned about its middle by angles (deg) about the camera's x, y and z axes, with its
/// middle at `middle_mm` in the camera frame.
pub fn pose(board: &Chessboard, angles_deg: [f64; 3], middle_mm: [f64; 3]) -> Pose {
    let [x, y, z] = angles_deg.map(f64::to_radians);
    let turn = |axis: Vector3<f64>, angle: f64| Rotation3::new(axis * angle);
    let rotation = turn(Vector3::x(), x) * turn(Vector3::y(), y) * turn(Vector3::z(), z);
    let middle = 0.5
        * board.square_mm
        * Vector3::new(board.columns as f64 - 1.0, board.rows as f64 - 1.0, 0.0);
    Pose {
        rotation: *rotation.matrix(),
        translation_mm: Vector3::from(middle_mm) - rotation * middle,
    }
}

/// Where the corners are in truth; `None` when one is behind the camera or beyond the lens.
pub fn corners(board: &Chessboard, lens: &Lens, pose: &Pose) -> Option<Vec<Corner>> {
    (0..board.corner_count())
        .map(|k| {
            let (column, row) = (k % board.columns, k / board.columns);
            let corner = Corner { column, row, at: RawPx::default() };
            let at = lens.project(pose.apply(board.place_mm(&corner).push(0.0)))?;
            Some(Corner { at, ..corner })
        })
        .collect()
}

/// The true corners with noise (px), as the finder would give them.
pub fn seen(
    board: &Chessboard,
    lens: &Lens,
    pose: &Pose,
    noise_px: f64,
    random: &mut Random,
) -> BoardImage {
    let mut corners = corners(board, lens, pose).expect("in front of the camera");
    for corner in &mut corners {
        corner.at.x += noise_px * random.normal();
        corner.at.y += noise_px * random.normal();
    }
    BoardImage { corners, blur_px: [0.7; 2] }
}

/// Photograph the board.
pub fn photograph(board: &Chessboard, lens: &Lens, pose: &Pose, shot: Shot) -> Still {
    const SAMPLES: usize = 16;
    let [width, height] = shot.size_px;
    let board_from_camera = pose.rotation.transpose();
    let centre = -(board_from_camera * pose.translation_mm);
    let reflectance = |x: f64, y: f64| {
        let ray = lens.unproject(RawPx { x, y }).map(|r| board_from_camera * r);
        let at = ray.and_then(|r| {
            let scale = -centre.z / r.z;
            (scale > 0.0).then(|| (centre + scale * r) / board.square_mm)
        });
        let Some(at) = at else { return 0.4 };
        let (i, j) = (at.x.floor(), at.y.floor());
        let [columns, rows] = [board.columns as f64, board.rows as f64];
        let on_squares = (-1.0..columns).contains(&i) && (-1.0..rows).contains(&j);
        let on_paper = (-1.6..columns + 0.6).contains(&at.x) && (-1.6..rows + 0.6).contains(&at.y);
        match (on_squares, on_paper) {
            // The square before corner (0, 0) is dark.
            (true, _) => f64::from((i + j).rem_euclid(2.0) > 0.5),
            (false, true) => 1.0,
            // a floor with planks
            (false, false) => 0.3 + 0.1 * (0.7 * at.x).sin() * (5.0 * at.y).cos(),
        }
    };
    let [dark, bright] = shot.greys;
    let mut grey: Vec<f64> = (0..width * height)
        .map(|k| {
            let (x, y) = ((k % width) as f64, (k / width) as f64);
            // Each sample in its own sixteenth of rows and of columns.
            let offset = |n: usize| (n as f64 + 0.5) / SAMPLES as f64 - 0.5;
            let sum: f64 =
                (0..SAMPLES).map(|s| reflectance(x + offset(s), y + offset(7 * s % SAMPLES))).sum();
            let light = 1.0 + (shot.light_right - 1.0) * x / width as f64;
            light * (dark + (bright - dark) * sum / SAMPLES as f64)
        })
        .collect();
    if shot.blur_px > 0.0 {
        grey = blurred(&grey, 1, width, shot.blur_px, |k| k % width);
        grey = blurred(&grey, width, height, shot.blur_px, |k| k / width);
    }
    let mut random = Random(17);
    let pixels = grey
        .iter()
        .map(|g| (g + shot.noise * random.normal()).round().clamp(0.0, 255.0) as u8)
        .collect();
    Still { pixels, size_px: shot.size_px }
}

/// Gaussian blur along one direction; the border repeats.
fn blurred(
    grey: &[f64],
    stride: usize,
    length: usize,
    sigma: f64,
    position: impl Fn(usize) -> usize,
) -> Vec<f64> {
    let reach = (3.0 * sigma).ceil() as isize;
    let weights: Vec<f64> =
        (-reach..=reach).map(|d| (-0.5 * (d as f64 / sigma).powi(2)).exp()).collect();
    let total: f64 = weights.iter().sum();
    (0..grey.len())
        .map(|k| {
            let at = position(k);
            let value = |d: isize| {
                let there = at.saturating_add_signed(d).min(length - 1);
                grey[k + there * stride - at * stride]
            };
            (-reach..=reach).zip(&weights).map(|(d, w)| w * value(d)).sum::<f64>() / total
        })
        .collect()
}
