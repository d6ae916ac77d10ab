//! What a USB stick brings, read as from a stranger: plain files of a folder without links, of
//! bounded size and number, and of one signed set if a key is in force.

use super::REPORT;
use super::files;
use super::manifest::{MANIFEST, Manifest, SIGNATURE, another_file, sha256};
use super::trust::Trust;
use crate::error::{Error, Result};
use rustix::fs::{AtFlags, Dir, Mode, OFlags, mkdirat, openat, statat};
use std::fs::File;
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// The folder on the stick.
pub const FOLDER: &str = "beltgauge";
/// The folder inside it that results are left in.
pub const RESULTS: &str = "results";
/// The folders inside it with stills of a calibration.
pub const LENS_FOLDER: &str = "lens";
/// The same of the board on the belt.
pub const BELT_FOLDER: &str = "belt";
/// Name of the report on an update.
pub const UPDATE_REPORT: &str = "update.txt";
/// Name of the file with the code for the page.
pub const CODE: &str = "code.txt";
/// Largest text file.
pub const TEXT_BYTES_MAX: u64 = 256 << 10;
/// Largest file at all: a still or a system.
pub const FILE_BYTES_MAX: u64 = 64 << 20;
/// All stills of a folder together.
pub const STILLS_BYTES_MAX: u64 = 192 << 20;
/// Most stills of a folder.
pub const STILLS_MAX: usize = 60;
/// Most entries of a folder that are looked at.
const ENTRIES_MAX: usize = 1000;
/// Most names that a report lists.
const NAMES_TOLD: usize = 12;
/// Files that are no part of a set: what the appliance leaves, and the manifest itself.
const NO_PART: [&str; 5] = [REPORT, UPDATE_REPORT, CODE, MANIFEST, SIGNATURE];
/// How folders are opened; never through a link.
const FOLDER_FLAGS: OFlags =
    OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::CLOEXEC).union(OFlags::NOFOLLOW);

/// The folder of a stick, or one inside.
pub struct Stick {
    folder: OwnedFd,
    path: PathBuf,
    /// Before the names of its files in the manifest: `lens/` in a folder inside.
    prefix: String,
    /// The signed set; none: no key is in force.
    manifest: Option<Rc<Manifest>>,
}

impl Stick {
    /// The folder `beltgauge` in `root`, whatever its case. Without one: a folder whose name begins
    /// like it, so that there is a place to say so.
    pub fn open(root: &Path) -> Result<Self> {
        let nothing = |why: String| {
            Error::configuration(format!("there is no folder to import: {why}"))
                .in_file(&root.join(FOLDER))
                .remedy("put the configuration into a folder `beltgauge` on the stick")
        };
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let root_folder =
            rustix::fs::open(root, flags, Mode::empty()).map_err(|e| nothing(e.to_string()))?;
        let mut found: Vec<(u8, String, OwnedFd)> = Vec::new();
        for name in names(&root_folder, root)? {
            let lower = name.to_lowercase();
            if !lower.starts_with(FOLDER) {
                continue;
            }
            if let Ok(folder) = openat(&root_folder, &name, FOLDER_FLAGS, Mode::empty()) {
                let rank = u8::from(name != FOLDER) + u8::from(lower != FOLDER);
                found.push((rank, name, folder));
            }
        }
        let best = found.into_iter().min_by(|a, b| (a.0, &a.1).cmp(&(b.0, &b.1)));
        let (_, name, folder) = best.ok_or_else(|| nothing("none is there".to_owned()))?;
        Ok(Self { folder, path: root.join(name), prefix: String::new(), manifest: None })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its name, fit for a log.
    pub fn name(&self) -> String {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        name.escape_debug().to_string()
    }

    /// Refuse a folder whose name only begins like ours.
    pub fn check_name(&self) -> Result<()> {
        let name = self.name();
        if name.to_lowercase() == FOLDER {
            return Ok(());
        }
        Err(Error::configuration(format!("the folder on the stick is called {name}"))
            .in_file(&self.path)
            .allowed(FOLDER)
            .remedy("rename it"))
    }

    /// Hold the stick to its signed manifest if a key is in force, and note the set as taken.
    pub fn seal(&mut self, trust: &mut Trust) -> Result<()> {
        let Some(key) = trust.key()? else { return Ok(()) };
        let read = |name: &str| {
            self.read(name, TEXT_BYTES_MAX).map_err(|e| {
                if self.has(name) {
                    return e;
                }
                Error::configuration(format!(
                    "what is not signed is refused, and {name} is not there"
                ))
                .in_file(&self.path)
                .allowed("a set signed with the secret key that belongs to the key in force")
                .remedy(format!("`beltgauge manifest`, then minisign -S -m {MANIFEST}"))
            })
        };
        let (text, signature) = (read(MANIFEST)?, read(SIGNATURE)?);
        let in_manifest = |e: Error| e.in_file(&self.path.join(MANIFEST));
        let manifest = Manifest::verified(&text, &signature, &key).map_err(in_manifest)?;
        trust.take(&manifest, sha256(&text)).map_err(in_manifest)?;
        // A set is taken whole: one with a file less could mean something else.
        for (name, bytes) in manifest.files() {
            let size = self.size_of(name).map_err(|e| e.in_file(&self.path.join(name)))?;
            if size != bytes {
                return Err(another_file("the file is not the one in the signed manifest")
                    .in_file(&self.path.join(name)));
            }
        }
        self.manifest = Some(Rc::new(manifest));
        Ok(())
    }

    /// Bytes of a file in it or in a folder inside.
    fn size_of(&self, name: &str) -> Result<u64> {
        let missing = || another_file("a file of the signed manifest is not there");
        let (folder, name) = match name.split_once('/') {
            Some((folder, name)) => (Some(self.folder(folder).ok_or_else(missing)?), name),
            None => (None, name),
        };
        let file = folder.as_ref().unwrap_or(self).plain(name).map_err(|_| missing())?;
        file.metadata().map(|m| m.len()).map_err(|_| missing())
    }

    /// A folder inside; `None` when there is none, or the signed set has none of its files.
    pub fn folder(&self, name: &str) -> Option<Self> {
        let folder = openat(&self.folder, name, FOLDER_FLAGS, Mode::empty()).ok()?;
        let prefix = format!("{}{name}/", self.prefix);
        let manifest = self.manifest.clone();
        let listed = |m: &Rc<Manifest>| m.files().any(|(file, _)| file.starts_with(&prefix));
        manifest.as_ref().is_none_or(listed).then_some(())?;
        Some(Self { folder, path: self.path.join(name), prefix, manifest })
    }

    /// Whether there is a plain file of that name.
    pub fn has(&self, name: &str) -> bool {
        self.plain(name).is_ok()
    }

    /// Whether there is anything of that name, be it a file or not.
    pub fn exists(&self, name: &str) -> bool {
        statat(&self.folder, name, AtFlags::SYMLINK_NOFOLLOW).is_ok()
    }

    fn plain(&self, name: &str) -> Result<File> {
        // Of one folder only: what is behind a slash may be behind a link.
        let found = if is_plain_name(Path::new(name)) {
            files::open(&self.folder, Path::new(name))
        } else {
            Err(std::io::ErrorKind::InvalidFilename.into())
        };
        found.map_err(|e| {
            Error::configuration(format!("cannot open the file: {e}"))
                .in_file(&self.path.join(name))
                .allowed("plain files of the stick")
                .remedy("copy the file itself on to the stick")
        })
    }

    /// The contents of a file of at most so many bytes, as the signed set has them if there is one.
    pub fn read(&self, name: &str, bytes_max: u64) -> Result<Vec<u8>> {
        if let Some((folder, name)) = name.split_once('/')
            && let Some(folder) = self.folder(folder)
        {
            return folder.read(name, bytes_max);
        }
        let path = self.path.join(name);
        let bytes = files::read_open(&self.plain(name)?, bytes_max).map_err(|e| {
            if e.kind() == std::io::ErrorKind::FileTooLarge {
                return Error::configuration("the file is too large")
                    .in_file(&path)
                    .allowed(format!("{bytes_max} bytes"));
            }
            Error::failure(format!("cannot read the file: {e}"))
                .in_file(&path)
                .remedy("the stick is damaged: use another")
        })?;
        if let Some(manifest) = &self.manifest {
            let name = format!("{}{name}", self.prefix);
            manifest.check(&name, &bytes).map_err(|e| e.in_file(&path))?;
        }
        Ok(bytes)
    }

    /// A text file.
    pub fn read_text(&self, name: &str) -> Result<String> {
        String::from_utf8(self.read(name, TEXT_BYTES_MAX)?).map_err(|e| {
            Error::configuration(format!("not UTF-8 text: {e}"))
                .in_file(&self.path.join(name))
                .remedy("save it as UTF-8; some editors call it Unicode")
        })
    }

    /// Names of what is in the folder, in order; those of the signed set if there is one.
    pub fn names(&self) -> Result<Vec<String>> {
        let mut names = names(&self.folder, &self.path)?;
        if let Some(manifest) = &self.manifest {
            names.retain(|name| manifest.has(&format!("{}{name}", self.prefix)));
        }
        Ok(names)
    }

    /// Names of the files that a manifest lists.
    pub(super) fn set(&self) -> Result<Vec<String>> {
        let mut set = self.names()?;
        set.retain(|name| !NO_PART.contains(&name.as_str()) && self.plain(name).is_ok());
        for name in [LENS_FOLDER, BELT_FOLDER] {
            if let Some(folder) = self.folder(name) {
                set.extend(folder.names()?.into_iter().map(|file| format!("{name}/{file}")));
            }
        }
        Ok(set)
    }

    /// What is there, for a report.
    pub fn contents(&self) -> String {
        let mut names = names(&self.folder, &self.path).unwrap_or_default();
        let more = names.len().saturating_sub(NAMES_TOLD);
        names.truncate(NAMES_TOLD);
        // What a stranger wrote goes into a log.
        let mut text: Vec<String> =
            names.iter().map(|name| name.escape_debug().to_string()).collect();
        match more {
            0 if text.is_empty() => text.push("nothing".to_owned()),
            0 => {}
            more => text.push(format!("{more} more")),
        }
        text.join(", ")
    }

    /// Leave a file, if the stick can be written; never through a link.
    pub fn leave(&self, name: &str, bytes: &[u8]) {
        leave(&self.folder, &self.path, name, bytes);
    }

    /// Leave a file in the folder for results.
    pub fn leave_result(&self, name: &str, bytes: &[u8]) {
        let _ = mkdirat(&self.folder, RESULTS, Mode::from_raw_mode(0o755));
        match openat(&self.folder, RESULTS, FOLDER_FLAGS, Mode::empty()) {
            Ok(folder) => leave(folder, &self.path.join(RESULTS), name, bytes),
            Err(e) => not_left(&self.path.join(RESULTS), &e.into()),
        }
    }
}

fn leave(folder: impl AsFd, path: &Path, name: &str, bytes: &[u8]) {
    let left = files::create(folder, Path::new(name), bytes).and_then(|file| file.sync_all());
    if let Err(e) = left {
        not_left(&path.join(name), &e);
    }
}

fn not_left(path: &Path, e: &std::io::Error) {
    tracing::warn!("{} cannot be left on the stick: {e}", path.display());
}

/// Names of what is in a folder, in order; hidden ones are passed over.
fn names(folder: &OwnedFd, path: &Path) -> Result<Vec<String>> {
    let unreadable =
        |e: rustix::io::Errno| Error::failure(format!("cannot list the folder: {e}")).in_file(path);
    let mut names = Vec::new();
    for entry in Dir::read_from(folder).map_err(unreadable)?.take(ENTRIES_MAX) {
        let entry = entry.map_err(unreadable)?;
        let Ok(name) = entry.file_name().to_str() else { continue };
        if !name.starts_with('.') {
            names.push(name.to_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// Whether a path is the plain name of a file, in no other folder.
pub fn is_plain_name(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == path.as_os_str() && name.to_str().is_some())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn root(name: &str) -> PathBuf {
        let root =
            std::env::temp_dir().join(format!("beltgauge-stick-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&root);
        std::fs::create_dir_all(root.join(FOLDER)).expect("room");
        root
    }

    #[test]
    fn links_pipes_folders_and_large_files_are_refused() {
        let root = root("hostile");
        let folder = root.join(FOLDER);
        std::fs::write(folder.join("good"), "good").expect("room");
        symlink("/etc/passwd", folder.join("link")).expect("room");
        symlink("/etc", folder.join("folder-link")).expect("room");
        std::fs::create_dir(folder.join("folder")).expect("room");
        let pipe = std::process::Command::new("mkfifo").arg(folder.join("pipe")).status();
        assert!(pipe.is_ok_and(|status| status.success()));
        std::fs::write(folder.join("large"), vec![b'a'; 4097]).expect("room");
        std::fs::write(folder.join("latin1"), b"gr\xfc\xdfe").expect("room");
        let stick = Stick::open(&root).expect("there");
        assert_eq!(stick.read("good", 4).expect("fits"), b"good");
        for (name, part) in [
            ("link", "cannot open"),
            ("folder", "not a plain file"),
            ("pipe", "not a plain file"),
            ("large", "too large"),
            ("missing", "cannot open"),
            ("../good", "cannot open"),
            ("folder-link/passwd", "cannot open"),
        ] {
            let error = stick.read(name, 4096).expect_err(name).to_string();
            assert!(error.contains(part), "{name}: {error}");
        }
        assert!(stick.read_text("latin1").expect_err("no UTF-8").to_string().contains("UTF-8"));
        assert!(stick.folder("folder-link").is_none() && stick.folder("folder").is_some());
        assert!(Stick::open(&root.join("nowhere")).is_err());
    }

    #[test]
    fn folders_that_begin_like_ours_are_found_and_told() {
        for (name, right) in [
            ("Beltgauge", true),
            ("BELTGAUGE", true),
            ("beltgauge (1)", false),
            ("Beltgauge.old", false),
        ] {
            let root = root("names");
            std::fs::rename(root.join(FOLDER), root.join(name)).expect("same disk");
            std::fs::create_dir(root.join("belts")).expect("room");
            let stick = Stick::open(&root).expect("there");
            assert_eq!(stick.check_name().is_ok(), right, "{name}");
            assert_eq!(stick.path(), root.join(name));
            std::fs::create_dir(root.join(FOLDER)).expect("room");
            assert_eq!(Stick::open(&root).expect("there").path(), root.join(FOLDER));
        }
        let root = root("none");
        std::fs::remove_dir(root.join(FOLDER)).expect("empty");
        std::fs::write(root.join("beltgauge.toml"), "").expect("room");
        assert!(Stick::open(&root).is_err(), "a file is no folder");
    }

    #[test]
    fn nothing_is_left_through_a_link() {
        let root = root("report");
        let victim = root.join("victim");
        std::fs::write(&victim, "untouched").expect("room");
        symlink(&victim, root.join(FOLDER).join("report.txt")).expect("room");
        symlink(&root, root.join(FOLDER).join(RESULTS)).expect("room");
        let stick = Stick::open(&root).expect("there");
        stick.leave("report.txt", b"well done");
        stick.leave_result("victim", b"harmed");
        assert_eq!(std::fs::read_to_string(&victim).expect("there"), "untouched");
        let report = std::fs::read_to_string(root.join(FOLDER).join("report.txt"));
        assert_eq!(report.expect("written"), "well done");
    }

    #[test]
    fn names_of_other_folders_are_not_plain() {
        for (name, plain) in [
            ("camera.toml", true),
            ("a/b", false),
            ("../b", false),
            ("/b", false),
            ("..", false),
            ("", false),
            ("b/", false),
        ] {
            assert_eq!(is_plain_name(Path::new(name)), plain, "{name}");
        }
    }
}
