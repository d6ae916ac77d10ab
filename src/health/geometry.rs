//! What a small motion of the camera does to its picture, and what that does to what is measured.
//!
//! The camera may turn about its three axes, move along its picture, and its lens may zoom (or it
//! comes nearer). What stands in the picture is taken to be about as far away as the belt.
//! Source: Longuet-Higgins and Prazdny 1980 for the field of motion.

use crate::camera::Camera;
use crate::config::Site;
use crate::stage::measure::budget::{Geometry, bias_mm};
use crate::units::{BeltMm, BeltRect, RawPx};
use nalgebra::{SMatrix, SVector, Vector2, Vector3};

/// Turn about the picture's x, y and optical axis, shift along x and y, all in radians; zoom, a share.
pub const PARAMETERS: usize = 6;
/// A motion of the camera.
pub type Motion = SVector<f64, PARAMETERS>;
/// How a place in the picture, px, or on the belt, mm, moves with each parameter.
pub type Rates = SMatrix<f64, 2, PARAMETERS>;
/// What each parameter does to length, width and height.
type Biases = SMatrix<f64, 3, PARAMETERS>;

/// How large each parameter may be: a knock turns a camera, and hardly shifts it.
pub const PRIOR_SIGMA: [f64; PARAMETERS] = [0.2, 0.2, 0.2, 0.001, 0.001, 0.2];
/// Step of the numerical derivatives.
const STEP: f64 = 1e-4;
/// Sides of the parcels that the error in mm is told for: a common one, a large one, a flat one.
const PARCELS_MM: [[f64; 3]; 3] =
    [[235.0, 125.0, 70.0], [400.0, 300.0, 200.0], [240.0, 160.0, 20.0]];
const YAW_DEG: f64 = 20.0;
/// The parcels' bias is linear up to here, mm on the belt.
const LINEAR_MM: f64 = 0.3;
/// Points of the zone along and across.
const GRID: usize = 3;

/// How the ray (x, y, 1) moves with each parameter.
fn fields(x: f64, y: f64) -> Rates {
    Rates::from_columns(&[
        Vector2::new(x * y, 1.0 + y * y),
        Vector2::new(1.0 + x * x, x * y),
        Vector2::new(-y, x),
        Vector2::new(1.0, 0.0),
        Vector2::new(0.0, 1.0),
        Vector2::new(x, y),
    ])
}

/// How the picture moves at a pixel, px; `None` where the lens shows nothing.
pub fn rates_px(camera: &Camera, px: RawPx) -> Option<Rates> {
    let ray = camera.lens.unproject(px)?;
    let [x, y] = [ray.x / ray.z, ray.y / ray.z];
    let fields = fields(x, y);
    let mut rates = Rates::zeros();
    for k in 0..PARAMETERS {
        let moved = |step: f64| {
            let at = fields.column(k) * step;
            camera.lens.project(Vector3::new(x + at.x, y + at.y, 1.0))
        };
        let (to, from) = (moved(STEP)?, moved(-STEP)?);
        rates.set_column(k, &(Vector2::new(to.x - from.x, to.y - from.y) / (2.0 * STEP)));
    }
    Some(rates)
}

/// What a motion of the camera does in the measuring zone.
pub struct Effect {
    /// At each point of a grid over the zone: in the picture, px, and on the belt, mm.
    zone: heapless::Vec<[Rates; 2], { GRID * GRID }>,
    /// Of each parcel that fits under the camera.
    parcels: heapless::Vec<Biases, { PARCELS_MM.len() }>,
}

/// What a motion of the camera comes to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Displacement {
    /// Of the picture in the zone, on average, px of the camera.
    pub picture_px: f64,
    /// Of the picture in the zone, on average, mm on the belt.
    pub belt_mm: f64,
    /// The largest error that it causes in the zone: of a place on the belt, or of a parcel's length,
    /// width or height.
    pub error_mm: f64,
}

impl Effect {
    /// Compute the tables; allocates.
    pub fn new(site: &Site) -> Self {
        let (camera, zone) = (&site.camera, &site.config.zone);
        let rates = |at: BeltMm| {
            let raw = camera.project(Vector3::new(at.x, at.y, 0.0))?;
            let px = rates_px(camera, raw)?;
            let mut mm = Rates::zeros();
            for k in 0..PARAMETERS {
                mm.set_column(k, &(moved_mm(camera, at, &unit(k, STEP))? / STEP));
            }
            Some([px, mm])
        };
        // There are as many places as points, and as sizes.
        let mut effect =
            Self { zone: grid(zone).filter_map(rates).collect(), parcels: heapless::Vec::new() };
        let sizes = PARCELS_MM.into_iter().filter(|size| size[2] <= site.height_max_mm);
        effect.parcels = sizes.filter_map(|size_mm| effect.biases(site, size_mm)).collect();
        effect
    }

    /// The fit's own answer to what each parameter does to the edges of a parcel.
    fn biases(&self, site: &Site, size_mm: [f64; 3]) -> Option<Biases> {
        let zone = &site.config.zone;
        let geometry = Geometry {
            view: &site.view,
            zone,
            height_max_mm: site.height_max_mm,
            travel_per_frame_mm: 0.0,
        };
        let mut biases = Biases::zeros();
        for k in 0..PARAMETERS {
            let step = LINEAR_MM / self.displacement(&unit(k, 1.0)).belt_mm;
            let motion = unit(k, step);
            let moved = |at: Vector2<f64>| {
                moved_mm(&site.camera, BeltMm { x: at.x, y: at.y }, &motion).unwrap_or_default()
            };
            // The belt's texture shows its travel in the same picture; an encoder does not.
            let centre = zone.centre();
            let [first, last] =
                [zone.x_min_mm, zone.x_max_mm].map(|x| moved(Vector2::new(x, centre.y)).x);
            let by_encoder = site.config.encoder.mm_per_count.is_some();
            let stretch = if by_encoder { 0.0 } else { (last - first) / zone.length_mm() };
            let bias = bias_mm(&geometry, size_mm, YAW_DEG, &moved, 1.0 + stretch)?;
            biases.set_column(k, &(Vector3::from(bias) / step));
        }
        Some(biases)
    }

    /// What a motion of the camera comes to.
    pub fn displacement(&self, motion: &Motion) -> Displacement {
        let count = self.zone.len().max(1) as f64;
        let moved =
            |which: usize| self.zone.iter().map(move |rates| (rates[which] * motion).norm());
        let dimensions = self.parcels.iter().map(|biases| (biases * motion).amax());
        Displacement {
            picture_px: moved(0).sum::<f64>() / count,
            belt_mm: moved(1).sum::<f64>() / count,
            error_mm: moved(1).chain(dimensions).fold(0.0, f64::max),
        }
    }

    /// Standard deviations of the displacement on the belt along and across travel, mm, on average over
    /// the zone, when the motion is known so well.
    pub fn sigma_mm(&self, covariance: &SMatrix<f64, PARAMETERS, PARAMETERS>) -> [f64; 2] {
        let mut sum = [0.0; 2];
        for [_, mm] in &self.zone {
            let of = mm * covariance * mm.transpose();
            sum = [sum[0] + of[(0, 0)], sum[1] + of[(1, 1)]];
        }
        sum.map(|sum| (sum / self.zone.len().max(1) as f64).sqrt())
    }
}

fn unit(k: usize, step: f64) -> Motion {
    let mut motion = Motion::zeros();
    motion[k] = step;
    motion
}

fn grid(zone: &BeltRect) -> impl Iterator<Item = BeltMm> + use<> {
    let at = |from: f64, to: f64, i: usize| from + (to - from) * i as f64 / (GRID - 1) as f64;
    let (x, y) = ((zone.x_min_mm, zone.x_max_mm), (zone.y_min_mm, zone.y_max_mm));
    (0..GRID * GRID).map(move |i| BeltMm { x: at(x.0, x.1, i % GRID), y: at(y.0, y.1, i / GRID) })
}

/// How far what is seen at a place of the belt seems to have moved there, mm.
fn moved_mm(camera: &Camera, at: BeltMm, motion: &Motion) -> Option<Vector2<f64>> {
    let raw = camera.project(Vector3::new(at.x, at.y, 0.0))?;
    let by = rates_px(camera, raw)? * motion;
    let seen = camera.belt_point(RawPx { x: raw.x + by.x, y: raw.y + by.y })?;
    Some(Vector2::new(seen.x - at.x, seen.y - at.y))
}
