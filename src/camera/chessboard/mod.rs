//! Finding a chessboard: its inner corners, in order, to a few hundredths of a pixel.
//!
//! Saddle points of the grey image at several sizes are joined to a grid along the edges that
//! lead from one to the next; then the picture of each corner is fitted in the full image.

mod corners;
mod grey;
mod grid;
mod refine;
mod saddle;

use crate::image::Plane;
use crate::units::RawPx;
use corners::{Corners, median, parity_sign};
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
}

/// Coarsest image that is searched, along its longer side.
const COARSEST_PX: usize = 240;
/// The search starts at about this size: fast, and sharp enough for most boards.
const FIRST_PX: usize = 1100;
/// So many of the board's corners must be seen: the rest may be hidden by glare or a hand.
const SEEN_MIN: f64 = 0.9;
/// Grids looked at more closely at each size of the image, the largest first.
const GRIDS_MAX: usize = 3;

impl Chessboard {
    /// A board; the order of the two counts does not matter.
    pub fn new(corners: [usize; 2], square_mm: f64) -> Self {
        let [a, b] = corners;
        Self { columns: a.max(b), rows: a.min(b), square_mm }
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

    /// Whether the pattern looks the same after half a turn: then its corners cannot be told
    /// from their opposites.
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
        for halvings in search_order(image.width().max(image.height())) {
            let mut small = (halvings > 0).then(|| full.halved());
            for _ in 1..halvings {
                small = small.map(|s| s.halved());
            }
            let smooth = small.as_ref().unwrap_or(&full).smoothed();
            let saddles = saddle::saddles(&smooth);
            let all = self.corner_count();
            for grid in grid::grids(&smooth, &saddles, all / 4, all).iter().take(GRIDS_MAX) {
                let mut corners = Corners::refined(&full, grid, halvings);
                corners.complete(&full, [self.columns, self.rows]);
                match self.ordered(&corners) {
                    Ok(found) => return Ok(found),
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
        let (mut blurs, mut dark_first, mut rightwards) = ([Vec::new(), Vec::new()], 0.0, 0.0);
        for ((x, y), refined) in corners.iter() {
            let (x, y) = ((x - first.0) as usize, (y - first.1) as usize);
            let (column, row) = if upright { (x, y) } else { (y, width - 1 - x) };
            let dark = if upright { refined.contrast } else { -refined.contrast };
            dark_first += parity_sign((column as i32, row as i32)) * dark;
            rightwards += (column as f64 - 0.5 * (self.columns - 1) as f64) * refined.at.x;
            let [first, second] = refined.blur_px;
            let [along_columns, along_rows] = &mut blurs;
            along_columns.push(if upright { first } else { second });
            along_rows.push(if upright { second } else { first });
            let at = RawPx { x: refined.at.x, y: refined.at.y };
            ordered.push(Corner { column, row, at });
        }
        if (if self.is_symmetric() { rightwards } else { dark_first }) < 0.0 {
            for corner in &mut ordered {
                *corner = self.half_turn(corner);
            }
        }
        ordered.sort_by_key(|c| (c.row, c.column));
        Ok(BoardImage { corners: ordered, blur_px: blurs.map(median) })
    }

    /// The same corner when the board is named from the opposite end.
    pub fn half_turn(&self, corner: &Corner) -> Corner {
        Corner {
            column: self.columns - 1 - corner.column,
            row: self.rows - 1 - corner.row,
            at: corner.at,
        }
    }
}

impl NotFound {
    /// The more telling of two failures.
    fn nearer(self, other: Self) -> Self {
        match (self, other) {
            (Self::AnotherGrid { seen: a, .. }, Self::AnotherGrid { seen: b, .. }) if a >= b => {
                self
            }
            (_, Self::AnotherGrid { .. }) => other,
            _ => self,
        }
    }
}

/// How often the image is halved, in the order of trying: the middle size, finer ones, coarser.
fn search_order(longer_side_px: usize) -> Vec<u32> {
    let halvings = |target: usize| (longer_side_px / target).max(1).ilog2();
    let (first, coarsest) = (halvings(FIRST_PX), halvings(COARSEST_PX));
    (0..=first).rev().chain(first + 1..=coarsest).collect()
}
