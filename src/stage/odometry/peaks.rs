//! Peaks of a correlation over shifts: the best, its rivals, and where it is between two shifts.

/// The peak is interpolated from this many shifts to both sides.
pub const PEAK_HALF: isize = 4;
/// Shifts that the interpolation needs.
pub const PEAK_SHIFTS: usize = 2 * PEAK_HALF as usize + 1;
/// Another peak of at least this share of the best makes it ambiguous.
pub const LIKE_HEIGHT: f32 = 0.7;
/// Peaks nearer than this are one, px.
const PEAK_APART_PX: isize = 3;

/// The highest peaks of a correlation, shift and height, each apart from the others.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Peaks {
    /// The highest.
    pub first: Option<(isize, f32)>,
    second: Option<(isize, f32)>,
    third: Option<(isize, f32)>,
}

impl Peaks {
    /// Of correlations from shift `from` on.
    pub fn of(rho: &[f32], from: isize, without: Option<isize>) -> Self {
        let near = |a: isize, b: isize| (a - b).abs() < PEAK_APART_PX;
        let is_peak = |&(shift, height): &(isize, f32)| {
            let at = (shift - from) as usize;
            let around = &rho[at.saturating_sub(2)..rho.len().min(at + 3)];
            // A plateau of nothing is none; a maximum at the end is a slope.
            height > 0.0
                && around.len() == 5
                && around.iter().all(|&other| other <= height)
                && without.is_none_or(|without| !near(shift, without))
        };
        let peaks = || (from..).zip(rho.iter().copied()).filter(is_peak);
        let highest = |but: [Option<(isize, f32)>; 2]| {
            peaks()
                .filter(|&(shift, _)| but.iter().flatten().all(|&(other, _)| !near(shift, other)))
                .max_by(|a, b| a.1.total_cmp(&b.1))
        };
        let first = highest([None; 2]);
        let second = highest([first, None]);
        Self { first, second, third: highest([first, second]) }
    }

    /// Whether another peak is about as high as the one at this shift. What stands still in the
    /// picture, at shift 0, and outdoes the belt's texture is not the belt.
    pub fn rival_of(&self, shift_px: f64) -> bool {
        let all = [self.first, self.second, self.third];
        let is_own = |shift: isize| (shift as f64 - shift_px).abs() < PEAK_APART_PX as f64;
        let own = all.iter().flatten().find(|(shift, _)| is_own(*shift)).map_or(0.0, |p| p.1);
        all.iter().flatten().filter(|(shift, _)| !is_own(*shift)).any(|&(shift, height)| {
            let in_picture = shift.abs() <= 1 && own < LIKE_HEIGHT * height;
            height >= LIKE_HEIGHT * own && !in_picture
        })
    }
}

/// The interpolated peak is looked for in steps of this many px.
const FINE_PX: f64 = 0.05;

/// Offset of the peak from the middle of correlations at neighbouring shifts; `None` when it
/// is not within a pixel.
pub fn peak(around: &[f64; PEAK_SHIFTS]) -> Option<f64> {
    use std::f64::consts::PI;
    let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
    let lanczos = |x: f64| sinc(x) * sinc(x / PEAK_HALF as f64);
    // Correlations of textures sampled finely enough are as smooth as the textures.
    let at = |offset: f64| -> f64 {
        let terms = around.iter().enumerate().map(|(k, rho)| {
            let x = offset - (k as isize - PEAK_HALF) as f64;
            if x.abs() < PEAK_HALF as f64 { rho * lanczos(x) } else { 0.0 }
        });
        terms.sum()
    };
    let best = (-19..=19)
        .map(|k| (k, at(f64::from(k) * FINE_PX)))
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(k, _)| f64::from(k) * FINE_PX)?;
    let (before, here, after) = (at(best - FINE_PX), at(best), at(best + FINE_PX));
    let curvature = before - 2.0 * here + after;
    let is_peak = curvature < 0.0 && before <= here && after <= here;
    is_peak.then(|| best + 0.5 * FINE_PX * (before - after) / curvature)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A parabola through the middle three shifts is off by up to 0.028 px here.
    #[test]
    fn the_peak_of_a_smooth_correlation_is_found_between_shifts() {
        for tenth in -4..=4 {
            let truth = f64::from(tenth) / 10.0;
            let around = std::array::from_fn(|k| {
                let x = (k as isize - PEAK_HALF) as f64 - truth;
                (-0.5 * (x / 1.3).powi(2)).exp()
            });
            let found = peak(&around).expect("a peak");
            // Four samples to each side leave 0.0015 px of this Gaussian.
            assert!((found - truth).abs() < 0.003, "{truth}: {found}");
        }
    }

    #[test]
    fn a_texture_that_repeats_itself_has_rivals_and_another_has_none() {
        let rho = |period_px: Option<f64>| -> [f32; 81] {
            std::array::from_fn(|k| {
                let x = k as f64 - 40.0 - 9.0;
                let peak = |x: f64| (-0.5 * (x / 1.5).powi(2)).exp();
                let repeated =
                    period_px.map_or(0.0, |p| peak(x.rem_euclid(p)) + peak(p - x.rem_euclid(p)));
                peak(x).max(repeated) as f32
            })
        };
        assert!(!Peaks::of(&rho(None), -40, None).rival_of(9.3));
        assert!(Peaks::of(&rho(Some(8.4)), -40, None).rival_of(9.3));
        // What stands still in the picture is no rival of a motion that stands out.
        assert_eq!(Peaks::of(&rho(None), -40, Some(9)).first, None);
    }

    #[test]
    fn a_slope_has_no_peak() {
        assert_eq!(peak(&std::array::from_fn(|k| k as f64)), None);
    }
}
