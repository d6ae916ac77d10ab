//! The control channel of a camera: taken, kept alive and given back.
//!
//! A camera may ask for more time with every answer. Nothing here waits for it longer than
//! [`DEADLINE`]; one that has missed it is asked nothing more, and is opened anew.

use super::failed;
use crate::error::{Error, Result};
use std::net::Ipv4Addr;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::sync::Mutex;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use viva_genicam::genapi::{GenApiError, RegisterIo};
use viva_genicam::gige::{GVCP_PORT, GigeDevice, GigeError, consts};

/// Of one transaction. All tries of a camera that does not know single registers take 2.2 s; then
/// they are read as memory.
const DEADLINE: Duration = Duration::from_secs(3);
/// What a camera waits for us, unless it says otherwise: so the standard.
const HEARTBEAT_TIMEOUT_MS: u32 = 3000;
/// Signs of life within that time: three may be lost.
const SIGNS_OF_LIFE: u32 = 4;
/// Neither a flood nor too few to notice, ms.
const SIGN_OF_LIFE_MS: std::ops::RangeInclusive<u32> = 100..=2000;

/// Control over a camera, for as long as this lives.
pub struct Control {
    address: Ipv4Addr,
    device: Arc<Mutex<GigeDevice>>,
    /// What was asked when the camera missed the deadline.
    silent: OnceLock<String>,
    keepalive: JoinHandle<()>,
    runtime: tokio::runtime::Runtime,
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
        let taken = runtime.block_on(async { timeout(DEADLINE, claim(address)).await });
        let (device, period) =
            taken.map_err(|_| failed(missed("control")))?.map_err(|e| failed(e.to_string()))?;
        let device = Arc::new(Mutex::new(device));
        let keepalive = runtime.spawn(keep_alive(Arc::clone(&device), period));
        Ok(Self { address, device, silent: OnceLock::new(), keepalive, runtime })
    }

    /// One transaction with the camera; `what` names it.
    fn ask<T>(
        &self,
        what: impl Fn() -> String,
        transaction: impl AsyncFnOnce(&mut GigeDevice) -> std::result::Result<T, GigeError>,
    ) -> std::result::Result<T, String> {
        if let Some(missed) = self.silent.get() {
            return Err(missed.clone());
        }
        let answer = self.runtime.block_on(async {
            timeout(DEADLINE, async { transaction(&mut *self.device.lock().await).await }).await
        });
        match answer {
            Ok(answer) => answer.map_err(|e| e.to_string()),
            Err(_) => Err(self.silent.get_or_init(|| missed(&what())).clone()),
        }
    }

    /// That the camera has missed the deadline, if it has.
    pub fn silence(&self) -> Option<Error> {
        self.silent.get().map(|missed| failed("the camera is lost", missed))
    }

    /// Whether the camera is still ours.
    pub fn check(&self) -> Result<()> {
        let what = || "who controls it".to_owned();
        match self.ask(what, async |device| device.ping_control_channel().await) {
            Ok(true) => Ok(()),
            Ok(false) => Err(failed("the camera is lost", "another program has taken it")),
            Err(e) => Err(failed("the camera is lost", e)),
        }
        .map_err(|e| e.at(self.address))
    }

    /// A register of the protocol's own.
    pub fn read(&self, register: u64) -> std::result::Result<u32, String> {
        let bytes = self.memory(register, 4)?;
        bytes.try_into().map(u32::from_be_bytes).map_err(|_| "a short answer".to_owned())
    }

    /// Write one.
    pub fn write(&self, register: u64, value: u32) -> std::result::Result<(), String> {
        self.set_memory(register, &value.to_be_bytes())
    }

    fn memory(&self, address: u64, length: usize) -> std::result::Result<Vec<u8>, String> {
        let what = || format!("{length} bytes at register {address:#x}");
        self.ask(what, async |device| device.read_register_or_mem(address, length).await)
    }

    fn set_memory(&self, address: u64, data: &[u8]) -> std::result::Result<(), String> {
        let what = || format!("writing {} bytes at register {address:#x}", data.len());
        self.ask(what, async |device| device.write_register_or_mem(address, data).await)
    }
}

impl RegisterIo for Control {
    fn read(&self, address: u64, length: usize) -> std::result::Result<Vec<u8>, GenApiError> {
        self.memory(address, length).map_err(GenApiError::io)
    }

    fn write(&self, address: u64, data: &[u8]) -> std::result::Result<(), GenApiError> {
        self.set_memory(address, data).map_err(GenApiError::io)
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        self.keepalive.abort();
        // One that is gone does not hear it, and notices by itself.
        let _ = self.ask(String::new, async |device| device.release_control().await);
    }
}

fn missed(what: &str) -> String {
    format!("{what}: no answer within {} s, or only pleas for more time", DEADLINE.as_secs())
}

/// The camera under our control, and how often it wants a sign of life.
async fn claim(address: Ipv4Addr) -> std::result::Result<(GigeDevice, Duration), GigeError> {
    let mut device = GigeDevice::open((address, GVCP_PORT).into()).await?;
    device.claim_control().await?;
    // Without it slow answers are asked for again.
    let _ = device.enable_pending_ack().await;
    let told_ms = device.heartbeat_timeout_ms().await.ok().filter(|ms| *ms > 0);
    let (least_ms, most_ms) = (*SIGN_OF_LIFE_MS.start(), *SIGN_OF_LIFE_MS.end());
    let ms = told_ms.unwrap_or(HEARTBEAT_TIMEOUT_MS) / SIGNS_OF_LIFE;
    let period = Duration::from_millis(ms.clamp(least_ms, most_ms).into());
    // Also while it lets us wait.
    device.set_inflight_keepalive_period(Some(period));
    Ok((device, period))
}

/// What fails here is noticed by whoever asks next.
async fn keep_alive(device: Arc<Mutex<GigeDevice>>, period: Duration) {
    loop {
        tokio::time::sleep(period).await;
        let ping = async { device.lock().await.ping_control_channel().await };
        let _ = timeout(DEADLINE, ping).await;
    }
}

/// A register of the first stream channel.
pub fn stream_register(offset: u64) -> u64 {
    consts::STREAM_CHANNEL_BASE + offset
}
