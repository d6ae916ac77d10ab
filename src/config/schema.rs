//! The keys of the configuration file, their defaults and ranges.

use super::fleet::Fleet;
use super::health::Health;
use super::plc::{Can, Encoder, Modbus, Plc};
use super::ranges::{self, range};
use super::service::{Archive, Log, Web};
use crate::error::{Error, Result};
use crate::units::BeltRect;
use minisign_verify::PublicKey;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// The configuration file.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// `[camera]`
    pub camera: CameraTable,
    /// `[zone]`: the part of the belt that the camera sees freely, belt coordinates.
    pub zone: BeltRect,
    /// `[belt]`
    pub belt: Belt,
    /// `[view]`
    #[serde(default)]
    pub view: View,
    /// `[background]`
    #[serde(default)]
    pub background: Background,
    /// `[segment]`
    #[serde(default)]
    pub segment: Segment,
    /// `[odometry]`
    #[serde(default)]
    pub odometry: Odometry,
    /// `[measure]`
    #[serde(default)]
    pub measure: Measure,
    /// `[health]`
    #[serde(default)]
    pub health: Health,
    /// `[limits]`
    #[serde(default)]
    pub limits: Limits,
    /// `[realtime]`
    #[serde(default)]
    pub realtime: Realtime,
    /// `[plc]`
    #[serde(default)]
    pub plc: Plc,
    /// `[modbus]`
    #[serde(default)]
    pub modbus: Modbus,
    /// `[can]`
    #[serde(default)]
    pub can: Can,
    /// `[encoder]`
    #[serde(default)]
    pub encoder: Encoder,
    /// `[import]`
    #[serde(default)]
    pub import: Import,
    /// `[web]`
    #[serde(default)]
    pub web: Web,
    /// `[archive]`
    #[serde(default)]
    pub archive: Archive,
    /// `[fleet]`
    #[serde(default)]
    pub fleet: Fleet,
    /// `[log]`
    #[serde(default)]
    pub log: Log,
}

/// How a live camera is reached.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Interface {
    /// Video4Linux: USB webcams and industrial cameras with a kernel driver.
    #[default]
    V4l2,
    /// GigE cameras, by this program's own receiver.
    Gige,
    /// GigE and USB3 cameras, by the Aravis library; needs the cargo feature `aravis`.
    Aravis,
}

/// `[camera]`: where the pictures come from and how they were taken.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraTable {
    /// Calibration file, relative to the configuration file.
    pub calibration: PathBuf,
    /// How the camera is reached.
    #[serde(default)]
    pub interface: Interface,
    /// Which one: device path, bus or card name; address, serial number or name of a GigE camera.
    /// None given: the only one.
    pub device: Option<String>,
    /// Pixel format, by its V4L2 or GenICam name; none given: 8-bit mono.
    pub format: Option<String>,
    /// Frames a second; none given: what the camera is set to.
    pub fps: Option<f64>,
    /// Exposure; none given: what the camera is set to.
    pub exposure_us: Option<f64>,
    /// Gain, in the camera's own unit; none given: what the camera is set to.
    pub gain: Option<f64>,
    /// GigE packets, headers included; none given: 1500 bytes.
    pub packet_bytes: Option<u32>,
    /// A camera that sends no frame for this long is opened again; 0: never, for one with a trigger.
    #[serde(default = "frame_timeout_s")]
    pub frame_timeout_s: f64,
    /// Other controls by the driver's or GenICam's name, set in this order, trigger for one.
    #[serde(default)]
    #[schemars(with = "std::collections::BTreeMap<String, serde_json::Value>")]
    pub controls: toml::Table,
}

/// Longer than any pause of a camera that runs free.
fn frame_timeout_s() -> f64 {
    5.0
}

impl CameraTable {
    /// All defaults.
    pub fn new(calibration: PathBuf) -> Self {
        Self {
            calibration,
            interface: Interface::default(),
            device: None,
            format: None,
            fps: None,
            exposure_us: None,
            gain: None,
            packet_bytes: None,
            frame_timeout_s: frame_timeout_s(),
            controls: toml::Table::new(),
        }
    }

    fn check(&self) -> Result<()> {
        for (name, value) in &self.controls {
            if value.is_table() || value.is_array() || value.is_datetime() {
                return Err(Error::configuration(format!("camera.controls.{name} = {value}"))
                    .allowed("a number, true, false or a text")
                    .remedy("write one value for each control"));
            }
        }
        Ok(())
    }
}

/// `[belt]`
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Belt {
    /// Nominal speed; may be off by 5 %.
    pub speed_mm_per_s: f64,
}

/// `[view]`: the rectified belt view.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// Pixel size on the belt; default: the camera's own in the middle of the zone.
    pub mm_per_px: Option<f64>,
    /// Tallest parcel; default: 400 mm, at most 40 % of the camera height.
    pub height_max_mm: Option<f64>,
}

/// `[background]`: the Gaussian mixture model.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Background {
    /// Frames at start-up on which the empty belt is learned and no parcel is reported.
    pub learn_frames: u32,
    /// Frames after which a change counts as background: 1 / learning rate.
    pub history_frames: u32,
    /// Foreground when further than this many standard deviations from every background mode.
    pub threshold_sigma: f64,
    /// Darker than the belt by no more than this factor is a shadow.
    pub shadow_ratio_min: f64,
    /// Darker still by no more than this factor is a dark parcel or a deep shadow; the
    /// measurement decides which.
    pub deep_shadow_ratio_min: f64,
}

impl Default for Background {
    fn default() -> Self {
        Self {
            learn_frames: 15,
            history_frames: 500,
            threshold_sigma: 4.0,
            shadow_ratio_min: 0.72,
            deep_shadow_ratio_min: 0.3,
        }
    }
}

/// `[segment]`: from mask to blobs.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Segment {
    /// Specks narrower than this vanish (opening).
    pub open_px: usize,
    /// Gaps narrower than this are filled (closing).
    pub close_px: usize,
    /// Blobs smaller than this on the belt are ignored.
    pub area_min_mm2: f64,
    /// What is narrower than this is a sliver of shadow or light, no parcel; default: 4 px of the
    /// view.
    pub side_min_mm: Option<f64>,
}

impl Default for Segment {
    fn default() -> Self {
        Self { open_px: 1, close_px: 3, area_min_mm2: 300.0, side_min_mm: None }
    }
}

/// `[odometry]`: belt motion from the belt's own texture.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Odometry {
    /// Largest relative error of the nominal speed that is searched.
    pub speed_error_max: f64,
}

impl Default for Odometry {
    fn default() -> Self {
        Self { speed_error_max: 0.06 }
    }
}

/// `[measure]`: from edges to a cuboid.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Measure {
    /// Radius of a parcel's edges: rounded edges appear inside of the outer size.
    pub edge_radius_mm: f64,
    /// Dimensions may be used when every standard deviation is at most this.
    pub sigma_max_mm: f64,
}

impl Default for Measure {
    fn default() -> Self {
        Self { edge_radius_mm: 1.2, sigma_max_mm: 3.0 }
    }
}

/// `[limits]`: the size of every table.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// The memory plan may not need more.
    pub memory_mib_max: usize,
    /// Parcels in view at once.
    pub tracks_max: usize,
    /// Runs of foreground pixels in one frame.
    pub runs_max: usize,
    /// Blobs in one frame.
    pub blobs_max: usize,
    /// Frames of one pass whose edges are kept for the fit.
    pub views_per_track_max: usize,
    /// Frames between camera and vision thread.
    pub frames_queued_max: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            memory_mib_max: 1024,
            tracks_max: 16,
            runs_max: 16384,
            blobs_max: 512,
            views_per_track_max: 96,
            frames_queued_max: 8,
        }
    }
}

/// `[realtime]`: how the vision thread gets its processor.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Realtime {
    /// Threads that a frame's rows are shared among.
    pub workers: usize,
    /// Lock all memory, so that none is ever swapped out.
    pub lock_memory: bool,
    /// `SCHED_FIFO` priority of the vision threads; 0: an ordinary thread.
    pub priority: u8,
    /// Bind the vision threads to this processor and those after it.
    pub first_processor: Option<usize>,
}

impl Default for Realtime {
    fn default() -> Self {
        Self { workers: 1, lock_memory: false, priority: 0, first_processor: None }
    }
}

/// `[import]`: what a USB stick may change.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Import {
    /// Only sets signed with the secret key that belongs to this one (minisign) are accepted.
    pub public_key: Option<String>,
}

/// A public key of minisign, as its `.pub` file has it in the last line.
pub fn public_key(text: &str) -> Result<PublicKey> {
    PublicKey::from_base64(text).map_err(|e| {
        Error::configuration(format!("import.public_key = {text:?}: {e}"))
            .allowed("the last line of minisign's .pub file")
            .remedy("make a pair of keys with `minisign -G`")
    })
}

impl Config {
    /// Parse and check each key on its own.
    pub fn parse(text: &str) -> Result<Self> {
        let not_understood = |e: toml::de::Error| {
            Error::configuration(e.to_string().trim_end().to_owned())
                .allowed("the keys of config/reference.toml; lengths in mm, speeds in mm per s")
                .remedy("correct the line shown")
        };
        let config: Self = toml::from_str(text).map_err(not_understood)?;
        ranges::check(&toml::from_str(text).map_err(not_understood)?)?;
        config.check()?;
        Ok(config)
    }

    /// What the table of ranges cannot say.
    fn check(&self) -> Result<()> {
        let Self { camera, zone, plc, modbus, can, encoder, import, web, fleet, log, .. } = self;
        camera.check()?;
        for (key, mm) in [
            ("zone.x_max_mm - zone.x_min_mm", zone.x_max_mm - zone.x_min_mm),
            ("zone.y_max_mm - zone.y_min_mm", zone.y_max_mm - zone.y_min_mm),
        ] {
            range(key, mm, 50.0, 10_000.0, "mm")?;
        }
        plc.check()?;
        can.check()?;
        encoder.check()?;
        check_writers(plc, modbus, can, encoder)?;
        web.check()?;
        fleet.check()?;
        log.check()?;
        import.public_key.as_deref().map_or(Ok(()), |key| public_key(key).map(drop))
    }
}

/// What a PLC has to write needs one that may.
fn check_writers(plc: &Plc, modbus: &Modbus, can: &Can, encoder: &Encoder) -> Result<()> {
    if can.interface.is_some() || !modbus.write_allow.is_empty() {
        return Ok(());
    }
    let needed = [
        (plc.queue, "plc.queue", "acknowledge", "set it to false"),
        (
            plc.heartbeat_timeout_s > 0.0,
            "plc.heartbeat_timeout_s",
            "write a heartbeat",
            "set it to 0",
        ),
        (
            encoder.mm_per_count.is_some(),
            "encoder.mm_per_count",
            "write the counts",
            "leave it out",
        ),
    ];
    let Some((_, key, what, without)) = needed.into_iter().find(|(set, ..)| *set) else {
        return Ok(());
    };
    Err(Error::configuration(format!(
        "{key} is set, but nobody may {what}: modbus.write_allow is empty and there is no CAN"
    ))
    .allowed("addresses of the PLCs that write, as [\"192.168.1.10\"]")
    .remedy(format!("name the PLC in modbus.write_allow, or can.interface, or {without}")))
}
