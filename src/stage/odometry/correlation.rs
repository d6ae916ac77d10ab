//! How alike two textures are at one shift, and what chance makes of it.

use crate::kernel::scalar::texture::Sums;

/// A correlation above this is clearly a match. One that is fainter, but beyond what chance reaches on
/// so many pixels, is a match if it has no rival: the camera's noise hides a texture in every single
/// pixel, not in 100,000 of them.
pub const MATCH_MIN: f64 = 0.08;
/// A correlation is no accident from this many standard deviations of chance on;
/// neighbouring pixels of a texture are alike, which makes chance twice as wide.
const CHANCE_SIGMA: f64 = 12.0;

/// Sums over both textures at one shift.
#[derive(Clone, Copy, Default)]
pub struct Correlation {
    /// Normalised, -1 to 1.
    pub rho: f64,
    /// Pixels that took part.
    pub pairs: u32,
    /// In units of the texture, squared.
    pub covariance: f64,
}

/// Two textures that lie on each other.
pub struct Match {
    /// The belt's travel from one to the other.
    pub shift_px: f64,
    /// Their correlation there.
    pub rho: f64,
    /// Pixels that took part.
    pub pairs: u32,
    /// Root of the texture's covariance, grey levels.
    pub texture_grey: f64,
    /// Frames missing before this one, by its step: its time is as much more than its stamp.
    pub missing: u32,
}

/// What a correlation of so many pairs never reaches by accident.
pub fn chance(pairs: u32) -> f64 {
    CHANCE_SIGMA / f64::from(pairs.max(1)).sqrt()
}

/// What a match of so many pairs needs at least.
pub fn match_min(pairs: u32) -> f64 {
    chance(pairs).min(MATCH_MIN)
}

impl Correlation {
    /// Of the sums over all rows.
    pub fn of(sums: &Sums) -> Self {
        let norm = (sums.aa as f64 * sums.bb as f64).sqrt();
        Self {
            rho: if norm > 0.0 { sums.ab as f64 / norm } else { 0.0 },
            pairs: sums.n,
            covariance: sums.ab as f64 / f64::from(sums.n.max(1)),
        }
    }
}
