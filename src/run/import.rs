//! `beltgauge import`: from a USB stick into the store of configurations, completely checked.

use super::{calibrate, update};
use crate::camera::LensModel;
use crate::camera::chessboard::Chessboard;
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use crate::source::check_interface;
use crate::store::manifest::MANIFEST;
use crate::store::stick::{
    BELT_FOLDER, CODE, FILE_BYTES_MAX, LENS_FOLDER, STILLS_BYTES_MAX, STILLS_MAX, Stick,
    TEXT_BYTES_MAX, is_plain_name,
};
use crate::store::{CONFIG_FILE, Locked, REPORT, Store, Trust, files};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// How the stills of a calibration on the stick were taken.
const CALIBRATION_FILE: &str = "calibration.toml";
const LENS_FILE: &str = "lens.toml";
const CAMERA_FILE: &str = "camera.toml";
/// What a calibration gives, for the technician.
const RESULTS: [&str; 4] = [LENS_FILE, "lens.html", CAMERA_FILE, "camera.html"];
/// Largest report of a calibration: it holds pictures.
const RESULT_BYTES_MAX: u64 = 64 << 20;

/// `calibration.toml` on the stick: the board of the stills in `lens/` and `belt/`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Inner corners along both sides.
    board: [usize; 2],
    square_mm: f64,
    #[serde(default)]
    board_thickness_mm: f64,
    #[serde(default = "brown")]
    model: LensModel,
}

fn brown() -> LensModel {
    LensModel::Brown
}

impl Board {
    /// Parse and check.
    pub fn parse(text: &str) -> Result<Self> {
        let board: Self = toml::from_str(text).map_err(|e| {
            Error::configuration(e.to_string().trim_end().to_owned())
                .allowed("board = [9, 6], square_mm = 25, board_thickness_mm, model")
        })?;
        let sane = board.board.iter().all(|n| (3..=60).contains(n))
            && (1.0..=1000.0).contains(&board.square_mm)
            && (0.0..=200.0).contains(&board.board_thickness_mm);
        sane.then_some(board).ok_or_else(|| {
            Error::configuration("no such board")
                .allowed("3 to 60 inner corners, squares of 1 to 1000 mm, up to 200 mm thick")
        })
    }
}

/// Import what is in the folder `beltgauge` of `root`. The report says what came of it, whether that
/// is an error or not, and is left in the store and on the stick. A stick without such a folder is an
/// error that is noted nowhere: it is somebody else's.
pub fn import(root: &Path, store: &Store) -> Result<String> {
    let mut stick = Stick::open(root)?;
    if stick.check_name().is_ok() && stick.has(update::IMAGE) && !is_for_import(&stick) {
        return Ok(format!(
            "There is no {CONFIG_FILE} on the stick: the configuration stays in force.\n"
        ));
    }
    let locked = store.lock()?;
    let mut report = Report::default();
    let result = locked.begin().and_then(|()| {
        let trust = stage(&mut stick, &locked, &mut report)?;
        let text = format!("{}The configuration is in force.\n", report.text);
        locked.apply(&trust, &text)?;
        report.text = text;
        Ok(())
    });
    if let Err(e) = &result {
        report.text = format!(
            "Refused; the configuration before stays in force.\nerror: {e}\n{}\
             In the folder {} of the stick: {}\n\
             Expected: {CONFIG_FILE}, and the camera file that it names if that is another one\n",
            report.text,
            stick.name(),
            stick.contents()
        );
        if let Err(e) = locked.refuse(&report.text) {
            tracing::warn!("{e}");
        }
    }
    stick.leave(REPORT, report.text.as_bytes());
    if result.is_ok() {
        leave_code(&stick, store);
    }
    for (name, bytes) in &report.results {
        stick.leave_result(name, bytes);
    }
    result.map(|()| report.text)
}

/// Say what [`import`] would do, and do nothing: neither the store nor the stick is changed.
pub fn check(root: &Path, store: &Store) -> Result<String> {
    let mut stick = Stick::open(root)?;
    let locked = store.lock()?;
    let mut report = Report::default();
    let staged = stage(&mut stick, &locked, &mut report);
    let discarded = locked.discard();
    staged?;
    discarded.map(|()| format!("{}It would be taken.\n", report.text))
}

/// Whoever brought what was taken may change things through the page too. The report has no code: it is
/// kept where others read it.
fn leave_code(stick: &Stick, store: &Store) {
    match store.code() {
        Ok(code) => {
            let text =
                format!("To change things on the page, sign in with: {code}\nIt is good once.\n");
            stick.leave(CODE, text.as_bytes());
        }
        Err(e) => tracing::warn!("{e}"),
    }
}

/// What an import tells.
#[derive(Default)]
struct Report {
    text: String,
    /// Files that a calibration gave, by name.
    results: Vec<(&'static str, Vec<u8>)>,
}

impl Report {
    fn line(&mut self, line: &str) {
        self.text.push_str(line);
        self.text.push('\n');
    }
}

/// Whether a stick with an update brings a configuration too, or what was meant to be one.
fn is_for_import(stick: &Stick) -> bool {
    let names = stick.names().unwrap_or_default();
    names.iter().any(|name| name.to_lowercase().contains(".toml") && !name.starts_with(MANIFEST))
}

/// Put the configuration before the one in force in force again. The key in force stays.
pub fn roll_back(store: &Store) -> Result<String> {
    let report = "The configuration before is in force again.\n";
    store.lock()?.roll_back(report)?;
    Ok(report.to_owned())
}

/// Copy, calibrate if there are stills, and check. Returns whom to trust from then on.
fn stage(stick: &mut Stick, locked: &Locked<'_>, report: &mut Report) -> Result<Trust> {
    stick.check_name()?;
    let mut trust = locked.store().trust()?;
    stick.seal(&mut trust)?;
    if !stick.has(CONFIG_FILE) {
        return Err(Error::configuration(format!("there is no file {CONFIG_FILE}"))
            .in_file(stick.path())
            .allowed(format!("a plain file with exactly this name: {CONFIG_FILE}"))
            .remedy("rename it; Windows hides the ends of names, such as a second one .txt"));
    }
    let text = stick.read_text(CONFIG_FILE)?;
    let on_stick = stick.path().join(CONFIG_FILE);
    let config = Config::parse(&text).map_err(|e| e.in_file(&on_stick))?;
    check_names(&config).map_err(|e| e.in_file(&on_stick))?;
    check_interface(config.camera.interface).map_err(|e| e.in_file(&on_stick))?;
    let staging = locked.stage()?;
    save(&staging.join(CONFIG_FILE), text.as_bytes())?;
    let camera = &config.camera.calibration;
    let name = camera.to_str().unwrap_or_default();
    if stick.has(CALIBRATION_FILE) && !stick.has(name) {
        let scratch = Scratch(locked.scratch()?);
        let made = calibrate_stills(stick, &scratch, report);
        report.results = scratch.results();
        made?;
        let made = scratch.0.join(CAMERA_FILE);
        std::fs::copy(&made, staging.join(camera))
            .map_err(|e| Error::failure(format!("cannot copy: {e}")).in_file(&made))?;
    } else {
        save(&staging.join(camera), &camera_file(stick, locked.store(), camera, report)?)?;
    }
    let site = Site::load(&staging.join(CONFIG_FILE))?;
    let plan = super::plan(&site);
    plan.check_limit(site.config.limits.memory_mib_max)?;
    let [width, height] = site.camera.image_size_px;
    report.line(&format!(
        "{CONFIG_FILE} and {name}: {width} x {height} px, zone {:.0} to {:.0} mm along, {:.0} to {:.0} mm across, {:.0} MiB",
        site.config.zone.x_min_mm,
        site.config.zone.x_max_mm,
        site.config.zone.y_min_mm,
        site.config.zone.y_max_mm,
        plan.bytes() as f64 / f64::from(1 << 20),
    ));
    tell_key(&mut trust, &config, report);
    Ok(trust)
}

/// The camera file on the stick; without one, that in force: the camera stays when settings change.
fn camera_file(
    stick: &Stick,
    store: &Store,
    camera: &Path,
    report: &mut Report,
) -> Result<Vec<u8>> {
    let name = camera.to_str().unwrap_or_default();
    match stick.read(name, TEXT_BYTES_MAX) {
        Err(_) if !stick.exists(name) => {
            let in_force = store.file_in_force(camera).ok_or_else(|| {
                Error::configuration(format!("{name} is neither on the stick nor in force"))
                    .in_file(&stick.path().join(name))
                    .remedy("put the camera file on the stick, or correct camera.calibration")
            })?;
            report.line(&format!("{name} is not on the stick: the one in force is used"));
            Ok(in_force)
        }
        read => read,
    }
}

/// The key that the configuration names comes in force. One that names none changes nothing: a line
/// that was forgotten must not open the door.
fn tell_key(trust: &mut Trust, config: &Config, report: &mut Report) {
    match &config.import.public_key {
        Some(key) if trust.public_key.as_ref() != Some(key) => {
            report.line(&format!("From now on sets must be signed with the key {key}"));
            trust.public_key = Some(key.clone());
        }
        None if trust.public_key.is_some() => {
            report.line("import.public_key is not given: the key in force stays");
        }
        _ => {}
    }
}

fn save(path: &Path, bytes: &[u8]) -> Result<()> {
    std::fs::write(path, bytes)
        .map_err(|e| Error::failure(format!("cannot write: {e}")).in_file(path))
}

/// The stick's configuration may name files of its own folder only.
fn check_names(config: &Config) -> Result<()> {
    let camera = &config.camera.calibration;
    let reserved = [CONFIG_FILE, CALIBRATION_FILE, LENS_FILE];
    if !is_plain_name(camera) || reserved.iter().any(|name| camera == Path::new(name)) {
        return Err(Error::configuration(format!("camera.calibration = {}", camera.display()))
            .allowed("the name of a file beside the configuration on the stick")
            .remedy("put the camera file into the same folder, as camera.toml for example"));
    }
    if let Some(file) = &config.plc.state_file {
        return Err(Error::configuration(format!("plc.state_file = {}", file.display()))
            .allowed("no such key on a stick")
            .remedy("leave it out: the appliance keeps what the PLC was told by itself"));
    }
    if let Some(folder) = &config.archive.folder {
        return Err(Error::configuration(format!("archive.folder = {}", folder.display()))
            .allowed("no such key on a stick")
            .remedy("leave it out: the appliance has a folder of its own for the archive"));
    }
    Ok(())
}

/// Make lens and camera file from the stills on the stick.
fn calibrate_stills(stick: &Stick, scratch: &Scratch, report: &mut Report) -> Result<()> {
    let board =
        Board::parse(&stick.read_text(CALIBRATION_FILE)?).map_err(|e| e.at(CALIBRATION_FILE))?;
    let chessboard = Chessboard::new(board.board, board.square_mm);
    let lens = scratch.0.join(LENS_FILE);
    let mut say = |line: &str| {
        report.line(line);
        Ok(())
    };
    let mut warnings = Vec::new();
    match stick.folder(LENS_FOLDER) {
        Some(folder) => {
            let stills = scratch.copy(&folder, LENS_FOLDER)?;
            let (board, model) = (&chessboard, board.model);
            warnings.extend(calibrate::lens(&stills, board, model, None, &lens, &mut say)?);
        }
        None => save(&lens, stick.read_text(LENS_FILE)?.as_bytes())?,
    }
    let belt = stick.folder(BELT_FOLDER).ok_or_else(|| {
        Error::configuration("there are no stills of the board on the belt")
            .at(BELT_FOLDER)
            .remedy("put the camera file, or stills into the folder belt/, on the stick")
    })?;
    let stills = scratch.copy(&belt, BELT_FOLDER)?;
    let (out, thickness_mm) = (scratch.0.join(CAMERA_FILE), board.board_thickness_mm);
    warnings.extend(calibrate::belt(
        &stills,
        &[],
        &chessboard,
        thickness_mm,
        &lens,
        &out,
        &mut say,
    )?);
    for warning in warnings {
        report.line(&format!("warning: {warning}"));
    }
    Ok(())
}

/// A folder for stills and results, removed in the end.
struct Scratch(PathBuf);

impl Scratch {
    /// What there is for the technician.
    fn results(&self) -> Vec<(&'static str, Vec<u8>)> {
        let read = |name| Some((name, files::read(&self.0.join(name), RESULT_BYTES_MAX).ok()?));
        RESULTS.into_iter().filter_map(read).collect()
    }

    fn copy(&self, from: &Stick, name: &str) -> Result<Vec<PathBuf>> {
        let names = from.names()?;
        if names.len() > STILLS_MAX {
            return Err(Error::configuration(format!("{} stills", names.len()))
                .at(name)
                .allowed(format!("{STILLS_MAX} in a folder"))
                .remedy("choose the sharpest"));
        }
        let folder = self.0.join(name);
        let failed = |e: std::io::Error| {
            Error::failure(format!("cannot copy the stills: {e}")).in_file(&folder)
        };
        std::fs::create_dir(&folder).map_err(failed)?;
        let mut room = STILLS_BYTES_MAX;
        for still in &names {
            let bytes = from.read(still, FILE_BYTES_MAX.min(room))?;
            room -= bytes.len() as u64;
            std::fs::write(folder.join(still), bytes).map_err(failed)?;
        }
        Ok(vec![folder])
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
