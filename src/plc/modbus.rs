//! Modbus TCP server: `tokio-modbus` behind the guard, reading the register image.
//!
//! In: the link. Out: registers to clients, `modbus.connections_max` that ask at once; those that `modbus.allow`
//! does not name are turned away, and only those that `modbus.write_allow` names may write. A write is
//! answered when the disk has what it changed. Runs on its own thread; nothing here can block the
//! vision thread.

use super::clients::{Asked, ClientList};
use super::command::Sender;
use super::guard;
use super::link::{Link, Refusal};
use super::log_limit::LogLimit;
use super::registers::MAP_VERSION;
use crate::config::Modbus as Settings;
use crate::error::{Error, Result};
use std::future::ready;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
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
    clients: ClientList,
    link: Link,
    mut visit: impl FnMut(&mut Link) -> bool,
) -> Result<()> {
    let failed = |e: std::io::Error| Error::failure(format!("the Modbus server failed: {e}"));
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        let link: SharedLink = Arc::new(Mutex::new(link));
        let listener = tokio::net::TcpListener::from_std(listener).map_err(failed)?;
        tokio::spawn(accept(listener, settings.clone(), clients, Arc::clone(&link)));
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
async fn accept(
    listener: tokio::net::TcpListener,
    settings: Settings,
    clients: ClientList,
    link: SharedLink,
) {
    let server = tokio_modbus::server::tcp::Server::new(listener);
    let connects = Arc::new(Mutex::new(LogLimit::default()));
    let refused_writes = Arc::new(Mutex::new(LogLimit::default()));
    let on_connected = |stream: TcpStream, address: SocketAddr| {
        let allowed = is_allowed(&settings.allow, address.ip());
        let told = lock(&connects).admits(Instant::now());
        if let Some(before) = told {
            tracing::info!(%address, allowed, not_logged_before = before, "Modbus client connects");
        }
        let _ = stream.set_nodelay(true);
        let idle = Duration::from_secs(settings.idle_timeout_s);
        let registers = Registers {
            link: Arc::clone(&link),
            base: settings.base_address,
            client: address.ip().to_canonical(),
            may_write: may_write(&settings.write_allow, address.ip()),
            refused_writes: Arc::clone(&refused_writes),
        };
        let (library_end, guard_end) = tokio::io::duplex(PIPE_BYTES);
        let asked = Asked::new(may_write(&settings.write_allow, address.ip())).from(address);
        let asked = Arc::new(asked);
        let note_request = {
            let (asked, clients) = (Arc::clone(&asked), clients.clone());
            move || {
                if asked.note() {
                    clients.lock().has_asked(&asked);
                }
            }
        };
        let connection = tokio::spawn(async move {
            if !allowed {
                return;
            }
            let ended = guard::serve(stream, guard_end, idle, note_request).await;
            if told.is_some() {
                tracing::info!(%address, ?ended, "Modbus client disconnected");
            }
        });
        if allowed {
            clients.lock().admit(asked, connection.abort_handle());
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

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Whether a client may connect. An IPv4 client of an IPv6 socket is the same client.
fn is_allowed(allow: &[IpAddr], client: IpAddr) -> bool {
    allow.is_empty() || allow.iter().any(|a| a.to_canonical() == client.to_canonical())
}

/// Whether a client may write. The unspecified address stands for everybody.
fn may_write(allow: &[IpAddr], client: IpAddr) -> bool {
    let is = |a: &IpAddr| a.is_unspecified() || a.to_canonical() == client.to_canonical();
    allow.iter().any(is)
}

/// The library's view of the registers.
struct Registers {
    link: SharedLink,
    base: u16,
    client: IpAddr,
    may_write: bool,
    refused_writes: Arc<Mutex<LogLimit>>,
}

impl Service for Registers {
    type Request = Request<'static>;
    type Response = Response;
    type Exception = ExceptionCode;
    type Future =
        Pin<Box<dyn Future<Output = std::result::Result<Response, ExceptionCode>> + Send>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        if writes(&request) && !self.may_write {
            if let Some(before) = lock(&self.refused_writes).admits(Instant::now()) {
                let client = self.client;
                tracing::warn!(%client, not_logged_before = before,
                    "write refused: the client is not in modbus.write_allow");
            }
            return Box::pin(ready(Err(ExceptionCode::IllegalFunction)));
        }
        let link = Arc::clone(&self.link);
        // One lock a request: a block read in one request is never torn.
        let answered = answer(&mut lock(&link), self.base, Sender::Modbus(self.client), request);
        Box::pin(async move {
            let (response, noted) = answered?;
            // What was written is on the disk before the client is told so.
            while !lock(&link).is_kept(noted) {
                tokio::time::sleep(UPDATE_PERIOD).await;
            }
            Ok(response)
        })
    }
}

fn writes(request: &Request<'_>) -> bool {
    matches!(
        request,
        Request::WriteSingleRegister(..)
            | Request::WriteMultipleRegisters(..)
            | Request::ReadWriteMultipleRegisters(..)
    )
}

/// The response, and what [`Link::is_kept`] must say before it is sent.
fn answer(
    link: &mut Link,
    base: u16,
    sender: Sender,
    request: Request<'_>,
) -> std::result::Result<(Response, u64), ExceptionCode> {
    let beyond = ExceptionCode::IllegalDataAddress;
    let at = |address: u16| address.checked_sub(base).ok_or(beyond);
    let refused = |refusal| match refusal {
        Refusal::Address => ExceptionCode::IllegalDataAddress,
        Refusal::Value => ExceptionCode::IllegalDataValue,
    };
    let read = |link: &Link, address: u16, count: u16| {
        link.read(at(address)?, count).map(<[u16]>::to_vec).ok_or(beyond)
    };
    let write = |link: &mut Link, address: u16, values: &[u16]| {
        link.write(at(address)?, values, sender, Instant::now()).map_err(refused)
    };
    Ok(match request {
        Request::ReadHoldingRegisters(address, count) => {
            (Response::ReadHoldingRegisters(read(link, address, count)?), 0)
        }
        Request::ReadInputRegisters(address, count) => {
            (Response::ReadInputRegisters(read(link, address, count)?), 0)
        }
        Request::ReadCoils(address, count) => {
            (Response::ReadCoils(link.bits(at(address)?, count).ok_or(beyond)?.collect()), 0)
        }
        Request::ReadDiscreteInputs(address, count) => {
            let bits = link.bits(at(address)?, count).ok_or(beyond)?.collect();
            (Response::ReadDiscreteInputs(bits), 0)
        }
        Request::WriteSingleRegister(address, value) => {
            let noted = write(link, address, &[value])?;
            (Response::WriteSingleRegister(address, value), noted)
        }
        Request::WriteMultipleRegisters(address, values) => {
            let noted = write(link, address, &values)?;
            (Response::WriteMultipleRegisters(address, values.len() as u16), noted)
        }
        Request::ReadWriteMultipleRegisters(address, count, write_address, values) => {
            // Whole or not at all: what cannot be read is not written either.
            read(link, address, count)?;
            let noted = write(link, write_address, &values)?;
            (Response::ReadWriteMultipleRegisters(read(link, address, count)?), noted)
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
        let mut answer = |request| answer(&mut link, 1000, Sender::Can, request).map(|(r, _)| r);
        let mut read = |address, count| answer(Request::ReadHoldingRegisters(address, count));
        let words = vec![0x4247, MAP_VERSION, 0x5678, 0x1234];
        assert_eq!(read(1000, 4), Ok(Response::ReadHoldingRegisters(words)));
        for (address, count) in [(999, 1), (0, 4), (1000 + 1224, 1), (65535, 1)] {
            assert_eq!(read(address, count), Err(ExceptionCode::IllegalDataAddress));
        }
        let count = Request::WriteMultipleRegisters(1062, vec![7, 1].into());
        assert_eq!(answer(count), Ok(Response::WriteMultipleRegisters(1062, 2)));
        let elsewhere = answer(Request::WriteSingleRegister(60, 1));
        assert_eq!(elsewhere, Err(ExceptionCode::IllegalDataAddress));
        let both = |read_at, write_at| {
            Request::ReadWriteMultipleRegisters(read_at, 2, write_at, vec![9, 1].into())
        };
        for (read_at, write_at) in [(999, 1062), (1062, 999)] {
            assert_eq!(answer(both(read_at, write_at)), Err(ExceptionCode::IllegalDataAddress));
        }
        let written = Response::ReadWriteMultipleRegisters(vec![9, 1]);
        assert_eq!(answer(both(1062, 1062)), Ok(written));
        let counts = std::iter::from_fn(|| link.next_count()).map(|(count, _)| count);
        assert!(counts.eq([0x1_0007, 0x1_0009]), "the refused ones have changed nothing");
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
            assert_eq!(may_write(&allow, ip(client)), expected, "{client}");
        }
        assert!(!may_write(&[], ip("10.0.0.1")), "nobody");
        assert!(may_write(&[ip("0.0.0.0")], ip("10.0.0.1")), "everybody");
    }
}
