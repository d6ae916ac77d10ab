//! The CAN interface's bit rates, set when the configuration names them; else they are the system's.

use crate::config::Can;
use crate::error::{Error, Result};
use socketcan::nl::{CanBitTiming, CanCtrlModes, InterfaceCanParams};
use socketcan::{CanCtrlMode, CanInterface};

/// The controller comes back from bus off by itself after this.
const RESTART_MS: u32 = 100;

/// All at once: the kernel takes CAN FD only together with both bit rates.
fn params(bitrate: u32, can: &Can) -> InterfaceCanParams {
    let timing = |bitrate| Some(CanBitTiming { bitrate, ..CanBitTiming::default() });
    let data_bitrate = can.fd.then_some(can.data_bitrate.unwrap_or(bitrate));
    InterfaceCanParams {
        bit_timing: timing(bitrate),
        data_bit_timing: data_bitrate.and_then(timing),
        ctrl_mode: can.fd.then(|| CanCtrlModes::from_mode(CanCtrlMode::Fd, true)),
        restart_ms: Some(RESTART_MS),
        ..InterfaceCanParams::default()
    }
}

/// The kernel's number of a configuration's interface while it is there: another one after it was
/// plugged in again.
pub fn index(can: &Can) -> Option<u32> {
    let path = format!("/sys/class/net/{}/ifindex", can.interface.as_ref()?);
    std::fs::read_to_string(path).ok()?.trim().parse().ok()
}

/// Set up the interface of a configuration, if it gives a bit rate.
pub fn set_up(can: &Can) -> Result<()> {
    let (Some(name), Some(bitrate)) = (&can.interface, can.bitrate) else { return Ok(()) };
    let set = || -> std::result::Result<(), socketcan::Error> {
        let interface = CanInterface::open(name)?;
        // A controller takes them only while it is down.
        interface.bring_down()?;
        interface.set_can_params(&params(bitrate, can))?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bit_rates_and_mode_go_to_the_kernel_in_one_message() {
        let fd = Can { fd: true, data_bitrate: Some(2_000_000), ..Can::default() };
        let both = params(500_000, &fd);
        let rate = |timing: Option<CanBitTiming>| timing.map(|timing| timing.bitrate);
        assert_eq!(
            (rate(both.bit_timing), rate(both.data_bit_timing)),
            (Some(500_000), Some(2_000_000))
        );
        assert!(both.ctrl_mode.is_some_and(|modes| modes.has_mode(CanCtrlMode::Fd)));
        let same = params(500_000, &Can { data_bitrate: None, ..fd });
        assert_eq!(rate(same.data_bit_timing), Some(500_000));
        let classical = params(250_000, &Can::default());
        assert_eq!(
            (rate(classical.bit_timing), rate(classical.data_bit_timing)),
            (Some(250_000), None)
        );
        assert!(classical.ctrl_mode.is_none() && classical.restart_ms == Some(RESTART_MS));
    }
}
