//! The belt under a camera against known truth: from a board and from surveyed points, then one
//! degenerate case a test.

#[path = "common/chessboard.rs"]
mod scene;

use beltgauge::camera::calibrate::{
    BeltCalibration, BeltStill, Pose, SurveyedPoint, calibrate_belt, calibrate_points,
};
use beltgauge::camera::chessboard::{BoardImage, Chessboard};
use beltgauge::camera::{CalibratedLens, Camera, Lens, LensModel, LensSigmaTable};
use beltgauge::error::Result;
use beltgauge::source::synthetic::Random;
use beltgauge::units::RawPx;
use nalgebra::{Matrix3, Rotation3, Vector3};
use scene::{assert_refused, brown, seen};

const SIZE: [usize; 2] = [1920, 1200];
/// What the finder reaches in a good image.
const NOISE_PX: f64 = 0.05;

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
    lying(&belt_board(), at_mm, turn_deg, thickness_mm, random)
}

fn lying(
    board: &Chessboard,
    at_mm: [f64; 2],
    turn_deg: f64,
    thickness_mm: f64,
    random: &mut Random,
) -> BoardImage {
    let camera = camera();
    // Columns along X, rows along -Y: clockwise seen from above.
    let flat = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let turned = Rotation3::new(Vector3::z() * turn_deg.to_radians()).into_inner() * flat;
    let place = Vector3::new(at_mm[0], at_mm[1], thickness_mm);
    let pose = Pose {
        rotation: camera.camera_from_belt * turned,
        translation_mm: camera.camera_from_belt * place + camera.translation_mm,
    };
    seen(board, &brown(), &pose, NOISE_PX, random)
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
    let long = Lens::new(LensModel::Brown, [1250.0; 2], [940.2, 599.1], brown().distortion);
    let lens = CalibratedLens { lens: long, ..lens_file() };
    // Refused as not flat or no pass, or warned about.
    if let Ok(found) = calibrate_belt(&belt_board(), &lens, &stills, &[], 0.0) {
        assert!(found.warnings.iter().any(|w| w.contains("--lens")), "{:?}", found.warnings);
    }
}

#[test]
fn a_board_that_slipped_is_warned_about_and_costs_certainty() {
    let mut random = Random(37);
    let mut images = pass(&mut random);
    images[1] = on_belt([-150.0, 155.0], 20.0, 0.0, &mut random);
    let found = belt(&images, 3, 0.0).expect("a pass, nearly");
    assert!(found.warnings.iter().any(|w| w.contains("slipped")), "{:?}", found.warnings);
    let [_, _, travel] = belt_errors(&found.camera);
    let sigma = found.sigma_travel_deg.expect("from a pass");
    assert!(sigma > 0.05 && travel.abs() < 5.0 * sigma, "{travel} {sigma}");
}

#[test]
fn the_same_still_twice_is_refused() {
    let mut random = Random(38);
    let mut images = pass(&mut random);
    images.push(images[0].clone());
    assert_refused(belt(&images, 3, 0.0), &["the same still as belt_00.png", "belt_03.png"]);
}

#[test]
fn a_symmetric_board_is_named_alike_in_all_stills() {
    let mut random = Random(39);
    let board = Chessboard::new([8, 6], 60.0);
    let mut images =
        [-600.0, -150.0, 250.0].map(|x| lying(&board, [x, 150.0], 88.0, 0.0, &mut random));
    // Near a quarter turn the finder may take either end for the first.
    for corner in &mut images[1].corners {
        (corner.column, corner.row) = (7 - corner.column, 5 - corner.row);
    }
    let stills = [0, 1, 2].map(|k| BeltStill { name: "still", board: &images[k] });
    assert_belt(&calibrate_belt(&board, &lens_file(), &stills, &[], 0.0).expect("a pass"));
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
