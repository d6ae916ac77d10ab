//! Reads an archive forward, entry after entry, while it is being written.

use super::reader::Stored;
use super::segment::{self, Segment};
use super::{Entry, Kind};
use crate::error::{Error, Result};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

/// Follows an archive.
#[derive(Clone, Debug)]
pub struct Follower {
    folder: PathBuf,
    /// Number of the next entry, if it is there.
    next: u64,
    /// Segment and byte that it is looked for at; none: to be found.
    place: Option<(u64, u64)>,
}

impl Follower {
    /// From the entry after number `number` on.
    pub fn after(folder: &Path, number: u64) -> Self {
        Self { folder: folder.to_owned(), next: number.saturating_add(1), place: None }
    }

    /// At most `limit` entries that follow, oldest first, without their pictures. Numbers skip where
    /// entries are gone; in place of a damaged one comes a [`Kind::Gap`]. What it returns is on the disk for good: no power cut takes it back, and no
    /// other entry gets its number.
    pub fn read(&mut self, limit: usize) -> Result<Vec<Stored>> {
        let before = self.clone();
        self.read_on(limit).map_err(|e| {
            // What was found and is not returned comes again.
            *self = before;
            Error::failure(format!("cannot read the archive: {e}")).in_file(&self.folder)
        })
    }

    fn read_on(&mut self, limit: usize) -> io::Result<Vec<Stored>> {
        let mut found = Vec::new();
        // Listed before anything is read: whatever has a later one beside it is written to no more.
        let segments = segment::list(&self.folder)?;
        let is_listed = |first: u64| segments.iter().any(|(known, _)| *known == first);
        let Some((oldest, _)) = segments.first() else { return Ok(found) };
        let place = self.place.filter(|(first, _)| is_listed(*first));
        let (begin, mut offset) = place.unwrap_or_else(|| {
            let holds = segments.iter().rev().find(|(first, _)| *first <= self.next);
            (holds.map_or(*oldest, |(first, _)| *first), 0)
        });
        for (first, path) in segments.iter().filter(|(first, _)| *first >= begin) {
            let before = found.len();
            match self.read_segment(*first, path, offset, limit, &mut found) {
                // The oldest go while they are read.
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                read => read?,
            }
            let is_written_to = segments.last().is_some_and(|(newest, _)| newest == first);
            if is_written_to && found.len() > before {
                File::open(path)?.sync_data()?;
            }
            if found.len() == limit {
                break;
            }
            offset = 0;
        }
        Ok(found)
    }

    fn read_segment(
        &mut self,
        first: u64,
        path: &Path,
        offset: u64,
        limit: usize,
        found: &mut Vec<Stored>,
    ) -> io::Result<()> {
        let Some(mut segment) = Segment::open(path)? else { return Ok(()) };
        if offset > 0 {
            segment.seek(offset)?;
        }
        let length = std::fs::metadata(path)?.len();
        self.place = Some((first, segment.offset));
        while found.len() < limit
            && let Some((head, at)) = segment.pass(length)?
        {
            if head.number >= self.next {
                let before = segment.sum_before(at)?;
                segment.seek(at)?;
                let Some((head, entry, [written, comes_out])) = segment.next(&before)? else {
                    break;
                };
                let entry = if written == comes_out {
                    Entry { picture: Vec::new(), ..entry }
                } else {
                    changed(path, head.utc_ms)
                };
                self.next = head.number + 1;
                found.push(Stored { number: head.number, entry });
            }
            self.place = Some((first, segment.offset));
        }
        Ok(())
    }
}

/// In place of an entry that was changed, or is damaged, since it was written.
fn changed(path: &Path, utc_ms: u64) -> Entry {
    let segment = path.file_name().map(|name| name.to_string_lossy());
    let text = serde_json::json!({ "lost": 1, "damaged": segment }).to_string();
    Entry { kind: Kind::Gap, utc_ms, text, picture: Vec::new() }
}
