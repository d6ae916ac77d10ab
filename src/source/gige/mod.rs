//! GigE cameras, by this program's own receiver: the capture thread itself takes the packets.
//!
//! Control channel and packet formats are the `viva-genicam` crate's; its features too, but in a
//! child process (`features`). Frames are put together in `assembly`, which asks again for packets
//! that are missing. After opening, nothing is allocated for a frame.

pub(crate) mod assembly;
mod control;
pub mod features;

use super::feed::{Arrival, Driver};
use super::pixels::{PixelFormat, by_genicam};
use crate::config::CameraTable;
use crate::error::{Error, Result};
use crate::plan::Block;
use assembly::{Assembly, Resend, Step};
use control::{Control, stream_register};
use features::Features;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};
use viva_genicam::blocking;
use viva_genicam::gige::{
    DeviceInfo, DiscoveryOptions, GVCP_PORT, consts, set_recv_buffer, wait_readable,
};

/// How long discovery listens.
const DISCOVERY: Duration = Duration::from_millis(500);
/// How long one call waits for a frame.
const WAIT: Duration = Duration::from_millis(200);
/// Packets that wait in the kernel: nearly two frames of the reference camera.
const SOCKET_BYTES: usize = 4 << 20;
/// The IP and UDP headers of a packet.
const HEADERS: u32 = 28;
/// Packets of a network without jumbo frames.
const PACKET_BYTES: u32 = 1500;
/// The camera must not split packets.
const DO_NOT_FRAGMENT: u32 = 0x4000_0000;
/// Without packets for this long the camera is asked whether it is still there.
const SILENCE: Duration = Duration::from_secs(1);

/// A camera that streams to us.
pub struct Gige {
    features: Features,
    control: Control,
    address: Ipv4Addr,
    socket: UdpSocket,
    datagram: Vec<u8>,
    assembly: Assembly,
    format: PixelFormat,
    size_px: [usize; 2],
    ticks_per_s: f64,
    heard: Instant,
}

fn failed(what: &str, why: impl std::fmt::Display) -> Error {
    Error::failure(format!("{what}: {why}"))
        .remedy("check cable, address and that no other program controls the camera")
}

impl Gige {
    /// Find, set up and start the camera of a configuration.
    pub fn open(settings: &CameraTable, size_px: [usize; 2]) -> Result<Self> {
        let (format, _) = by_genicam(settings.format.as_deref().unwrap_or("Mono8"))?;
        let found = find(settings.device.as_deref())?;
        let place = found.ip;
        let control = Control::take(place)?;
        Self::start(control, place, settings, format, size_px).map_err(|e| e.at(place))
    }

    fn start(
        control: Control,
        address: Ipv4Addr,
        settings: &CameraTable,
        format: PixelFormat,
        size_px: [usize; 2],
    ) -> Result<Self> {
        let mut features =
            described(&control, settings, size_px).map_err(|e| control.silence().unwrap_or(e))?;
        let network = |e: std::io::Error| failed("cannot open a socket for the pictures", e);
        // The address by which the camera reaches us is that by which we reach it.
        let towards = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).map_err(network)?;
        towards.connect((address, GVCP_PORT)).map_err(network)?;
        let std::net::IpAddr::V4(ours) = towards.local_addr().map_err(network)?.ip() else {
            return Err(failed("cannot open a socket for the pictures", "no IPv4 address"));
        };
        let socket = UdpSocket::bind((ours, 0)).map_err(network)?;
        socket.set_nonblocking(true).map_err(network)?;
        let buffer = set_recv_buffer(&socket, SOCKET_BYTES).map_err(network)?;
        if buffer.is_short() {
            tracing::warn!(
                "the kernel holds only {} bytes of packets, {SOCKET_BYTES} are needed: \
                 set net.core.rmem_max to {SOCKET_BYTES}",
                buffer.granted
            );
        }
        let port = socket.local_addr().map_err(network)?.port();
        let packet_bytes = direct_stream(&control, ours, port, settings)?;
        let ticks = [consts::TIMESTAMP_TICK_FREQUENCY_HIGH, consts::TIMESTAMP_TICK_FREQUENCY_LOW]
            .map(|register| control.read(register).unwrap_or(0));
        let ticks_per_s = match u64::from(ticks[0]) << 32 | u64::from(ticks[1]) {
            0 => 1e9,
            ticks => ticks as f64,
        };
        let [width, height] = size_px;
        let image_bytes = format.row_bytes(width) * height;
        let datagram_bytes = (packet_bytes - HEADERS) as usize;
        let assembly = Assembly::new(image_bytes, datagram_bytes, size_px)?;
        let started = features.start(&control)?;
        started.map_err(|e| failed("cannot start the camera", e))?;
        let datagram = vec![0; packet_bytes as usize];
        let heard = Instant::now();
        Ok(Self {
            features,
            control,
            address,
            socket,
            datagram,
            assembly,
            format,
            size_px,
            ticks_per_s,
            heard,
        })
    }

    /// Packets until something has come of them, or time is up.
    fn receive(&mut self, until: Instant) -> Result<Step> {
        let lost = |e: std::io::Error| failed("the camera is lost", e);
        loop {
            // Also in a flood of what is none of ours.
            if Instant::now() >= until {
                return Ok(Step::More);
            }
            match self.socket.recv_from(&mut self.datagram) {
                // Whoever else sends to this port is not listened to.
                Ok((_, from)) if from.ip() != self.address => {}
                Ok((length, _)) => {
                    self.heard = Instant::now();
                    let step = self.assembly.packet(&self.datagram[..length], self.heard)?;
                    if step != Step::More {
                        return Ok(step);
                    }
                }
                Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => {
                    let now = Instant::now();
                    let mut resends = heapless::Vec::new();
                    let step = self.assembly.idle(now, &mut resends);
                    resends.iter().for_each(|resend| self.ask_again(resend));
                    if step != Step::More {
                        return Ok(step);
                    }
                    let wait = until.saturating_duration_since(now).min(assembly::PATIENCE);
                    wait_readable(&self.socket, wait).map_err(lost)?;
                }
                // What a datagram of ours met on the way: the camera is asked below.
                Err(e) if e.kind() == std::io::ErrorKind::ConnectionRefused => {}
                Err(e) => return Err(lost(e)),
            }
        }
    }

    fn ask_again(&self, resend: &Resend) {
        // A request that is lost is made again.
        let _ = self.socket.send_to(resend.bytes(), (self.address, GVCP_PORT));
    }

    /// Whether the camera is still ours, asked when it has been silent.
    fn check(&mut self) -> Result<()> {
        if self.heard.elapsed() < SILENCE {
            return Ok(());
        }
        self.heard = Instant::now();
        self.control.check()
    }

    fn wait(&mut self) -> Result<Step> {
        match self.receive(Instant::now() + WAIT)? {
            Step::More => self.check().map(|()| Step::More),
            step => Ok(step),
        }
    }
}

impl Driver for Gige {
    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Arrival> {
        let image = match self.wait()? {
            Step::More => return Ok(Arrival::Nothing),
            Step::Torn => return Ok(Arrival::Torn),
            Step::Whole(image) => image,
        };
        if self.format == PixelFormat::Mono8 {
            std::mem::swap(buffer, self.assembly.image(image.slot));
        } else {
            let stride = self.format.row_bytes(self.size_px[0]);
            let raw = self.assembly.image(image.slot);
            if !self.format.to_mono(raw, stride, self.size_px, buffer) {
                return Ok(Arrival::Torn);
            }
        }
        Ok(Arrival::Frame {
            sequence: image.sequence,
            stamp_s: image.stamp as f64 / self.ticks_per_s,
            captured: image.began,
            stride: self.size_px[0],
        })
    }

    fn skip(&mut self) -> Result<bool> {
        Ok(matches!(self.wait()?, Step::Whole(_)))
    }

    fn resends(&self) -> u64 {
        self.assembly.resends()
    }
}

impl Drop for Gige {
    fn drop(&mut self) {
        self.features.stop(&self.control);
        // A camera that is gone does not hear it.
        let _ = self.control.write(stream_register(consts::STREAM_DESTINATION_PORT), 0);
    }
}

/// The camera by address, serial number, name or model; without a name the only one.
fn find(wanted: Option<&str>) -> Result<DeviceInfo> {
    if let Some(address) = wanted.and_then(|wanted| wanted.parse::<Ipv4Addr>().ok()) {
        let found = blocking::discover_ip(address, DISCOVERY)
            .map_err(|e| failed("cannot look for the camera", e).at(address))?;
        return found.ok_or_else(|| failed("camera.device", "it does not answer").at(address));
    }
    let options = DiscoveryOptions::new().include_loopback(true);
    let mut there = blocking::discover_with(DISCOVERY, &options)
        .map_err(|e| failed("cannot look for cameras", e))?;
    let text = |text: &Option<String>| text.clone().unwrap_or_default();
    let list = there.iter().map(|info| {
        format!("{} {} ({}, {})", info.ip, text(&info.model), text(&info.serial), info.mac_string())
    });
    let list = list.collect::<Vec<_>>().join("; ");
    let list = if list.is_empty() { "none answers".to_owned() } else { list };
    there.retain(|info| {
        let names = [&info.serial, &info.user_name, &info.model];
        wanted.is_none_or(|wanted| {
            names.iter().any(|name| name.as_deref() == Some(wanted)) || info.mac_string() == wanted
        })
    });
    there.dedup_by_key(|info| info.ip);
    match (there.pop(), there.is_empty()) {
        (Some(found), true) => Ok(found),
        (Some(_), false) => Err(Error::configuration("camera.device: more than one camera fits")
            .allowed(list)
            .remedy("give its address or serial number")),
        (None, _) => {
            let wanted = wanted.unwrap_or("a camera");
            Err(Error::failure(format!("camera.device: {wanted} does not answer"))
                .allowed(list)
                .remedy("check cable, power and address, or name one of these"))
        }
    }
}

/// The camera's features, those of the configuration set.
fn described(
    control: &Control,
    settings: &CameraTable,
    [width, height]: [usize; 2],
) -> Result<Features> {
    let mut features = Features::of(control)?;
    // Outside: the child has ended; inside: the camera refuses.
    let mut set = |key: &str, name: &str, value: &str| -> Result<Result<()>> {
        let set = features.set(control, name, value)?;
        Ok(set.map_err(|e| {
            Error::configuration(format!("{key}: the camera does not take {name} = {value}: {e}"))
                .remedy("give what the camera's manual allows")
        }))
    };
    let image_size = "image_size_px of the calibration";
    set(image_size, "Width", &width.to_string())??;
    set(image_size, "Height", &height.to_string())??;
    set("camera.format", "PixelFormat", settings.format.as_deref().unwrap_or("Mono8"))??;
    // Cameras without these have nothing to switch off.
    let _ = set("", "AcquisitionMode", "Continuous")?;
    if let Some(us) = settings.exposure_us {
        let _ = set("", "ExposureAuto", "Off")?;
        let us = us.to_string();
        if let Err(e) = set("camera.exposure_us", "ExposureTime", &us)? {
            set("", "ExposureTimeAbs", &us)?.map_err(|_| e)?;
        }
    }
    if let Some(gain) = settings.gain {
        let _ = set("", "GainAuto", "Off")?;
        if let Err(e) = set("camera.gain", "Gain", &gain.to_string())? {
            set("", "GainRaw", &gain.round().to_string())?.map_err(|_| e)?;
        }
    }
    if let Some(fps) = settings.fps {
        let _ = set("", "AcquisitionFrameRateEnable", "true")?;
        let fps = fps.to_string();
        if let Err(e) = set("camera.fps", "AcquisitionFrameRate", &fps)? {
            set("", "AcquisitionFrameRateAbs", &fps)?.map_err(|_| e)?;
        }
    }
    for (name, value) in &settings.controls {
        let text = value.as_str().map_or_else(|| value.to_string(), ToOwned::to_owned);
        set(&format!("camera.controls.{name}"), name, &text)??;
    }
    Ok(features)
}

/// Tell the camera where to send its pictures, and in packets of which size; returns the size.
fn direct_stream(
    control: &Control,
    ours: Ipv4Addr,
    port: u16,
    settings: &CameraTable,
) -> Result<u32> {
    let refused = |e: String| failed("the camera does not take the stream's address", e);
    let bytes = settings.packet_bytes.unwrap_or(PACKET_BYTES);
    let size = stream_register(consts::STREAM_PACKET_SIZE);
    control.write(size, bytes | DO_NOT_FRAGMENT).map_err(refused)?;
    let given = control.read(size).map_err(refused)? & 0xffff;
    if !(576..=9000).contains(&given) {
        return Err(failed("the camera's packets", format!("{given} bytes")));
    }
    control
        .write(stream_register(consts::STREAM_DESTINATION_ADDRESS), ours.into())
        .map_err(refused)?;
    control
        .write(stream_register(consts::STREAM_DESTINATION_PORT), port.into())
        .map_err(refused)?;
    Ok(given)
}
