//! A copy of the log for a site's collector: messages of RFC 5424 in UDP datagrams (RFC 5426).
//!
//! Nobody waits for the network: as those of `log`, lines go through a bounded queue to a thread of its own. What is
//! sent while nobody listens, or the network is away, is lost and not counted: the line that told of it would be lost too.

use crate::error::{Error, Result};
use crate::event::clock;
use std::io::{self, Write};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::OnceLock;
use tracing::{Event, Level, Subscriber};
use tracing_appender::non_blocking::{NonBlocking, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::Layer;
use tracing_subscriber::fmt::FormatFields;
use tracing_subscriber::fmt::format::{DefaultFields, Writer};
use tracing_subscriber::layer::Context;

/// Lines that wait to be sent.
const LINES_MAX: usize = 1024;
/// A longer message is cut: every receiver should take as much (RFC 5426, 3.2).
const BYTES_MAX: usize = 2048;
/// Of a host's name (RFC 5424, 6).
const HOST_BYTES_MAX: usize = 255;
/// "System daemons" (RFC 5424, table 1).
const FACILITY: u8 = 3;

static COLLECTOR: OnceLock<Collector> = OnceLock::new();

struct Collector {
    lines: NonBlocking,
    host: String,
}

/// Send every line of the log to a collector from now on. The last lines are sent when what is returned is dropped.
pub fn start(to: SocketAddr) -> Result<WorkerGuard> {
    let any: SocketAddr = match to {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any)
        .map_err(|e| Error::failure(format!("cannot send the log to {to}: {e}")))?;
    let (lines, guard) = NonBlockingBuilder::default()
        .buffered_lines_limit(LINES_MAX)
        .lossy(true)
        .thread_name("syslog")
        .finish(Datagrams { socket, to });
    let host = host(&rustix::system::uname().nodename().to_string_lossy());
    let _ = COLLECTOR.set(Collector { lines, host });
    Ok(guard)
}

/// Lines that were dropped since start because they found no room.
pub fn lines_dropped() -> u64 {
    COLLECTOR.get().map_or(0, |to| to.lines.error_counter().dropped_lines() as u64)
}

/// The part of the log that knows the collector, once there is one.
pub struct Syslog;

impl<S: Subscriber> Layer<S> for Syslog {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let Some(to) = COLLECTOR.get() else { return };
        let mut text = String::new();
        if DefaultFields::new().format_fields(Writer::new(&mut text), event).is_ok() {
            let line = message(*event.metadata().level(), clock::utc_ms(), &to.host, &text);
            // What finds no room is counted there.
            let _ = to.lines.clone().write_all(line.as_bytes());
        }
    }
}

/// Each line is a datagram.
struct Datagrams {
    socket: UdpSocket,
    to: SocketAddr,
}

impl Write for Datagrams {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        // A network that is away may be back for the next line.
        let _ = self.socket.send_to(line, self.to);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A machine's name as a message may have it; `-`: it has none.
fn host(name: &str) -> String {
    let is_name = name.bytes().all(|b| b.is_ascii_graphic()) && !name.starts_with('(');
    if is_name && (1..=HOST_BYTES_MAX).contains(&name.len()) { name.to_owned() } else { "-".into() }
}

/// A message: priority, version, time, host, program, process, kind (none), structured data (none), text.
fn message(level: Level, utc_ms: u64, host: &str, text: &str) -> String {
    let severity = match level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        _ => 7,
    };
    let (priority, utc, process) =
        (FACILITY * 8 + severity, clock::utc(utc_ms), std::process::id());
    let mut line = format!("<{priority}>1 {utc} {host} beltgauge {process} - - {text}");
    while line.len() > BYTES_MAX {
        line.pop();
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_as_the_standard_says() {
        let process = std::process::id();
        assert_eq!(
            message(Level::WARN, 1_790_000_000_123, "box-3", "the camera is lost"),
            format!(
                "<28>1 2026-09-21T14:13:20.123Z box-3 beltgauge {process} - - the camera is lost"
            )
        );
        let priority = |level| message(level, 0, "-", "").split('>').next().map(str::to_owned);
        assert_eq!(priority(Level::ERROR).as_deref(), Some("<27"));
        assert_eq!(priority(Level::INFO).as_deref(), Some("<30"));
        assert_eq!(priority(Level::DEBUG).as_deref(), Some("<31"));
    }

    #[test]
    fn what_is_longer_than_a_receiver_takes_is_cut_between_characters() {
        let line = message(Level::INFO, 0, "-", &"ä".repeat(2000));
        assert!((BYTES_MAX - 1..=BYTES_MAX).contains(&line.len()), "{}", line.len());
        assert!(line.ends_with('ä'));
    }

    #[test]
    fn a_machine_without_a_name_says_so() {
        assert_eq!(host("lane-3.example.com"), "lane-3.example.com");
        let long = "a".repeat(HOST_BYTES_MAX + 1);
        for none in ["", "(none)", "two words", "zwölf", &long] {
            assert_eq!(host(none), "-", "{none:?}");
        }
    }
}
