//! What the pages show, as JSON has it.

use crate::event::ParcelRecord;
use serde::Serialize;

/// A point of a picture: column and row, in its pixels.
pub type Px = [f32; 2];

/// Base and top of a cuboid in a picture: four corners each, around it in the same order.
pub type Cuboid = [Px; 8];

/// What the machine tells when it is asked.
pub trait Machine: Send + Sync + 'static {
    /// Its state.
    fn state(&self) -> State;
    /// What the PLC reads and writes.
    fn plc(&self) -> Plc;
    /// So many entries of the archive before one, newest first; before none: the newest. May wait for
    /// the disk.
    fn archived(&self, before: Option<u64>, limit: usize) -> Result<Archived, String>;
    /// The picture of an entry of the archive. May wait for the disk.
    fn archived_picture(&self, entry: u64) -> Option<Vec<u8>>;
    /// What it adds to the support bundle: each file is made when it is asked for, and may wait for the
    /// disk.
    fn bundle(&self) -> BundleFiles;
}

/// Changes the machine's site, for whoever has signed in. Everything but [`Keeper::is_signed_in`] may wait
/// for the disk; errors are words for the visitor.
pub trait Keeper: Send + Sync + 'static {
    /// Sign in with the one-time code: the secret that the visitor is known by from then on. `None`: it is
    /// another code.
    fn sign_in(&self, code: &str) -> Result<Option<String>, String>;
    /// Whether whoever has this secret has signed in.
    fn is_signed_in(&self, secret: &str) -> bool;
    /// Sign out whoever has signed in.
    fn sign_out(&self) -> Result<(), String>;
    /// The site in force.
    fn site(&self) -> Site;
    /// Empty the tray: the files that the visitor brings, as on a stick.
    fn clear(&self) -> Result<(), String>;
    /// Put a file on the tray.
    fn put(&self, path: &str, bytes: &[u8]) -> Result<(), String>;
    /// Begin a change; [`Site::work`] says how it goes.
    fn change(&self, change: Change) -> Result<(), String>;
}

/// What a visitor who has signed in can have done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// Say what putting the tray in force would do.
    Check,
    /// Put what is on the tray in force.
    Apply,
    /// Put the site before in force again.
    GoBack,
}

/// How far a change has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WorkState {
    /// There was none since start.
    #[default]
    None,
    /// It is at work.
    Busy,
    /// It is done.
    Good,
    /// It was refused, or has failed.
    Bad,
}

/// A change, since start.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Work {
    /// Which.
    pub change: Option<Change>,
    /// How far it has come.
    pub state: WorkState,
    /// What it came to, in words.
    pub report: String,
    /// Another site is in force: the program starts again.
    pub restarts: bool,
}

/// A text file of the site.
#[derive(Clone, Debug, Serialize)]
pub struct SiteFile {
    /// Its name, beside the configuration.
    pub name: String,
    /// What is in it.
    pub text: String,
}

/// The site in force.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Site {
    /// Its configuration, as it was written.
    pub configuration: Option<String>,
    /// The camera file that it names.
    pub camera: Option<SiteFile>,
    /// There is one before it.
    pub can_go_back: bool,
    /// Imports so far, from sticks and through the page; wraps.
    pub imports: u16,
    /// What the last one came to, in words.
    pub report: String,
    /// The last change through the page, since start.
    pub work: Work,
}

/// Files of the support bundle, one after the other.
pub type BundleFiles = Box<dyn Iterator<Item = BundleFile> + Send>;

/// A file of the support bundle.
#[derive(Clone, Debug)]
pub struct BundleFile {
    /// Its path in the bundle.
    pub name: String,
    /// What is in it, or why it is left out.
    pub bytes: Result<Vec<u8>, String>,
}

/// The machine's state.
#[derive(Clone, Debug, Default, Serialize)]
pub struct State {
    /// Version of the program.
    pub version: &'static str,
    /// The machine's clock when this was so, ms since 1970: it stands still when nothing new is known.
    pub utc_ms: u64,
    /// Since start.
    pub uptime_s: f64,
    /// Starts of the appliance; 0: it keeps none.
    pub boots: u16,
    /// Four lamps.
    pub lamps: Vec<Lamp>,
    /// Codes of all that is wrong or worth knowing, what matters most first.
    pub reasons: Vec<u16>,
    /// The empty belt has been learned.
    pub ready: bool,
    /// Parcels are not reported, by command.
    pub stopped: bool,
    /// The camera.
    pub camera: CameraState,
    /// The belt.
    pub belt: BeltState,
    /// What happened so far.
    pub counts: Counts,
    /// The archive.
    pub archive: ArchiveState,
}

/// A lamp.
#[derive(Clone, Debug, Serialize)]
pub struct Lamp {
    /// `running`, `uncertain`, `maintenance` or `failure`.
    pub name: &'static str,
    /// It is lit.
    pub on: bool,
    /// Codes of the reasons why; of `running`: why not.
    pub reasons: Vec<u16>,
}

/// The camera and its frames.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CameraState {
    /// It is there and does what it was asked for.
    pub present: bool,
    /// How often it was lost.
    pub losses: u64,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Frames processed.
    pub frames: u64,
    /// Frames that came too late.
    pub frames_dropped: u64,
    /// Frames that never came.
    pub frames_lost: u64,
    /// Frames that came with parts missing.
    pub frames_torn: u64,
    /// The slowest frame in the pipeline.
    pub frame_time_max_ms: f64,
    /// Whether it is seen when it moves: 0 being learned, 1 no, 2 across travel, 3 along travel, 4 yes.
    pub watch: u16,
    /// How far its picture has moved since start.
    pub moved_px: f64,
    /// The largest error that this causes.
    pub moved_error_mm: f64,
    /// Standard deviation of its blur; `None`: not known.
    pub blur_px: Option<f64>,
    /// The part of the picture whose light has changed most, from 1, of 4 columns and 3 rows; 0: not known.
    pub light_region: u16,
    /// Its brightness over that at start, less 1.
    pub light_change: f64,
}

/// The belt.
#[derive(Clone, Debug, Default, Serialize)]
pub struct BeltState {
    /// Its speed.
    pub speed_mm_per_s: f64,
    /// As configured.
    pub nominal_mm_per_s: f64,
    /// It is measured, not assumed.
    pub measured: bool,
    /// By the encoder.
    pub by_encoder: bool,
    /// Since start.
    pub travel_mm: f64,
    /// What the pictures show; negative: against +X.
    pub seen_mm_per_s: Option<f64>,
    /// The encoder's travel over that of the texture.
    pub encoder_ratio: Option<f64>,
}

/// What happened since start.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Counts {
    /// Parcels reported, measured or not.
    pub parcels: u64,
    /// Of these, parcels without dimensions.
    pub parcels_unmeasured: u64,
    /// Of these, parcels whose dimensions may be used.
    pub parcels_usable: u64,
    /// Parcels that vanished inside the view.
    pub parcels_lost: u64,
    /// Parcels that left the PLC's queue without having been acknowledged.
    pub queue_overflows: u64,
    /// Times that a table was full: runs or blobs, tracks, records.
    pub table_overflows: [u64; 3],
    /// Parcels without a picture, because too many came at once.
    pub pictures_missed: u64,
    /// Parcels that page and archive were not told of, because too many came at once.
    pub parcels_missed: u64,
    /// Commands that are no events, because too many came at once.
    pub commands_missed: u64,
    /// Lines of the log that nobody read.
    pub log_lines_dropped: u64,
}

/// The archive.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ArchiveState {
    /// There is one.
    pub enabled: bool,
    /// Entries written since start.
    pub entries_written: u64,
    /// Entries that found the disk slow, full or failing.
    pub entries_lost: u64,
    /// Bytes on the disk.
    pub bytes: u64,
    /// It takes no more.
    pub bytes_max: u64,
    /// Why it cannot be written at present.
    pub fault: Option<String>,
    /// The part of it that was found damaged since start.
    pub damaged: Option<String>,
}

/// A parcel as it was told to the PLC.
#[derive(Clone, Debug, Serialize)]
pub struct Parcel {
    /// Its number on this list, from 1 at start.
    pub n: u64,
    /// When it was told, ms since 1970.
    pub utc_ms: u64,
    /// The record.
    #[serde(flatten)]
    pub record: ParcelRecord,
    /// Its picture, if there is one.
    pub picture: Option<ParcelPicture>,
    /// Why there is none.
    pub no_picture: Option<NoPicture>,
}

/// Why there is no picture of a parcel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NoPicture {
    /// Too many came at once.
    TooMany,
    /// It was not followed through the middle of the zone, where pictures are taken.
    NotInMiddle,
}

impl NoPicture {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::TooMany, Self::NotInMiddle];
}

/// What belongs to a parcel's picture.
#[derive(Clone, Debug, Serialize)]
pub struct ParcelPicture {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// The record's cuboid in it.
    pub cuboid_px: Option<Cuboid>,
}

/// Something that happened.
#[derive(Clone, Debug, Serialize)]
pub struct Event {
    /// Its number on this list, from 1 at start.
    pub n: u64,
    /// When, ms since 1970.
    pub utc_ms: u64,
    /// What: `started`, `stopped`, `began` and `ended` (of the reason `code`), `camera_lost`, `command`,
    /// `import`, `signed_in`, `site_check`, `site_apply`, `site_go_back`.
    pub kind: &'static str,
    /// Which.
    pub code: u32,
    /// Who or what, in the machine's words.
    pub detail: String,
}

/// A piece of the trend: what happened meanwhile.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Point {
    /// Its number, from 1 at start.
    pub n: u64,
    /// When it ended, ms since 1970.
    pub utc_ms: u64,
    /// How long it is.
    pub span_s: f32,
    /// Parcels told.
    pub parcels: u32,
    /// Of these, parcels whose dimensions must not be used, measured or not.
    pub refused: u32,
    /// Of these, parcels that could not be measured.
    pub unmeasured: u32,
    /// Means of the standard deviations of length, width and height of those that were measured.
    pub sigma_mm: Option<[f32; 3]>,
    /// The belt's speed at its end; `None`: not measured.
    pub belt_speed_mm_per_s: Option<f32>,
    /// Standard deviation of the picture's blur at its end; `None`: not known.
    pub blur_px: Option<f32>,
    /// Frames that came too late, torn or not at all.
    pub frames_missing: u32,
}

/// Entries of the archive.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Archived {
    /// Newest first: number, time, kind and what was written.
    pub entries: Vec<serde_json::Value>,
    /// Ask for what is before this one; none: there is no more.
    pub before: Option<u64>,
    /// Where entries are missing among these because they cannot be read.
    pub unread: Vec<String>,
}

/// The PLC's side.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Plc {
    /// Version of the map.
    pub map_version: String,
    /// Address of the map's first register.
    pub base_address: u16,
    /// What it reads of the machine's state.
    pub status: Vec<Field>,
    /// What it writes.
    pub command: Vec<Field>,
    /// The latest parcel.
    pub latest: Vec<Field>,
    /// Who wrote last, and when.
    pub written: Option<Written>,
    /// Who is connected.
    pub clients: Vec<Client>,
    /// The CAN interface, if there is one.
    pub can_interface: Option<String>,
}

/// A value in the registers.
#[derive(Clone, Debug, Serialize)]
pub struct Field {
    /// Address of its first register.
    pub address: u16,
    /// Name in the map.
    pub name: &'static str,
    /// In its unit.
    pub value: f64,
    /// Its registers.
    pub registers: Vec<u16>,
    /// Unit.
    pub unit: &'static str,
    /// Decimal places that its registers can hold.
    pub digits: u8,
    /// Meaning.
    pub meaning: &'static str,
}

/// A write.
#[derive(Clone, Debug, Serialize)]
pub struct Written {
    /// Who.
    pub sender: String,
    /// How long ago.
    pub seconds_ago: f64,
}

/// A Modbus client.
#[derive(Clone, Debug, Serialize)]
pub struct Client {
    /// Address and port.
    pub address: String,
    /// Whole requests so far.
    pub requests: u32,
    /// Since the last one.
    pub silent_s: f64,
    /// It may write.
    pub may_write: bool,
}

/// What is drawn over a live picture: of the same frame.
#[derive(Clone, Debug, Serialize)]
pub struct Scene {
    /// Number of the frame.
    pub frame: u64,
    /// Its time from the first frame.
    pub t_s: f64,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// The zone's border.
    pub zone_px: Vec<Px>,
    /// Lines of the grid on the belt, with what they are labelled by: `x` or `y`, and mm.
    pub grid_px: Vec<(char, f64, Vec<Px>)>,
    /// The belt's direction: from, to.
    pub travel_px: [Px; 2],
    /// Parcels.
    pub parcels: Vec<Sight>,
}

/// A parcel in a live picture.
#[derive(Clone, Debug, Serialize)]
pub struct Sight {
    /// `candidate`, `riding` or `told`.
    pub phase: &'static str,
    /// Border of its image.
    pub bounds_px: Vec<Px>,
    /// Its cuboid as estimated so far.
    pub cuboid_px: Option<Cuboid>,
}

/// What the camera's picture shows to whoever sets it up.
#[derive(Clone, Debug, Serialize)]
pub struct Setup {
    /// Number of the frame.
    pub frame: u64,
    /// Its time from the first frame.
    pub t_s: f64,
    /// Columns and rows of the camera's picture.
    pub size_px: [usize; 2],
    /// In the JPEG: the whole picture.
    pub whole: Piece,
    /// Five places, one to one, below it: the middle, then the corners, row by row.
    pub places: Vec<SetupPlace>,
    /// How often each sixteenth of the greys is there, as a share of the pixels.
    pub histogram: [f32; 16],
    /// Share of the pixels that are as white as can be, and black.
    pub white_share: f32,
    /// Likewise.
    pub black_share: f32,
    /// How far the belt moves while a frame is exposed, pixels of the belt view; `None`: the
    /// configuration names no exposure.
    pub motion_blur_px: Option<f64>,
    /// The board that was looked for.
    pub board: Option<BoardSeen>,
}

/// A part of the camera's picture in the JPEG that comes with it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Piece {
    /// Where it begins in the camera's picture.
    pub from_px: [usize; 2],
    /// Where it begins in the JPEG.
    pub at_px: [usize; 2],
    /// Columns and rows in the JPEG.
    pub size_px: [usize; 2],
    /// Pixels of the camera for each.
    pub shrunk_by: usize,
}

/// A place of the picture.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct SetupPlace {
    /// Its part of the JPEG.
    #[serde(flatten)]
    pub piece: Piece,
    /// Standard deviation of the blur of the edges there; `None`: there are none.
    pub blur_px: Option<f64>,
}

/// A chessboard in the camera's picture.
#[derive(Clone, Debug, Serialize)]
pub struct BoardSeen {
    /// `found`, or why it is not: `no_grid`, `another_grid`, `markers`.
    pub found: &'static str,
    /// Inner corners of the grid that was seen, the longer side first.
    pub size: Option<[usize; 2]>,
    /// Its inner corners in the camera's picture, row by row; a few may be missing.
    pub corners_px: Vec<Px>,
    /// The outermost of them, around it: a quadrangle that is none when the camera looks straight at it.
    pub outline_px: Vec<Px>,
}
