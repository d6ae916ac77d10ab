//! The machine as its fleet sees it: the archive's entries, and figures.

use super::desk::Insight;
use crate::archive::{Follower, Kind, Reader, Stored};
use crate::config::Config;
use crate::error::{Error, Result};
use crate::fleet::{Entries, Entry, Figures, Machine};
use crate::web::Machine as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Refuse a fleet whose parcels would have no number of their own, or that could not be told again.
pub fn check(config: &Config) -> Result<()> {
    let needed = [
        (config.archive.folder.is_some(), "archive.folder", "parcels are told out of the archive"),
        (
            config.plc.state_file.is_some(),
            "plc.state_file",
            "without it parcels' numbers begin anew with every start",
        ),
    ];
    match needed.into_iter().find(|(is_set, ..)| !is_set) {
        Some((_, key, why)) if config.fleet.broker.is_some() => {
            Err(Error::configuration(format!("fleet.broker is set, but {key} is not: {why}"))
                .allowed("both archive.folder and plc.state_file")
                .remedy(format!("set {key}, or leave fleet.broker out")))
        }
        _ => Ok(()),
    }
}

/// Follows the archive of a folder, from the entry after number `number` on.
pub fn entries_after(folder: &Path, number: u64) -> Box<dyn Entries> {
    Box::new(Following(Follower::after(folder, number)))
}

/// Time of an entry of a folder's archive, if it is there, and the number of the newest.
///
/// # Errors
/// What the disk says.
pub fn entry_time(folder: &Path, number: u64) -> std::result::Result<(Option<u64>, u64), String> {
    let look = || -> Result<_> {
        let reader = Reader::open(folder)?;
        let time = reader.entry(number)?.map(|stored| stored.entry.utc_ms);
        Ok((time, reader.before(None, 1)?.entries.first().map_or(0, |stored| stored.number)))
    };
    look().map_err(|e| e.to_string())
}

struct Following(Follower);

impl Entries for Following {
    fn next(&mut self, limit: usize) -> std::result::Result<Vec<Entry>, String> {
        let entry = |Stored { number, entry }: Stored| Entry {
            number,
            utc_ms: entry.utc_ms,
            kind: match entry.kind {
                Kind::Parcel => crate::fleet::Kind::Parcel,
                Kind::Event => crate::fleet::Kind::Event,
                Kind::Gap => crate::fleet::Kind::Gap,
            },
            text: entry.text,
        };
        let found = self.0.read(limit).map_err(|e| e.to_string())?;
        Ok(found.into_iter().map(entry).collect())
    }
}

/// The appliance's side.
pub(super) struct Lane {
    pub(super) insight: Arc<Insight>,
    pub(super) archive: PathBuf,
}

impl Machine for Lane {
    fn boots(&self) -> Option<u16> {
        let plc = self.insight.plc_side();
        plc.is_known().then_some(plc.status.boots)
    }

    fn figures(&self) -> Figures {
        let state = self.insight.state();
        let is_lit = |name| state.lamps.iter().any(|lamp| lamp.name == name && lamp.on);
        let (camera, counts, archive) = (&state.camera, &state.counts, &state.archive);
        Figures {
            utc_ms: state.utc_ms,
            uptime_s: state.uptime_s,
            running: is_lit("running"),
            uncertain: is_lit("uncertain"),
            maintenance: is_lit("maintenance"),
            failure: is_lit("failure"),
            stopped: state.stopped,
            camera_present: camera.present,
            camera_losses: camera.losses,
            frames: camera.frames,
            frames_dropped: camera.frames_dropped,
            frames_lost: camera.frames_lost,
            frames_torn: camera.frames_torn,
            frame_time_max_ms: camera.frame_time_max_ms,
            belt_speed_mm_per_s: state.belt.speed_mm_per_s,
            belt_measured: state.belt.measured,
            parcels: counts.parcels,
            parcels_unmeasured: counts.parcels_unmeasured,
            parcels_usable: counts.parcels_usable,
            parcels_lost: counts.parcels_lost,
            queue_overflows: counts.queue_overflows,
            archive_entries_lost: archive.entries_lost,
            archive_writable: archive.enabled && archive.fault.is_none(),
            reasons: state.reasons,
        }
    }

    fn entries_after(&self, number: u64) -> Box<dyn Entries> {
        entries_after(&self.archive, number)
    }

    fn entry_time(&self, number: u64) -> std::result::Result<(Option<u64>, u64), String> {
        entry_time(&self.archive, number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fleet_needs_an_archive_and_numbers_that_do_not_begin_anew() {
        let text = "[camera]\ncalibration = \"c\"\n[belt]\nspeed_mm_per_s = 500\n\
            [zone]\nx_min_mm = -600\nx_max_mm = 600\ny_min_mm = -380\ny_max_mm = 380\n";
        let with = |more: &str| check(&Config::parse(&format!("{text}{more}")).expect("valid"));
        let fleet = "[fleet]\nbroker = \"127.0.0.1:1883\"\nsite = \"s\"\nlane = \"l\"\n";
        let (archive, state) = ("[archive]\nfolder = \"a\"\n", "[plc]\nstate_file = \"s\"\n");
        assert!(with("").is_ok() && with(&format!("{fleet}{archive}{state}")).is_ok());
        for (has, lacks) in [(archive, "plc.state_file"), (state, "archive.folder")] {
            let error = with(&format!("{fleet}{has}")).expect_err("refused").to_string();
            assert!(error.contains(&format!("but {lacks} is not")), "{error}");
        }
    }
}
