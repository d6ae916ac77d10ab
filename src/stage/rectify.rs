//! Raw image -> belt view, through one precomputed fixed-point map.
//!
//! In: raw frame. Out: belt view and which of its pixels the camera sees. Owns: map, view.
//! Cost: 6 bytes of map, 4 of image read and 1 written a pixel. The map holds lens
//! distortion, tilt and roll at once, so each pixel is interpolated exactly once.

use crate::camera::{BeltView, Camera};
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::bits::words;
use crate::kernel::scalar::remap::{FRACTION_ONE, Source, remap};
use crate::plan::{Block, Memory, Plan};
use crate::units::{BeltPx, RawPx};
use nalgebra::Vector3;

/// The rectification stage.
pub struct Rectify {
    size_px: [usize; 2],
    map: Block<Source>,
    seen: Block<u64>,
    view: Block<u8>,
}

impl Rectify {
    /// Memory for a view.
    pub fn plan(view: &BeltView, plan: &mut Plan) {
        let [width, height] = view.size_px;
        plan.add::<Source>("rectify.map", width * height, "source of every belt view pixel");
        plan.add::<u64>("rectify.seen", words(width) * height, "bit: the camera sees the pixel");
        plan.add::<u8>("rectify.view", width * height, "the belt view of the current frame");
    }

    /// Compute the map.
    pub fn new(camera: &Camera, view: &BeltView, memory: &mut Memory) -> Result<Self> {
        let mut map = memory.take("rectify.map", Source::default())?;
        let mut seen = memory.take("rectify.seen", 0u64)?;
        let [width, height] = view.size_px;
        for v in 0..height {
            for u in 0..width {
                let at = view.belt_point(BeltPx { u: u as f64, v: v as f64 });
                let raw = camera.project(Vector3::new(at.x, at.y, 0.0));
                if let Some(source) = raw.and_then(|px| source(camera, px)) {
                    map[v * width + u] = source;
                    seen[v * words(width) + u / 64] |= 1 << (u % 64);
                }
            }
        }
        Ok(Self { size_px: view.size_px, map, seen, view: memory.take("rectify.view", 0)? })
    }

    /// Rectify one frame; `raw` has the camera's image size. Unseen pixels repeat pixel (0, 0).
    pub fn step(&mut self, raw: Plane<'_>) {
        remap(raw, &self.map, &mut self.view);
    }

    /// The belt view.
    pub fn view(&self) -> Plane<'_> {
        let [width, height] = self.size_px;
        Plane::packed(&self.view, width, height).unwrap_or_else(|| unreachable!("planned so"))
    }

    /// Bit-packed: the camera sees the pixel.
    pub fn seen(&self) -> &[u64] {
        &self.seen
    }
}

/// Fixed-point source of a raw position; `None` when its four neighbours are not all inside.
fn source(camera: &Camera, px: RawPx) -> Option<Source> {
    let one = f64::from(FRACTION_ONE);
    let fixed = |value: f64, side: usize| {
        let steps = (value * one).round();
        let inside = steps >= 0.0 && steps < (side - 1) as f64 * one;
        inside.then_some((
            steps as u32 / u32::from(FRACTION_ONE),
            steps as u32 % u32::from(FRACTION_ONE),
        ))
    };
    let [width, height] = camera.image_size_px;
    let ((x, fx), (y, fy)) = (fixed(px.x, width)?, fixed(px.y, height)?);
    Some(Source { x: x as u16, y: y as u16, fx: fx as u8, fy: fy as u8 })
}
