//! Codes and bits of the register map, by name: what documents and kits call them.

/// What is wrong or worth knowing: code, name in the kits, and meaning.
#[rustfmt::skip]
pub const REASONS: [(u16, &str, &str); 26] = [
    (0, "all_is_well", "all is well"),
    (1, "source_ended", "the frame source has ended or failed"),
    (2, "no_frames", "no frames arrive"),
    (3, "can_bus_off", "CAN: bus off"),
    (4, "can_down", "CAN: interface down or not there"),
    (5, "can_error_passive", "CAN: error passive, nobody acknowledges"),
    (6, "encoder_silent", "the encoder does not count"),
    (7, "plc_silent", "the PLC is silent"),
    (8, "learning", "the empty belt is being learned"),
    (9, "stopped", "stopped by command"),
    (10, "parcel_never_acknowledged", "a parcel found the queue full and was never acknowledged, since start"),
    (11, "table_full", "a table or queue has been full since start, see the counters"),
    (12, "camera_absent", "the camera is not there, or does not do what the configuration asks for: see the log"),
    (13, "import_refused", "the last configuration that was imported was refused: see its report"),
    (14, "disk_fails", "the disk fails: sequence numbers, acknowledgments and tickets would not survive a restart; see the log"),
    (15, "encoder_disagrees", "the encoder and the belt disagree: see encoder_ratio; correct encoder.mm_per_count, or give command 6"),
    (16, "belt_not_as_configured", "the belt does not run as configured: see belt_seen for its speed and direction"),
    (17, "belt_ambiguous", "the belt's texture repeats itself, so that its motion is ambiguous: fit an encoder"),
    (18, "belt_hides_parcels", "the belt's texture or the camera's noise is so strong that it hides parcels"),
    (19, "frames_missing", "of the frames of the last 10 s more than 1 in 100 are missing: see frames_dropped, frames_lost, frames_torn"),
    (20, "archive_fails", "the archive: its disk fails or does not answer, entries were lost, or damage was found, since start; see the page"),
    (21, "camera_moved", "the camera has moved a little: see camera_moved, camera_error; fasten it"),
    (22, "camera_misplaced", "the camera has moved so far that sizes and places are wrong: calibrate the belt again"),
    (23, "picture_blurred", "the picture is less sharp than it should be: see blur; clean and focus the lens"),
    (24, "picture_unusable", "the picture is so unsharp that heights are wrong: see blur; focus the lens"),
    (25, "light_changed", "the light has changed, or the lens is dirty: see light_region, light_change"),
];

/// Names of the bits of `status`, from bit 0.
#[rustfmt::skip]
pub const STATUS_BITS: [&str; 7] = [
    "running", "ready", "belt_measured", "by_encoder", "stopped", "plc_silent", "parcels_wait",
];
/// Names of the bits of `fault`, from bit 0.
#[rustfmt::skip]
pub const FAULT_BITS: [&str; 15] = [
    "source_ended", "table_full", "parcel_never_acknowledged", "can_off", "encoder_silent", "camera_absent", "disk_fails",
    "encoder_disagrees", "belt_not_as_configured", "belt_hides_parcels", "frames_missing", "archive_fails", "camera_moved",
    "picture_blurred", "light_changed",
];
/// Names of the bits of a parcel's `valid`, from bit 0.
pub const VALID_BITS: [&str; 4] = ["may_be_used", "is_box", "by_encoder", "measured"];
