//! Sub-pixel edges on a grey profile sampled across a predicted edge.

use crate::image::Plane;

/// A step is no wider than twice this many samples.
const RAMP: usize = 4;

/// Blur of a step as the slope sees it, samples, one sigma: optics, pixel, map and smoothing.
const BLUR: f32 = 1.4;
/// A step is not drawn further than this, samples.
const DRAWN_MAX: f32 = 1.6;

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
    let at = |i: f32, w: f32| {
        [start[0] + i * step[0] + w * across[0], start[1] + i * step[1] + w * across[1]]
    };
    // All lie between these four.
    let (last, w) = (profile.len().saturating_sub(1) as f32, half_width as f32);
    let corners = [at(0.0, -w), at(0.0, w), at(last, -w), at(last, w)];
    if !corners.into_iter().all(|[x, y]| image.surrounds(x, y)) {
        return None;
    }
    for (i, out) in profile.iter_mut().enumerate() {
        let mut sum = 0.0;
        for w in -half_width..=half_width {
            let [x, y] = at(i as f32, w as f32);
            sum += image.between(x, y);
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
/// A ramp that begins at the step, as a contact shadow does, draws the extremum to its side: with a
/// step of height A blurred to sigma, and slopes B beside it, by `sigma^2 (B+ - B-) / A`.
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
        let offset = offset.clamp(-0.5, 0.5);
        // What the slopes beside the step would be at it, from those beyond its blur.
        let beside = [-1i32, 1].map(|side| {
            // Between the samples, as far from the step on either side.
            let at = |d: i32| {
                let x = i as f32 + offset + (side * d) as f32;
                let inside = x >= 2.0 && x + 1.0 < last as f32;
                let lerp = |j: usize| slope(j) + (x - j as f32) * (slope(j + 1) - slope(j));
                inside.then(|| lerp(x as usize) * sign)
            };
            let [Some(near), Some(far)] = [at(3), at(5)] else { return 0.0 };
            (2.5 * near - 1.5 * far).clamp(0.0, 2.0 * near.max(0.0))
        });
        let rise = here * sign - 0.5 * (beside[0] + beside[1]);
        let drawn = BLUR * (beside[1] - beside[0]) / (2.507 * rise.max(0.2 * here.abs()));
        let at = i as f32 + offset - drawn.clamp(-DRAWN_MAX, DRAWN_MAX);
        let step = Step { at, slope: sharp * sign };
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
        // Steepest in its middle, 2.5 grey levels a sample, and wide.
        let soft: Vec<f32> =
            (0..40).map(|i| 60.0 / (1.0 + (-(i as f32 - 20.3) / 6.0).exp())).collect();
        assert_eq!(steps(&soft, 0.8, &mut [Step::default(); 3]), 0);
        let ramp: Vec<f32> = (0..40).map(|i| i as f32 * 3.0).collect();
        let edge_in_it: Vec<f32> =
            ramp.iter().zip(blurred_step(15.0, 0.0, 12.0)).map(|(a, b)| a + b).collect();
        assert_eq!(steps(&edge_in_it, 0.8, &mut [Step::default(); 3]), 1);
    }

    #[test]
    fn a_contact_shadow_draws_no_step_to_its_side() {
        // A dark top, 7 grey levels of step, and a shadow that fades over 8 samples.
        let profile: Vec<f32> = (0..250)
            .map(|i| {
                let x = (i as f32 - 125.0) / 10.0;
                let near = (1.0 - x / 8.0).clamp(0.0, 1.0);
                if x < 0.0 { 20.0 } else { 45.0 - 18.0 * near * near }
            })
            .collect();
        // A pixel and the optics: two boxes, one and one and a half samples wide.
        let box_filter = |p: &[f32], n: usize| -> Vec<f32> {
            p.windows(n).map(|w| w.iter().sum::<f32>() / n as f32).collect()
        };
        let blurred = box_filter(&box_filter(&profile, 10), 15);
        let sampled: Vec<f32> = blurred.iter().step_by(10).copied().collect();
        let mut found = [Step::default(); 1];
        assert_eq!(steps(&sampled, 0.8, &mut found), 1);
        // Windows of 10 and 15 fine samples shift by 11.5 of them.
        let truth = (125.0 - 11.5) / 10.0;
        assert!((found[0].at - truth).abs() < 0.4, "{} {truth}", found[0].at);
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
