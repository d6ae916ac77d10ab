//! The report of a lens: errors, coverage, residuals, distortion, an undistorted sample.

use super::{BLUE, Drawing, GREEN, GREY, Page, RED, arrow_scale, escaped};
use crate::camera::calibrate::{LensCalibration, ViewResult};
use crate::camera::chessboard::Chessboard;
use crate::camera::{ImageEntry, Lens, LensModel};
use crate::error::Result;
use crate::run::calibrate::Shot;
use crate::source::Still;
use crate::units::RawPx;
use nalgebra::Vector3;
use std::fmt::Write;
use std::path::Path;

/// Write the report of a lens calibration.
pub(in crate::run) fn lens(
    path: &Path,
    board: &Chessboard,
    size_px: [usize; 2],
    shots: &[Shot],
    entries: &[ImageEntry],
    calibration: &LensCalibration,
) -> Result<()> {
    let mut page = Page::new("Lens calibration");
    page.warnings(&calibration.warnings);
    page.table(&parameters(calibration, size_px));
    page.section(
        "Error of each image",
        "Root mean square distance between corners seen and expected. Rejected images are red.",
    );
    page.add(error_bars(entries));
    let kept = || calibration.views.iter().filter(|v| v.rejected.is_none());
    let scale = arrow_scale(size_px, calibration.rms_px);
    page.section(
        "Coverage and residuals",
        &format!(
            "Every corner of every image kept, with its error (seen minus expected) drawn {scale} \
             times as long. Corners should reach all parts of the image; errors should point \
             everywhere."
        ),
    );
    page.add(coverage(size_px, kept(), scale));
    page.section(
        "Distortion",
        "A square grid as the lens shows it. Grey: where a pinhole would show a point; red: where the lens \
         shows it instead, and how many px away.",
    );
    page.add(distortion_grid(size_px, &calibration.lens));
    if !calibration.shape_mm.is_empty() {
        page.section(
            "Shape of the board",
            "How far each corner lies before (+) or behind (-) the plane of a flat board, mm.",
        );
        page.add(board_shape(board, &calibration.shape_mm));
    }
    // The first image kept is as good a sample as any.
    let mut views = calibration.views.iter();
    let sample = shots
        .iter()
        .find(|s| s.board.is_ok() && views.next().is_some_and(|v| v.rejected.is_none()));
    if let Some(shot) = sample {
        page.section(
            "An undistorted sample",
            &format!("{}: straight edges of the board and the room must be straight.", shot.name),
        );
        page.add(Drawing::over(&undistorted(&shot.still, &calibration.lens))?.html());
    }
    page.save(path)
}

fn parameters(
    calibration: &LensCalibration,
    [width, height]: [usize; 2],
) -> Vec<(&'static str, String)> {
    let (all, sigma) = (calibration.lens.parameters(), calibration.sigma);
    let model = calibration.lens.model;
    let names: &[&str] = match model {
        LensModel::Brown => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"],
        LensModel::Fisheye => &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
    };
    let mut rows = vec![
        ("model", format!("{model:?}").to_lowercase()),
        ("image", format!("{width} x {height} px")),
        ("rms", format!("{:.3} px", calibration.rms_px)),
    ];
    rows.extend(names.iter().enumerate().map(|(k, &name)| {
        let value = if k < 4 {
            format!("{:.2} +- {:.2} px", all[k], sigma[k])
        } else {
            format!("{:.5} +- {:.5}", all[k], sigma[k])
        };
        (name, value)
    }));
    rows
}

fn error_bars(entries: &[ImageEntry]) -> String {
    let largest = entries.iter().filter_map(|e| e.rms_px).fold(1e-3, f64::max);
    let mut html = "<table>".to_owned();
    for entry in entries {
        let rms = entry.rms_px.unwrap_or(0.0);
        let colour = if entry.rejected.is_some() { RED } else { BLUE };
        let value = entry.rms_px.map_or("-".to_owned(), |r| format!("{r:.3} px"));
        let reason = entry.rejected.as_deref().unwrap_or_default();
        let _ = writeln!(
            html,
            "<tr><td>{}<td class=n>{value}<td><svg width=\"{:.0}\" height=\"12\" \
             style=\"background:{colour}\"></svg> <span class=bad>{}</span>",
            escaped(&entry.file),
            1.0 + 300.0 * rms / largest,
            escaped(reason)
        ); // writing to a String cannot fail
    }
    html + "</table>"
}

fn coverage<'a>(
    size_px: [usize; 2],
    views: impl Iterator<Item = &'a ViewResult>,
    scale: f64,
) -> String {
    let mut drawing = Drawing::new(size_px);
    for view in views {
        for (corner, residual) in &view.residuals {
            let from = [corner.at.x, corner.at.y];
            let to = [from[0] + scale * residual.x, from[1] + scale * residual.y];
            drawing.line(from, to, RED, 1.0);
            drawing.dot(from, BLUE, 2.0);
        }
    }
    drawing.html()
}

fn distortion_grid(size_px: [usize; 2], lens: &Lens) -> String {
    const LINES: usize = 16;
    let [width, height] = size_px.map(|s| s as f64);
    let step = width / LINES as f64;
    let pinhole = |x: f64, y: f64| {
        let ray = Vector3::new((x - lens.cx_px) / lens.fx_px, (y - lens.cy_px) / lens.fy_px, 1.0);
        lens.project(ray).map(|p| [p.x, p.y])
    };
    let mut drawing = Drawing::new(size_px);
    // Beyond the image too: a barrel shows more than a pinhole.
    let lines = |side: f64| {
        let count = (side / step) as i32 + 1;
        (-count..=2 * count).map(move |k| f64::from(k) * step)
    };
    let along = |side: f64| {
        let from = -side;
        (0..=300).map(move |k| from + f64::from(k) / 100.0 * side)
    };
    let inside = |p: &[f64; 2]| {
        (-0.1 * width..1.1 * width).contains(&p[0]) && (-0.1 * height..1.1 * height).contains(&p[1])
    };
    for x in lines(width) {
        drawing.curve(along(height).map(|y| pinhole(x, y).filter(inside)), BLUE, 1.2);
    }
    for y in lines(height) {
        drawing.curve(along(width).map(|x| pinhole(x, y).filter(inside)), BLUE, 1.2);
    }
    for (kx, ky) in (0..=8).flat_map(|kx| (0..=6).map(move |ky| (kx, ky))) {
        let (x, y) = (f64::from(kx) / 8.0 * (width - 1.0), f64::from(ky) / 6.0 * (height - 1.0));
        drawing.dot([x, y], GREY, 2.0);
        if let Some([u, v]) = pinhole(x, y) {
            drawing.line([x, y], [u, v], RED, 1.0);
            drawing.text([x, y], &format!("{:.0}", (u - x).hypot(v - y)), RED, 14.0);
        }
    }
    drawing.html()
}

fn board_shape(board: &Chessboard, shape_mm: &[Vector3<f64>]) -> String {
    const CELL: usize = 60;
    let largest = shape_mm.iter().map(|s| s.z.abs()).fold(1e-6, f64::max);
    let mut drawing = Drawing::new([CELL * board.columns, CELL * board.rows]);
    for (k, shape) in shape_mm.iter().enumerate() {
        let (column, row) = (k % board.columns, k / board.columns);
        let (x, y) = ((column * CELL) as f64, (row * CELL) as f64);
        // The board's third axis leads away from the camera.
        let before_mm = -shape.z;
        let colour = if before_mm > 0.0 { GREEN } else { RED };
        let opacity = 0.8 * before_mm.abs() / largest;
        drawing.put(format_args!(
            "<rect x=\"{x}\" y=\"{y}\" width=\"{CELL}\" height=\"{CELL}\" fill=\"{colour}\" fill-opacity=\"{opacity:.2}\"/>"
        ));
        drawing.put(format_args!(
            "<text x=\"{:.0}\" y=\"{:.0}\" font-size=\"15\" text-anchor=\"middle\">{before_mm:+.2}</text>",
            x + 0.5 * CELL as f64,
            y + 0.58 * CELL as f64
        ));
    }
    drawing.html()
}

/// The still as a pinhole camera would have seen it.
fn undistorted(still: &Still, lens: &Lens) -> Still {
    let [width, height] = still.size_px;
    // All of the image's middle rows and columns stay visible.
    let mut zoom = 1.0_f64;
    let centre = RawPx { x: lens.cx_px, y: lens.cy_px };
    for (x, y) in [
        (0.0, centre.y),
        (width as f64 - 1.0, centre.y),
        (centre.x, 0.0),
        (centre.x, height as f64 - 1.0),
    ] {
        if let Some(ray) = lens.unproject(RawPx { x, y })
            && ray.z > 0.0
        {
            let (u, v) = (lens.fx_px * ray.x / ray.z, lens.fy_px * ray.y / ray.z);
            let seen = (x - centre.x).hypot(y - centre.y);
            zoom = zoom.min(seen / u.hypot(v).max(1.0)).max(0.25);
        }
    }
    let plane = still.plane();
    let pixel = |k: usize| {
        let (x, y) = ((k % width) as f64, (k / width) as f64);
        let ray = Vector3::new(
            (x - centre.x) / (zoom * lens.fx_px),
            (y - centre.y) / (zoom * lens.fy_px),
            1.0,
        );
        let at = lens.project(ray)?;
        plane?.sample(at.x as f32, at.y as f32)
    };
    let pixels = (0..width * height).map(|k| pixel(k).map_or(0, |g| g.round() as u8)).collect();
    Still { pixels, size_px: still.size_px }
}
