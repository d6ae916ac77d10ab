//! What was put up to be looked at: the newest live pictures, the last parcels and events, the trend.

use super::model::{Event, Parcel, Point};
use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// Parcels that are kept to be looked at; older ones are in the archive.
pub const PARCELS_MAX: usize = 200;
/// The same of events.
pub const EVENTS_MAX: usize = 300;
/// The same of the trend: eight hours, a shift, in pieces of ten seconds.
pub const POINTS_MAX: usize = 2880;
/// Events of visitors that wait for the desk.
const NOTES_MAX: usize = 32;
/// A live picture that is older shows something else by now.
const FRESH: Duration = Duration::from_millis(300);

/// What a live picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum View {
    /// The camera's picture.
    Raw,
    /// The belt view.
    Belt,
    /// What helps to set the camera up ([`super::Setup`]).
    Setup,
}

/// Kinds of live pictures.
const VIEWS: usize = 3;
/// Whole pictures that are kept for whoever wants one of those that he has just been shown.
const WHOLE_MAX: usize = 4;

/// A live picture, ready to be sent.
#[derive(Debug)]
pub struct Picture {
    /// Number of its frame.
    pub frame: u64,
    /// When it was put up.
    pub at: Instant,
    /// A line of JSON ([`super::Scene`]), then the JPEG.
    pub bytes: axum::body::Bytes,
}

type Live = watch::Sender<Option<Arc<Picture>>>;

/// Everything that is put up. Whoever puts something up waits for nobody but a reader that copies a list.
pub struct Board {
    started_ms: u64,
    parcels: Mutex<VecDeque<(Arc<Parcel>, axum::body::Bytes)>>,
    events: Mutex<VecDeque<Arc<Event>>>,
    notes: Mutex<VecDeque<Event>>,
    points: Mutex<VecDeque<Point>>,
    parcels_told: AtomicU64,
    events_told: AtomicU64,
    live: [Live; VIEWS],
    /// Requests that wait for a picture.
    waiting: [AtomicUsize; VIEWS],
    /// The camera's last pictures with a board, by number of the frame.
    whole: Mutex<VecDeque<(u64, axum::body::Bytes)>>,
    /// Inner corners of the board that is looked for: columns * 256 + rows; 0: none.
    board: AtomicUsize,
    /// Who makes the pictures.
    desk: OnceLock<Thread>,
    closed: watch::Sender<bool>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Board {
    /// Nothing yet. `started_ms`: since 1970; it tells one run's numbers from another's.
    pub fn new(started_ms: u64) -> Self {
        Self {
            started_ms,
            parcels: Mutex::default(),
            events: Mutex::default(),
            notes: Mutex::default(),
            points: Mutex::new(VecDeque::with_capacity(POINTS_MAX)),
            parcels_told: AtomicU64::new(0),
            events_told: AtomicU64::new(0),
            live: std::array::from_fn(|_| watch::Sender::new(None)),
            waiting: Default::default(),
            whole: Mutex::default(),
            board: AtomicUsize::new(0),
            desk: OnceLock::new(),
            closed: watch::Sender::new(false),
        }
    }

    /// The thread that calls makes the pictures: it is woken when one is asked for.
    pub fn is_served_here(&self) {
        self.desk.get_or_init(std::thread::current);
    }

    /// Number of this run.
    pub fn started_ms(&self) -> u64 {
        self.started_ms
    }

    /// Put up a parcel and its picture (empty: none); it gets its number.
    pub fn parcel(&self, mut parcel: Parcel, jpeg: Vec<u8>) -> Arc<Parcel> {
        parcel.n = self.parcels_told.fetch_add(1, Ordering::Relaxed) + 1;
        let parcel = Arc::new(parcel);
        put(&mut lock(&self.parcels), PARCELS_MAX, (Arc::clone(&parcel), jpeg.into()));
        parcel
    }

    /// Put up an event; it gets its number.
    pub fn event(&self, mut event: Event) -> Arc<Event> {
        event.n = self.events_told.fetch_add(1, Ordering::Relaxed) + 1;
        let event = Arc::new(event);
        put(&mut lock(&self.events), EVENTS_MAX, Arc::clone(&event));
        event
    }

    /// What a visitor did, for whoever puts up events and keeps them.
    pub fn note(&self, event: Event) {
        put(&mut lock(&self.notes), NOTES_MAX, event);
    }

    /// What visitors did since this was asked last.
    pub fn take_notes(&self) -> VecDeque<Event> {
        std::mem::take(&mut *lock(&self.notes))
    }

    /// Put up a piece of the trend; it gets its number.
    pub fn point(&self, mut point: Point) {
        let mut points = lock(&self.points);
        point.n = points.back().map_or(0, |last| last.n) + 1;
        put(&mut points, POINTS_MAX, point);
    }

    /// Pieces of the trend after number `n`, oldest first, at most so many of the oldest.
    pub fn points_since(&self, n: u64, limit: usize) -> Vec<Point> {
        let points = lock(&self.points);
        let seen = points.partition_point(|point| point.n <= n);
        points.range(seen..).take(limit).copied().collect()
    }

    /// Parcels after number `n`, oldest first, at most so many of the newest.
    pub fn parcels_since(&self, n: u64, limit: usize) -> Vec<Arc<Parcel>> {
        let parcels = lock(&self.parcels);
        let after = parcels.iter().filter(|(parcel, _)| parcel.n > n);
        let skip = after.clone().count().saturating_sub(limit);
        after.skip(skip).map(|(parcel, _)| Arc::clone(parcel)).collect()
    }

    /// Events after number `n`, oldest first.
    pub fn events_since(&self, n: u64) -> Vec<Arc<Event>> {
        lock(&self.events).iter().filter(|event| event.n > n).map(Arc::clone).collect()
    }

    /// The JPEG of parcel `n`.
    pub fn parcel_picture(&self, n: u64) -> Option<axum::body::Bytes> {
        let parcels = lock(&self.parcels);
        let (_, jpeg) = parcels.iter().find(|(parcel, _)| parcel.n == n)?;
        (!jpeg.is_empty()).then(|| jpeg.clone())
    }

    /// Whether somebody waits for a live picture.
    pub fn is_wanted(&self, view: View) -> bool {
        self.waiting[view as usize].load(Ordering::Relaxed) > 0
    }

    /// Put up a live picture.
    pub fn picture(&self, view: View, frame: u64, bytes: Vec<u8>) {
        let picture = Picture { frame, at: Instant::now(), bytes: bytes.into() };
        self.live[view as usize].send_replace(Some(Arc::new(picture)));
    }

    /// Look for a board of so many inner corners in the pictures for setting up; none: for no board.
    pub(super) fn look_for(&self, board: Option<[u8; 2]>) {
        let sides = board.map_or(0, |[a, b]| usize::from(a) << 8 | usize::from(b));
        self.board.store(sides, Ordering::Relaxed);
    }

    /// Inner corners of the board that is looked for.
    pub fn looked_for(&self) -> Option<[usize; 2]> {
        let sides = self.board.load(Ordering::Relaxed);
        (sides > 0).then_some([sides >> 8, sides & 0xff])
    }

    /// Keep the camera's picture of a frame for a while, as a file.
    pub fn whole(&self, frame: u64, file: Vec<u8>) {
        put(&mut lock(&self.whole), WHOLE_MAX, (frame, file.into()));
    }

    /// The camera's picture of a frame, if it is still kept.
    pub(super) fn whole_picture(&self, frame: u64) -> Option<axum::body::Bytes> {
        let kept = lock(&self.whole);
        kept.iter().find(|(kept, _)| *kept == frame).map(|(_, file)| file.clone())
    }

    /// A fresh picture of another frame than `shown`, as soon as there is one.
    pub(super) async fn next_picture(&self, view: View, shown: Option<u64>) -> Arc<Picture> {
        let mut live = self.live[view as usize].subscribe();
        let is_new =
            |picture: &Picture| Some(picture.frame) != shown && picture.at.elapsed() < FRESH;
        let put_up = live.borrow_and_update().clone();
        if let Some(picture) = put_up.filter(|picture| is_new(picture)) {
            return picture;
        }
        let _waiting = Waiting::of(self, view);
        loop {
            // It fails when the board is gone, and with it whoever asks.
            let _ = live.changed().await;
            let put_up = live.borrow_and_update().clone();
            if let Some(picture) = put_up.filter(|picture| is_new(picture)) {
                return picture;
            }
        }
    }

    /// Whoever serves it, and every request that waits, shall end.
    pub fn close(&self) {
        self.closed.send_replace(true);
    }

    pub(super) async fn closed(&self) {
        let _ = self.closed.subscribe().wait_for(|closed| *closed).await;
    }
}

fn put<T>(list: &mut VecDeque<T>, most: usize, item: T) {
    if list.len() == most {
        list.pop_front();
    }
    list.push_back(item);
}

/// A request that waits for a picture, however it ends.
struct Waiting<'a>(&'a AtomicUsize);

impl<'a> Waiting<'a> {
    fn of(board: &'a Board, view: View) -> Self {
        let waiting = &board.waiting[view as usize];
        waiting.fetch_add(1, Ordering::Relaxed);
        if let Some(desk) = board.desk.get() {
            desk.unpark();
        }
        Self(waiting)
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(code: u32) -> Event {
        Event { n: 0, utc_ms: 0, kind: "began", code, detail: String::new() }
    }

    #[test]
    fn lists_are_bounded_and_numbers_go_on() {
        let board = Board::new(0);
        for code in 0..1000 {
            board.event(event(code));
        }
        let last = board.events_since(0);
        assert_eq!((last.len(), last[0].n, last[EVENTS_MAX - 1].n), (EVENTS_MAX, 701, 1000));
        assert_eq!(board.events_since(998).len(), 2);
        assert!(board.events_since(5000).is_empty());
        for _ in 0..POINTS_MAX + 70 {
            board.point(Point::default());
        }
        let numbers = |since, limit| {
            let points = board.points_since(since, limit);
            (points.len(), points.first().map(|point| point.n), points.last().map(|point| point.n))
        };
        assert_eq!(numbers(0, 9), (9, Some(71), Some(79)), "the oldest are gone");
        assert_eq!(numbers(2948, 9), (2, Some(2949), Some(2950)));
        assert_eq!(numbers(2950, 9), (0, None, None));
    }

    #[test]
    fn a_picture_is_wanted_while_a_request_waits_and_no_longer() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        runtime.expect("runtime").block_on(async {
            let board = Board::new(0);
            assert!(!board.is_wanted(View::Belt));
            let mut request = Box::pin(board.next_picture(View::Belt, None));
            let soon = Duration::from_millis(1);
            assert!(tokio::time::timeout(soon, &mut request).await.is_err());
            assert!(board.is_wanted(View::Belt) && !board.is_wanted(View::Raw));
            board.picture(View::Belt, 7, vec![1]);
            assert_eq!(request.await.frame, 7);
            assert!(!board.is_wanted(View::Belt));
            // At once for another one, not for who has seen it.
            assert_eq!(board.next_picture(View::Belt, Some(6)).await.frame, 7);
            let again = board.next_picture(View::Belt, Some(7));
            assert!(tokio::time::timeout(soon, again).await.is_err());
            assert!(!board.is_wanted(View::Belt), "it went away");
        });
    }
}
