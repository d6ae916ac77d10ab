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
    pub(super) board: std::result::Result<BoardImage, NoUse>,
}

/// Why a still is of no use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NoUse {
    /// No board was found in it.
    NoBoard(NotFound),
    /// Its size is not this one, that of most.
    NotOfSize([usize; 2]),
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
    let stills = load(&files)?;
    let size_px = size_of_most(&files, &stills)?;
    let shots = look(&files, stills, size_px, board, say)?;
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
    report::lens(&page, board, size_px, &shots, &entries, &calibration)?;
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
    let stills = load(&files)?;
    let shots = look(&files, stills, lens.image_size_px, board, say)?;
    let mut stills = Vec::with_capacity(shots.len());
    for shot in &shots {
        let board_image = shot.board.as_ref().map_err(|reason| {
            Error::configuration(no_use(board, &shot.still, *reason))
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
            turned_back: false,
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

/// Load every image: they may come from a stranger's stick.
fn load(files: &[PathBuf]) -> Result<Vec<Still>> {
    if files.is_empty() {
        return Err(Error::configuration("no images")
            .remedy("name the image files, or a folder that holds them"));
    }
    files
        .iter()
        .map(|path| {
            let still = Still::load_sandboxed(path)?;
            check_sides(path, still.size_px)?;
            Ok(still)
        })
        .collect()
}

/// The size of more stills than any other's: the camera's.
fn size_of_most(files: &[PathBuf], stills: &[Still]) -> Result<[usize; 2]> {
    let count = |size: [usize; 2]| stills.iter().filter(|s| s.size_px == size).count();
    let largest = stills.iter().map(|s| count(s.size_px)).max().unwrap_or(0);
    let mut most = stills.iter().zip(files).filter(|(s, _)| count(s.size_px) == largest);
    let (first, first_file) = most.next().ok_or_else(|| Error::configuration("no images"))?;
    match most.find(|(s, _)| s.size_px != first.size_px) {
        None => Ok(first.size_px),
        Some((other, other_file)) => {
            let ([w, h], [a, b]) = (first.size_px, other.size_px);
            let (name, other_name) = (name_of(first_file), name_of(other_file));
            Err(Error::configuration(format!(
                "{largest} images of {w} x {h} px as {name}, {largest} of {a} x {b} px as {other_name}"
            ))
            .allowed("one size, or most of one size")
            .remedy("use images of one camera with one setting, none cropped, scaled or turned"))
        }
    }
}

/// Look for the board in every image of the right size.
fn look(
    files: &[PathBuf],
    stills: Vec<Still>,
    size_px: [usize; 2],
    board: &Chessboard,
    say: &mut dyn FnMut(&str) -> Result<()>,
) -> Result<Vec<Shot>> {
    let mut shots: Vec<Shot> = Vec::with_capacity(files.len());
    for (number, (path, still)) in files.iter().zip(stills).enumerate() {
        let plane =
            still.plane().ok_or_else(|| Error::failure("an image without pixels").in_file(path))?;
        let found = if still.size_px == size_px {
            board.find(plane).map_err(NoUse::NoBoard)
        } else {
            Err(NoUse::NotOfSize(size_px))
        };
        let name = name_of(path);
        let outcome = match &found {
            Ok(image) => format!("{} corners", image.corners.len()),
            Err(reason) => no_use(board, &still, *reason),
        };
        say(&format!("{:>3}/{} {name:24} {outcome}", number + 1, files.len()))?;
        shots.push(Shot { name, still, board: found });
    }
    Ok(shots)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Why a still is of no use, in words.
fn no_use(board: &Chessboard, still: &Still, reason: NoUse) -> String {
    let wanted = board.in_order([board.columns, board.rows]);
    match reason {
        NoUse::NoBoard(NotFound::NoGrid) => format!("no board of {wanted} inner corners"),
        NoUse::NoBoard(NotFound::Markers) => {
            "looks like a ChArUco board, with markers in its squares: use a plain chessboard".into()
        }
        NoUse::NoBoard(NotFound::AnotherGrid { size, seen })
            if size == [board.columns, board.rows] =>
        {
            format!("only {seen} of the board's {} corners", board.corner_count())
        }
        NoUse::NoBoard(NotFound::AnotherGrid { size, .. }) => {
            format!("{} inner corners, not {wanted}", board.in_order(size))
        }
        NoUse::NotOfSize([width, height]) => {
            let [w, h] = still.size_px;
            format!(
                "{w} x {h} px, not {width} x {height}: use images of one camera with one setting, none \
                 cropped, scaled or turned"
            )
        }
    }
}

/// What the images hold, for an error about all of them.
fn seen_summary(board: &Chessboard, shots: &[Shot]) -> String {
    let found = shots.iter().filter(|s| s.board.is_ok()).count();
    let summary = format!("{} images, the board found in {found}", shots.len());
    // The most telling: what another one says of the size hides what is seen of the board.
    let telling = |shot: &&Shot| matches!(&shot.board, Err(NoUse::NoBoard(reason)) if *reason != NotFound::NoGrid);
    match shots.iter().find(telling) {
        Some(Shot { still, board: Err(reason), .. }) if found == 0 => {
            format!("{summary} (--board: {})", no_use(board, still, *reason))
        }
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
            let view = if shot.board.is_ok() { views.next() } else { None };
            let rejected = match &shot.board {
                Err(reason) => Some(no_use(board, &shot.still, *reason)),
                Ok(_) => view.and_then(|v| v.rejected.clone()),
            };
            let (rms_px, turned_back) = view.map_or((None, false), |v| (v.rms_px, v.is_turned));
            ImageEntry { file, rms_px, rejected, turned_back }
        })
        .collect()
}

fn entry_line(entry: &ImageEntry) -> String {
    let error = entry.rms_px.map_or("      -   ".to_owned(), |rms| format!("{rms:7.3} px"));
    let rejected = entry.rejected.as_ref().map_or(String::new(), |r| format!("  rejected: {r}"));
    let turned = if entry.turned_back { "  turned by 180 degrees: turned back" } else { "" };
    format!("{:24} {error}{turned}{rejected}", entry.file)
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

/// An image of impossible size is none of a camera's.
fn check_sides(path: &Path, [width, height]: [usize; 2]) -> Result<()> {
    if [width, height].iter().all(|side| IMAGE_SIDE_PX.contains(side)) {
        return Ok(());
    }
    let (from, to) = (IMAGE_SIDE_PX.start(), IMAGE_SIDE_PX.end());
    Err(Error::configuration(format!("an image of {width} x {height} px"))
        .in_file(path)
        .allowed(format!("sides of {from} to {to} px")))
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
