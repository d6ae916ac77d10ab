//! A directory of image files, in order of name, numbers as numbers.

use super::{FrameSource, Still, stills_in};
use crate::error::{Error, Result};
use crate::image::FrameTime;
use std::path::{Path, PathBuf};

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
        let files = stills_in(folder)?;
        let size_px = Still::size_of(&files[0])?;
        Ok(Self { files: files.into_iter(), size_px, fps, next_index: 0 })
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
        let still = Still::load(&path).map_err(|e| e.remedy(remedy))?;
        let [width, height] = self.size_px;
        if still.size_px != self.size_px {
            return Err(Error::failure(format!(
                "a frame of {} x {} px",
                still.size_px[0], still.size_px[1]
            ))
            .in_file(&path)
            .allowed(format!("{width} x {height} px, as the first frame"))
            .remedy(remedy));
        }
        frame.copy_from_slice(&still.pixels);
        let index = self.next_index;
        self.next_index += 1;
        Ok(Some(FrameTime { index, t_s: index as f64 / self.fps }))
    }
}
