//! The cuboid on the belt and its image in the belt view, with derivatives.
//!
//! Source: DESIGN "known motion". A point at height h over the belt point q appears at
//! `nadir + m (q - nadir)` with `m = Zc / (Zc - h)`, in mm on the belt plane.

use crate::camera::BeltView;
use nalgebra::{SMatrix, SVector, Vector2};

/// Number of parameters.
pub const N: usize = 7;
/// Footprint centre at the reference position of the belt, mm.
pub const X: usize = 0;
/// The same, across the belt.
pub const Y: usize = 1;
/// Direction of the length axis against +X, radians.
pub const YAW: usize = 2;
/// Footprint along the yaw direction, mm.
pub const LENGTH: usize = 3;
/// Footprint across it, mm.
pub const WIDTH: usize = 4;
/// Height over the belt, mm.
pub const HEIGHT: usize = 5;
/// True travel over assumed travel.
pub const SCALE: usize = 6;

/// Cuboid and motion: [X, Y, YAW, LENGTH, WIDTH, HEIGHT, SCALE].
pub type Params = SVector<f64, N>;

/// Directions in which the reach of a silhouette is kept, evenly around the circle.
pub const DIRECTIONS: usize = 32;

/// Unit vector of direction `k`.
pub fn direction(k: usize) -> Vector2<f64> {
    let angle = std::f64::consts::TAU * k as f64 / DIRECTIONS as f64;
    Vector2::new(angle.cos(), angle.sin())
}

/// Corners of the footprint in units of half length and half width, counter-clockwise.
/// Face k lies between corner k and corner k + 1.
const CORNERS: [[f64; 2]; 4] = [[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]];
/// Outward normals of the faces in the cuboid's own axes: +length, +width, -length, -width.
const NORMALS: [[f64; 2]; 4] = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]];

/// How rounded edges look. The grey value of an arc of radius r changes from the top face's to the
/// side's over the whole arc, and where the side is hidden the outline runs over the arc. The
/// middle of the change, projected to the height of the top face, is `-inset + drop * tan(tilt)`
/// outward, nearly linear in the tilt of the line of sight: as if the top face were smaller
/// and lower. For Lambertian shading under diffuse light (radiance proportional to 1 + cos) over
/// a belt half as bright as the side, visible sides give -0.21 r + 0.5 r tan(tilt), hidden ones
/// -0.14 r + 0.6 r tan(tilt).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rounding {
    /// Each edge of the top face appears this far inside, mm.
    pub inset_mm: f64,
    /// The top face appears this much lower, mm.
    pub drop_mm: f64,
}

impl Rounding {
    /// Edges of a radius, mm.
    pub fn of_radius(radius_mm: f64) -> Self {
        Self { inset_mm: 0.22 * radius_mm, drop_mm: 0.6 * radius_mm }
    }
}

/// A corner of the cuboid seen in the belt view.
#[derive(Clone, Copy, Debug)]
pub struct Vertex {
    /// Where it is over the belt, mm.
    pub over_belt: Vector2<f64>,
    /// Where it appears, mm on the belt plane.
    pub image: Vector2<f64>,
    /// Derivative of `image` by the parameters.
    pub jacobian: SMatrix<f64, 2, N>,
}

/// The cuboid as one frame shows it.
#[derive(Clone, Debug)]
pub struct Outline {
    /// Corners on the belt.
    pub base: [Vertex; 4],
    /// Corners of the top face.
    pub top: [Vertex; 4],
    /// Outward normals of the side faces.
    pub normals: [Vector2<f64>; 4],
    /// Whether the camera sees the side face.
    pub side_visible: [bool; 4],
}

/// A straight edge that the model predicts: of the top face (0 to 3) or of the base (4 to 7).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EdgeId(pub u8);

/// How many edges there are.
pub const EDGES: usize = 8;

impl EdgeId {
    /// Side face that the edge bounds.
    pub fn face(self) -> usize {
        usize::from(self.0 % 4)
    }

    /// On the belt rather than around the top face.
    pub fn is_base(self) -> bool {
        self.0 >= 4
    }
}

impl Outline {
    /// The cuboid when the belt has travelled `travel_mm` (as assumed) since the reference.
    pub fn new(view: &BeltView, params: &Params, travel_mm: f64) -> Self {
        Self::rounded(view, Rounding::default(), params, travel_mm)
    }

    /// The same with top edges where rounded ones appear.
    pub fn rounded(view: &BeltView, rounding: Rounding, params: &Params, travel_mm: f64) -> Self {
        let (sin, cos) = params[YAW].sin_cos();
        let along = Vector2::new(cos, sin);
        let across = Vector2::new(-sin, cos);
        let centre = Vector2::new(params[X] + params[SCALE] * travel_mm, params[Y]);
        let top_mm = params[HEIGHT] - rounding.drop_mm;
        let m = view.magnification(top_mm);
        // dm/dh = Zc / (Zc - h)^2
        let m_by_height = m * m / view.camera_height_mm;
        let vertex = |corner: [f64; 2], top: bool| {
            let [a, b] = corner.map(|c| 0.5 * c);
            let inset_mm = if top { 2.0 * rounding.inset_mm } else { 0.0 };
            let arm = along * (a * (params[LENGTH] - inset_mm))
                + across * (b * (params[WIDTH] - inset_mm));
            let over_belt = centre + arm;
            let mut jacobian = SMatrix::<f64, 2, N>::zeros();
            jacobian.set_column(X, &Vector2::new(1.0, 0.0));
            jacobian.set_column(Y, &Vector2::new(0.0, 1.0));
            jacobian.set_column(YAW, &Vector2::new(-arm.y, arm.x));
            jacobian.set_column(LENGTH, &(along * a));
            jacobian.set_column(WIDTH, &(across * b));
            jacobian.set_column(SCALE, &Vector2::new(travel_mm, 0.0));
            let mut image = over_belt;
            if top {
                jacobian *= m;
                jacobian.set_column(HEIGHT, &((over_belt - view.nadir) * m_by_height));
                image = view.project(over_belt, top_mm);
            }
            Vertex { over_belt, image, jacobian }
        };
        let base = CORNERS.map(|c| vertex(c, false));
        let normals = NORMALS.map(|[a, b]| along * a + across * b);
        let side_visible =
            std::array::from_fn(|k| normals[k].dot(&(view.nadir - base[k].over_belt)) > 0.0);
        Self { base, top: CORNERS.map(|c| vertex(c, true)), normals, side_visible }
    }

    /// Both ends of an edge.
    pub fn ends(&self, edge: EdgeId) -> [&Vertex; 2] {
        let corners = if edge.is_base() { &self.base } else { &self.top };
        [&corners[edge.face()], &corners[(edge.face() + 1) % 4]]
    }

    /// Whether the camera sees the edge: all of the top face, the base below visible sides.
    pub fn visible(&self, edge: EdgeId) -> bool {
        !edge.is_base() || self.side_visible[edge.face()]
    }

    /// Distance in the view between a face's base edge and its top edge, mm.
    pub fn side_depth_mm(&self, face: usize) -> f64 {
        self.normals[face].dot(&(self.base[face].image - self.top[face].image)).abs()
    }

    /// The corner that reaches furthest in `direction`.
    pub fn support(&self, direction: Vector2<f64>) -> &Vertex {
        let mut best = &self.base[0];
        for vertex in self.base.iter().chain(&self.top) {
            if vertex.image.dot(&direction) > best.image.dot(&direction) {
                best = vertex;
            }
        }
        best
    }

    /// Whether a point of the belt plane lies in the silhouette, or within `margin_mm` of it.
    pub fn covers(&self, at: Vector2<f64>, margin_mm: f64) -> bool {
        (0..DIRECTIONS)
            .map(direction)
            .all(|d| at.dot(&d) <= self.support(d).image.dot(&d) + margin_mm)
    }

    /// The upstream end on the belt, mm.
    pub fn trailing_x_mm(&self) -> f64 {
        self.base.iter().map(|v| v.over_belt.x).fold(f64::INFINITY, f64::min)
    }
}

/// The same cuboid, its axes named as those of `other`: faces keep their identity.
pub fn named_like(mut params: Params, other: &Params) -> Params {
    use std::f64::consts::FRAC_PI_2;
    let quarters = ((other[YAW] - params[YAW]) / FRAC_PI_2).round();
    params[YAW] += quarters * FRAC_PI_2;
    if quarters.rem_euclid(2.0) > 0.5 {
        params.swap_rows(LENGTH, WIDTH);
    }
    params
}

/// With length >= width and yaw in (-90, 90] degrees; the same cuboid.
pub fn canonical(mut params: Params) -> Params {
    use std::f64::consts::{FRAC_PI_2, PI};
    if params[LENGTH] < params[WIDTH] {
        params.swap_rows(LENGTH, WIDTH);
        params[YAW] += FRAC_PI_2;
    }
    params[YAW] = params[YAW].rem_euclid(PI);
    if params[YAW] > FRAC_PI_2 {
        params[YAW] -= PI;
    }
    params
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::BeltMm;

    fn view() -> BeltView {
        BeltView {
            size_px: [100, 100],
            mm_per_px: 1.0,
            origin: BeltMm { x: 0.0, y: 0.0 },
            nadir: Vector2::new(12.0, -7.0),
            camera_height_mm: 1500.0,
        }
    }

    #[test]
    fn the_jacobian_is_the_derivative() {
        let params = Params::from([120.0, -60.0, 0.4, 230.0, 120.0, 90.0, 1.01]);
        let at = |p: &Params| Outline::new(&view(), p, 250.0);
        let outline = at(&params);
        for j in 0..N {
            let h = 1e-4;
            let (mut less, mut more) = (params, params);
            less[j] -= h;
            more[j] += h;
            let (less, more) = (at(&less), at(&more));
            for (k, v) in outline.base.iter().chain(&outline.top).enumerate() {
                let image = |o: &Outline| if k < 4 { o.base[k].image } else { o.top[k - 4].image };
                let numeric = (image(&more) - image(&less)) / (2.0 * h);
                // Central differences in f64 with h = 1e-4 are good to 1e-6 here.
                assert!((numeric - v.jacobian.column(j)).norm() < 1e-5, "parameter {j} vertex {k}");
            }
        }
    }

    #[test]
    fn rounded_edges_appear_inside_and_lower() {
        let params = Params::from([300.0, -7.0, 0.0, 90.0, 50.0, 40.0, 1.0]);
        let rounding = Rounding { inset_mm: 0.5, drop_mm: 2.0 };
        let smaller = Params::from([300.0, -7.0, 0.0, 89.0, 49.0, 38.0, 1.0]);
        let rounded = Outline::rounded(&view(), rounding, &params, 20.0);
        let [sharp, smaller] = [params, smaller].map(|p| Outline::new(&view(), &p, 20.0));
        for k in 0..4 {
            assert!((rounded.top[k].image - smaller.top[k].image).norm() < 1e-9);
            assert_eq!(rounded.base[k].image, sharp.base[k].image);
        }
    }

    #[test]
    fn a_silhouette_covers_its_corners_and_not_its_neighbours() {
        let outline =
            Outline::new(&view(), &Params::from([300.0, -7.0, 0.3, 90.0, 50.0, 40.0, 1.0]), 0.0);
        for vertex in outline.base.iter().chain(&outline.top) {
            assert!(outline.covers(vertex.image, 1e-9));
        }
        assert!(!outline.covers(Vector2::new(300.0, 60.0), 5.0));
        assert!(outline.covers(Vector2::new(300.0, 40.0), 30.0));
    }

    #[test]
    fn sides_facing_the_nadir_are_visible() {
        let outline =
            Outline::new(&view(), &Params::from([300.0, -7.0, 0.0, 50.0, 50.0, 40.0, 1.0]), 0.0);
        assert_eq!(outline.side_visible, [false, false, true, false]);
    }

    #[test]
    fn a_cuboid_under_the_camera_shows_no_side() {
        let outline =
            Outline::new(&view(), &Params::from([12.0, -7.0, 0.3, 50.0, 50.0, 40.0, 1.0]), 0.0);
        assert_eq!(outline.side_visible, [false; 4]);
    }

    #[test]
    fn axes_named_like_another_s_keep_the_cuboid() {
        let params = Params::from([0.0, 0.0, -0.1, 440.0, 118.0, 5.0, 1.0]);
        for yaw in [-0.1, 1.48, 3.0, -1.6, 7.9, 20.3] {
            let mut other = params;
            other[YAW] = yaw;
            let named = named_like(params, &other);
            assert!((named[YAW] - yaw).abs() <= std::f64::consts::FRAC_PI_4 + 1e-12);
            let [before, after] = [params, named].map(|p| Outline::new(&view(), &p, 0.0));
            for v in &before.top {
                assert!(after.top.iter().any(|o| (o.image - v.image).norm() < 1e-9));
            }
        }
    }

    #[test]
    fn canonical_form_keeps_the_cuboid() {
        for yaw_deg in [-170.0, -95.0, -90.0, 0.0, 45.0, 90.0, 91.0, 179.0, 300.0_f64] {
            for (l, w) in [(30.0, 20.0), (20.0, 30.0)] {
                let params = Params::from([0.0, 0.0, yaw_deg.to_radians(), l, w, 5.0, 1.0]);
                let c = canonical(params);
                assert!(c[LENGTH] >= c[WIDTH]);
                assert!(c[YAW] > -std::f64::consts::FRAC_PI_2 - 1e-12);
                assert!(c[YAW] <= std::f64::consts::FRAC_PI_2 + 1e-12);
                let (before, after) =
                    (Outline::new(&view(), &params, 0.0), Outline::new(&view(), &c, 0.0));
                for v in &before.top {
                    assert!(after.top.iter().any(|o| (o.image - v.image).norm() < 1e-9));
                }
            }
        }
    }
}
