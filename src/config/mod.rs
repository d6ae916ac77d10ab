//! TOML -> validated [`Config`]. Every key but those of the smallest configuration has a default;
//! unknown keys are refused; a wrong value names file, key, value, allowed range and remedy.

mod fleet;
mod health;
mod json_schema;
mod plc;
mod ranges;
mod schema;
mod service;

pub use fleet::Fleet;
pub use health::Health;
pub use json_schema::json_schema;
pub use plc::{Can, DimensionOrder, Encoder, Modbus, Plc, WordOrder};
pub use schema::{
    Background, CameraTable, Config, Import, Interface, Limits, Measure, Odometry, Realtime,
    Segment, View, public_key,
};
pub use service::{Archive, Log, Web};

use crate::camera::{BeltView, Camera, CameraFile};
use crate::error::{Error, Result};
use crate::units::{BeltMm, BeltRect};
use nalgebra::Vector3;
use std::path::Path;

/// A configuration with its camera, cross-checked: what the pipeline is built from.
#[derive(Clone, Debug)]
pub struct Site {
    /// The validated keys.
    pub config: Config,
    /// The calibrated camera.
    pub camera: Camera,
    /// The belt view that follows from both.
    pub view: BeltView,
    /// Largest object height that the view has room for, mm.
    pub height_max_mm: f64,
}

impl Site {
    /// Read a configuration and the calibration it names.
    pub fn load(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| {
            Error::configuration(format!("cannot read the configuration: {e}"))
                .in_file(path)
                .remedy("give an existing file with --config")
        })?;
        let config = Config::parse(&text).map_err(|e| e.in_file(path))?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let camera = CameraFile::load(&folder.join(&config.camera.calibration))?;
        let mut site = Self::new(config, camera).map_err(|e| e.in_file(path))?;
        site.beside(path);
        Ok(site)
    }

    /// Files that the configuration names are beside it.
    pub fn beside(&mut self, path: &Path) {
        let folder = path.parent().unwrap_or(Path::new("."));
        let Config { camera, plc, archive, fleet, .. } = &mut self.config;
        let named =
            [&mut plc.state_file, &mut archive.folder, &mut fleet.login_file, &mut fleet.ca_file];
        for file in named.into_iter().flatten().chain([&mut camera.calibration]) {
            *file = folder.join(&*file);
        }
    }

    /// Check the configuration against the camera.
    pub fn new(config: Config, camera: Camera) -> Result<Self> {
        let zone = config.zone;
        check_zone_in_view(&camera, &zone)?;
        let camera_height_mm = camera.centre_in_belt().z;
        let height_max_mm = height_max(&config.view, camera_height_mm)?;
        let mm_per_px = match config.view.mm_per_px {
            Some(mm) => mm,
            // Sees as much as the camera does in the middle of the zone, and no more.
            None => camera.mm_per_px(zone.centre()).ok_or_else(|| {
                Error::configuration("the camera does not see the middle of the zone")
                    .remedy("check [zone] and the calibration's [pose]")
            })?,
        };
        // Kernels index columns with 16 bits.
        let [w, h] = BeltView::full_size_px(&camera, &zone, height_max_mm, mm_per_px);
        if w.max(h) > 8192 {
            return Err(Error::configuration(format!("the belt view would be {w} x {h} px"))
                .allowed("8192 px a side")
                .remedy(
                    "set a larger view.mm_per_px, a smaller zone or a lower view.height_max_mm",
                ));
        }
        let view = BeltView::covering(&camera, &zone, height_max_mm, mm_per_px);
        check_zone_in_belt_view(&view, &zone)?;
        Ok(Self { config, camera, view, height_max_mm })
    }
}

impl Site {
    /// Refuse frames of another size than the calibration's.
    pub fn check_image_size(&self, [width, height]: [usize; 2]) -> Result<()> {
        let expected = self.camera.image_size_px;
        if [width, height] == expected {
            return Ok(());
        }
        Err(Error::configuration(format!("the input has frames of {width} x {height} px"))
            .allowed(format!(
                "{} x {} px, the calibration's image_size_px",
                expected[0], expected[1]
            ))
            .remedy("use the calibration of this camera and image size"))
    }
}

/// Magnification grows without bound towards the camera; beyond this an object fills the view.
const HEIGHT_MAX_OF_CAMERA_HEIGHT: f64 = 0.8;

fn height_max(view: &View, camera_height_mm: f64) -> Result<f64> {
    let limit = HEIGHT_MAX_OF_CAMERA_HEIGHT * camera_height_mm;
    match view.height_max_mm {
        None => Ok(400.0_f64.min(0.4 * camera_height_mm)),
        Some(mm) if mm <= limit => Ok(mm),
        Some(mm) => Err(Error::configuration(format!(
            "view.height_max_mm = {mm}, but the camera is {camera_height_mm:.0} mm above the belt"
        ))
        .allowed(format!("up to {limit:.0} mm"))
        .remedy("lower it, or mount the camera higher and calibrate again")),
    }
}

/// Points checked on each side of the zone.
const SIDE_POINTS: u32 = 16;

fn check_zone_in_view(camera: &Camera, zone: &BeltRect) -> Result<()> {
    // Between its corners a side may bulge out of a distorted image.
    let [a, b, c, d] = zone.corners();
    let along = |from: BeltMm, to: BeltMm| {
        (0..SIDE_POINTS).map(move |i| {
            let t = f64::from(i) / f64::from(SIDE_POINTS);
            BeltMm { x: from.x + t * (to.x - from.x), y: from.y + t * (to.y - from.y) }
        })
    };
    // Corners first: their numbers are those of the file.
    let corners = [a, b, c, d].into_iter();
    let sides = along(a, b).chain(along(b, c)).chain(along(c, d)).chain(along(d, a));
    for corner in corners.chain(sides) {
        let raw = camera.project(Vector3::new(corner.x, corner.y, 0.0));
        if raw.is_some_and(|px| camera.sees(px)) {
            continue;
        }
        let image = match raw {
            Some(px) => format!("at pixel ({:.0}, {:.0})", px.x, px.y),
            None => "behind the camera or beyond its lens model".to_owned(),
        };
        let [width, height] = camera.image_size_px;
        return Err(Error::configuration(format!(
            "the zone's border at x = {:.0} mm, y = {:.0} mm is outside the camera's view: {image}",
            corner.x, corner.y
        ))
        .at("[zone]")
        .allowed(format!(
            "a border inside the {width} x {height} px image{}",
            visible_range(camera)
        ))
        .remedy("make the zone smaller, or check its unit (mm) and the calibration's [pose]"));
    }
    Ok(())
}

/// A lens model that folds may see the zone's border and yet not the zone.
fn check_zone_in_belt_view(view: &BeltView, zone: &BeltRect) -> Result<()> {
    let inside = zone.corners().iter().all(|&corner| {
        let px = view.px(corner);
        let [width, height] = view.size_px.map(|n| n as f64);
        (0.0..width).contains(&px.u) && (0.0..height).contains(&px.v)
    });
    if inside {
        return Ok(());
    }
    Err(Error::configuration("the camera does not see the whole zone: its lens model is absurd")
        .at("[lens] distortion")
        .allowed("a model that maps the zone into the image without folding")
        .remedy("check the distortion coefficients and their order, or calibrate again"))
}

/// The belt seen along the middle lines of the image, for the error text.
fn visible_range(camera: &Camera) -> String {
    let [width, height] = camera.image_size_px.map(|n| (n - 1) as f64);
    let edge =
        [(0.0, height / 2.0), (width, height / 2.0), (width / 2.0, 0.0), (width / 2.0, height)];
    let points = edge.map(|(x, y)| camera.belt_point(crate::units::RawPx { x, y }));
    let [Some(a), Some(b), Some(c), Some(d)] = points else { return String::new() };
    let range = |v: [f64; 4]| {
        (
            v.into_iter().fold(f64::INFINITY, f64::min),
            v.into_iter().fold(f64::NEG_INFINITY, f64::max),
        )
    };
    let (x, y) = (range([a.x, b.x, c.x, d.x]), range([a.y, b.y, c.y, d.y]));
    format!("; its middle lines reach x {:.0} to {:.0}, y {:.0} to {:.0} mm", x.0, x.1, y.0, y.1)
}
