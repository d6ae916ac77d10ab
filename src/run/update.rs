//! `beltgauge update`: a new system from a USB stick into the boot partition, beside the running one.
//!
//! The boot loader (systemd-boot) counts its trials by the name: `beltgauge-2+3.efi` is tried three
//! times; `+3` is taken off once it works. When it does not, `beltgauge-1.efi` is started again.

use crate::error::{Error, Result};
use crate::store::stick::{Stick, UPDATE_REPORT};
use crate::store::{Locked, Store, files};
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Name of the system on the stick.
pub(super) const IMAGE: &str = "beltgauge.efi";
/// Largest system: two of them fit the boot partition.
const IMAGE_BYTES_MAX: u64 = 60 << 20;
/// How often a new system is tried.
const TRIALS: u32 = 3;
/// What a file takes beside its bytes: parts of a cluster, the folder's growth.
const SPARE_BYTES: u64 = 128 << 10;
/// Machine types of PE files (Microsoft's PE format, 3.3.1).
const MACHINE: u16 = if cfg!(target_arch = "aarch64") { 0xaa64 } else { 0x8664 };

/// Put the system that is in the folder `beltgauge` of `root` into `to`, to be tried at the next start.
/// The one that works stays; others go, once the new one is there. What came of it is left on the stick.
pub fn update(root: &Path, store: &Store, to: &Path) -> Result<String> {
    let mut stick = Stick::open(root)?;
    let locked = store.lock()?;
    let result = take(&mut stick, &locked, to);
    let said = match &result {
        Ok(said) => said.clone(),
        Err(e) => format!("Refused; the system stays as it is.\nerror: {e}\n"),
    };
    stick.leave(UPDATE_REPORT, said.as_bytes());
    result
}

fn take(stick: &mut Stick, locked: &Locked<'_>, to: &Path) -> Result<String> {
    stick.check_name()?;
    let mut trust = locked.store().trust()?;
    stick.seal(&mut trust)?;
    let image = stick.read(IMAGE, IMAGE_BYTES_MAX)?;
    if machine(&image) != Some(MACHINE) {
        return Err(Error::configuration("not a system for this board")
            .in_file(&stick.path().join(IMAGE))
            .allowed(format!("beltgauge-{}.efi of board/build", std::env::consts::ARCH)));
    }
    let failed = |e: std::io::Error| {
        Error::failure(format!("the new system cannot be written: {e}"))
            .in_file(to)
            .remedy("the boot partition needs room for two systems")
    };
    remove_halves(to).map_err(failed)?;
    let systems = systems(to).map_err(failed)?;
    // A stick that stays plugged in must not be an update at every start.
    let same = |system: &&System| has_contents(&system.path, &image).unwrap_or(false);
    if let Some(system) = systems.iter().find(same) {
        let place = system.path.display();
        return if system.is_tried_out {
            Err(Error::configuration("this system was tried before and did not work")
                .in_file(&system.path)
                .remedy("build another; to try the same again, remove that file at the console"))
        } else {
            Ok(format!("it is there already, as {place}.\n"))
        };
    }
    let (kept, others) = keep(systems);
    let to_remove_first = too_many(to, &others, image.len() as u64).map_err(failed)?;
    locked.keep(&trust)?;
    for system in &others[..to_remove_first] {
        fs::remove_file(&system.path).map_err(failed)?;
    }
    let last = others.iter().chain(&kept).map(|system| system.number).max().unwrap_or(0);
    let name = format!("beltgauge-{}+{TRIALS}.efi", last + 1);
    files::replace(&to.join(&name), &image).map_err(failed)?;
    for system in &others[to_remove_first..] {
        fs::remove_file(&system.path).map_err(failed)?;
    }
    Ok(format!("{name} is tried at the next start.\n"))
}

/// The system that is started when the new one does not work, and the others, the least useful first.
fn keep(mut systems: Vec<System>) -> (Option<System>, Vec<System>) {
    systems.sort_by_key(|system| (!system.on_trial, !system.is_tried_out, system.number));
    let kept = systems.pop();
    (kept, systems)
}

/// How many of the others must go before there is room for the new one.
fn too_many(to: &Path, others: &[System], bytes: u64) -> std::io::Result<usize> {
    let disk = rustix::fs::statvfs(to)?;
    let mut free = disk.f_bavail * disk.f_frsize;
    let needed = bytes + SPARE_BYTES;
    for (count, system) in others.iter().enumerate() {
        if free >= needed {
            return Ok(count);
        }
        free += fs::metadata(&system.path)?.len();
    }
    if free >= needed {
        return Ok(others.len());
    }
    let what = format!("{free} bytes could be free, and it needs {needed}");
    Err(std::io::Error::new(std::io::ErrorKind::StorageFull, what))
}

/// Remove what an update that was cut off left.
fn remove_halves(folder: &Path) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == files::NEW) {
            files::remove(&path)?;
        }
    }
    Ok(())
}

/// Whether a file has these contents, without holding them twice.
fn has_contents(path: &Path, bytes: &[u8]) -> std::io::Result<bool> {
    let mut file = files::open(rustix::fs::CWD, path)?;
    if file.metadata()?.len() != bytes.len() as u64 {
        return Ok(false);
    }
    let mut part = vec![0; 1 << 20];
    for expected in bytes.chunks(part.len()) {
        let part = &mut part[..expected.len()];
        file.read_exact(part)?;
        if part != expected {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The machine that a PE file is for.
fn machine(image: &[u8]) -> Option<u16> {
    let at = image.get(0x3c..0x40).filter(|_| image.starts_with(b"MZ"))?;
    let at = u32::from_le_bytes(at.try_into().ok()?) as usize;
    let header = image.get(at..at.checked_add(6)?)?;
    header.starts_with(b"PE\0\0").then(|| u16::from_le_bytes([header[4], header[5]]))
}

struct System {
    path: PathBuf,
    number: u64,
    /// It has a counter of trials in its name.
    on_trial: bool,
    /// Its trials are used up.
    is_tried_out: bool,
}

fn systems(folder: &Path) -> std::io::Result<Vec<System>> {
    let mut systems = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let Some(rest) = name.strip_prefix("beltgauge-").and_then(|n| n.strip_suffix(".efi"))
        else {
            continue;
        };
        let (number, trials) = rest.split_once('+').map_or((rest, None), |(n, t)| (n, Some(t)));
        let on_trial = trials.is_some();
        // "+LEFT-DONE".
        let is_tried_out = trials.is_some_and(|trials| trials.split('-').next() == Some("0"));
        if let Ok(number) = number.parse() {
            systems.push(System { path, number, on_trial, is_tried_out });
        }
    }
    Ok(systems)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pe(machine: u16) -> Vec<u8> {
        let mut image = vec![0; 0x100];
        image[..2].copy_from_slice(b"MZ");
        image[0x3c] = 0x80;
        image[0x80..0x84].copy_from_slice(b"PE\0\0");
        image[0x84..0x86].copy_from_slice(&machine.to_le_bytes());
        image
    }

    /// A stick's image, a folder as the boot partition, and a store.
    fn place(name: &str, old: &[&str]) -> (PathBuf, PathBuf, Store) {
        let root =
            std::env::temp_dir().join(format!("beltgauge-update-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&root);
        let (stick, boot) = (root.join("stick"), root.join("boot"));
        fs::create_dir_all(stick.join("beltgauge")).expect("room");
        fs::create_dir_all(&boot).expect("room");
        for old in old {
            fs::write(boot.join(old), old).expect("room");
        }
        fs::write(stick.join("beltgauge").join(IMAGE), pe(MACHINE)).expect("room");
        (stick, boot, Store::new(&root.join("store")))
    }

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(folder)
            .expect("there")
            .map(|entry| entry.expect("readable").file_name().into_string().expect("UTF-8"))
            .collect();
        names.sort();
        names
    }

    #[test]
    fn the_new_system_is_on_trial_beside_the_one_that_works() {
        let old = [
            "beltgauge-1.efi",
            "beltgauge-3.efi",
            "beltgauge-4+0-3.efi",
            "beltgauge-x.efi",
            "beltgauge-5+3.efi.new",
        ];
        let (stick, boot, store) = place("trial", &old);
        let image = stick.join("beltgauge").join(IMAGE);
        for (bytes, fits) in [(vec![], false), (pe(0x1234), false), (pe(MACHINE), true)] {
            fs::write(&image, bytes).expect("room");
            assert_eq!(update(&stick, &store, &boot).is_ok(), fits);
            let report =
                fs::read_to_string(stick.join("beltgauge").join(UPDATE_REPORT)).expect("left");
            assert_eq!(report.starts_with("Refused"), !fits, "{report}");
        }
        assert_eq!(names(&boot), ["beltgauge-3.efi", "beltgauge-5+3.efi", "beltgauge-x.efi"]);
        let again = update(&stick, &store, &boot).expect("fits");
        assert!(
            again.contains("there already") && !boot.join("beltgauge-6+3.efi").exists(),
            "{again}"
        );
        fs::rename(boot.join("beltgauge-5+3.efi"), boot.join("beltgauge-5+0-3.efi")).expect("room");
        let error = update(&stick, &store, &boot).expect_err("was tried").to_string();
        assert!(error.contains("did not work") && error.contains("beltgauge-5+0-3.efi"), "{error}");
        fs::rename(boot.join("beltgauge-5+0-3.efi"), boot.join("beltgauge-5+3.efi")).expect("room");
        assert_eq!(fs::read(boot.join("beltgauge-5+3.efi")).expect("there"), pe(MACHINE));
    }

    #[test]
    fn the_only_system_is_never_removed() {
        let systems = |names: &[&str]| -> Vec<System> {
            let (_, boot, _) = place("only", names);
            systems(&boot).expect("readable")
        };
        for (names, best) in [
            (&["beltgauge-3.efi", "beltgauge-4+2-1.efi"][..], 3),
            (&["beltgauge-4+2-1.efi", "beltgauge-5+0-3.efi"], 4),
            (&["beltgauge-5+0-3.efi"], 5),
            (&["beltgauge-1.efi", "beltgauge-2.efi"], 2),
        ] {
            let (kept, others) = keep(systems(names));
            assert_eq!(kept.map(|system| system.number), Some(best), "{names:?}");
            assert_eq!(others.len(), names.len() - 1);
        }
    }

    #[test]
    fn only_as_many_go_first_as_the_disk_asks_for() {
        let names = ["beltgauge-3.efi", "beltgauge-4+2-1.efi"];
        let (_, boot, _) = place("full", &names);
        let (_, others) = keep(systems(&boot).expect("readable"));
        assert_eq!(too_many(&boot, &others, 1).expect("room"), 0);
        let error = too_many(&boot, &others, u64::MAX >> 1).expect_err("no disk is so large");
        assert_eq!(error.kind(), std::io::ErrorKind::StorageFull);
    }
}
