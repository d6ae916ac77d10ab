//! What a USB stick brings, read as from a stranger: plain files of a folder without links, of
//! bounded size and number, and signed if a key is set.

use crate::error::{Error, Result};
use minisign_verify::{PublicKey, Signature};
use rustix::fs::{Dir, FileType, Mode, OFlags, fstat, openat, unlinkat};
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

/// The folder on the stick.
pub const FOLDER: &str = "beltgauge";
/// The extension of signatures.
const SIGNATURE: &str = "minisig";
/// Largest text file.
pub const TEXT_BYTES_MAX: u64 = 256 << 10;
/// Largest still.
pub const STILL_BYTES_MAX: u64 = 64 << 20;
/// All stills of a folder together.
pub const STILLS_BYTES_MAX: u64 = 192 << 20;
/// Most stills of a folder.
pub const STILLS_MAX: usize = 60;
/// Most entries of a folder that are looked at.
const ENTRIES_MAX: usize = 1000;

/// The folder of a stick, or one inside.
pub struct Stick {
    folder: OwnedFd,
    path: PathBuf,
    key: Option<PublicKey>,
}

/// A public key of minisign, as its `.pub` file has it in the last line.
pub fn public_key(text: &str) -> Result<PublicKey> {
    PublicKey::from_base64(text).map_err(|e| {
        Error::configuration(format!("import.public_key = {text:?}: {e}"))
            .allowed("the last line of minisign's .pub file")
            .remedy("make a pair of keys with `minisign -G`")
    })
}

impl Stick {
    /// The folder `beltgauge` in `root`.
    pub fn open(root: &Path, key: Option<PublicKey>) -> Result<Self> {
        let path = root.join(FOLDER);
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let root = rustix::fs::open(root, flags, Mode::empty());
        let folder =
            root.and_then(|root| openat(root, FOLDER, flags | OFlags::NOFOLLOW, Mode::empty()));
        let folder = folder.map_err(|e| {
            Error::configuration(format!("there is no folder to import: {e}"))
                .in_file(&path)
                .remedy("put the configuration into a folder `beltgauge` on the stick")
        })?;
        Ok(Self { folder, path, key })
    }

    /// A folder inside; `None` when there is none.
    pub fn folder(&self, name: &str) -> Option<Self> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC | OFlags::NOFOLLOW;
        let folder = openat(&self.folder, name, flags, Mode::empty()).ok()?;
        Some(Self { folder, path: self.path.join(name), key: self.key.clone() })
    }

    /// Whether there is a file of that name.
    pub fn has(&self, name: &str) -> bool {
        self.plain(name).is_ok()
    }

    fn plain(&self, name: &str) -> Result<File> {
        let path = self.path.join(name);
        let refused = |what: String| {
            Error::configuration(what)
                .in_file(&path)
                .allowed("plain files of the stick")
                .remedy("copy the file itself on to the stick")
        };
        // Neither a link nor what waits for ever, as a pipe does.
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = openat(&self.folder, name, flags, Mode::empty())
            .map_err(|e| refused(format!("cannot open the file: {e}")))?;
        let stat = fstat(&file).map_err(|e| refused(format!("cannot open the file: {e}")))?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
            return Err(refused("not a file".to_owned()));
        }
        Ok(file.into())
    }

    /// The contents of a file of at most so many bytes, whose signature is right if a key is set.
    pub fn read(&self, name: &str, bytes_max: u64) -> Result<Vec<u8>> {
        let bytes = self.read_unsigned(name, bytes_max)?;
        if let Some(key) = &self.key {
            let refused = |why: String| {
                Error::configuration(format!("the signature is not right: {why}"))
                    .in_file(&self.path.join(name))
                    .allowed("files signed for import.public_key of the configuration in force")
                    .remedy(format!("sign it: minisign -S -m {name}"))
            };
            let signature = self
                .read_unsigned(&format!("{name}.{SIGNATURE}"), TEXT_BYTES_MAX)
                .map_err(|_| refused(format!("{name}.{SIGNATURE} is not there")))?;
            let signature = Signature::decode(&String::from_utf8_lossy(&signature));
            let signature = signature.map_err(|e| refused(e.to_string()))?;
            key.verify(&bytes, &signature, false).map_err(|e| refused(e.to_string()))?;
        }
        Ok(bytes)
    }

    fn read_unsigned(&self, name: &str, bytes_max: u64) -> Result<Vec<u8>> {
        let path = self.path.join(name);
        let mut bytes = Vec::new();
        self.plain(name)?.take(bytes_max + 1).read_to_end(&mut bytes).map_err(|e| {
            Error::failure(format!("cannot read the file: {e}"))
                .in_file(&path)
                .remedy("the stick is damaged: use another")
        })?;
        if bytes.len() as u64 > bytes_max {
            return Err(Error::configuration("the file is too large")
                .in_file(&path)
                .allowed(format!("{bytes_max} bytes")));
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

    /// Names of the files that are no signatures, in order.
    pub fn names(&self) -> Result<Vec<String>> {
        let unreadable = |e: rustix::io::Errno| {
            Error::failure(format!("cannot list the folder: {e}")).in_file(&self.path)
        };
        let mut names = Vec::new();
        for entry in Dir::read_from(&self.folder).map_err(unreadable)?.take(ENTRIES_MAX) {
            let entry = entry.map_err(unreadable)?;
            let Ok(name) = entry.file_name().to_str() else { continue };
            let signature = Path::new(name).extension().is_some_and(|e| e == SIGNATURE);
            if !name.starts_with('.') && !signature {
                names.push(name.to_owned());
            }
        }
        names.sort();
        Ok(names)
    }

    /// Leave a report, if the stick can be written; never through a link.
    pub fn leave(&self, name: &str, report: &str) {
        let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
        let mode = Mode::from_raw_mode(0o644);
        let _ = unlinkat(&self.folder, name, rustix::fs::AtFlags::empty());
        let left = openat(&self.folder, name, flags, mode)
            .map_err(std::io::Error::from)
            .and_then(|file| File::from(file).write_all(report.as_bytes()));
        if let Err(e) = left {
            tracing::info!("no report is left on the stick: {e}");
        }
    }
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
        let stick = Stick::open(&root, None).expect("there");
        assert_eq!(stick.read("good", 4).expect("fits"), b"good");
        for (name, part) in [
            ("link", "cannot open"),
            ("folder", "not a file"),
            ("pipe", "not a file"),
            ("large", "too large"),
            ("missing", "cannot open"),
            ("../good", "cannot open"),
        ] {
            let error = stick.read(name, 4096).expect_err(name).to_string();
            assert!(error.contains(part), "{name}: {error}");
        }
        assert!(stick.read_text("latin1").expect_err("no UTF-8").to_string().contains("UTF-8"));
        assert!(stick.folder("folder-link").is_none() && stick.folder("folder").is_some());
        assert!(Stick::open(&root.join("nowhere"), None).is_err());
    }

    #[test]
    fn a_report_is_not_written_through_a_link() {
        let root = root("report");
        let victim = root.join("victim");
        std::fs::write(&victim, "untouched").expect("room");
        symlink(&victim, root.join(FOLDER).join("report.txt")).expect("room");
        Stick::open(&root, None).expect("there").leave("report.txt", "well done");
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
