//! What helps to set a camera up, from one of its pictures: focus at five places, exposure, the board.

use super::shots::shrink;
use crate::camera::chessboard::{BoardImage, Chessboard, Corner, NotFound};
use crate::camera::focus;
use crate::config::Config;
use crate::image::{FrameTime, Plane};
use crate::web::{BoardSeen, Piece, Setup, SetupPlace};

/// The whole picture is shrunk by a whole factor until it is no wider and no higher.
const WHOLE_SIDES_PX: [usize; 2] = [1024, 768];
/// A place that is shown one to one, at most.
const PLACE_PX: [usize; 2] = [200, 150];
/// Blur is measured around it: a third of the picture, and no more than this.
const AROUND_PX: [usize; 2] = [480, 360];
/// Middles of the places, in sixths of the picture's sides.
const PLACES_SIXTHS: [[usize; 2]; 5] = [[3, 3], [1, 1], [5, 1], [1, 5], [5, 5]];
/// As white as can be, and black.
const WHITE_FROM: usize = 254;
const BLACK_TO: usize = 1;
/// The size of its squares does not matter for finding a board.
const ANY_SQUARE_MM: f64 = 1.0;

/// What a picture shows, and the pixels of the picture that goes with it: columns, rows, greys.
pub(super) fn look(
    picture: Plane<'_>,
    time: FrameTime,
    board: Option<[usize; 2]>,
    motion_blur_px: Option<f64>,
) -> (Setup, [usize; 2], Vec<u8>) {
    let size_px = [picture.width(), picture.height()];
    let (whole, places) = layout(size_px);
    let columns = places.iter().map(|place| place.at_px[0] + place.size_px[0]).max();
    let canvas_px = [
        whole.size_px[0].max(columns.unwrap_or(0)),
        whole.size_px[1] + places.first().map_or(0, |place| place.size_px[1]),
    ];
    let mut canvas = vec![0; canvas_px[0] * canvas_px[1]];
    for piece in std::iter::once(&whole).chain(&places) {
        lay(picture, piece, &mut canvas, canvas_px[0]);
    }
    let places = places.iter().map(|piece| {
        let around = [0, 1].map(|i| {
            let middle = piece.from_px[i] + piece.size_px[i] / 2;
            let half = (size_px[i] / 3).min(AROUND_PX[i]) / 2;
            [middle.saturating_sub(half), (middle + half).min(size_px[i])]
        });
        SetupPlace { piece: *piece, blur_px: part(picture, around).and_then(focus::blur_px) }
    });
    let greys = histogram(picture);
    let share =
        |counts: &[u32]| counts.iter().sum::<u32>() as f32 / (size_px[0] * size_px[1]) as f32;
    let setup = Setup {
        frame: time.index,
        t_s: time.t_s,
        size_px,
        whole,
        places: places.collect(),
        histogram: std::array::from_fn(|i| share(&greys[16 * i..16 * (i + 1)])),
        white_share: share(&greys[WHITE_FROM..]),
        black_share: share(&greys[..=BLACK_TO]),
        motion_blur_px,
        board: board.map(|corners| seen(picture, corners)),
    };
    (setup, canvas_px, canvas)
}

/// How far the belt moves while a frame is exposed, pixels of the belt view.
pub(super) fn motion_blur_px(config: &Config, mm_per_px: f64) -> Option<f64> {
    let exposure_us = config.camera.exposure_us?;
    Some(config.belt.speed_mm_per_s * exposure_us * 1e-6 / mm_per_px)
}

/// Where the whole picture and the five places go: the places below it, side by side.
fn layout(size_px: [usize; 2]) -> (Piece, Vec<Piece>) {
    let factor = |i: usize| size_px[i].div_ceil(WHOLE_SIDES_PX[i]);
    let shrunk_by = factor(0).max(factor(1)).max(1);
    let whole = Piece {
        from_px: [0; 2],
        at_px: [0; 2],
        size_px: size_px.map(|side| (side / shrunk_by).max(1)),
        shrunk_by,
    };
    let place_px = [0, 1].map(|i| PLACE_PX[i].min(size_px[i] / 3).max(1));
    let place = |k: usize| Piece {
        from_px: [0, 1].map(|i| {
            let middle = PLACES_SIXTHS[k][i] * size_px[i] / 6;
            middle.saturating_sub(place_px[i] / 2)
        }),
        at_px: [k * place_px[0], whole.size_px[1]],
        size_px: place_px,
        shrunk_by: 1,
    };
    (whole, (0..PLACES_SIXTHS.len()).map(place).collect())
}

/// Put a piece of the picture into a larger one.
fn lay(picture: Plane<'_>, piece: &Piece, canvas: &mut [u8], columns: usize) {
    let Piece { from_px, at_px, size_px, shrunk_by } = *piece;
    let to_px = [0, 1].map(|i| from_px[i] + size_px[i] * shrunk_by);
    let mut pixels = vec![0; size_px[0] * size_px[1]];
    shrink(picture, [from_px, to_px], shrunk_by, &mut pixels);
    for (row, from) in pixels.chunks_exact(size_px[0]).enumerate() {
        let first = (at_px[1] + row) * columns + at_px[0];
        canvas[first..first + size_px[0]].copy_from_slice(from);
    }
}

/// A part of a picture: from, to along both sides.
fn part(picture: Plane<'_>, [[x0, x1], [y0, y1]]: [[usize; 2]; 2]) -> Option<Plane<'_>> {
    Plane::new(picture.from(x0, y0), x1 - x0, y1 - y0, picture.stride())
}

fn histogram(picture: Plane<'_>) -> [u32; 256] {
    let mut counts = [0; 256];
    for &grey in (0..picture.height()).flat_map(|y| picture.row(y)) {
        counts[usize::from(grey)] += 1;
    }
    counts
}

/// What the picture shows of a board.
fn seen(picture: Plane<'_>, corners: [usize; 2]) -> BoardSeen {
    let board = Chessboard::new(corners, ANY_SQUARE_MM);
    let (found, size) = match board.find(picture) {
        Ok(image) => return whole_board(&board, &image),
        Err(NotFound::NoGrid) => ("no_grid", None),
        Err(NotFound::AnotherGrid { size, .. }) => ("another_grid", Some(size)),
        Err(NotFound::Markers) => ("markers", None),
    };
    BoardSeen { found, size, corners_px: Vec::new(), outline_px: Vec::new() }
}

fn whole_board(board: &Chessboard, image: &BoardImage) -> BoardSeen {
    let px = |corner: &Corner| [corner.at.x as f32, corner.at.y as f32];
    let (last_column, last_row) = (board.columns - 1, board.rows - 1);
    let around = [(0, 0), (last_column, 0), (last_column, last_row), (0, last_row)];
    let outline_px = around.iter().filter_map(|&(column, row)| {
        image.corners.iter().find(|c| (c.column, c.row) == (column, row)).map(px)
    });
    BoardSeen {
        found: "found",
        size: Some([board.columns, board.rows]),
        corners_px: image.corners.iter().map(px).collect(),
        outline_px: outline_px.collect(),
    }
}

/// A picture as a file of the netpbm kind, as `calibrate` and the stick take it.
pub(super) fn pgm(pixels: &[u8], [width, height]: [usize; 2]) -> Vec<u8> {
    let mut file = format!("P5\n{width} {height}\n255\n").into_bytes();
    file.extend_from_slice(pixels);
    file
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::demo;
    use crate::source::synthetic::{BoardStills, held_poses};

    const TIME: FrameTime = FrameTime { index: 5, t_s: 0.2 };

    #[test]
    fn a_board_that_is_held_is_seen_with_its_corners_and_the_places_are_sharp() {
        let scenario = demo::scenario().expect("committed");
        let camera = scenario.camera().expect("valid");
        let mut stills = BoardStills::new(scenario, Chessboard::new([9, 6], 25.0)).expect("valid");
        let poses = held_poses(&camera.lens, camera.image_size_px);
        let still = stills.held(poses[4].0, poses[4].1);
        let picture = still.plane().expect("whole");
        let (setup, size_px, canvas) = look(picture, TIME, Some([9, 6]), None);
        assert_eq!(canvas.len(), size_px[0] * size_px[1]);
        let board = setup.board.expect("looked for");
        assert_eq!((board.found, board.outline_px.len()), ("found", 4));
        assert!(board.corners_px.len() >= 49, "{} corners", board.corners_px.len());
        // In the middle of the picture: the board is held there.
        let blur_px = setup.places[0].blur_px.expect("edges");
        assert!(blur_px < 0.8, "{blur_px}");
        assert!((setup.histogram.iter().sum::<f32>() - 1.0).abs() < 1e-3);
        let (other, ..) = look(picture, TIME, Some([7, 5]), None);
        let board = other.board.expect("looked for");
        assert_eq!((board.found, board.size), ("another_grid", Some([9, 6])));
    }

    #[test]
    fn every_pixel_of_a_place_is_the_camera_s_own_and_no_size_is_too_small() {
        for [width, height] in [[1280, 800], [2448, 2048], [64, 48], [4, 3], [1, 1]] {
            let pixels: Vec<u8> =
                (0..width * height).map(|i| (i % width * 3 + i / width * 7) as u8).collect();
            let picture = Plane::packed(&pixels, width, height).expect("fits");
            let (setup, [columns, _], canvas) = look(picture, TIME, None, Some(0.5));
            for place in &setup.places {
                let Piece { from_px: [x, y], at_px: [u, v], size_px: [w, h], .. } = place.piece;
                for (i, k) in [(0, 0), (w - 1, h - 1)] {
                    assert_eq!(canvas[(v + k) * columns + u + i], picture.at(x + i, y + k));
                }
            }
        }
    }

    #[test]
    fn a_picture_too_bright_or_too_dark_says_so() {
        let (setup, ..) =
            look(Plane::packed(&[255; 4800], 80, 60).expect("fits"), TIME, None, None);
        assert_eq!((setup.white_share, setup.black_share, setup.histogram[15]), (1.0, 0.0, 1.0));
        let (setup, ..) = look(Plane::packed(&[0; 4800], 80, 60).expect("fits"), TIME, None, None);
        assert_eq!((setup.white_share, setup.black_share, setup.histogram[0]), (0.0, 1.0, 1.0));
    }
}
