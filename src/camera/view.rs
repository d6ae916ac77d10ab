//! The belt view: a virtual camera at the real one's centre, looking perpendicularly at the belt.
//!
//! Its image plane is the belt plane itself, so a pixel is a point of the belt in mm, all
//! motion is horizontal, and a point at height h lies away from the nadir by the factor
//! `Zc / (Zc - h)`, the magnification (DESIGN: known motion).

use super::Camera;
use crate::units::{BeltMm, BeltPx, BeltRect};
use nalgebra::{Vector2, Vector3};

/// Around the zone this many px are kept: edges at its border need their surroundings.
const MARGIN_PX: f64 = 30.0;

/// Geometry of the belt view. Row 0 is the left edge of the belt seen along travel.
#[derive(Clone, Debug, PartialEq)]
pub struct BeltView {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Size of a pixel on the belt, both directions.
    pub mm_per_px: f64,
    /// Belt coordinates of the centre of pixel (0, 0).
    pub origin: BeltMm,
    /// The point of the belt under the camera.
    pub nadir: Vector2<f64>,
    /// Camera height above the belt.
    pub camera_height_mm: f64,
}

impl BeltView {
    fn full(camera: &Camera, zone: &BeltRect, height_max_mm: f64, mm_per_px: f64) -> Self {
        let centre = camera.centre_in_belt();
        let (nadir, camera_height_mm) = (Vector2::new(centre.x, centre.y), centre.z);
        let margin_mm = MARGIN_PX * mm_per_px;
        let magnification = camera_height_mm / (camera_height_mm - height_max_mm);
        let away = |edge_mm: f64, nadir_mm: f64| nadir_mm + magnification * (edge_mm - nadir_mm);
        let x_min = zone.x_min_mm.min(away(zone.x_min_mm, nadir.x)) - margin_mm;
        let x_max = zone.x_max_mm.max(away(zone.x_max_mm, nadir.x)) + margin_mm;
        let y_min = zone.y_min_mm.min(away(zone.y_min_mm, nadir.y)) - margin_mm;
        let y_max = zone.y_max_mm.max(away(zone.y_max_mm, nadir.y)) + margin_mm;
        let count = |length_mm: f64| (length_mm / mm_per_px).ceil() as usize + 1;
        Self {
            size_px: [count(x_max - x_min), count(y_max - y_min)],
            mm_per_px,
            origin: BeltMm { x: x_min, y: y_max },
            nadir,
            camera_height_mm,
        }
    }

    /// Columns and rows before anything is cut to the camera's image.
    pub fn full_size_px(
        camera: &Camera,
        zone: &BeltRect,
        height_max_mm: f64,
        mm_per_px: f64,
    ) -> [usize; 2] {
        Self::full(camera, zone, height_max_mm, mm_per_px).size_px
    }

    /// The view that holds every image of an object up to `height_max_mm` standing in `zone`,
    /// cut to what the camera's image holds. Never empty for a zone that the camera sees.
    pub fn covering(camera: &Camera, zone: &BeltRect, height_max_mm: f64, mm_per_px: f64) -> Self {
        Self::full(camera, zone, height_max_mm, mm_per_px).cut_to_image(camera)
    }

    /// The bounding box of the pixels that the camera sees, found on a coarse grid.
    fn cut_to_image(self, camera: &Camera) -> Self {
        const GRID_PX: usize = 8;
        let [width, height] = self.size_px;
        let grid = |n: usize| (0..n).step_by(GRID_PX).chain([n - 1]);
        let (mut u_range, mut v_range) = ((width, 0), (height, 0));
        for v in grid(height) {
            for u in grid(width) {
                let at = self.belt_point(BeltPx { u: u as f64, v: v as f64 });
                let raw = camera.project(Vector3::new(at.x, at.y, 0.0));
                if raw.is_some_and(|px| camera.sees(px)) {
                    u_range = (u_range.0.min(u), u_range.1.max(u));
                    v_range = (v_range.0.min(v), v_range.1.max(v));
                }
            }
        }
        if u_range.0 > u_range.1 {
            return self;
        }
        let (u0, v0) = (u_range.0.saturating_sub(GRID_PX), v_range.0.saturating_sub(GRID_PX));
        let (u1, v1) =
            ((u_range.1 + GRID_PX).min(width - 1), (v_range.1 + GRID_PX).min(height - 1));
        Self {
            origin: self.belt_point(BeltPx { u: u0 as f64, v: v0 as f64 }),
            size_px: [u1 - u0 + 1, v1 - v0 + 1],
            ..self
        }
    }

    /// Point of the belt plane at a view pixel.
    pub fn belt_point(&self, px: BeltPx) -> BeltMm {
        BeltMm {
            x: self.origin.x + px.u * self.mm_per_px,
            y: self.origin.y - px.v * self.mm_per_px,
        }
    }

    /// View pixel of a point of the belt plane.
    pub fn px(&self, at: BeltMm) -> BeltPx {
        BeltPx {
            u: (at.x - self.origin.x) / self.mm_per_px,
            v: (self.origin.y - at.y) / self.mm_per_px,
        }
    }

    /// Image, on the belt plane in mm, of a point `height_mm` above the belt.
    pub fn project(&self, at: Vector2<f64>, height_mm: f64) -> Vector2<f64> {
        self.nadir + self.magnification(height_mm) * (at - self.nadir)
    }

    /// `Zc / (Zc - h)`: how much faster than the belt a point at height h moves in the view.
    pub fn magnification(&self, height_mm: f64) -> f64 {
        self.camera_height_mm / (self.camera_height_mm - height_mm)
    }
}
