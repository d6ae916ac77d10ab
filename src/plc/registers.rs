//! The register map: one table that the server encodes from and the documents are printed from.
//!
//! Input (FC 4) and holding (FC 3) registers are the same image. A parcel block carries its
//! sequence number first and last, so that a client that reads it in two requests can tell whether
//! it changed in between.

use super::codes::{FAULT_BITS, STATUS_BITS, VALID_BITS};
use super::health::{Concern, HealthStatus};
use super::journal::Keeping;
use super::table::{Field, fields};
use crate::config::WordOrder;
use crate::event::{Counters, ParcelRecord, Shape};

/// Versions of the map, major in the high byte; a client checks the major one.
const V1_0: u16 = 0x0100;
const V1_1: u16 = 0x0101;
const V1_2: u16 = 0x0102;
const V2_0: u16 = 0x0200;
/// The current one.
pub const MAP_VERSION: u16 = V2_0;
/// Address of the registers that a PLC writes, and their number.
pub const COMMAND: u16 = 60;
/// Registers that a PLC writes.
pub const COMMAND_COUNT: u16 = 10;
/// Address of the oldest parcel that waits to be acknowledged.
pub const QUEUE_HEAD: u16 = 140;
/// Registers of one parcel block.
pub const PARCEL_STRIDE: u16 = 32;
/// Address of the latest parcel.
pub const LATEST: u16 = 100;
/// Address of the ring's first block.
pub const RING: u16 = 200;
/// Parcels in the ring; parcel `seq` is in block `(seq - 1) % RING_PARCELS`.
pub const RING_PARCELS: u16 = 32;
/// Registers in all.
pub const COUNT: u16 = RING + RING_PARCELS * PARCEL_STRIDE;

/// The code of an import that was refused.
pub const IMPORT_REFUSED: u16 = 2;

/// What became of the last configuration that was imported.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ImportStatus {
    /// Imports tried since the store was made.
    pub count: u16,
    /// 0 none was tried, 1 applied, 2 refused, 3 rolled back.
    pub result: u16,
}

/// What the appliance's other threads tell.
#[derive(Clone, Copy, Debug, Default)]
#[allow(clippy::struct_excessive_bools)] // they become bits
pub struct VisionStatus {
    /// The empty belt has been learned.
    pub ready: bool,
    /// The belt's motion is measured, not assumed.
    pub belt_measured: bool,
    /// It is measured by the encoder.
    pub by_encoder: bool,
    /// The frame source has ended or failed.
    pub source_ended: bool,
    /// Belt speed.
    pub belt_speed_mm_per_s: f64,
    /// Time of the newest frame since start.
    pub time_s: f64,
    /// Belt travel since start.
    pub belt_travel_mm: f64,
    /// Frames that came too late and were dropped.
    pub frames_dropped: u64,
    /// Frames that the camera counted and that never came.
    pub frames_lost: u64,
    /// Frames that came with parts missing.
    pub frames_torn: u64,
    /// Lately too many of them, whichever of the three.
    pub frames_missing: bool,
    /// The archive has lost entries, is damaged, or its disk fails or does not answer.
    pub archive_fails: bool,
    /// There is no camera, or it does not do what the configuration asks for.
    pub camera_absent: bool,
    /// How often the camera was lost.
    pub camera_losses: u64,
    /// Of the last configuration that came on a stick.
    pub import: ImportStatus,
    /// What the pipeline counts.
    pub counters: Counters,
    /// What is known of the belt beside its speed.
    pub belt: BeltStatus,
    /// What the instrument knows of itself.
    pub health: HealthStatus,
}

/// Ratios that command 6 corrects.
const ENCODER_RATIOS: std::ops::RangeInclusive<f64> = 0.7..=1.4;

/// What the pictures show of the belt, and what disagrees with it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[allow(clippy::struct_excessive_bools)] // they become bits
pub struct BeltStatus {
    /// Speed that the pictures show; negative: against +X.
    pub seen_mm_per_s: Option<f64>,
    /// It is another than the configuration's, or against +X.
    pub not_as_configured: bool,
    /// The texture repeats itself: several speeds would explain it.
    pub ambiguous: bool,
    /// Texture or noise are so strong that they hide parcels.
    pub hides_parcels: bool,
    /// The encoder's travel over that of the texture.
    pub encoder_ratio: Option<f64>,
    /// The encoder shows another travel than the belt: it is not used.
    pub encoder_disagrees: bool,
}

/// State of the CAN controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CanState {
    /// Not configured.
    #[default]
    Off,
    /// Sends and receives.
    Active,
    /// Many errors: nobody acknowledges, or the cable is bad.
    Passive,
    /// Too many: the controller has left the bus until it is restarted.
    BusOff,
    /// The interface is down or not there.
    Down,
}

/// What the CAN side tells.
#[derive(Clone, Copy, Debug, Default)]
pub struct CanStatus {
    /// State of the controller.
    pub state: CanState,
    /// Transmit error counter of the controller, when it last told.
    pub transmit_errors: u8,
    /// Receive error counter.
    pub receive_errors: u8,
    /// How often the bus was lost.
    pub bus_offs: u64,
    /// Parcels that no frame could be sent of in time.
    pub parcels_dropped: u64,
    /// Frames that the interface refused for ever.
    pub frames_refused: u64,
}

/// What the status block shows.
#[derive(Clone, Copy, Debug, Default)]
#[allow(clippy::struct_excessive_bools)] // they are the bits of two registers
pub struct Status {
    /// Of the vision thread.
    pub vision: VisionStatus,
    /// Of the CAN bus.
    pub can: CanStatus,
    /// Rises ten times a second while frames arrive.
    pub heartbeat: u16,
    /// Frames arrive.
    pub running: bool,
    /// Parcels are not reported, by command.
    pub stopped: bool,
    /// The PLC's heartbeat stands still.
    pub plc_silent: bool,
    /// An encoder is configured and does not count.
    pub encoder_silent: bool,
    /// Starts of the appliance.
    pub boots: u16,
    /// Sequence number of the latest parcel.
    pub sequence: u32,
    /// Parcels that wait to be acknowledged.
    pub queued: u16,
    /// Parcels that left the queue without having been acknowledged.
    pub queue_overflows: u64,
    /// Ticket of the last command, and what became of it.
    pub ticket: u16,
    /// See [`super::command::Outcome`].
    pub outcome: u16,
    /// Scale interval.
    pub scale_interval_mm: f64,
    /// Where numbers, acknowledgments and tickets are kept.
    pub keeping: Keeping,
    /// Belt travel of an encoder's count, as configured or set by command.
    pub mm_per_count: Option<f64>,
}

impl Status {
    /// Belt travel of an encoder's count, as the belt's texture shows it.
    pub fn mm_per_count_seen(&self) -> Option<f64> {
        let ratio = self.vision.belt.encoder_ratio.filter(|ratio| *ratio > 0.0)?;
        Some(self.mm_per_count? / ratio)
    }

    /// Whether the encoder's scale is off by no more than what a wrong scale explains.
    pub fn encoder_scale_is_plausible(&self) -> bool {
        self.vision.belt.encoder_ratio.is_some_and(|ratio| ENCODER_RATIOS.contains(&ratio))
    }

    fn overflows(&self) -> u64 {
        let c = &self.vision.counters;
        c.segment_overflows + c.track_overflows + c.event_overflows
    }

    /// Word of status bits.
    pub fn status_bits(&self) -> u16 {
        bits::<{ STATUS_BITS.len() }>([
            self.running,
            self.vision.ready,
            self.vision.belt_measured,
            self.vision.by_encoder,
            self.stopped,
            self.plc_silent,
            self.queued > 0,
        ])
    }

    /// Word of fault bits.
    pub fn fault_bits(&self) -> u16 {
        bits::<{ FAULT_BITS.len() }>([
            self.vision.source_ended,
            self.overflows() > 0,
            self.queue_overflows > 0,
            matches!(self.can.state, CanState::BusOff | CanState::Down),
            self.encoder_silent,
            self.vision.camera_absent,
            self.keeping == Keeping::Failing,
            self.vision.belt.encoder_disagrees,
            self.vision.belt.not_as_configured,
            self.vision.belt.hides_parcels,
            self.vision.frames_missing,
            self.vision.archive_fails,
            self.vision.health.camera != Concern::None,
            self.vision.health.blur != Concern::None,
            self.vision.health.light != Concern::None,
        ])
    }

    /// Code of what matters most: see [`super::codes::REASONS`].
    pub fn reason(&self) -> u16 {
        self.reasons().next().unwrap_or(0)
    }

    /// Codes of all that holds, most important first; what was, comes after what is.
    pub fn reasons(&self) -> impl Iterator<Item = u16> + use<> {
        let holds = [
            (1, self.vision.source_ended),
            (12, self.vision.camera_absent),
            (2, !self.running),
            (3, self.can.state == CanState::BusOff),
            (4, self.can.state == CanState::Down),
            (5, self.can.state == CanState::Passive),
            (14, self.keeping == Keeping::Failing),
            (6, self.encoder_silent),
            (15, self.vision.belt.encoder_disagrees),
            (16, self.vision.belt.not_as_configured),
            (22, self.vision.health.camera == Concern::Fault),
            (24, self.vision.health.blur == Concern::Fault),
            (7, self.plc_silent),
            (8, !self.vision.ready),
            (18, self.vision.belt.hides_parcels),
            (17, self.vision.belt.ambiguous),
            (19, self.vision.frames_missing),
            (21, self.vision.health.camera == Concern::Warning),
            (23, self.vision.health.blur == Concern::Warning),
            (25, self.vision.health.light != Concern::None),
            (9, self.stopped),
            (13, self.vision.import.result == IMPORT_REFUSED),
            (20, self.vision.archive_fails),
            (10, self.queue_overflows > 0),
            (11, self.overflows() > 0),
        ];
        holds.into_iter().filter(|(_, holds)| *holds).map(|(code, _)| code)
    }
}

/// A word of bits, from bit 0; as many as there are names.
fn bits<const N: usize>(set: [bool; N]) -> u16 {
    set.iter().enumerate().map(|(i, set)| u16::from(*set) << i).sum()
}

/// The registers that a PLC writes, as it last wrote them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CommandBlock {
    /// Rises while the PLC is alive.
    pub heartbeat: u16,
    /// Low word of the sequence number up to which parcels were taken.
    pub acknowledge: u16,
    /// Count of the encoder.
    pub encoder_count: u32,
    /// A command is carried out when this changes.
    pub ticket: u16,
    /// Code of the command.
    pub command: u16,
    /// Its argument.
    pub argument: u32,
}

type StatusField = Field<Status>;
type CommandField = Field<CommandBlock>;
type ParcelField = Field<ParcelRecord>;

/// Counters wrap at their register's size.
fn wrapped(count: u64) -> f64 {
    f64::from(count as u32)
}

/// Identity, status and counters, at address 0, before and after the command block.
#[rustfmt::skip]
pub const STATUS_FIELDS: &[StatusField] = fields![
    [0, V1_0, "identity", U16, "", 1.0, "constant 0x4247, \"BG\"", |_| f64::from(0x4247)],
    [1, V1_0, "map_version", U16, "", 1.0, "major in the high byte, minor in the low", |_| f64::from(MAP_VERSION)],
    [2, V1_0, "test_u32", U32, "", 1.0, "constant 0x12345678: checks the word order", |_| f64::from(0x1234_5678)],
    [4, V1_0, "test_i16", I16, "", 1.0, "constant -12345: checks the sign", |_| -12345.0],
    [10, V1_0, "heartbeat", U16, "", 1.0, "rises ten times a second while frames arrive; wraps", |s| f64::from(s.heartbeat)],
    [11, V1_0, "status", U16, "bits", 1.0, "bit 0 running, bit 1 ready (belt learned), bit 2 belt motion measured, bit 3 by the encoder, bit 4 stopped by command, bit 5 PLC silent, bit 6 parcels wait to be acknowledged", |s| f64::from(s.status_bits())],
    [12, V1_0, "fault", U16, "bits", 1.0, "bit 0 frame source ended, bit 1 a table has been full since start (see counters), bit 2 a parcel was never acknowledged, bit 3 CAN bus off or down, bit 4 encoder silent, bit 5 no camera, bit 6 the disk fails, bit 7 encoder and belt disagree, bit 8 the belt does not run as configured, bit 9 the belt hides parcels, bit 10 frames are missing, bit 11 the archive fails, bit 12 the camera has moved, bit 13 the picture is unsharp, bit 14 the light has changed", |s| f64::from(s.fault_bits())],
    [13, V1_0, "belt_speed", U32, "mm/s", 10.0, "belt speed", |s| s.vision.belt_speed_mm_per_s],
    [15, V1_0, "frames", U32, "", 1.0, "frames processed; wraps", |s| wrapped(s.vision.counters.frames)],
    [17, V1_0, "frames_dropped", U32, "", 1.0, "frames that came too late; wraps", |s| wrapped(s.vision.frames_dropped)],
    [19, V1_0, "parcels", U32, "", 1.0, "sequence number of the latest parcel", |s| f64::from(s.sequence)],
    [21, V1_0, "parcels_unmeasured", U32, "", 1.0, "of the parcels, those that could not be measured", |s| wrapped(s.vision.counters.unmeasured)],
    [23, V1_0, "parcels_lost", U32, "", 1.0, "parcels that vanished inside the view", |s| wrapped(s.vision.counters.lost)],
    [25, V1_0, "segment_overflows", U32, "", 1.0, "frames with more runs or blobs than the tables hold", |s| wrapped(s.vision.counters.segment_overflows)],
    [27, V1_0, "track_overflows", U32, "", 1.0, "blobs that found no free track", |s| wrapped(s.vision.counters.track_overflows)],
    [29, V1_0, "event_overflows", U32, "", 1.0, "records that found the queue to the PLC full", |s| wrapped(s.vision.counters.event_overflows)],
    [31, V1_0, "time", U32, "ms", 1.0, "time of the newest frame since start; wraps", |s| wrapped((s.vision.time_s * 1000.0) as u64)],
    [33, V1_0, "belt_travel", U32, "mm", 10.0, "belt travel since start; wraps after 429 km", |s| wrapped_mm(s.vision.belt_travel_mm)],
    [35, V1_1, "reason", U16, "", 1.0, "what matters most, see below", |s| f64::from(s.reason())],
    [36, V1_1, "boots", U16, "", 1.0, "starts of the appliance, 0 when plc.state_file is not set; wraps", |s| f64::from(s.boots)],
    [37, V1_1, "queued", U16, "", 1.0, "parcels that wait to be acknowledged", |s| f64::from(s.queued)],
    [38, V1_1, "queue_overflows", U32, "", 1.0, "parcels that left the queue without having been acknowledged; wraps", |s| wrapped(s.queue_overflows)],
    [40, V1_1, "ticket_done", U16, "", 1.0, "ticket of the last command", |s| f64::from(s.ticket)],
    [41, V1_1, "result", U16, "", 1.0, "what became of it, see below", |s| f64::from(s.outcome)],
    [42, V1_1, "scale_interval", U16, "mm", 10.0, "dimensions are rounded to multiples of it", |s| s.scale_interval_mm],
    [43, V1_1, "can_state", U16, "", 1.0, "0 not configured, 1 active, 2 error passive, 3 bus off, 4 down", |s| f64::from(s.can.state as u8)],
    [44, V1_1, "can_transmit_errors", U16, "", 1.0, "error counter of the controller, when it last told", |s| f64::from(s.can.transmit_errors)],
    [45, V1_1, "can_receive_errors", U16, "", 1.0, "error counter of the controller, when it last told", |s| f64::from(s.can.receive_errors)],
    [46, V1_1, "can_bus_offs", U32, "", 1.0, "how often the bus was lost; wraps", |s| wrapped(s.can.bus_offs)],
    [48, V1_1, "can_parcels_dropped", U32, "", 1.0, "parcels that could not be sent in time; wraps", |s| wrapped(s.can.parcels_dropped)],
    [50, V1_1, "can_frames_refused", U32, "", 1.0, "frames that the interface refused for ever; wraps", |s| wrapped(s.can.frames_refused)],
    [52, V1_2, "frames_lost", U32, "", 1.0, "frames that the camera counted and that never came; wraps", |s| wrapped(s.vision.frames_lost)],
    [54, V1_2, "frames_torn", U32, "", 1.0, "frames that came with parts missing; wraps", |s| wrapped(s.vision.frames_torn)],
    [56, V1_2, "camera_losses", U16, "", 1.0, "how often the camera was lost; wraps", |s| f64::from(s.vision.camera_losses as u16)],
    [57, V1_2, "imports", U16, "", 1.0, "configurations that came on a stick; wraps", |s| f64::from(s.vision.import.count)],
    [58, V1_2, "import_result", U16, "", 1.0, "of the last: 0 there was none, 1 applied, 2 refused, 3 rolled back", |s| f64::from(s.vision.import.result)],
    [70, V2_0, "belt_seen", I32, "mm/s", 10.0, "belt speed that the pictures show, negative against +X; 0: none", |s| s.vision.belt.seen_mm_per_s.unwrap_or(0.0)],
    [72, V2_0, "encoder_ratio", I16, "", 10000.0, "the encoder's travel over the belt's, negative when it counts the other way; 0: not known, or it stands", |s| s.vision.belt.encoder_ratio.unwrap_or(0.0)],
    [73, V2_0, "mm_per_count", I32, "mm", 1_000_000.0, "belt travel of a count, as configured or set by command 6; 0: no encoder", |s| s.mm_per_count.unwrap_or(0.0)],
    [75, V2_0, "mm_per_count_seen", I32, "mm", 1_000_000.0, "the same as the belt's texture shows it; 0: not known", |s| s.mm_per_count_seen().unwrap_or(0.0)],
    [77, V2_0, "camera_watch", U16, "", 1.0, "whether a camera that moves is seen: 0 what stands is being learned, 1 no: too little stands, 2 across travel alone, 3 along travel alone, 4 yes", |s| f64::from(s.vision.health.camera_watch)],
    [78, V2_0, "camera_moved", U16, "px", 100.0, "how far the picture has moved since start", |s| s.vision.health.camera_moved_px],
    [79, V2_0, "camera_error", U16, "mm", 100.0, "the largest error that it causes, of a place or of a dimension", |s| s.vision.health.camera_error_mm],
    [80, V2_0, "blur", U16, "px", 100.0, "standard deviation of the picture's blur; 0: not known", |s| s.vision.health.blur_px.unwrap_or(0.0)],
    [81, V2_0, "light_region", U16, "", 1.0, "the part of the picture whose light has changed most since start: 4 columns and 3 rows, from 1 at the top left, row by row; 0: not known", |s| f64::from(s.vision.health.light_region)],
    [82, V2_0, "light_change", I16, "%", 1.0, "by how much", |s| 100.0 * s.vision.health.light_change],
];

/// What a PLC writes, from [`COMMAND`] on.
#[rustfmt::skip]
pub const COMMAND_FIELDS: &[CommandField] = fields![
    [0, V1_1, "plc_heartbeat", U16, "", 1.0, "any value that keeps changing while the PLC is alive", |c| f64::from(c.heartbeat)],
    [1, V1_1, "acknowledge", U16, "", 1.0, "low word of the sequence number up to which parcels were taken; writing it again does no harm", |c| f64::from(c.acknowledge)],
    [2, V1_1, "encoder_count", U32, "", 1.0, "belt position as the encoder counts it, as often as possible; wraps at encoder.bits", |c| f64::from(c.encoder_count)],
    [4, V1_1, "ticket", U16, "", 1.0, "the command is carried out when this is written with another value than the last one; 0: no command", |c| f64::from(c.ticket)],
    [5, V1_1, "command", U16, "", 1.0, "code, see below", |c| f64::from(c.command)],
    [6, V1_1, "argument", U32, "", 1.0, "of the command", |c| f64::from(c.argument)],
];

/// Tenths of a mm wrap at their register's size, whichever way the belt runs.
fn wrapped_mm(mm: f64) -> f64 {
    f64::from((10.0 * mm).round() as i64 as u32) / 10.0
}

/// Quality 0 to 100 of a dimension: 100 at sigma 0, 0 from 5 mm on.
fn quality(sigma_mm: f64) -> f64 {
    (100.0 * (1.0 - sigma_mm / 5.0)).clamp(0.0, 100.0)
}

/// One parcel, at the latest address and in each block of the ring.
#[rustfmt::skip]
pub const PARCEL_FIELDS: &[ParcelField] = fields![
    [0, V1_0, "sequence", U32, "", 1.0, "from 1; 0 = no parcel yet", |p| f64::from(p.seq)],
    [2, V2_0, "valid", U16, "bits", 1.0, "bit 0 the dimensions may be used: sort by them only then; bit 1 its shape is a box; bit 2 the encoder told the belt's motion; bit 3 it was measured", |p| f64::from(bits::<{ VALID_BITS.len() }>([p.may_be_used, p.shape == Shape::Box, p.by_encoder, p.not_measured.is_none()]))],
    [3, V1_0, "flags", U16, "bits", 1.0, "doubts, see below", |p| f64::from(p.flags.bits())],
    [4, V1_0, "length", U16, "mm", 10.0, "longer side of the footprint, or as plc.order says", |p| p.length_mm],
    [5, V1_0, "width", U16, "mm", 10.0, "shorter side of the footprint, or as plc.order says", |p| p.width_mm],
    [6, V1_0, "height", U16, "mm", 10.0, "height over the belt, or as plc.order says", |p| p.height_mm],
    [7, V1_0, "yaw", I16, "deg", 100.0, "length axis against travel, counter-clockwise, (-90, 90]", |p| p.yaw_deg],
    [8, V1_0, "x", I32, "mm", 10.0, "footprint centre along travel, at time", |p| p.x_mm],
    [10, V1_0, "y", I32, "mm", 10.0, "footprint centre across, left positive", |p| p.y_mm],
    [12, V1_0, "sigma_length", U16, "mm", 100.0, "standard deviation", |p| p.sigma_length_mm],
    [13, V1_0, "sigma_width", U16, "mm", 100.0, "standard deviation", |p| p.sigma_width_mm],
    [14, V1_0, "sigma_height", U16, "mm", 100.0, "standard deviation", |p| p.sigma_height_mm],
    [15, V1_0, "quality_length", U16, "%", 1.0, "100 - 20 sigma/mm, at least 0", |p| quality(p.sigma_length_mm)],
    [16, V1_0, "quality_width", U16, "%", 1.0, "100 - 20 sigma/mm, at least 0", |p| quality(p.sigma_width_mm)],
    [17, V1_0, "quality_height", U16, "%", 1.0, "100 - 20 sigma/mm, at least 0", |p| quality(p.sigma_height_mm)],
    [18, V1_0, "belt_speed", U32, "mm/s", 10.0, "mean over the pass", |p| p.belt_speed_mm_per_s],
    [20, V1_0, "frame", U32, "", 1.0, "frame at which x and y hold; wraps", |p| wrapped(p.frame)],
    [22, V1_0, "time", U32, "ms", 1.0, "time of that frame since start; wraps", |p| wrapped((p.t_s * 1000.0).round() as u64)],
    [24, V1_0, "belt_travel", U32, "mm", 10.0, "belt travel since start at that frame; wraps after 429 km", |p| wrapped_mm(p.belt_travel_mm)],
    [26, V2_0, "not_measured", U16, "", 1.0, "why it has no dimensions, see below; 0: it has", |p| p.not_measured.map_or(0.0, |reason| f64::from(reason as u8))],
    [30, V1_0, "sequence_end", U32, "", 1.0, "equals sequence unless the block changed between two requests", |p| f64::from(p.seq)],
];

/// All registers, ready to be read.
pub struct RegisterImage {
    order: WordOrder,
    registers: [u16; COUNT as usize],
}

impl RegisterImage {
    /// No parcel yet.
    pub fn new(order: WordOrder) -> Self {
        let mut image = Self { order, registers: [0; COUNT as usize] };
        image.set_status(&Status::default());
        image
    }

    /// Write the status block.
    pub fn set_status(&mut self, status: &Status) {
        self.write(STATUS_FIELDS, status, 0);
    }

    /// Show what the PLC wrote.
    pub fn set_command(&mut self, block: &CommandBlock) {
        self.write(COMMAND_FIELDS, block, COMMAND);
    }

    /// Write a parcel as the latest and into its place of the ring.
    pub fn publish(&mut self, record: &ParcelRecord) {
        let slot = record.seq.wrapping_sub(1) % u32::from(RING_PARCELS);
        for start in [LATEST, RING + slot as u16 * PARCEL_STRIDE] {
            self.write(PARCEL_FIELDS, record, start);
        }
    }

    /// Write the parcel that waits to be acknowledged, or that there is none.
    pub fn set_queue_head(&mut self, record: Option<&ParcelRecord>) {
        match record {
            Some(record) => self.write(PARCEL_FIELDS, record, QUEUE_HEAD),
            None => self.registers[usize::from(QUEUE_HEAD)..][..usize::from(PARCEL_STRIDE)].fill(0),
        }
    }

    fn write<S>(&mut self, fields: &[Field<S>], source: &S, start: u16) {
        let block = &mut self.registers[usize::from(start)..];
        for field in fields {
            field.write(source, self.order, block);
        }
    }

    /// `count` registers from `address`; `None` when any of them does not exist.
    pub fn read(&self, address: u16, count: u16) -> Option<&[u16]> {
        let start = usize::from(address);
        self.registers.get(start..start + usize::from(count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::codes::REASONS;
    use crate::plc::record;

    fn fields_fit<S>(fields: &[Field<S>], end: u16) {
        let mut next = 0;
        for f in fields {
            assert!(f.offset >= next, "{} overlaps the field before it", f.name);
            next = f.offset + f.kind.registers();
        }
        assert!(next <= end);
    }

    #[test]
    fn fields_do_not_overlap_and_blocks_hold_them() {
        fields_fit(STATUS_FIELDS, LATEST);
        let own = COMMAND..COMMAND + COMMAND_COUNT;
        let registers = |f: &StatusField| f.offset..f.offset + f.kind.registers();
        assert!(STATUS_FIELDS.iter().flat_map(registers).all(|r| !own.contains(&r)));
        fields_fit(COMMAND_FIELDS, COMMAND_COUNT);
        fields_fit(PARCEL_FIELDS, PARCEL_STRIDE);
        const { assert!(COMMAND + COMMAND_COUNT <= LATEST) }
        const { assert!(LATEST + PARCEL_STRIDE <= QUEUE_HEAD) }
        const { assert!(QUEUE_HEAD + PARCEL_STRIDE <= RING) }
    }

    #[test]
    fn a_parcel_is_encoded_as_the_map_says() {
        let mut image = RegisterImage::new(WordOrder::HighFirst);
        image.publish(&record(70_000));
        let latest = image.read(LATEST, PARCEL_STRIDE).expect("exists");
        assert_eq!(latest[..8], [1, 4464, 0b1011, 0, 2351, 1248, 702, (-1240i16) as u16]);
        assert_eq!(latest[8..12], [0, 610, 0xffff, (-403i16) as u16]);
        assert_eq!(latest[12..18], [30, 25, 750, 94, 95, 0]);
        assert_eq!(latest[18..26], [0, 5003, 0, 137, 0, 3425, 0, 17125]);
        assert_eq!(latest[30..], [1, 4464]);
    }

    #[test]
    fn the_ring_keeps_the_last_32_in_their_places() {
        let mut image = RegisterImage::new(WordOrder::HighFirst);
        (1..=40).for_each(|seq| image.publish(&record(seq)));
        for seq in 9..=40u16 {
            let at = RING + (seq - 1) % RING_PARCELS * PARCEL_STRIDE;
            assert_eq!(image.read(at, 2), Some(&[0, seq][..]));
        }
    }

    #[test]
    fn values_out_of_range_saturate() {
        let mut image = RegisterImage::new(WordOrder::HighFirst);
        let huge =
            ParcelRecord { length_mm: 1e9, width_mm: -3.0, height_mm: f64::NAN, ..record(1) };
        image.publish(&huge);
        assert_eq!(image.read(LATEST + 4, 3), Some(&[65535, 0, 0][..]));
    }

    #[test]
    fn belt_travel_wraps_and_differences_do_not() {
        let field = PARCEL_FIELDS.iter().find(|f| f.name == "belt_travel").expect("there");
        let bits = |mm: f64| field.bits(&ParcelRecord { belt_travel_mm: mm, ..record(1) });
        let end_mm = f64::from(u32::MAX) / 10.0;
        for (from, to) in [(end_mm - 50.0, end_mm + 70.0), (-3.2, 116.8), (9.7e9, 9.7e9 + 120.0)] {
            assert_eq!(bits(to).wrapping_sub(bits(from)), 1200, "{from} to {to}");
        }
    }

    #[test]
    fn the_reason_is_what_is_wrong_now_before_what_was() {
        let mut status = Status { running: true, ..Status::default() };
        status.vision.ready = true;
        assert_eq!(status.reason(), 0);
        status.vision.counters.segment_overflows = 1;
        assert_eq!(status.reason(), 11);
        status.encoder_silent = true;
        assert_eq!(status.reason(), 6);
        status.can.state = CanState::BusOff;
        assert_eq!(status.reason(), 3);
        assert!(status.reasons().eq([3, 6, 11]));
        let codes = REASONS.iter().map(|(code, ..)| *code);
        assert!(codes.eq(0..26));
    }

    #[test]
    fn registers_beyond_the_map_do_not_exist() {
        let image = RegisterImage::new(WordOrder::HighFirst);
        assert!(image.read(COUNT - 1, 1).is_some());
        for (address, count) in [(COUNT, 1), (COUNT - 1, 2), (65535, 1), (65535, 65535)] {
            assert!(image.read(address, count).is_none());
        }
    }
}
