//! Mean profiles across edges, and by how much two of them are shifted against each other.

use super::blur::{self, Edge};
use super::edges::{Axis, Point};
use crate::image::Plane;
use nalgebra::{Matrix3, Vector3};

/// A profile reaches this far to both sides, px.
pub(super) const REACH_PX: usize = 64;
/// Its samples.
pub(super) const SAMPLES: usize = 2 * REACH_PX + 1;
/// Two profiles are compared so far to both sides of the edge, px.
const WINDOW_PX: usize = 9;
/// An edge has so much room to the picture's border.
pub(super) const MARGIN_PX: usize = WINDOW_PX + NEAR_PX as usize + 2;
/// Around the expected place an edge is looked for so far, px.
pub(super) const NEAR_PX: i32 = 4;
/// The largest shift that a profile can show, px.
pub(super) const SHIFT_MAX_PX: i32 = (REACH_PX - WINDOW_PX) as i32;
/// Profiles that are less alike than this show different things.
pub(super) const ALIKE_MIN: f32 = 0.8;
/// Steps of the sub-pixel fit.
const ITERATIONS: usize = 4;
/// The sub-pixel fit stays within this of the best whole pixel, px.
const FIT_PX: f32 = 1.0;

/// A mean profile; outside of the picture it has no samples.
pub(super) struct Profile<'a> {
    pub(super) mean: &'a [f32],
    /// First sample and end inside the picture.
    pub(super) inside: [usize; 2],
}

impl Profile<'_> {
    /// The step that is shifted so far from its middle.
    pub(super) fn edge(&self, shift_px: f32) -> Option<Edge> {
        let inside = &self.mean[self.inside[0]..self.inside[1]];
        blur::edge(inside, REACH_PX as f32 + shift_px - self.inside[0] as f32)
    }
}

/// Which samples of a point's profile lie in a picture.
pub(super) fn inside(point: &Point, size_px: [usize; 2]) -> [usize; 2] {
    let along = usize::from(point.axis == Axis::Column);
    let (at, size) = (usize::from(point.at[along]), size_px[along]);
    [REACH_PX.saturating_sub(at), (size + REACH_PX - at).min(SAMPLES)]
}

/// Add a frame's profile to the sums.
pub(super) fn add(raw: Plane<'_>, point: &Point, sums: &mut [u32]) {
    let [from, to] = inside(point, [raw.width(), raw.height()]);
    let [x, y] = point.at.map(usize::from);
    let sums = &mut sums[from..to];
    match point.axis {
        Axis::Row => {
            let row = &raw.row(y)[x + from - REACH_PX..];
            sums.iter_mut().zip(row).for_each(|(sum, v)| *sum += u32::from(*v));
        }
        Axis::Column => {
            let column = raw.from(x, y + from - REACH_PX).iter().step_by(raw.stride());
            sums.iter_mut().zip(column).for_each(|(sum, v)| *sum += u32::from(*v));
        }
    }
}

/// How a profile fits to a reference.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Match {
    /// The edge has moved by so much along the profile, px.
    pub(super) shift_px: f32,
    /// Its contrast over that of the reference.
    pub(super) contrast: f32,
    /// Correlation of the two, 1: the same.
    pub(super) alike: f32,
}

/// The reference's window around the edge.
fn window(reference: &[f32]) -> &[f32] {
    &reference[REACH_PX - WINDOW_PX..=REACH_PX + WINDOW_PX]
}

/// Correlation of a profile, shifted by whole pixels, with a reference.
pub(super) fn alike(reference: &[f32], now: &Profile<'_>, shift: i32) -> f32 {
    let start = REACH_PX as i32 - WINDOW_PX as i32 + shift;
    let n = 2 * WINDOW_PX + 1;
    let (from, to) = (start, start + n as i32);
    if from < now.inside[0] as i32 || to > now.inside[1] as i32 {
        return 0.0;
    }
    let pair = || window(reference).iter().zip(&now.mean[from as usize..to as usize]);
    let (mr, mn) = pair().fold((0.0, 0.0), |(r, p), (a, b)| (r + a, p + b));
    let (mr, mn) = (mr / n as f32, mn / n as f32);
    let [rr, nn, rn] = pair().fold([0.0f32; 3], |[rr, nn, rn], (a, b)| {
        let (a, b) = (a - mr, b - mn);
        [rr + a * a, nn + b * b, rn + a * b]
    });
    if rr * nn > 0.0 { rn / (rr * nn).sqrt() } else { 0.0 }
}

/// Find a reference's edge in a profile near `expected_px`; `None` where nothing is alike.
pub(super) fn find(reference: &[f32], now: &Profile<'_>, expected_px: f32) -> Option<Match> {
    let middle = expected_px.round() as i32;
    let shifts = (middle - NEAR_PX..=middle + NEAR_PX)
        .filter(|shift| shift.abs() < SHIFT_MAX_PX)
        .map(|shift| (shift, alike(reference, now, shift)));
    let (whole, alike) = shifts.max_by(|a, b| a.1.total_cmp(&b.1))?;
    if alike < ALIKE_MIN {
        return None;
    }
    let mut shift = whole as f32;
    let mut contrast = 1.0;
    for _ in 0..ITERATIONS {
        let [a, slope] = fit(reference, now, shift)?;
        if a.abs() < f32::EPSILON {
            return None;
        }
        (contrast, shift) = (a, shift - slope / a);
        if (shift - whole as f32).abs() > FIT_PX {
            return None;
        }
    }
    Some(Match { shift_px: shift, contrast, alike })
}

/// Least squares of the shifted profile by the reference, its slope and a constant: the first two.
fn fit(reference: &[f32], now: &Profile<'_>, shift: f32) -> Option<[f32; 2]> {
    let (mut matrix, mut vector) = (Matrix3::<f32>::zeros(), Vector3::zeros());
    for k in REACH_PX - WINDOW_PX..=REACH_PX + WINDOW_PX {
        let row = Vector3::new(reference[k], 0.5 * (reference[k + 1] - reference[k - 1]), 1.0);
        let value = cubic(now, k as f32 + shift)?;
        matrix += row * row.transpose();
        vector += row * value;
    }
    let solution = matrix.cholesky()?.solve(&vector);
    Some([solution[0], solution[1]])
}

/// Value between samples, by Keys' cubic.
fn cubic(profile: &Profile<'_>, at: f32) -> Option<f32> {
    let k = at.floor();
    let (first, t) = (k as usize, at - k);
    if first < profile.inside[0] + 1 || first + 2 >= profile.inside[1] {
        return None;
    }
    let [a, b, c, d] = [-1, 0, 1, 2].map(|i: isize| profile.mean[first.wrapping_add_signed(i)]);
    let (m, n) = (0.5 * (c - a), 0.5 * (d - b));
    // Hermite's cubic through b and c with the slopes m and n.
    let square = 3.0 * (c - b) - 2.0 * m - n;
    let cube = 2.0 * (b - c) + m + n;
    Some(b + t * (m + t * (square + t * cube)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A blurred edge at `at`, its grey levels times `gain` on `black`.
    fn edge(at: f32, sigma: f32, gain: f32, black: f32) -> Vec<f32> {
        let value = |k: usize| {
            let d = (k as f32 - at) / sigma;
            black + gain * 100.0 / (1.0 + (-1.702 * d).exp())
        };
        (0..SAMPLES).map(value).collect()
    }

    #[test]
    fn a_shift_is_found_to_a_few_hundredths_of_a_pixel_in_other_light() {
        let middle = REACH_PX as f32;
        for sigma in [0.7, 1.0, 2.0] {
            let reference = edge(middle + 0.3, sigma, 1.0, 10.0);
            for shift in [-3.4, -1.0, -0.5, -0.05, 0.0, 0.25, 0.5, 2.75] {
                let mean = edge(middle + 0.3 + shift, sigma, 0.6, 25.0);
                let now = Profile { mean: &mean, inside: [0, SAMPLES] };
                let found = find(&reference, &now, 0.0).expect("alike");
                let off = found.shift_px - shift;
                assert!(off.abs() < 0.03, "sigma {sigma}, shift {shift}: off by {off}");
                assert!((found.contrast - 0.6).abs() < 0.02, "{found:?}");
            }
        }
    }

    #[test]
    fn a_far_shift_is_found_where_it_is_expected_and_nothing_in_plain_grey() {
        let reference = edge(REACH_PX as f32, 1.0, 1.0, 10.0);
        let mean = edge(REACH_PX as f32 + 40.2, 1.0, 1.0, 10.0);
        let now = Profile { mean: &mean, inside: [0, SAMPLES] };
        assert_eq!(find(&reference, &now, 0.0), None);
        let found = find(&reference, &now, 38.0).expect("alike");
        assert!((found.shift_px - 40.2).abs() < 0.03, "{found:?}");
        let plain = Profile { mean: &[40.0; SAMPLES], inside: [0, SAMPLES] };
        assert_eq!(find(&reference, &plain, 0.0), None);
        let cut = Profile { mean: &mean, inside: [0, REACH_PX + 30] };
        assert_eq!(find(&reference, &cut, 38.0), None, "it would be outside the picture");
    }
}
