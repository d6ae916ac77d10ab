//! Modbus TCP server: `tokio-modbus` behind the guard, reading the register image.
//!
//! In: the link. Out: registers to any number of clients up to `modbus.connections_max`, beyond
//! which the one silent for longest is disconnected; clients that `modbus.allow` does not name are
//! turned away. Runs on its own thread; nothing here can block the vision thread.

use super::guard;
use super::link::{Link, Refusal};
use super::registers::MAP_VERSION;
use crate::config::Modbus as Settings;
use crate::error::{Error, Result};
use std::future::{Ready, ready};
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::io::DuplexStream;
use tokio::net::TcpStream;
use tokio_modbus::server::Service;
use tokio_modbus::{ExceptionCode, Request, Response};

/// How often the link is visited: new records and status reach the registers, requests leave.
const UPDATE_PERIOD: Duration = Duration::from_millis(2);
/// Bytes between guard and library: one request and one answer.
const PIPE_BYTES: usize = 1024;
/// Pause after the listener failed, which is when descriptors are short.
const ACCEPT_RETRY: Duration = Duration::from_millis(200);

type SharedLink = Arc<Mutex<Link>>;

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

/// Serve until `visit` returns false; it is called every [`UPDATE_PERIOD`].
pub fn serve(
    listener: TcpListener,
    settings: &Settings,
    link: Link,
    mut visit: impl FnMut(&mut Link) -> bool,
) -> Result<()> {
    let failed = |e: std::io::Error| Error::failure(format!("the Modbus server failed: {e}"));
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        let link: SharedLink = Arc::new(Mutex::new(link));
        let listener = tokio::net::TcpListener::from_std(listener).map_err(failed)?;
        tokio::spawn(accept(listener, settings.clone(), Arc::clone(&link)));
        let mut ticks = tokio::time::interval(UPDATE_PERIOD);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            let mut link = link.lock().unwrap_or_else(PoisonError::into_inner);
            if !visit(&mut link) {
                return Ok(());
            }
        }
    })
}

/// Accept clients for ever; a failing listener is tried again.
async fn accept(listener: tokio::net::TcpListener, settings: Settings, link: SharedLink) {
    let server = tokio_modbus::server::tcp::Server::new(listener);
    let clients = Mutex::new(Clients { max: settings.connections_max, connected: Vec::new() });
    let started = Instant::now();
    let on_connected = |stream: TcpStream, address: SocketAddr| {
        let allowed = is_allowed(&settings.allow, address.ip());
        if !allowed {
            tracing::warn!(%address, "Modbus client not in modbus.allow: turned away");
        }
        let _ = stream.set_nodelay(true);
        let idle = Duration::from_secs(settings.idle_timeout_s);
        let registers = Registers { link: Arc::clone(&link), base: settings.base_address };
        let (library_end, guard_end) = tokio::io::duplex(PIPE_BYTES);
        let last_request = Arc::new(AtomicU64::new(0));
        let seen = Arc::clone(&last_request);
        let note_request = move || {
            seen.store(started.elapsed().as_millis() as u64, Ordering::Relaxed);
        };
        note_request();
        let connection = tokio::spawn(async move {
            if !allowed {
                return;
            }
            tracing::info!(%address, "Modbus client connected");
            let reason = guard::serve(stream, guard_end, idle, note_request).await;
            tracing::info!(%address, ?reason, "Modbus client disconnected");
        });
        let client = Client { last_request, connection: connection.abort_handle() };
        if allowed {
            clients.lock().unwrap_or_else(PoisonError::into_inner).admit(client);
        }
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

/// Whether a client may connect. An IPv4 client of an IPv6 socket is the same client.
fn is_allowed(allow: &[IpAddr], client: IpAddr) -> bool {
    allow.is_empty() || allow.iter().any(|a| a.to_canonical() == client.to_canonical())
}

/// The library's view of the registers.
struct Registers {
    link: SharedLink,
    base: u16,
}

impl Service for Registers {
    type Request = Request<'static>;
    type Response = Response;
    type Exception = ExceptionCode;
    type Future = Ready<std::result::Result<Response, ExceptionCode>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        // One lock a request: a block read in one request is never torn.
        let mut link = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        ready(answer(&mut link, self.base, request))
    }
}

fn answer(
    link: &mut Link,
    base: u16,
    request: Request<'_>,
) -> std::result::Result<Response, ExceptionCode> {
    let beyond = ExceptionCode::IllegalDataAddress;
    let at = |address: u16| address.checked_sub(base).ok_or(beyond);
    let refused = |refusal| match refusal {
        Refusal::Address => ExceptionCode::IllegalDataAddress,
        Refusal::Value => ExceptionCode::IllegalDataValue,
    };
    Ok(match request {
        Request::ReadHoldingRegisters(address, count) => {
            Response::ReadHoldingRegisters(link.read(at(address)?, count).ok_or(beyond)?.to_vec())
        }
        Request::ReadInputRegisters(address, count) => {
            Response::ReadInputRegisters(link.read(at(address)?, count).ok_or(beyond)?.to_vec())
        }
        Request::ReadCoils(address, count) => {
            Response::ReadCoils(link.bits(at(address)?, count).ok_or(beyond)?.collect())
        }
        Request::ReadDiscreteInputs(address, count) => {
            Response::ReadDiscreteInputs(link.bits(at(address)?, count).ok_or(beyond)?.collect())
        }
        Request::WriteSingleRegister(address, value) => {
            link.write(at(address)?, &[value], Instant::now()).map_err(refused)?;
            Response::WriteSingleRegister(address, value)
        }
        Request::WriteMultipleRegisters(address, values) => {
            link.write(at(address)?, &values, Instant::now()).map_err(refused)?;
            Response::WriteMultipleRegisters(address, values.len() as u16)
        }
        _ => return Err(ExceptionCode::IllegalFunction),
    })
}

/// What FC 43/14 tells: vendor, product, version of product and map.
pub(super) fn identification() -> [(u8, String); 4] {
    let map = format!("register map {}.{}", MAP_VERSION >> 8, MAP_VERSION & 0xff);
    [
        (0, "Beltgauge".to_owned()),
        (1, "Beltgauge".to_owned()),
        (2, env!("CARGO_PKG_VERSION").to_owned()),
        (4, map),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Plc, WordOrder};
    use crate::plc::journal::Journal;

    #[test]
    fn the_map_begins_at_the_base_address_and_words_come_in_the_order_asked_for() {
        let mut link = Link::new(
            Plc::default(),
            WordOrder::LowFirst,
            false,
            Journal::default(),
            Instant::now(),
        );
        let mut read =
            |address, count| answer(&mut link, 1000, Request::ReadHoldingRegisters(address, count));
        let words = vec![0x4247, MAP_VERSION, 0x5678, 0x1234];
        assert_eq!(read(1000, 4), Ok(Response::ReadHoldingRegisters(words)));
        for (address, count) in [(999, 1), (0, 4), (1000 + 1224, 1), (65535, 1)] {
            assert_eq!(read(address, count), Err(ExceptionCode::IllegalDataAddress));
        }
        let count = Request::WriteMultipleRegisters(1062, vec![7, 1].into());
        assert_eq!(answer(&mut link, 1000, count), Ok(Response::WriteMultipleRegisters(1062, 2)));
        assert_eq!(link.next_count().map(|(count, _)| count), Some(0x1_0007));
        let elsewhere = Request::WriteSingleRegister(60, 1);
        let refused = answer(&mut link, 1000, elsewhere);
        assert_eq!(refused, Err(ExceptionCode::IllegalDataAddress));
    }

    #[test]
    fn only_clients_on_the_list_are_let_in() {
        let ip = |text: &str| text.parse::<IpAddr>().expect("an address");
        assert!(is_allowed(&[], ip("10.0.0.9")));
        let allow = [ip("10.0.0.1"), ip("fe80::1")];
        for (client, expected) in [
            ("10.0.0.1", true),
            ("::ffff:10.0.0.1", true),
            ("fe80::1", true),
            ("10.0.0.9", false),
            ("::ffff:10.0.0.9", false),
        ] {
            assert_eq!(is_allowed(&allow, ip(client)), expected, "{client}");
        }
    }
}
