//! The same corners into `OpenCV`'s calibrateCamera and `fisheye::calibrate`: the same lens.
//!
//! Both minimise the same sum of squares, so parameters agree far below their uncertainty: to
//! four significant digits, or to a hundredth of a standard deviation where a parameter is so
//! near 0 that digits mean nothing.

#[path = "../../tests/common/chessboard.rs"]
mod scene;

use beltgauge::camera::calibrate::{BoardShape, LensCalibration, LensStart, calibrate_lens};
use beltgauge::camera::chessboard::{BoardImage, Chessboard};
use beltgauge::camera::{Lens, LensModel};
use beltgauge::source::synthetic::Random;
use beltgauge::source::{Still, stills_in};
use opencv::calib3d;
use opencv::core::{Mat, Point2f, Point3f, Size, TermCriteria, TermCriteria_Type, Vector};
use opencv::prelude::*;
use scene::{brown, pose, seen};
use std::path::Path;

const SIZE: [usize; 2] = [1920, 1200];

fn board() -> Chessboard {
    Chessboard::new([9, 6], 25.0)
}

/// Boards all over the image with 0.1 px of noise.
fn views(lens: &Lens, seed: u64) -> Vec<BoardImage> {
    let mut random = Random(seed);
    (0..14)
        .map(|k: usize| {
            let angles = [0; 3].map(|_| random.between([-35.0, 35.0]));
            let z = random.between([380.0, 520.0]);
            let (u, v) = ((k % 3) as f64 - 1.0, (k / 3 % 3) as f64 - 1.0);
            let pose = pose(&board(), angles, [0.45 * z * u, 0.25 * z * v, z]);
            seen(&board(), lens, &pose, 0.1, &mut random)
        })
        .collect()
}

/// What `OpenCV` makes of the corners: parameters in our order, and the rms.
fn opencv(images: &[BoardImage], size: [usize; 2], model: LensModel) -> ([f64; 9], f64) {
    let mut places: Vector<Vector<Point3f>> = Vector::new();
    let mut pixels: Vector<Vector<Point2f>> = Vector::new();
    for image in images {
        let place = |c| board().place_mm(c).cast::<f32>();
        let corners = || image.corners.iter();
        places.push(corners().map(|c| Point3f::new(place(c).x, place(c).y, 0.0)).collect());
        pixels.push(corners().map(|c| Point2f::new(c.at.x as f32, c.at.y as f32)).collect());
    }
    let size = Size::new(size[0] as i32, size[1] as i32);
    let kind = TermCriteria_Type::COUNT as i32 + TermCriteria_Type::EPS as i32;
    let criteria = TermCriteria::new(kind, 500, 1e-14).expect("criteria");
    let (mut matrix, mut distortion) = (Mat::default(), Mat::default());
    let (mut turns, mut shifts) = (Vector::<Mat>::new(), Vector::<Mat>::new());
    let rms = match model {
        LensModel::Brown => calib3d::calibrate_camera(
            &places,
            &pixels,
            size,
            &mut matrix,
            &mut distortion,
            &mut turns,
            &mut shifts,
            0,
            criteria,
        ),
        LensModel::Fisheye => calib3d::calibrate(
            &places,
            &pixels,
            size,
            &mut matrix,
            &mut distortion,
            &mut turns,
            &mut shifts,
            calib3d::Fisheye_CALIB_RECOMPUTE_EXTRINSIC | calib3d::Fisheye_CALIB_FIX_SKEW,
            criteria,
        ),
    }
    .expect("OpenCV calibrates");
    let k = |row, column| *matrix.at_2d::<f64>(row, column).expect("3 x 3");
    let mut all = [k(0, 0), k(1, 1), k(0, 2), k(1, 2), 0.0, 0.0, 0.0, 0.0, 0.0];
    for i in 0..model.distortion_count() {
        all[4 + i] = *distortion.at::<f64>(i as i32).expect("a coefficient");
    }
    (all, rms)
}

fn ours(images: &[BoardImage], size: [usize; 2], model: LensModel) -> LensCalibration {
    calibrate_lens(&board(), size, images, model, LensStart::Unknown, BoardShape::Flat)
        .expect("good views")
}

fn assert_agree(name: &str, images: &[BoardImage], size: [usize; 2], model: LensModel) {
    let found = ours(images, size, model);
    // Rejected views and corners would be another problem.
    assert!(found.views.iter().all(|v| v.rejected.is_none() && v.outliers == 0));
    let (expected, expected_rms) = opencv(images, size, model);
    println!("{name}: rms ours {:.6} OpenCV {expected_rms:.6} px", found.rms_px);
    for (k, (ours, theirs)) in found.lens.parameters().into_iter().zip(expected).enumerate() {
        println!("  {ours:14.8} {theirs:14.8} +- {:.8}", found.sigma[k]);
        let tolerance = (0.5e-4 * theirs.abs()).max(0.01 * found.sigma[k]);
        assert!((ours - theirs).abs() <= tolerance, "{name}: parameter {k}: {ours} {theirs}");
    }
    assert!((found.rms_px / expected_rms - 1.0).abs() < 0.01);
}

#[test]
fn a_brown_lens_as_opencv_finds_it() {
    for seed in 1..=3 {
        assert_agree("brown", &views(&brown(), seed), SIZE, LensModel::Brown);
    }
}

#[test]
fn a_fisheye_lens_as_opencv_finds_it() {
    let lens = Lens::new(
        LensModel::Fisheye,
        [560.0, 561.0],
        [955.0, 603.0],
        [0.02, -0.006, 0.001, -0.0002, 0.0],
    );
    for seed in 4..=6 {
        assert_agree("fisheye", &views(&lens, seed), SIZE, LensModel::Fisheye);
    }
}

/// The corners that our finder sees in `OpenCV`'s own sample images.
#[test]
fn opencv_s_own_boards_as_opencv_finds_them() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/opencv_chessboard");
    if !data.exists() {
        assert!(std::env::var("CI").as_deref() != Ok("true"), "no {}", data.display());
        println!("skipped: no data ({})", data.display());
        return;
    }
    for side in ["left", "right"] {
        let files = stills_in(&data).expect("images");
        let images: Vec<BoardImage> = files
            .iter()
            .filter(|f| f.file_name().is_some_and(|n| n.to_string_lossy().starts_with(side)))
            .map(|f| {
                let still = Still::load(f).expect("an image");
                board().find(still.plane().expect("whole")).expect("a board")
            })
            .collect();
        assert_eq!(images.len(), 13);
        assert_agree(side, &images, [640, 480], LensModel::Brown);
    }
}
