//! Stills of a chessboard, for calibrating the synthetic belt's camera: held before the lens, or carried
//! by the belt.

use super::noise::Noise;
use super::{Scenario, Synthetic};
use crate::camera::calibrate::Pose;
use crate::camera::chessboard::Chessboard;
use crate::camera::{Camera, Lens};
use crate::error::Result;
use crate::source::Still;
use crate::units::RawPx;
use nalgebra::{Matrix3, Rotation3, Vector3};

/// Samples of a pixel in each direction.
const SUB: usize = 4;
/// Grey levels: ink, paper, and the dim room behind a board that is held.
const INK: f64 = 30.0;
const PAPER: f64 = 200.0;
const ROOM: f64 = 70.0;
/// Paper beyond the outer squares, in squares.
const RIM: f64 = 0.6;

/// Makes stills.
pub struct BoardStills {
    synthetic: Synthetic,
    camera: Camera,
    board: Chessboard,
    noise: Noise,
    /// The ray of every pixel in the camera frame; NaN beyond the lens model.
    rays: Vec<Vector3<f64>>,
    taken: u64,
}

impl BoardStills {
    /// Stills by the camera of a scenario, with its noise.
    pub fn new(scenario: Scenario, board: Chessboard) -> Result<Self> {
        let camera = scenario.camera()?;
        let [width, height] = camera.image_size_px;
        let ray = |i: usize| {
            let px = RawPx { x: (i % width) as f64, y: (i / width) as f64 };
            camera.lens.unproject(px).unwrap_or(Vector3::repeat(f64::NAN))
        };
        let rays = (0..width * height).map(ray).collect();
        let noise = Noise::new(scenario.seed, &scenario.noise);
        let synthetic = Synthetic::new(scenario)?;
        Ok(Self { synthetic, camera, board, noise, rays, taken: 0 })
    }

    /// The board turned about its middle by angles (degrees) about the camera's x, y and z axes, its
    /// middle at a place in the camera frame.
    pub fn held(&mut self, angles_deg: [f64; 3], middle_mm: [f64; 3]) -> Still {
        let turn = |axis: Vector3<f64>, k: usize| Rotation3::new(axis * angles_deg[k].to_radians());
        let rotation = turn(Vector3::x(), 0) * turn(Vector3::y(), 1) * turn(Vector3::z(), 2);
        let [columns, rows] = [self.board.columns, self.board.rows].map(|n| n as f64 - 1.0);
        let middle = 0.5 * self.board.square_mm * Vector3::new(columns, rows, 0.0);
        let pose = Pose {
            rotation: *rotation.matrix(),
            translation_mm: Vector3::from(middle_mm) - rotation * middle,
        };
        let mut clean = vec![(ROOM * 256.0) as u16; self.rays.len()];
        self.paint(&pose, &mut clean);
        self.develop(&clean)
    }

    /// The board lying on the belt, its printed face so far above it, its first corner at a place of
    /// the belt, its longer side turned so far from +X.
    pub fn on_belt(&mut self, corner_mm: [f64; 2], yaw_deg: f64, thickness_mm: f64) -> Still {
        let mut clean = vec![0; self.rays.len()];
        self.synthetic.renderer.render(0, &mut clean);
        // Face up: its rows go to -Y.
        let flat = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
        let turned = Rotation3::new(Vector3::z() * yaw_deg.to_radians()).into_inner() * flat;
        let [x, y] = corner_mm;
        let at = Vector3::new(x, y, thickness_mm);
        let pose = Pose {
            rotation: self.camera.camera_from_belt * turned,
            translation_mm: self.camera.camera_from_belt * at + self.camera.translation_mm,
        };
        self.paint(&pose, &mut clean);
        self.develop(&clean)
    }

    /// Draw the board over a clean frame, 1/256 grey levels.
    fn paint(&self, pose: &Pose, clean: &mut [u16]) {
        let board_from_camera = pose.rotation.transpose();
        let centre = -(board_from_camera * pose.translation_mm);
        let width = self.camera.image_size_px[0];
        for i in width + 1..clean.len().saturating_sub(width + 1) {
            let at = |ray: Vector3<f64>| {
                let ray = board_from_camera * ray;
                let scale = -centre.z / ray.z;
                (scale > 0.0).then(|| (centre + scale * ray).xy() / self.board.square_mm)
            };
            let slope = |a: usize, b: usize| 0.5 * (self.rays[a] - self.rays[b]);
            let (du, dv) = (slope(i + 1, i - 1), slope(i + width, i - width));
            let behind = f64::from(clean[i]);
            let mut sum = 0.0;
            for k in 0..SUB * SUB {
                let place = |n: usize| (n as f64 + 0.5) / SUB as f64 - 0.5;
                let ray = self.rays[i] + place(k % SUB) * du + place(k / SUB) * dv;
                let grey = at(ray).and_then(|p| self.grey(p.x, p.y));
                sum += grey.map_or(behind, |grey| 256.0 * grey);
            }
            clean[i] = (sum / (SUB * SUB) as f64) as u16;
        }
    }

    /// The print at a place in squares from the first corner; `None` beside the paper.
    fn grey(&self, x: f64, y: f64) -> Option<f64> {
        let [columns, rows] = [self.board.columns as f64, self.board.rows as f64];
        let on = |rim: f64| {
            (-1.0 - rim..columns + rim).contains(&x) && (-1.0 - rim..rows + rim).contains(&y)
        };
        // The square before the first corner is dark.
        let dark = (x.floor() + y.floor()).rem_euclid(2.0) < 0.5;
        on(RIM).then_some(if on(0.0) && dark { INK } else { PAPER })
    }

    fn develop(&mut self, clean: &[u16]) -> Still {
        let size_px = self.camera.image_size_px;
        let mut pixels = vec![0; clean.len()];
        self.noise.apply(self.taken, clean, size_px[0], &mut pixels);
        self.taken += 1;
        Still { pixels, size_px }
    }
}

/// What a technician takes of a lens: tilted to all sides, everywhere in the image.
pub fn held_poses(lens: &Lens, size_px: [usize; 2]) -> Vec<([f64; 3], [f64; 3])> {
    const TILTS_DEG: [[f64; 2]; 5] =
        [[32.0, 0.0], [-32.0, 8.0], [6.0, 34.0], [-8.0, -34.0], [24.0, -24.0]];
    const VIEWS: usize = 15;
    const NEAREST_MM: f64 = 380.0;
    let [focal_px, ..] = lens.parameters();
    let [width, height] = size_px.map(|n| n as f64);
    let pose = |k: usize| {
        let (column, row) = (k as f64 % 3.0 - 1.0, (k / 3) as f64 % 3.0 - 1.0);
        let z_mm = NEAREST_MM + 12.0 * k as f64;
        let tilt = TILTS_DEG[k % TILTS_DEG.len()];
        // To two thirds of the way to the image's border.
        let at = [column * width, row * height].map(|px| 0.3 * px / focal_px * z_mm);
        ([tilt[0], tilt[1], 25.0 * k as f64], [at[0], at[1], z_mm])
    };
    (0..VIEWS).map(pose).collect()
}
