//! A lens against known truth: round trips, then one degenerate case a test.

#[path = "common/chessboard.rs"]
mod scene;

use beltgauge::camera::calibrate::{BoardShape, LensCalibration, LensStart, Pose, calibrate_lens};
use beltgauge::camera::chessboard::{BoardImage, Chessboard};
use beltgauge::camera::{Lens, LensModel};
use beltgauge::error::Result;
use beltgauge::source::synthetic::Random;
use nalgebra::{Rotation3, Vector3};
use scene::{assert_refused, brown, pose, seen};

const SIZE: [usize; 2] = [1920, 1200];
/// What the finder reaches in a good image.
const NOISE_PX: f64 = 0.05;

fn board() -> Chessboard {
    Chessboard::new([9, 6], 25.0)
}

/// The brown lens with other focal lengths.
fn focal(fx_px: f64, fy_px: f64) -> Lens {
    let [_, _, rest @ ..] = brown().parameters();
    let [cx, cy, a, b, c, d, e] = rest;
    Lens::new(LensModel::Brown, [fx_px, fy_px], [cx, cy], [a, b, c, d, e])
}

fn fisheye() -> Lens {
    Lens::new(
        LensModel::Fisheye,
        [560.0, 561.0],
        [955.0, 603.0],
        [0.02, -0.006, 0.001, -0.0002, 0.0],
    )
}

/// Boards all over the image, tilted to all sides.
fn poses(count: usize, random: &mut Random) -> Vec<Pose> {
    let mut place = |k: usize| {
        let tilt = |random: &mut Random| random.between([-40.0, 40.0]);
        let angles = [tilt(random), tilt(random), random.between([-180.0, 180.0])];
        let z = random.between([350.0, 500.0]);
        // over a grid of 3 x 3 places
        let [u, v] = [(k % 3) as f64 - 1.0, (k / 3 % 3) as f64 - 1.0];
        pose(&board(), angles, [0.5 * z * u, 0.28 * z * v, z])
    };
    (0..count).map(&mut place).collect()
}

fn views(lens: &Lens, poses: &[Pose], random: &mut Random) -> Vec<BoardImage> {
    poses.iter().map(|p| seen(&board(), lens, p, NOISE_PX, random)).collect()
}

fn calibrate(images: &[BoardImage], model: LensModel) -> Result<LensCalibration> {
    calibrate_lens(&board(), SIZE, images, model, LensStart::Unknown, BoardShape::Estimated)
}

/// Every parameter within five of its own standard deviations, and the noise found again.
fn assert_recovers(lens: &Lens, found: &LensCalibration) {
    let (truth, result) = (lens.parameters(), found.lens.parameters());
    for k in 0..truth.len() {
        let error = (result[k] - truth[k]).abs();
        assert!(error <= 5.0 * found.sigma[k], "parameter {k}: {error} > 5 * {}", found.sigma[k]);
    }
    assert!(found.sigma[0] < 0.0005 * lens.fx_px, "sigma fx {}", found.sigma[0]);
    // Both coordinates of a corner have the noise; 16 x 54 corners estimate it to a few per cent.
    let expected_px = NOISE_PX * f64::sqrt(2.0);
    assert!((found.rms_px / expected_px - 1.0).abs() < 0.1, "rms {} px", found.rms_px);
}

#[test]
fn a_brown_lens_comes_back() {
    let mut random = Random(1);
    let images = views(&brown(), &poses(16, &mut random), &mut random);
    let found = calibrate(&images, LensModel::Brown).expect("good views");
    assert_recovers(&brown(), &found);
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
    assert!(found.views.iter().all(|v| v.rejected.is_none() && v.outliers == 0));
    assert!(found.shape_mm.is_empty(), "a flat board was bent");
}

#[test]
fn a_fisheye_lens_comes_back() {
    let mut random = Random(2);
    let images = views(&fisheye(), &poses(16, &mut random), &mut random);
    assert_recovers(&fisheye(), &calibrate(&images, LensModel::Fisheye).expect("good views"));
}

#[test]
fn a_fisheye_sees_boards_beside_and_behind_itself() {
    let mut random = Random(3);
    let lens =
        Lens::new(LensModel::Fisheye, [350.0; 2], [960.0, 600.0], [0.01, 0.0, 0.0, 0.0, 0.0]);
    let poses: Vec<Pose> = (0..14)
        .map(|k| {
            // around the axis, up to 75 degrees off it, facing the camera
            let off = if k < 2 { 5.0 } else { 30.0 + 15.0 * f64::from(k % 4) };
            let around = Rotation3::new(Vector3::z() * f64::from(k) * 0.9);
            let outward = around * Rotation3::new(Vector3::y() * f64::to_radians(off));
            let turn = Rotation3::new(Vector3::new(0.4, -0.3, 0.2) * f64::from(k % 3 - 1));
            let facing = pose(&board(), [0.0; 3], [0.0, 0.0, 260.0]);
            let middle = Vector3::new(0.0, 0.0, 260.0);
            Pose {
                rotation: (outward * turn).into_inner() * facing.rotation,
                translation_mm: outward * (middle + turn * (facing.translation_mm - middle)),
            }
        })
        .collect();
    let images = views(&lens, &poses, &mut random);
    assert_recovers(&lens, &calibrate(&images, LensModel::Fisheye).expect("good views"));
}

#[test]
fn a_data_sheet_is_a_start_and_is_checked() {
    let mut random = Random(4);
    let images = views(&brown(), &poses(16, &mut random), &mut random);
    let from = |focal_px: f64| {
        let start = LensStart::FocalPx(focal_px);
        calibrate_lens(&board(), SIZE, &images, LensModel::Brown, start, BoardShape::Estimated)
            .expect("good views")
    };
    assert_recovers(&brown(), &from(1000.0));
    let doubted = from(1500.0);
    assert_recovers(&brown(), &doubted);
    assert!(doubted.warnings.iter().any(|w| w.contains("data sheet")), "{:?}", doubted.warnings);
}

#[test]
fn a_bent_board_is_noticed_and_its_shape_estimated() {
    let mut random = Random(5);
    let board = board();
    let images: Vec<BoardImage> = poses(16, &mut random)
        .iter()
        .map(|pose| {
            let mut image = seen(&board, &brown(), pose, NOISE_PX, &mut random);
            for corner in &mut image.corners {
                // bowed by 2 mm along the longer side
                let part = corner.column as f64 / 4.0 - 1.0;
                let bent = board.place_mm(corner).push(2.0 * (1.0 - part * part));
                let at = brown().project(pose.apply(bent)).expect("in front");
                corner.at.x = at.x + NOISE_PX * random.normal();
                corner.at.y = at.y + NOISE_PX * random.normal();
            }
            image
        })
        .collect();
    let found = calibrate(&images, LensModel::Brown).expect("good views");
    assert_recovers(&brown(), &found);
    assert!(found.warnings.iter().any(|w| w.contains("not flat")), "{:?}", found.warnings);
    let start = LensStart::Unknown;
    let flat = calibrate_lens(&board, SIZE, &images, LensModel::Brown, start, BoardShape::Flat)
        .expect("a result");
    assert!(flat.rms_px > 3.0 * found.rms_px, "{} {}", flat.rms_px, found.rms_px);
}

#[test]
fn one_corner_off_by_20_px_does_no_harm() {
    let mut random = Random(6);
    let mut images = views(&brown(), &poses(16, &mut random), &mut random);
    images[3].corners[20].at.x += 20.0;
    let found = calibrate(&images, LensModel::Brown).expect("good views");
    assert_recovers(&brown(), &found);
    assert_eq!(found.views.iter().map(|v| v.outliers).sum::<usize>(), 1);
    assert_eq!(found.views[3].outliers, 1);
}

#[test]
fn a_view_that_does_not_belong_is_rejected_with_its_reason() {
    let mut random = Random(7);
    let mut images = views(&brown(), &poses(16, &mut random), &mut random);
    // The camera moved while this one was read out, row by row.
    for corner in &mut images[5].corners {
        corner.at.x += 0.02 * (corner.at.y - 600.0) + (corner.at.y / 40.0).sin();
    }
    let found = calibrate(&images, LensModel::Brown).expect("good views");
    assert_recovers(&brown(), &found);
    let reason = found.views[5].rejected.as_ref().expect("rejected");
    assert!(reason.contains("px"), "{reason}");
    assert_eq!(found.views.iter().filter(|v| v.rejected.is_some()).count(), 1);
}

#[test]
fn a_view_smeared_by_motion_is_rejected() {
    let mut random = Random(8);
    let mut images = views(&brown(), &poses(12, &mut random), &mut random);
    images[2].blur_px = [0.8, 5.0];
    let found = calibrate(&images, LensModel::Brown).expect("good views");
    assert!(found.views[2].rejected.as_ref().is_some_and(|r| r.contains("motion")));
    assert_recovers(&brown(), &found);
}

#[test]
fn two_views_are_too_few() {
    let mut random = Random(9);
    let images = views(&brown(), &poses(2, &mut random), &mut random);
    assert_refused(calibrate(&images, LensModel::Brown), &["2 usable views", "at least 3"]);
}

#[test]
fn no_view_at_all_is_too_few() {
    assert_refused(calibrate(&[], LensModel::Fisheye), &["0 usable views"]);
}

#[test]
fn parallel_views_are_refused() {
    let mut random = Random(10);
    for angles in [[0.0; 3], [25.0, 10.0, 0.0]] {
        let poses: Vec<Pose> = (0..12)
            .map(|k| {
                let (u, v) = (f64::from(k % 4) - 1.5, f64::from(k / 4) - 1.0);
                let z = 350.0 + 20.0 * f64::from(k);
                let turned = [angles[0], angles[1], f64::from(k)];
                let parallel =
                    pose(&board(), [turned[0], turned[1], 0.0], [130.0 * u, 80.0 * v, z]);
                let in_plane = Rotation3::new(Vector3::z() * turned[2].to_radians());
                Pose { rotation: parallel.rotation * in_plane.into_inner(), ..parallel }
            })
            .collect();
        let images = views(&brown(), &poses, &mut random);
        assert_refused(calibrate(&images, LensModel::Brown), &["tilted"]);
    }
}

#[test]
fn the_same_view_many_times_is_refused() {
    let mut random = Random(11);
    let one = pose(&board(), [30.0, 20.0, 0.0], [0.0, 0.0, 400.0]);
    let images = views(&brown(), &[one; 10], &mut random);
    assert_refused(calibrate(&images, LensModel::Brown), &["alike"]);
}

#[test]
fn a_copy_of_a_view_adds_nothing() {
    let mut random = Random(17);
    let images = views(&brown(), &poses(12, &mut random), &mut random);
    let once = calibrate(&images, LensModel::Brown).expect("good views");
    let twice = calibrate(&[&images[..], &images[..3]].concat(), LensModel::Brown);
    let twice = twice.expect("good views");
    assert_eq!(once.sigma[0].to_bits(), twice.sigma[0].to_bits());
    let reason = twice.views[13].rejected.as_ref().expect("rejected");
    assert_eq!(reason, "a copy of view 2");
}

#[test]
fn stretched_images_are_refused() {
    let mut random = Random(12);
    let stretched = focal(1019.3, 1.45 * 1019.3);
    let poses: Vec<Pose> = poses(12, &mut random);
    let images = views(&stretched, &poses, &mut random);
    assert_refused(calibrate(&images, LensModel::Brown), &["fy / fx = 1.45", "stretched"]);
}

#[test]
fn slightly_stretched_images_are_warned_about() {
    let mut random = Random(13);
    let stretched = focal(1019.3, 1.04 * 1019.3);
    let images = views(&stretched, &poses(12, &mut random), &mut random);
    let found = calibrate(&images, LensModel::Brown).expect("a result");
    assert!(found.warnings.iter().any(|w| w.contains("stretched")), "{:?}", found.warnings);
}

#[test]
fn boards_in_one_part_of_the_image_are_warned_about() {
    let mut random = Random(14);
    let poses: Vec<Pose> = (0..12)
        .map(|_| {
            let angles = [random.between([-40.0, 40.0]), random.between([-40.0, 40.0]), 0.0];
            pose(&board(), angles, [-170.0, -90.0, 500.0])
        })
        .collect();
    let images = views(&brown(), &poses, &mut random);
    let found = calibrate(&images, LensModel::Brown).expect("a result");
    assert!(found.warnings.iter().any(|w| w.contains("bottom right")), "{:?}", found.warnings);
}

#[test]
fn a_mirrored_image_mirrors_the_principal_point() {
    let mut random = Random(15);
    let board = board();
    let mirrored: Vec<BoardImage> = views(&brown(), &poses(16, &mut random), &mut random)
        .into_iter()
        .map(|mut image| {
            for corner in &mut image.corners {
                corner.at.x = SIZE[0] as f64 - 1.0 - corner.at.x;
                // as the finder names them: columns and rows turn clockwise
                corner.column = board.columns - 1 - corner.column;
            }
            image
        })
        .collect();
    let found = calibrate(&mirrored, LensModel::Brown).expect("good views");
    let expected = SIZE[0] as f64 - 1.0 - brown().cx_px;
    assert!((found.lens.cx_px - expected).abs() < 5.0 * found.sigma[2], "{}", found.lens.cx_px);
}

#[test]
fn two_cameras_in_one_set_are_noticed() {
    let mut random = Random(16);
    let mut images = views(&brown(), &poses(6, &mut random), &mut random);
    images.extend(views(&focal(1500.0, 1500.0), &poses(6, &mut random), &mut random));
    let warnings = match calibrate(&images, LensModel::Brown) {
        Err(error) => error.to_string(),
        Ok(found) => found.warnings.join("\n"),
    };
    assert!(warnings.contains("of no use") || warnings.contains("corners are off"), "{warnings}");
}

#[test]
fn a_board_behind_the_camera_has_no_picture() {
    let behind = pose(&board(), [10.0, 0.0, 0.0], [0.0, 0.0, -400.0]);
    assert!(scene::corners(&board(), &brown(), &behind).is_none());
}

/// As a program that turns pictures by 180 degrees leaves it: the finder names its corners alike.
fn turn(image: &mut BoardImage) {
    for corner in &mut image.corners {
        corner.at.x = SIZE[0] as f64 - 1.0 - corner.at.x;
        corner.at.y = SIZE[1] as f64 - 1.0 - corner.at.y;
    }
}

#[test]
fn stills_turned_by_180_degrees_give_the_calibration_of_the_unturned_set() {
    let mut random = Random(18);
    let unturned = views(&brown(), &poses(16, &mut random), &mut random);
    let truth = calibrate(&unturned, LensModel::Brown).expect("good views");
    for is_turned in [
        |k: usize| k == 5,
        |k: usize| k < 7,
        |k: usize| k.is_multiple_of(3),
        // Of two halves the first view's kind is taken as right.
        |k: usize| k % 2 == 1,
    ] {
        let mut images = unturned.clone();
        let of_those = images.iter_mut().enumerate().filter(|(k, _)| is_turned(*k));
        of_those.for_each(|(_, image)| turn(image));
        let found = calibrate(&images, LensModel::Brown).expect("good views");
        let told: Vec<usize> = (0..16).filter(|&k| found.views[k].is_turned).collect();
        assert_eq!(told, (0..16).filter(|&k| is_turned(k)).collect::<Vec<_>>());
        assert!(found.views.iter().all(|v| v.rejected.is_none()));
        let pairs = found.lens.parameters().into_iter().zip(truth.lens.parameters());
        for (k, (a, b)) in pairs.enumerate() {
            // Rounding: the fits start elsewhere.
            assert!((a - b).abs() < 1e-3 * truth.sigma[k].max(1e-9), "parameter {k}: {a} for {b}");
        }
        let warned = found.warnings.iter().any(|w| w.contains("turned back: view "));
        assert!(warned, "{:?}", found.warnings);
    }
    assert!(!truth.views.iter().any(|v| v.is_turned));
}

#[test]
fn an_error_that_is_wild_for_the_resolution_is_warned_about() {
    let mut random = Random(19);
    let poses = poses(12, &mut random);
    // The same error is nothing unusual in an image of three times the size.
    for (scale, wild) in [(1.0, true), (1.0 / 3.0, false)] {
        let images: Vec<BoardImage> =
            poses.iter().map(|p| seen(&board(), &brown(), p, scale * 1.0, &mut random)).collect();
        let found = calibrate(&images, LensModel::Brown).expect("a result");
        let warned =
            found.warnings.iter().any(|w| w.contains("too much for images of 1920 x 1200"));
        assert_eq!(warned, wild, "rms {}: {:?}", found.rms_px, found.warnings);
    }
}
