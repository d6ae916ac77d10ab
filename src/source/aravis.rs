//! GigE and USB3 cameras through the Aravis library: the cargo feature `aravis`.
#![allow(unsafe_code)] // the library lends its buffers by pointer

use super::feed::{Arrival, Driver};
use super::pixels::{PixelFormat, by_genicam};
use crate::config::CameraTable;
use crate::error::{Error, Result};
use crate::plan::Block;
use ::aravis as library;
use library::{BufferStatus, CameraExt, CameraExtManual, DeviceExt, StreamExt};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Buffers that the library fills.
const BUFFERS: usize = 8;
/// How long one call waits for a frame.
const WAIT: Duration = Duration::from_millis(200);

/// A camera that streams to the library.
pub struct Aravis {
    camera: library::Camera,
    stream: library::Stream,
    format: PixelFormat,
    size_px: [usize; 2],
    lost: Arc<AtomicBool>,
    sequence: Option<(u64, u64)>,
}

fn failed(what: &str, why: impl std::fmt::Display) -> Error {
    Error::failure(format!("{what}: {why}"))
        .remedy("check cable and address, and that no other program controls the camera")
}

impl Aravis {
    /// Find, set up and start the camera of a configuration.
    pub fn open(settings: &CameraTable, size_px: [usize; 2]) -> Result<Self> {
        let name = settings.format.as_deref().unwrap_or("Mono8");
        let (format, _) = by_genicam(name)?;
        let place = settings.device.as_deref().unwrap_or("any camera");
        let camera = library::Camera::new(settings.device.as_deref())
            .map_err(|e| failed("cannot open the camera", e).at(place))?;
        set_features(&camera, settings, name, size_px).map_err(|e| e.at(place))?;
        let started = || {
            let device = camera.device().ok_or_else(|| failed("the camera", "has no device"))?;
            let lost = Arc::new(AtomicBool::new(false));
            let noticed = Arc::clone(&lost);
            device.connect_control_lost(move |_| noticed.store(true, Ordering::Relaxed));
            let refused = |e| failed("cannot start the camera", e);
            let stream = camera.create_stream().map_err(refused)?;
            let bytes = camera.payload().map_err(refused)? as usize;
            for _ in 0..BUFFERS {
                stream.push_buffer(library::Buffer::new_allocate(bytes));
            }
            camera.start_acquisition().map_err(refused)?;
            Ok((stream, lost))
        };
        let (stream, lost) = started().map_err(|e: Error| e.at(place))?;
        Ok(Self { camera, stream, format, size_px, lost, sequence: None })
    }

    fn pop(&self) -> Result<Option<library::Buffer>> {
        if self.lost.load(Ordering::Relaxed) {
            return Err(failed("the camera is lost", "it does not answer any more"));
        }
        Ok(self.stream.timeout_pop_buffer(WAIT.as_micros() as u64))
    }

    /// The camera's number of a frame as one that does not wrap around. A torn frame may come after
    /// the next one.
    fn unwrapped(&mut self, id: u64) -> u64 {
        let (last, number) = self.sequence.unwrap_or((id, 0));
        let ahead = frames_ahead(id, last);
        let number = number.saturating_add_signed(ahead);
        if ahead >= 0 {
            self.sequence = Some((id, number));
        }
        number
    }

    fn take(&mut self, frame: &library::Buffer, buffer: &mut Block<u8>) -> Arrival {
        let sequence = self.unwrapped(frame.frame_id());
        if frame.status() != BufferStatus::Success {
            return Arrival::Torn;
        }
        let size = [frame.image_width() as usize, frame.image_height() as usize];
        if size != self.size_px {
            return Arrival::Torn;
        }
        let (data, bytes) = frame.data();
        // SAFETY: the buffer is ours until it is pushed back, which is after this call.
        let image = unsafe { std::slice::from_raw_parts(data.cast_const(), bytes) };
        let stride = self.format.row_bytes(size[0]);
        if !self.format.to_mono(image, stride, size, buffer) {
            return Arrival::Torn;
        }
        let stamp_s = frame.timestamp() as f64 / 1e9;
        Arrival::Frame { sequence, stamp_s, captured: Instant::now(), stride: size[0] }
    }
}

impl Driver for Aravis {
    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Arrival> {
        let Some(frame) = self.pop()? else { return Ok(Arrival::Nothing) };
        let arrival = self.take(&frame, buffer);
        self.stream.push_buffer(frame);
        Ok(arrival)
    }

    fn skip(&mut self) -> Result<bool> {
        let Some(frame) = self.pop()? else { return Ok(false) };
        self.unwrapped(frame.frame_id());
        self.stream.push_buffer(frame);
        Ok(true)
    }
}

impl Drop for Aravis {
    fn drop(&mut self) {
        // A camera that is gone does not hear it.
        let _ = self.camera.stop_acquisition();
    }
}

/// How many frames `id` is after `last`; numbers of 16 bits go from 65535 to 1.
fn frames_ahead(id: u64, last: u64) -> i64 {
    let ahead = id.wrapping_sub(last) as i64;
    match ahead {
        _ if id.max(last) > 65_535 => ahead,
        ..-32_767 => ahead + 65_535,
        // A torn frame from before the wrap.
        32_768.. => ahead - 65_535,
        _ => ahead,
    }
}

fn set_features(
    camera: &library::Camera,
    settings: &CameraTable,
    format: &str,
    [width, height]: [usize; 2],
) -> Result<()> {
    let refused = |key: &str, e: &dyn std::fmt::Display| {
        Error::configuration(format!("{key}: the camera does not take it: {e}"))
            .remedy("give what the camera's manual allows")
    };
    let size = "image_size_px of the calibration";
    for (side, bounds) in [(width, camera.width_bounds()), (height, camera.height_bounds())] {
        let (min, max) = bounds.map_err(|e| refused(size, &e))?;
        if !(min..=max).contains(&(side as i32)) {
            return Err(refused(size, &format!("{side} px")).allowed(format!("{min} to {max} px")));
        }
    }
    camera.set_region(0, 0, width as i32, height as i32).map_err(|e| refused(size, &e))?;
    camera.set_pixel_format_from_string(format).map_err(|e| refused("camera.format", &e))?;
    let given = camera.region().map_err(|e| refused(size, &e))?;
    if given != (0, 0, width as i32, height as i32) {
        let what = format!("it gives {} x {} px", given.2, given.3);
        return Err(refused(size, &what));
    }
    if let Some(us) = settings.exposure_us {
        camera.set_exposure_time(us).map_err(|e| refused("camera.exposure_us", &e))?;
    }
    if let Some(gain) = settings.gain {
        camera.set_gain(gain).map_err(|e| refused("camera.gain", &e))?;
    }
    if let Some(fps) = settings.fps {
        camera.set_frame_rate(fps).map_err(|e| refused("camera.fps", &e))?;
    }
    if let Some(bytes) = settings.packet_bytes.filter(|_| camera.is_gv_device()) {
        camera.gv_set_packet_size(bytes as i32).map_err(|e| refused("camera.packet_bytes", &e))?;
    }
    let Some(device) = camera.device() else { return Ok(()) };
    for (name, value) in &settings.controls {
        let text = value.as_str().map_or_else(|| value.to_string(), ToOwned::to_owned);
        let set = device.set_features_from_string(&format!("{name}=\"{text}\""));
        set.map_err(|e| refused(&format!("camera.controls.{name}"), &e))?;
    }
    Ok(())
}
