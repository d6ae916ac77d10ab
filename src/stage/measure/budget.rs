//! The error budget: what uncertainty a geometry leaves, from the fit's own normal equations
//! on the views that a perfect camera would take (DESIGN: error budget).

use super::corners::TopMotion;
use super::fit::{Estimate, Problem, Silhouette};
use super::model::{HEIGHT, LENGTH, Outline, Params, Rounding, SCALE, WIDTH};
use super::observe::PassView;
use super::{EDGE_COUNT_MIN, VIEWS_PER_ZONE};
use crate::belt::BeltPosition;
use crate::camera::BeltView;
use crate::units::BeltRect;
use nalgebra::{SVector, Vector2};

/// A geometry to judge.
#[derive(Clone, Copy, Debug)]
pub struct Geometry<'a> {
    /// The belt view that the camera gives.
    pub view: &'a BeltView,
    /// The measuring zone.
    pub zone: &'a BeltRect,
    /// Tallest parcel, mm.
    pub height_max_mm: f64,
    /// Belt travel from frame to frame, mm.
    pub travel_per_frame_mm: f64,
}

/// Expected standard deviations of length, width and height, mm, of a cuboid of `size_mm` turned by
/// `yaw_deg` that passes through the middle of the zone. `textured`: corners on its top are
/// followed. `None` when too little of it is seen to fit a cuboid.
pub fn expected_sigma_mm(
    geometry: &Geometry<'_>,
    size_mm: [f64; 3],
    yaw_deg: f64,
    textured: bool,
) -> Option<[f64; 3]> {
    let params = passing_middle(geometry.zone, size_mm, yaw_deg);
    let views = perfect_views(geometry, &params);
    let estimate = fit(geometry, &params, &views, textured)?;
    Some([LENGTH, WIDTH, HEIGHT].map(|i| estimate.sigma[i]))
}

/// Errors of length, width and height, mm, of such a cuboid without texture, when the picture of what is seen
/// at a place of the belt has moved by `moved_mm` of that place, and the belt's travel is taken
/// to be `travel_scale` of what it is.
pub fn bias_mm(
    geometry: &Geometry<'_>,
    size_mm: [f64; 3],
    yaw_deg: f64,
    moved_mm: &dyn Fn(Vector2<f64>) -> Vector2<f64>,
    travel_scale: f64,
) -> Option<[f64; 3]> {
    let params = passing_middle(geometry.zone, size_mm, yaw_deg);
    let mut views = perfect_views(geometry, &params);
    let before = fit(geometry, &params, &views, false)?;
    for view in &mut views {
        let outline = Outline::new(geometry.view, &params, view.travel_mm);
        let moved_px: Vec<f32> = view
            .samples()
            .iter()
            .map(|sample| {
                let [anchor, outward] = [sample.anchor, sample.outward]
                    .map(|[x, y]| Vector2::new(f64::from(x), f64::from(y)));
                (outward.dot(&moved_mm(anchor)) / geometry.view.mm_per_px) as f32
            })
            .collect();
        *view = PassView::of(&outline, view.travel_mm * travel_scale, |i| moved_px[i]);
    }
    let after = fit(geometry, &params, &views, false)?;
    Some([LENGTH, WIDTH, HEIGHT].map(|i| after.params[i] - before.params[i]))
}

fn passing_middle(
    zone: &BeltRect,
    [length_mm, width_mm, height_mm]: [f64; 3],
    yaw_deg: f64,
) -> Params {
    let centre = zone.centre();
    let yaw = yaw_deg.to_radians();
    Params::from([centre.x, centre.y, yaw, length_mm, width_mm, height_mm, 1.0])
}

/// How far a cuboid is followed before and after the middle of the zone, mm.
fn reach_mm(zone: &BeltRect, params: &Params) -> f64 {
    0.5 * zone.length_mm() + params[LENGTH].hypot(params[WIDTH])
}

/// What a perfect camera sees of it.
fn perfect_views(geometry: &Geometry<'_>, params: &Params) -> Vec<PassView> {
    let zone = geometry.zone;
    let step_mm = geometry.travel_per_frame_mm.max(zone.length_mm() / VIEWS_PER_ZONE);
    let count = (reach_mm(zone, params) / step_mm).floor() as i32;
    (-count..=count)
        .map(|i| f64::from(i) * step_mm)
        .map(|travel| PassView::of(&Outline::new(geometry.view, params, travel), travel, |_| 0.0))
        .collect()
}

/// The product's own fit to views of a cuboid; `None` when it does not come near.
fn fit(
    geometry: &Geometry<'_>,
    params: &Params,
    views: &[PassView],
    textured: bool,
) -> Option<Estimate> {
    // Measured all along by the belt's texture.
    let mut end = BeltPosition::default();
    end.advance(2.0 * reach_mm(geometry.zone, params), true);
    let ratio = geometry.view.magnification(params[HEIGHT]);
    let problem = Problem {
        geometry: geometry.view,
        zone: geometry.zone,
        height_max_mm: geometry.height_max_mm,
        rounding: Rounding::default(),
        reference_travel_mm: 0.0,
        travel_sigma: end.sigma_since(&BeltPosition::default()),
        silhouette: Silhouette::Whole,
        enclosing: false,
        top_motion: textured.then(|| TopMotion::certain(ratio)),
        view_stride: 1,
    };
    let estimate = problem.fit_edges(views, *params)?;
    let off = (estimate.params - params).component_mul(&SVector::from(KEPT)).amax();
    (off < NEAR_MM && estimate.edge_count >= EDGE_COUNT_MIN).then_some(estimate)
}

/// A fit that ends further from the truth has found something else.
const NEAR_MM: f64 = 2.0;
/// The parameters whose errors are mm.
const KEPT: [f64; super::model::N] = {
    let mut kept = [1.0; super::model::N];
    kept[super::model::YAW] = 0.0;
    kept[SCALE] = 0.0;
    kept
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::BeltMm;

    const ZONE: BeltRect =
        BeltRect { x_min_mm: -500.0, x_max_mm: 500.0, y_min_mm: -350.0, y_max_mm: 350.0 };

    fn sigma(height_of_camera_mm: f64, step_mm: f64, textured: bool) -> [f64; 3] {
        let view = BeltView {
            size_px: [1000, 700],
            mm_per_px: height_of_camera_mm / 1000.0,
            origin: BeltMm { x: -800.0, y: 600.0 },
            nadir: Vector2::new(0.0, 0.0),
            camera_height_mm: height_of_camera_mm,
        };
        let geometry = Geometry {
            view: &view,
            zone: &ZONE,
            height_max_mm: 400.0,
            travel_per_frame_mm: step_mm,
        };
        expected_sigma_mm(&geometry, [235.0, 125.0, 70.0], 20.0, textured).expect("seen")
    }

    #[test]
    fn a_higher_camera_fewer_frames_and_a_plain_top_measure_worse() {
        let [l, w, h] = sigma(1500.0, 20.0, true);
        let [l_high, w_high, h_high] = sigma(3000.0, 20.0, true);
        let [l_fast, w_fast, _] = sigma(1500.0, 200.0, true);
        let [.., h_plain] = sigma(1500.0, 20.0, false);
        assert!(l_high > l && w_high > w && h_high > h);
        assert!(l_fast > l && w_fast > w);
        assert!(h_plain > 1.2 * h, "{h_plain} {h}");
    }

    #[test]
    fn a_lens_that_zooms_makes_sides_longer_and_the_height_wrong_where_the_travel_is_known_otherwise()
     {
        let view = BeltView {
            size_px: [1000, 700],
            mm_per_px: 1.5,
            origin: BeltMm { x: -800.0, y: 600.0 },
            nadir: Vector2::new(0.0, 0.0),
            camera_height_mm: 1500.0,
        };
        let geometry =
            Geometry { view: &view, zone: &ZONE, height_max_mm: 400.0, travel_per_frame_mm: 20.0 };
        let zoom = 0.0004;
        let zoomed = |at: Vector2<f64>| zoom * at;
        let bias = |travel_scale: f64| {
            bias_mm(&geometry, [235.0, 125.0, 70.0], 20.0, &zoomed, travel_scale).expect("seen")
        };
        // The belt's texture zooms too.
        let [length, width, height] = bias(1.0 + zoom);
        let near = |value: f64, expected: f64| (value - expected).abs() < 0.03;
        assert!(near(length, zoom * 235.0) && near(width, zoom * 125.0), "{length} {width}");
        assert!(near(height, 0.0), "{height}");
        // What is faster by 1 part in 2500 looks higher by as much of the camera's distance.
        let [.., height] = bias(1.0);
        assert!((height - zoom * 1430.0).abs() < 0.2, "{height}");
        let none = bias_mm(&geometry, [235.0, 125.0, 70.0], 20.0, &|_| Vector2::zeros(), 1.0);
        assert_eq!(none, Some([0.0; 3]));
    }

    #[test]
    fn what_is_seen_in_one_frame_only_is_not_measured() {
        let view = BeltView {
            size_px: [1000, 700],
            mm_per_px: 1.5,
            origin: BeltMm { x: -800.0, y: 600.0 },
            nadir: Vector2::new(0.0, 0.0),
            camera_height_mm: 1500.0,
        };
        let geometry =
            Geometry { view: &view, zone: &ZONE, height_max_mm: 400.0, travel_per_frame_mm: 5e3 };
        assert!(expected_sigma_mm(&geometry, [235.0, 125.0, 70.0], 20.0, true).is_none());
    }
}
