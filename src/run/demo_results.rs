//! What the demo tells at its end: measured sizes beside the true ones, and what the words mean.

use super::Progress;
use crate::error::{Error, Result};
use crate::event::{Flags, NotMeasured, ParcelRecord};
use crate::source::synthetic::{Parcel, Scenario};
use std::collections::VecDeque;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// A record belongs to the parcel whose true centre is this near.
const MATCH_MM: f64 = 60.0;
/// The last parcels, which get a line in the table and a picture: an endless demo must not fill the memory.
const KEPT_MAX: usize = 200;
/// Frames that may be left out while nothing else is worth a word: a hiccup at start.
const DROPPED_SHARE_UNTOLD: f64 = 0.005;

/// Records as they come, and what they add up to.
pub(super) struct Results {
    path: PathBuf,
    lines: BufWriter<File>,
    /// The first line that could not be written.
    failed: Option<std::io::Error>,
    kept: VecDeque<ParcelRecord>,
    count: u64,
    errors: Errors,
}

/// Absolute errors of every dimension so far.
#[derive(Default)]
struct Errors {
    sum_mm: f64,
    count: u32,
    worst_mm: f64,
}

/// The parcel of the scenario that a record is of.
fn truth(scenario: &Scenario, record: &ParcelRecord) -> Option<Parcel> {
    let distance = |parcel: &Parcel| {
        let place = scenario.place_at_frame(parcel, record.frame);
        (place.x_mm - record.x_mm).hypot(place.y_mm - record.y_mm)
    };
    let nearest = scenario.parcels().iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    (distance(nearest) < MATCH_MM).then_some(*nearest)
}

/// Measured minus true.
fn errors_mm(record: &ParcelRecord, parcel: &Parcel) -> [f64; 3] {
    [
        record.length_mm - parcel.length_mm,
        record.width_mm - parcel.width_mm,
        record.height_mm - parcel.height_mm,
    ]
}

impl Results {
    /// Records go to the file `path`, a JSON line each.
    pub(super) fn create(path: &Path) -> Result<Self> {
        let file = File::create(path)
            .map_err(|e| Error::failure(format!("cannot write the results: {e}")).in_file(path))?;
        Ok(Self {
            path: path.to_owned(),
            lines: BufWriter::new(file),
            failed: None,
            kept: VecDeque::with_capacity(KEPT_MAX),
            count: 0,
            errors: Errors::default(),
        })
    }

    /// One more.
    pub(super) fn add(&mut self, scenario: &Scenario, record: ParcelRecord) {
        let written = serde_json::to_writer(&mut self.lines, &record)
            .map_err(std::io::Error::from)
            .and_then(|()| self.lines.write_all(b"\n"));
        if let Err(e) = written {
            self.failed.get_or_insert(e);
        }
        self.count += 1;
        if let Some(parcel) = truth(scenario, &record)
            && record.not_measured.is_none()
        {
            for error_mm in errors_mm(&record, &parcel).map(f64::abs) {
                self.errors.sum_mm += error_mm;
                self.errors.count += 1;
                self.errors.worst_mm = self.errors.worst_mm.max(error_mm);
            }
        }
        if self.kept.len() == KEPT_MAX {
            self.kept.pop_front();
        }
        self.kept.push_back(record);
    }

    /// The last one.
    pub(super) fn last(&self) -> Option<&ParcelRecord> {
        self.kept.back()
    }

    /// The last ones, oldest first.
    pub(super) fn kept(&self) -> impl Iterator<Item = &ParcelRecord> {
        self.kept.iter()
    }

    /// Every line is on its way to the disk.
    pub(super) fn finish(&mut self) -> Result<()> {
        let flushed = self.lines.flush();
        self.failed.take().map_or(flushed, Err).map_err(|e| {
            Error::failure(format!("cannot write the results: {e}")).in_file(&self.path)
        })
    }

    /// Measured beside true sizes, and what the words in it mean.
    pub(super) fn table(&self, scenario: &Scenario, progress: &Progress) -> String {
        let mut text = String::from(
            "  #      true L x W x H mm     measured L x W x H mm           error mm        2 sigma mm  flags\n",
        );
        for record in &self.kept {
            text += &line(scenario, record);
        }
        if self.count > self.kept.len() as u64 {
            let _ = writeln!(text, "These are the last {} of {}.", self.kept.len(), self.count);
        }
        let Errors { sum_mm, count, worst_mm } = self.errors;
        let _ = writeln!(
            text,
            "{} parcels, mean absolute error {:.2} mm, largest {worst_mm:.2} mm; {} frames, {} dropped, \
             slowest frame {:.1} ms in the pipeline",
            self.count,
            sum_mm / f64::from(count.max(1)),
            progress.status.counters.frames,
            progress.status.frames_dropped,
            progress.frame_time_max.as_secs_f64() * 1e3,
        );
        text += &legend(&self.kept);
        text += &speed_of_this_computer(
            progress.status.counters.frames,
            progress.status.frames_dropped,
        );
        text
    }
}

fn line(scenario: &Scenario, r: &ParcelRecord) -> String {
    let triple = |v: [f64; 3]| format!("{:6.1} {:6.1} {:6.1}", v[0], v[1], v[2]);
    let measured = triple([r.length_mm, r.width_mm, r.height_mm]);
    let flags = r.flags;
    let Some(parcel) = truth(scenario, r) else {
        return format!("{:3}  {:>22}    {measured}   belongs to no parcel  {flags}\n", r.seq, "-");
    };
    let true_size = triple([parcel.length_mm, parcel.width_mm, parcel.height_mm]);
    if let Some(reason) = r.not_measured {
        return format!("{:3}   {true_size}      not measured: {reason}\n", r.seq);
    }
    let [dl, dw, dh] = errors_mm(r, &parcel);
    let [sl, sw, sh] = [r.sigma_length_mm, r.sigma_width_mm, r.sigma_height_mm].map(|s| 2.0 * s);
    format!(
        "{:3}   {true_size}      {measured}    {dl:+6.2} {dw:+6.2} {dh:+6.2}   {sl:4.1} {sw:4.1} {sh:4.1}  {flags}\n",
        r.seq,
    )
}

/// What the columns and the words of these records mean.
fn legend(records: &VecDeque<ParcelRecord>) -> String {
    let mut text = String::from(
        "error: measured minus true. 2 sigma: what the appliance itself expects; 19 of 20 errors should be within.\n",
    );
    for (flag, name, meaning) in Flags::ALL {
        if records.iter().any(|r| r.flags.has(flag)) {
            let _ = writeln!(text, "flag {name}: {meaning}");
        }
    }
    for (reason, name, meaning) in NotMeasured::ALL {
        if records.iter().any(|r| r.not_measured == Some(reason)) {
            let _ = writeln!(text, "not measured, {name}: {meaning}");
        }
    }
    if records.iter().all(|r| r.may_be_used) {
        text += "No parcel has a flag: no doubts.\n";
    } else {
        text += "A parcel with a flag must not be sorted by its size; the bit `valid` tells the PLC so.\n";
    }
    text
}

/// Whether frames were left out, and what that does.
fn speed_of_this_computer(frames: u64, dropped: u64) -> String {
    let share = dropped as f64 / (frames + dropped).max(1) as f64;
    if share <= DROPPED_SHARE_UNTOLD {
        return "This computer was fast enough.\n".to_owned();
    }
    let mut text = format!(
        "This computer was too slow: {dropped} of {} frames ({:.0} %) were left out, as a camera would lose \
         them. Parcels were seen less often, so errors and sigmas are larger, and some may be flagged or not \
         measured. End other programs and try again.\n",
        frames + dropped,
        100.0 * share
    );
    if cfg!(debug_assertions) {
        text += "This is a build for debugging: `cargo run --release -- demo` is faster.\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_computer_is_told_and_a_fast_one_too() {
        assert!(speed_of_this_computer(1000, 2).contains("fast enough"));
        assert!(speed_of_this_computer(0, 0).contains("fast enough"));
        let slow = speed_of_this_computer(750, 250);
        assert!(slow.contains("too slow: 250 of 1000 frames (25 %)"), "{slow}");
    }

    #[test]
    fn only_words_that_occur_are_explained() {
        let mut record = crate::plc::record(1);
        let plain = legend(&VecDeque::from([record]));
        assert!(plain.contains("no doubts") && !plain.contains("flag clipped"), "{plain}");
        record.flags.set(Flags::CLIPPED, true);
        record.may_be_used = false;
        let flagged = legend(&VecDeque::from([record]));
        assert!(flagged.contains("flag clipped: it reached over"), "{flagged}");
        assert!(!flagged.contains("merged") && flagged.contains("must not be sorted"), "{flagged}");
    }
}
