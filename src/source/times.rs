//! The true times of a recording, in a file beside it: a line a picture, its number and its seconds.
//!
//! A Y4M stream has one rate and no gaps; a camera loses frames, and its clock is not the rate.

use super::FrameSource;
use super::y4m::read_line;
use crate::error::{Error, Result};
use crate::image::FrameTime;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// The first line of every such file.
pub(super) const HEADER: &str =
    "# frame number and seconds since the first frame, a line for every picture\n";

/// The file of a recording's times: FILE.y4m.times beside FILE.y4m.
pub fn times_beside(recording: &Path) -> PathBuf {
    let mut name = recording.as_os_str().to_owned();
    name.push(".times");
    name.into()
}

/// A recording with the true times of its pictures.
pub(super) struct Timed<S> {
    source: S,
    path: PathBuf,
    lines: BufReader<File>,
    line_number: u64,
    last: Option<FrameTime>,
    missing: u64,
}

impl<S: FrameSource> Timed<S> {
    /// Read times from a file, which must begin as such a file does.
    pub(super) fn new(source: S, path: PathBuf) -> Result<Self> {
        let file = File::open(&path).map_err(|e| {
            Error::failure(format!("cannot open the recording's times: {e}")).in_file(&path)
        })?;
        let lines = BufReader::new(file);
        let mut timed = Self { source, path, lines, line_number: 0, last: None, missing: 0 };
        let first = timed.line()?.unwrap_or_default();
        if first != HEADER.trim_end() {
            return Err(timed
                .wrong(&first)
                .allowed(format!("a first line {:?}", HEADER.trim_end())));
        }
        Ok(timed)
    }

    fn wrong(&self, found: &str) -> Error {
        Error::failure(format!("the recording's times are damaged: {found:?}"))
            .at(format!("{}, line {}", self.path.display(), self.line_number))
            .remedy("give --fps, so that this file is not read; gaps are then not known")
    }

    fn line(&mut self) -> Result<Option<String>> {
        self.line_number += 1;
        read_line(&mut self.lines).map_err(|e| self.wrong(&e.to_string()))
    }

    /// The time of the next picture; `None` after the last.
    fn time(&mut self) -> Result<Option<FrameTime>> {
        let Some(line) = self.line()? else { return Ok(None) };
        let time = line.split_once(' ').and_then(|(index, t_s)| {
            let t_s = t_s.parse::<f64>().ok().filter(|t_s| t_s.is_finite())?;
            Some(FrameTime { index: index.parse().ok()?, t_s })
        });
        let follows = |time: &FrameTime| {
            self.last.is_none_or(|last| time.index > last.index && time.t_s >= last.t_s)
        };
        let time = time.filter(follows).ok_or_else(|| {
            self.wrong(&line).allowed("a number and seconds, both above those of the line before")
        })?;
        self.missing += self.last.map_or(0, |last| time.index - last.index - 1);
        self.last = Some(time);
        Ok(Some(time))
    }
}

impl<S: FrameSource> FrameSource for Timed<S> {
    fn size_px(&self) -> [usize; 2] {
        self.source.size_px()
    }

    fn fps(&self) -> f64 {
        self.source.fps()
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        match (self.source.next_into(frame)?, self.time()?) {
            (Some(_), Some(time)) => Ok(Some(time)),
            (None, None) => Ok(None),
            (picture, _) => {
                let which = if picture.is_some() { "times end" } else { "pictures end" };
                Err(Error::failure(format!("the recording was cut off: its {which} first"))
                    .at(format!("{}, line {}", self.path.display(), self.line_number))
                    .remedy("what was measured before it is written"))
            }
        }
    }

    fn doubt(&self) -> Option<String> {
        let told = (self.missing > 0).then(|| {
            format!(
                "{} frames are missing in the recording: its camera or disk was too slow",
                self.missing
            )
        });
        told.or_else(|| self.source.doubt())
    }
}
