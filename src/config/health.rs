//! `[health]`: when the instrument says that it is not as it was.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A camera's displacement that matters, mm: a third of what a parcel's size is known to.
const MOVED_WARNING_MM: f64 = 0.3;
/// A displacement that is told for certain, px of the view.
const MOVED_SURE_PX: f64 = 0.3;

/// `[health]`
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Health {
    /// Time of a running belt from one look to the next.
    pub every_s: f64,
    /// The camera has moved: error of a place or a dimension from which on it is a warning; default: 0.3 mm, at
    /// least 0.3 px of the view.
    pub moved_warning_mm: Option<f64>,
    /// And a fault: as large as the standard deviation up to which dimensions may be used.
    pub moved_fault_mm: f64,
    /// The picture is unsharp: standard deviation of its blur from which on it is a warning. Heights are then wrong by
    /// a mm (pixels of 1.5 mm).
    pub blur_warning_px: f64,
    /// And a fault: heights are then wrong by 3 mm.
    pub blur_fault_px: f64,
    /// The light has changed: share by which a part of the picture may be brighter or darker.
    pub light_change_max: f64,
}

impl Default for Health {
    fn default() -> Self {
        Self {
            every_s: 10.0,
            moved_warning_mm: None,
            moved_fault_mm: 3.0,
            blur_warning_px: 1.5,
            blur_fault_px: 2.5,
            light_change_max: 0.3,
        }
    }
}

impl Health {
    /// The error from which on a displacement is a warning, when a pixel of the view is so large.
    pub fn moved_warning_mm(&self, mm_per_px: f64) -> f64 {
        let by_default = MOVED_WARNING_MM.max(MOVED_SURE_PX * mm_per_px);
        self.moved_warning_mm.unwrap_or(by_default.min(self.moved_fault_mm))
    }
}
