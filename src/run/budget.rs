//! `beltgauge budget`: what a geometry can measure, before anything is bought.

use super::report;
use crate::camera::{Camera, Lens, LensModel};
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use crate::stage::measure::budget::{Geometry, expected_sigma_mm};
use nalgebra::{Matrix3, Vector3};
use std::fmt::Write as _;
use std::path::Path;

/// Sizes of the table, mm.
const SIZES_MM: [[f64; 3]; 7] = [
    [235.0, 125.0, 70.0],
    [330.0, 105.0, 140.0],
    [600.0, 400.0, 300.0],
    [400.0, 300.0, 200.0],
    [240.0, 160.0, 4.0],
    [100.0, 60.0, 30.0],
    [40.0, 30.0, 10.0],
];
/// A turn that is nothing special.
const YAW_DEG: f64 = 20.0;
/// Heights of the plot.
const PLOT_HEIGHTS: usize = 40;
/// Scale intervals that devices have.
const INTERVALS_MM: [f64; 7] = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0];

/// A camera looking straight down on a zone.
#[derive(Clone, Copy, Debug)]
pub struct StraightDown {
    /// Lens over the belt.
    pub camera_height_mm: f64,
    /// Focal length.
    pub focal_px: f64,
    /// Columns and rows.
    pub image_size_px: [usize; 2],
    /// Zone along and across the belt.
    pub zone_mm: [f64; 2],
    /// Belt speed.
    pub speed_mm_per_s: f64,
}

/// Focal lengths of lenses, as part of the image's longer side: 140 and 3 degrees of view.
const FOCAL_PER_SIDE: [f64; 2] = [0.18, 20.0];

impl StraightDown {
    /// The site it makes.
    ///
    /// # Errors
    /// When the camera does not see the zone, or a value is out of its range.
    pub fn site(&self) -> Result<Site> {
        let width = self.image_size_px[0].max(self.image_size_px[1]) as f64;
        let [shortest, longest] = FOCAL_PER_SIDE.map(|part| part * width);
        if !(shortest..=longest).contains(&self.focal_px) {
            return Err(Error::configuration(format!("--focal-px {}", self.focal_px))
                .allowed(format!(
                    "{shortest:.0} to {longest:.0} px for images of {width} px: lenses without \
                     distortion see 3 to 140 degrees"
                ))
                .remedy("divide the focal length in mm by the size of a pixel in mm"));
        }
        let [x, y] = self.zone_mm.map(|side| 0.5 * side);
        let config = Config::parse(&format!(
            "[camera]\ncalibration = \"none\"\n[belt]\nspeed_mm_per_s = {}\n\
             [zone]\nx_min_mm = -{x}\nx_max_mm = {x}\ny_min_mm = -{y}\ny_max_mm = {y}\n",
            self.speed_mm_per_s
        ))?;
        let centre_px = self.image_size_px.map(|n| 0.5 * (n as f64 - 1.0));
        let camera = Camera {
            image_size_px: self.image_size_px,
            lens: Lens::new(LensModel::Brown, [self.focal_px; 2], centre_px, [0.0; 5]),
            camera_from_belt: Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)),
            translation_mm: Vector3::new(0.0, 0.0, self.camera_height_mm),
        };
        camera.checked_height_mm()?;
        Site::new(config, camera)
    }
}

/// The table of expected standard deviations; a plot of them over the height goes to `out`.
///
/// # Errors
/// When the plot cannot be written.
pub fn run(site: &Site, fps: f64, out: Option<&Path>) -> Result<String> {
    let geometry = Geometry {
        view: &site.view,
        zone: &site.config.zone,
        height_max_mm: site.height_max_mm,
        travel_per_frame_mm: site.config.belt.speed_mm_per_s / fps,
    };
    let mut table = format!(
        "camera {:.0} mm above the belt, {:.2} mm a pixel, {:.1} mm of travel a frame\n\
         expected standard deviation, mm, with texture on the top and without;\n\
         d: smallest scale interval that three of the latter fit in\n\n\
         {:>17}  {:^22}  {:^22}  {:>5}\n",
        site.view.camera_height_mm,
        site.view.mm_per_px,
        geometry.travel_per_frame_mm,
        "L x W x H mm",
        "textured: L W H",
        "plain: L W H",
        "d mm"
    );
    for size_mm in SIZES_MM.into_iter().filter(|s| s[2] <= site.height_max_mm) {
        let [l, w, h] = size_mm;
        let sigma = |textured| expected_sigma_mm(&geometry, size_mm, YAW_DEG, textured);
        let cell = |sigma: Option<[f64; 3]>| match sigma {
            Some([l, w, h]) => format!("{l:6.2} {w:6.2} {h:6.2}"),
            None => "seen too little".to_owned(),
        };
        let (textured, plain) = (sigma(true), sigma(false));
        let interval = plain.and_then(interval_mm).map_or("-".to_owned(), |d| format!("{d:.0}"));
        let _ = writeln!(
            table,
            "{:>17}  {:^22}  {:^22}  {interval:>5}",
            format!("{l:.0} x {w:.0} x {h:.0}"),
            cell(textured),
            cell(plain),
        ); // writing to a String cannot fail
    }
    let legal = SIZES_MM.iter().filter(|s| s[2] <= site.height_max_mm);
    let worst = legal
        .filter_map(|&size| expected_sigma_mm(&geometry, size, YAW_DEG, false))
        .filter_map(interval_mm)
        .fold(0.0, f64::max);
    let _ = write!(
        table,
        "\nwith d = {worst:.0} mm for all of them, the smallest legal side would be {:.0} mm (10 d)",
        10.0 * worst
    );
    if let Some(out) = out {
        let heights = (1..=PLOT_HEIGHTS)
            .map(|i| site.height_max_mm * i as f64 / PLOT_HEIGHTS as f64)
            .collect::<Vec<_>>();
        let curve = |textured| {
            heights
                .iter()
                .map(|&h| (h, expected_sigma_mm(&geometry, [235.0, 125.0, h], YAW_DEG, textured)))
                .collect::<Vec<_>>()
        };
        report::budget(&table, &[("textured", curve(true)), ("plain", curve(false))], out)?;
    }
    Ok(table)
}

/// The smallest scale interval that three standard deviations fit in.
fn interval_mm(sigma_mm: [f64; 3]) -> Option<f64> {
    let worst = sigma_mm.into_iter().fold(0.0, f64::max);
    INTERVALS_MM.into_iter().find(|d| 3.0 * worst <= *d)
}
