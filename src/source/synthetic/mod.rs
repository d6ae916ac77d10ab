//! The synthetic belt: deterministic frames of parcels on a conveyor, with exact truth.
//!
//! A [`Scenario`] (TOML) is the only source of truth. [`Renderer`] makes clean frames in 1/256
//! grey level; [`noise`] is a separate step. Serves demo, tests and benchmarks.

mod belt;
mod blocks;
mod board;
mod intruder;
mod lamps;
mod light;
mod marks;
pub mod noise;
mod parcel;
mod random;
mod render;
mod scenario;
mod sensor;
mod shape;
mod solid;
mod surface;

pub use board::{BoardStills, held_poses};
pub use parcel::{Material, Parcel, Place};
pub use random::Random;
pub use render::Renderer;
pub use scenario::Scenario;
pub use shape::Shape;

use sensor::Sensor;

use super::FrameSource;
use crate::camera::BeltView;
use crate::error::Result;
use crate::image::FrameTime;

/// The synthetic belt as a frame source.
pub struct Synthetic {
    renderer: Renderer,
    noise: noise::Noise,
    sensor: Sensor,
    clean: Vec<u16>,
    next_index: u64,
}

impl Synthetic {
    /// A source of the scenario's frames.
    pub fn new(scenario: Scenario) -> Result<Self> {
        let noise = noise::Noise::new(scenario.seed, &scenario.noise);
        let renderer = Renderer::new(scenario)?;
        let [width, height] = renderer.camera().image_size_px;
        let (seed, table) = (renderer.scenario().seed, &renderer.scenario().sensor);
        let sensor = Sensor::new(table, seed, [width, height]);
        Ok(Self { renderer, noise, sensor, clean: vec![0; width * height], next_index: 0 })
    }

    /// The scenario rendered.
    pub fn scenario(&self) -> &Scenario {
        self.renderer.scenario()
    }

    /// Which pixels of a belt view show a parcel in frame `index`: see [`Renderer::parcel_mask`].
    pub fn parcel_mask(&mut self, index: u64, view: &BeltView, mask: &mut [bool]) {
        self.renderer.parcel_mask(index, view, mask);
    }

    /// Render frame `index`, with its noise. A noise reduction in the scenario needs them in order.
    pub fn render(&mut self, index: u64, frame: &mut [u8]) {
        self.renderer.render(index, &mut self.clean);
        self.sensor.expose(index, &mut self.clean);
        self.noise.apply(index, &self.clean, self.renderer.camera().image_size_px[0], frame);
        self.sensor.process(index, frame);
    }
}

impl FrameSource for Synthetic {
    fn size_px(&self) -> [usize; 2] {
        self.renderer.camera().image_size_px
    }

    fn fps(&self) -> f64 {
        self.scenario().fps
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        let index = self.next_index;
        if index >= self.scenario().frames {
            return Ok(None);
        }
        self.render(index, frame);
        self.next_index += 1;
        Ok(Some(FrameTime { index, t_s: index as f64 / self.fps() }))
    }

    fn skip(&mut self, count: u64) {
        self.next_index += count;
    }
}

#[cfg(test)]
mod tests;
