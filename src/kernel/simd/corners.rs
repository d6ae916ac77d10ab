//! How good a corner every pixel of an area is, in vectors: the
//! [minimum eigenvalue](crate::kernel::scalar::flow::Patch::minimum_eigenvalue) of the patch
//! around it.
//!
//! Sums down the columns slide from row to row: the products of the row that comes are added,
//! those of the row that goes are taken off. All are whole numbers, so nothing drifts.

use crate::image::Plane;
use crate::kernel::scalar::flow::{HALF, SIDE, minimum_eigenvalue};
use fearless_simd::{Level, dispatch};

/// Columns worked on at a time: all about them stays in the first-level cache.
const STRIP: usize = 128;
/// Columns whose sums a strip needs, in whole vectors of 16.
const COLUMNS: usize = (STRIP + SIDE - 1).next_multiple_of(16);
/// Sums of four columns each that a strip needs.
const FOURS: usize = STRIP + SIDE - 5;
/// Pixels of a row that their gradients need.
const PIXELS: usize = COLUMNS + 2;

type Row = [u8; PIXELS];

/// An area of an image, px: first and last column, first and last row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Area {
    /// Columns.
    pub u: [usize; 2],
    /// Rows.
    pub v: [usize; 2],
}

/// The scores of an area, as far as patches fit into the image, handed over in pieces of rows:
/// first column, row, scores in (grey levels a px)^2.
pub fn minimum_eigenvalues(
    level: Level,
    image: Plane<'_>,
    area: Area,
    mut piece: impl FnMut(usize, usize, &[f32]),
) {
    let fits = |[first, last]: [usize; 2], size: usize| {
        (first.max(HALF + 1), last.saturating_add(1).min(size.saturating_sub(HALF + 1)))
    };
    let (left, right) = fits(area.u, image.width());
    let (top, bottom) = fits(area.v, image.height());
    if top >= bottom {
        return;
    }
    for left in (left..right).step_by(STRIP) {
        let width = STRIP.min(right - left);
        let pixels = left - HALF - 1..=left + width + HALF;
        let mut strip = Strip {
            pixels: [[0; PIXELS]; 3],
            gradients: [[[0; COLUMNS]; 2]; SIDE],
            sums: [[0; COLUMNS]; 3],
            fours: [[0; FOURS]; 3],
        };
        let mut scores = [0.0; STRIP];
        let first = top - HALF - 1;
        for v in first..=bottom + HALF {
            let row = &image.row(v)[pixels.clone()];
            strip.pixels[v % 3][..row.len()].copy_from_slice(row);
            if v < first + 2 {
                continue;
            }
            dispatch!(level, _simd => strip.slide(v - 1));
            if v > first + SIDE {
                dispatch!(level, _simd => strip.score(&mut scores));
                piece(left, v - 1 - HALF, &scores[..width]);
            }
        }
    }
}

struct Strip {
    /// The last three rows.
    pixels: [Row; 3],
    /// Twice the gradient, x and y, of the rows of a window.
    gradients: [[[i16; COLUMNS]; 2]; SIDE],
    /// Sums of its products down each column: xx, xy, yy.
    sums: [[i32; COLUMNS]; 3],
    /// Sums of four columns each.
    fours: [[i32; FOURS]; 3],
}

impl Strip {
    /// Add the products of row `v`, take off those of the row that it takes the place of.
    #[inline(always)]
    fn slide(&mut self, v: usize) {
        let [above, row, below] = [v + 2, v, v + 1].map(|v| &self.pixels[v % 3]);
        let [gradient_x, gradient_y] = &mut self.gradients[v % SIDE];
        let [xx, xy, yy] = &mut self.sums;
        for i in 0..COLUMNS {
            let x = i16::from(row[i + 2]) - i16::from(row[i]);
            let y = i16::from(below[i + 1]) - i16::from(above[i + 1]);
            let (gone_x, gone_y) = (gradient_x[i], gradient_y[i]);
            xx[i] += product(x + gone_x, x - gone_x);
            yy[i] += product(y + gone_y, y - gone_y);
            xy[i] += product(x, y) - product(gone_x, gone_y);
            (gradient_x[i], gradient_y[i]) = (x, y);
        }
    }

    #[inline(always)]
    fn score(&mut self, scores: &mut [f32; STRIP]) {
        const { assert!(SIDE == 13, "three fours and one") };
        // Loops, not `map`: a closure is not compiled for the level.
        for (fours, columns) in self.fours.iter_mut().zip(&self.sums) {
            for i in 0..FOURS {
                fours[i] = columns[i] + columns[i + 1] + columns[i + 2] + columns[i + 3];
            }
        }
        let ([xx, xy, yy], [fours_xx, fours_xy, fours_yy]) = (&self.sums, &self.fours);
        for (i, score) in scores.iter_mut().enumerate() {
            *score = minimum_eigenvalue([
                window(fours_xx, xx, i) as f32,
                window(fours_xy, xy, i) as f32,
                window(fours_yy, yy, i) as f32,
            ]);
        }
    }
}

#[inline(always)]
fn window(fours: &[i32; FOURS], columns: &[i32; COLUMNS], i: usize) -> i32 {
    fours[i] + fours[i + 4] + fours[i + 8] + columns[i + 12]
}

#[inline(always)]
fn product(a: i16, b: i16) -> i32 {
    i32::from(a) * i32::from(b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::scalar::flow::Patch;
    use crate::kernel::simd::each_level;

    /// Every score of `area` against the specification; returns how many there were.
    fn compare(image: Plane<'_>, area: Area) -> usize {
        let mut count = 0;
        each_level(|level| {
            count = 0;
            minimum_eigenvalues(level, image, area, |u, v, scores| {
                for (u, score) in (u..).zip(scores) {
                    let patch = Patch::cut(image, u, v).expect("inside");
                    assert!(
                        score.to_bits() == patch.minimum_eigenvalue().to_bits(),
                        "{level:?} ({u}, {v}): {score}"
                    );
                }
                count += scores.len();
            });
        });
        count
    }

    fn random(n: usize) -> Vec<u8> {
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 40) as u8
        };
        (0..n).map(|_| next()).collect()
    }

    const ALL: Area = Area { u: [0, usize::MAX], v: [0, usize::MAX] };

    #[test]
    fn every_level_scores_as_the_specification_whatever_the_width_and_the_alignment() {
        let random = random(400 * 40);
        for width in [15, 16, 17, 31, 127 + 14, 128 + 14, 129 + 14, 300] {
            for offset in [0, 1, 7] {
                let image = Plane::new(&random[offset..], width, 24, width + 5).expect("fits");
                assert_eq!(compare(image, ALL), (width - 14) * (24 - 14));
            }
        }
        let image = Plane::packed(&random, 400, 40).expect("fits");
        assert_eq!(compare(image, Area { u: [33, 301], v: [9, 20] }), 269 * 12);
    }

    #[test]
    fn the_strongest_and_the_weakest_gradients_fit() {
        let (width, height) = (150, 40);
        for fill in [0, 255] {
            let same = vec![fill; width * height];
            assert!(compare(Plane::packed(&same, width, height).expect("fits"), ALL) > 0);
        }
        // Gradients of 255 everywhere, in one direction and in both.
        for slope in [0, 1] {
            let bars = |i: usize| if (i % width + slope * (i / width)) % 4 < 2 { 0 } else { 255 };
            let data: Vec<u8> = (0..width * height).map(bars).collect();
            assert!(compare(Plane::packed(&data, width, height).expect("fits"), ALL) > 0);
        }
    }

    #[test]
    fn where_no_patch_fits_there_is_no_score() {
        let data = random(60 * 60);
        let image = Plane::packed(&data, 60, 60).expect("fits");
        for area in [
            Area { u: [0, 6], v: [0, 59] },
            Area { u: [53, 80], v: [0, 59] },
            Area { u: [0, 59], v: [0, 6] },
            Area { u: [0, 59], v: [53, 900] },
            Area { u: [30, 20], v: [0, 59] },
        ] {
            assert_eq!(compare(image, area), 0, "{area:?}");
        }
        for (width, height) in [(14, 60), (60, 14), (0, 0), (3, 3)] {
            let image = Plane::packed(&data[..width * height], width, height).expect("fits");
            assert_eq!(compare(image, ALL), 0, "{width}x{height}");
        }
    }
}
