//! Finding the chessboard: rendered boards with known corners, one difficulty a test.

#[path = "common/chessboard.rs"]
mod scene;

use beltgauge::camera::chessboard::{BoardImage, Chessboard, NotFound};
use beltgauge::camera::{Lens, LensModel};
use beltgauge::source::Still;
use beltgauge::source::synthetic::Random;
use beltgauge::units::RawPx;
use scene::{Shot, corners, photograph, pose};

const VGA: [usize; 2] = [640, 480];

fn board() -> Chessboard {
    Chessboard::new([9, 6], 25.0)
}

fn pinhole([width, height]: [usize; 2]) -> Lens {
    let centre = [0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0)];
    Lens::new(LensModel::Brown, [0.9 * width as f64; 2], centre, [0.0; 5])
}

fn find(board: &Chessboard, still: &Still) -> Result<BoardImage, NotFound> {
    board.find(still.plane().expect("whole"))
}

/// Photograph the board, find it, and return the root mean square distance of its corners from
/// the truth. All of them must be there, each under its own name.
fn error_px(board: &Chessboard, lens: &Lens, angles: [f64; 3], at: [f64; 3], shot: Shot) -> f64 {
    let pose = pose(board, angles, at);
    let truth = corners(board, lens, &pose).expect("in front");
    let still = photograph(board, lens, &pose, shot);
    let found = find(board, &still).unwrap_or_else(|e| panic!("{angles:?} {at:?}: {e:?}"));
    assert_eq!(found.corners.len(), truth.len(), "{angles:?}");
    let squares = found.corners.iter().zip(&truth).map(|(a, b)| {
        assert_eq!((a.column, a.row), (b.column, b.row));
        (a.at.x - b.at.x).powi(2) + (a.at.y - b.at.y).powi(2)
    });
    (squares.sum::<f64>() / truth.len() as f64).sqrt()
}

// Noise of 2 grey levels at a contrast of 170 moves a corner with 40 px of edges by a few
// thousandths of a px; sampling at sixteenths of a pixel leaves up to 0.02 px.
const SHARP_PX: f64 = 0.03;

#[test]
fn a_plain_view_to_hundredths_of_a_pixel() {
    let error = error_px(&board(), &pinhole(VGA), [0.0; 3], [0.0, 0.0, 400.0], Shot::sharp(VGA));
    assert!(error < SHARP_PX, "{error:.4} px");
}

#[test]
fn every_orientation_names_the_corners_alike() {
    for turn in (0..360).step_by(30) {
        let angles = [15.0, -20.0, f64::from(turn)];
        let error = error_px(&board(), &pinhole(VGA), angles, [0.0, 0.0, 420.0], Shot::sharp(VGA));
        assert!(error < SHARP_PX, "turned by {turn} degrees: {error:.4} px");
    }
}

#[test]
fn perspective_up_to_60_degrees() {
    for angles in [[60.0, 0.0, 0.0], [0.0, 60.0, 0.0], [-60.0, 0.0, 40.0], [45.0, -45.0, 20.0]] {
        let error = error_px(&board(), &pinhole(VGA), angles, [0.0, 0.0, 420.0], Shot::sharp(VGA));
        assert!(error < 2.0 * SHARP_PX, "{angles:?}: {error:.4} px"); // squares half as high
    }
}

#[test]
fn strong_barrel_distortion() {
    let lens =
        Lens::new(LensModel::Brown, [380.0; 2], [320.0, 240.0], [-0.35, 0.15, 0.0, 0.0, -0.03]);
    for at in [[0.0, 0.0, 220.0], [-110.0, -60.0, 260.0], [120.0, 70.0, 280.0]] {
        let error = error_px(&board(), &lens, [10.0, 15.0, 5.0], at, Shot::sharp(VGA));
        // The lens bends edges inside the window by some hundredths of a px.
        assert!(error < 3.0 * SHARP_PX, "{at:?}: {error:.4} px");
    }
}

#[test]
fn fisheye_of_170_degrees() {
    let lens = Lens::new(
        LensModel::Fisheye,
        [220.0; 2],
        [320.0, 240.0],
        [0.02, -0.006, 0.001, -0.0002, 0.0],
    );
    for at in [[0.0, 0.0, 130.0], [-180.0, 0.0, 120.0], [150.0, 90.0, 120.0]] {
        let turn = f64::to_degrees(f64::atan2(at[0], at[2]));
        let error = error_px(&board(), &lens, [0.0, turn * 0.7, 0.0], at, Shot::sharp(VGA));
        assert!(error < 4.0 * SHARP_PX, "{at:?}: {error:.4} px"); // edges bend more
    }
}

#[test]
fn blur_of_several_pixels() {
    for blur_px in [2.0, 4.0] {
        let shot = Shot { blur_px, ..Shot::sharp([1280, 960]) };
        let error =
            error_px(&board(), &pinhole([1280, 960]), [10.0, 20.0, 15.0], [0.0, 0.0, 420.0], shot);
        assert!(error < 2.0 * SHARP_PX, "blur {blur_px} px: {error:.4} px"); // wide edges, more noise
    }
}

#[test]
fn low_contrast_in_noise() {
    let shot = Shot { greys: [100.0, 118.0], noise: 3.0, ..Shot::sharp(VGA) };
    let error = error_px(&board(), &pinhole(VGA), [10.0, -10.0, 8.0], [0.0, 0.0, 400.0], shot);
    assert!(error < 0.3, "{error:.4} px"); // contrast is six times the noise, not eighty
}

#[test]
fn uneven_light() {
    let shot = Shot { light_right: 0.12, ..Shot::sharp(VGA) };
    let error = error_px(&board(), &pinhole(VGA), [0.0, 20.0, 8.0], [0.0, 0.0, 380.0], shot);
    assert!(error < 2.0 * SHARP_PX, "{error:.4} px"); // a tenth of the light at one end
}

#[test]
fn a_board_that_runs_over_the_border() {
    // The inner corners are in the image, the outer squares partly outside.
    let angles = [0.0, 0.0, 3.0];
    let error = error_px(&board(), &pinhole(VGA), angles, [0.0, 0.0, 208.0], Shot::sharp(VGA));
    assert!(error < SHARP_PX, "{error:.4} px");
    let at = [-74.0, -56.0, 330.0];
    let error = error_px(&board(), &pinhole(VGA), angles, at, Shot::sharp(VGA));
    assert!(error < SHARP_PX, "{error:.4} px");
}

#[test]
fn a_small_far_board() {
    // Squares of 9 px.
    let error =
        error_px(&board(), &pinhole(VGA), [20.0, 10.0, 5.0], [0.0, 0.0, 1600.0], Shot::sharp(VGA));
    assert!(error < 3.0 * SHARP_PX, "{error:.4} px"); // a fifth of the edges
}

#[test]
fn squares_of_five_px() {
    let (board, lens) = (board(), pinhole(VGA));
    for angles in [[0.0; 3], [0.0, 0.0, 20.0], [5.0, 5.0, -30.0]] {
        let error = error_px(&board, &lens, angles, [40.0, 30.0, 2880.0], Shot::sharp(VGA));
        assert!(error < 6.0 * SHARP_PX, "{angles:?}: {error:.4} px"); // 22 pixels a corner
    }
}

#[test]
fn a_board_with_markers_in_its_squares_is_named() {
    let (board, lens) = (board(), pinhole(VGA));
    let straight = pose(&board, [0.0; 3], [0.0, 0.0, 400.0]);
    let mut still = photograph(&board, &lens, &straight, Shot::sharp(VGA));
    let first = corners(&board, &lens, &straight).expect("in front")[0].at;
    let square_px = 0.9 * VGA[0] as f64 * board.square_mm / 400.0;
    let mut random = Random(6);
    let bits: [bool; 36 * 70] = std::array::from_fn(|_| random.unit() < 0.5);
    for (k, grey) in still.pixels.iter_mut().enumerate() {
        let at = [(k % VGA[0]) as f64 - first.x, (k / VGA[0]) as f64 - first.y];
        let [i, j] = at.map(|px| (px / square_px).floor() as isize);
        // Six by six cells in the middle seven tenths, the outermost black.
        let cell = at.map(|px| ((px / square_px).rem_euclid(1.0) - 0.15) / 0.7 * 6.0);
        let on_board = (-1..9).contains(&i) && (-1..6).contains(&j);
        if on_board && (i + j).rem_euclid(2) == 1 && cell.iter().all(|c| (0.0..6.0).contains(c)) {
            let [u, v] = cell.map(|c| c as usize);
            let inside = (1..5).contains(&u) && (1..5).contains(&v);
            let number = (j + 1) as usize * 10 + (i + 1) as usize;
            *grey = if inside && bits[36 * number + 6 * v + u] { 200 } else { 30 };
        }
    }
    assert_eq!(find(&board, &still), Err(NotFound::Markers));
    assert_eq!(find(&Chessboard::new([8, 5], 25.0), &still), Err(NotFound::Markers));
}

#[test]
fn five_megapixels() {
    let size = [2592, 1944];
    let error =
        error_px(&board(), &pinhole(size), [25.0, 20.0, 5.0], [0.0, 0.0, 330.0], Shot::sharp(size));
    assert!(error < SHARP_PX, "{error:.4} px");
}

#[test]
fn rows_by_columns_is_the_same_board() {
    let (named, other) = (Chessboard::new([6, 9], 25.0), Chessboard::new([9, 6], 25.0));
    assert_eq!((named.columns, named.rows), (other.columns, other.rows));
    assert_eq!((named.in_order([9, 6]), other.in_order([9, 6])), ("6x9".into(), "9x6".into()));
}

#[test]
fn a_symmetric_board_leads_to_the_right() {
    let board = Chessboard::new([8, 6], 25.0);
    for turn in [0.0, 30.0, 170.0, -100.0] {
        let lens = pinhole(VGA);
        let pose = pose(&board, [10.0, 0.0, turn], [0.0, 0.0, 400.0]);
        let found = find(&board, &photograph(&board, &lens, &pose, Shot::sharp(VGA)))
            .unwrap_or_else(|e| panic!("{turn}: {e:?}"));
        let (first, last) = (found.corners[0].at, found.corners[board.columns - 1].at);
        assert!(last.x > first.x, "{turn}: {first:?} {last:?}");
    }
}

#[test]
fn a_square_board_leads_to_the_right() {
    for side in [6, 7] {
        let (board, lens) = (Chessboard::new([side, side], 25.0), pinhole(VGA));
        for turn in [-80.0, -40.0, 12.0, 54.0, 100.0, 170.0] {
            let pose = pose(&board, [20.0, 10.0, turn], [0.0, 0.0, 400.0]);
            let found = find(&board, &photograph(&board, &lens, &pose, Shot::sharp(VGA)))
                .unwrap_or_else(|e| panic!("{side} {turn}: {e:?}"));
            assert_eq!(found.corners.len(), side * side);
            let direction = board.direction(&found.corners);
            // An odd number of corners tells a quarter turn by its colours, an even one does not.
            let slack = if side == 7 { 90.0 } else { 45.0 };
            let off_deg = direction.y.atan2(direction.x).to_degrees().abs();
            assert!(off_deg < slack + 10.0, "{side} {turn}: {off_deg}"); // perspective
        }
    }
}

#[test]
fn a_symmetric_board_with_hidden_corners_is_named_alike() {
    let (board, lens) = (Chessboard::new([8, 6], 25.0), pinhole(VGA));
    let pose = pose(&board, [0.0, 0.0, 8.0], [-60.0, 0.0, 500.0]);
    let whole = photograph(&board, &lens, &pose, Shot::sharp(VGA));
    let expected = find(&board, &whole).expect("a board");
    for corner in [0, 7] {
        // A thumb on the end of the first row.
        let at = expected.corners[corner].at;
        let mut still = whole.clone();
        for (k, grey) in still.pixels.iter_mut().enumerate() {
            let (x, y) = ((k % VGA[0]) as f64, (k / VGA[0]) as f64);
            if (x - at.x).hypot(y - at.y) < 20.0 {
                *grey = 128;
            }
        }
        let found = find(&board, &still).expect("a board");
        assert!(found.corners.len() < 48);
        for seen in &found.corners {
            let truth = expected.corners[board.index(seen)].at;
            assert!((seen.at.x - truth.x).hypot(seen.at.y - truth.y) < 1.0, "{seen:?} {truth:?}");
        }
    }
}

#[test]
fn the_direction_does_not_depend_on_where_the_board_is_or_what_is_hidden() {
    let (board, lens) = (Chessboard::new([8, 6], 25.0), pinhole(VGA));
    let pose = pose(&board, [0.0, 0.0, 30.0], [-120.0, 80.0, 700.0]);
    let mut seen = corners(&board, &lens, &pose).expect("in front");
    seen.retain(|c| c.column > 0 || c.row > 2); // half of one end is hidden
    let direction = board.direction(&seen);
    let angle_deg = direction.y.atan2(direction.x).to_degrees();
    // The hidden corners tilt it by a few degrees.
    assert!((angle_deg - 30.0).abs() < 8.0, "{angle_deg}");
}

#[test]
fn the_wanted_board_is_found_beside_a_larger_one() {
    let lens = pinhole([1280, 720]);
    let (small, large) = (Chessboard::new([8, 5], 25.0), Chessboard::new([11, 8], 25.0));
    let left = pose(&small, [5.0, 0.0, 4.0], [-180.0, 0.0, 700.0]);
    let right = pose(&large, [0.0, 5.0, -3.0], [170.0, 0.0, 800.0]);
    let soft = Shot { greys: [60.0, 140.0], ..Shot::sharp([1280, 720]) };
    let mut still = photograph(&small, &lens, &left, soft);
    let other = photograph(&large, &lens, &right, Shot::sharp([1280, 720]));
    for (k, grey) in still.pixels.iter_mut().enumerate() {
        if k % 1280 >= 640 {
            *grey = other.pixels[k];
        }
    }
    let found = find(&small, &still).expect("the smaller board");
    assert!(found.corners.iter().all(|c| c.at.x < 640.0));
}

/// A chessboard is its own mirror image, so nothing can tell; but columns and rows turn
/// clockwise, as on a board seen from its printed side.
#[test]
fn a_mirrored_image_is_a_board_too() {
    let (board, lens) = (board(), pinhole(VGA));
    let pose = pose(&board, [20.0, 25.0, 10.0], [0.0, 0.0, 420.0]);
    let mut still = photograph(&board, &lens, &pose, Shot::sharp(VGA));
    for row in still.pixels.chunks_exact_mut(VGA[0]) {
        row.reverse();
    }
    let found = find(&board, &still).expect("a board");
    let at = |column: usize, row: usize| found.corners[row * board.columns + column].at;
    let step = |a: RawPx, b: RawPx| (b.x - a.x, b.y - a.y);
    let (along, across) = (step(at(0, 0), at(8, 0)), step(at(0, 0), at(0, 5)));
    assert!(along.0 * across.1 - along.1 * across.0 > 0.0);
}

#[test]
fn another_board_is_named() {
    let (board, lens) = (board(), pinhole(VGA));
    let pose = pose(&board, [10.0, 5.0, 3.0], [0.0, 0.0, 400.0]);
    let still = photograph(&board, &lens, &pose, Shot::sharp(VGA));
    for wrong in [[8, 6], [10, 7], [8, 5]] {
        let found = find(&Chessboard::new(wrong, 25.0), &still);
        assert_eq!(found, Err(NotFound::AnotherGrid { size: [9, 6], seen: 54 }), "{wrong:?}");
    }
}

#[test]
fn images_without_a_board_hold_none() {
    let mut random = Random(5);
    let pixels = (0..VGA[0] * VGA[1]).map(|_| (255.0 * random.unit()) as u8).collect();
    assert!(find(&board(), &Still { pixels, size_px: VGA }).is_err());
    for (grey, size_px) in [(0, VGA), (255, VGA), (7, [1, 1]), (7, [16, 2000]), (7, [3, 3])] {
        let still = Still { pixels: vec![grey; size_px[0] * size_px[1]], size_px };
        assert_eq!(find(&board(), &still), Err(NotFound::NoGrid), "{size_px:?}");
    }
}

#[test]
fn motion_is_seen_in_the_blur() {
    let (board, lens) = (board(), pinhole(VGA));
    let pose = pose(&board, [0.0; 3], [0.0, 0.0, 400.0]);
    let still = photograph(&board, &lens, &pose, Shot::sharp(VGA));
    let plain = find(&board, &still).expect("a board").blur_px;
    // Along rows, over 9 px: the vertical edges, those along the board's rows, widen.
    let smear = |row: &[u8], x: usize| {
        let sum: u32 = (0..9).map(|k| u32::from(row[(x + k).saturating_sub(4).min(639)])).sum();
        (sum / 9) as u8
    };
    let pixels = still
        .pixels
        .chunks_exact(640)
        .flat_map(|row| (0..640).map(move |x| smear(row, x)))
        .collect();
    let moved = find(&board, &Still { pixels, size_px: VGA }).expect("a board").blur_px;
    assert!((plain[0] - plain[1]).abs() < 0.1, "{plain:?}");
    assert!(moved[1] > 2.0 && moved[0] < 1.3 * plain[0], "{plain:?} {moved:?}");
}
