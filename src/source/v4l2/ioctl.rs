//! Questions to a device that the `v4l` crate answers with a panic when the device names itself in
//! something else than UTF-8.
#![allow(unsafe_code)] // ioctl has no other interface; the one call is here

use std::io;
use v4l::Device;
use v4l::v4l_sys::{
    V4L2_CAP_STREAMING, V4L2_CAP_VIDEO_CAPTURE, V4L2_CTRL_FLAG_NEXT_CTRL, v4l2_capability,
    v4l2_queryctrl,
};
use v4l::v4l2::vidioc::{self, _IOC_TYPE};

/// One ioctl.
///
/// # Safety
/// `T` must be the type that the kernel expects with `request`.
pub(super) unsafe fn ioctl<T>(
    device: &Device,
    request: _IOC_TYPE,
    argument: &mut T,
) -> io::Result<()> {
    let argument = std::ptr::from_mut(argument).cast();
    // SAFETY: the caller gives the type that belongs to the request.
    unsafe { v4l::v4l2::ioctl(device.handle().fd(), request, argument) }
}

/// A zeroed structure of the kernel's.
///
/// # Safety
/// All zeros must be a `T`.
pub(super) unsafe fn zeroed<T>() -> T {
    // SAFETY: the caller promises.
    unsafe { std::mem::zeroed() }
}

/// What a device is.
pub struct Identity {
    /// Name of the model.
    pub card: String,
    /// Where it is plugged in.
    pub bus: String,
    /// It captures into buffers.
    pub captures: bool,
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

/// Ask a device what it is.
pub fn identity(device: &Device) -> io::Result<Identity> {
    // SAFETY: plain numbers; and QUERYCAP takes this type.
    let capability = unsafe {
        let mut capability: v4l2_capability = zeroed();
        ioctl(device, vidioc::VIDIOC_QUERYCAP, &mut capability)?;
        capability
    };
    let needed = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
    Ok(Identity {
        card: text(&capability.card),
        bus: text(&capability.bus_info),
        captures: capability.device_caps & needed == needed,
    })
}

/// One control of a device.
pub struct ControlRange {
    /// Its number.
    pub id: u32,
    /// Its name as `v4l2-ctl --list-ctrls` prints it: lower case, underscores.
    pub name: String,
    /// Smallest value.
    pub min: i64,
    /// Largest value.
    pub max: i64,
}

/// All controls of a device.
pub fn controls(device: &Device) -> Vec<ControlRange> {
    const CONTROLS_MAX: usize = 1000;
    let (mut found, mut id) = (Vec::new(), 0);
    while found.len() < CONTROLS_MAX {
        // SAFETY: plain numbers; and QUERYCTRL takes this type.
        let query = unsafe {
            let mut query: v4l2_queryctrl = zeroed();
            query.id = id | V4L2_CTRL_FLAG_NEXT_CTRL;
            if ioctl(device, vidioc::VIDIOC_QUERYCTRL, &mut query).is_err() {
                break;
            }
            query
        };
        id = query.id;
        let (min, max) = (i64::from(query.minimum), i64::from(query.maximum));
        found.push(ControlRange { id, name: control_name(&text(&query.name)), min, max });
    }
    found
}

fn control_name(text: &str) -> String {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("_")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_devices_are_read_whatever_they_hold() {
        assert_eq!(text(b"Cam\xff 1\0rest"), "Cam\u{fffd} 1");
        assert_eq!(text(b"no end"), "no end");
        assert_eq!(control_name("White Balance, Automatic"), "white_balance_automatic");
    }
}
