//! `beltgauge archive`: what was seen, listed, exported, verified.

use crate::archive::{Kind, Reader, Stored};
use crate::error::{Error, Result};
use crate::event::{clock, csv as columns};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Where an export goes; none of them: nowhere.
#[derive(Clone, Copy, Debug, Default)]
pub struct Export<'a> {
    /// A line of CSV for each parcel.
    pub csv: Option<&'a Path>,
    /// A line of JSON for each entry.
    pub jsonl: Option<&'a Path>,
    /// Folder for the pictures.
    pub pictures: Option<&'a Path>,
}

/// The last entries, newest first, and what of them cannot be read.
pub fn list(folder: &Path, last: usize) -> Result<String> {
    let mut text = String::new();
    let page = Reader::open(folder)?.before(None, last)?;
    for stored in page.entries {
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "{:8}  {}  {}",
            stored.number,
            clock::utc(stored.entry.utc_ms),
            line(&stored)
        );
    }
    for unread in page.unread {
        let _ = writeln!(text, "warning: {unread}");
    }
    Ok(text)
}

fn line(stored: &Stored) -> String {
    let what: serde_json::Value = serde_json::from_str(&stored.entry.text).unwrap_or_default();
    let mm = |name: &str| what[name].as_f64().unwrap_or(f64::NAN);
    let word = |name: &str| what[name].as_str().unwrap_or_default().to_owned();
    match stored.entry.kind {
        Kind::Parcel if !what["not_measured"].is_null() => {
            format!("parcel #{} not measured: {}", what["seq"], word("not_measured"))
        }
        Kind::Parcel => {
            let flags = what["flags"].as_array().map(Vec::as_slice).unwrap_or_default();
            let flags: Vec<&str> = flags.iter().filter_map(|flag| flag.as_str()).collect();
            format!(
                "parcel #{} {:.1} x {:.1} x {:.1} mm {}",
                what["seq"],
                mm("length_mm"),
                mm("width_mm"),
                mm("height_mm"),
                flags.join(", ")
            )
        }
        Kind::Event => format!("{} {} {}", word("kind"), what["code"], word("detail")),
        Kind::Gap if !what["damaged"].is_null() => {
            let lost = &what["lost"];
            format!(
                "{} is damaged: entries in it are missing; {lost} more were lost",
                word("damaged")
            )
        }
        Kind::Gap => format!("{} entries were lost: the disk did not take them", what["lost"]),
    }
}

/// Write entries where other programs read them; returns what was done.
pub fn export(folder: &Path, to: Export<'_>) -> Result<String> {
    if to.csv.is_none() && to.jsonl.is_none() && to.pictures.is_none() {
        return Err(Error::configuration("nothing to export to")
            .allowed("--csv FILE, --jsonl FILE, --pictures DIR, any of them")
            .remedy("give at least one"));
    }
    let reader = Reader::open(folder)?;
    for (option, path) in [("--csv", to.csv), ("--jsonl", to.jsonl), ("--pictures", to.pictures)] {
        path.map_or(Ok(()), |path| refuse_inside(option, path, folder))?;
    }
    let mut csv = to.csv.map(Lines::create).transpose()?;
    let mut jsonl = to.jsonl.map(Lines::create).transpose()?;
    if let Some(csv) = &mut csv {
        csv.write(&columns::header("entry"))?;
    }
    if let Some(pictures) = to.pictures {
        std::fs::create_dir_all(pictures).map_err(|e| unwritable(&e, pictures))?;
    }
    let (mut parcels, mut pictures) = (0u64, 0u64);
    let verdict = reader.each(|stored| {
        let is_parcel = stored.entry.kind == Kind::Parcel;
        parcels += u64::from(is_parcel);
        if let Some(csv) = csv.as_mut().filter(|_| is_parcel) {
            let record = serde_json::from_str(&stored.entry.text).unwrap_or_default();
            csv.write(&columns::line(stored.number, stored.entry.utc_ms, &record))?;
        }
        if let Some(jsonl) = &mut jsonl {
            jsonl.write(&stored.json())?;
        }
        if let Some(folder) = to.pictures.filter(|_| !stored.entry.picture.is_empty()) {
            let path = folder.join(format!("{:08}.jpg", stored.number));
            std::fs::write(&path, &stored.entry.picture).map_err(|e| unwritable(&e, &path))?;
            pictures += 1;
        }
        Ok(())
    })?;
    for lines in [csv, jsonl].into_iter().flatten() {
        lines.finish()?;
    }
    let mut text = format!("{} entries, {parcels} of them parcels", verdict.entries);
    if to.pictures.is_some() {
        let _ = write!(text, ", {pictures} pictures");
    }
    for broken in verdict.broken {
        let _ = write!(text, "\nwarning: {broken}");
    }
    Ok(text)
}

/// Whether the archive is as it was written.
///
/// # Errors
/// Names every place where its chain is broken.
pub fn verify(folder: &Path) -> Result<String> {
    let verdict = Reader::open(folder)?.verify()?;
    if !verdict.broken.is_empty() {
        return Err(Error::failure(format!(
            "the archive's chain is broken:\n{}",
            verdict.broken.join("\n")
        ))
        .in_file(folder)
        .remedy("something was changed, taken out, or the disk is damaged: export what is left, replace the disk"));
    }
    let mut text = match (verdict.first, verdict.last) {
        (Some(first), Some(last)) => {
            format!("whole: {} entries, {first} to {last}", verdict.entries)
        }
        _ => "whole: no entries".to_owned(),
    };
    let sum = verdict.sum.iter().fold(String::new(), |mut hex, byte| {
        let _ = write!(hex, "{byte:02x}");
        hex
    });
    let _ = write!(text, "\nsum of the chain: {sum}");
    if verdict.told_lost > 0 {
        let _ = write!(text, "\n{} entries were lost and are told as lost", verdict.told_lost);
    }
    if verdict.torn_bytes > 0 {
        let _ =
            write!(text, "\n{} bytes were being written when the power went", verdict.torn_bytes);
    }
    Ok(text)
}

/// An export must not lie in the archive, nor over a part of it.
fn refuse_inside(option: &str, path: &Path, folder: &Path) -> Result<()> {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let places = [path, parent.unwrap_or(Path::new("."))];
    let archive = folder.canonicalize().ok();
    let is_inside = |place: &Path| {
        let place = place.canonicalize().ok();
        place.zip(archive.as_ref()).is_some_and(|(place, archive)| place.starts_with(archive))
    };
    if places.into_iter().any(is_inside) {
        return Err(Error::configuration(format!("{option} {} is in the archive", path.display()))
            .allowed("a place outside of it")
            .remedy("choose another one"));
    }
    Ok(())
}

fn unwritable(e: &std::io::Error, path: &Path) -> Error {
    Error::failure(format!("cannot write: {e}")).in_file(path)
}

/// A file of lines.
struct Lines<'a> {
    path: &'a Path,
    file: BufWriter<File>,
}

impl<'a> Lines<'a> {
    fn create(path: &'a Path) -> Result<Self> {
        let file = File::create(path).map_err(|e| unwritable(&e, path))?;
        Ok(Self { path, file: BufWriter::new(file) })
    }

    fn write(&mut self, line: &str) -> Result<()> {
        writeln!(self.file, "{line}").map_err(|e| unwritable(&e, self.path))
    }

    fn finish(mut self) -> Result<()> {
        self.file.flush().map_err(|e| unwritable(&e, self.path))
    }
}
