//! The camera's features by name, through the description (GenICam XML) that the camera brings.
//!
//! That description is a stranger's program: an archive, a tree, formulas. So a child process
//! (`sandbox`) fetches, parses and evaluates it; this process reads and writes for it the registers
//! that it names, and holds nothing that was parsed. What stays trusted here: control packets and
//! their answers, of bounded length, which `viva-genicam` takes apart.

use crate::error::{Error, Result};
use crate::sandbox::{Sandbox, printable};
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::io::{BufRead, BufReader, ErrorKind, Read, Stdin, Stdout, Write};
use std::time::{Duration, Instant};
use viva_genicam::Camera;
use viva_genicam::genapi::{GenApiError, NodeMap, RegisterIo};

/// The child's task.
pub const TASK: &str = "camera-features";
/// Memory of the child; the largest descriptions of cameras need a tenth.
const MEMORY_BYTES: u64 = 256 << 20;
/// A description that is larger, as the camera stores it, is none.
const DESCRIPTION_BYTES_MAX: usize = 16 << 20;
/// Bytes of one reading or writing of registers.
const ACCESS_BYTES_MAX: usize = 4096;
/// Fetching the description and setting everything: well below what the watchdog waits.
const SETTING_UP: Duration = Duration::from_secs(20);
/// Stopping the camera.
const STOPPING: Duration = Duration::from_secs(2);

/// What this process wants of the child.
#[derive(Debug, Serialize, Deserialize)]
enum Order {
    Describe,
    Set { name: String, value: String },
    Start,
    Stop,
}

/// What the child wants of this process before it is done.
#[derive(Debug, Serialize, Deserialize)]
enum Request {
    Read { address: u64, length: usize },
    Write { address: u64, data: Vec<u8> },
    Done(std::result::Result<(), String>),
}

/// Bytes that were read, or why they were not.
pub type Answer = std::result::Result<Vec<u8>, String>;

/// The child that knows the features of one camera.
pub struct Features {
    child: Sandbox,
    until: Instant,
}

impl Features {
    /// Have the camera's description fetched and understood.
    pub fn of(io: &dyn RegisterIo) -> Result<Self> {
        let until = Instant::now() + SETTING_UP;
        let mut features = Self { child: Sandbox::start(TASK)?, until };
        features.carry_out(io, &Order::Describe)?.map_err(|e| {
            Error::failure(format!("the camera's description of itself: {e}"))
                .remedy("update the camera's firmware; if it is a stranger's, take it off the net")
        })?;
        Ok(features)
    }

    /// Set a feature, as text. The inner error is the camera's refusal.
    pub fn set(
        &mut self,
        io: &dyn RegisterIo,
        name: &str,
        value: &str,
    ) -> Result<std::result::Result<(), String>> {
        let order = Order::Set { name: name.to_owned(), value: value.to_owned() };
        self.carry_out(io, &order)
    }

    /// Start the pictures.
    pub fn start(&mut self, io: &dyn RegisterIo) -> Result<std::result::Result<(), String>> {
        self.carry_out(io, &Order::Start)
    }

    /// Stop the pictures. A camera that is gone does not hear it.
    pub fn stop(&mut self, io: &dyn RegisterIo) {
        self.until = Instant::now() + STOPPING;
        let _ = self.carry_out(io, &Order::Stop);
    }

    fn carry_out(
        &mut self,
        io: &dyn RegisterIo,
        order: &Order,
    ) -> Result<std::result::Result<(), String>> {
        self.send(order)?;
        loop {
            let line = self.child.read_line(self.until)?;
            let Ok(request) = serde_json::from_str(&line) else {
                return Err(self.child.end(ErrorKind::InvalidData));
            };
            let answer = match request {
                Request::Done(result) => return Ok(result.map_err(|e| printable(&e))),
                Request::Read { address, length } => within(address, length)
                    .and_then(|()| io.read(address, length).map_err(|e| e.to_string())),
                Request::Write { address, data } => within(address, data.len())
                    .and_then(|()| io.write(address, &data).map_err(|e| e.to_string()))
                    .map(|()| Vec::new()),
            };
            self.send::<Answer>(&answer)?;
        }
    }

    fn send<T: Serialize>(&mut self, message: &T) -> Result<()> {
        let line = serde_json::to_string(message)
            .map_err(|e| Error::failure(format!("a message that cannot be written: {e}")))?;
        self.child.write_line(&line, self.until)
    }
}

/// Registers have addresses of 32 bits.
fn within(address: u64, length: usize) -> std::result::Result<(), String> {
    let fits = length <= ACCESS_BYTES_MAX
        && address.checked_add(length as u64).is_some_and(|end| end <= 1 << 32);
    if fits {
        return Ok(());
    }
    Err(format!("no registers: {length} bytes at {address:#x}, at most {ACCESS_BYTES_MAX}"))
}

/// In the child: follow orders until there are no more.
pub fn serve() -> Result<()> {
    crate::sandbox::confine(MEMORY_BYTES)?;
    let pipe = Pipe(RefCell::new((BufReader::new(std::io::stdin()), std::io::stdout())));
    let mut camera = None;
    while let Some(order) = pipe.receive::<Order>()? {
        let result = match (order, &mut camera) {
            (Order::Describe, camera) => describe(|address, length| pipe.read_all(address, length))
                .map(|map| {
                    *camera = Some(Camera::new(&pipe, map));
                }),
            (_, None) => Err("no description yet".to_owned()),
            (Order::Set { name, value }, Some(camera)) => {
                camera.set(&name, &value).map_err(|e| e.to_string())
            }
            (Order::Start, Some(camera)) => camera.acquisition_start().map_err(|e| e.to_string()),
            (Order::Stop, Some(camera)) => camera.acquisition_stop().map_err(|e| e.to_string()),
        };
        // A refusal may quote the description at any length.
        pipe.send(&Request::Done(result.map_err(|e| printable(&e))))?;
    }
    Ok(())
}

/// Fetch and parse the description of the camera whose memory `read_all` reads.
pub fn describe(read_all: impl Fn(u64, usize) -> Answer) -> std::result::Result<NodeMap, String> {
    let fetch = viva_genapi_xml::fetch_and_load_xml(|address, length| {
        std::future::ready(read_all(address, length).map_err(viva_genapi_xml::XmlError::transport))
    });
    let runtime = tokio::runtime::Builder::new_current_thread().build();
    let xml = runtime.map_err(|e| e.to_string())?.block_on(fetch).map_err(|e| e.to_string())?;
    let model = viva_genapi_xml::parse(&xml).map_err(|e| e.to_string())?;
    NodeMap::try_from_xml(model).map_err(|e| e.to_string())
}

/// The child's way to the process above, and through it to the camera's registers.
struct Pipe(RefCell<(BufReader<Stdin>, Stdout)>);

impl Pipe {
    fn receive<T: for<'a> Deserialize<'a>>(&self) -> Result<Option<T>> {
        let mut line = String::new();
        let broken = |e: String| Error::failure(format!("the process above: {e}"));
        let reader = &mut self.0.borrow_mut().0;
        reader
            .by_ref()
            .take(crate::sandbox::LINE_BYTES_MAX as u64)
            .read_line(&mut line)
            .map_err(|e| broken(e.to_string()))?;
        if line.is_empty() {
            return Ok(None);
        }
        serde_json::from_str(&line).map(Some).map_err(|e| broken(e.to_string()))
    }

    fn send(&self, message: &Request) -> Result<()> {
        let writer = &mut self.0.borrow_mut().1;
        serde_json::to_writer(&mut *writer, message)
            .map_err(std::io::Error::from)
            .and_then(|()| writer.write_all(b"\n"))
            .and_then(|()| writer.flush())
            .map_err(|e| Error::failure(format!("the process above: {e}")))
    }

    fn ask(&self, request: &Request) -> Answer {
        self.send(request).map_err(|e| e.to_string())?;
        let answer = self.receive::<Answer>().map_err(|e| e.to_string())?;
        answer.unwrap_or_else(|| Err("the process above has ended".to_owned()))
    }

    /// Any stretch of the camera's memory that a description may take.
    fn read_all(&self, address: u64, length: usize) -> Answer {
        if length > DESCRIPTION_BYTES_MAX {
            return Err(format!("{length} bytes, at most {DESCRIPTION_BYTES_MAX}"));
        }
        let mut bytes = Vec::with_capacity(length);
        while bytes.len() < length {
            let address = address.saturating_add(bytes.len() as u64);
            let length = ACCESS_BYTES_MAX.min(length - bytes.len());
            let part = self.ask(&Request::Read { address, length })?;
            if part.is_empty() {
                return Err("the camera answers with nothing".to_owned());
            }
            bytes.extend(part);
        }
        Ok(bytes)
    }
}

impl RegisterIo for &Pipe {
    fn read(&self, address: u64, length: usize) -> std::result::Result<Vec<u8>, GenApiError> {
        self.ask(&Request::Read { address, length }).map_err(GenApiError::io)
    }

    fn write(&self, address: u64, data: &[u8]) -> std::result::Result<(), GenApiError> {
        let request = Request::Write { address, data: data.to_vec() };
        self.ask(&request).map(drop).map_err(GenApiError::io)
    }
}
