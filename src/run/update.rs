//! `beltgauge update`: a new system from a USB stick into the boot partition, beside the running one.
//!
//! The boot loader (systemd-boot) counts its trials by the name: `beltgauge-2+3.efi` is tried three
//! times; `+3` is taken off once it works. When it does not, `beltgauge-1.efi` is started again.

use super::import::key_in_force;
use crate::config::stick::Stick;
use crate::config::store::Store;
use crate::error::{Error, Result};
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// Name of the system on the stick.
const IMAGE: &str = "beltgauge.efi";
/// Largest system: two of them fit the boot partition.
const IMAGE_BYTES_MAX: u64 = 60 << 20;
/// How often a new system is tried.
const TRIALS: u32 = 3;
/// Machine types of PE files (Microsoft's PE format, 3.3.1).
const MACHINE: u16 = if cfg!(target_arch = "aarch64") { 0xaa64 } else { 0x8664 };

/// Put the system that is in the folder `beltgauge` of `root` into `to`, to be tried at the next start.
/// The one that runs stays; others go.
pub fn update(root: &Path, store: &Store, to: &Path) -> Result<String> {
    let stick = Stick::open(root, key_in_force(store)?)?;
    let image = stick.read(IMAGE, IMAGE_BYTES_MAX)?;
    if machine(&image) != Some(MACHINE) {
        return Err(Error::configuration("not a system for this board")
            .in_file(&root.join("beltgauge").join(IMAGE))
            .allowed(format!("beltgauge-{}.efi of board/build", std::env::consts::ARCH)));
    }
    let failed = |e: std::io::Error| {
        Error::failure(format!("the new system cannot be written: {e}"))
            .in_file(to)
            .remedy("the boot partition needs room for two systems")
    };
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
    let kept = systems.iter().filter(|s| !s.on_trial).max_by_key(|s| s.number);
    let kept_path = kept.map(|system| &system.path);
    for system in systems.iter().filter(|system| Some(&system.path) != kept_path) {
        fs::remove_file(&system.path).map_err(failed)?;
    }
    let number = 1 + systems.iter().map(|system| system.number).max().unwrap_or(0);
    let name = format!("beltgauge-{number}+{TRIALS}.efi");
    let new = to.join("new.tmp");
    let written = File::create(&new).and_then(|mut file| {
        file.write_all(&image)?;
        file.sync_all()?;
        fs::rename(&new, to.join(&name))?;
        File::open(to)?.sync_all()
    });
    written.map_err(failed)?;
    Ok(format!("{name} is tried at the next start.\n"))
}

/// Whether a file has these contents, without holding them twice.
fn has_contents(path: &Path, bytes: &[u8]) -> std::io::Result<bool> {
    let mut file = File::open(path)?;
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

    #[test]
    fn the_new_system_is_on_trial_beside_the_one_that_works() {
        let root = std::env::temp_dir().join(format!("beltgauge-update-{}", std::process::id()));
        let _ = fs::remove_dir_all(&root);
        let (stick, boot) = (root.join("stick"), root.join("boot"));
        fs::create_dir_all(stick.join("beltgauge")).expect("room");
        fs::create_dir_all(&boot).expect("room");
        let store = Store::new(&root.join("store"));
        for old in ["beltgauge-1.efi", "beltgauge-3.efi", "beltgauge-4+0-3.efi", "beltgauge-x.efi"]
        {
            fs::write(boot.join(old), old).expect("room");
        }
        let image = stick.join("beltgauge").join(IMAGE);
        for (bytes, fits) in [(vec![], false), (pe(0x1234), false), (pe(MACHINE), true)] {
            fs::write(&image, bytes).expect("room");
            assert_eq!(update(&stick, &store, &boot).is_ok(), fits);
        }
        let mut names: Vec<_> = fs::read_dir(&boot)
            .expect("there")
            .map(|entry| entry.expect("readable").file_name().into_string().expect("UTF-8"))
            .collect();
        names.sort();
        assert_eq!(names, ["beltgauge-3.efi", "beltgauge-5+3.efi", "beltgauge-x.efi"]);
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
}
