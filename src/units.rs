//! Units and frames, as types where mixing them up would compile.
//!
//! Two pixel frames exist and never mix: [`RawPx`] is the camera's image, [`BeltPx`] the
//! rectified belt view. Both follow `OpenCV`: the centre of the top-left pixel is (0, 0).
//! Millimetres on the belt plane are [`BeltMm`]: +x along travel, +y to the left seen
//! along travel, origin under the camera centre. Scalars carry their unit in their name.

/// A point in the camera's image, in pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RawPx {
    /// Column.
    pub x: f64,
    /// Row.
    pub y: f64,
}

/// A point in the belt view, in pixels of that view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BeltPx {
    /// Column: grows along travel.
    pub u: f64,
    /// Row: grows to the right seen along travel.
    pub v: f64,
}

/// A point on the belt plane, in mm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BeltMm {
    /// Along travel.
    pub x: f64,
    /// To the left seen along travel.
    pub y: f64,
}

/// An axis-aligned rectangle on the belt plane, in mm.
#[derive(
    Clone, Copy, Debug, PartialEq, serde::Deserialize, serde::Serialize, schemars::JsonSchema,
)]
#[serde(deny_unknown_fields)]
pub struct BeltRect {
    /// Upstream end.
    pub x_min_mm: f64,
    /// Downstream end.
    pub x_max_mm: f64,
    /// Right side seen along travel.
    pub y_min_mm: f64,
    /// Left side seen along travel.
    pub y_max_mm: f64,
}

impl BeltRect {
    /// The four corners, counter-clockwise seen from above.
    pub fn corners(&self) -> [BeltMm; 4] {
        [
            BeltMm { x: self.x_min_mm, y: self.y_min_mm },
            BeltMm { x: self.x_max_mm, y: self.y_min_mm },
            BeltMm { x: self.x_max_mm, y: self.y_max_mm },
            BeltMm { x: self.x_min_mm, y: self.y_max_mm },
        ]
    }

    /// Whether a point of the belt is inside, borders included.
    pub fn contains(&self, x_mm: f64, y_mm: f64) -> bool {
        (self.x_min_mm..=self.x_max_mm).contains(&x_mm)
            && (self.y_min_mm..=self.y_max_mm).contains(&y_mm)
    }

    /// Length along travel.
    pub fn length_mm(&self) -> f64 {
        self.x_max_mm - self.x_min_mm
    }

    /// Middle of the rectangle.
    pub fn centre(&self) -> BeltMm {
        BeltMm {
            x: f64::midpoint(self.x_min_mm, self.x_max_mm),
            y: f64::midpoint(self.y_min_mm, self.y_max_mm),
        }
    }
}
