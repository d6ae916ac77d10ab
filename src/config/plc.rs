//! The tables of what a PLC is told, and by which wire; the encoder that it reads.

use super::ranges::range;
use crate::error::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

/// Which dimension is called length, and which width and height.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DimensionOrder {
    /// Length is the longer side of the footprint.
    LongestFirst,
    /// Length is the side of the footprint that points along the travel more than the other.
    TravelFirst,
    /// The largest of the three is the length, the smallest the height.
    Descending,
}

/// `[plc]`: what a PLC is told, by whatever wire.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Plc {
    /// Which dimension is which.
    pub order: DimensionOrder,
    /// Dimensions are rounded to multiples of this, the scale interval d.
    pub scale_interval_mm: f64,
    /// A parcel is published when the belt has carried it this far beyond the end of the zone.
    pub publish_after_mm: f64,
    /// Parcels wait in a queue until the PLC acknowledges them; one that finds it full is a fault.
    pub queue: bool,
    /// A PLC whose heartbeat stands still for this long is silent; 0: it has none.
    pub heartbeat_timeout_s: f64,
    /// Sequence number, boot counter and the last parcels are kept in this file over restarts,
    /// relative to the configuration file.
    pub state_file: Option<PathBuf>,
}

impl Default for Plc {
    fn default() -> Self {
        Self {
            order: DimensionOrder::LongestFirst,
            scale_interval_mm: 0.1,
            publish_after_mm: 0.0,
            queue: false,
            heartbeat_timeout_s: 0.0,
            state_file: None,
        }
    }
}

/// Which register of a two-register value comes first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WordOrder {
    /// The high word.
    #[default]
    HighFirst,
    /// The low word.
    LowFirst,
}

/// `[modbus]`: the server for the PLC.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Modbus {
    /// Address and port; 502 needs `CAP_NET_BIND_SERVICE`.
    #[schemars(with = "String")]
    pub listen: SocketAddr,
    /// Clients at once.
    pub connections_max: usize,
    /// A client silent for this long is disconnected.
    pub idle_timeout_s: u64,
    /// Only these addresses may connect; none given: all.
    pub allow: Vec<IpAddr>,
    /// Only these addresses may write: acknowledge, command, tell counts. None given: nobody. The address
    /// 0.0.0.0 stands for everybody.
    pub write_allow: Vec<IpAddr>,
    /// Of two-register values.
    pub word_order: WordOrder,
    /// Address of the map's first register.
    pub base_address: u16,
}

impl Default for Modbus {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([0, 0, 0, 0], 502)),
            connections_max: 16,
            idle_timeout_s: 60,
            allow: Vec::new(),
            write_allow: Vec::new(),
            word_order: WordOrder::HighFirst,
            base_address: 0,
        }
    }
}

/// `[can]`: the CAN bus of the PLC.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Can {
    /// Network interface; none given: no CAN.
    pub interface: Option<String>,
    /// Parcels as one CAN FD frame each, instead of several classical ones.
    pub fd: bool,
    /// Identifier of the first message; 16 are taken.
    pub base_id: u16,
    /// Bit rate to set up the interface with; none given: the system has set it up.
    pub bitrate: Option<u32>,
    /// Bit rate of the data of CAN FD frames; none given: the same.
    pub data_bitrate: Option<u32>,
}

impl Default for Can {
    fn default() -> Self {
        Self { interface: None, fd: false, base_id: 0x500, bitrate: None, data_bitrate: None }
    }
}

/// `[encoder]`: the belt's position as the PLC counts it.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Encoder {
    /// Belt travel of a count, negative when it counts backwards; none given: no encoder.
    pub mm_per_count: Option<f64>,
    /// The counter wraps around after this many bits.
    pub bits: u32,
    /// Without a count for this long the belt's texture takes over.
    pub timeout_s: f64,
}

impl Default for Encoder {
    fn default() -> Self {
        Self { mm_per_count: None, bits: 32, timeout_s: 0.2 }
    }
}

impl Plc {
    pub(super) fn check(&self) -> Result<()> {
        let steps = 10.0 * self.scale_interval_mm;
        if (steps - steps.round()).abs() > 1e-6 {
            let text = format!("plc.scale_interval_mm = {}", self.scale_interval_mm);
            return Err(Error::configuration(text)
                .allowed("whole tenths of a mm")
                .remedy("the registers count tenths of a mm: round it"));
        }
        Ok(())
    }
}

impl Can {
    pub(super) fn check(&self) -> Result<()> {
        let Some(name) = &self.interface else { return Ok(()) };
        if (1..16).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_graphic() && b != b'/')
        {
            return Ok(());
        }
        Err(Error::configuration(format!("can.interface = {name:?}"))
            .allowed("1 to 15 letters and digits, as `ip link` lists it")
            .remedy("give the name of a CAN interface, for example can0"))
    }
}

impl Encoder {
    pub(super) fn check(&self) -> Result<()> {
        if let Some(mm) = self.mm_per_count {
            range("encoder.mm_per_count, without its sign,", mm.abs(), 0.0001, 100.0, "mm")?;
        }
        Ok(())
    }
}
