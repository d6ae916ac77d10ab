//! How wide a profile's edge is: a step convolved with a Gaussian is fitted to it.
//!
//! Source of the error function: Abramowitz and Stegun, 7.1.26 (to 1.5e-7).

use nalgebra::{Matrix4, Vector4};

/// The fit looks so far to both sides of the edge, samples.
pub(super) const WINDOW: usize = 9;
const ITERATIONS: usize = 10;
/// A step that fits worse than this share of its contrast has something else beside it.
const MISFIT_MAX: f32 = 0.05;
/// Widths that are looked for, px.
const SIGMA_PX: std::ops::RangeInclusive<f32> = 0.25..=6.0;
/// The edge stays so near to where it was found, px.
const NEAR_PX: f32 = 2.0;

/// A step in a profile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Edge {
    /// Standard deviation of its blur along the profile, px.
    pub(super) sigma_px: f32,
    /// Root mean square of what the fit leaves, as a share of the step.
    pub(super) misfit: f32,
}

impl Edge {
    /// Whether it is a step and nothing else.
    pub(super) fn is_clean(self) -> bool {
        self.misfit < MISFIT_MAX
    }
}

/// Fit a blurred step near sample `at` of a profile; `None` where there is none.
pub(super) fn edge(profile: &[f32], at: f32) -> Option<Edge> {
    let first = (at.round() as usize).checked_sub(WINDOW)?;
    let samples = profile.get(first..=first + 2 * WINDOW)?;
    let last = samples.len() - 1;
    let mut centre = at - first as f32;
    let (mut base, mut step, mut sigma) = (samples[0], samples[last] - samples[0], 1.0f32);
    let expected = centre;
    for _ in 0..ITERATIONS {
        let (mut normal, mut vector) = (Matrix4::<f32>::zeros(), Vector4::zeros());
        for (k, value) in samples.iter().enumerate() {
            let z = (k as f32 - centre) / sigma;
            let (rise, slope) = (normal_distribution(z), normal_density(z) / sigma);
            let row = Vector4::new(1.0, rise, -step * slope, -step * slope * z);
            normal += row * row.transpose();
            vector += row * (value - base - step * rise);
        }
        // A little damping: far from the step a width has no effect.
        for i in 0..4 {
            normal[(i, i)] *= 1.001;
        }
        let change = normal.cholesky()?.solve(&vector);
        (base, step) = (base + change[0], step + change[1]);
        centre += change[2].clamp(-1.0, 1.0);
        sigma = (sigma + change[3].clamp(-0.5 * sigma, 0.5)).max(*SIGMA_PX.start());
    }
    if !SIGMA_PX.contains(&sigma) || (centre - expected).abs() > NEAR_PX || step == 0.0 {
        return None;
    }
    let left = |(k, value): (usize, &f32)| {
        let rise = normal_distribution((k as f32 - centre) / sigma);
        (value - base - step * rise).powi(2)
    };
    let mean_square = samples.iter().enumerate().map(left).sum::<f32>() / samples.len() as f32;
    Some(Edge { sigma_px: sigma, misfit: mean_square.sqrt() / step.abs() })
}

fn normal_density(z: f32) -> f32 {
    0.398_942_3 * (-0.5 * z * z).exp()
}

fn normal_distribution(z: f32) -> f32 {
    let x = z.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * x);
    let series = t
        * (0.254_829_6
            + t * (-0.284_496_74 + t * (1.421_413_7 + t * (-1.453_152 + t * 1.061_405_4))));
    let above = 0.5 * series * (-x * x).exp();
    if z > 0.0 { 1.0 - above } else { above }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIDDLE: usize = 16;

    fn blurred(at: f32, sigma: f32) -> Vec<f32> {
        let middle = MIDDLE as f32 + at;
        (0..=2 * MIDDLE)
            .map(|k| 20.0 + 60.0 * normal_distribution((k as f32 - middle) / sigma))
            .collect()
    }

    #[test]
    fn the_width_of_a_step_is_found() {
        for sigma in [0.5, 0.7, 1.0, 2.0, 3.0] {
            for at in [-0.4, 0.0, 0.3] {
                let mean = blurred(at, sigma);
                let found = edge(&mean, MIDDLE as f32).expect("a step");
                assert!(
                    (found.sigma_px - sigma).abs() < 0.03 * sigma,
                    "{sigma} at {at}: {found:?}"
                );
                assert!(found.misfit < 0.01, "{found:?}");
            }
        }
    }

    #[test]
    fn a_line_is_no_step_and_plain_grey_has_none() {
        let mut mean = blurred(0.0, 0.7);
        mean[MIDDLE + 4..].fill(20.0);
        assert!(edge(&mean, MIDDLE as f32).is_none_or(|found| found.misfit > 0.05));
        assert_eq!(edge(&[40.0; 2 * MIDDLE + 1], MIDDLE as f32), None);
    }
}
