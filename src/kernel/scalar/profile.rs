//! Sub-pixel edges on a grey profile sampled across a predicted edge.

use crate::image::Plane;

/// A step is no wider than twice this many samples.
const RAMP: usize = 4;

/// A step found on a profile.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// Position along the profile, in samples from its first.
    pub at: f32,
    /// Grey levels a sample beyond the slope around it, positive when the profile rises.
    pub slope: f32,
}

/// Sample `profile.len()` values from `start` on, `step` px apart, each the mean of
/// `2 * half_width + 1` neighbours across the profile. `None` when any leaves the image.
pub fn sample(
    image: Plane<'_>,
    start: [f32; 2],
    step: [f32; 2],
    half_width: i32,
    profile: &mut [f32],
) -> Option<()> {
    let length = step[0].hypot(step[1]).max(f32::MIN_POSITIVE);
    let across = [-step[1] / length, step[0] / length];
    let scale = 1.0 / (2 * half_width + 1) as f32;
    for (i, out) in profile.iter_mut().enumerate() {
        let i = i as f32;
        let mut sum = 0.0;
        for w in -half_width..=half_width {
            let w = w as f32;
            let x = start[0] + i * step[0] + w * across[0];
            let y = start[1] + i * step[1] + w * across[1];
            sum += image.sample(x, y)?;
        }
        *out = sum * scale;
    }
    Some(())
}

/// The steepest local extrema of the profile's slope, at least `slope_min`, strongest first.
/// Returns how many were stored in `steps`.
///
/// The slope is the difference of neighbours smoothed by [1 2 1]; its extremum is refined by
/// a parabola, which is unbiased for a symmetric blur. A ramp is no step: of a slope counts
/// what exceeds that on both sides, [`RAMP`] samples away; shadows have wide borders.
pub fn steps(profile: &[f32], slope_min: f32, steps: &mut [Step]) -> usize {
    let slope = |i: usize| {
        let p = &profile[i - 2..=i + 2];
        (p[4] - p[0] + 2.0 * (p[3] - p[1])) / 8.0
    };
    let last = profile.len().saturating_sub(3);
    let mut count = 0;
    for i in 3..last {
        let (before, here, after) = (slope(i - 1), slope(i), slope(i + 1));
        let sign = here.signum();
        let peak = here * sign > before * sign && here * sign >= after * sign;
        let around = [i.max(2 + RAMP) - RAMP, (i + RAMP).min(last - 1)].map(|j| slope(j) * sign);
        let sharp = here * sign - around[0].min(around[1]).max(0.0);
        if !peak || sharp < slope_min {
            continue;
        }
        let curvature = before - 2.0 * here + after;
        let offset = if curvature == 0.0 { 0.0 } else { 0.5 * (before - after) / curvature };
        let step = Step { at: i as f32 + offset.clamp(-0.5, 0.5), slope: sharp * sign };
        let rank = steps[..count].iter().position(|s| s.slope.abs() < sharp).unwrap_or(count);
        if rank < steps.len() {
            count = (count + 1).min(steps.len());
            steps[rank..count].rotate_right(1);
            steps[rank] = step;
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A step at `at` blurred by a Gaussian-like ramp three samples wide.
    fn blurred_step(at: f32, low: f32, high: f32) -> Vec<f32> {
        (0..25).map(|i| low + (high - low) / (1.0 + (-(i as f32 - at) / 0.6).exp())).collect()
    }

    #[test]
    fn a_blurred_step_is_found_to_a_twentieth_of_a_sample() {
        for tenth in 0..10 {
            let at = 11.0 + tenth as f32 / 10.0;
            for (low, high) in [(20.0, 90.0), (90.0, 20.0)] {
                let mut found = [Step::default(); 3];
                assert_eq!(steps(&blurred_step(at, low, high), 1.0, &mut found), 1);
                assert!((found[0].at - at).abs() < 0.05, "{} {at}", found[0].at);
                assert_eq!(found[0].slope > 0.0, high > low);
            }
        }
    }

    #[test]
    fn a_flat_profile_has_no_step() {
        for level in [0.0, 255.0] {
            assert_eq!(steps(&[level; 25], 1.0, &mut [Step::default(); 3]), 0);
        }
    }

    #[test]
    fn a_shadow_s_border_is_no_step() {
        let ramp: Vec<f32> = (0..40).map(|i| i as f32 * 3.0).collect();
        assert_eq!(steps(&ramp, 0.8, &mut [Step::default(); 3]), 0);
        let edge_in_it: Vec<f32> =
            ramp.iter().zip(blurred_step(15.0, 0.0, 12.0)).map(|(a, b)| a + b).collect();
        assert_eq!(steps(&edge_in_it, 0.8, &mut [Step::default(); 3]), 1);
    }

    #[test]
    fn the_strongest_steps_are_kept() {
        let mut profile = blurred_step(7.0, 0.0, 20.0);
        for (sum, more) in profile.iter_mut().zip(blurred_step(16.0, 0.0, 100.0)) {
            *sum += more;
        }
        let mut found = [Step::default(); 1];
        assert_eq!(steps(&profile, 1.0, &mut found), 1);
        assert!((found[0].at - 16.0).abs() < 0.1, "{found:?}");
    }

    #[test]
    fn a_profile_that_leaves_the_image_is_refused() {
        let data = [0; 100];
        let image = Plane::packed(&data, 10, 10).expect("square");
        assert!(sample(image, [5.0, 5.0], [1.0, 0.0], 0, &mut [0.0; 3]).is_some());
        assert!(sample(image, [5.0, 5.0], [1.0, 0.0], 0, &mut [0.0; 5]).is_none());
        assert!(sample(image, [f32::NAN, 5.0], [1.0, 0.0], 0, &mut [0.0; 2]).is_none());
    }
}
