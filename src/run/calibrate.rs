//! `beltgauge calibrate`: stills or surveyed points in; a camera file, and beside it its report
//! as HTML, out.

use super::outputs::refuse_inputs;
use super::report;
use crate::camera::calibrate::{
    BeltCalibration, BeltStill, BoardShape, LensCalibration, LensStart, SurveyedPoint,
    calibrate_belt, calibrate_lens, calibrate_points,
};
use crate::camera::chessboard::{BoardImage, Chessboard, NotFound};
use crate::camera::{
    BeltTable, CalibratedLens, CalibrationFile, Camera, CameraFile, IMAGE_SIDE_PX, ImageEntry,
    LensModel, LensSigmaTable,
};
use crate::error::{Error, Result};
use crate::source::{Still, stills_in};
use crate::units::RawPx;
use nalgebra::Vector3;
use std::path::{Path, PathBuf};

/// A focal length as the data sheet gives it.
#[derive(Clone, Copy, Debug)]
pub struct DataSheet {
    /// Focal length of the lens.
    pub focal_mm: f64,
    /// Width of the sensor's image area.
    pub sensor_width_mm: f64,
}

/// An image and what was found in it.
pub(super) struct Shot {
    pub(super) name: String,
    pub(super) still: Still,
    pub(super) board: std::result::Result<BoardImage, NotFound>,
}

/// Calibrate a lens. `say` gets a line of progress an image, then the result.
pub fn lens(
    images: &[PathBuf],
    board: &Chessboard,
    model: LensModel,
    data_sheet: Option<DataSheet>,
    out: &Path,
    say: &mut dyn FnMut(&str) -> Result<()>,
) -> Result<Vec<String>> {
    let files = files_of(images)?;
    let page = report_beside(out, &[&files])?;
    let shots = look(&files, None, board, say)?;
    let size_px = shots[0].still.size_px;
    let found: Vec<BoardImage> = shots.iter().filter_map(|s| s.board.clone().ok()).collect();
    let start = data_sheet.map_or(LensStart::Unknown, |sheet| {
        LensStart::FocalPx(sheet.focal_mm / sheet.sensor_width_mm * size_px[0] as f64)
    });
    let shape = BoardShape::Estimated;
    let calibration = calibrate_lens(board, size_px, &found, model, start, shape)
        .map_err(|e| e.at(seen_summary(board, &shots)))?;
    let entries = lens_entries(board, &shots, &calibration);
    let sigma = LensSigmaTable::new(model, calibration.sigma);
    CalibrationFile::lens(
        size_px,
        &calibration.lens,
        Some(sigma),
        calibration.rms_px,
        calibration.warnings.clone(),
        entries.clone(),
    )
    .save(out, "beltgauge calibrate lens")?;
    report::lens(&page, board, &shots, &entries, &calibration)?;
    for entry in &entries {
        say(&entry_line(entry))?;
    }
    say(&lens_summary(&calibration))?;
    Ok(calibration.warnings)
}

/// Calibrate the belt from stills of a board lying on it: carried, in order of time, and laid
/// elsewhere.
pub fn belt(
    carried: &[PathBuf],
    elsewhere: &[PathBuf],
    board: &Chessboard,
    thickness_mm: f64,
    lens_file: &Path,
    out: &Path,
    say: &mut dyn FnMut(&str) -> Result<()>,
) -> Result<Vec<String>> {
    let lens = CameraFile::load_lens(lens_file)?;
    let carried = files_of(carried)?;
    let elsewhere = files_of(elsewhere)?;
    let page = report_beside(out, &[&carried, &elsewhere, &[lens_file.to_owned()]])?;
    let files = [&carried[..], &elsewhere].concat();
    let shots = look(&files, Some(lens.image_size_px), board, say)?;
    let mut stills = Vec::with_capacity(shots.len());
    for shot in &shots {
        let board_image = shot.board.as_ref().map_err(|reason| {
            Error::configuration(not_found(board, *reason))
                .at(&shot.name)
                .remedy("take this still again, with the whole board in the image")
        })?;
        stills.push(BeltStill { name: &shot.name, board: board_image });
    }
    let (carried, elsewhere) = stills.split_at(carried.len());
    let calibration = calibrate_belt(board, &lens, carried, elsewhere, thickness_mm)?;
    let entries: Vec<ImageEntry> = shots
        .iter()
        .zip(&calibration.stills)
        .map(|(shot, still)| ImageEntry {
            file: shot.name.clone(),
            rms_px: Some(still.rms_px),
            rejected: None,
        })
        .collect();
    let table = belt_table(&calibration);
    save_belt(
        &lens,
        &calibration.camera,
        calibration.rms_px,
        &calibration.warnings,
        &entries,
        &table,
        out,
    )?;
    report::belt(&page, &shots, &table, &calibration)?;
    for entry in &entries {
        say(&entry_line(entry))?;
    }
    say(&belt_summary(&table))?;
    Ok(calibration.warnings)
}

/// Calibrate the belt from surveyed points.
pub fn points(
    csv: &Path,
    lens_file: &Path,
    out: &Path,
    say: &mut dyn FnMut(&str) -> Result<()>,
) -> Result<Vec<String>> {
    let page = report_beside(out, &[&[csv.to_owned(), lens_file.to_owned()]])?;
    let lens = CameraFile::load_lens(lens_file)?;
    let points = read_points(csv)?;
    let calibration = calibrate_points(&lens, &points).map_err(|e| e.in_file(csv))?;
    let (camera_height_mm, camera_tilt_deg) = height_and_tilt(&calibration.camera);
    let table = BeltTable {
        camera_height_mm,
        camera_tilt_deg,
        sigma_height_mm: calibration.sigma_height_mm,
        sigma_tilt_deg: calibration.sigma_tilt_deg,
        sigma_travel_deg: Some(calibration.sigma_travel_deg),
        travel_mm: None,
        surveyed_origin_mm: Some(calibration.origin_mm),
    };
    let (rms_px, warnings) = (calibration.rms_px, calibration.warnings);
    save_belt(&lens, &calibration.camera, rms_px, &warnings, &[], &table, out)?;
    for (point, error_px) in points.iter().zip(&calibration.error_px) {
        let at = point.in_belt_mm;
        say(&format!("({:8.1} {:8.1} {:8.1}) mm  {error_px:6.2} px", at.x, at.y, at.z))?;
    }
    report::points(&page, &points, &calibration.error_px, &calibration.camera, &table, &warnings)?;
    say(&belt_summary(&table))?;
    Ok(warnings)
}

/// The image files, those of folders in order of name.
fn files_of(images: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::with_capacity(images.len());
    for path in images {
        if path.is_dir() {
            files.extend(stills_in(path)?);
        } else {
            files.push(path.clone());
        }
    }
    Ok(files)
}

/// Load every image and look for the board.
fn look(
    files: &[PathBuf],
    size_px: Option<[usize; 2]>,
    board: &Chessboard,
    say: &mut dyn FnMut(&str) -> Result<()>,
) -> Result<Vec<Shot>> {
    let mut shots: Vec<Shot> = Vec::with_capacity(files.len());
    for (number, path) in files.iter().enumerate() {
        let expected = size_px.or(shots.first().map(|s| s.still.size_px));
        // They may come from a stranger's stick.
        let still = Still::load_sandboxed(path)?;
        check_size(path, still.size_px, expected)?;
        let plane =
            still.plane().ok_or_else(|| Error::failure("an image without pixels").in_file(path))?;
        let found = board.find(plane);
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let outcome = match &found {
            Ok(image) => format!("{} corners", image.corners.len()),
            Err(reason) => not_found(board, *reason),
        };
        say(&format!("{:>3}/{} {name:24} {outcome}", number + 1, files.len()))?;
        shots.push(Shot { name, still, board: found });
    }
    if shots.is_empty() {
        return Err(Error::configuration("no images")
            .remedy("name the image files, or a folder that holds them"));
    }
    Ok(shots)
}

fn not_found(board: &Chessboard, reason: NotFound) -> String {
    let Chessboard { columns, rows, .. } = board;
    match reason {
        NotFound::NoGrid => format!("no board of {columns}x{rows} inner corners"),
        NotFound::AnotherGrid { size: [a, b], seen } if [a, b] == [*columns, *rows] => {
            format!("only {seen} of the board's {} corners", board.corner_count())
        }
        NotFound::AnotherGrid { size: [a, b], .. } => {
            format!("{a}x{b} inner corners, not {columns}x{rows}")
        }
    }
}

/// What the images hold, for an error about all of them.
fn seen_summary(board: &Chessboard, shots: &[Shot]) -> String {
    let found = shots.iter().filter(|s| s.board.is_ok()).count();
    let summary = format!("{} images, the board found in {found}", shots.len());
    let other =
        shots.iter().find_map(|s| s.board.as_ref().err().filter(|e| **e != NotFound::NoGrid));
    match other {
        Some(reason) if found == 0 => format!("{summary} (--board: {})", not_found(board, *reason)),
        _ => summary,
    }
}

fn lens_entries(
    board: &Chessboard,
    shots: &[Shot],
    calibration: &LensCalibration,
) -> Vec<ImageEntry> {
    let mut views = calibration.views.iter();
    shots
        .iter()
        .map(|shot| {
            let file = shot.name.clone();
            let (rms_px, rejected) = match &shot.board {
                Err(reason) => (None, Some(not_found(board, *reason))),
                Ok(_) => views.next().map_or((None, None), |v| (v.rms_px, v.rejected.clone())),
            };
            ImageEntry { file, rms_px, rejected }
        })
        .collect()
}

fn entry_line(entry: &ImageEntry) -> String {
    let error = entry.rms_px.map_or("      -   ".to_owned(), |rms| format!("{rms:7.3} px"));
    let rejected = entry.rejected.as_ref().map_or(String::new(), |r| format!("  rejected: {r}"));
    format!("{:24} {error}{rejected}", entry.file)
}

fn lens_summary(calibration: &LensCalibration) -> String {
    let (lens, sigma) = (&calibration.lens, &calibration.sigma);
    format!(
        "fx {:.2} +- {:.2} px, fy {:.2} +- {:.2} px, centre ({:.2} +- {:.2}, {:.2} +- {:.2}) px, rms {:.3} px",
        lens.fx_px,
        sigma[0],
        lens.fy_px,
        sigma[1],
        lens.cx_px,
        sigma[2],
        lens.cy_px,
        sigma[3],
        calibration.rms_px
    )
}

fn belt_summary(table: &BeltTable) -> String {
    let travel = table
        .sigma_travel_deg
        .map_or("assumed".to_owned(), |sigma| format!("+- {sigma:.3} degrees"));
    format!(
        "camera {:.1} +- {:.1} mm above the belt, tilted {:.2} +- {:.3} degrees, travel direction {travel}",
        table.camera_height_mm, table.sigma_height_mm, table.camera_tilt_deg, table.sigma_tilt_deg
    )
}

/// The size of an image must be possible, and that of the others or the lens.
fn check_size(path: &Path, size_px: [usize; 2], expected: Option<[usize; 2]>) -> Result<()> {
    let [width, height] = size_px;
    let wrong = || Error::configuration(format!("an image of {width} x {height} px")).in_file(path);
    let (from, to) = (IMAGE_SIDE_PX.start(), IMAGE_SIDE_PX.end());
    match expected {
        Some([w, h]) if size_px != [w, h] => Err(wrong()
            .allowed(format!("{w} x {h} px, as the other images and the lens"))
            .remedy("use images of one camera with one setting, none cropped, scaled or turned")),
        _ if size_px.iter().any(|side| !IMAGE_SIDE_PX.contains(side)) => {
            Err(wrong().allowed(format!("sides of {from} to {to} px")))
        }
        _ => Ok(()),
    }
}

/// Where the report goes: beside the camera file, as .html. Refuses, before any work, an output
/// that would destroy something else than an earlier result.
fn report_beside(out: &Path, inputs: &[&[PathBuf]]) -> Result<PathBuf> {
    let page = out.with_extension("html");
    let refused = |what: &str| {
        Err(Error::configuration(what.to_owned())
            .in_file(out)
            .remedy("name a new file, or the result of an earlier calibration, with --out"))
    };
    for file in [out, &page] {
        if std::fs::symlink_metadata(file).is_ok_and(|m| !m.is_file()) {
            return refused("--out, or its report beside it, is not a plain file");
        }
        let inputs: Vec<&Path> = inputs.iter().copied().flatten().map(PathBuf::as_path).collect();
        refuse_inputs("--out, or its report beside it,", file, &inputs)?;
    }
    if page == out {
        return Err(Error::configuration("--out would be overwritten by its own report")
            .in_file(out)
            .remedy("end the camera file's name in .toml"));
    }
    Ok(page)
}

/// Camera height, mm, and angle between optical axis and the belt's normal, degrees.
fn height_and_tilt(camera: &Camera) -> (f64, f64) {
    let cos = -camera.camera_from_belt[(2, 2)];
    (camera.centre_in_belt().z, cos.clamp(-1.0, 1.0).acos().to_degrees())
}

fn belt_table(calibration: &BeltCalibration) -> BeltTable {
    let (camera_height_mm, camera_tilt_deg) = height_and_tilt(&calibration.camera);
    BeltTable {
        camera_height_mm,
        camera_tilt_deg,
        sigma_height_mm: calibration.sigma_height_mm,
        sigma_tilt_deg: calibration.sigma_tilt_deg,
        sigma_travel_deg: calibration.sigma_travel_deg,
        travel_mm: Some(calibration.travel_mm.clone()),
        surveyed_origin_mm: None,
    }
}

fn save_belt(
    lens: &CalibratedLens,
    camera: &Camera,
    rms_px: f64,
    warnings: &[String],
    entries: &[ImageEntry],
    table: &BeltTable,
    out: &Path,
) -> Result<()> {
    CalibrationFile::lens(
        lens.image_size_px,
        &lens.lens,
        lens.sigma.clone(),
        rms_px,
        warnings.to_vec(),
        entries.to_vec(),
    )
    .over_belt(camera, table.clone())
    .save(out, "beltgauge calibrate belt")
}

fn read_points(path: &Path) -> Result<Vec<SurveyedPoint>> {
    let text = std::fs::read_to_string(path).map_err(|e| {
        Error::configuration(format!("cannot read the surveyed points: {e}")).in_file(path)
    })?;
    parse_points(&text, path)
}

/// Lines of X, Y, Z in mm and u, v in px, separated by commas or semicolons; a first line of
/// names, empty lines and lines that start with # are passed over. `path` is for error texts.
pub fn parse_points(text: &str, path: &Path) -> Result<Vec<SurveyedPoint>> {
    let mut points = Vec::new();
    let mut is_first = true;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim_start_matches('\u{feff}').trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let values: Option<Vec<f64>> = line
            .split([',', ';'])
            .map(|value| value.trim().parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        let is_header =
            std::mem::take(&mut is_first) && !line.contains(|c: char| c.is_ascii_digit());
        match values.as_deref() {
            Some(&[x, y, z, u, v]) => points.push(SurveyedPoint {
                in_belt_mm: Vector3::new(x, y, z),
                at: RawPx { x: u, y: v },
            }),
            _ if is_header => {}
            _ => {
                return Err(Error::configuration(format!("not a surveyed point: {line:?}"))
                    .at(format!("{}, line {}", path.display(), number + 1))
                    .allowed("five numbers: X, Y, Z in mm, u, v in px")
                    .remedy(
                        "write a decimal point, and commas or semicolons between the numbers",
                    ));
            }
        }
    }
    Ok(points)
}
