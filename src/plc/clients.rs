//! Who stays connected when there are too many: those who have asked properly, before strangers.

use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Instant;
use tokio::task::AbortHandle;

/// What a client has asked for.
#[derive(Debug, Default)]
pub(super) struct Asked {
    requests: AtomicU32,
    /// When it asked last, ms since the first client.
    last_ms: AtomicU64,
}

/// Time counts from the first client on.
static START: OnceLock<Instant> = OnceLock::new();

fn now_ms() -> u64 {
    START.get_or_init(Instant::now).elapsed().as_millis() as u64
}

impl Asked {
    /// It has sent a whole request.
    pub(super) fn note(&self) {
        self.requests.fetch_add(1, Ordering::Relaxed);
        self.last_ms.store(now_ms(), Ordering::Relaxed);
    }

    /// The least is the first to go. Who has never asked is a stranger; who has asked once may be one;
    /// among equals the one silent for longest.
    fn standing(&self) -> (u32, u64) {
        (self.requests.load(Ordering::Relaxed).min(2), self.last_ms.load(Ordering::Relaxed))
    }
}

/// The connected clients.
#[derive(Debug)]
pub(super) struct Clients {
    max: usize,
    connected: Vec<(Arc<Asked>, AbortHandle)>,
}

impl Clients {
    /// None yet.
    pub(super) fn new(max: usize) -> Self {
        Self { max, connected: Vec::with_capacity(max) }
    }

    /// Take a client in. One too many takes the place of the least in standing, so that a PLC that has
    /// been restarted gets in, whatever it left half-open before.
    pub(super) fn admit(&mut self, asked: Arc<Asked>, connection: AbortHandle) {
        asked.last_ms.store(now_ms(), Ordering::Relaxed);
        self.connected.retain(|(_, connection)| !connection.is_finished());
        if self.connected.len() >= self.max {
            let standing = |i: &usize| self.connected[*i].0.standing();
            if let Some(least) = (0..self.connected.len()).min_by_key(standing) {
                self.connected.swap_remove(least).1.abort();
            }
        }
        self.connected.push((asked, connection));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Let every aborted task end.
    async fn settle() {
        for _ in 0..200 {
            tokio::task::yield_now().await;
        }
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
                (0..requests).for_each(|_| asked.note());
                task
            };
            let (plc, panel) = (admit(10), admit(2));
            let curious: Vec<_> = (0..50).map(|_| admit(1)).collect();
            let strangers: Vec<_> = (0..50).map(|_| admit(0)).collect();
            settle().await;
            assert!(!plc.is_finished() && !panel.is_finished());
            let left = |tasks: &[tokio::task::JoinHandle<()>]| {
                tasks.iter().filter(|task| !task.is_finished()).count()
            };
            assert_eq!((left(&curious), left(&strangers)), (1, 1));
            // All have asked: the one silent for longest goes.
            let others: Vec<_> = (0..3).map(|_| admit(2)).collect();
            settle().await;
            assert!(left(&others) == 3 && left(&[plc, panel]) == 1);
        });
    }
}
