//! What a parcel shows from above, and how two such things exclude each other.

use super::enclosing::SPREAD_MM;
use super::rectangle::Rectangle;
use crate::stage::evidence::Cell;

/// A border with less than this share of edge is an accident.
const SUPPORT_MIN: f64 = 0.65;
/// Each side has at least this share of edge.
const SIDE_SUPPORT_MIN: f64 = 0.25;
/// Lines that happen to lie right give this share.
const ACCIDENT_SUPPORT: f64 = 0.55;
/// Cells this far around a face are its own: its sides, as far as an edge spreads, mm.
const SIDE_MM: f64 = SPREAD_MM;
/// What encloses a bag is known to a few mm: two such faces are one parcel's when this share of one lies
/// inside the other.
const OVERLAP_SHARE: f64 = 0.3;
/// Two cuboids that reach further into each other are one parcel's, mm.
const CUBOID_DEPTH_MM: f64 = 5.0;
/// Cells of a border lower than this tell the belt, too, mm: the mean of both within what an edge spreads ...
const FLAT_MM: f64 = 7.0;
/// ... so that its edges alone must tell it: this share of them.
const FLAT_SUPPORT_MIN: f64 = 0.9;
/// Two borders are one when so much of each lies inside the other.
const SAME_SHARE: f64 = 0.95;
/// Borders with a line further inside: one for each side.
pub const NARROWER: usize = 4;
/// What differs less in height is at one height, mm.
pub const STEP_MM: f64 = 12.0;

/// A parcel seen from above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Its border.
    pub rectangle: Rectangle,
    /// For each side the border with a line further inside that may be it, too.
    pub narrower: [Option<Rectangle>; NARROWER],
    /// Over the belt, mm.
    pub height_mm: f64,
    /// Cells that began it.
    pub cells: usize,
    /// A cuboid's top face, by its edges; else this is what encloses the parcel.
    pub is_cuboid: bool,
}

/// A cuboid fitted to the edges around a face.
#[derive(Clone, Copy, Debug)]
pub struct Cuboid {
    /// Its top face.
    pub rectangle: Rectangle,
    /// Over the belt, mm.
    pub height_mm: f64,
    /// Enough of the edges are a cuboid's.
    pub is_box: bool,
}

impl Face {
    /// A cuboid's top face over a place.
    pub fn cuboid(place: &Rectangle, height_mm: f64) -> Self {
        let (narrower, cells, is_cuboid) = ([None; NARROWER], 0, true);
        Self { rectangle: *place, narrower, height_mm, cells, is_cuboid }
    }

    /// What the face explains: its border beyond what an accident has.
    pub fn worth(&self) -> f64 {
        let border_mm = 2.0 * (self.rectangle.length_mm + self.rectangle.width_mm);
        (self.rectangle.support() - ACCIDENT_SUPPORT) * border_mm
    }

    /// Whether a cell belongs to the face: on it, or lower and beside it.
    pub fn owns(&self, cell: &Cell, [x_mm, y_mm]: [f64; 2]) -> bool {
        f64::from(cell.height_mm) < self.height_mm + STEP_MM
            && self.rectangle.outside_mm(x_mm, y_mm) < SIDE_MM
    }

    /// Whether it is too near to the belt for cells to tell one from the other.
    pub fn is_low(&self) -> bool {
        self.height_mm < FLAT_MM
    }

    /// Whether it is as low, and a whole border tells it.
    pub fn is_flat(&self) -> bool {
        self.is_low() && self.rectangle.support() > FLAT_SUPPORT_MIN
    }

    /// Whether two faces have one border at one height.
    pub fn is_same(&self, other: &Self) -> bool {
        let [one, two] = [&self.rectangle, &other.rectangle];
        (self.height_mm - other.height_mm).abs() < STEP_MM
            && one.share_inside(two).min(two.share_inside(one)) > SAME_SHARE
    }

    /// Whether two faces cannot be two parcels'.
    pub fn excludes(&self, other: &Self) -> bool {
        let both = self.is_cuboid && other.is_cuboid;
        let [depth_mm, share] = if both { [CUBOID_DEPTH_MM, 0.0] } else { [0.0, OVERLAP_SHARE] };
        let inside = |a: &Self, b: &Self| a.rectangle.shrunk(depth_mm).share_inside(&b.rectangle);
        inside(self, other) > share || inside(other, self) > share
    }
}

/// Whether enough of a border is edge.
pub fn is_border(rectangle: &Rectangle) -> bool {
    let weakest = rectangle.sides.iter().copied().fold(1.0, f64::min);
    rectangle.support() >= SUPPORT_MIN && weakest >= SIDE_SUPPORT_MIN
}
