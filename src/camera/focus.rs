//! How sharp a picture is: the blur of its strongest edges, for whoever turns the lens.
//!
//! Source: S. Zhuo, T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44 (9),
//! 2011. An edge that is blurred once more loses the more of its gradient the sharper it was. Here both
//! gradients are of blurred pictures, as noise has none of its own there: with R the ratio of the gradient
//! behind a blur of a to that behind one of b, sigma^2 = (b^2 - R^2 a^2) / (R^2 - 1).

use crate::image::Plane;

/// Standard deviations of both blurs: edges nearer to each other than three of the second are mixed.
const BLURS_PX: [f32; 2] = [1.0, 2.0];
const RADIUS: usize = 6;
/// What is nearer to the border has no gradient.
const BORDER: usize = RADIUS + 1;
/// A central difference is itself a blur: the variance of a box of two pixels, px^2.
const DIFFERENCE_VARIANCE_PX2: f32 = 4.0 / 12.0;
/// The strongest edges have at least this share of the gradient that one pixel in 500 exceeds.
const STRONG_SHARE: f32 = 0.5;
const STRONGEST: usize = 500;
/// An edge stands out of what the rest of the picture shows, noise and texture, by this factor; and
/// is no less than so many grey levels a pixel.
const OVER_MEDIAN: f32 = 4.0;
const GRADIENT_MIN: f32 = 2.0;
/// Fewer points of edges say nothing.
const POINTS_MIN: usize = 12;
/// More blur than this is not told apart.
const BLUR_MAX_PX: f64 = 8.0;

/// Standard deviation of the blur of the strongest edges of a picture, px: their median.
///
/// `None` where no edge stands out, or where even the strongest are wider than 8 px. From 0.7 to 3 px
/// it is right within a tenth; beyond that it only says which of two pictures is the sharper one.
pub fn blur_px(picture: Plane<'_>) -> Option<f64> {
    let [width, height] = [picture.width(), picture.height()];
    if width.min(height) <= 2 * (BORDER + 1) {
        return None;
    }
    let grey: Vec<f32> =
        (0..height).flat_map(|y| picture.row(y).iter().map(|&grey| f32::from(grey))).collect();
    let [once, again] = BLURS_PX.map(|blur_px| blurred(&grey, width, blur_px));
    let gradient = |grey: &[f32], i: usize| {
        let [dx, dy] = [grey[i + 1] - grey[i - 1], grey[i + width] - grey[i - width]];
        (0.5 * dx, 0.5 * dy)
    };
    // So many pixels from the border.
    let inside = |border: usize| {
        (border..height - border)
            .flat_map(move |y| (y * width + border)..(y * width + width - border))
    };
    let mut strengths = vec![0.0; width * height];
    for i in inside(BORDER) {
        let (dx, dy) = gradient(&once, i);
        strengths[i] = dx.hypot(dy);
    }
    let mut ranked: Vec<f32> = inside(BORDER).map(|i| strengths[i]).collect();
    let [half, last] = [ranked.len() / 2, ranked.len() - 1 - ranked.len() / STRONGEST];
    let median = *ranked.select_nth_unstable_by(half, f32::total_cmp).1;
    let strongest = *ranked.select_nth_unstable_by(last, f32::total_cmp).1;
    let strong = (STRONG_SHARE * strongest).max(OVER_MEDIAN * median).max(GRADIENT_MIN);
    let [once_px2, again_px2] = BLURS_PX.map(|blur_px| blur_px * blur_px);
    let mut variances: Vec<f32> = inside(BORDER + 1)
        .filter(|&i| strengths[i] >= strong)
        .filter_map(|i| {
            let (dx, dy) = gradient(&once, i);
            // The crest of the edge: nothing beside it is steeper.
            let beside = if dx.abs() > dy.abs() { 1 } else { width };
            let is_crest =
                strengths[i] >= strengths[i - beside] && strengths[i] > strengths[i + beside];
            let (dx, dy) = gradient(&again, i);
            let ratio_squared = strengths[i].powi(2) / (dx * dx + dy * dy);
            (is_crest && ratio_squared > 1.0).then(|| {
                (again_px2 - ratio_squared * once_px2) / (ratio_squared - 1.0)
                    - DIFFERENCE_VARIANCE_PX2
            })
        })
        .collect();
    if variances.len() < POINTS_MIN {
        return None;
    }
    let middle = variances.len() / 2;
    let variance = *variances.select_nth_unstable_by(middle, f32::total_cmp).1;
    let blur_px = f64::from(variance.max(0.0)).sqrt();
    (blur_px <= BLUR_MAX_PX).then_some(blur_px)
}

/// A blurred picture; its border, as wide as the filter, is of no use.
fn blurred(grey: &[f32], width: usize, blur_px: f32) -> Vec<f32> {
    let weight = |k: usize| (-0.5 * ((k as f32 - RADIUS as f32) / blur_px).powi(2)).exp();
    let mut weights: [f32; 2 * RADIUS + 1] = std::array::from_fn(weight);
    let sum: f32 = weights.iter().sum();
    for weight in &mut weights {
        *weight /= sum;
    }
    let along = |grey: &[f32], step: usize| -> Vec<f32> {
        let mut out = vec![0.0; grey.len()];
        let reach = RADIUS * step;
        for (i, out) in out.iter_mut().enumerate().take(grey.len() - reach).skip(reach) {
            *out = weights.iter().enumerate().map(|(k, w)| w * grey[i + k * step - reach]).sum();
        }
        out
    };
    along(&along(grey, 1), width)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::synthetic::Random;

    const SIDE: usize = 120;

    /// A dark square turned by 10 degrees before a bright ground, blurred, with noise.
    fn square(sigma_px: f64, contrast: f64, noise: f64) -> Vec<u8> {
        let mut random = Random(7);
        let (sin, cos) = 10f64.to_radians().sin_cos();
        // The normal distribution to 0.0002: S. R. Bowling et al., 2009.
        let normal = |z: f64| 1.0 / (1.0 + (-1.5976 * z - 0.07056 * z.powi(3)).exp());
        let step = |x: f64| normal(x / sigma_px);
        (0..SIDE * SIDE)
            .map(|i| {
                let middle = SIDE as f64 / 2.0;
                let (x, y) = ((i % SIDE) as f64 - middle, (i / SIDE) as f64 - middle);
                let (u, v) = (cos * x + sin * y, cos * y - sin * x);
                let inside = |t: f64| step(t + 30.0) * step(30.0 - t);
                let grey = 150.0 - contrast * inside(u) * inside(v);
                (grey + noise * random.normal()).round().clamp(0.0, 255.0) as u8
            })
            .collect()
    }

    fn blur_of(pixels: &[u8]) -> Option<f64> {
        blur_px(Plane::packed(pixels, SIDE, SIDE).expect("fits"))
    }

    #[test]
    fn the_blur_of_edges_is_found() {
        for (contrast, noise) in [(100.0, 0.0), (100.0, 2.0), (40.0, 1.0)] {
            for sigma_px in [0.7, 1.0, 1.5, 2.0, 3.0] {
                let found = blur_of(&square(sigma_px, contrast, noise)).expect("edges");
                let off = (found - sigma_px).abs() / sigma_px;
                assert!(off < 0.1, "{sigma_px} px at {contrast}, noise {noise}: {found}");
            }
        }
    }

    #[test]
    fn the_sharper_picture_of_two_is_told_so_also_where_both_are_sharp() {
        let of = |sigma_px| blur_of(&square(sigma_px, 90.0, 1.0)).expect("edges");
        let blurs = [0.3, 0.6, 0.8, 1.0, 1.3, 2.0, 3.0, 5.0].map(of);
        assert!(blurs.is_sorted(), "{blurs:?}");
    }

    #[test]
    fn a_plain_wall_noise_and_a_picture_too_small_have_no_edge() {
        assert_eq!(blur_of(&[90; SIDE * SIDE]), None);
        let mut random = Random(3);
        let noise: Vec<u8> =
            (0..SIDE * SIDE).map(|_| (90.0 + 6.0 * random.normal()) as u8).collect();
        assert_eq!(blur_of(&noise), None);
        assert_eq!(blur_px(Plane::packed(&[0; 100], 10, 10).expect("fits")), None);
    }
}
