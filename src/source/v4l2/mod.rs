//! Cameras with a kernel driver, through Video4Linux.
//!
//! Frames of 8-bit mono are lent to the pipeline in the driver's own memory; others are converted on
//! the way. The device is opened, asked and given back by the `v4l` crate and its bindings; the ring of
//! buffers is in `ring`.

mod ioctl;
mod ring;

use super::feed::{Arrival, Driver};
use super::pixels::{PixelFormat, by_fourcc};
use crate::config::CameraTable;
use crate::error::{Error, Result};
use crate::plan::Block;
use ring::{BUFFERS, Filled, Ring};
use rustix::time::{ClockId, clock_gettime};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use v4l::control::{Control, Value};
use v4l::format::FourCC;
use v4l::video::Capture;
use v4l::video::capture::Parameters;
use v4l::{Device, Format, Fraction};

/// Device nodes that are looked at.
const NODES: usize = 64;
/// How long one call waits for a frame: whoever wants the thread to end waits as long.
const WAIT: Duration = Duration::from_millis(200);
/// The driver keeps so many buffers to fill, whatever the pipeline does with the others.
const QUEUED_MIN: usize = 2;
/// Units of `V4L2_CID_EXPOSURE_ABSOLUTE`.
const EXPOSURE_UNIT_US: f64 = 100.0;
/// `V4L2_EXPOSURE_MANUAL`.
const EXPOSURE_MANUAL: i64 = 1;

/// An open device that streams.
pub struct V4l2 {
    ring: Ring,
    format: PixelFormat,
    stride: usize,
    size_px: [usize; 2],
    /// Buffers of the plan in whose place driver's ones were lent.
    spare: Vec<Block<u8>>,
    /// Pictures are looked at in the driver's buffers, without a copy.
    lends: bool,
    sequence: Option<(u32, u64)>,
}

impl V4l2 {
    /// Open, set up and start the device of a configuration.
    pub fn open(settings: &CameraTable, size_px: [usize; 2]) -> Result<Self> {
        let (path, device) = find(settings.device.as_deref())?;
        let opened = Self::set_up(device, settings, size_px);
        opened.map_err(|e| e.at(path.display()))
    }

    fn set_up(device: Device, settings: &CameraTable, size_px: [usize; 2]) -> Result<Self> {
        let (format, fourcc) = by_fourcc(settings.format.as_deref().unwrap_or("GREY"))?;
        let stride = set_format(&device, fourcc, format, size_px)?;
        if let Some(fps) = settings.fps {
            set_fps(&device, fps)?;
        }
        set_controls(&device, settings)?;
        let ring = Ring::start(device).map_err(|e| failed("cannot stream", &e))?;
        let spare = Vec::with_capacity(ring.len());
        // With fewer buffers than were asked for, v4l2loopback's 8 for one, a frame that waits may be filled anew.
        let lends = format == PixelFormat::Mono8 && ring.len() >= BUFFERS as usize;
        Ok(Self { ring, format, stride, size_px, spare, lends, sequence: None })
    }

    /// A driver's buffer goes back to the driver; from here on `buffer` is one of the plan's.
    fn take_back(&mut self, buffer: &mut Block<u8>) -> Result<()> {
        if !buffer.is_foreign() {
            return Ok(());
        }
        // None is left when the camera was lost and took them along: that is no steady state.
        let own = match self.spare.pop() {
            Some(own) => own,
            None => Block::own(self.size_px.iter().product())?,
        };
        let lent = std::mem::replace(buffer, own);
        match self.ring.index_of(&lent) {
            Some(index) => self.ring.queue(index, lent).map_err(|e| lost(&e)),
            None => Ok(()),
        }
    }

    /// The driver's number of a frame, which wraps around, as one that does not.
    fn unwrapped(&mut self, sequence: u32) -> u64 {
        let number = self.sequence.map_or(u64::from(sequence), |(last, number)| {
            number + u64::from(sequence.wrapping_sub(last))
        });
        self.sequence = Some((sequence, number));
        number
    }

    /// Put a filled buffer's picture into `buffer`; whether it was whole.
    fn hand_over(&mut self, filled: &Filled, buffer: &mut Block<u8>) -> io::Result<bool> {
        let [width, height] = self.size_px;
        let needed = self.stride * (height - 1) + width;
        let compressed = self.format == PixelFormat::Jpeg;
        let bytes = filled.bytes.min(filled.block_len());
        if self.ring.is_lent(filled.index) {
            // The driver fills what it had not got back: from here on its pictures are copied.
            self.lends = false;
            return Ok(false);
        }
        let lend = self.lends && self.ring.queued() >= QUEUED_MIN;
        if filled.damaged || (!compressed && bytes < needed) {
            self.ring.requeue(filled.index)?;
            return Ok(false);
        }
        if lend {
            let Some(lent) = self.ring.lend(filled.index) else { return Ok(false) };
            self.spare.push(std::mem::replace(buffer, lent));
            return Ok(true);
        }
        let image = &self.ring.bytes(filled.index)[..bytes];
        let whole = self.format.to_mono(image, self.stride, self.size_px, buffer);
        self.ring.requeue(filled.index)?;
        Ok(whole)
    }
}

impl Driver for V4l2 {
    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Arrival> {
        self.take_back(buffer)?;
        let Some(filled) = self.ring.dequeue(WAIT).map_err(|e| lost(&e))? else {
            return Ok(Arrival::Nothing);
        };
        let sequence = self.unwrapped(filled.sequence);
        if !self.hand_over(&filled, buffer).map_err(|e| lost(&e))? {
            return Ok(Arrival::Torn);
        }
        let stride = if buffer.is_foreign() { self.stride } else { self.size_px[0] };
        let captured = exposed_at(&filled);
        Ok(Arrival::Frame { sequence, stamp_s: filled.stamp_s, captured, stride })
    }

    fn skip(&mut self) -> Result<bool> {
        let filled = self.ring.dequeue(WAIT).map_err(|e| lost(&e))?;
        let Some(filled) = filled else { return Ok(false) };
        self.unwrapped(filled.sequence);
        if !self.ring.is_lent(filled.index) {
            self.ring.requeue(filled.index).map_err(|e| lost(&e))?;
        }
        Ok(true)
    }
}

/// By our clock: drivers stamp by the same one, or else now is the best guess.
fn exposed_at(filled: &Filled) -> Instant {
    let (now, clock) = (Instant::now(), clock_gettime(ClockId::Monotonic));
    let clock_s = clock.tv_sec as f64 + clock.tv_nsec as f64 / 1e9;
    let age = Duration::try_from_secs_f64(clock_s - filled.stamp_s).unwrap_or_default();
    let known = filled.monotonic && age < Duration::from_secs(1);
    now.checked_sub(if known { age } else { Duration::ZERO }).unwrap_or(now)
}

fn lost(e: &io::Error) -> Error {
    failed("the camera is lost", e)
}

fn failed(what: &str, e: &io::Error) -> Error {
    let remedy = match e.raw_os_error() {
        Some(16) => "another program uses it: end that one",
        Some(19) => "plug it in again; it is opened as soon as it is there",
        Some(28) => "the USB bus has no room: use another port, or fewer frames a second",
        _ => "look at the kernel's messages (dmesg)",
    };
    Error::failure(format!("{what}: {e}")).remedy(remedy)
}

/// The device by path, bus or card name; without a name the only one that captures.
fn find(wanted: Option<&str>) -> Result<(PathBuf, Device)> {
    if let Some(path) = wanted.filter(|wanted| wanted.starts_with('/')) {
        let device = Device::with_path(path)
            .map_err(|e| failed("cannot open camera.device", &e).in_file(Path::new(path)))?;
        return Ok((path.into(), device));
    }
    let mut there = Vec::new();
    for node in 0..NODES {
        let path = PathBuf::from(format!("/dev/video{node}"));
        let Ok(device) = Device::with_path(&path) else { continue };
        let Ok(identity) = ioctl::identity(&device) else { continue };
        if identity.captures {
            there.push((path, device, identity));
        }
    }
    let named = |(path, _, identity): &(PathBuf, Device, ioctl::Identity)| {
        format!("{} ({}, {})", path.display(), identity.card, identity.bus)
    };
    let list = there.iter().map(named).collect::<Vec<_>>().join("; ");
    let list = if list.is_empty() { "none is there".to_owned() } else { list };
    there.retain(|(.., identity)| {
        wanted.is_none_or(|wanted| identity.card == wanted || identity.bus == wanted)
    });
    let mut found = there.into_iter();
    match (found.next(), found.next()) {
        (Some((path, device, _)), None) => Ok((path, device)),
        (Some(_), Some(_)) => Err(Error::configuration("camera.device: more than one fits")
            .allowed(list)
            .remedy("give its path, or the bus it is on")),
        (None, _) => Err(Error::failure(format!(
            "camera.device: {} is not there",
            wanted.unwrap_or("a camera")
        ))
        .allowed(list)
        .remedy("plug it in, or name one of these")),
    }
}

/// Returns the bytes from one row to the next.
fn set_format(
    device: &Device,
    fourcc: [u8; 4],
    format: PixelFormat,
    [width, height]: [usize; 2],
) -> Result<usize> {
    // Stride and size 0: the driver chooses them.
    let wanted = Format::new(width as u32, height as u32, FourCC::new(&fourcc));
    let given = device.set_format(&wanted).map_err(|e| failed("cannot set the format", &e))?;
    let name = |fourcc: &[u8; 4]| String::from_utf8_lossy(fourcc).trim_end().to_owned();
    if given.fourcc.repr != fourcc || [given.width, given.height] != [wanted.width, wanted.height] {
        let formats = device.enum_formats().unwrap_or_default();
        let formats: Vec<String> = formats.iter().map(|f| name(&f.fourcc.repr)).collect();
        return Err(Error::configuration(format!(
            "the camera delivers {} of {} x {} px, asked for were {} of {width} x {height} px",
            name(&given.fourcc.repr),
            given.width,
            given.height,
            name(&fourcc),
        ))
        .allowed(format!("its formats: {}", formats.join(", ")))
        .remedy("set camera.format to one of them; the size is the calibration's image_size_px"));
    }
    Ok((given.stride as usize).max(format.row_bytes(width)))
}

fn set_fps(device: &Device, fps: f64) -> Result<()> {
    // In thousandths, as drivers round it anyway.
    let interval = Fraction::new(1000, (fps * 1000.0).round() as u32);
    let given = device
        .set_params(&Parameters::new(interval))
        .map_err(|e| failed("camera.fps cannot be set", &e))?
        .interval;
    let given_fps = f64::from(given.denominator) / f64::from(given.numerator.max(1));
    if (given_fps - fps).abs() > 0.01 * fps {
        tracing::warn!("camera.fps = {fps}: the camera makes {given_fps:.2} frames a second");
    }
    Ok(())
}

fn set_controls(device: &Device, settings: &CameraTable) -> Result<()> {
    use v4l::v4l_sys::{V4L2_CID_EXPOSURE_ABSOLUTE, V4L2_CID_EXPOSURE_AUTO, V4L2_CID_GAIN};
    let set = |key: &str, id: u32, value: i64| {
        device.set_control(Control { id, value: Value::Integer(value) }).map_err(|e| {
            Error::configuration(format!("{key}: the camera does not take {value}: {e}"))
                .remedy("leave it out, or set the camera's own control under [camera.controls]")
        })
    };
    if let Some(us) = settings.exposure_us {
        // A camera without automatic exposure has no such control.
        let _ = set("camera.exposure_us", V4L2_CID_EXPOSURE_AUTO, EXPOSURE_MANUAL);
        let units = (us / EXPOSURE_UNIT_US).round().max(1.0) as i64;
        set("camera.exposure_us", V4L2_CID_EXPOSURE_ABSOLUTE, units)?;
    }
    if let Some(gain) = settings.gain {
        set("camera.gain", V4L2_CID_GAIN, gain.round() as i64)?;
    }
    if settings.controls.is_empty() {
        return Ok(());
    }
    let known = ioctl::controls(device);
    for (name, value) in &settings.controls {
        let key = format!("camera.controls.{name}");
        let control = known.iter().find(|control| control.name == *name).ok_or_else(|| {
            let names: Vec<_> = known.iter().map(|control| control.name.as_str()).collect();
            Error::configuration(format!("{key}: the camera has no such control"))
                .allowed(names.join(", "))
                .remedy("name one of these")
        })?;
        let number = match *value {
            toml::Value::Boolean(on) => Some(i64::from(on)),
            toml::Value::Integer(number) => Some(number),
            toml::Value::Float(number) => Some(number.round() as i64),
            _ => None,
        };
        let range = control.min..=control.max;
        let number = number.filter(|number| range.contains(number)).ok_or_else(|| {
            Error::configuration(format!("{key} = {value}"))
                .allowed(format!("{} to {}", control.min, control.max))
                .remedy("give a number; true and false are 1 and 0")
        })?;
        set(&key, control.id, number)?;
    }
    Ok(())
}
