//! The state as Prometheus reads it: text format 0.0.4.

use super::model::State;
use std::fmt::Write as _;

/// What it is served as.
pub(super) const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Every figure: its name without the prefix, its type, its meaning, its value.
#[rustfmt::skip] // a table: a row each
fn figures(s: &State) -> Vec<(&'static str, &'static str, &'static str, f64)> {
    let flag = |set: bool| f64::from(u8::from(set));
    let count = |n: u64| n as f64;
    let (camera, belt, counts, archive) = (&s.camera, &s.belt, &s.counts, &s.archive);
    let [segments, tracks, records] = counts.table_overflows;
    let nothing = f64::NAN;
    vec![
        ("uptime_seconds", "gauge", "time since start", s.uptime_s),
        ("ready", "gauge", "1: the empty belt has been learned", flag(s.ready)),
        ("stopped", "gauge", "1: parcels are not reported, by command", flag(s.stopped)),
        ("camera_present", "gauge", "1: the camera is there as configured", flag(camera.present)),
        ("camera_losses_total", "counter", "times that the camera was lost", count(camera.losses)),
        ("frames_total", "counter", "frames processed", count(camera.frames)),
        ("frames_dropped_total", "counter", "frames that came too late", count(camera.frames_dropped)),
        ("frames_lost_total", "counter", "frames that never came", count(camera.frames_lost)),
        ("frames_torn_total", "counter", "frames with parts missing", count(camera.frames_torn)),
        ("frame_time_max_seconds", "gauge", "the slowest frame in the pipeline since start", camera.frame_time_max_ms / 1e3),
        ("camera_watch", "gauge", "whether a camera that moves is seen: 0 being learned, 1 no, 2 across travel, 3 along travel, 4 yes", f64::from(camera.watch)),
        ("camera_moved_pixels", "gauge", "how far the picture has moved since start", camera.moved_px),
        ("camera_error_metres", "gauge", "the largest error that this causes", camera.moved_error_mm / 1e3),
        ("blur_pixels", "gauge", "standard deviation of the picture's blur", camera.blur_px.unwrap_or(nothing)),
        ("light_change_ratio", "gauge", "the largest change of a part's brightness since start", camera.light_change),
        ("belt_speed_metres_per_second", "gauge", "belt speed", belt.speed_mm_per_s / 1e3),
        ("belt_measured", "gauge", "1: the belt's motion is measured, not assumed", flag(belt.measured)),
        ("belt_by_encoder", "gauge", "1: by the encoder", flag(belt.by_encoder)),
        ("belt_travel_metres", "gauge", "belt travel since start", belt.travel_mm / 1e3),
        ("encoder_ratio", "gauge", "the encoder's travel over that of the texture", belt.encoder_ratio.unwrap_or(nothing)),
        ("parcels_total", "counter", "parcels reported, measured or not", count(counts.parcels)),
        ("parcels_unmeasured_total", "counter", "of these, parcels without dimensions", count(counts.parcels_unmeasured)),
        ("parcels_usable_total", "counter", "of these, parcels whose dimensions may be used", count(counts.parcels_usable)),
        ("parcels_lost_total", "counter", "parcels that vanished in view", count(counts.parcels_lost)),
        ("queue_overflows_total", "counter", "parcels never acknowledged by the PLC", count(counts.queue_overflows)),
        ("segment_overflows_total", "counter", "frames with too many runs or blobs", count(segments)),
        ("track_overflows_total", "counter", "blobs without a free track", count(tracks)),
        ("record_overflows_total", "counter", "records that found a queue full", count(records)),
        ("pictures_missed_total", "counter", "parcels without a picture because too many came at once", count(counts.pictures_missed)),
        ("parcels_missed_total", "counter", "parcels that page and archive were not told of", count(counts.parcels_missed)),
        ("commands_missed_total", "counter", "commands of the PLC that are no events", count(counts.commands_missed)),
        ("log_lines_dropped_total", "counter", "lines of the log that nobody read", count(counts.log_lines_dropped)),
        ("archive_entries_total", "counter", "entries archived", count(archive.entries_written)),
        ("archive_entries_lost_total", "counter", "entries not archived", count(archive.entries_lost)),
        ("archive_bytes", "gauge", "size of the archive", count(archive.bytes)),
        ("archive_writable", "gauge", "1: the archive is written", flag(archive.enabled && archive.fault.is_none())),
    ]
}

/// The text.
pub(super) fn text(state: &State) -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = writeln!(
        text,
        "# HELP beltgauge_build_info version of the program\n# TYPE beltgauge_build_info gauge\n\
         beltgauge_build_info{{version=\"{}\"}} 1",
        state.version
    );
    for (name, kind, meaning, value) in figures(state) {
        let _ = writeln!(
            text,
            "# HELP beltgauge_{name} {meaning}\n# TYPE beltgauge_{name} {kind}\nbeltgauge_{name} {}",
            Number(value)
        );
    }
    let _ = writeln!(text, "# HELP beltgauge_lamp 1: lit\n# TYPE beltgauge_lamp gauge");
    for lamp in &state.lamps {
        let _ = writeln!(text, "beltgauge_lamp{{lamp=\"{}\"}} {}", lamp.name, u8::from(lamp.on));
    }
    let _ = writeln!(
        text,
        "# HELP beltgauge_reason 1: what the code says is the case\n# TYPE beltgauge_reason gauge"
    );
    for code in &state.reasons {
        let _ = writeln!(text, "beltgauge_reason{{code=\"{code}\"}} 1");
    }
    text
}

/// As Prometheus writes numbers.
struct Number(f64);

impl std::fmt::Display for Number {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            value if value.is_nan() => f.write_str("NaN"),
            value if value.is_infinite() => f.write_str(if value > 0.0 { "+Inf" } else { "-Inf" }),
            value => write!(f, "{value}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn every_line_is_prometheus_and_every_name_is_described_once() {
        let text = text(&State { reasons: vec![2, 12], version: "1.2.3", ..State::default() });
        let is_name = |name: &str| {
            name.starts_with("beltgauge_")
                && name.bytes().all(|b| b.is_ascii_lowercase() || b == b'_')
        };
        let mut described = HashSet::new();
        for line in text.lines() {
            if let Some(rest) = line.strip_prefix("# TYPE ") {
                let (name, kind) = rest.split_once(' ').expect("a type");
                assert!(described.insert(name), "{name} is described twice");
                assert_eq!(kind == "counter", name.ends_with("_total"), "{name}");
                continue;
            }
            if line.starts_with("# HELP ") {
                continue;
            }
            let (series, value) = line.rsplit_once(' ').expect("a value");
            let name = series.split('{').next().expect("a name");
            assert!(is_name(name) && described.contains(name), "{line}");
            assert!(value == "NaN" || value.parse::<f64>().is_ok_and(f64::is_finite), "{line}");
        }
        assert!(text.contains("beltgauge_reason{code=\"12\"} 1\n"));
        assert!(text.contains("beltgauge_encoder_ratio NaN\n"), "what is not known is no number");
    }

    #[test]
    fn what_is_shipped_for_prometheus_and_grafana_asks_for_figures_that_there_are() {
        let text = text(&State { reasons: vec![2], ..State::default() });
        for (file, asked_min) in [
            (include_str!("../../config/fleet/alerts.yml"), 10),
            (include_str!("../../config/fleet/dashboard.json"), 10),
        ] {
            let is_part = |c: char| c.is_ascii_lowercase() || c == '_';
            let names = file.match_indices("beltgauge_").map(|(at, _)| {
                let rest = &file[at..];
                &rest[..rest.find(|c| !is_part(c)).unwrap_or(rest.len())]
            });
            let names: HashSet<&str> = names.collect();
            assert!(names.len() >= asked_min, "only {names:?}");
            for name in names {
                assert!(text.contains(&format!("# TYPE {name} ")), "there is no {name}");
            }
        }
    }
}
