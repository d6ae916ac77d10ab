//! Single images: PNG, PGM, JPEG, BMP and TIFF files, as grey values.

use crate::error::{Error, Result};
use crate::image::Plane;
use crate::sandbox::{self, Sandbox, printable};
use image::{DynamicImage, ImageDecoder};
use std::fs::File;
use std::io::{BufRead, Cursor, ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const EXTENSIONS: [&str; 7] = ["png", "pgm", "jpg", "jpeg", "bmp", "tif", "tiff"];

/// A decoded image; colour becomes luma.
#[derive(Clone, Debug)]
pub struct Still {
    /// Grey values by row.
    pub pixels: Vec<u8>,
    /// Width and height.
    pub size_px: [usize; 2],
}

/// Largest image, in pixels: twice what machine-vision cameras of this kind have.
const PIXELS_MAX: u64 = 64 << 20;
/// Most bytes of a decoded image, before it becomes grey: three colours of 8 bits, and spare.
const DECODED_BYTES_MAX: u64 = 256 << 20;
/// Largest image file for the child process.
const FILE_BYTES_MAX: u64 = 64 << 20;
/// The child's task.
pub const TASK: &str = "image";
/// Memory of the child: file, decoded image, grey image and the decoder's own.
const MEMORY_BYTES: u64 = 512 << 20;
/// How long the child may take for an image.
const DECODING: Duration = Duration::from_secs(20);

impl Still {
    /// Decode a file, whatever its name. For files of the user's own: a decoder may fall for what a
    /// stranger made, see [`Still::load_sandboxed`].
    pub fn load(path: &Path) -> Result<Self> {
        decode(open(path)?).map_err(|e| e.in_file(path))
    }

    /// [`Still::load`] in a child process with limits on memory and time, for files from a stranger:
    /// what it does to its decoder is an error here.
    pub fn load_sandboxed(path: &Path) -> Result<Self> {
        let until = Instant::now() + DECODING;
        let load = |mut child: Sandbox| -> Result<Self> {
            let header = child.read_line(until)?;
            let header: std::result::Result<[usize; 2], String> =
                serde_json::from_str(&header).map_err(|_| child.end(ErrorKind::InvalidData))?;
            let size_px = header.map_err(|e| Error::failure(printable(&e)))?;
            check_pixels(size_px.map(|side| side as u64))?;
            let pixels = child.read_bytes(size_px[0] * size_px[1], until)?;
            Ok(Self { pixels, size_px })
        };
        Sandbox::start_on(TASK, open(path)?.into_inner())
            .and_then(load)
            .map_err(|e| e.in_file(path).remedy("take this image again, or leave it out"))
    }

    /// Width and height of a file without decoding it.
    pub fn size_of(path: &Path) -> Result<[usize; 2]> {
        let size = reader(open(path)?)?.into_dimensions().map_err(unreadable);
        let (width, height) = size.map_err(|e| e.in_file(path))?;
        Ok([width as usize, height as usize])
    }

    /// The image, as kernels see it; `None` when `pixels` has been cut.
    pub fn plane(&self) -> Option<Plane<'_>> {
        Plane::packed(&self.pixels, self.size_px[0], self.size_px[1])
    }
}

fn unreadable(why: impl std::fmt::Display) -> Error {
    Error::failure(format!("unreadable image: {why}"))
}

fn open(path: &Path) -> Result<std::io::BufReader<File>> {
    // Opening a pipe would wait for ever.
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file()) {
        return Err(Error::failure("not an image file").in_file(path));
    }
    File::open(path)
        .map(std::io::BufReader::new)
        .map_err(|e| Error::failure(format!("cannot open: {e}")).in_file(path))
}

fn reader<R: BufRead + Seek>(file: R) -> Result<image::ImageReader<R>> {
    image::ImageReader::new(file).with_guessed_format().map_err(unreadable)
}

/// Refused by size before anything is decoded.
fn check_pixels([width, height]: [u64; 2]) -> Result<()> {
    if width.saturating_mul(height) <= PIXELS_MAX && width.min(height) > 0 {
        return Ok(());
    }
    Err(Error::configuration(format!("an image of {width} x {height} px"))
        .allowed(format!("up to {} megapixels", PIXELS_MAX >> 20))
        .remedy("use images as the camera delivers them"))
}

/// Decode an image of any of the formats, up to [`PIXELS_MAX`].
pub fn decode(file: impl BufRead + Seek) -> Result<Still> {
    let mut decoder = reader(file)?.into_decoder().map_err(unreadable)?;
    let (width, height) = decoder.dimensions();
    check_pixels([width.into(), height.into()])?;
    if decoder.total_bytes() > DECODED_BYTES_MAX {
        return Err(unreadable(format!("{width} x {height} px of that many bits"))
            .allowed(format!("up to {} MiB decoded", DECODED_BYTES_MAX >> 20)));
    }
    let mut limits = image::Limits::no_limits();
    limits.max_alloc = Some(DECODED_BYTES_MAX);
    decoder.set_limits(limits).map_err(unreadable)?;
    let image = DynamicImage::from_decoder(decoder).map_err(unreadable)?.into_luma8();
    let size_px = [image.width() as usize, image.height() as usize];
    Ok(Still { pixels: image.into_raw(), size_px })
}

/// In the child: decode the image on standard input on to standard output.
pub fn serve() -> Result<()> {
    sandbox::confine(MEMORY_BYTES)?;
    let mut bytes = Vec::new();
    let mut file = std::io::stdin().take(FILE_BYTES_MAX + 1);
    let read = file.read_to_end(&mut bytes).map_err(unreadable);
    let still = read.and_then(|_| match bytes.len() as u64 {
        FILE_BYTES_MAX.. => Err(unreadable(format!("more than {} MiB", FILE_BYTES_MAX >> 20))),
        _ => decode(Cursor::new(&bytes)),
    });
    let header = still.as_ref().map(|still| still.size_px).map_err(ToString::to_string);
    let line = serde_json::to_string(&header).map_err(unreadable)?;
    let mut out = std::io::stdout();
    let pixels = still.as_ref().map_or(&[][..], |still| &still.pixels);
    out.write_all(line.as_bytes())
        .and_then(|()| out.write_all(b"\n"))
        .and_then(|()| out.write_all(pixels))
        .and_then(|()| out.flush())
        .map_err(unreadable)
}

/// The image files of a folder, in order of name; numbers in names count as numbers.
pub fn stills_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let unreadable = |e: std::io::Error| {
        Error::failure(format!("cannot list the directory: {e}")).in_file(folder)
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        let is_image = extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str()));
        if is_image && path.is_file() {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(Error::configuration("the directory holds no frames")
            .in_file(folder)
            .allowed(EXTENSIONS.map(|e| format!("*.{e}")).join(", ")));
    }
    files.sort_by_cached_key(|path| natural_order(path));
    let same = |pair: &&[PathBuf]| natural_order(&pair[0]) == natural_order(&pair[1]);
    if let Some([a, b]) = files.windows(2).find(same) {
        let name =
            |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let names = [name(a), name(b)];
        return Err(Error::configuration(format!(
            "{} and {} have the same number: which comes first is not known",
            names[0], names[1]
        ))
        .in_file(folder)
        .remedy("remove one, or number the files with the same count of digits"));
    }
    Ok(files)
}

/// A piece of a file's name. Numbers compare by their count of digits, then by the digits.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Piece {
    Number(usize, String),
    Text(String),
}

/// A name in pieces: frame 2 comes before frame 10.
fn natural_order(path: &Path) -> Vec<Piece> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let mut pieces: Vec<Piece> = Vec::new();
    for run in name.as_bytes().chunk_by(|a, b| a.is_ascii_digit() == b.is_ascii_digit()) {
        let text = String::from_utf8_lossy(run).into_owned();
        let is_fraction =
            matches!(&pieces[..], [.., Piece::Number(..), Piece::Text(t)] if t == ".");
        pieces.push(if run[0].is_ascii_digit() && !is_fraction {
            let digits = text.trim_start_matches('0').to_owned();
            Piece::Number(digits.len(), digits)
        } else {
            Piece::Text(text)
        });
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_in_order_of_their_numbers() {
        let in_order = [
            "1.png",
            "2.png",
            "10.png",
            "123456789012345678901234567890.png",
            "cam2_frame9.png",
            "cam2_frame10.png",
            "cam10_frame1.png",
            // Seconds with a fraction.
            "t7.25.png",
            "t7.5.png",
            "t10.125.png",
        ];
        let keys = in_order.map(|name| natural_order(Path::new(name)));
        assert!(keys.is_sorted_by(|a, b| a < b), "{keys:?}");
        let same = ["07.png", "7.png"].map(|name| natural_order(Path::new(name)));
        assert_eq!(same[0], same[1]);
    }
}
