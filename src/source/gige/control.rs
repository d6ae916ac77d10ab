//! The control channel of a camera: taken, kept alive and given back.

use super::failed;
use crate::error::Result;
use std::net::Ipv4Addr;
use viva_genicam::genapi::RegisterIo;
use viva_genicam::gige::{GVCP_PORT, GigeDevice, consts};
use viva_genicam::{ControlState, GigeRegisterIo};

/// Control over a camera, for as long as this lives. Dropped in this order: giving control back
/// needs the runtime.
pub struct Control {
    registers: GigeRegisterIo,
    _runtime: tokio::runtime::Runtime,
}

impl Control {
    /// Take control of the camera at an address; nothing of its description is read.
    pub fn take(address: Ipv4Addr) -> Result<Self> {
        let failed = |e: String| failed("cannot control the camera", e).at(address);
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("camera-control")
            .enable_all()
            .build()
            .map_err(|e| failed(e.to_string()))?;
        let device = runtime.block_on(async {
            let mut device = GigeDevice::open((address, GVCP_PORT).into()).await?;
            device.claim_control().await?;
            // Without it slow answers are asked for again.
            let _ = device.enable_pending_ack().await;
            Ok::<_, viva_genicam::gige::GigeError>(device)
        });
        let device = device.map_err(|e| failed(e.to_string()))?;
        let registers = GigeRegisterIo::new(runtime.handle().clone(), device);
        Ok(Self { registers, _runtime: runtime })
    }

    /// The camera's registers.
    pub fn registers(&self) -> &dyn RegisterIo {
        &self.registers
    }

    /// Whether the camera is still ours.
    pub fn check(&self) -> Result<()> {
        match self.registers.refresh_control_state() {
            Ok(ControlState::Held) => Ok(()),
            Ok(_) => Err(failed("the camera is lost", "another program has taken it")),
            Err(e) => Err(failed("the camera is lost", e)),
        }
    }

    /// A register of the protocol's own.
    pub fn read(&self, register: u64) -> std::result::Result<u32, String> {
        let bytes = self.registers.read(register, 4).map_err(|e| e.to_string())?;
        bytes.try_into().map(u32::from_be_bytes).map_err(|_| "a short answer".to_owned())
    }

    /// Write one.
    pub fn write(&self, register: u64, value: u32) -> std::result::Result<(), String> {
        self.registers.write(register, &value.to_be_bytes()).map_err(|e| e.to_string())
    }
}

/// A register of the first stream channel.
pub fn stream_register(offset: u64) -> u64 {
    consts::STREAM_CHANNEL_BASE + offset
}
