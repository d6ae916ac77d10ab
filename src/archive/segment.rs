//! The bytes of a segment: a head, then entries.
//!
//! Head: `BGARCH01`, number of its first entry, the sum that its chain goes on from, CRC-32 of these.
//! Entry: `BGEN`, kind, three zeros, number, UTC in ms, bytes of text, bytes of picture; text; picture;
//! SHA-256 of the sum before and all of these. Numbers are little-endian.

use super::{Entry, Kind};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Ends the name of a segment.
const EXTENSION: &str = "bga";
const HEAD_MAGIC: &[u8; 8] = b"BGARCH01";
const ENTRY_MAGIC: &[u8; 4] = b"BGEN";
/// Of a segment's head.
pub const HEAD_BYTES: usize = 8 + 8 + SUM_BYTES + 4;
const ENTRY_HEAD_BYTES: usize = 32;
const SUM_BYTES: usize = 32;
/// No entry is smaller.
const ENTRY_BYTES_MIN: u64 = (ENTRY_HEAD_BYTES + SUM_BYTES) as u64;
/// Text and picture of an entry, each; a claim of more is damage.
pub const PART_BYTES_MAX: usize = 1 << 20;

/// What an entry and all before it come to.
pub type Sum = [u8; SUM_BYTES];

/// A segment's head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// Number of its first entry.
    pub first: u64,
    /// The sum that its chain goes on from.
    pub before: Sum,
}

impl Head {
    /// Its bytes.
    pub fn bytes(&self) -> Vec<u8> {
        let mut bytes = [&HEAD_MAGIC[..], &self.first.to_le_bytes(), &self.before].concat();
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }

    fn of(bytes: &[u8; HEAD_BYTES]) -> Option<Self> {
        let (content, crc) = bytes.split_at(HEAD_BYTES - 4);
        let is_whole =
            crc32fast::hash(content).to_le_bytes() == crc && content.starts_with(HEAD_MAGIC);
        is_whole.then_some(())?;
        let first = u64::from_le_bytes(content[8..16].try_into().ok()?);
        Some(Self { first, before: content[16..].try_into().ok()? })
    }
}

/// What an entry says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EntryHead {
    /// What it is of; none: a later version's.
    pub kind: Option<Kind>,
    /// Its number, from 1.
    pub number: u64,
    /// When, ms since 1970.
    pub utc_ms: u64,
    text_bytes: u32,
    picture_bytes: u32,
}

impl EntryHead {
    /// Bytes of the whole entry.
    pub fn entry_bytes(&self) -> u64 {
        (ENTRY_HEAD_BYTES + SUM_BYTES) as u64
            + u64::from(self.text_bytes)
            + u64::from(self.picture_bytes)
    }

    fn of(bytes: &[u8; ENTRY_HEAD_BYTES]) -> Option<Self> {
        bytes.starts_with(ENTRY_MAGIC).then_some(())?;
        let number = |at: usize| Some(u64::from_le_bytes(bytes[at..at + 8].try_into().ok()?));
        let size = |at: usize| Some(u32::from_le_bytes(bytes[at..at + 4].try_into().ok()?));
        let head = Self {
            kind: Kind::of(bytes[4]),
            number: number(8)?,
            utc_ms: number(16)?,
            text_bytes: size(24)?,
            picture_bytes: size(28)?,
        };
        let most = PART_BYTES_MAX as u32;
        (head.text_bytes <= most && head.picture_bytes <= most).then_some(head)
    }
}

/// The bytes of entry `number`, and the sum of all up to it.
pub fn encode(entry: &Entry, number: u64, before: &Sum) -> (Vec<u8>, Sum) {
    let sizes = [entry.text.len(), entry.picture.len()].map(|n| (n as u32).to_le_bytes());
    let mut bytes = [
        &ENTRY_MAGIC[..],
        &[entry.kind as u8, 0, 0, 0],
        &number.to_le_bytes(),
        &entry.utc_ms.to_le_bytes(),
        &sizes[0],
        &sizes[1],
        entry.text.as_bytes(),
        &entry.picture,
    ]
    .concat();
    let sum = Sha256::new().chain_update(before).chain_update(&bytes).finalize().into();
    bytes.extend(sum);
    (bytes, sum)
}

/// The segments of a folder with the numbers of their first entries, oldest first.
pub fn list(folder: &Path) -> std::io::Result<Vec<(u64, PathBuf)>> {
    let mut found = Vec::new();
    let read = match std::fs::read_dir(folder) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(found),
        read => read?,
    };
    for entry in read {
        let path = entry?.path();
        let is_segment = path.extension().is_some_and(|e| e == EXTENSION);
        let first = path.file_stem().and_then(|stem| stem.to_str()?.parse().ok());
        if let Some(first) = first.filter(|_| is_segment) {
            found.push((first, path));
        }
    }
    found.sort();
    Ok(found)
}

/// Where the segment that begins with an entry is.
pub fn path(folder: &Path, first: u64) -> PathBuf {
    folder.join(format!("{first:020}.{EXTENSION}"))
}

/// No more entries than this are in so many bytes of a segment, whatever is left of them.
pub fn entries_max(bytes: u64) -> u64 {
    bytes.div_ceil(ENTRY_BYTES_MIN)
}

/// What is behind the last whole entry of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// Nothing.
    Whole,
    /// The beginning of an entry, or zeros: a power cut leaves such.
    Torn,
    /// Anything else: no power cut does that.
    Damaged,
}

/// Reads a segment from its beginning.
pub struct Segment {
    file: BufReader<File>,
    /// Its head.
    pub head: Head,
    /// Bytes read as whole entries so far, the head included.
    pub offset: u64,
}

impl Segment {
    /// Open it; `None` when its head was never written or is damaged.
    pub fn open(path: &Path) -> std::io::Result<Option<Self>> {
        let mut file = BufReader::new(File::open(path)?);
        let mut bytes = [0; HEAD_BYTES];
        if !fill(&mut file, &mut bytes)? {
            return Ok(None);
        }
        let head = Head::of(&bytes);
        Ok(head.map(|head| Self { file, head, offset: HEAD_BYTES as u64 }))
    }

    /// The next entry's head, its text and picture left out; `None` at the end, or at what is not whole.
    pub fn pass(&mut self, length: u64) -> std::io::Result<Option<(EntryHead, u64)>> {
        let at = self.offset;
        let Some((head, _)) = self.head_of_next()? else { return Ok(None) };
        let end = at + head.entry_bytes();
        if end > length {
            return Ok(None);
        }
        self.file.seek_relative(head.entry_bytes() as i64 - ENTRY_HEAD_BYTES as i64)?;
        self.offset = end;
        Ok(Some((head, at)))
    }

    /// The next entry, with its sum as it is written and as it comes out; `None` at the end, or at what is
    /// not whole.
    pub fn next(&mut self, before: &Sum) -> std::io::Result<Option<(EntryHead, Entry, [Sum; 2])>> {
        let Some((head, bytes)) = self.head_of_next()? else { return Ok(None) };
        let mut text = vec![0; head.text_bytes as usize];
        let mut picture = vec![0; head.picture_bytes as usize];
        let mut written = [0; SUM_BYTES];
        let whole = fill(&mut self.file, &mut text)?
            && fill(&mut self.file, &mut picture)?
            && fill(&mut self.file, &mut written)?;
        if !whole {
            return Ok(None);
        }
        let sum = Sha256::new().chain_update(before).chain_update(bytes);
        let sum = sum.chain_update(&text).chain_update(&picture).finalize().into();
        self.offset += head.entry_bytes();
        let text = String::from_utf8_lossy(&text).into_owned();
        let entry =
            Entry { kind: head.kind.unwrap_or(Kind::Event), utc_ms: head.utc_ms, text, picture };
        Ok(Some((head, entry, [written, sum])))
    }

    /// The sum of all before an entry, as [`Segment::pass`] told where it is.
    pub fn sum_before(&mut self, offset: u64) -> std::io::Result<Sum> {
        let mut sum = self.head.before;
        if offset > HEAD_BYTES as u64 {
            self.seek(offset - SUM_BYTES as u64)?;
            fill(&mut self.file, &mut sum)?;
        }
        Ok(sum)
    }

    /// Go to an entry, as [`Segment::pass`] told where it is.
    pub fn seek(&mut self, offset: u64) -> std::io::Result<()> {
        self.file.seek(SeekFrom::Start(offset))?;
        self.offset = offset;
        Ok(())
    }

    /// What there is where the next entry, of this number, should be: for when there is none.
    pub fn ending(&mut self, number: u64, length: u64) -> std::io::Result<Ending> {
        self.seek(self.offset)?;
        let left = length.saturating_sub(self.offset);
        // An entry that is not there as a whole is no longer than this.
        let entry_max = ENTRY_BYTES_MIN + 2 * PART_BYTES_MAX as u64;
        let mut bytes = Vec::new();
        self.file.by_ref().take(left.min(entry_max)).read_to_end(&mut bytes)?;
        if bytes.is_empty() {
            return Ok(Ending::Whole);
        }
        if is_zero(&bytes) {
            let mut rest = vec![0; 4096];
            loop {
                let n = self.file.read(&mut rest)?;
                if n == 0 {
                    return Ok(Ending::Torn);
                }
                if !is_zero(&rest[..n]) {
                    return Ok(Ending::Damaged);
                }
            }
        }
        let begins = match bytes.first_chunk() {
            None => bytes.starts_with(&ENTRY_MAGIC[..bytes.len().min(ENTRY_MAGIC.len())]),
            Some(head) => EntryHead::of(head)
                .is_some_and(|head| head.number == number && head.entry_bytes() > left),
        };
        Ok(if begins && !has_entry(&bytes) { Ending::Torn } else { Ending::Damaged })
    }

    fn head_of_next(&mut self) -> std::io::Result<Option<(EntryHead, [u8; ENTRY_HEAD_BYTES])>> {
        let mut bytes = [0; ENTRY_HEAD_BYTES];
        if !fill(&mut self.file, &mut bytes)? {
            return Ok(None);
        }
        Ok(EntryHead::of(&bytes).map(|head| (head, bytes)))
    }
}

fn is_zero(bytes: &[u8]) -> bool {
    bytes.iter().all(|&byte| byte == 0)
}

/// Whether a whole entry begins behind the first bytes: its sum goes on from the 32 bytes before it.
fn has_entry(bytes: &[u8]) -> bool {
    let is_entry = |at: usize| {
        let entry = &bytes[at..];
        let head = EntryHead::of(entry.first_chunk()?)?;
        let entry = entry.get(..head.entry_bytes() as usize)?;
        let (content, written) = entry.split_at(entry.len() - SUM_BYTES);
        let before = &bytes[at - SUM_BYTES..at];
        let sum = Sha256::new().chain_update(before).chain_update(content).finalize();
        (sum.as_slice() == written).then_some(())
    };
    (SUM_BYTES..bytes.len()).any(|at| is_entry(at).is_some())
}

/// Whether there were enough bytes.
fn fill(file: &mut impl Read, bytes: &mut [u8]) -> std::io::Result<bool> {
    match file.read_exact(bytes) {
        Err(e) if e.kind() == ErrorKind::UnexpectedEof => Ok(false),
        read => read.map(|()| true),
    }
}
