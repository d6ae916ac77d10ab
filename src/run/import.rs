//! `beltgauge import`: from a USB stick into the store of configurations, completely checked.

use super::calibrate;
use crate::camera::LensModel;
use crate::camera::chessboard::Chessboard;
use crate::config::stick::{
    self, STILL_BYTES_MAX, STILLS_BYTES_MAX, STILLS_MAX, Stick, is_plain_name,
};
use crate::config::store::{CONFIG_FILE, ImportResult, Locked, REPORT, Store};
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// How the stills of a calibration on the stick were taken.
const CALIBRATION_FILE: &str = "calibration.toml";
const LENS_FOLDER: &str = "lens";
const BELT_FOLDER: &str = "belt";
const LENS_FILE: &str = "lens.toml";

/// `calibration.toml` on the stick: the board of the stills in `lens/` and `belt/`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Board {
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
    fn parse(text: &str) -> Result<Self> {
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
/// is an error or not, and is left in the store and on the stick.
pub fn import(root: &Path, store: &Store) -> Result<String> {
    let locked = store.lock()?;
    let mut report = String::new();
    // A stick that stays plugged in is imported at every start: what is in force already stays.
    let result = stage(root, store, &locked, &mut report)
        .and_then(|()| if locked.is_in_force() { Ok(()) } else { locked.apply() });
    match &result {
        Ok(()) => report.push_str("The configuration is in force.\n"),
        Err(e) => {
            let _ =
                writeln!(report, "Refused; the configuration before stays in force.\nerror: {e}");
        }
    }
    let outcome = if result.is_ok() { ImportResult::Applied } else { ImportResult::Refused };
    locked.note(outcome, &report)?;
    if let Ok(stick) = Stick::open(root, None) {
        stick.leave(REPORT, &report);
    }
    result.map(|()| report)
}

/// Put the configuration before the one in force in force again.
pub fn roll_back(store: &Store) -> Result<String> {
    let locked = store.lock()?;
    locked.roll_back()?;
    let report = "The configuration before is in force again.\n";
    locked.note(ImportResult::RolledBack, report)?;
    Ok(report.to_owned())
}

/// Copy, calibrate if there are stills, and check.
fn stage(root: &Path, store: &Store, locked: &Locked<'_>, report: &mut String) -> Result<()> {
    let key = key_in_force(store)?;
    let stick = Stick::open(root, key)?;
    let text = stick.read_text(CONFIG_FILE)?;
    let on_stick = root.join(stick::FOLDER).join(CONFIG_FILE);
    let config = Config::parse(&text).map_err(|e| e.in_file(&on_stick))?;
    check_names(&config).map_err(|e| e.in_file(&on_stick))?;
    let staging = locked.stage()?;
    let save = |name: &Path, bytes: &[u8]| {
        std::fs::write(staging.join(name), bytes)
            .map_err(|e| Error::failure(format!("cannot write: {e}")).in_file(&staging.join(name)))
    };
    save(Path::new(CONFIG_FILE), text.as_bytes())?;
    let camera = &config.camera.calibration;
    let name = camera.to_str().unwrap_or_default();
    if stick.has(CALIBRATION_FILE) && !stick.has(name) {
        calibrate_stills(&stick, &staging, camera, report)?;
    } else {
        save(camera, stick.read_text(name)?.as_bytes())?;
    }
    let site = Site::load(&staging.join(CONFIG_FILE))?;
    let plan = super::plan(&site);
    plan.check_limit(site.config.limits.memory_mib_max)?;
    let [width, height] = site.camera.image_size_px;
    let _ = writeln!(
        report,
        "{CONFIG_FILE} and {name}: {width} x {height} px, zone {:.0} to {:.0} mm along, {:.0} to {:.0} mm across, {:.0} MiB",
        site.config.zone.x_min_mm,
        site.config.zone.x_max_mm,
        site.config.zone.y_min_mm,
        site.config.zone.y_max_mm,
        plan.bytes() as f64 / f64::from(1 << 20),
    );
    Ok(())
}

/// The key that the configuration in force asks for. When that cannot be read, nothing is accepted:
/// a damaged file must not open the door.
pub(super) fn key_in_force(store: &Store) -> Result<Option<minisign_verify::PublicKey>> {
    let path = store.config();
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(Error::failure(format!("cannot read: {e}")).in_file(&path)),
    };
    let config = Config::parse(&text).map_err(|e| e.in_file(&path))?;
    config.import.public_key.as_deref().map(stick::public_key).transpose()
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
    Ok(())
}

/// Make the camera file from the stills on the stick.
fn calibrate_stills(
    stick: &Stick,
    staging: &Path,
    camera: &Path,
    report: &mut String,
) -> Result<()> {
    let board =
        Board::parse(&stick.read_text(CALIBRATION_FILE)?).map_err(|e| e.at(CALIBRATION_FILE))?;
    let chessboard = Chessboard::new(board.board, board.square_mm);
    let scratch = Scratch::new()?;
    let lens = scratch.0.join(LENS_FILE);
    let mut say = |line: &str| {
        let _ = writeln!(report, "{line}");
        Ok(())
    };
    let mut warnings = Vec::new();
    match stick.folder(LENS_FOLDER) {
        Some(folder) => {
            let stills = scratch.copy(&folder, LENS_FOLDER)?;
            let (board, model) = (&chessboard, board.model);
            warnings.extend(calibrate::lens(&stills, board, model, None, &lens, &mut say)?);
        }
        None => std::fs::write(&lens, stick.read_text(LENS_FILE)?)
            .map_err(|e| Error::failure(format!("cannot write: {e}")).in_file(&lens))?,
    }
    let belt = stick.folder(BELT_FOLDER).ok_or_else(|| {
        Error::configuration("there are no stills of the board on the belt")
            .at(BELT_FOLDER)
            .remedy("put the camera file, or stills into the folder belt/, on the stick")
    })?;
    let stills = scratch.copy(&belt, BELT_FOLDER)?;
    let (out, thickness_mm) = (scratch.0.join("camera.toml"), board.board_thickness_mm);
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
        let _ = writeln!(report, "warning: {warning}");
    }
    std::fs::copy(&out, staging.join(camera))
        .map(drop)
        .map_err(|e| Error::failure(format!("cannot write: {e}")).in_file(camera))
}

/// A folder for stills, removed in the end.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Result<Self> {
        let path = std::env::temp_dir().join(format!("beltgauge-import-{}", std::process::id()));
        std::fs::create_dir(&path)
            .map_err(|e| Error::failure(format!("cannot make a folder: {e}")).in_file(&path))?;
        Ok(Self(path))
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
            let bytes = from.read(still, STILL_BYTES_MAX.min(room))?;
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
