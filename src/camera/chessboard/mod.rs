//! Finding a chessboard: its inner corners, in order, to a few hundredths of a pixel.
//!
//! Saddle points of the grey image at several sizes are joined to a grid along the edges that
//! lead from one to the next; then the picture of each corner is fitted in the full image.

mod corners;
mod grey;
mod grid;
mod markers;
mod refine;
mod saddle;

use crate::image::Plane;
use crate::units::RawPx;
pub(super) use corners::median;
use corners::{Corners, parity_sign};
use grey::Grey;
use nalgebra::Vector2;

/// The pattern: inner corners, and the size of a square.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chessboard {
    /// Inner corners along the longer side.
    pub columns: usize,
    /// Inner corners along the shorter side.
    pub rows: usize,
    /// Side of a square.
    pub square_mm: f64,
    /// The shorter side was named first: so do messages.
    pub shorter_first: bool,
}

/// An inner corner of the board that was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// From 0, along the longer side.
    pub column: usize,
    /// From 0, along the shorter side; columns and rows turn clockwise in the image.
    pub row: usize,
    /// Where it is.
    pub at: RawPx,
}

/// A board as an image shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct BoardImage {
    /// Its inner corners by row and column; a few may be missing.
    pub corners: Vec<Corner>,
    /// Median width of the edges along columns and along rows: scale of the hyperbolic tangent
    /// across them. Motion widens one more than the other.
    pub blur_px: [f64; 2],
}

/// Why no board was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NotFound {
    /// No grid of squares at all.
    NoGrid,
    /// A grid with this many inner corners (longer side first), of which so many were seen.
    AnotherGrid {
        /// Inner corners along both sides.
        size: [usize; 2],
        /// Corners seen.
        seen: usize,
    },
    /// A board whose bright squares hold markers.
    Markers,
}

/// Coarsest image that is searched, along its longer side.
const COARSEST_PX: usize = 240;
/// The search starts at about this size: fast, and sharp enough for most boards.
const FIRST_PX: usize = 1100;
/// So many of the board's corners must be seen: the rest may be hidden by glare or a hand.
const SEEN_MIN: f64 = 0.9;
/// Grids looked at more closely at each size of the image, the largest first.
const GRIDS_MAX: usize = 6;

impl Chessboard {
    /// A board; the order of the two counts matters for messages only.
    pub fn new(corners: [usize; 2], square_mm: f64) -> Self {
        let [a, b] = corners;
        Self { columns: a.max(b), rows: a.min(b), square_mm, shorter_first: a < b }
    }

    /// Two counts, the longer side's first, as text in the order in which the board was named.
    pub fn in_order(&self, [long, short]: [usize; 2]) -> String {
        if self.shorter_first { format!("{short}x{long}") } else { format!("{long}x{short}") }
    }

    /// Corners of the whole board.
    pub fn corner_count(&self) -> usize {
        self.columns * self.rows
    }

    /// A corner's number, row by row.
    pub fn index(&self, corner: &Corner) -> usize {
        corner.row * self.columns + corner.column
    }

    /// Place of a corner on the board, mm from corner (0, 0).
    pub fn place_mm(&self, corner: &Corner) -> Vector2<f64> {
        self.square_mm * Vector2::new(corner.column as f64, corner.row as f64)
    }

    /// Whether the pattern looks the same after half a turn (a square one perhaps after a
    /// quarter): then its corners cannot be told from their opposites.
    pub fn is_symmetric(&self) -> bool {
        (self.columns + self.rows).is_multiple_of(2)
    }

    /// Find the board in an image.
    ///
    /// Corners are in the same order in every image, unless the pattern is symmetric; then
    /// the columns lead to the right of the image, as far as can be.
    pub fn find(&self, image: Plane<'_>) -> Result<BoardImage, NotFound> {
        let full = Grey::new(image);
        let mut failure = NotFound::NoGrid;
        let mut pyramid = vec![full];
        for halvings in search_order(image.width().max(image.height())) {
            while pyramid.len() <= halvings {
                pyramid.push(pyramid[pyramid.len() - 1].halved());
            }
            let (full, smooth) = (&pyramid[0], pyramid[halvings].smoothed());
            let saddles = saddle::saddles(&smooth);
            let all = self.corner_count();
            for grid in grid::grids(&smooth, &saddles, all / 4, all).iter().take(GRIDS_MAX) {
                let mut corners = Corners::refined(full, grid, halvings);
                corners.complete(full, [self.columns, self.rows]);
                match self.ordered(&corners) {
                    Ok(found) => return Ok(found),
                    Err(_) if markers::fill(full, grid, halvings) => failure = NotFound::Markers,
                    Err(reason) => failure = failure.nearer(reason),
                }
            }
        }
        Err(failure)
    }

    /// The corners in the board's order, when the grid is the board.
    fn ordered(&self, corners: &Corners) -> Result<BoardImage, NotFound> {
        let [width, height] = corners.size();
        let size = [width.max(height), width.min(height)];
        let seen = corners.count();
        if size != [self.columns, self.rows]
            || (seen as f64) < SEEN_MIN * self.corner_count() as f64
        {
            return Err(NotFound::AnotherGrid { size, seen });
        }
        // A quarter turn keeps the sense of rotation and exchanges dark and bright squares.
        let upright = width >= height;
        let [first, _] = corners.bounds();
        let mut ordered = Vec::with_capacity(seen);
        let (mut blurs, mut dark_first) = ([Vec::new(), Vec::new()], 0.0);
        for ((x, y), refined) in corners.iter() {
            let (x, y) = ((x - first.0) as usize, (y - first.1) as usize);
            let (column, row) = if upright { (x, y) } else { (y, width - 1 - x) };
            let dark = if upright { refined.contrast } else { -refined.contrast };
            dark_first += parity_sign((column as i32, row as i32)) * dark;
            let [first, second] = refined.blur_px;
            let [along_columns, along_rows] = &mut blurs;
            along_columns.push(if upright { first } else { second });
            along_rows.push(if upright { second } else { first });
            let at = RawPx { x: refined.at.x, y: refined.at.y };
            ordered.push(Corner { column, row, at });
        }
        if dark_first < 0.0 {
            let turns = if self.columns == self.rows { 1 } else { 2 };
            ordered = self.turned(&ordered, turns);
        }
        let mut ordered = self.named_towards(&ordered, Vector2::x());
        ordered.sort_by_key(|c| (c.row, c.column));
        Ok(BoardImage { corners: ordered, blur_px: blurs.map(median) })
    }

    /// The corners under those of the names that the pattern allows whose columns lead furthest
    /// in a direction of the image.
    pub fn named_towards(&self, corners: &[Corner], towards: Vector2<f64>) -> Vec<Corner> {
        let turns: &[usize] = match (self.columns == self.rows, self.is_symmetric()) {
            (true, _) if self.columns.is_multiple_of(2) => &[0, 1, 2, 3],
            (_, true) => &[0, 2],
            (_, false) => &[0],
        };
        let reach = |turns: usize| self.direction(&self.turned(corners, turns)).dot(&towards);
        let best = turns.iter().max_by(|&&a, &&b| reach(a).total_cmp(&reach(b)));
        self.turned(corners, best.copied().unwrap_or(0))
    }

    /// Where the columns lead in the image; its length says nothing.
    pub fn direction(&self, corners: &[Corner]) -> Vector2<f64> {
        let middle = corners.iter().map(|c| c.column as f64).sum::<f64>() / corners.len() as f64;
        corners.iter().map(|c| (c.column as f64 - middle) * Vector2::new(c.at.x, c.at.y)).sum()
    }

    /// The corners named from the board turned by quarter turns; by two only, unless its sides
    /// are equal.
    fn turned(&self, corners: &[Corner], quarter_turns: usize) -> Vec<Corner> {
        let (last_column, last_row) = (self.columns - 1, self.rows - 1);
        let name = |Corner { column, row, at }: Corner| match quarter_turns {
            1 => Corner { column: row, row: last_column - column, at },
            2 => Corner { column: last_column - column, row: last_row - row, at },
            3 => Corner { column: last_row - row, row: column, at },
            _ => Corner { column, row, at },
        };
        corners.iter().copied().map(name).collect()
    }
}

impl NotFound {
    /// The more telling of two failures.
    fn nearer(self, other: Self) -> Self {
        match (self, other) {
            (Self::Markers, _) | (_, Self::Markers) => Self::Markers,
            (Self::AnotherGrid { seen: a, .. }, Self::AnotherGrid { seen: b, .. }) if a >= b => {
                self
            }
            (_, Self::AnotherGrid { .. }) => other,
            _ => self,
        }
    }
}

/// How often the image is halved, in the order of trying: the middle size, finer ones, coarser.
fn search_order(longer_side_px: usize) -> Vec<usize> {
    let halvings = |target: usize| (longer_side_px / target).max(1).ilog2() as usize;
    let (first, coarsest) = (halvings(FIRST_PX), halvings(COARSEST_PX));
    (0..=first).rev().chain(first + 1..=coarsest).collect()
}
