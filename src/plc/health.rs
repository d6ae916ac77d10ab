//! What the instrument knows of itself, in the words of the PLC's interface.

/// How bad something is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Concern {
    /// As it should be.
    #[default]
    None,
    /// Somebody should look after it.
    Warning,
    /// What is measured is wrong.
    Fault,
}

/// What the instrument knows of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HealthStatus {
    /// How well the camera's place is watched: 0 being learned, 1 not at all, 2 across travel, 3 along
    /// travel, 4 both.
    pub camera_watch: u16,
    /// How far the picture has moved, px.
    pub camera_moved_px: f64,
    /// The error that comes of it.
    pub camera_error_mm: f64,
    /// How bad that is.
    pub camera: Concern,
    /// Standard deviation of the picture's blur; `None`: not known.
    pub blur_px: Option<f64>,
    /// How bad that is.
    pub blur: Concern,
    /// The region of the picture whose light has changed most, from 1; 0: not known yet.
    pub light_region: u16,
    /// Its brightness over that when it was learned, less 1.
    pub light_change: f64,
    /// How bad that is.
    pub light: Concern,
}
