//! The grid's corners in the full image: refined, completed, and rid of what is none.

use super::grey::Grey;
use super::grid::{Cell, Grid};
use super::refine::{Refined, refine};
use nalgebra::Vector2;
use std::collections::HashMap;

/// A corner with less of the board's median contrast is none.
const CONTRAST_MIN: f64 = 0.2;

/// Refined corners by column and row.
pub(super) struct Corners(HashMap<Cell, Refined>);

impl Corners {
    /// Fit the corners of a grid that was found in an image halved `halvings` times.
    pub(super) fn refined(image: &Grey, grid: &Grid, halvings: usize) -> Self {
        let scale = (1u64 << halvings) as f64;
        let shift = Vector2::repeat(0.5 * (scale - 1.0));
        let grid: Grid = grid.iter().map(|(&cell, at)| (cell, scale * at + shift)).collect();
        let place = |cell: Cell| grid.get(&cell).copied();
        let fit = |(&cell, &at)| Some((cell, refine(image, at, steps(place, cell)?)?));
        let mut corners = Self(grid.iter().filter_map(fit).collect());
        let typical = corners.median_contrast();
        corners.0.retain(|&cell, c| parity_sign(cell) * c.contrast / typical > CONTRAST_MIN);
        corners.trim();
        corners
    }

    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (Cell, &Refined)> {
        self.0.iter().map(|(&cell, corner)| (cell, corner))
    }

    /// Look for the corners that the saddles missed: inside the grid, and a line further while
    /// it is smaller than `size`, the longer side first.
    pub(super) fn complete(&mut self, image: &Grey, size: [usize; 2]) {
        // Each pass may fill cells next to those of the pass before.
        for _ in 0..size[0] {
            let [first, last] = self.bounds();
            let [width, height] = self.size();
            let room = width.max(height) < size[0] || width.min(height) < size[1];
            let margin = i32::from(room);
            let typical = self.median_contrast();
            let mut found = Vec::new();
            for y in first.1 - margin..=last.1 + margin {
                for x in first.0 - margin..=last.0 + margin {
                    if !self.0.contains_key(&(x, y))
                        && let Some((at, steps)) = self.expected((x, y))
                        && let Some(corner) = refine(image, at, steps)
                        && parity_sign((x, y)) * corner.contrast / typical > CONTRAST_MIN
                    {
                        found.push(((x, y), corner));
                    }
                }
            }
            if found.is_empty() {
                return;
            }
            self.0.extend(found);
            self.trim();
        }
    }

    /// Columns and rows of the grid.
    pub(super) fn size(&self) -> [usize; 2] {
        let [first, last] = self.bounds();
        [(last.0 - first.0 + 1) as usize, (last.1 - first.1 + 1) as usize]
    }

    /// Smallest and largest column and row.
    pub(super) fn bounds(&self) -> [Cell; 2] {
        let range = |of: fn(&Cell) -> i32| {
            let values = || self.0.keys().map(of);
            (values().min().unwrap_or(0), values().max().unwrap_or(-1))
        };
        let (columns, rows) = (range(|c| c.0), range(|c| c.1));
        [(columns.0, rows.0), (columns.1, rows.1)]
    }

    /// Where an unseen corner should be, and its steps, from those around it.
    fn expected(&self, (x, y): Cell) -> Option<(Vector2<f64>, [Vector2<f64>; 2])> {
        let at = |cell: Cell| self.0.get(&cell).map(|c| c.at);
        let mut places = Vec::new();
        for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
            match [1, 2, 3].map(|k| at((x + k * dx, y + k * dy))) {
                [Some(a), Some(b), Some(c)] => places.push(3.0 * a - 3.0 * b + c),
                [Some(a), Some(b), None] => places.push(2.0 * a - b),
                _ => {}
            }
        }
        if places.is_empty() {
            return None;
        }
        let place = places.iter().sum::<Vector2<f64>>() / places.len() as f64;
        let steps = steps(|cell| if cell == (x, y) { Some(place) } else { at(cell) }, (x, y))?;
        Some((place, steps))
    }

    /// Cut off border lines of which less than half is seen: they are not the board's.
    fn trim(&mut self) {
        while !self.0.is_empty() {
            let [first, last] = self.bounds();
            let [width, height] = self.size();
            let thin_column = [first.0, last.0]
                .into_iter()
                .find(|&x| 2 * self.0.keys().filter(|c| c.0 == x).count() < height);
            let thin_row = [first.1, last.1]
                .into_iter()
                .find(|&y| 2 * self.0.keys().filter(|c| c.1 == y).count() < width);
            match (thin_column, thin_row) {
                (Some(x), _) => self.0.retain(|c, _| c.0 != x),
                (None, Some(y)) => self.0.retain(|c, _| c.1 != y),
                (None, None) => return,
            }
        }
    }

    /// Of the corners' contrasts with their signs made alike.
    fn median_contrast(&self) -> f64 {
        median(self.iter().map(|(cell, c)| parity_sign(cell) * c.contrast).collect())
    }
}

/// Steps to the nearer neighbours along columns and rows: they bound the window.
fn steps(place: impl Fn(Cell) -> Option<Vector2<f64>>, (x, y): Cell) -> Option<[Vector2<f64>; 2]> {
    let own = place((x, y))?;
    let step = |dx: i32, dy: i32| {
        let ahead = place((x + dx, y + dy)).map(|p| p - own);
        let behind = place((x - dx, y - dy)).map(|p| own - p);
        match (ahead, behind) {
            (Some(a), Some(b)) => Some(if a.norm() < b.norm() { a } else { b }),
            (a, b) => a.or(b),
        }
    };
    Some([step(1, 0)?, step(0, 1)?])
}

/// The contrast of a chessboard changes its sign from corner to corner.
pub(super) fn parity_sign((x, y): Cell) -> f64 {
    if (x + y).rem_euclid(2) == 0 { 1.0 } else { -1.0 }
}

/// The middle value; 0 of none.
pub(in crate::camera) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
