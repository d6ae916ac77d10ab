//! The log on standard error, and all else that is written there: nobody waits for whoever reads it.
//!
//! Lines go through a bounded queue to a thread of its own. When nobody reads and the queue is full,
//! lines are dropped, counted and told.

use super::syslog::{self, Syslog};
use std::io::Write;
use std::sync::OnceLock;
use std::sync::mpsc::sync_channel;
use std::time::Duration;
use tracing::Level;
use tracing_appender::non_blocking::{NonBlocking, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Lines that wait to be read; a line is some 200 bytes.
const LINES_MAX: usize = 4096;

/// Whoever reads has taken the last words within this, or does not read.
const FAREWELL: Duration = Duration::from_secs(10);

static STDERR: OnceLock<NonBlocking> = OnceLock::new();

/// How the log looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// For people.
    Text,
    /// A JSON object a line.
    Json,
}

/// Start the log, once; `RUST_LOG` says more or less than `level`. The last lines are written when what
/// is returned is dropped, if somebody reads them.
pub fn start(level: Level, format: Format) -> WorkerGuard {
    let (writer, guard) = NonBlockingBuilder::default()
        .buffered_lines_limit(LINES_MAX)
        .lossy(true)
        .thread_name("log")
        .finish(std::io::stderr());
    let filter = EnvFilter::builder().with_default_directive(level.into()).from_env_lossy();
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(writer.clone());
    match format {
        Format::Text => log.finish().with(Syslog).init(),
        Format::Json => log.json().finish().with(Syslog).init(),
    }
    let _ = STDERR.set(writer);
    guard
}

/// Write to standard error without waiting for whoever reads it.
pub fn say(text: std::fmt::Arguments<'_>) {
    let text = text.to_string();
    let _ = match STDERR.get() {
        Some(writer) => writer.clone().write_all(text.as_bytes()),
        // Not started: a test.
        None => std::io::stderr().write_all(text.as_bytes()),
    };
}

/// Write to standard error and wait until it is written, which a busy computer takes its time for; not for
/// ever, when nobody reads.
pub fn last_words(text: String) {
    let (tell, told) = sync_channel(1);
    let writer = std::thread::Builder::new().name("last words".into()).spawn(move || {
        let _ = std::io::stderr().write_all(text.as_bytes());
        let _ = tell.send(());
    });
    if writer.is_ok() {
        let _ = told.recv_timeout(FAREWELL);
    }
}

/// Lines that were dropped since start because they found no room.
pub fn lines_dropped() -> u64 {
    let unread = STDERR.get().map_or(0, |writer| writer.error_counter().dropped_lines() as u64);
    unread + syslog::lines_dropped()
}
