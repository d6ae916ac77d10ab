//! A directory of PNG, PGM or JPEG frames, in order of name.

use super::FrameSource;
use crate::error::{Error, Result};
use crate::image::FrameTime;
use std::path::{Path, PathBuf};

const EXTENSIONS: [&str; 4] = ["png", "pgm", "jpg", "jpeg"];

/// The frames of a directory. Decoding allocates: a replay, not a camera.
pub struct Directory {
    files: std::vec::IntoIter<PathBuf>,
    size_px: [usize; 2],
    fps: f64,
    next_index: u64,
}

impl Directory {
    /// List the frames; the first one gives the size.
    pub fn open(folder: &Path, fps: Option<f64>) -> Result<Self> {
        let fps = fps.ok_or_else(|| {
            Error::configuration("a directory of images has no frame rate")
                .in_file(folder)
                .remedy("give the camera's frames a second with --fps")
        })?;
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
        files.sort();
        let first = files.first().ok_or_else(|| {
            Error::configuration("the directory holds no frames")
                .in_file(folder)
                .allowed("*.png, *.pgm, *.jpg, *.jpeg")
        })?;
        let (width, height) = image::ImageReader::open(first)
            .and_then(image::ImageReader::with_guessed_format)
            .map_err(image::ImageError::IoError)
            .and_then(image::ImageReader::into_dimensions)
            .map_err(|e| Error::failure(format!("unreadable image: {e}")).in_file(first))?;
        Ok(Self {
            files: files.into_iter(),
            size_px: [width as usize, height as usize],
            fps,
            next_index: 0,
        })
    }
}

impl FrameSource for Directory {
    fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    fn fps(&self) -> f64 {
        self.fps
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        let Some(path) = self.files.next() else { return Ok(None) };
        let remedy = "replace or remove this file; what was measured before it is written";
        let image = image::ImageReader::open(&path)
            .and_then(image::ImageReader::with_guessed_format)
            .map_err(|e| Error::failure(format!("cannot open: {e}")).in_file(&path))?
            .decode()
            .map_err(|e| {
                Error::failure(format!("unreadable image: {e}")).in_file(&path).remedy(remedy)
            })?
            .into_luma8();
        let [width, height] = self.size_px;
        if [image.width() as usize, image.height() as usize] != [width, height] {
            return Err(Error::failure(format!(
                "a frame of {} x {} px",
                image.width(),
                image.height()
            ))
            .in_file(&path)
            .allowed(format!("{width} x {height} px, as the first frame"))
            .remedy(remedy));
        }
        frame.copy_from_slice(image.as_raw());
        let index = self.next_index;
        self.next_index += 1;
        Ok(Some(FrameTime { index, t_s: index as f64 / self.fps }))
    }
}
