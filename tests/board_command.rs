//! `beltgauge board`: the board that is drawn is found by `calibrate`, in true size, in both formats.

mod common;

use beltgauge::camera::chessboard::Chessboard;
use beltgauge::image::Plane;
use common::{beltgauge, run, scratch};
use std::fs;
use std::path::Path;

/// Of the pictures that are made of it here.
const PX_PER_MM: f64 = 4.0;

fn draw(folder: &Path, arguments: &[&str]) -> std::process::Output {
    run(beltgauge().current_dir(folder).arg("board").args(arguments))
}

/// Numbers after `name="` in a line.
fn attribute(line: &str, name: &str) -> Option<f64> {
    let (_, after) = line.split_once(&format!(" {name}=\""))?;
    after.split('"').next()?.trim_end_matches("mm").parse().ok()
}

/// Size of the sheet, and its black rectangles: x, y, width, height in mm.
fn svg(path: &Path) -> ([f64; 2], Vec<[f64; 4]>) {
    let text = fs::read_to_string(path).expect("drawn");
    let head = text.lines().next().expect("a head");
    let size = ["width", "height"].map(|name| attribute(head, name).expect("a size"));
    let rectangles = text.lines().filter(|line| line.starts_with("<rect x="));
    let numbers = |line: &str| {
        ["x", "y", "width", "height"].map(|name| attribute(line, name).expect("a number"))
    };
    (size, rectangles.map(numbers).collect())
}

/// The same from a PDF, in mm from the top left.
fn pdf(path: &Path) -> ([f64; 2], Vec<[f64; 4]>) {
    let bytes = fs::read(path).expect("drawn");
    let text = String::from_utf8_lossy(&bytes);
    let mm = |pt: &str| pt.parse::<f64>().expect("a number") * 25.4 / 72.0;
    let (_, after) = text.split_once("/MediaBox [").expect("a page");
    let corners: Vec<f64> = after.split(']').next().expect("closed").split(' ').map(mm).collect();
    let size = [corners[2], corners[3]];
    let rectangles = text.lines().filter_map(|line| line.strip_suffix(" re")).map(|line| {
        let n: Vec<f64> = line.split(' ').map(mm).collect();
        [n[0], size[1] - n[1] - n[3], n[2], n[3]]
    });
    (size, rectangles.collect())
}

fn picture(size_mm: [f64; 2], rectangles: &[[f64; 4]]) -> (Vec<u8>, [usize; 2]) {
    let [width, height] = size_mm.map(|side| (side * PX_PER_MM).round() as usize);
    let mut grey = vec![230u8; width * height];
    for [x, y, w, h] in rectangles.iter().map(|r| r.map(|mm| (mm * PX_PER_MM).round() as usize)) {
        for row in grey[y * width..(y + h) * width].chunks_mut(width) {
            row[x..x + w].fill(20);
        }
    }
    (grey, [width, height])
}

#[test]
fn the_board_that_is_drawn_is_found_in_true_size_in_both_formats() {
    let folder = scratch("board");
    for (squares, corners, square_mm, sheet) in [
        ("10x7", [9, 6], 25.0, [297.0, 210.0]),
        ("7x10", [9, 6], 25.0, [297.0, 210.0]),
        ("12x8", [11, 7], 30.0, [420.0, 297.0]),
        ("4x4", [3, 3], 12.5, [297.0, 210.0]),
    ] {
        for file in ["board.svg", "board.pdf"] {
            let side = square_mm.to_string();
            let arguments = ["--squares", squares, "--square-mm", &side, "--out", file];
            let output = draw(&folder, &arguments);
            assert!(output.status.success(), "{output:?}");
            let said = String::from_utf8_lossy(&output.stdout).into_owned();
            assert!(said.contains("100 %") && said.contains("100 mm"), "{said}");
            let path = folder.join(file);
            let (size_mm, rectangles) = if file.ends_with("svg") { svg(&path) } else { pdf(&path) };
            // PDF has single precision.
            let near = |a: f64, b: f64| (a - b).abs() < 1e-3;
            assert!(near(size_mm[0], sheet[0]) && near(size_mm[1], sheet[1]), "{size_mm:?}");
            let inside = |[x, y, w, h]: &[f64; 4]| {
                *x > 5.0 && *y > 5.0 && x + w < sheet[0] - 5.0 && y + h < sheet[1] - 5.0
            };
            assert!(rectangles.iter().all(inside), "a printer cuts {file} of {squares} off");
            let lines = rectangles.iter().filter(|r| near(r[2].max(r[3]), 100.0)).count();
            assert_eq!(lines, 2, "{file}: lines of 100 mm");
            // A screen has 96 pixels an inch: what is thinner may fall between two rows of them.
            let thinnest_mm = rectangles.iter().map(|r| r[2].min(r[3])).fold(f64::MAX, f64::min);
            assert!(thinnest_mm > 25.4 / 96.0, "{file}: a line of {thinnest_mm} mm is not drawn");
            let (grey, [width, height]) = picture(size_mm, &rectangles);
            let board = Chessboard::new(corners, square_mm);
            let plane = Plane::packed(&grey, width, height).expect("this size");
            let found = board.find(plane).expect("our own finder finds it");
            assert_eq!(found.corners.len(), board.corner_count());
            let at = |k: usize| (found.corners[k].at.x, found.corners[k].at.y);
            let (first, last) = (at(0), at(board.corner_count() - 1));
            let across_mm = (last.0 - first.0).hypot(last.1 - first.1) / PX_PER_MM;
            let truth_mm = square_mm * ((corners[0] - 1) as f64).hypot((corners[1] - 1) as f64);
            // What is rounded to pixels here: half a pixel at both ends.
            assert!((across_mm - truth_mm).abs() < 1.0 / PX_PER_MM, "{across_mm} of {truth_mm} mm");
        }
    }
}

#[test]
fn a_board_larger_than_any_sheet_has_a_sheet_of_its_own() {
    let folder = scratch("board-large");
    let output = draw(&folder, &["--squares", "20x14", "--square-mm", "100", "--out", "b.svg"]);
    assert!(output.status.success(), "{output:?}");
    let (size, rectangles) = svg(&folder.join("b.svg"));
    assert_eq!((size, rectangles.len()), ([2032.0, 1432.0], 140 + 2));
}

#[test]
fn a_board_that_cannot_be_is_refused_by_name() {
    let folder = scratch("board-refused");
    for (squares, side, out, words) in [
        ("3x7", "25", "b.svg", &["3x7", "4 to 61"][..]),
        ("10x7", "0.5", "b.svg", &["0.5", "1 to 500"]),
        ("10x7", "25", "b.png", &["b.png", ".svg or .pdf"]),
        ("10x7", "25", "no/where.svg", &["no/where.svg", "cannot write"]),
    ] {
        let output = draw(&folder, &["--squares", squares, "--square-mm", side, "--out", out]);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success(), "{squares} {side} {out}");
        assert!(words.iter().all(|word| told.contains(word)), "{words:?} not in {told}");
    }
}
