//! Reads an archive, also one that is being written.

use super::segment::{self, Ending, EntryHead, HEAD_BYTES, Segment, Sum};
use super::{Entry, Kind};
use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// An entry as it was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stored {
    /// Its number, from 1; numbers skip only behind what was damaged.
    pub number: u64,
    /// What was kept; the picture may be left out.
    pub entry: Entry,
}

impl Stored {
    /// As a line of JSON, without the picture.
    pub fn json(&self) -> String {
        let (number, kind, what) = (self.number, self.entry.kind.name(), &self.entry.text);
        format!("{{\"entry\":{number},\"kind\":\"{kind}\",\"what\":{what}}}")
    }
}

/// A part of the archive.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Page {
    /// Entries, newest first, without their pictures.
    pub entries: Vec<Stored>,
    /// Where entries are missing because they cannot be read: a segment, and what is wrong with it.
    pub unread: Vec<String>,
}

/// What [`Reader::verify`] found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verdict {
    /// Whole entries.
    pub entries: u64,
    /// Number of the first one.
    pub first: Option<u64>,
    /// Number of the last one.
    pub last: Option<u64>,
    /// The sum of the chain up to there.
    pub sum: Sum,
    /// Entries that the disk did not take, as the chain tells.
    pub told_lost: u64,
    /// Bytes that power cuts left half-written.
    pub torn_bytes: u64,
    /// Where the chain is broken: something was changed, taken out, or damaged.
    pub broken: Vec<String>,
}

impl Page {
    fn unread(&mut self, segment: &Path, why: &str) {
        let name = segment.file_name().unwrap_or_default().to_string_lossy();
        self.unread.push(format!("{name}: {why}"));
    }

    /// Add the last entries of a segment, until there are `limit`.
    fn add_last_of(&mut self, path: &Path, before: u64, limit: usize) -> std::io::Result<()> {
        let length = std::fs::metadata(path)?.len();
        let Some(mut segment) = Segment::open(path)? else {
            // One that is shorter was begun when the power went.
            if length > HEAD_BYTES as u64 {
                self.unread(path, "its head is damaged");
            }
            return Ok(());
        };
        let (mut heads, mut next) = (Vec::<(EntryHead, u64)>::new(), segment.head.first);
        let why = loop {
            match segment.pass(length) {
                Ok(Some((head, _))) if head.number >= before => break None,
                Ok(Some((head, at))) => {
                    next = head.number + 1;
                    heads.push((head, at));
                }
                Ok(None) => match segment.ending(next, length) {
                    Ok(Ending::Damaged) => break Some("damaged".to_owned()),
                    Ok(Ending::Whole | Ending::Torn) => break None,
                    Err(e) => break Some(format!("cannot be read: {e}")),
                },
                Err(e) => break Some(format!("cannot be read: {e}")),
            }
        };
        if let Some(why) = why {
            self.unread(path, &format!("{why} where entry {next} should be"));
        }
        let room = limit - self.entries.len();
        for (head, at) in heads.into_iter().rev().take(room) {
            let number = head.number;
            // Its sum is not asked for: that takes the ones before.
            match segment.seek(at).and_then(|()| segment.next(&Sum::default())) {
                Ok(Some((_, mut entry, _))) => {
                    entry.picture = Vec::new();
                    self.entries.push(Stored { number, entry });
                }
                Ok(None) => {}
                Err(e) => self.unread(path, &format!("entry {number} cannot be read: {e}")),
            }
        }
        Ok(())
    }
}

/// An archive to read.
#[derive(Clone, Debug)]
pub struct Reader {
    folder: PathBuf,
}

impl Reader {
    /// Of the archive in a folder, which must be there.
    pub fn open(folder: &Path) -> Result<Self> {
        if folder.is_dir() {
            return Ok(Self { folder: folder.to_owned() });
        }
        Err(Error::configuration("there is no archive")
            .in_file(folder)
            .allowed("the folder of archive.folder, or STORE/archive of an appliance")
            .remedy("give the archive's folder"))
    }

    fn failed(&self, e: &std::io::Error) -> Error {
        Error::failure(format!("cannot read the archive: {e}")).in_file(&self.folder)
    }

    fn segments(&self) -> Result<Vec<(u64, PathBuf)>> {
        segment::list(&self.folder).map_err(|e| self.failed(&e))
    }

    /// At most `limit` entries before number `before` (none: from the newest on). It takes as long as one
    /// segment, however large the archive is.
    ///
    /// # Errors
    /// When nothing can be read and the disk says why. Otherwise what cannot be read hides nothing else.
    pub fn before(&self, before: Option<u64>, limit: usize) -> Result<Page> {
        let before = before.unwrap_or(u64::MAX);
        let (mut page, mut failed) = (Page::default(), None);
        for (first, path) in self.segments()?.into_iter().rev() {
            if first >= before || page.entries.len() == limit {
                continue;
            }
            match page.add_last_of(&path, before, limit) {
                // The writer may have taken it away.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
                Err(e) => {
                    page.unread(&path, &format!("cannot be read: {e}"));
                    failed = Some(e);
                }
                Ok(()) => {}
            }
        }
        match failed {
            Some(e) if page.entries.is_empty() => Err(self.failed(&e)),
            _ => Ok(page),
        }
    }

    /// One entry with its picture.
    pub fn entry(&self, number: u64) -> Result<Option<Stored>> {
        let holds = |(first, _): &&(u64, PathBuf)| *first <= number;
        let segments = self.segments()?;
        let Some((_, path)) = segments.iter().rev().find(holds) else { return Ok(None) };
        let read = || -> std::io::Result<Option<Stored>> {
            let Some(mut segment) = Segment::open(path)? else { return Ok(None) };
            let length = std::fs::metadata(path)?.len();
            while let Some((head, at)) = segment.pass(length)? {
                if head.number == number {
                    segment.seek(at)?;
                    let next = segment.next(&Sum::default())?;
                    return Ok(next.map(|(head, entry, _)| Stored { number: head.number, entry }));
                }
            }
            Ok(None)
        };
        read().map_err(|e| self.failed(&e))
    }

    /// Every whole entry, oldest first.
    ///
    /// # Errors
    /// What the disk or `each` says.
    pub fn each(&self, mut each: impl FnMut(Stored) -> Result<()>) -> Result<Verdict> {
        let mut verdict = Verdict::default();
        for (first, path) in self.segments()? {
            self.walk(first, &path, &mut verdict, &mut each)?;
        }
        Ok(verdict)
    }

    /// Whether the chain is whole.
    pub fn verify(&self) -> Result<Verdict> {
        self.each(|_| Ok(()))
    }

    fn walk(
        &self,
        first: u64,
        path: &Path,
        verdict: &mut Verdict,
        each: &mut impl FnMut(Stored) -> Result<()>,
    ) -> Result<()> {
        let failed = |e: std::io::Error| self.failed(&e);
        let name = path.display();
        let length = std::fs::metadata(path).map_err(failed)?.len();
        let mut segment = match Segment::open(path) {
            Ok(Some(segment)) => segment,
            Ok(None) if length <= HEAD_BYTES as u64 => {
                // Begun when the power went.
                verdict.torn_bytes += length;
                return Ok(());
            }
            Ok(None) => {
                verdict.broken.push(format!("{name}: its head is damaged"));
                return Ok(());
            }
            Err(e) => {
                verdict.broken.push(format!("{name}: cannot be read: {e}"));
                return Ok(());
            }
        };
        let (mut sum, mut next) = (segment.head.before, segment.head.first);
        if next != first {
            verdict.broken.push(format!("{name}: begins with entry {next}, not as it is called"));
        }
        if let Some(last) = verdict.last
            && (last + 1 != next || verdict.sum != sum)
        {
            verdict.broken.push(format!("{name}: does not go on from entry {last}"));
        }
        loop {
            let at = segment.offset;
            let (head, entry, [written, comes_out]) = match segment.next(&sum) {
                Ok(Some(found)) => found,
                Ok(None) => break,
                Err(e) => {
                    verdict.broken.push(format!("{name}: cannot be read behind byte {at}: {e}"));
                    return Ok(());
                }
            };
            if head.number != next {
                let found = head.number;
                verdict.broken.push(format!("{name}: entry {found} where {next} should be"));
            }
            if written != comes_out {
                verdict.broken.push(format!("{name}: entry {} was changed", head.number));
            }
            (sum, next) = (written, head.number + 1);
            verdict.first.get_or_insert(head.number);
            (verdict.last, verdict.sum) = (Some(head.number), sum);
            verdict.entries += 1;
            if entry.kind == Kind::Gap {
                let gap: serde_json::Value = serde_json::from_str(&entry.text).unwrap_or_default();
                verdict.told_lost += gap["lost"].as_u64().unwrap_or(0);
            }
            each(Stored { number: head.number, entry })?;
        }
        // As long as it was at first: it may be written to.
        let at = segment.offset;
        match segment.ending(next, length) {
            Ok(Ending::Whole) => {}
            Ok(Ending::Torn) => verdict.torn_bytes += length.saturating_sub(at),
            Ok(Ending::Damaged) => {
                verdict
                    .broken
                    .push(format!("{name}: damaged at byte {at}, where entry {next} should be"));
            }
            Err(e) => verdict.broken.push(format!("{name}: cannot be read behind byte {at}: {e}")),
        }
        Ok(())
    }
}
