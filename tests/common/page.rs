//! The page's server as a test starts it.

use beltgauge::config::Web;
use beltgauge::web::{self, Archived, Board, BundleFile, BundleFiles, Keeper, Machine, Plc, State};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

/// Nothing a test waits for takes longer.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// A machine in which nothing moves.
pub struct Still;

impl Machine for Still {
    fn state(&self) -> State {
        State { version: "1.2.3", ..State::default() }
    }
    fn plc(&self) -> Plc {
        Plc::default()
    }
    fn archived(&self, before: Option<u64>, limit: usize) -> Result<Archived, String> {
        let last = before.unwrap_or(1000);
        let entries = (0..limit as u64).map(|i| serde_json::json!(last - 1 - i)).collect();
        Ok(Archived { entries, before: Some(last - limit as u64), unread: Vec::new() })
    }
    fn archived_picture(&self, entry: u64) -> Option<Vec<u8>> {
        (entry == 7).then(|| b"jpeg".to_vec())
    }
    fn bundle(&self) -> BundleFiles {
        // More than any socket takes on the way.
        let file = |n| BundleFile { name: format!("{n}.bin"), bytes: Ok(noise(n, 1 << 20)) };
        Box::new((0..BUNDLED).map(file))
    }
}

/// Files of the machine in its bundle.
pub const BUNDLED: u32 = 12;

/// Bytes that no packer makes smaller.
pub fn noise(seed: u32, bytes: usize) -> Vec<u8> {
    let mut state = seed + 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state as u8
    };
    (0..bytes).map(|_| next()).collect()
}

pub struct Server {
    pub address: SocketAddr,
    pub board: Arc<Board>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Server {
    pub fn start() -> Self {
        Self::of(Arc::new(Still))
    }

    pub fn of(machine: Arc<dyn Machine>) -> Self {
        Self::with(Web::default(), machine)
    }

    pub fn with(settings: Web, machine: Arc<dyn Machine>) -> Self {
        Self::kept(settings, machine, None)
    }

    /// One whose site can be changed.
    pub fn kept(settings: Web, machine: Arc<dyn Machine>, keeper: Option<Arc<dyn Keeper>>) -> Self {
        let settings = Web { address: [127, 0, 0, 1].into(), port: 0, ..settings };
        let listening = web::listen(&settings);
        let address = listening.as_ref().expect("bound").local_addr().expect("bound");
        let board = Arc::new(Board::new(5));
        let served = Arc::clone(&board);
        let thread = std::thread::spawn(move || {
            web::serve(&settings, listening, &served, machine, keeper).expect("serves");
        });
        Self { address, board, thread: Some(thread) }
    }

    pub fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).expect("listens");
        stream.set_read_timeout(Some(PATIENCE)).expect("a time");
        stream
    }

    /// Send bytes, return what is answered until the connection ends.
    pub fn send(&self, bytes: &[u8]) -> String {
        let mut stream = self.connect();
        // It may be hung up on while it still talks.
        let _ = stream.write_all(bytes);
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }

    pub fn get(&self, path: &str) -> String {
        self.send(
            format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
                .as_bytes(),
        )
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.board.close();
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok() || std::thread::panicking());
        }
    }
}

pub fn status(answer: &str) -> u16 {
    let code = answer.split(' ').nth(1).and_then(|code| code.parse().ok());
    code.unwrap_or_else(|| panic!("no answer: {answer:?}"))
}

pub fn body(answer: &str) -> serde_json::Value {
    let (_, body) = answer.split_once("\r\n\r\n").expect("an answer");
    serde_json::from_str(body).expect("JSON")
}
