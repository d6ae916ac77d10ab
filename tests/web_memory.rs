//! However many ask, and whatever: the page's memory does not grow.
#![allow(unsafe_code)] // a counting allocator cannot be written without

use beltgauge::config::Web;
use beltgauge::web::{
    self, Archived, Board, BundleFile, BundleFiles, Event, Machine, Plc, State, View,
};
use std::alloc::{GlobalAlloc, Layout, System};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Bytes that are taken and not given back.
static HELD: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: everything is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HELD.fetch_add(layout.size(), Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Nothing that is waited for takes longer.
const PATIENCE: Duration = Duration::from_secs(30);
const REQUESTS: usize = 10_000;
/// Less than one byte for two requests: nothing that is kept for each is so small.
const STEPS_BYTES: usize = REQUESTS / 2;
/// What a careless answer leaves behind, for three of twelve requests: a pointer.
const LEFT_BYTES: usize = 8;

struct Still {
    careless: bool,
}

impl Machine for Still {
    fn state(&self) -> State {
        if self.careless {
            std::mem::forget(std::hint::black_box(vec![0u8; LEFT_BYTES]));
        }
        State { reasons: vec![1, 2, 3], ..State::default() }
    }
    fn plc(&self) -> Plc {
        Plc::default()
    }
    fn archived(&self, _: Option<u64>, limit: usize) -> Result<Archived, String> {
        let entries = vec![serde_json::json!({"seq": 1}); limit];
        Ok(Archived { entries, ..Archived::default() })
    }
    fn archived_picture(&self, _: u64) -> Option<Vec<u8>> {
        Some(vec![0; 20_000])
    }
    fn bundle(&self) -> BundleFiles {
        let file = |n| BundleFile { name: format!("{n}"), bytes: Ok(vec![0; 10_000]) };
        Box::new((0..3).map(file))
    }
}

/// Ask on a connection of its own; what is answered does not matter here.
fn ask(server: SocketAddr, request: &str) {
    let mut stream = TcpStream::connect(server).expect("listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("a time");
    let _ = stream.write_all(request.as_bytes());
    let _ = stream.read_to_end(&mut Vec::new());
}

/// So many requests, well-meant and other, and pictures and events meanwhile.
fn visit(server: SocketAddr, board: &Board, count: usize) {
    let head = "Host: localhost\r\nConnection: close\r\n";
    let long = "a".repeat(20_000);
    let requests = [
        format!("GET / HTTP/1.1\r\n{head}\r\n"),
        format!("GET /api/state HTTP/1.1\r\n{head}\r\n"),
        format!("GET /api/events?since=0 HTTP/1.1\r\n{head}\r\n"),
        format!("GET /api/live/belt HTTP/1.1\r\n{head}\r\n"),
        format!("GET /api/archive?limit=3 HTTP/1.1\r\n{head}\r\n"),
        format!("GET /api/archive/1/picture HTTP/1.1\r\n{head}\r\n"),
        format!("GET /api/bundle.tar.gz HTTP/1.1\r\n{head}\r\n"),
        format!("GET /metrics HTTP/1.1\r\n{head}\r\n"),
        format!("GET /{long} HTTP/1.1\r\n{head}\r\n"),
        "GET / HTTP/1.1\r\nHost: evil.example.com\r\nConnection: close\r\n\r\n".to_owned(),
        format!("POST /api/state HTTP/1.1\r\nContent-Length: 5\r\n{head}\r\nhello"),
        "\u{0}\u{1}\u{2}\r\n\r\n".to_owned(),
    ];
    for (i, request) in requests.iter().cycle().take(count).enumerate() {
        board.picture(View::Belt, i as u64, vec![0; 30_000]);
        let detail = "x".repeat(50);
        board.event(Event { n: 0, utc_ms: 0, kind: "began", code: 2, detail });
        ask(server, request);
    }
}

/// What is held once connections that ended have left: it stands still.
fn held() -> usize {
    let start = Instant::now();
    let (mut last, mut same) = (HELD.load(Ordering::Relaxed), 0);
    while same < 20 {
        assert!(start.elapsed() < PATIENCE, "what is held does not come to rest");
        std::thread::sleep(Duration::from_millis(10));
        let now = HELD.load(Ordering::Relaxed);
        same = if now == last { same + 1 } else { 0 };
        last = now;
    }
    last
}

/// By how much ten thousand requests have made it grow.
fn growth(careless: bool) -> usize {
    let settings = Web { address: [127, 0, 0, 1].into(), port: 0, ..Web::default() };
    let listening = web::listen(&settings);
    let server = listening.as_ref().expect("bound").local_addr().expect("bound");
    let board = Arc::new(Board::new(5));
    std::thread::scope(|scope| {
        let machine = Arc::new(Still { careless });
        scope.spawn(|| web::serve(&settings, listening, &board, machine, None).expect("serves"));
        // Lists are full, threads and tables are there.
        visit(server, &board, 1_000);
        let before = held();
        visit(server, &board, REQUESTS);
        let after = held();
        board.close();
        after.saturating_sub(before)
    })
}

// One test: what is held is that of the whole process.
#[test]
fn ten_thousand_requests_leave_nothing_behind_and_it_would_show() {
    let grown = growth(false);
    assert!(grown < STEPS_BYTES, "{grown} bytes more");
    let grown = growth(true);
    assert!(grown > STEPS_BYTES, "the measure is blind: {grown} bytes");
}
