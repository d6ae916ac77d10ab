//! What the demo has of a board: the stills that `demo --record` puts beside its recording, with a site and
//! its camera, and `demo --board` shows instead of parcels.

use crate::camera::chessboard::Chessboard;
use crate::camera::{BeltTable, CalibrationFile, Camera};
use crate::error::{Error, Result};
use crate::image::FrameTime;
use crate::source::synthetic::{BoardStills, Scenario, held_poses};
use crate::source::{FrameSource, Still};
use std::path::Path;

/// The board that README calibrates with: 10 by 7 squares, glued to something of 3 mm.
const CORNERS: [usize; 2] = [9, 6];
const SQUARE_MM: f64 = 25.0;
const THICKNESS_MM: f64 = 3.0;
/// So long a still is shown.
const STILL_S: f64 = 1.0;
/// Where the board's first corner lies in the stills of its way, and how it is turned.
const PASS_X_MM: [f64; 4] = [-430.0, -220.0, 20.0, 240.0];
const PASS_Y_MM: f64 = 90.0;
const PASS_YAW_DEG: f64 = 4.0;
/// The same for the stills of it laid elsewhere.
const ELSEWHERE: [([f64; 2], f64); 4] = [
    ([-420.0, 300.0], -10.0),
    ([190.0, 280.0], 15.0),
    ([-400.0, -130.0], 20.0),
    ([200.0, -110.0], -5.0),
];

/// Write the folder.
pub(super) fn write(
    folder: &Path,
    scenario: &Scenario,
    camera: &Camera,
    config: &str,
) -> Result<()> {
    let failed = |e: std::io::Error| {
        Error::failure(format!("--record: cannot write the site: {e}")).in_file(folder)
    };
    for part in ["views", "pass", "elsewhere"] {
        std::fs::create_dir_all(folder.join(part)).map_err(failed)?;
    }
    std::fs::write(folder.join("beltgauge.toml"), config).map_err(failed)?;
    true_camera(camera).save(&folder.join("camera.toml"), "beltgauge demo --record")?;
    for (part, k, still) in stills(scenario, camera)? {
        let [width, height] = still.size_px.map(|n| n as u32);
        let path = folder.join(part).join(format!("{k:02}.png"));
        image::save_buffer(&path, &still.pixels, width, height, image::ExtendedColorType::L8)
            .map_err(|e| Error::failure(format!("cannot write a still: {e}")).in_file(&path))?;
    }
    Ok(())
}

/// Every still of the board: its folder, its number there, its picture.
fn stills(scenario: &Scenario, camera: &Camera) -> Result<Vec<(&'static str, usize, Still)>> {
    let board = Chessboard::new(CORNERS, SQUARE_MM);
    let mut stills = BoardStills::new(scenario.clone(), board)?;
    let mut all = Vec::new();
    for (k, (angles_deg, middle_mm)) in
        held_poses(&camera.lens, camera.image_size_px).into_iter().enumerate()
    {
        all.push(("views", k, stills.held(angles_deg, middle_mm)));
    }
    for (k, x_mm) in PASS_X_MM.into_iter().enumerate() {
        let still = stills.on_belt([x_mm, PASS_Y_MM], PASS_YAW_DEG, THICKNESS_MM);
        all.push(("pass", k, still));
    }
    for (k, (corner_mm, yaw_deg)) in ELSEWHERE.into_iter().enumerate() {
        all.push(("elsewhere", k, stills.on_belt(corner_mm, yaw_deg, THICKNESS_MM)));
    }
    Ok(all)
}

/// A camera that is shown the board: held 15 times, carried by the belt to four places, and again.
pub(super) struct BoardShow {
    stills: Vec<Still>,
    fps: f64,
    next_index: u64,
}

impl BoardShow {
    /// By the camera of a scenario. Its stills are drawn now: it takes a few seconds.
    pub(super) fn new(scenario: &Scenario, camera: &Camera) -> Result<Self> {
        let all = stills(scenario, camera)?.into_iter();
        let stills = all.filter(|(part, ..)| *part != "elsewhere").map(|(.., still)| still);
        Ok(Self { stills: stills.collect(), fps: scenario.fps, next_index: 0 })
    }
}

impl FrameSource for BoardShow {
    fn size_px(&self) -> [usize; 2] {
        self.stills[0].size_px
    }

    fn fps(&self) -> f64 {
        self.fps
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        let (index, t_s) = (self.next_index, self.next_index as f64 / self.fps);
        let shown = (t_s / STILL_S) as usize % self.stills.len();
        frame.copy_from_slice(&self.stills[shown].pixels);
        self.next_index += 1;
        Ok(Some(FrameTime { index, t_s }))
    }

    fn skip(&mut self, count: u64) {
        self.next_index += count;
    }
}

/// The camera that rendered the recording, as `calibrate` would write it: without error.
fn true_camera(camera: &Camera) -> CalibrationFile {
    let axis = camera.camera_from_belt.row(2);
    let belt = BeltTable {
        camera_height_mm: camera.centre_in_belt().z,
        camera_tilt_deg: (-axis[2]).clamp(-1.0, 1.0).acos().to_degrees(),
        sigma_height_mm: 0.0,
        sigma_tilt_deg: 0.0,
        sigma_travel_deg: None,
        travel_mm: None,
        surveyed_origin_mm: None,
    };
    CalibrationFile::lens(camera.image_size_px, &camera.lens, None, 0.0, Vec::new(), Vec::new())
        .over_belt(camera, belt)
}
