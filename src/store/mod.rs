//! The appliance's disk: configurations, one in force and one to go back to; whom it trusts; what
//! came on sticks.
//!
//! ```text
//! STORE/current  -> site-7        the configuration in force: beltgauge.toml and what it names
//!       previous -> site-6        the one before it
//!       trust.toml                the key in force, the highest counter taken with each key
//!       import.toml, report.txt   what the last import came to
//!       plc.state                 what the PLC was told
//!       access.toml               who may change all this through the page
//! ```
//! A configuration is written, brought to the disk and checked before one rename of a link puts it in
//! force. What belongs to it is noted before, in `import.toml`: whoever comes next after a power cut
//! completes an import whose link was renamed, and takes back one whose link was not.

mod access;
mod change;
pub mod files;
pub mod manifest;
pub mod stick;
mod trust;

pub use access::Session;
pub use change::Locked;
pub use trust::Trust;

use crate::camera::CameraFile;
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use stick::TEXT_BYTES_MAX;

/// Name of the configuration file of a site.
pub const CONFIG_FILE: &str = "beltgauge.toml";
const CURRENT: &str = "current";
const IMPORT: &str = "import.toml";
const TRUST: &str = "trust.toml";
/// Name of the report on the last import.
pub const REPORT: &str = "report.txt";
/// Another import is waited for so long.
const LOCK_WAIT: Duration = Duration::from_secs(2);
const LOCK_POLL: Duration = Duration::from_millis(20);
/// What an import came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImportResult {
    /// There was none.
    #[default]
    None,
    /// It is in force.
    Applied,
    /// It was refused or cut off; the one before stays in force.
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

/// `import.toml`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Imports {
    #[serde(flatten)]
    last: ImportRecord,
    /// One that was begun and has not ended.
    under_way: Option<UnderWay>,
}

/// An import, as far as it has come.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct UnderWay {
    /// What it comes to once `site` is in force.
    result: ImportResult,
    /// The folder that it puts in force, once that is known.
    site: Option<PathBuf>,
    /// The folder to go back to then.
    previous: Option<PathBuf>,
    /// Whom to trust then.
    trust: Option<Trust>,
}

/// A folder with configurations.
#[derive(Clone, Debug)]
pub struct Store {
    root: PathBuf,
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

    /// Read the configuration in force and its camera file. Nothing but plain files of bounded size
    /// is read, so that a start never hangs.
    pub fn site(&self) -> Result<Site> {
        let path = self.config();
        let config = Config::parse(&text_of(&path)?).map_err(|e| e.in_file(&path))?;
        let camera_path = path.with_file_name(&config.camera.calibration);
        let camera = CameraFile::parse(&text_of(&camera_path)?)
            .and_then(CameraFile::into_camera)
            .map_err(|e| e.in_file(&camera_path))?;
        let mut site = Site::new(config, camera).map_err(|e| e.in_file(&path))?;
        site.beside(&path);
        Ok(site)
    }

    /// A file beside the configuration in force, if it is there and plain.
    pub fn file_in_force(&self, name: &Path) -> Option<Vec<u8>> {
        files::read(&self.root.join(CURRENT).join(name), TEXT_BYTES_MAX).ok()
    }

    /// The folder in force, by name: another one after every change.
    pub fn in_force(&self) -> Option<PathBuf> {
        fs::read_link(self.root.join(CURRENT)).ok()
    }

    /// Whether there is a configuration to go back to.
    pub fn can_go_back(&self) -> bool {
        fs::read_link(self.root.join(change::PREVIOUS)).is_ok()
    }

    /// What the last import came to, in words.
    pub fn last_report(&self) -> String {
        text_of(&self.root.join(REPORT)).unwrap_or_default()
    }

    /// Its folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where what the PLC was told is kept, whatever the configuration.
    pub fn plc_state(&self) -> PathBuf {
        self.root.join("plc.state")
    }

    /// Where the archive is, whatever the configuration.
    pub fn archive(&self) -> PathBuf {
        self.root.join("archive")
    }

    /// What is known of the last import that ended; nothing is, when it cannot be read.
    pub fn last_import(&self) -> ImportRecord {
        self.imports().last
    }

    fn imports(&self) -> Imports {
        let text = text_of(&self.root.join(IMPORT)).unwrap_or_default();
        toml::from_str(&text).unwrap_or_default()
    }

    /// Whom to trust. A key once in force stays, whatever becomes of the configuration; only a set
    /// signed with it brings another.
    pub fn trust(&self) -> Result<Trust> {
        let kept = self.kept_trust()?;
        if let Some(kept) = kept.as_ref().filter(|kept| kept.public_key.is_some()) {
            return Ok(kept.clone());
        }
        let path = self.config();
        let in_force = match files::read(&path, TEXT_BYTES_MAX) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(unreadable(&path, &e)),
            Ok(bytes) => {
                public_key_of(&String::from_utf8_lossy(&bytes)).map_err(|e| e.in_file(&path))
            }
        };
        match (in_force, kept) {
            (Ok(public_key), kept) => {
                let mut trust = kept.unwrap_or_default();
                trust.public_key = public_key;
                Ok(trust)
            }
            // No key was in force when it could still be read.
            (Err(_), Some(kept)) => Ok(kept),
            (Err(e), None) => Err(e.remedy(
                "whether a key was in force is not known: correct that file, or remove it, at the console",
            )),
        }
    }

    fn kept_trust(&self) -> Result<Option<Trust>> {
        let path = self.root.join(TRUST);
        let damaged = |what: String| {
            Error::failure(format!("whom to trust is not known: {what}"))
                .in_file(&path)
                .remedy("remove the file at the console: then the configuration's key is in force")
        };
        match files::read(&path, TEXT_BYTES_MAX) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(damaged(e.to_string())),
            Ok(bytes) => {
                let trust: Trust = toml::from_str(&String::from_utf8_lossy(&bytes))
                    .map_err(|e| damaged(e.to_string().trim_end().to_owned()))?;
                trust.key().map_err(|e| damaged(e.to_string()))?;
                Ok(Some(trust))
            }
        }
    }

    /// End an import that was cut off, and keep the key of the configuration in force. For every
    /// start; a disk that cannot be written is told, and does not stop it.
    pub fn settle(&self) {
        match self.lock() {
            Ok(_) => {}
            Err(e) => tracing::warn!("{e}"),
        }
    }

    /// Become the one who changes it. An import that was cut off is ended first.
    pub fn lock(&self) -> Result<Locked<'_>> {
        fs::create_dir_all(&self.root).map_err(|e| self.failed(&e))?;
        // Open to read and write, no pipe makes anyone wait.
        let mut options = File::options();
        options.create(true).truncate(false).read(true).write(true);
        let lock = options.open(self.root.join("lock")).map_err(|e| self.failed(&e))?;
        let start = Instant::now();
        while flock(&lock, FlockOperation::NonBlockingLockExclusive).is_err() {
            if start.elapsed() > LOCK_WAIT {
                return Err(Error::failure("another import is at work")
                    .in_file(&self.root)
                    .remedy("wait for it"));
            }
            std::thread::sleep(LOCK_POLL);
        }
        let locked = Locked::new(self, lock);
        locked.settle()?;
        Ok(locked)
    }

    fn failed(&self, e: &std::io::Error) -> Error {
        Error::failure(format!("the store of configurations cannot be written: {e}"))
            .in_file(&self.root)
            .remedy("give a folder on a disk with room that the process may write, with --store")
    }
}

fn unreadable(path: &Path, e: &std::io::Error) -> Error {
    Error::configuration(format!("cannot read the file: {e}")).in_file(path)
}

/// A text file of the store.
fn text_of(path: &Path) -> Result<String> {
    let bytes = files::read(path, TEXT_BYTES_MAX)
        .map_err(|e| unreadable(path, &e).remedy("import a configuration"))?;
    String::from_utf8(bytes)
        .map_err(|e| Error::configuration(format!("not UTF-8 text: {e}")).in_file(path))
}
/// The key of a configuration, also of one that another version of the program has written: what else
/// is in it does not matter here.
fn public_key_of(text: &str) -> Result<Option<String>> {
    let table: toml::Table = text
        .parse()
        .map_err(|e: toml::de::Error| Error::configuration(e.to_string().trim_end().to_owned()))?;
    match table.get("import").and_then(|import| import.get("public_key")) {
        None => Ok(None),
        Some(toml::Value::String(key)) => Ok(Some(key.clone())),
        Some(other) => Err(Error::configuration(format!("import.public_key = {other}"))
            .allowed("the last line of minisign's .pub file, as a text")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_read_from_a_configuration_that_this_version_refuses() {
        let key = |text: &str| public_key_of(text).map_err(|e| e.to_string());
        assert_eq!(
            key("[plc]\nunknown = 1\n[import]\npublic_key = \"RWQ\"\n"),
            Ok(Some("RWQ".into()))
        );
        assert_eq!(key("[plc]\nqueue = true\n"), Ok(None));
        assert!(key("[import]\npublic_key = 5\n").is_err_and(|e| e.contains("import.public_key")));
        assert!(key("[import\n").is_err(), "damaged: not known");
    }
}
