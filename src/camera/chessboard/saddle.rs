//! Candidates: saddle points of the smoothed grey image, where two edges cross.
//!
//! Source: the determinant of the Hessian after Chen and Zhang 2005, "A new sub-pixel detector
//! for X-corners in camera calibration targets", eq. 4 to 7.

use super::grey::Grey;
use nalgebra::{Matrix2, Vector2};

/// More than any board and its surroundings show; the strongest are kept.
const CANDIDATES_MAX: usize = 4000;
/// A saddle is the strongest within this many pixels, columns and rows.
const RIVAL_PX: usize = 2;
/// Weaker saddles, grey levels a pixel squared, are noise of an 8-bit image.
const STRENGTH_MIN: f32 = 0.25;
/// Smaller ratios of the curvatures are ridges: edges that meet at less than 25 degrees.
const CURVATURE_RATIO_MIN: f64 = 0.05;

/// A point where two edges seem to cross.
pub(super) struct Saddle {
    pub(super) at: Vector2<f64>,
    /// Directions of the two edges, unit length, either sense.
    pub(super) edges: [Edge; 2],
    /// Root of the negative determinant of the Hessian.
    pub(super) strength: f32,
}

/// An edge through a saddle.
#[derive(Clone, Copy)]
pub(super) struct Edge {
    pub(super) along: Vector2<f64>,
    /// Whether it is brighter on the side of (-y, x), going away from the saddle; the same in
    /// either sense.
    pub(super) brighter_left: bool,
}

/// The saddles of a smoothed image, the strongest first.
pub(super) fn saddles(smooth: &Grey) -> Vec<Saddle> {
    let (width, height) = (smooth.width, smooth.height);
    let mut strength = vec![0.0_f32; width * height];
    let border = RIVAL_PX + 1;
    for y in border..height.saturating_sub(border) {
        for x in border..width.saturating_sub(border) {
            let [xx, xy, yy] = hessian(smooth, x, y);
            strength[y * width + x] = (xy * xy - xx * yy).max(0.0).sqrt();
        }
    }
    let mut found = Vec::new();
    for y in border..height.saturating_sub(border) {
        for x in border..width.saturating_sub(border) {
            let own = strength[y * width + x];
            if own < STRENGTH_MIN {
                continue;
            }
            let rows = y - RIVAL_PX..=y + RIVAL_PX;
            let strongest = rows.into_iter().all(|v| {
                strength[v * width + x - RIVAL_PX..=v * width + x + RIVAL_PX]
                    .iter()
                    .all(|&s| s <= own)
            });
            if strongest {
                found.extend(saddle(smooth, x, y, own));
            }
        }
    }
    found.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    found.truncate(CANDIDATES_MAX);
    found
}

/// Second derivatives xx, xy, yy.
fn hessian(smooth: &Grey, x: usize, y: usize) -> [f32; 3] {
    let at = |dx: isize, dy: isize| smooth.at(x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
    [
        at(1, 0) - 2.0 * at(0, 0) + at(-1, 0),
        0.25 * (at(1, 1) - at(-1, 1) - at(1, -1) + at(-1, -1)),
        at(0, 1) - 2.0 * at(0, 0) + at(0, -1),
    ]
}

fn saddle(smooth: &Grey, x: usize, y: usize, strength: f32) -> Option<Saddle> {
    let [xx, xy, yy] = hessian(smooth, x, y).map(f64::from);
    let curvature = Matrix2::new(xx, xy, xy, yy);
    let value = |x: usize, y: usize| f64::from(smooth.at(x, y));
    let slope =
        0.5 * Vector2::new(value(x + 1, y) - value(x - 1, y), value(x, y + 1) - value(x, y - 1));
    let step = curvature.try_inverse()? * -slope;
    if step.amax() > 1.5 {
        return None; // the grey value is level somewhere else: a slope, not a saddle
    }
    let eigen = curvature.symmetric_eigen();
    let (bright, dark) = if eigen.eigenvalues[0] > 0.0 { (0, 1) } else { (1, 0) };
    let (up, down) = (eigen.eigenvalues[bright], -eigen.eigenvalues[dark]);
    if up.min(down) < CURVATURE_RATIO_MIN * up.max(down) {
        return None;
    }
    // Along the edges the second derivative is zero.
    let across = (up / down).sqrt();
    let edges = [across, -across].map(|tangent| {
        let along = (eigen.eigenvectors.column(bright) + tangent * eigen.eigenvectors.column(dark))
            .normalize();
        let left = Vector2::new(-along.y, along.x);
        Edge { along, brighter_left: left.dot(&(curvature * along)) > 0.0 }
    });
    Some(Saddle { at: Vector2::new(x as f64, y as f64) + step, edges, strength })
}
