//! A CAN bus as the kernel gives it, or a test.

use super::frames::Payload;
use socketcan::{
    CanAnyFrame, CanDataFrame, CanFdFrame, CanFdSocket, EmbeddedFrame, Frame as _, Socket,
    SocketOptions, StandardId,
};
use std::io::{Error, ErrorKind};

/// What a bus brings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// A data frame with a standard identifier.
    Frame {
        /// Its identifier.
        id: u16,
        /// Its bytes.
        payload: Payload,
    },
    /// An error frame of the driver, `linux/can/error.h`.
    Error {
        /// Classes of errors, as bits.
        class: u32,
        /// Details.
        data: [u8; 8],
    },
    /// Something that is none of ours.
    Other,
}

/// A CAN bus: the kernel's, or a test's.
pub trait Bus: Sized {
    /// Open an interface, for CAN FD if so asked.
    fn open(interface: &str, fd: bool) -> std::io::Result<Self>;
    /// Whether an interface is on its bus, where that is known.
    fn carrier(interface: &str) -> Option<bool>;
    /// Send a frame, or fail at once with [`ErrorKind::WouldBlock`] or `ENOBUFS`.
    fn send(&mut self, id: u16, payload: &[u8], fd: bool) -> std::io::Result<()>;
    /// The next event, [`ErrorKind::WouldBlock`] when there is none.
    fn receive(&mut self) -> std::io::Result<Event>;
}

impl Bus for CanFdSocket {
    fn open(interface: &str, fd: bool) -> std::io::Result<Self> {
        let socket = <Self as Socket>::open(interface)?;
        let mtu = attribute(interface, "mtu").and_then(|mtu| mtu.parse::<usize>().ok());
        if fd && mtu.is_some_and(|mtu| mtu < FD_MTU) {
            let text = "it takes no CAN FD: set it up with `fd on`, or can.fd to false";
            return Err(Error::new(ErrorKind::Unsupported, text));
        }
        socket.set_nonblocking(true)?;
        socket.set_error_filter_accept_all()?;
        Ok(socket)
    }

    fn carrier(interface: &str) -> Option<bool> {
        // An interface that is down has none to tell.
        attribute(interface, "carrier").map(|carrier| carrier == "1")
    }

    fn send(&mut self, id: u16, payload: &[u8], fd: bool) -> std::io::Result<()> {
        let wrong = || Error::from(ErrorKind::InvalidInput);
        let id = StandardId::new(id).ok_or_else(wrong)?;
        if fd {
            self.write_frame(&CanFdFrame::new(id, payload).ok_or_else(wrong)?)
        } else {
            self.write_frame(&CanDataFrame::new(id, payload).ok_or_else(wrong)?)
        }
    }

    fn receive(&mut self) -> std::io::Result<Event> {
        let data = |id: u32, extended: bool, bytes: &[u8]| {
            if extended {
                return Event::Other;
            }
            // A frame of the kernel has at most 64 bytes.
            Payload::from_slice(bytes)
                .map_or(Event::Other, |payload| Event::Frame { id: id as u16, payload })
        };
        Ok(match self.read_frame()? {
            CanAnyFrame::Normal(frame) => data(frame.raw_id(), frame.is_extended(), frame.data()),
            CanAnyFrame::Fd(frame) => data(frame.raw_id(), frame.is_extended(), frame.data()),
            CanAnyFrame::Remote(_) => Event::Other,
            CanAnyFrame::Error(frame) => {
                let mut bytes = [0; 8];
                for (byte, value) in bytes.iter_mut().zip(frame.data()) {
                    *byte = *value;
                }
                Event::Error { class: frame.error_bits(), data: bytes }
            }
        })
    }
}

/// The kernel's frame of CAN FD, bytes.
const FD_MTU: usize = 72;

/// What the kernel tells of an interface.
fn attribute(interface: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(format!("/sys/class/net/{interface}/{name}")).ok()?;
    Some(text.trim().to_owned())
}

/// The bus takes or has no frame at the moment.
pub(super) fn would_block(error: &Error) -> bool {
    let no_buffers = rustix::io::Errno::NOBUFS.raw_os_error();
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted)
        || error.raw_os_error() == Some(no_buffers)
}
