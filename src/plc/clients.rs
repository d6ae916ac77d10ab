//! Who stays connected when there are too many: those who have asked properly, before strangers.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;
use tokio::task::AbortHandle;

/// Clients that have not asked yet, beside `modbus.connections_max` that have: at 100 connects a second
/// each has more than a second for its first request.
const STRANGERS_MAX: usize = 128;

/// What a client has asked for.
#[derive(Debug, Default)]
pub(super) struct Asked {
    requests: AtomicU32,
    /// When it asked last, ms since the first client.
    last_ms: AtomicU64,
    /// It is named in the configuration as one that writes: the PLC itself.
    may_write: bool,
    address: Option<SocketAddr>,
}

/// Time counts from the first client on.
static START: OnceLock<Instant> = OnceLock::new();

fn now_ms() -> u64 {
    START.get_or_init(Instant::now).elapsed().as_millis() as u64
}

impl Asked {
    /// Nothing yet.
    pub(super) fn new(may_write: bool) -> Self {
        Self { may_write, ..Self::default() }
    }

    /// By a client with an address.
    pub(super) fn from(self, address: SocketAddr) -> Self {
        Self { address: Some(address), ..self }
    }

    /// It has sent a whole request. Whether that was its first.
    pub(super) fn note(&self) -> bool {
        self.last_ms.store(now_ms(), Ordering::Relaxed);
        self.requests.fetch_add(1, Ordering::Relaxed) == 0
    }

    fn is_stranger(&self) -> bool {
        self.requests.load(Ordering::Relaxed) == 0
    }

    /// The least is the first to go: who may not write, who has asked only once, who is silent for
    /// longest.
    fn standing(&self) -> (bool, u32, u64) {
        let requests = self.requests.load(Ordering::Relaxed).min(2);
        (self.may_write, requests, self.last_ms.load(Ordering::Relaxed))
    }
}

/// A connected client, for those who watch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Client {
    /// Address and port.
    pub address: SocketAddr,
    /// Whole requests so far.
    pub requests: u32,
    /// Since the last one, or since it came.
    pub silent_s: f64,
    /// It may write.
    pub may_write: bool,
}

/// The list of connected clients; locked by the PLC thread's tasks alone, so that they wait for nobody.
#[derive(Clone, Debug)]
pub struct ClientList(Arc<Mutex<Clients>>);

impl ClientList {
    /// Room for so many that ask.
    pub fn new(max: usize) -> Self {
        Self(Arc::new(Mutex::new(Clients::new(max))))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Clients> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Put those that are connected into a list; it never needs more than `Self::room`.
    pub fn copy_to(&self, list: &mut Vec<Client>) {
        let now_ms = now_ms();
        let clients = self.lock();
        let alive = clients.connected.iter().filter(|(_, connection)| !connection.is_finished());
        let client = |asked: &Asked| {
            let silent_ms = now_ms.saturating_sub(asked.last_ms.load(Ordering::Relaxed));
            Some(Client {
                address: asked.address?,
                requests: asked.requests.load(Ordering::Relaxed),
                silent_s: silent_ms as f64 / 1e3,
                may_write: asked.may_write,
            })
        };
        list.clear();
        list.extend(alive.filter_map(|(asked, _)| client(asked)));
    }

    /// No more are connected at once.
    pub fn room(&self) -> usize {
        self.lock().max + STRANGERS_MAX
    }
}

/// The connected clients.
#[derive(Debug)]
pub(super) struct Clients {
    /// Of those who have asked.
    max: usize,
    connected: Vec<(Arc<Asked>, AbortHandle)>,
}

impl Clients {
    /// None yet.
    pub(super) fn new(max: usize) -> Self {
        Self { max, connected: Vec::with_capacity(max + STRANGERS_MAX) }
    }

    /// Take a stranger in. One too many takes the place of the one that has waited for longest.
    pub(super) fn admit(&mut self, asked: Arc<Asked>, connection: AbortHandle) {
        asked.last_ms.store(now_ms(), Ordering::Relaxed);
        self.connected.retain(|(_, connection)| !connection.is_finished());
        self.limit(STRANGERS_MAX - 1, Asked::is_stranger);
        self.connected.push((asked, connection));
    }

    /// A client has asked for the first time. One too many takes the place of the least in standing, so
    /// that a PLC that has been restarted gets in, whatever it left half-open before.
    pub(super) fn has_asked(&mut self, asked: &Arc<Asked>) {
        self.connected.retain(|(_, connection)| !connection.is_finished());
        let is_other = |client: &Asked| !std::ptr::eq(client, Arc::as_ptr(asked));
        self.limit(self.max - 1, |client| !client.is_stranger() && is_other(client));
    }

    /// Disconnect some of a kind, until so many are left.
    fn limit(&mut self, left: usize, is_of_kind: impl Fn(&Asked) -> bool) {
        loop {
            let of_kind = (0..self.connected.len()).filter(|&i| is_of_kind(&self.connected[i].0));
            if of_kind.clone().count() <= left {
                return;
            }
            let least = of_kind.min_by_key(|&i| self.connected[i].0.standing());
            let Some(least) = least else { return };
            self.connected.swap_remove(least).1.abort();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Let every aborted task end.
    async fn settle() {
        for _ in 0..2000 {
            tokio::task::yield_now().await;
        }
    }

    #[test]
    fn a_client_that_may_write_goes_last_however_seldom_it_asks() {
        let (plc, stranger) = (Asked::new(true), Asked::new(false));
        plc.note();
        for _ in 0..9 {
            stranger.note();
        }
        assert!(plc.standing() > stranger.standing());
    }

    #[test]
    fn who_has_asked_properly_outlasts_any_number_of_strangers() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("runtime");
        runtime.block_on(async {
            let task = || tokio::spawn(std::future::pending::<()>());
            let mut clients = Clients::new(4);
            let mut admit = |requests: u32| {
                let (asked, task) = (Arc::new(Asked::default()), task());
                clients.admit(Arc::clone(&asked), task.abort_handle());
                for _ in 0..requests {
                    if asked.note() {
                        clients.has_asked(&asked);
                    }
                }
                task
            };
            let (plc, panel) = (admit(10), admit(2));
            let new_plc = admit(0);
            let curious: Vec<_> = (0..50).map(|_| admit(1)).collect();
            let strangers: Vec<_> = (0..100).map(|_| admit(0)).collect();
            settle().await;
            let left = |tasks: &[tokio::task::JoinHandle<()>]| {
                tasks.iter().filter(|task| !task.is_finished()).count()
            };
            assert!(!plc.is_finished() && !panel.is_finished());
            assert!(!new_plc.is_finished(), "it has not asked yet");
            assert_eq!((left(&curious), left(&strangers)), (2, 100));
            let more: Vec<_> = (0..1000).map(|_| admit(0)).collect();
            settle().await;
            assert_eq!(left(&strangers) + left(&more) + left(&[new_plc]), STRANGERS_MAX);
            // All have asked: the one silent for longest goes.
            let others: Vec<_> = (0..3).map(|_| admit(2)).collect();
            settle().await;
            assert!(left(&others) == 3 && left(&[plc, panel]) == 1 && left(&curious) == 0);
        });
    }
}
