//! The appliance's configurations on its disk: one in force, one to go back to.
//!
//! ```text
//! STORE/current  -> site-7        the configuration in force: beltgauge.toml and what it names
//!       previous -> site-6        the one before it
//!       import.toml, report.txt   what the last import came to
//!       plc.state                 what the PLC was told
//! ```
//! A configuration is written, brought to the disk and checked before one rename of a link puts it in
//! force: power that fails at any instant leaves the old or the new one.

use crate::error::{Error, Result};
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

/// Name of the configuration file of a site.
pub const CONFIG_FILE: &str = "beltgauge.toml";
const CURRENT: &str = "current";
const PREVIOUS: &str = "previous";
const SITE: &str = "site-";
const STAGING: &str = "staging";
const IMPORT: &str = "import.toml";
/// Name of the report on the last import.
pub const REPORT: &str = "report.txt";

/// What an import came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImportResult {
    /// There was none.
    #[default]
    None,
    /// It is in force.
    Applied,
    /// It was refused; the one before stays in force.
    Refused,
    /// The one before is in force again.
    RolledBack,
}

/// What is known of the last import.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImportRecord {
    /// Imports so far; wraps.
    pub count: u16,
    /// Of the last one.
    pub result: ImportResult,
}

/// A folder with configurations.
#[derive(Clone, Debug)]
pub struct Store {
    root: PathBuf,
}

/// The right to change the store; one process has it.
pub struct Locked<'a> {
    store: &'a Store,
    lock: File,
}

impl Store {
    /// A store in an existing folder.
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    /// The configuration in force; it need not be there.
    pub fn config(&self) -> PathBuf {
        self.root.join(CURRENT).join(CONFIG_FILE)
    }

    /// Where what the PLC was told is kept, whatever the configuration.
    pub fn plc_state(&self) -> PathBuf {
        self.root.join("plc.state")
    }

    /// What is known of the last import; nothing is, when it cannot be read.
    pub fn last_import(&self) -> ImportRecord {
        let text = fs::read_to_string(self.root.join(IMPORT)).unwrap_or_default();
        toml::from_str(&text).unwrap_or_default()
    }

    /// Become the one who changes it.
    pub fn lock(&self) -> Result<Locked<'_>> {
        fs::create_dir_all(&self.root).map_err(|e| self.failed(&e))?;
        let lock = File::create(self.root.join("lock")).map_err(|e| self.failed(&e))?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|_| {
            Error::failure("another import is at work").in_file(&self.root).remedy("wait for it")
        })?;
        Ok(Locked { store: self, lock })
    }

    fn failed(&self, e: &std::io::Error) -> Error {
        Error::failure(format!("the store of configurations cannot be written: {e}"))
            .in_file(&self.root)
            .remedy("give a folder on a disk with room that the process may write, with --store")
    }
}

impl Drop for Locked<'_> {
    /// Closing is not enough: a child between its fork and its exec has the file open too.
    fn drop(&mut self) {
        let _ = flock(&self.lock, FlockOperation::Unlock);
    }
}

impl Locked<'_> {
    /// An empty folder to put a configuration into. What power that failed left there is gone.
    pub fn stage(&self) -> Result<PathBuf> {
        let staging = self.store.root.join(STAGING);
        let made = remove(&staging).and_then(|()| fs::create_dir(&staging));
        made.map_err(|e| self.store.failed(&e))?;
        Ok(staging)
    }

    /// Whether what was staged is in force already.
    pub fn is_in_force(&self) -> bool {
        let contents = |folder: &str| -> std::io::Result<BTreeMap<OsString, Vec<u8>>> {
            let entries = fs::read_dir(self.store.root.join(folder))?;
            let file = |entry: std::io::Result<fs::DirEntry>| {
                let entry = entry?;
                Ok((entry.file_name(), fs::read(entry.path())?))
            };
            entries.map(file).collect()
        };
        let [staged, current] = [STAGING, CURRENT].map(contents);
        staged.is_ok_and(|staged| current.is_ok_and(|current| staged == current))
    }

    /// Put what was staged in force.
    pub fn apply(&self) -> Result<()> {
        self.try_apply().map_err(|e| self.store.failed(&e))
    }

    fn try_apply(&self) -> std::io::Result<()> {
        let root = &self.store.root;
        let staging = root.join(STAGING);
        for entry in fs::read_dir(&staging)? {
            File::open(entry?.path())?.sync_all()?;
        }
        sync(&staging)?;
        let used: Vec<u64> = self.sites()?.into_iter().filter_map(|(_, number)| number).collect();
        let name = format!("{SITE}{}", used.iter().max().map_or(1, |last| last + 1));
        fs::rename(&staging, root.join(&name))?;
        sync(root)?;
        if let Ok(current) = fs::read_link(root.join(CURRENT)) {
            self.point(PREVIOUS, &current)?;
        }
        self.point(CURRENT, Path::new(&name))?;
        self.prune()
    }

    /// Put the configuration before the one in force in force again, and the other way round.
    pub fn roll_back(&self) -> Result<()> {
        let root = &self.store.root;
        let link = |name: &str| fs::read_link(root.join(name));
        let (Ok(current), Ok(previous)) = (link(CURRENT), link(PREVIOUS)) else {
            return Err(Error::configuration("there is no configuration to go back to")
                .in_file(root)
                .remedy("import one"));
        };
        let swapped = self.point(CURRENT, &previous).and_then(|()| self.point(PREVIOUS, &current));
        swapped.map_err(|e| self.store.failed(&e))
    }

    /// Note what an import came to, and write its report.
    pub fn note(&self, result: ImportResult, report: &str) -> Result<()> {
        let count = self.store.last_import().count.wrapping_add(1);
        let record = toml::to_string(&ImportRecord { count, result }).unwrap_or_default();
        let written = self
            .replace(REPORT, report.as_bytes())
            .and_then(|()| self.replace(IMPORT, record.as_bytes()));
        written.map_err(|e| self.store.failed(&e))
    }

    /// Make a link point to another configuration, in one step.
    fn point(&self, name: &str, target: &Path) -> std::io::Result<()> {
        let root = &self.store.root;
        let new = root.join("link.new");
        remove(&new)?;
        symlink(target, &new)?;
        fs::rename(&new, root.join(name))?;
        sync(root)
    }

    /// Replace a file, in one step.
    fn replace(&self, name: &str, bytes: &[u8]) -> std::io::Result<()> {
        let root = &self.store.root;
        let new = root.join("file.new");
        let mut file = File::create(&new)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&new, root.join(name))?;
        sync(root)
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

    /// Remove the configurations that no link points to.
    fn prune(&self) -> std::io::Result<()> {
        let kept = [CURRENT, PREVIOUS].map(|name| fs::read_link(self.store.root.join(name)).ok());
        for (path, _) in self.sites()? {
            if !kept.iter().flatten().any(|kept| path.ends_with(kept)) {
                remove(&path)?;
            }
        }
        Ok(())
    }
}

/// Remove a file or folder, if it is there.
fn remove(path: &Path) -> std::io::Result<()> {
    let removed = match fs::symlink_metadata(path) {
        Ok(metadata) if metadata.is_dir() => fs::remove_dir_all(path),
        _ => fs::remove_file(path),
    };
    removed.or_else(|e| if e.kind() == ErrorKind::NotFound { Ok(()) } else { Err(e) })
}

fn sync(folder: &Path) -> std::io::Result<()> {
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

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
        locked.apply().expect("room");
        locked.note(ImportResult::Applied, text).expect("room");
    }

    fn current(store: &Store) -> Option<String> {
        fs::read_to_string(store.config()).ok()
    }

    #[test]
    fn the_last_two_are_kept_and_can_be_swapped() {
        let store = store("two");
        assert_eq!((current(&store), store.last_import()), (None, ImportRecord::default()));
        assert!(store.lock().expect("free").roll_back().is_err(), "nothing to go back to");
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
            locked.roll_back().expect("two are there");
            assert_eq!(current(&store).as_deref(), Some(text));
        }
        let record = ImportRecord { count: 3, result: ImportResult::Applied };
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
    fn whatever_a_power_cut_left_behind_does_not_stop_the_next_import() {
        let store = store("cut");
        import(&store, "a");
        let root = &store.root;
        fs::create_dir(root.join(STAGING)).expect("room");
        fs::write(root.join(STAGING).join("half"), "").expect("room");
        symlink("nowhere", root.join("link.new")).expect("room");
        fs::write(root.join("file.new"), "ha").expect("room");
        fs::create_dir(root.join("site-9")).expect("room");
        fs::create_dir(root.join("site-x")).expect("room");
        fs::write(root.join(IMPORT), "count = ").expect("room");
        assert_eq!(store.last_import(), ImportRecord::default());
        import(&store, "b");
        assert_eq!(current(&store).as_deref(), Some("b"));
        let locked = store.lock().expect("free");
        assert_eq!(locked.sites().expect("readable").len(), 2);
        locked.roll_back().expect("two are there");
        assert_eq!(current(&store).as_deref(), Some("a"));
    }
}
