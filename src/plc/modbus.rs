//! Modbus TCP server: `tokio-modbus` behind the guard, reading the register image.
//!
//! In: parcel records from a ring, status. Out: registers to any number of clients up to
//! `modbus.connections_max`, beyond which the one silent for longest is disconnected. Owns: the register image. Runs on its own thread; nothing here
//! can block the vision thread.

use super::guard;
use super::registers::{RegisterImage, Status};
use crate::config::Modbus as Settings;
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use std::future::{Ready, ready};
use std::net::{SocketAddr, TcpListener};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::io::DuplexStream;
use tokio::net::TcpStream;
use tokio_modbus::server::Service;
use tokio_modbus::{ExceptionCode, Request, Response};

/// How often new records and status reach the registers.
const UPDATE_PERIOD: Duration = Duration::from_millis(2);
/// Bytes between guard and library: one request and one answer.
const PIPE_BYTES: usize = 1024;
/// Pause after the listener failed, which is when descriptors are short.
const ACCEPT_RETRY: Duration = Duration::from_millis(200);

type SharedImage = Arc<Mutex<RegisterImage>>;

/// Bind the server's socket, before any thread is started.
pub fn bind(settings: &Settings) -> Result<TcpListener> {
    let bound =
        TcpListener::bind(settings.listen).and_then(|l| l.set_nonblocking(true).map(|()| l));
    bound.map_err(|e| {
        let remedy = match e.kind() {
            std::io::ErrorKind::AddrInUse => "stop the other server, or choose another port",
            std::io::ErrorKind::PermissionDenied => {
                "ports below 1024 need the capability: setcap cap_net_bind_service=+ep beltgauge"
            }
            _ => "give an address of this machine and a free port",
        };
        Error::failure(format!("cannot listen for Modbus clients: {e}"))
            .at(format!("modbus.listen = {}", settings.listen))
            .allowed("an address of this machine, a port that nobody else uses")
            .remedy(remedy)
    })
}

/// Serve until `next` says stop. `next` is called every [`UPDATE_PERIOD`]; it takes new
/// records to the closure it is given and returns the status, or `None` to stop.
pub fn serve(
    listener: TcpListener,
    settings: &Settings,
    mut next: impl FnMut(&mut dyn FnMut(&ParcelRecord)) -> Option<Status>,
) -> Result<()> {
    let failed = |e: std::io::Error| Error::failure(format!("the Modbus server failed: {e}"));
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        let image: SharedImage = Arc::default();
        let listener = tokio::net::TcpListener::from_std(listener).map_err(failed)?;
        tokio::spawn(accept(listener, settings.clone(), Arc::clone(&image)));
        let mut ticks = tokio::time::interval(UPDATE_PERIOD);
        loop {
            ticks.tick().await;
            let mut image = image.lock().unwrap_or_else(PoisonError::into_inner);
            match next(&mut |record| image.publish(record)) {
                Some(status) => image.set_status(&status),
                None => return Ok(()),
            }
        }
    })
}

/// Accept clients for ever; a failing listener is tried again.
async fn accept(listener: tokio::net::TcpListener, settings: Settings, image: SharedImage) {
    let server = tokio_modbus::server::tcp::Server::new(listener);
    let clients = Mutex::new(Clients { max: settings.connections_max, connected: Vec::new() });
    let started = Instant::now();
    let on_connected = |stream: TcpStream, address: SocketAddr| {
        let _ = stream.set_nodelay(true);
        let idle = Duration::from_secs(settings.idle_timeout_s);
        let registers = Registers(Arc::clone(&image));
        let (library_end, guard_end) = tokio::io::duplex(PIPE_BYTES);
        let last_request = Arc::new(AtomicU64::new(0));
        let seen = Arc::clone(&last_request);
        let note_request = move || {
            seen.store(started.elapsed().as_millis() as u64, Ordering::Relaxed);
        };
        note_request();
        let connection = tokio::spawn(async move {
            tracing::info!(%address, "Modbus client connected");
            let reason = guard::serve(stream, guard_end, idle, note_request).await;
            tracing::info!(%address, ?reason, "Modbus client disconnected");
        });
        let client = Client { last_request, connection: connection.abort_handle() };
        clients.lock().unwrap_or_else(PoisonError::into_inner).admit(client);
        async move { Ok(Some((registers, library_end))) }
    };
    loop {
        let ended: std::io::Result<()> =
            server.serve::<Registers, DuplexStream, _, _, _>(&on_connected, |_| {}).await;
        tracing::error!(?ended, "Modbus listener failed; trying again");
        tokio::time::sleep(ACCEPT_RETRY).await;
    }
}

/// The connected clients.
struct Clients {
    max: usize,
    connected: Vec<Client>,
}

struct Client {
    /// When it last asked for something, ms since the server started.
    last_request: Arc<AtomicU64>,
    connection: tokio::task::AbortHandle,
}

impl Clients {
    /// Take a client in. When there are too many, the one silent for longest has to go: a PLC
    /// that has been restarted must get in, whatever it left half-open before.
    fn admit(&mut self, client: Client) {
        self.connected.retain(|c| !c.connection.is_finished());
        if self.connected.len() >= self.max {
            let silence = |c: &Client| c.last_request.load(Ordering::Relaxed);
            let longest = (0..self.connected.len()).min_by_key(|&i| silence(&self.connected[i]));
            if let Some(i) = longest {
                self.connected.swap_remove(i).connection.abort();
            }
        }
        self.connected.push(client);
    }
}

/// The library's view of the registers.
struct Registers(SharedImage);

impl Service for Registers {
    type Request = Request<'static>;
    type Response = Response;
    type Exception = ExceptionCode;
    type Future = Ready<std::result::Result<Response, ExceptionCode>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        // One lock a request: a block read in one request is never torn.
        let image = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let read = |address, count| {
            image.read(address, count).map(<[u16]>::to_vec).ok_or(ExceptionCode::IllegalDataAddress)
        };
        ready(match request {
            Request::ReadHoldingRegisters(address, count) => {
                read(address, count).map(Response::ReadHoldingRegisters)
            }
            Request::ReadInputRegisters(address, count) => {
                read(address, count).map(Response::ReadInputRegisters)
            }
            _ => Err(ExceptionCode::IllegalFunction),
        })
    }
}
