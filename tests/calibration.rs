//! Calibration against known truth: round trips, then one degenerate case a test.

#[path = "common/chessboard.rs"]
mod scene;

use beltgauge::camera::calibrate::{
    BeltCalibration, BeltStill, BoardShape, LensCalibration, LensStart, Pose, SurveyedPoint,
    calibrate_belt, calibrate_lens, calibrate_points,
};
use beltgauge::camera::chessboard::{BoardImage, Chessboard};
use beltgauge::camera::{CalibratedLens, Camera, Lens, LensModel, LensSigmaTable};
use beltgauge::error::Result;
use beltgauge::source::synthetic::Random;
use beltgauge::units::RawPx;
use nalgebra::{Matrix3, Rotation3, Vector3};
use scene::{pose, seen};

const SIZE: [usize; 2] = [1920, 1200];
/// What the finder reaches in a good image.
const NOISE_PX: f64 = 0.05;

fn board() -> Chessboard {
    Chessboard::new([9, 6], 25.0)
}

fn brown() -> Lens {
    Lens::new(
        LensModel::Brown,
        [1019.3, 1019.9],
        [940.2, 599.1],
        [-0.181, 0.080, 0.0005, -0.0004, -0.008],
    )
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

fn assert_refused<T: std::fmt::Debug>(result: Result<T>, words: &[&str]) {
    let error = result.expect_err("must be refused").to_string();
    for word in words {
        assert!(error.contains(word), "no {word:?} in: {error}");
    }
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

// --- the belt

/// A camera 1508 mm above the belt, tilted; X along travel.
fn camera() -> Camera {
    let down = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let tilt = Rotation3::new(Vector3::new(4.0, 1.5, 12.0) * f64::to_radians(1.0));
    let rotation = tilt.into_inner() * down;
    Camera {
        image_size_px: SIZE,
        lens: brown(),
        camera_from_belt: rotation,
        translation_mm: -(rotation * Vector3::new(0.0, 0.0, 1508.0)),
    }
}

/// A board lying on the belt, its corner (0, 0) at a place, turned; `thickness_mm` thick.
fn on_belt(at_mm: [f64; 2], turn_deg: f64, thickness_mm: f64, random: &mut Random) -> BoardImage {
    let camera = camera();
    // Columns along X, rows along -Y: clockwise seen from above.
    let flat = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let turned = Rotation3::new(Vector3::z() * turn_deg.to_radians()).into_inner() * flat;
    let place = Vector3::new(at_mm[0], at_mm[1], thickness_mm);
    let pose = Pose {
        rotation: camera.camera_from_belt * turned,
        translation_mm: camera.camera_from_belt * place + camera.translation_mm,
    };
    seen(&belt_board(), &brown(), &pose, NOISE_PX, random)
}

/// A larger board: seen from 1.5 m it determines the plane.
fn belt_board() -> Chessboard {
    Chessboard::new([9, 6], 60.0)
}

fn lens_file() -> CalibratedLens {
    CalibratedLens { image_size_px: SIZE, lens: brown(), sigma: None }
}

fn belt(images: &[BoardImage], pass: usize, thickness_mm: f64) -> Result<BeltCalibration> {
    let names: Vec<String> = (0..images.len()).map(|k| format!("belt_{k:02}.png")).collect();
    let stills: Vec<BeltStill> =
        names.iter().zip(images).map(|(name, board)| BeltStill { name, board }).collect();
    let (carried, elsewhere) = stills.split_at(pass);
    calibrate_belt(&belt_board(), &lens_file(), carried, elsewhere, thickness_mm)
}

/// Tilt and travel direction against the truth, degrees; height, mm.
fn belt_errors(found: &Camera) -> [f64; 3] {
    let turn = found.camera_from_belt.transpose() * camera().camera_from_belt;
    [
        found.centre_in_belt().z - camera().centre_in_belt().z,
        turn[(0, 2)].hypot(turn[(1, 2)]).to_degrees(),
        turn[(1, 0)].to_degrees(),
    ]
}

fn assert_belt(found: &BeltCalibration) {
    let [height, tilt, travel] = belt_errors(&found.camera);
    assert!(height.abs() < 5.0 * found.sigma_height_mm, "{height} {}", found.sigma_height_mm);
    assert!(tilt < 5.0 * found.sigma_tilt_deg, "{tilt} {}", found.sigma_tilt_deg);
    let sigma = found.sigma_travel_deg.expect("from a pass");
    assert!(travel.abs() < 5.0 * sigma, "{travel} {sigma}");
    assert!(found.sigma_height_mm < 0.3 && found.sigma_tilt_deg < 0.02 && sigma < 0.02);
    let centre = found.camera.centre_in_belt();
    assert!(centre.x.hypot(centre.y) < 1e-9, "the origin is not under the camera");
}

fn pass(random: &mut Random) -> Vec<BoardImage> {
    [-600.0, -150.0, 250.0].map(|x| on_belt([x, 150.0], 20.0, 0.0, random)).to_vec()
}

#[test]
fn a_carried_board_gives_plane_and_travel() {
    let mut random = Random(20);
    let found = belt(&pass(&mut random), 3, 0.0).expect("a pass");
    assert_belt(&found);
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
    // 5 sigma of a way that is measured to a tenth of a mm
    assert!((found.travel_mm[2] - 850.0).abs() < 0.5, "{:?}", found.travel_mm);
}

#[test]
fn travel_is_where_the_board_went_not_where_it_points() {
    let mut random = Random(21);
    let images: Vec<BoardImage> =
        [-600.0, -150.0, 250.0].map(|x| on_belt([x, 150.0], 200.0, 0.0, &mut random)).to_vec();
    assert_belt(&belt(&images, 3, 0.0).expect("a pass"));
}

#[test]
fn a_thick_board_lies_above_the_belt() {
    let mut random = Random(22);
    let images: Vec<BoardImage> =
        [-600.0, -150.0, 250.0].map(|x| on_belt([x, 150.0], 5.0, 18.0, &mut random)).to_vec();
    assert_belt(&belt(&images, 3, 18.0).expect("a pass"));
    let [height, ..] = belt_errors(&belt(&images, 3, 0.0).expect("a pass").camera);
    assert!((height + 18.0).abs() < 0.5, "{height}");
}

#[test]
fn one_still_gives_the_plane_and_says_what_is_missing() {
    let mut random = Random(23);
    let found = belt(&pass(&mut random)[..1], 1, 0.0).expect("a plane");
    let [height, tilt, _] = belt_errors(&found.camera);
    assert!(height.abs() < 5.0 * found.sigma_height_mm && tilt < 5.0 * found.sigma_tilt_deg);
    assert_eq!(found.sigma_travel_deg, None);
    assert!(found.warnings[0].contains("direction of travel"), "{:?}", found.warnings);
    // +X along the image's rows
    let along = found.camera.camera_from_belt * Vector3::x();
    assert!(along.x > 0.9 && along.y.abs() < 1e-9, "{along}");
}

#[test]
fn stills_laid_elsewhere_make_the_plane_surer() {
    let mut random = Random(24);
    let mut images = pass(&mut random);
    let alone = belt(&images, 3, 0.0).expect("a pass");
    images.push(on_belt([-100.0, 400.0], 100.0, 0.0, &mut random));
    images.push(on_belt([-200.0, -150.0], -30.0, 0.0, &mut random));
    let more = belt(&images, 3, 0.0).expect("a pass");
    assert_belt(&more);
    assert!(more.sigma_tilt_deg < 0.7 * alone.sigma_tilt_deg);
}

#[test]
fn a_board_that_was_turned_is_no_pass() {
    let mut random = Random(25);
    let mut images = pass(&mut random);
    images.push(on_belt([400.0, 150.0], 110.0, 0.0, &mut random));
    assert_refused(belt(&images, 4, 0.0), &["one pass", "turned by", "belt_03.png", "--elsewhere"]);
}

#[test]
fn a_board_laid_beside_its_way_is_no_pass() {
    let mut random = Random(26);
    let mut images = pass(&mut random);
    images[1] = on_belt([-150.0, 190.0], 20.0, 0.0, &mut random);
    assert_refused(belt(&images, 3, 0.0), &["one pass", "beside the line", "belt_01.png"]);
}

#[test]
fn a_wrong_lens_is_warned_about() {
    let mut random = Random(36);
    let images = pass(&mut random);
    let names = ["a", "b", "c"];
    let stills: Vec<BeltStill> =
        names.iter().zip(&images).map(|(name, board)| BeltStill { name, board }).collect();
    let lens = CalibratedLens { lens: focal(1250.0, 1250.0), ..lens_file() };
    // Refused as not flat or no pass, or warned about.
    if let Ok(found) = calibrate_belt(&belt_board(), &lens, &stills, &[], 0.0) {
        assert!(found.warnings.iter().any(|w| w.contains("--lens")), "{:?}", found.warnings);
    }
}

#[test]
fn no_still_is_refused() {
    assert_refused(belt(&[], 0, 0.0), &["no still"]);
}

#[test]
fn stills_out_of_order_are_no_pass() {
    let mut random = Random(27);
    let mut images = pass(&mut random);
    images.swap(1, 2);
    assert_refused(belt(&images, 3, 0.0), &["one pass", "further along", "order of time"]);
}

#[test]
fn a_board_that_did_not_move_is_no_pass() {
    let mut random = Random(28);
    let images = [0, 1].map(|_| on_belt([-300.0, 150.0], 20.0, 0.0, &mut random));
    assert_refused(belt(&images, 2, 0.0), &["one pass", "moved only"]);
}

#[test]
fn a_board_held_above_the_belt_is_no_pass() {
    let mut random = Random(29);
    let mut images = pass(&mut random);
    images[2] = on_belt([250.0, 150.0], 20.0, 60.0, &mut random);
    // Lifted, it is out of the plane of the others, or off their line: both are said.
    let error = belt(&images, 3, 0.0).expect_err("must be refused").to_string();
    assert!(error.contains("lie in one plane") || error.contains("one pass"), "{error}");
}

// --- surveyed points

fn survey(places: &[[f64; 3]], noise_px: f64, random: &mut Random) -> Vec<SurveyedPoint> {
    let camera = camera();
    places
        .iter()
        .map(|&place| {
            let in_belt = Vector3::from(place);
            let at = camera.project(in_belt).expect("in view");
            // The surveyor has another origin.
            let in_belt_mm = in_belt + Vector3::new(1000.0, 200.0, 0.0);
            let mut moved = || noise_px * random.normal();
            SurveyedPoint { in_belt_mm, at: RawPx { x: at.x + moved(), y: at.y + moved() } }
        })
        .collect()
}

const CORNERS: [[f64; 3]; 4] =
    [[-600.0, -380.0, 0.0], [600.0, -380.0, 0.0], [600.0, 380.0, 0.0], [-600.0, 380.0, 0.0]];
const IN_SPACE: [[f64; 3]; 7] = [
    [-600.0, -380.0, 0.0],
    [600.0, -300.0, 150.0],
    [500.0, 380.0, 20.0],
    [-600.0, 300.0, 220.0],
    [0.0, 0.0, 300.0],
    [100.0, -350.0, 0.0],
    [-200.0, 100.0, 80.0],
];

fn points(places: &[[f64; 3]], noise_px: f64) -> Result<Camera> {
    let points = survey(places, noise_px, &mut Random(30));
    calibrate_points(&lens_file(), &points).map(|found| {
        // 0.1 px of noise on a handful of points moves the origin by a mm at most
        assert!((found.origin_mm[0] - 1000.0).abs() < 2.0, "{:?}", found.origin_mm);
        assert!((found.origin_mm[1] - 200.0).abs() < 2.0, "{:?}", found.origin_mm);
        found.camera
    })
}

#[test]
fn exact_points_give_the_exact_pose() {
    for places in [&CORNERS[..], &IN_SPACE[..], &IN_SPACE[..6]] {
        let [height, tilt, travel] = belt_errors(&points(places, 0.0).expect("a pose"));
        // The refinement ends at steps of 1e-10.
        assert!(
            height.abs() < 1e-4 && tilt < 1e-5 && travel.abs() < 1e-5,
            "{height} {tilt} {travel}"
        );
    }
}

#[test]
fn points_a_tenth_of_a_pixel_off_give_the_pose_to_a_millimetre() {
    for places in [&CORNERS[..], &IN_SPACE[..]] {
        let [height, tilt, travel] = belt_errors(&points(places, 0.1).expect("a pose"));
        // 0.1 px is 0.15 mm on the belt; the lever from 0.8 m of points to 1.5 m of height is 2.
        assert!(
            height.abs() < 1.0 && tilt < 0.05 && travel.abs() < 0.05,
            "{height} {tilt} {travel}"
        );
    }
}

#[test]
fn points_on_a_plane_above_the_belt_will_do() {
    let raised = CORNERS.map(|[x, y, _]| [x, y, 120.0]);
    let [height, tilt, _] = belt_errors(&points(&raised, 0.0).expect("a pose"));
    assert!(height.abs() < 1e-4 && tilt < 1e-5, "{height} {tilt}");
}

#[test]
fn three_points_are_too_few() {
    assert_refused(points(&CORNERS[..3], 0.0), &["3 points on one plane", "4 points on one plane"]);
}

#[test]
fn five_points_in_space_are_too_few() {
    assert_refused(points(&IN_SPACE[..5], 0.0), &["5 points in space", "6 in space"]);
}

#[test]
fn points_on_one_line_are_refused() {
    let line: Vec<[f64; 3]> = (0..8).map(|k| [150.0 * f64::from(k) - 500.0, 0.0, 0.0]).collect();
    assert_refused(points(&line, 0.0), &["on one line"]);
    assert_refused(points(&[[0.0; 3]; 5], 0.0), &["on one line"]);
}

#[test]
fn a_wrong_point_is_named() {
    let mut points = survey(&IN_SPACE, 0.05, &mut Random(31));
    points[4].at.x += 15.0;
    assert_refused(calibrate_points(&lens_file(), &points), &["point 5 disagrees"]);
}

#[test]
fn all_points_but_one_on_the_belt_will_do() {
    let mut places = CORNERS.to_vec();
    places.extend([
        [0.0, -300.0, 0.0],
        [-300.0, 100.0, 0.0],
        [300.0, 200.0, 0.0],
        [0.0, 0.0, 200.0],
    ]);
    let [height, tilt, _] = belt_errors(&points(&places, 0.0).expect("a pose"));
    assert!(height.abs() < 1e-4 && tilt < 1e-5, "{height} {tilt}");
}

#[test]
fn a_mirrored_survey_is_refused() {
    let mut points = survey(&CORNERS, 0.0, &mut Random(32));
    for point in &mut points {
        point.in_belt_mm.y = -point.in_belt_mm.y;
    }
    assert_refused(calibrate_points(&lens_file(), &points), &["above the belt", "signs"]);
}

#[test]
fn a_point_outside_the_image_is_named() {
    let mut points = survey(&CORNERS, 0.0, &mut Random(33));
    points[2].at.y = 1300.0;
    assert_refused(calibrate_points(&lens_file(), &points), &["point 3", "1300", "below 1200"]);
}

#[test]
fn points_that_disagree_are_refused() {
    let mut points = survey(&CORNERS, 0.0, &mut Random(34));
    points[1].at.x -= 200.0;
    assert_refused(calibrate_points(&lens_file(), &points), &["disagree", "px"]);
}

#[test]
fn the_uncertainty_of_the_focal_length_is_inherited() {
    let sigma = LensSigmaTable::new(LensModel::Brown, [10.193; 9]); // 1 % of fx
    let lens = CalibratedLens { sigma: Some(sigma), ..lens_file() };
    let points = survey(&CORNERS, 0.0, &mut Random(35));
    let found = calibrate_points(&lens, &points).expect("a pose");
    assert!((15.0..17.0).contains(&found.sigma_height_mm), "{}", found.sigma_height_mm);
}

#[test]
fn a_point_right_under_a_fisheye_is_like_others() {
    let lens =
        Lens::new(LensModel::Fisheye, [560.0; 2], [960.0, 600.0], [0.02, 0.0, 0.0, 0.0, 0.0]);
    let calibrated = CalibratedLens { image_size_px: SIZE, lens: lens.clone(), sigma: None };
    let down = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let mut places = CORNERS.to_vec();
    places.push([0.0; 3]);
    let seen = |place: &[f64; 3]| {
        let in_belt_mm = Vector3::from(*place);
        let at = lens.project(down * in_belt_mm + Vector3::new(0.0, 0.0, 1500.0));
        SurveyedPoint { in_belt_mm, at: at.expect("in view") }
    };
    let points: Vec<SurveyedPoint> = places.iter().map(seen).collect();
    let found = calibrate_points(&calibrated, &points).expect("a pose");
    assert!((found.camera.centre_in_belt().z - 1500.0).abs() < 1e-4);
}

#[test]
fn a_board_behind_the_camera_has_no_picture() {
    let behind = pose(&board(), [10.0, 0.0, 0.0], [0.0, 0.0, -400.0]);
    assert!(scene::corners(&board(), &brown(), &behind).is_none());
}
