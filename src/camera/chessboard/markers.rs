//! ChArUco boards: the bright squares hold markers, in whose way the corners cannot be fitted.

use super::corners::{median, parity_sign};
use super::grey::Grey;
use super::grid::{Cell, Grid};
use nalgebra::Vector2;

/// Samples along the sides of a square, and the part of a side that they leave out at both ends:
/// blurred edges.
const SAMPLES: usize = 9;
const BORDER: f64 = 0.2;
/// In the middle squares with markers span more than this part of the step from dark to bright,
/// plain ones less.
const SPAN: f64 = 0.5;
/// Fewer squares of either colour show no pattern.
const SQUARES_MIN: usize = 4;

/// Whether markers fill the squares of one colour of a grid found in an image halved `halvings`
/// times, and none those of the other.
pub(super) fn fill(image: &Grey, grid: &Grid, halvings: usize) -> bool {
    let scale = (1u64 << halvings) as f64;
    let shift = Vector2::repeat(0.5 * (scale - 1.0));
    let at = |cell: Cell| grid.get(&cell).map(|at| scale * at + shift);
    let spans_of = |colour: f64| -> [Vec<f64>; 2] {
        let squares = grid.keys().filter(|&&cell| colour * parity_sign(cell) > 0.0);
        squares
            .filter_map(|&(x, y)| {
                let corners = [at((x, y))?, at((x + 1, y))?, at((x, y + 1))?, at((x + 1, y + 1))?];
                darkest_and_brightest(image, corners)
            })
            .map(|[darkest, brightest]| (darkest, brightest))
            .collect::<(Vec<f64>, Vec<f64>)>()
            .into()
    };
    let [one, other] = [1.0, -1.0].map(spans_of);
    if one[0].len().min(other[0].len()) < SQUARES_MIN {
        return false;
    }
    let typical = |[darkest, brightest]: [Vec<f64>; 2]| [median(darkest), median(brightest)];
    let [one, other] = [typical(one), typical(other)];
    let step = one[1].max(other[1]) - one[0].min(other[0]);
    let is_filled = |[darkest, brightest]: [f64; 2]| brightest - darkest > SPAN * step;
    is_filled(one) != is_filled(other)
}

/// Grey values inside of a square of which the image shows all.
fn darkest_and_brightest(image: &Grey, corners: [Vector2<f64>; 4]) -> Option<[f64; 2]> {
    let [a, b, c, d] = corners;
    let part = |k: usize| BORDER + (1.0 - 2.0 * BORDER) * k as f64 / (SAMPLES - 1) as f64;
    let mut ends = [f64::INFINITY, f64::NEG_INFINITY];
    for (x, y) in (0..SAMPLES * SAMPLES).map(|k| (part(k % SAMPLES), part(k / SAMPLES))) {
        let upper = a + x * (b - a);
        let lower = c + x * (d - c);
        let grey = image.sample(upper + y * (lower - upper))?;
        ends = [ends[0].min(grey), ends[1].max(grey)];
    }
    Some(ends)
}
