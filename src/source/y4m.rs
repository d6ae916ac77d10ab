//! YUV4MPEG2: the luma of mono and 4:2:0 streams, from a file or a pipe.
//!
//! Source: the format's description in mjpegtools, yuv4mpeg(5).

use super::{FPS, FrameSource};
use crate::error::{Error, Result};
use crate::image::FrameTime;
use std::io::{BufRead, BufReader, Read};

/// What standard input is called.
pub(super) const STDIN: &str = "standard input";
/// Longer header lines are not Y4M.
const LINE_BYTES_MAX: u64 = 1024;

/// The whole line that measures any video. `filter` is ffmpeg's, or nothing.
fn through_ffmpeg(name: &str, filter: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-+".contains(c);
    let input = match name {
        STDIN => "INPUT".to_owned(),
        _ if name.chars().all(plain) => name.to_owned(),
        _ => format!("'{}'", name.replace('\'', r"'\''")),
    };
    format!(
        "ffmpeg -v error -i {input} {filter}-pix_fmt gray -f yuv4mpegpipe -strict -1 - | \
         beltgauge measure - --config FILE"
    )
}

/// A Y4M stream.
pub struct Y4m {
    reader: BufReader<Box<dyn Read + Send>>,
    name: String,
    size_px: [usize; 2],
    fps: f64,
    /// Chroma bytes after each frame's luma.
    chroma_bytes: u64,
    next_index: u64,
}

impl Y4m {
    /// Read the stream header. `fps` overrides the stream's own rate.
    pub fn new(reader: Box<dyn Read + Send>, name: &str, fps: Option<f64>) -> Result<Self> {
        let mut reader = BufReader::with_capacity(1 << 20, reader);
        let wrong = |what: String| {
            Error::configuration(what)
                .at(name)
                .allowed("YUV4MPEG2 with W, H, F; 8-bit mono or 4:2:0 (Cmono, C420, C420jpeg, C420mpeg2, C420paldv)")
                .remedy(through_ffmpeg(name, ""))
        };
        let line = read_line(&mut reader)
            .map_err(|e| Error::failure(format!("cannot read: {e}")).at(name))?
            .ok_or_else(|| wrong("the input is empty".to_owned()))?;
        if line.len() as u64 >= LINE_BYTES_MAX {
            return Err(wrong("the stream header is too long".to_owned()));
        }
        let mut fields = line.trim_end().split(' ');
        if fields.next() != Some("YUV4MPEG2") {
            return Err(wrong("the input is not a YUV4MPEG2 stream".to_owned()));
        }
        let (mut width, mut height, mut rate, mut chroma) =
            (None, None, None, "420jpeg".to_owned());
        for field in fields.filter(|f| !f.is_empty()) {
            let (tag, value) = field.split_at(field.chars().next().map_or(0, char::len_utf8));
            match tag {
                "W" => width = value.parse::<usize>().ok(),
                "H" => height = value.parse::<usize>().ok(),
                "F" => rate = parse_rate(value),
                "C" => value.clone_into(&mut chroma),
                "I" if ["t", "b", "m"].contains(&value) => {
                    return Err(wrong(format!(
                        "the stream is interlaced, I{value}: each frame is two pictures of \
                         different times, row by row"
                    ))
                    .remedy(through_ffmpeg(name, "-vf yadif=1 ")));
                }
                _ => {}
            }
        }
        let side = |value: Option<usize>, tag: &str| {
            value
                .filter(|n| (16..=16384).contains(n))
                .ok_or_else(|| wrong(format!("the stream header has no usable {tag}: {line}")))
        };
        let (width, height) = (side(width, "width W")?, side(height, "height H")?);
        let chroma_bytes = match chroma.as_str() {
            "mono" => 0,
            "420" | "420jpeg" | "420mpeg2" | "420paldv" => {
                2 * width.div_ceil(2) * height.div_ceil(2)
            }
            other => return Err(wrong(format!("colour space C{other} is not supported"))),
        };
        let fps = fps.or(rate).filter(|fps| FPS.contains(fps)).ok_or_else(|| {
            wrong(format!("the stream header has no usable frame rate F: {line}"))
                .remedy("give the camera's frames a second with --fps")
        })?;
        Ok(Self {
            reader,
            name: name.to_owned(),
            size_px: [width, height],
            fps,
            chroma_bytes: chroma_bytes as u64,
            next_index: 0,
        })
    }

    fn broken(&self, what: String) -> Error {
        Error::failure(what)
            .at(format!("{}, frame {}", self.name, self.next_index))
            .remedy("the input is damaged from here on; what was measured before it is written")
    }
}

impl FrameSource for Y4m {
    fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    fn fps(&self) -> f64 {
        self.fps
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        let header = read_line(&mut self.reader)
            .map_err(|e| self.broken(format!("cannot read the frame header: {e}")))?;
        let Some(header) = header else { return Ok(None) };
        if header != "FRAME" && !header.starts_with("FRAME ") {
            return Err(self.broken("expected a FRAME header".to_owned()));
        }
        self.reader.read_exact(frame).map_err(|e| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => {
                self.broken("the stream ends in the middle of a frame".to_owned())
            }
            _ => self.broken(format!("cannot read: {e}")),
        })?;
        let skipped =
            std::io::copy(&mut (&mut self.reader).take(self.chroma_bytes), &mut std::io::sink())
                .map_err(|e| self.broken(format!("cannot read: {e}")))?;
        if skipped < self.chroma_bytes {
            return Err(self.broken("the stream ends in the middle of a frame".to_owned()));
        }
        let index = self.next_index;
        self.next_index += 1;
        Ok(Some(FrameTime { index, t_s: index as f64 / self.fps }))
    }
}

/// A line without its end; `None` at the end of the stream. A line too long comes back cut.
pub(super) fn read_line(reader: &mut impl BufRead) -> std::io::Result<Option<String>> {
    let mut line = Vec::new();
    reader.take(LINE_BYTES_MAX).read_until(b'\n', &mut line)?;
    if line.is_empty() {
        return Ok(None);
    }
    if line.last() == Some(&b'\n') {
        line.pop();
    }
    Ok(Some(String::from_utf8_lossy(&line).into_owned()))
}

fn parse_rate(value: &str) -> Option<f64> {
    let (numerator, denominator) = value.split_once(':')?;
    let fps = numerator.parse::<f64>().ok()? / denominator.parse::<f64>().ok()?;
    (fps.is_finite() && fps > 0.0).then_some(fps)
}
