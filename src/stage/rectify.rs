//! Raw image -> belt view, through one precomputed fixed-point map.
//!
//! In: raw frame. Out: belt view and which of its pixels the camera sees. Owns: map, view.
//! Cost: 1.5 bytes of map and 1 written a pixel, and the image once. The map holds lens
//! distortion, tilt and roll at once, so each pixel is interpolated exactly once. At the border of
//! the image a group of pixels is seen only as a whole.

use crate::camera::{BeltView, Camera};
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::Level;
use crate::kernel::bands::{self, Jobs, rows_per_band};
use crate::kernel::scalar::bits::{self, stride, words};
use crate::kernel::scalar::remap::{GROUP, Source};
use crate::kernel::simd::remap::remap;
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltPx;
use nalgebra::Vector3;

/// The rectification stage.
pub struct Rectify {
    level: Level,
    bands: usize,
    size_px: [usize; 2],
    map: Block<Source>,
    seen: Block<u64>,
    view: Block<u8>,
}

impl Rectify {
    /// Memory for a view.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let [width, height] = view.size_px;
        let pixels = stride(width) * height;
        plan.add::<Source>("rectify.map", pixels / GROUP, "source of 8 belt view pixels");
        plan.add::<u64>("rectify.seen", words(width) * height, "bit: the camera sees the pixel");
        plan.add::<u8>("rectify.view", pixels, "the belt view of the current frame");
    }

    /// Compute the map.
    pub fn new(
        camera: &Camera,
        view: &BeltView,
        level: Level,
        bands: usize,
        memory: &mut Memory,
    ) -> Result<Self> {
        let mut map = memory.take("rectify.map", Source::default())?;
        let mut seen = memory.take("rectify.seen", 0u64)?;
        let width = view.size_px[0];
        let groups = stride(width) / GROUP;
        let raw = |u: usize, v: usize| {
            let at = view.belt_point(BeltPx { u: u as f64, v: v as f64 });
            camera.project(Vector3::new(at.x, at.y, 0.0)).map(|px| [px.x, px.y])
        };
        for (v, (map, seen)) in
            map.chunks_exact_mut(groups).zip(seen.chunks_exact_mut(words(width))).enumerate()
        {
            for (source, u) in map.iter_mut().zip((0..width).step_by(GROUP)) {
                let (first, last) = (raw(u, v), raw(u + GROUP - 1, v));
                let line = first
                    .zip(last)
                    .and_then(|(first, last)| Source::between(first, last, camera.image_size_px));
                if let Some(line) = line {
                    *source = line;
                    bits::set(seen, u as u16, (u + GROUP).min(width) as u16);
                }
            }
        }
        let view_px = memory.take("rectify.view", 0)?;
        Ok(Self { level, bands, size_px: view.size_px, map, seen, view: view_px })
    }

    /// Rectify one frame; `raw` has the camera's image size. Unseen pixels repeat pixel (0, 0).
    pub fn step(&mut self, raw: Plane<'_>) {
        let [width, height] = self.size_px;
        let pixels = rows_per_band(height, self.bands) * stride(width);
        let parts = self.map.chunks(pixels / GROUP).zip(self.view.chunks_mut(pixels));
        let mut jobs: Jobs<_> = parts.collect();
        bands::run(&mut jobs, &|(map, view)| remap(self.level, raw, map, view));
    }

    /// The belt view.
    pub fn view(&self) -> Plane<'_> {
        let [width, height] = self.size_px;
        Plane::new(&self.view, width, height, stride(width))
            .unwrap_or_else(|| unreachable!("planned so"))
    }

    /// The belt view's pixels, rows of [`stride`].
    pub fn pixels(&self) -> &[u8] {
        &self.view
    }

    /// Bit-packed: the camera sees the pixel.
    pub fn seen(&self) -> &[u64] {
        &self.seen
    }
}
