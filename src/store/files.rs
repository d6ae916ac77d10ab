//! Files that are replaced whole, and files that are read from a stranger.

use rustix::fs::{AtFlags, FileType, Mode, OFlags, fstat, openat, unlinkat};
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

/// What a file or link is called until it takes its place.
pub const NEW: &str = "new";
/// Who may read a file that is made: everybody, or its owner alone.
const PUBLIC: u32 = 0o644;
const PRIVATE: u32 = 0o600;

/// Replace a file in one step: a power cut leaves the old one or the new one, whole and on the disk.
/// An error leaves the old one.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_as(PUBLIC, path, bytes)
}

/// The same of a file that nobody but its owner may read.
pub fn replace_private(path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_as(PRIVATE, path, bytes)
}

fn replace_as(mode: u32, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let new = beside(path)?;
    let written = create_as(mode, rustix::fs::CWD, &new, bytes)
        .and_then(|file| file.sync_all())
        .and_then(|()| fs::rename(&new, path));
    if written.is_err() {
        let _ = remove(&new);
    }
    written.and_then(|()| sync_folder_of(path))
}

/// Make a link point elsewhere, in one step.
pub fn point(link: &Path, target: &Path) -> io::Result<()> {
    let new = beside(link)?;
    symlink(target, &new)?;
    fs::rename(&new, link)?;
    sync_folder_of(link)
}

/// A free name in the same folder. What a power cut left there is gone.
fn beside(path: &Path) -> io::Result<PathBuf> {
    let mut new = path.as_os_str().to_owned();
    new.push(".");
    new.push(NEW);
    let new = PathBuf::from(new);
    remove(&new).map(|()| new)
}

/// Write a new file. Never through a link; a file that was there is taken away.
/// On an error there is none, rather than half of one.
pub fn create(folder: impl AsFd, name: &Path, bytes: &[u8]) -> io::Result<File> {
    create_as(PUBLIC, folder, name, bytes)
}

fn create_as(mode: u32, folder: impl AsFd, name: &Path, bytes: &[u8]) -> io::Result<File> {
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
    let _ = unlinkat(&folder, name, AtFlags::empty());
    let mut file = File::from(openat(&folder, name, flags, Mode::from_raw_mode(mode))?);
    let written = file.write_all(bytes);
    if written.is_err() {
        let _ = unlinkat(&folder, name, AtFlags::empty());
    }
    written.map(|()| file)
}

/// Remove a file or folder, if it is there.
pub fn remove(path: &Path) -> io::Result<()> {
    let removed = match fs::symlink_metadata(path) {
        Ok(metadata) if metadata.is_dir() => fs::remove_dir_all(path),
        _ => fs::remove_file(path),
    };
    removed.or_else(|e| if e.kind() == ErrorKind::NotFound { Ok(()) } else { Err(e) })
}

/// Bring the names in a folder to the disk.
pub fn sync(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

fn sync_folder_of(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    sync(folder.unwrap_or(Path::new(".")))
}

/// Open a plain file of a folder: no link, and nothing that waits for ever, as a pipe does.
pub fn open(folder: impl AsFd, name: &Path) -> io::Result<File> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = openat(folder, name, flags, Mode::empty())?;
    if FileType::from_raw_mode(fstat(&file)?.st_mode) != FileType::RegularFile {
        return Err(io::Error::new(ErrorKind::InvalidInput, "not a plain file"));
    }
    Ok(file.into())
}

/// The contents of a plain file, of at most so many bytes.
pub fn read(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    read_open(&open(rustix::fs::CWD, path)?, bytes_max)
}

/// The same of one that is open.
pub fn read_open(file: &File, bytes_max: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.take(bytes_max + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        let what = format!("too large: up to {bytes_max} bytes are allowed");
        return Err(io::Error::new(ErrorKind::FileTooLarge, what));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> PathBuf {
        let folder =
            std::env::temp_dir().join(format!("beltgauge-files-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("room");
        folder
    }

    #[test]
    fn a_file_is_replaced_whatever_lies_in_the_way() {
        let folder = folder("replace");
        let (path, new) = (folder.join("file"), folder.join("file.new"));
        let victim = folder.join("victim");
        fs::write(&victim, "untouched").expect("room");
        replace(&path, b"1").expect("room");
        fs::write(&new, "ha").expect("room");
        replace(&path, b"2").expect("half a file goes");
        fs::create_dir(&new).expect("room");
        replace(&path, b"3").expect("a folder goes");
        symlink(&victim, &new).expect("room");
        replace(&path, b"4").expect("a link goes");
        assert_eq!(fs::read(&path).expect("there"), b"4");
        assert_eq!(fs::read(&victim).expect("there"), b"untouched");
        symlink(&victim, folder.join("link")).expect("room");
        replace(&folder.join("link"), b"5").expect("the link itself is replaced");
        assert_eq!(fs::read(&victim).expect("there"), b"untouched");
    }

    #[test]
    fn a_private_file_is_its_owners_alone() {
        use std::os::unix::fs::PermissionsExt;
        let path = folder("private").join("file");
        for _ in 0..2 {
            replace_private(&path, b"1").expect("room");
            let mode = fs::metadata(&path).expect("there").permissions().mode();
            assert_eq!(mode & 0o077, 0);
        }
    }

    #[test]
    fn what_cannot_be_replaced_stays_and_leaves_nothing_behind() {
        let folder = folder("stays");
        let path = folder.join("file");
        fs::create_dir(&path).expect("room");
        replace(&path, b"1").expect_err("a folder is in its place");
        assert!(path.is_dir() && !folder.join("file.new").exists());
    }

    #[test]
    fn only_plain_files_of_bounded_size_are_read() {
        let folder = folder("read");
        fs::write(folder.join("file"), "1234").expect("room");
        symlink("file", folder.join("link")).expect("room");
        let pipe = std::process::Command::new("mkfifo").arg(folder.join("pipe")).status();
        assert!(pipe.is_ok_and(|status| status.success()));
        assert_eq!(read(&folder.join("file"), 4).expect("plain"), b"1234");
        for (path, part) in [
            (folder.join("file"), ""),
            (folder.join("link"), ""),
            (folder.join("pipe"), "not a plain file"),
            (folder.clone(), "not a plain file"),
            (PathBuf::from("/dev/zero"), "not a plain file"),
        ] {
            let error = read(&path, 3).expect_err("refused").to_string();
            assert!(error.contains(part), "{}: {error}", path.display());
        }
    }
}
