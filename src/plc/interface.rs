//! The CAN interface's bit rates, set when the configuration names them; else they are the system's.

use crate::config::Can;
use crate::error::{Error, Result};
use socketcan::{CanCtrlMode, CanInterface};

/// The controller comes back from bus off by itself after this.
const RESTART_MS: u32 = 100;

/// Set up the interface of a configuration, if it gives a bit rate.
pub fn set_up(can: &Can) -> Result<()> {
    let (Some(name), Some(bitrate)) = (&can.interface, can.bitrate) else { return Ok(()) };
    let set = || -> std::result::Result<(), socketcan::Error> {
        let interface = CanInterface::open(name)?;
        // A controller takes them only while it is down.
        interface.bring_down()?;
        interface.set_bitrate(bitrate, None)?;
        if can.fd {
            interface.set_data_bitrate(can.data_bitrate.unwrap_or(bitrate), None)?;
            interface.set_ctrlmode(CanCtrlMode::Fd, true)?;
        }
        interface.set_restart_ms(RESTART_MS)?;
        interface.bring_up()
    };
    set().map_err(|e| {
        Error::failure(format!("can.bitrate = {bitrate}: {name} cannot be set up: {e}"))
            .allowed("what the controller can do, with CAP_NET_ADMIN")
            .remedy(
                "set it up with `ip link set ... type can bitrate ...` and leave can.bitrate out",
            )
    })
}
