//! What every number of a configuration may be: one table for the check and for the JSON Schema.

use crate::error::{Error, Result};
use std::net::SocketAddr;

/// Key, smallest value, largest value, unit.
type Range = (&'static str, f64, f64, &'static str);

/// Of every key with a number but `encoder.mm_per_count`, whose sign is free.
pub(super) const RANGES: &[Range] = &[
    ("camera.fps", 0.5, 1000.0, "frames a second"),
    ("camera.exposure_us", 1.0, 1e6, "us"),
    ("camera.gain", 0.0, 1e6, ""),
    ("camera.packet_bytes", 576.0, 9000.0, "bytes"),
    ("camera.frame_timeout_s", 0.0, 3600.0, "s"),
    ("zone.x_min_mm", -20_000.0, 20_000.0, "mm"),
    ("zone.x_max_mm", -20_000.0, 20_000.0, "mm"),
    ("zone.y_min_mm", -20_000.0, 20_000.0, "mm"),
    ("zone.y_max_mm", -20_000.0, 20_000.0, "mm"),
    ("belt.speed_mm_per_s", 10.0, 10_000.0, "mm per s"),
    ("view.mm_per_px", 0.05, 20.0, "mm"),
    ("view.height_max_mm", 5.0, 5_000.0, "mm"),
    ("background.learn_frames", 1.0, 1000.0, ""),
    ("background.history_frames", 20.0, 2000.0, ""),
    ("background.threshold_sigma", 3.0, 10.0, ""),
    ("background.shadow_ratio_min", 0.1, 1.0, ""),
    ("background.deep_shadow_ratio_min", 0.0, 1.0, ""),
    ("segment.open_px", 0.0, 10.0, ""),
    ("segment.close_px", 0.0, 30.0, ""),
    ("segment.area_min_mm2", 1.0, 1e6, "mm2"),
    ("segment.side_min_mm", 0.0, 1000.0, "mm"),
    ("odometry.speed_error_max", 0.0, 0.2, ""),
    ("measure.edge_radius_mm", 0.0, 20.0, "mm"),
    ("measure.sigma_max_mm", 0.1, 100.0, "mm"),
    ("health.every_s", 1.0, 3600.0, "s"),
    ("health.moved_warning_mm", 0.05, 100.0, "mm"),
    ("health.moved_fault_mm", 0.05, 1000.0, "mm"),
    ("health.blur_warning_px", 0.3, 6.0, "px"),
    ("health.blur_fault_px", 0.3, 6.0, "px"),
    ("health.light_change_max", 0.05, 10.0, ""),
    ("limits.memory_mib_max", 1.0, 16_384.0, ""),
    ("limits.tracks_max", 1.0, 256.0, ""),
    ("limits.runs_max", 256.0, 1_048_576.0, ""),
    ("limits.blobs_max", 16.0, 65_536.0, ""),
    ("limits.views_per_track_max", 16.0, 1024.0, ""),
    ("limits.frames_queued_max", 2.0, 15.0, ""),
    ("realtime.workers", 1.0, 8.0, ""),
    ("realtime.priority", 0.0, 99.0, ""),
    ("realtime.first_processor", 0.0, 1023.0, ""),
    ("plc.scale_interval_mm", 0.1, 50.0, "mm"),
    ("plc.publish_after_mm", 0.0, 20_000.0, "mm"),
    ("plc.heartbeat_timeout_s", 0.0, 600.0, "s"),
    ("modbus.connections_max", 1.0, 256.0, ""),
    ("modbus.idle_timeout_s", 1.0, 86_400.0, ""),
    ("modbus.base_address", 0.0, 60_000.0, ""),
    // Standard identifiers have 11 bits, and 16 are taken.
    ("can.base_id", 1.0, 2032.0, ""),
    ("can.bitrate", 10_000.0, 1_000_000.0, ""),
    ("can.data_bitrate", 10_000.0, 8_000_000.0, ""),
    ("encoder.bits", 8.0, 32.0, ""),
    ("web.connections_max", 8.0, 1024.0, ""),
    ("web.pictures_per_s_max", 1.0, 60.0, ""),
    ("archive.mib_max", 16.0, 1_048_576.0, ""),
    ("encoder.timeout_s", 0.02, 10.0, "s"),
];

/// Check every number that a file gives. Types have been checked before.
pub(super) fn check(file: &toml::Table) -> Result<()> {
    for &(key, min, max, unit) in RANGES {
        let (table, name) = key.split_once('.').unwrap_or((key, ""));
        let value = match file.get(table).and_then(|table| table.get(name)) {
            Some(toml::Value::Float(value)) => *value,
            Some(toml::Value::Integer(value)) => *value as f64,
            _ => continue,
        };
        range(key, value, min, max, unit)?;
    }
    Ok(())
}

/// Check one number.
pub(super) fn range(key: &str, value: f64, min: f64, max: f64, unit: &str) -> Result<()> {
    if (min..=max).contains(&value) {
        return Ok(());
    }
    let remedy = if unit.starts_with("mm") && (min..=max).contains(&(1000.0 * value)) {
        "this looks like metres: write it in mm"
    } else {
        "correct the value"
    };
    Err(Error::configuration(format!("{key} = {value}"))
        .allowed(format!("{min} to {max} {unit}").trim_end())
        .remedy(remedy))
}
/// Refuse what is no place that another machine can be reached at.
pub(super) fn other_machine(key: &str, address: SocketAddr, example: &str) -> Result<()> {
    if address.port() != 0 && !address.ip().is_unspecified() {
        return Ok(());
    }
    Err(Error::configuration(format!("{key} = \"{address}\""))
        .allowed(format!("address and port of another machine, as \"{example}\""))
        .remedy("give that machine's own address and port"))
}
