//! The support bundle: a tar.gz that is packed file by file, as fast as it is taken.
//!
//! Each file is made and packed on a thread that may wait for the disk, and only when the one before has
//! been taken. So a slow visitor holds one file in memory and no thread.

use super::model::BundleFiles;
use flate2::Compression;
use flate2::write::GzEncoder;
use futures_util::stream::{self, Stream};
use std::fmt::Write as _;
use std::io;
use tar::{Builder, Header};
use tokio::sync::OwnedSemaphorePermit;

/// Bytes of all files together, before they are packed.
const BYTES_MAX: usize = 16 << 20;
/// The folder that everything in it is in.
const FOLDER: &str = "beltgauge-bundle";
/// The last file: what is in it, and what is left out and why.
const CONTENTS: &str = "contents.txt";

/// A bundle that is being packed.
pub(super) struct Packing {
    files: BundleFiles,
    /// None: it is complete.
    tar: Option<Builder<GzEncoder<Vec<u8>>>>,
    time_s: u64,
    left_bytes: usize,
    contents: String,
}

impl Packing {
    /// Of these files, made at this time (ms since 1970).
    pub(super) fn new(files: BundleFiles, utc_ms: u64) -> Self {
        let packed = GzEncoder::new(Vec::new(), Compression::fast());
        Self {
            files,
            tar: Some(Builder::new(packed)),
            time_s: utc_ms / 1000,
            left_bytes: BYTES_MAX,
            contents: String::new(),
        }
    }

    /// The next bytes; none: it is complete.
    fn next(&mut self) -> io::Result<Option<Vec<u8>>> {
        while let Some(tar) = &mut self.tar {
            if let Some(file) = self.files.next() {
                let told = match file.bytes {
                    Ok(bytes) if bytes.len() <= self.left_bytes => {
                        self.left_bytes -= bytes.len();
                        append(tar, &file.name, &bytes, self.time_s)?;
                        format!("{} bytes", bytes.len())
                    }
                    Ok(_) => "left out: the bundle is full".to_owned(),
                    Err(why) => format!("left out: {why}"),
                };
                // Writing to a string does not fail.
                let _ = writeln!(self.contents, "{}: {told}", file.name);
                let packed = std::mem::take(tar.get_mut().get_mut());
                if !packed.is_empty() {
                    return Ok(Some(packed));
                }
            } else if let Some(mut tar) = self.tar.take() {
                append(&mut tar, CONTENTS, self.contents.as_bytes(), self.time_s)?;
                return tar.into_inner()?.finish().map(Some);
            }
        }
        Ok(None)
    }
}

fn append(
    tar: &mut Builder<GzEncoder<Vec<u8>>>,
    name: &str,
    bytes: &[u8],
    time_s: u64,
) -> io::Result<()> {
    let mut header = Header::new_ustar();
    header.set_size(bytes.len() as u64);
    header.set_mode(0o644);
    header.set_mtime(time_s);
    tar.append_data(&mut header, format!("{FOLDER}/{name}"), bytes)
}

/// A bundle as the body of an answer. It keeps its place until it is complete, or whoever takes it has gone.
pub(super) fn stream(
    packing: Packing,
    place: OwnedSemaphorePermit,
) -> impl Stream<Item = io::Result<Vec<u8>>> {
    stream::try_unfold((packing, place), |(mut packing, place)| async {
        let pack = move || packing.next().map(|bytes| bytes.map(|bytes| (bytes, (packing, place))));
        tokio::task::spawn_blocking(pack).await.map_err(io::Error::other)?
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::model::BundleFile;
    use flate2::read::GzDecoder;
    use std::collections::BTreeMap;
    use std::io::Read;

    fn file(name: &str, bytes: Result<Vec<u8>, String>) -> BundleFile {
        BundleFile { name: name.to_owned(), bytes }
    }

    /// What comes out again, by name.
    fn unpacked(files: Vec<BundleFile>) -> BTreeMap<String, Vec<u8>> {
        let mut packing = Packing::new(Box::new(files.into_iter()), 1_795_000_000_123);
        let mut packed = Vec::new();
        while let Some(bytes) = packing.next().expect("packed") {
            packed.extend(bytes);
        }
        assert!(packing.next().expect("packed").is_none(), "it stays complete");
        let mut archive = tar::Archive::new(GzDecoder::new(&packed[..]));
        let read = |entry: io::Result<tar::Entry<'_, _>>| {
            let mut entry = entry.expect("whole");
            let name = entry.path().expect("a name").display().to_string();
            let mut bytes = Vec::new();
            entry.read_to_end(&mut bytes).expect("whole");
            (name, bytes)
        };
        archive.entries().expect("whole").map(read).collect()
    }

    #[test]
    fn what_is_packed_comes_out_and_what_is_left_out_is_told() {
        let files = vec![
            file("a.txt", Ok(b"first".to_vec())),
            file("folder/b.jpg", Ok(vec![7; 100_000])),
            file("c.toml", Err("there is none".to_owned())),
        ];
        let found = unpacked(files);
        assert_eq!(found.len(), 3, "{:?}", found.keys());
        assert_eq!(found["beltgauge-bundle/a.txt"], b"first");
        assert_eq!(found["beltgauge-bundle/folder/b.jpg"], vec![7; 100_000]);
        let contents = String::from_utf8_lossy(&found["beltgauge-bundle/contents.txt"]);
        assert_eq!(
            contents,
            "a.txt: 5 bytes\nfolder/b.jpg: 100000 bytes\nc.toml: left out: there is none\n"
        );
    }

    #[test]
    fn it_is_bounded_and_what_is_small_still_fits() {
        let large = || Ok(vec![0; BYTES_MAX / 2 + 1]);
        let found =
            unpacked(vec![file("a", large()), file("b", large()), file("c", Ok(vec![1; 10]))]);
        let bytes: usize = found.values().map(Vec::len).sum();
        assert!(bytes < BYTES_MAX, "{bytes}");
        let contents = String::from_utf8_lossy(&found["beltgauge-bundle/contents.txt"]);
        assert!(contents.contains("b: left out: the bundle is full\nc: 10 bytes"), "{contents}");
    }

    #[test]
    fn a_file_is_made_only_when_the_one_before_was_taken() {
        let (made, counted) = std::sync::mpsc::channel();
        let files = (0..5).map(move |n| {
            made.send(n).expect("open");
            // Nothing that a packer holds back.
            let noise: Vec<u8> =
                (0..200_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
            file(&format!("{n}"), Ok(noise))
        });
        let mut packing = Packing::new(Box::new(files), 0);
        for n in 0..5 {
            assert!(packing.next().expect("packed").is_some());
            assert_eq!(counted.try_iter().collect::<Vec<_>>(), [n]);
        }
    }
}
