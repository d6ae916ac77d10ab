//! The report of a belt: a metre grid over the still, and how far it can be trusted.

use super::{BLUE, Drawing, GREEN, Page, RED, arrow_scale, escaped};
use crate::camera::calibrate::{BeltCalibration, SurveyedPoint};
use crate::camera::{BeltTable, Camera};
use crate::error::Result;
use crate::run::calibrate::Shot;
use crate::units::BeltMm;
use nalgebra::Vector3;
use std::path::Path;

/// Spacing of the grid's lines; every fifth is bold.
const GRID_MM: f64 = 100.0;
/// Points a line is drawn through, one every 10 mm.
const STEP_MM: f64 = 10.0;
/// Nobody needs more grid than this.
const GRID_HALF_MM: f64 = 3000.0;

/// Write the report of a belt calibration from stills of a board.
pub(in crate::run) fn belt(
    path: &Path,
    shots: &[Shot],
    table: &BeltTable,
    calibration: &BeltCalibration,
) -> Result<()> {
    let camera = &calibration.camera;
    let mut page = Page::new("Belt calibration");
    page.warnings(&calibration.warnings);
    page.table(&trust(table));
    let scale = arrow_scale(camera.image_size_px, calibration.rms_px);
    page.section(
        "The belt, in metres",
        &format!(
            "A line every {GRID_MM} mm, bold every half metre. Green: travel (+X). Red: left (+Y). \
             The grid must lie on the belt and the green arrow point where parcels go. Blue: the \
             board's corners, each with its error (seen minus expected) drawn {scale} times as long."
        ),
    );
    for (shot, still) in shots.iter().zip(&calibration.stills) {
        page.add(format!("<p>{} ({:.3} px)</p>", escaped(&shot.name), still.rms_px));
        let mut drawing = Drawing::over(&shot.still)?;
        grid(&mut drawing, camera);
        for (corner, residual) in &still.residuals {
            let from = [corner.at.x, corner.at.y];
            drawing.line(
                from,
                [from[0] + scale * residual.x, from[1] + scale * residual.y],
                RED,
                1.0,
            );
            drawing.dot(from, BLUE, 1.6);
        }
        page.add(drawing.html());
    }
    page.save(path)
}

/// Write the report of a belt calibration from surveyed points.
pub(in crate::run) fn points(
    path: &Path,
    points: &[SurveyedPoint],
    error_px: &[f64],
    camera: &Camera,
    table: &BeltTable,
    warnings: &[String],
) -> Result<()> {
    let mut page = Page::new("Belt calibration from surveyed points");
    page.warnings(warnings);
    page.table(&trust(table));
    page.section(
        "The points and the belt, in metres",
        "A line every 100 mm, bold every half metre; blue: the points, with their errors in px.",
    );
    let mut drawing = Drawing::new(camera.image_size_px);
    grid(&mut drawing, camera);
    for (point, error) in points.iter().zip(error_px) {
        let at = [point.at.x, point.at.y];
        drawing.dot(at, BLUE, 4.0);
        drawing.text([at[0] + drawing.stroke(6.0), at[1]], &format!("{error:.2}"), BLUE, 14.0);
    }
    page.add(drawing.html());
    page.save(path)
}

fn trust(table: &BeltTable) -> Vec<(&'static str, String)> {
    let travel = table
        .sigma_travel_deg
        .map_or("assumed along the image's rows".to_owned(), |s| format!("+- {s:.3} degrees"));
    let mut rows = vec![
        (
            "camera above the belt",
            format!("{:.1} +- {:.1} mm", table.camera_height_mm, table.sigma_height_mm),
        ),
        (
            "tilt of the camera",
            format!("{:.2} +- {:.3} degrees", table.camera_tilt_deg, table.sigma_tilt_deg),
        ),
        ("direction of travel", travel),
    ];
    if let Some(travel_mm) = &table.travel_mm {
        let ways: Vec<String> = travel_mm.iter().map(|t| format!("{t:.1}")).collect();
        rows.push(("carried", format!("{} mm", ways.join(", "))));
    }
    if let Some([x, y]) = table.surveyed_origin_mm {
        rows.push(("origin, in the survey", format!("({x:.1}, {y:.1}) mm")));
    }
    rows
}

fn grid(drawing: &mut Drawing, camera: &Camera) {
    let seen = |x: f64, y: f64| {
        camera.project(Vector3::new(x, y, 0.0)).filter(|&p| camera.sees(p)).map(|p| [p.x, p.y])
    };
    let [x_range, y_range] = extent(camera);
    let lines = |[from, to]: [f64; 2]| {
        let first = (from / GRID_MM).ceil() as i32;
        let last = (to / GRID_MM).floor() as i32;
        first..=last
    };
    let along = |[from, to]: [f64; 2]| {
        let count = ((to - from) / STEP_MM) as i32;
        (0..=count).map(move |k| from + f64::from(k) * STEP_MM)
    };
    let width = |line: i32| if line % 5 == 0 { 1.6 } else { 0.6 };
    for line in lines(x_range) {
        let x = f64::from(line) * GRID_MM;
        drawing.curve(along(y_range).map(|y| seen(x, y)), "#ffd23f", width(line));
    }
    for line in lines(y_range) {
        let y = f64::from(line) * GRID_MM;
        drawing.curve(along(x_range).map(|x| seen(x, y)), "#ffd23f", width(line));
    }
    for line in lines(x_range).filter(|l| l % 5 == 0) {
        let x = f64::from(line) * GRID_MM;
        if let Some(at) = seen(x, 0.0) {
            drawing.text(at, &format!("{:.1} m", x / 1000.0), "#333", 14.0);
        }
    }
    let length_mm = 0.2 * (x_range[1] - x_range[0]).min(y_range[1] - y_range[0]);
    // From the origin, or where the middle of the image is when that is not seen.
    let start = seen(0.0, 0.0).map_or_else(
        || BeltMm { x: 0.5 * (x_range[0] + x_range[1]), y: 0.5 * (y_range[0] + y_range[1]) },
        |_| BeltMm::default(),
    );
    for ([dx, dy], colour) in [([length_mm, 0.0], GREEN), ([0.0, length_mm], RED)] {
        let tip = (start.x + dx, start.y + dy);
        if let (Some(from), Some(to)) = (seen(start.x, start.y), seen(tip.0, tip.1)) {
            drawing.line(from, to, colour, 4.0);
            drawing.dot(to, colour, 6.0);
        }
    }
}

/// The part of the belt in the image: x from, to; y from, to; mm.
fn extent(camera: &Camera) -> [[f64; 2]; 2] {
    let [width, height] = camera.image_size_px.map(|s| s as f64 - 1.0);
    let mut ranges = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for (i, j) in (0..=20).flat_map(|i| (0..=20).map(move |j| (i, j))) {
        let px =
            crate::units::RawPx { x: f64::from(i) / 20.0 * width, y: f64::from(j) / 20.0 * height };
        if let Some(at) = camera.belt_point(px) {
            for (range, value) in ranges.iter_mut().zip([at.x, at.y]) {
                let value = value.clamp(-GRID_HALF_MM, GRID_HALF_MM);
                *range = [range[0].min(value), range[1].max(value)];
            }
        }
    }
    ranges.map(|r| if r[0] <= r[1] { r } else { [0.0, 0.0] })
}
