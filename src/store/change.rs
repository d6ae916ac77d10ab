//! What changes the store: one import at a time, each of them old or new after a power cut.

use super::access::ACCESS;
use super::stick::TEXT_BYTES_MAX;
use super::{
    CURRENT, IMPORT, ImportRecord, ImportResult, Imports, REPORT, Store, TRUST, Trust, UnderWay,
    files,
};
use crate::error::{Error, Result};
use rustix::fs::{FlockOperation, flock};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

pub(super) const PREVIOUS: &str = "previous";
const SITE: &str = "site-";
const STAGING: &str = "staging";
const CUT_OFF: &str = "The import was cut off; the configuration before stays in force.\n\
    Plug the stick in again.\n";
const CUT_OFF_LATE: &str = "The import was cut off when it was nearly done, and has been completed.\n\
    The configuration is in force.\n";

/// The right to change the store; one process has it.
pub struct Locked<'a> {
    store: &'a Store,
    lock: File,
}

impl Drop for Locked<'_> {
    /// Closing is not enough: a child between its fork and its exec has the file open too.
    fn drop(&mut self) {
        let _ = flock(&self.lock, FlockOperation::Unlock);
    }
}

impl<'a> Locked<'a> {
    /// Of a lock that is held.
    pub(super) fn new(store: &'a Store, lock: File) -> Self {
        Self { store, lock }
    }

    /// The store that is locked.
    pub fn store(&self) -> &Store {
        self.store
    }

    /// End an import that was cut off, remove what it left, and keep the key in force.
    pub(super) fn settle(&self) -> Result<()> {
        let imports = self.store.imports();
        let mut cut_off = None;
        if let Some(under_way) = imports.under_way {
            let is_in_force = self.has_come_in_force(&under_way);
            let report = if is_in_force { CUT_OFF_LATE } else { CUT_OFF };
            cut_off = Some(report);
            if is_in_force {
                self.complete(&under_way, report)?;
            } else {
                self.note(ImportResult::Refused, report)?;
            }
        }
        if let Some(report) = cut_off {
            tracing::warn!("{}", report.trim_end().replace('\n', " "));
        }
        let cleaned = files::remove(&self.path(STAGING))
            .and_then(|()| self.scratch_path())
            .and_then(|scratch| files::remove(&scratch))
            .and_then(|()| self.prune());
        cleaned.map_err(|e| self.store.failed(&e))?;
        // A configuration that cannot be read is for the import to tell.
        let (Ok(trust), Ok(kept)) = (self.store.trust(), self.store.kept_trust()) else {
            return Ok(());
        };
        if kept.is_none_or(|kept| kept != trust) { self.keep(&trust) } else { Ok(()) }
    }

    /// Note that an import begins.
    pub fn begin(&self) -> Result<()> {
        self.note_under_way(UnderWay::default())
    }

    /// Leave nothing of what was staged.
    pub fn discard(&self) -> Result<()> {
        files::remove(&self.path(STAGING)).map_err(|e| self.store.failed(&e))
    }

    /// An empty folder to put a configuration into.
    pub fn stage(&self) -> Result<PathBuf> {
        let staging = self.path(STAGING);
        let made = files::remove(&staging).and_then(|()| fs::create_dir(&staging));
        made.map_err(|e| self.store.failed(&e))?;
        Ok(staging)
    }

    /// An empty folder for what is not to be kept, outside of the store: stills are larger than it.
    pub fn scratch(&self) -> Result<PathBuf> {
        let made = self.scratch_path().and_then(|path| {
            files::remove(&path)?;
            fs::create_dir(&path)?;
            Ok(path)
        });
        made.map_err(|e| {
            Error::failure(format!("cannot make a folder: {e}")).in_file(&std::env::temp_dir())
        })
    }

    /// Of one store it is always the same, so that what a killed import left is found.
    fn scratch_path(&self) -> std::io::Result<PathBuf> {
        let store = fs::metadata(&self.store.root)?;
        let name = format!("beltgauge-import-{:x}-{:x}", store.dev(), store.ino());
        Ok(std::env::temp_dir().join(name))
    }

    /// Put what was staged in force, and trust whom it says. What is in force already stays.
    pub fn apply(&self, trust: &Trust, report: &str) -> Result<()> {
        let under_way = self.prepare(trust).map_err(|e| self.store.failed(&e))?;
        self.switch(&under_way, report)
    }

    fn prepare(&self, trust: &Trust) -> std::io::Result<UnderWay> {
        let current = fs::read_link(self.path(CURRENT)).ok();
        let trust = Some(trust.clone());
        let result = ImportResult::Applied;
        if self.is_in_force() {
            let previous = fs::read_link(self.path(PREVIOUS)).ok();
            return Ok(UnderWay { result, site: current, previous, trust });
        }
        let staging = self.path(STAGING);
        for entry in fs::read_dir(&staging)? {
            File::open(entry?.path())?.sync_all()?;
        }
        files::sync(&staging)?;
        let used: Vec<u64> = self.sites()?.into_iter().filter_map(|(_, number)| number).collect();
        let name = format!("{SITE}{}", used.iter().max().map_or(1, |last| last + 1));
        fs::rename(&staging, self.path(&name))?;
        files::sync(&self.store.root)?;
        Ok(UnderWay { result, site: Some(name.into()), previous: current, trust })
    }

    /// Whether what was staged is in force already.
    fn is_in_force(&self) -> bool {
        let contents = |folder: &str| -> std::io::Result<BTreeMap<OsString, Vec<u8>>> {
            let entries = fs::read_dir(self.path(folder))?;
            let file = |entry: std::io::Result<fs::DirEntry>| {
                let entry = entry?;
                Ok((entry.file_name(), files::read(&entry.path(), TEXT_BYTES_MAX)?))
            };
            entries.map(file).collect()
        };
        let [staged, current] = [STAGING, CURRENT].map(contents);
        staged.is_ok_and(|staged| current.is_ok_and(|current| staged == current))
    }

    /// Put the configuration before the one in force in force again, and the other way round.
    pub fn roll_back(&self, report: &str) -> Result<()> {
        let link = |name: &str| fs::read_link(self.path(name));
        let (Ok(previous), Ok(site)) = (link(CURRENT), link(PREVIOUS)) else {
            return Err(Error::configuration("there is no configuration to go back to")
                .in_file(&self.store.root)
                .remedy("import one"));
        };
        let (site, previous) = (Some(site), Some(previous));
        let under_way = UnderWay { result: ImportResult::RolledBack, site, previous, trust: None };
        self.switch(&under_way, report)
    }

    /// Put a folder in force, in one step that whoever comes next can complete.
    fn switch(&self, under_way: &UnderWay, report: &str) -> Result<()> {
        self.note_under_way(under_way.clone())?;
        if let Some(site) = &under_way.site {
            files::point(&self.path(CURRENT), site).map_err(|e| self.store.failed(&e))?;
        }
        self.complete(under_way, report)
    }

    /// All that follows from a configuration that is in force.
    fn complete(&self, under_way: &UnderWay, report: &str) -> Result<()> {
        if let Some(previous) = &under_way.previous {
            files::point(&self.path(PREVIOUS), previous).map_err(|e| self.store.failed(&e))?;
        }
        if let Some(trust) = &under_way.trust {
            self.keep(trust)?;
        }
        self.note(under_way.result, report)?;
        self.prune().map_err(|e| self.store.failed(&e))
    }

    /// Whether the one step was done: then the import is to be completed, not taken back.
    fn has_come_in_force(&self, under_way: &UnderWay) -> bool {
        let current = fs::read_link(self.path(CURRENT)).ok();
        under_way.site.is_some() && under_way.site == current
    }

    /// Note that an import was refused. One that failed after its one step is left to be completed by
    /// whoever comes next.
    pub fn refuse(&self, report: &str) -> Result<()> {
        match self.store.imports().under_way {
            Some(under_way) if self.has_come_in_force(&under_way) => Ok(()),
            _ => self.note(ImportResult::Refused, report),
        }
    }

    /// Keep whom to trust.
    pub fn keep(&self, trust: &Trust) -> Result<()> {
        self.write(TRUST, trust)
    }

    /// Note what an import came to, and write its report.
    fn note(&self, result: ImportResult, report: &str) -> Result<()> {
        files::replace(&self.path(REPORT), report.as_bytes()).map_err(|e| self.store.failed(&e))?;
        let count = self.store.last_import().count.wrapping_add(1);
        self.write(IMPORT, &Imports { last: ImportRecord { count, result }, under_way: None })
    }

    fn note_under_way(&self, under_way: UnderWay) -> Result<()> {
        let last = self.store.last_import();
        self.write(IMPORT, &Imports { last, under_way: Some(under_way) })
    }

    fn write(&self, name: &str, value: &impl Serialize) -> Result<()> {
        let text = toml::to_string(value).map_err(std::io::Error::other);
        text.and_then(|text| files::replace(&self.path(name), text.as_bytes()))
            .map_err(|e| self.store.failed(&e))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.store.root.join(name)
    }

    /// The folders of sites and their numbers.
    fn sites(&self) -> std::io::Result<Vec<(PathBuf, Option<u64>)>> {
        let mut sites = Vec::new();
        for entry in fs::read_dir(&self.store.root)? {
            let path = entry?.path();
            let name = path.file_name().and_then(|name| name.to_str());
            if let Some(number) = name.and_then(|name| name.strip_prefix(SITE)) {
                let number = number.parse().ok();
                sites.push((path, number));
            }
        }
        Ok(sites)
    }

    /// Remove the configurations that no link points to, and files that did not take their place.
    fn prune(&self) -> std::io::Result<()> {
        let kept = [CURRENT, PREVIOUS].map(|name| fs::read_link(self.path(name)).ok());
        for (path, _) in self.sites()? {
            if !kept.iter().flatten().any(|kept| path.ends_with(kept)) {
                files::remove(&path)?;
            }
        }
        for name in [CURRENT, PREVIOUS, IMPORT, TRUST, REPORT, ACCESS] {
            files::remove(&self.path(&format!("{name}.{}", files::NEW)))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::CONFIG_FILE;
    use std::os::unix::fs::symlink;

    fn store(name: &str) -> Store {
        let root =
            std::env::temp_dir().join(format!("beltgauge-store-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&root);
        Store::new(&root)
    }

    fn import(store: &Store, text: &str) {
        let locked = store.lock().expect("free");
        let staging = locked.stage().expect("room");
        fs::write(staging.join(CONFIG_FILE), text).expect("room");
        locked.apply(&Trust::default(), text).expect("room");
    }

    fn current(store: &Store) -> Option<String> {
        fs::read_to_string(store.config()).ok()
    }

    #[test]
    fn the_last_two_are_kept_and_can_be_swapped() {
        let store = store("two");
        assert_eq!((current(&store), store.last_import()), (None, ImportRecord::default()));
        assert!(store.lock().expect("free").roll_back("back").is_err(), "nothing to go back to");
        for text in ["a", "b", "c"] {
            import(&store, text);
        }
        assert_eq!(current(&store).as_deref(), Some("c"));
        for (text, same) in [("c", true), ("b", false)] {
            let locked = store.lock().expect("free");
            let staging = locked.stage().expect("room");
            fs::write(staging.join(CONFIG_FILE), text).expect("room");
            assert_eq!(locked.is_in_force(), same);
        }
        let locked = store.lock().expect("free");
        assert!(store.lock().is_err(), "one at a time");
        assert_eq!(locked.sites().expect("readable").len(), 2);
        for text in ["b", "c"] {
            locked.roll_back("back").expect("two are there");
            assert_eq!(current(&store).as_deref(), Some(text));
        }
        let record = ImportRecord { count: 5, result: ImportResult::RolledBack };
        assert_eq!(store.last_import(), record);
    }

    #[test]
    fn a_child_that_still_has_the_lock_open_does_not_hold_it() {
        let store = store("child");
        let locked = store.lock().expect("free");
        let inherited = locked.lock.try_clone().expect("as fork does");
        drop(locked);
        store.lock().expect("free");
        drop(inherited);
    }

    #[test]
    fn a_cut_import_is_taken_back_before_its_step_and_completed_after_it() {
        let store = store("step");
        import(&store, "a");
        let key = "RWQf6LRCGA9i53mlYecO4IzT51TGPpvWucNSCh1CBM0QTaLn73Y7GFO3";
        let mut trust = Trust::default();
        trust.public_key = Some(key.into());
        for (stepped, result, text) in
            [(false, ImportResult::Refused, "a"), (true, ImportResult::Applied, "b")]
        {
            let locked = store.lock().expect("free");
            locked.begin().expect("room");
            let staging = locked.stage().expect("room");
            fs::write(staging.join(CONFIG_FILE), "b").expect("room");
            let under_way = locked.prepare(&trust).expect("room");
            locked.note_under_way(under_way.clone()).expect("room");
            if stepped {
                let site = under_way.site.expect("staged");
                files::point(&store.root.join(CURRENT), &site).expect("room");
            }
            let count = store.last_import().count;
            drop(locked); // as a power cut does: nothing else is written
            store.settle();
            store.settle();
            assert_eq!(store.last_import(), ImportRecord { count: count + 1, result });
            assert_eq!(current(&store).as_deref(), Some(text));
            let kept = store.kept_trust().expect("readable").and_then(|kept| kept.public_key);
            assert_eq!(kept.is_some(), stepped);
        }
        store.lock().expect("free").roll_back("back").expect("the one before is known");
        assert_eq!(current(&store).as_deref(), Some("a"));
    }

    #[test]
    fn whatever_a_power_cut_left_behind_does_not_stop_the_next_import() {
        let store = store("cut");
        import(&store, "a");
        let root = &store.root;
        fs::create_dir(root.join(STAGING)).expect("room");
        fs::write(root.join(STAGING).join("half"), "").expect("room");
        symlink("nowhere", root.join("current.new")).expect("room");
        fs::write(root.join("import.toml.new"), "ha").expect("room");
        fs::create_dir(root.join("site-9")).expect("room");
        fs::create_dir(root.join("site-x")).expect("room");
        fs::write(root.join(IMPORT), "count = ").expect("room");
        assert_eq!(store.last_import(), ImportRecord::default());
        import(&store, "b");
        assert_eq!(current(&store).as_deref(), Some("b"));
        let locked = store.lock().expect("free");
        assert_eq!(locked.sites().expect("readable").len(), 2);
        locked.roll_back("back").expect("two are there");
        assert_eq!(current(&store).as_deref(), Some("a"));
    }
}
