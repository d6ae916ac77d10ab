//! Single images: PNG, PGM, JPEG, BMP and TIFF files, as grey values.

use crate::error::{Error, Result};
use crate::image::Plane;
use std::path::{Path, PathBuf};

const EXTENSIONS: [&str; 7] = ["png", "pgm", "jpg", "jpeg", "bmp", "tif", "tiff"];

/// A decoded image; colour becomes luma.
#[derive(Clone, Debug)]
pub struct Still {
    /// Grey values by row.
    pub pixels: Vec<u8>,
    /// Width and height.
    pub size_px: [usize; 2],
}

impl Still {
    /// Decode a file, whatever its name.
    pub fn load(path: &Path) -> Result<Self> {
        let image = reader(path)?
            .decode()
            .map_err(|e| Error::failure(format!("unreadable image: {e}")).in_file(path))?
            .into_luma8();
        let size_px = [image.width() as usize, image.height() as usize];
        Ok(Self { pixels: image.into_raw(), size_px })
    }

    /// Width and height of a file without decoding it.
    pub fn size_of(path: &Path) -> Result<[usize; 2]> {
        let (width, height) = reader(path)?
            .into_dimensions()
            .map_err(|e| Error::failure(format!("unreadable image: {e}")).in_file(path))?;
        Ok([width as usize, height as usize])
    }

    /// The image, as kernels see it; `None` when `pixels` has been cut.
    pub fn plane(&self) -> Option<Plane<'_>> {
        Plane::packed(&self.pixels, self.size_px[0], self.size_px[1])
    }
}

type Reader = image::ImageReader<std::io::BufReader<std::fs::File>>;

fn reader(path: &Path) -> Result<Reader> {
    // Opening a pipe would wait for ever.
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file()) {
        return Err(Error::failure("not an image file").in_file(path));
    }
    image::ImageReader::open(path)
        .and_then(image::ImageReader::with_guessed_format)
        .map_err(|e| Error::failure(format!("cannot open: {e}")).in_file(path))
}

/// The image files of a folder, in order of name.
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
    files.sort();
    Ok(files)
}
