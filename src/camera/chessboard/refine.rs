//! A corner to a few hundredths of a pixel: the picture of two crossing edges is fitted.
//!
//! The model is `level + shade . d + contrast * s(d1 / blur1) * s(d2 / blur2)` with d1, d2
//! the distances from the two edges and s a sigmoid: what blur makes of a black and white corner
//! under uneven light. The window follows the squares' size in the image.

use super::grey::Grey;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// The window reaches this part of the way to the neighbours, whose edges must stay outside.
const WINDOW: f64 = 0.47;
/// Further out nothing is gained, and a wide-angle lens bends the edges.
const WINDOW_PX_MAX: f64 = 16.0;
/// Parameters: corner x, y; both edges' angles; both edges' log blur; contrast; level; shade x, y.
const PARAMETERS: usize = 10;
/// A fit with fewer pixels a parameter than two says nothing: squares of 5 px have 22.
const PIXELS_MIN: usize = 2 * PARAMETERS;
const STEPS_MAX: usize = 25;
/// The fit must explain the window but for this part of the contrast (root mean square).
const RESIDUAL_MAX: f64 = 0.5;

/// A corner further from its start, in steps to the next corner, is another one.
const MOVED_MAX: f64 = 0.25;
/// Edges lead to the neighbours, but for perspective and distortion, rad.
const TURNED_MAX: f64 = 0.3;

/// A refined corner.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refined {
    pub(super) at: Vector2<f64>,
    /// Half of the step from dark to bright, grey levels; positive when the square between the
    /// two steps to the neighbours is dark.
    pub(super) contrast: f64,
    /// Width of the edges along the first and the second step.
    pub(super) blur_px: [f64; 2],
}

/// Fit the corner near `start`, between neighbours about `steps` away along its two edges.
pub(super) fn refine(
    image: &Grey,
    start: Vector2<f64>,
    steps: [Vector2<f64>; 2],
) -> Option<Refined> {
    let pixels = window(image, start, steps)?;
    let mut x = initial(&pixels, steps);
    let mut damping = 1e-3;
    let (mut cost, mut normal, mut gradient) = linearise(&pixels, &x);
    for _ in 0..STEPS_MAX {
        let mut damped = normal;
        for k in 0..PARAMETERS {
            damped[(k, k)] += damping * normal[(k, k)] + 1e-12;
        }
        let step = damped.cholesky()?.solve(&gradient);
        let next = x - step;
        let at_next = linearise(&pixels, &next);
        if at_next.0 < cost {
            let moved = step[0].hypot(step[1]);
            x = next;
            (cost, normal, gradient) = at_next;
            damping *= 0.2;
            if moved < 1e-4 {
                break;
            }
        } else {
            damping *= 8.0;
            if damping > 1e6 {
                break;
            }
        }
    }
    let offset = Vector2::new(x[0], x[1]);
    let (contrast, blur) = (x[6], [x[4].exp(), x[5].exp()]);
    let spacing = steps[0].norm().min(steps[1].norm());
    let residual = (cost / pixels.len() as f64).sqrt();
    let start_angles = steps.map(|s| s.y.atan2(s.x));
    let turned = (x[2] - start_angles[0]).abs().max((x[3] - start_angles[1]).abs());
    let kept = offset.norm() < MOVED_MAX * spacing
        && turned < TURNED_MAX
        && blur[0].max(blur[1]) < spacing
        && residual < RESIDUAL_MAX * contrast.abs()
        && contrast.abs() > 1.0;
    kept.then_some(Refined { at: start + offset, contrast, blur_px: blur })
}

/// Offsets from the start and grey values inside the parallelogram of the window.
fn window(
    image: &Grey,
    start: Vector2<f64>,
    steps: [Vector2<f64>; 2],
) -> Option<Vec<(Vector2<f64>, f64)>> {
    let [a, b] = steps.map(|s| s * WINDOW.min(WINDOW_PX_MAX / s.norm()));
    let inverse = Matrix2::from_columns(&[a, b]).try_inverse()?;
    let reach = a.abs() + b.abs();
    let first = start - reach;
    let last = start + reach;
    let range = |from: f64, to: f64, end: usize| {
        (from.ceil().max(0.0) as usize)..((to.floor() + 1.0).clamp(0.0, end as f64) as usize)
    };
    let mut pixels = Vec::new();
    for y in range(first.y, last.y, image.height) {
        for x in range(first.x, last.x, image.width) {
            let offset = Vector2::new(x as f64, y as f64) - start;
            if (inverse * offset).amax() <= 1.0 {
                pixels.push((offset, f64::from(image.at(x, y))));
            }
        }
    }
    (pixels.len() >= PIXELS_MIN).then_some(pixels)
}

fn initial(pixels: &[(Vector2<f64>, f64)], steps: [Vector2<f64>; 2]) -> SVector<f64, PARAMETERS> {
    let [along, across] = steps.map(|s| s.y.atan2(s.x));
    let mean = pixels.iter().map(|(_, g)| g).sum::<f64>() / pixels.len() as f64;
    // The product of the distances is positive in one pair of sectors, negative in the other.
    let product: f64 = pixels
        .iter()
        .map(|&(d, g)| {
            let [d1, d2] = [along, across].map(|angle| distance(d, angle));
            (d1 * d2).signum() * (g - mean)
        })
        .sum();
    let contrast = product / pixels.len() as f64;
    SVector::from([0.0, 0.0, along, across, 0.0, 0.0, contrast, mean, 0.0, 0.0])
}

/// Signed distance from the line through the origin at `angle`.
fn distance(d: Vector2<f64>, angle: f64) -> f64 {
    let (sin, cos) = angle.sin_cos();
    d.y * cos - d.x * sin
}

type Linearised = (f64, SMatrix<f64, PARAMETERS, PARAMETERS>, SVector<f64, PARAMETERS>);

/// Cost, normal matrix and gradient.
fn linearise(pixels: &[(Vector2<f64>, f64)], x: &SVector<f64, PARAMETERS>) -> Linearised {
    let mut cost = 0.0;
    let mut normal = SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros();
    let mut gradient = SVector::<f64, PARAMETERS>::zeros();
    let [blur_1, blur_2] = [x[4].exp(), x[5].exp()];
    let angles = [x[2].sin_cos(), x[3].sin_cos()];
    for &(offset, grey) in pixels {
        let r = offset - Vector2::new(x[0], x[1]);
        let [(s1, c1), (s2, c2)] = angles;
        let [d1, d2] = [(r.y * c1 - r.x * s1) / blur_1, (r.y * c2 - r.x * s2) / blur_2];
        let [t1, t2] = [d1.tanh(), d2.tanh()];
        // derivatives of the product by the distances, px
        let [by_1, by_2] =
            [x[6] * (1.0 - t1 * t1) * t2 / blur_1, x[6] * (1.0 - t2 * t2) * t1 / blur_2];
        let model = x[7] + x[8] * offset.x + x[9] * offset.y + x[6] * t1 * t2;
        let row = SVector::<f64, PARAMETERS>::from([
            by_1 * s1 + by_2 * s2,
            -by_1 * c1 - by_2 * c2,
            -by_1 * (r.x * c1 + r.y * s1),
            -by_2 * (r.x * c2 + r.y * s2),
            -by_1 * d1 * blur_1,
            -by_2 * d2 * blur_2,
            t1 * t2,
            1.0,
            offset.x,
            offset.y,
        ]);
        let error = model - grey;
        cost += error * error;
        gradient += row * error;
        normal.ger(1.0, &row, &row, 1.0);
    }
    (cost, normal, gradient)
}
