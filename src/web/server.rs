//! Sockets: who is let in, for how long, with how many bytes.

use super::api;
use super::board::Board;
use super::guard::{Doorkeeper, Visit};
use super::model::{Keeper, Machine};
use crate::config::Web as Settings;
use crate::error::{Error, Result};
use axum::Extension;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpStream;

/// An address that cannot be had yet is tried again after this: its network may come up later.
const LISTEN_RETRY: Duration = Duration::from_secs(2);
/// Pause after the listener failed, which is when descriptors are short.
const ACCEPT_RETRY: Duration = Duration::from_millis(200);
/// A request's head must be whole within this; a connection on which nothing is asked for as long ends.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);
/// A visitor that takes nothing of an answer for this long is gone, ms.
const TAKE_TIMEOUT_MS: u32 = 10_000;
/// A connection ends after this, whatever it does: browsers open another one.
const VISIT_MAX: Duration = Duration::from_mins(2);
/// What it is answering then may take this long.
const LAST_ANSWER: Duration = Duration::from_secs(10);
/// Bytes of a request's head, and of an answer under way.
const BUFFER_BYTES: usize = 16 * 1024;
/// Header lines of a request.
const HEADERS_MAX: usize = 64;
/// Threads that read the archive for visitors.
const READERS: usize = 2;
/// Stack of each: locked memory counts all of it.
const STACK_BYTES: usize = 512 * 1024;

/// The socket, if its address could be had.
pub type Listening = std::io::Result<TcpListener>;

/// Bind the socket.
pub fn listen(settings: &Settings) -> Listening {
    let listener = TcpListener::bind((settings.address, settings.port))?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// Serve until the board is closed. An address that cannot be had is no reason to stop measuring: it is
/// told once and tried again.
pub fn serve(
    settings: &Settings,
    listening: Listening,
    board: &Arc<Board>,
    machine: Arc<dyn Machine>,
    keeper: Option<Arc<dyn Keeper>>,
) -> Result<()> {
    let failed = |e: std::io::Error| Error::failure(format!("the web server failed: {e}"));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(READERS)
        .thread_stack_size(STACK_BYTES)
        .thread_name("web reader")
        .build()
        .map_err(failed)?;
    runtime.block_on(async {
        tokio::select! {
            () = accept(settings, listening, board, machine, keeper) => {}
            () = board.closed() => {}
        }
    });
    // A reader that hangs on a dead disk is left behind.
    runtime.shutdown_background();
    Ok(())
}

/// The socket, however long it takes.
async fn patiently(settings: &Settings, listening: Listening) -> tokio::net::TcpListener {
    let mut listening = listening;
    let mut told = false;
    loop {
        match listening.and_then(tokio::net::TcpListener::from_std) {
            Ok(listener) => {
                if let Ok(address) = listener.local_addr() {
                    tracing::info!(%address, "the page is served");
                }
                return listener;
            }
            Err(error) if !told => {
                told = true;
                let address = SocketAddr::new(settings.address, settings.port);
                tracing::warn!(
                    %address, %error,
                    "the page is not served: web.address and web.port must be this machine's and free; \
                     trying again"
                );
            }
            Err(_) => {}
        }
        tokio::time::sleep(LISTEN_RETRY).await;
        listening = listen(settings);
    }
}

async fn accept(
    settings: &Settings,
    listening: Listening,
    board: &Arc<Board>,
    machine: Arc<dyn Machine>,
    keeper: Option<Arc<dyn Keeper>>,
) {
    let listener = patiently(settings, listening).await;
    let door = Doorkeeper::new(settings.connections_max);
    let router = api::router(Arc::clone(board), machine, keeper, settings);
    loop {
        match listener.accept().await {
            Ok((stream, address)) => {
                // One too many is hung up on.
                if let Some(visit) = door.admit(address.ip()) {
                    let admitted = settings.admits(address.ip());
                    let router = if admitted { router.clone() } else { api::closed() };
                    let router = router.layer(Extension(address.ip().to_canonical()));
                    tokio::spawn(receive(stream, visit, router));
                }
            }
            Err(_) => tokio::time::sleep(ACCEPT_RETRY).await,
        }
    }
}

/// One connection, to its end.
async fn receive(stream: TcpStream, visit: Visit, router: axum::Router) {
    let _ = stream.set_nodelay(true);
    let _ = rustix::net::sockopt::set_tcp_user_timeout(&stream, TAKE_TIMEOUT_MS);
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_buf_size(BUFFER_BYTES)
        .max_headers(HEADERS_MAX)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    let mut connection = std::pin::pin!(connection);
    // How it ends is the visitor's business.
    if tokio::time::timeout(VISIT_MAX, connection.as_mut()).await.is_err() {
        connection.as_mut().graceful_shutdown();
        let _ = tokio::time::timeout(LAST_ANSWER, connection).await;
    }
    drop(visit);
}
