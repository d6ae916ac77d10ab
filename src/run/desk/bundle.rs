//! What a support bundle says of this machine: configuration, calibration, memory, what the archive has.
//!
//! No secret is in it: a configuration names the files of passwords and keys, and their contents are
//! never read here.

use crate::archive::{Kind, Reader, Stored};
use crate::camera::{Camera, CameraFile};
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use crate::run::memory;
use crate::store::files;
use crate::web::{BundleFile, BundleFiles};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A file on the disk that is larger is left out.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Entries of the archive that are looked through, from the newest on.
const ENTRIES_MAX: usize = 2000;
/// Of them so many are looked at in one go.
const PAGE: usize = 100;
/// Events, and parcels that must not be used, that are taken of them.
const EVENTS_MAX: usize = 500;
const DOUBTED_MAX: usize = 40;

const ABOUT: &str = "\
A support bundle of Beltgauge: what a person elsewhere needs to see what is wrong.

about.txt           this text
state.json          lamps, reasons, counters, camera and belt health, as the page shows them
plc.json            every register with its value, connected clients
events.json         events since start, oldest first (the last 300)
parcels.csv         parcels since start, oldest first (the last 200)
configuration.toml  the configuration in force, with the defaults
camera.toml         lens and pose in force
memory.txt          the memory plan
process.txt         memory and threads of the process, as the kernel tells
machine.txt         memory of the machine, as the kernel tells
calibration/        the calibration's file and its report
archive/events.jsonl   events of the archive, newest first (the last 500 of 2000 entries)
archive/doubted.jsonl  parcels of the archive whose sizes must not be used, newest first (the last 40)
archive/ENTRY.jpg      their pictures
contents.txt        what is in this bundle, what is left out and why

Left out on purpose: passwords and secret keys. The configuration names the file of the login for the fleet's
broker; what is in that file is not here.
";

/// What does not change while the machine runs.
#[derive(Clone, Debug, Default)]
pub struct Papers {
    camera: String,
    memory: String,
}

impl Papers {
    /// Of a site.
    pub fn of(site: &Site) -> Result<Self> {
        Ok(Self { camera: in_force(&site.camera)?, memory: format!("{}\n", memory::plan(site)) })
    }
}

/// A camera as a file has it.
fn in_force(camera: &Camera) -> Result<String> {
    toml::to_string(&CameraFile::from(camera)).map_err(|e| Error::failure(format!("no TOML: {e}")))
}

/// The files, each made when it is asked for.
pub fn files(config: &Config, papers: &Papers) -> BundleFiles {
    let about = format!(
        "{ABOUT}\nBeltgauge {} for {}-{}, on {} processors.\n",
        env!("CARGO_PKG_VERSION"),
        std::env::consts::ARCH,
        std::env::consts::OS,
        std::thread::available_parallelism().map_or(0, usize::from),
    );
    let configuration = toml::to_string(config).map_err(|e| e.to_string());
    let texts = [
        ("about.txt", Ok(about)),
        ("configuration.toml", configuration),
        ("camera.toml", Ok(papers.camera.clone())),
        ("memory.txt", Ok(papers.memory.clone())),
    ];
    let texts = texts.map(|(name, text)| file(name, text.map(String::into_bytes)));
    let of_kernel = [("process.txt", "/proc/self/status"), ("machine.txt", "/proc/meminfo")];
    let of_kernel = of_kernel.into_iter().map(|(name, path)| file(name, read(Path::new(path))));
    let (calibration, camera) = (config.camera.calibration.clone(), papers.camera.clone());
    let calibration = std::iter::once_with(move || calibrated(&calibration, &camera)).flatten();
    let folder = config.archive.folder.clone();
    let archived = folder.into_iter().flat_map(archived);
    Box::new(texts.into_iter().chain(of_kernel).chain(calibration).chain(archived))
}

fn file(name: &str, bytes: std::result::Result<Vec<u8>, String>) -> BundleFile {
    BundleFile { name: name.to_owned(), bytes }
}

fn read(path: &Path) -> std::result::Result<Vec<u8>, String> {
    files::read(path, FILE_BYTES_MAX).map_err(|e| format!("{}: {e}", path.display()))
}

/// The calibration's file and its report. The file may have been changed since the start: then neither
/// belongs to the camera in force, and both are left out.
fn calibrated(path: &Path, camera: &str) -> [BundleFile; 2] {
    let is_in_force = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes);
        let written = CameraFile::parse(&text).and_then(CameraFile::into_camera);
        written.is_ok_and(|written| in_force(&written).is_ok_and(|text| text == camera))
    };
    let other = || "it is not that of the camera in force".to_owned();
    let toml =
        read(path).and_then(|bytes| if is_in_force(&bytes) { Ok(bytes) } else { Err(other()) });
    let html = match &toml {
        Ok(_) => read(&path.with_extension("html")),
        Err(_) => Err("it goes with camera.toml".to_owned()),
    };
    [file("calibration/camera.toml", toml), file("calibration/camera.html", html)]
}

/// What was noted of the archive, before its pictures.
#[derive(Default)]
struct Noted {
    events: String,
    doubted: String,
    events_count: usize,
    /// Entries of parcels that must not be used.
    numbers: Vec<u64>,
    /// Each once, however many pages tell it.
    unread: BTreeSet<String>,
}

fn archived(folder: PathBuf) -> BundleFiles {
    match noted(&folder) {
        Err(e) => Box::new(std::iter::once(file("archive", Err(e.to_string())))),
        Ok(Noted { events, doubted, numbers, unread, .. }) => {
            let unread = unread.into_iter().map(|why| file("archive", Err(why)));
            let lists = [("events", events), ("doubted", doubted)];
            let lists =
                lists.map(|(name, text)| file(&format!("archive/{name}.jsonl"), Ok(text.into())));
            let pictures = numbers.into_iter().map(move |number| {
                let picture = picture(&folder, number);
                file(&format!("archive/{number:08}.jpg"), picture)
            });
            Box::new(lists.into_iter().chain(unread).chain(pictures))
        }
    }
}

fn noted(folder: &Path) -> Result<Noted> {
    let reader = Reader::open(folder)?;
    let (mut noted, mut before) = (Noted::default(), None);
    for _ in 0..ENTRIES_MAX / PAGE {
        let page = reader.before(before, PAGE)?;
        page.entries.iter().for_each(|stored| noted.take(stored));
        noted.unread.extend(page.unread);
        before = page.entries.last().map(|oldest| oldest.number);
        if page.entries.len() < PAGE {
            break;
        }
    }
    Ok(noted)
}

impl Noted {
    fn take(&mut self, stored: &Stored) {
        let line = |into: &mut String| {
            into.push_str(&stored.json());
            into.push('\n');
        };
        if stored.entry.kind != Kind::Parcel {
            if self.events_count < EVENTS_MAX {
                self.events_count += 1;
                line(&mut self.events);
            }
        } else if self.numbers.len() < DOUBTED_MAX {
            let what: serde_json::Value =
                serde_json::from_str(&stored.entry.text).unwrap_or_default();
            if what["may_be_used"] != true {
                self.numbers.push(stored.number);
                line(&mut self.doubted);
            }
        }
    }
}

fn picture(folder: &Path, number: u64) -> std::result::Result<Vec<u8>, String> {
    let stored = Reader::open(folder).and_then(|reader| reader.entry(number));
    let picture = stored.map_err(|e| e.to_string())?.map(|stored| stored.entry.picture);
    picture.filter(|jpeg| !jpeg.is_empty()).ok_or_else(|| "there is no picture of it".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::{Archive, Entry};
    use crate::run::desk::Insight;
    use crate::web::Machine;
    use std::collections::BTreeMap;
    use std::fs;
    use std::time::Duration;

    const CALIBRATION: &str = include_str!("../../../config/example/camera.toml");

    /// A folder with a login and an archive; the configuration that names them.
    fn site(name: &str, entries: Vec<Entry>) -> (PathBuf, Config) {
        let folder =
            std::env::temp_dir().join(format!("beltgauge-bundle-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        let archive = Archive::start(&folder.join("archive"), 64 << 20).expect("starts");
        for entry in entries {
            let before = archive.condition().written;
            archive.put(entry);
            while archive.condition().written == before {
                std::thread::yield_now();
            }
        }
        archive.finish(Duration::from_secs(30));
        fs::write(folder.join("login"), "operator\nopen sesame\n").expect("room");
        fs::write(folder.join("camera.toml"), CALIBRATION).expect("room");
        let mut config = crate::run::desk::insight::tests::config();
        config.fleet.login_file = Some(folder.join("login"));
        config.archive.folder = Some(folder.join("archive"));
        config.camera.calibration = folder.join("camera.toml");
        (folder, config)
    }

    fn parcel(seq: usize, may_be_used: bool) -> Entry {
        let text = format!("{{\"seq\":{seq},\"may_be_used\":{may_be_used}}}");
        Entry { kind: Kind::Parcel, utc_ms: 1, text, picture: format!("jpeg {seq}").into() }
    }

    fn event(code: usize) -> Entry {
        let text = format!("{{\"kind\":\"began\",\"code\":{code},\"detail\":\"\"}}");
        Entry { kind: Kind::Event, utc_ms: 1, text, picture: Vec::new() }
    }

    fn by_name(files: BundleFiles) -> BTreeMap<String, std::result::Result<Vec<u8>, String>> {
        files.map(|file| (file.name, file.bytes)).collect()
    }

    #[test]
    fn it_has_what_service_needs_and_no_secret() {
        let entries = vec![event(1), parcel(1, true), parcel(2, false), event(2)];
        let (folder, config) = site("whole", entries);
        fs::write(folder.join("camera.html"), "the report").expect("room");
        let camera = CameraFile::parse(CALIBRATION).and_then(CameraFile::into_camera);
        let camera = in_force(&camera.expect("an example")).expect("TOML");
        let papers = Papers { camera, memory: "plan".into() };
        let found = by_name(files(&config, &papers));
        let text =
            |name: &str| String::from_utf8_lossy(found[name].as_ref().expect("there")).into_owned();
        assert!(text("configuration.toml").contains("speed_mm_per_s = 500"));
        assert!(text("configuration.toml").contains("tracks_max"), "with the defaults");
        assert_eq!(text("calibration/camera.toml"), CALIBRATION);
        assert_eq!(text("calibration/camera.html"), "the report");
        assert!(text("process.txt").contains("VmRSS"));
        assert_eq!(text("archive/events.jsonl").lines().count(), 2);
        assert!(text("archive/doubted.jsonl").starts_with("{\"entry\":3,"));
        assert_eq!(text("archive/00000003.jpg"), "jpeg 2");
        assert!(!found.contains_key("archive/00000002.jpg"), "nobody doubts that one");
        for (name, bytes) in &found {
            let text = String::from_utf8_lossy(bytes.as_deref().unwrap_or_default());
            assert!(!text.contains("open sesame"), "{name} has the password");
            let folder = name.split('/').next().expect("a name");
            assert!(ABOUT.contains(name) || ABOUT.contains(&format!("{folder}/")), "{name}");
        }
        assert!(text("configuration.toml").contains("login"), "it names the file");

        // Another calibration has been put there, for the next start.
        let other = CALIBRATION.replacen("fx_px = ", "fx_px = 1", 1);
        fs::write(folder.join("camera.toml"), other).expect("room");
        let found = by_name(files(&config, &papers));
        let is_told = |why: &String| why.contains("not that of the camera in force");
        assert!(found["calibration/camera.toml"].as_ref().is_err_and(is_told));
        assert!(found["calibration/camera.html"].is_err());
        let _ = fs::remove_dir_all(folder);
    }

    #[test]
    fn of_a_long_archive_the_newest_are_taken() {
        let entries = (0..300).flat_map(|k| [event(k), parcel(k, k % 2 == 0)]).collect();
        let (folder, config) = site("long", entries);
        let found = by_name(files(&config, &Papers::default()));
        let pictures = found.keys().filter(|name| name.contains(".jpg")).count();
        assert_eq!(pictures, DOUBTED_MAX);
        assert!(found.contains_key("archive/00000600.jpg"), "the newest");
        assert_eq!(found["archive/00000600.jpg"].as_deref(), Ok(&b"jpeg 299"[..]));
        let _ = fs::remove_dir_all(folder);
    }

    #[test]
    fn what_cannot_be_read_of_the_archive_is_told_on_the_page_and_in_the_bundle() {
        let (folder, config) = site("unread", vec![event(1)]);
        // A folder opens and cannot be read, as a file on a bad sector.
        fs::create_dir(folder.join("archive/00000000000000000009.bga")).expect("room");
        let found = by_name(files(&config, &Papers::default()));
        let is_told = |why: &String| why.starts_with("00000000000000000009.bga: cannot be read");
        assert!(found["archive"].as_ref().is_err_and(is_told), "{found:?}");
        assert!(found["archive/events.jsonl"].as_ref().is_ok_and(|text| !text.is_empty()));
        let insight = Insight::new(config, Papers::default(), [0; 2], 4);
        let archived = insight.archived(None, 9).expect("the rest");
        assert!(archived.entries.len() == 1 && archived.unread.iter().all(is_told));
        assert_eq!(archived.unread.len(), 1);
        let _ = fs::remove_dir_all(folder);
    }

    #[test]
    fn an_archive_that_is_not_there_is_told() {
        let (folder, mut config) = site("none", Vec::new());
        config.archive.folder = Some(folder.join("elsewhere"));
        let found = by_name(files(&config, &Papers::default()));
        assert!(found["archive"].as_ref().is_err_and(|why| why.contains("there is no archive")));
        config.archive.folder = None;
        let found = by_name(files(&config, &Papers::default()));
        assert!(found.keys().all(|name| !name.starts_with("archive")));
        let _ = fs::remove_dir_all(folder);
    }
}
