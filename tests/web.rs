//! The page's server as strangers meet it.

mod common;

use beltgauge::config::Web;
use beltgauge::event::{Flags, ParcelRecord, Shape};
use beltgauge::web::{
    Archived, BundleFiles, Event, Machine, NoPicture, Parcel, Plc, Point, State, View,
};
use common::page::{BUNDLED, PATIENCE, Server, Still, body, noise, status};
use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A machine whose disk does not answer, until it is let.
struct Hung(Arc<AtomicBool>);

impl Machine for Hung {
    fn state(&self) -> State {
        Still.state()
    }
    fn plc(&self) -> Plc {
        Still.plc()
    }
    fn archived(&self, before: Option<u64>, limit: usize) -> Result<Archived, String> {
        while !self.0.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
        }
        Still.archived(before, limit)
    }
    fn archived_picture(&self, entry: u64) -> Option<Vec<u8>> {
        Still.archived_picture(entry)
    }
    fn bundle(&self) -> BundleFiles {
        Still.bundle()
    }
}

#[test]
fn what_is_there_is_served_and_every_answer_is_protected() {
    let server = Server::start();
    for (path, expected) in [
        ("/", 200),
        ("/main.js", 200),
        ("/de.json", 200),
        ("/metrics", 200),
        ("/api/state", 200),
        ("/api/plc", 200),
        ("/api/parcels", 200),
        ("/api/parcels?since=3&limit=2", 200),
        ("/api/events?since=18446744073709551615", 200),
        ("/api/archive?before=500&limit=5", 200),
        ("/api/archive/7/picture", 200),
        ("/api/archive/8/picture", 404),
        ("/api/archive/x/picture", 404),
        ("/api/parcels.csv", 200),
        ("/api/trend?since=4", 200),
        ("/api/bundle.tar.gz?name=../../etc/passwd", 200),
        ("/api/parcels/1/picture", 404),
        ("/api/parcels/-1/picture", 404),
        ("/api/live/up", 404),
        ("/api/live/belt?after=x", 400),
        ("/api/live/setup?columns=9&rows=2", 400),
        ("/api/live/setup?columns=300&rows=6", 400),
        ("/api/live/setup?columns=9&rows=x", 400),
        ("/api/still/7", 404),
        ("/api/still/-1", 404),
        ("/api/still/..%2f7", 404),
        ("/api/parcels?since=-1", 400),
        ("/api/parcels?since=%31", 400),
        ("/api/parcels?limit=99999999999999999999999", 400),
        ("/../../etc/passwd", 404),
        ("/..%2f..%2fetc%2fpasswd", 404),
        ("/api/archive/..%2f..%2f/picture", 404),
        ("//evil.example.com/", 404),
        ("/index.html", 404),
    ] {
        let answer = server.get(path);
        assert_eq!(status(&answer), expected, "{path}");
        let head = answer.to_lowercase();
        for header in [
            "content-security-policy: default-src 'none'",
            "x-content-type-options: nosniff",
            "cache-control: no-store",
        ] {
            assert!(head.contains(header), "{path} lacks {header}");
        }
        assert!(!answer.contains("root:"), "{path}");
    }
    let archived = body(&server.get("/api/archive?limit=1000000"));
    assert_eq!(
        archived["entries"].as_array().map(Vec::len),
        Some(100),
        "however many are asked for"
    );
}

#[test]
fn the_last_stills_of_a_board_are_kept_and_the_board_is_looked_for_as_it_was_asked() {
    let server = Server::start();
    assert_eq!(server.board.looked_for(), None);
    for frame in 0..10 {
        server.board.whole(frame, format!("P5 {frame}").into_bytes());
    }
    let kept: Vec<u64> = (0..10)
        .filter(|frame| status(&server.get(&format!("/api/still/{frame}"))) == 200)
        .collect();
    assert_eq!(kept, [6, 7, 8, 9], "the last four");
    assert!(server.get("/api/still/9").ends_with("\r\n\r\nP5 9"));
    for (query, looked_for) in [
        ("?columns=9&rows=6", Some([9, 6])),
        ("?columns=3&rows=60&after=5", Some([3, 60])),
        ("", None),
    ] {
        // Answered at once: there is a picture.
        server.board.picture(View::Setup, 7, b"{}\njpeg".to_vec());
        assert_eq!(status(&server.get(&format!("/api/live/setup{query}"))), 200, "{query}");
        assert_eq!(server.board.looked_for(), looked_for, "{query}");
    }
}

#[test]
fn nothing_can_be_changed_and_another_name_gets_nothing() {
    let server = Server::start();
    for method in ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "CONNECT", "BREW"] {
        let request =
            format!("{method} /api/state HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        let answer = server.send(request.as_bytes());
        assert!((400..500).contains(&status(&answer)), "{method}");
        assert!(!answer.contains("1.2.3"), "{method}");
    }
    for host in ["Host: evil.example.com\r\n", "", "Host: localhost\r\nHost: evil.example.com\r\n"]
    {
        let request = format!("GET /api/state HTTP/1.1\r\n{host}Connection: close\r\n\r\n");
        let answer = server.send(request.as_bytes());
        assert!((400..500).contains(&status(&answer)) && !answer.contains("1.2.3"), "{host:?}");
    }
}

#[test]
fn what_is_too_large_or_no_http_is_turned_away() {
    let server = Server::start();
    let long = "a".repeat(1 << 20);
    for request in [
        format!("GET /{long} HTTP/1.1\r\nHost: localhost\r\n\r\n"),
        format!("GET / HTTP/1.1\r\nHost: localhost\r\nX: {long}\r\n\r\n"),
        format!("GET / HTTP/1.1\r\nHost: localhost\r\n{}\r\n", "X: y\r\n".repeat(1000)),
        "\u{16}\u{3}\u{1}\u{2}\u{0}".to_owned(),
    ] {
        let answer = server.send(request.as_bytes());
        assert!(answer.is_empty() || (400..500).contains(&status(&answer)), "{answer:.60}");
    }
    // A body is not waited for, nor taken.
    let request =
        format!("POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9999999999\r\n\r\n{long}");
    let answer = server.send(request.as_bytes());
    assert!(answer.is_empty() || status(&answer) == 405, "{answer:.60}");
    assert_eq!(status(&server.get("/api/state")), 200, "it serves on");
}

#[test]
fn one_address_has_half_of_the_places_and_gets_them_back() {
    let server = Server::start();
    let half = Web::default().connections_max / 2;
    let mut open: Vec<TcpStream> = (0..half).map(|_| server.connect()).collect();
    // They are inside when they are answered.
    for stream in &mut open {
        stream.write_all(b"GET /api/plc HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("open");
        let mut some = [0; 16];
        stream.read_exact(&mut some).expect("answered");
    }
    let refused = server.send(b"GET /api/plc HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(refused.is_empty(), "one too many is hung up on: {refused}");
    drop(open);
    let start = Instant::now();
    while server.get("/api/plc").is_empty() {
        assert!(start.elapsed() < PATIENCE, "the places are not given back");
    }
}

/// A connection from another address of this machine.
fn connect_from(local: [u8; 4], server: SocketAddr) -> TcpStream {
    use rustix::net::{AddressFamily, SocketType, bind, connect, socket};
    let socket = socket(AddressFamily::INET, SocketType::STREAM, None).expect("a socket");
    bind(&socket, &SocketAddr::from((local, 0))).expect("all of 127 is this machine");
    connect(&socket, &server).expect("listens");
    let stream = TcpStream::from(socket);
    stream.set_read_timeout(Some(PATIENCE)).expect("a time");
    stream
}

#[test]
fn of_a_hundred_at_once_as_many_are_served_as_have_places_and_others_find_one() {
    const ASKED: &[u8] = b"GET /api/state HTTP/1.1\r\nHost: localhost\r\n\r\n";
    let server = Server::start();
    let mut crowd: Vec<TcpStream> = (0..100).map(|_| server.connect()).collect();
    let is_served = |stream: &mut TcpStream| {
        let mut some = [0; 12];
        // One too many may be hung up on while it talks.
        stream.write_all(ASKED).and_then(|()| stream.read_exact(&mut some)).is_ok()
            && some == *b"HTTP/1.1 200"
    };
    // All of them stay: who was served has not given its place back.
    let served = crowd.iter_mut().map(is_served).filter(|served| *served).count();
    assert_eq!(served, Web::default().connections_max / 2);
    let mut other = connect_from([127, 0, 0, 2], server.address);
    assert!(is_served(&mut other), "another visitor is locked out");
}

#[test]
fn who_is_not_named_among_those_who_may_look_is_told_so_and_sees_nothing() {
    let allow = vec!["127.0.0.2".parse().expect("an address")];
    let server = Server::with(Web { allow, ..Web::default() }, Arc::new(Still));
    for path in ["/", "/api/state", "/metrics", "/main.js", "/api/archive/7/picture"] {
        let answer = server.get(path);
        assert_eq!(status(&answer), 403, "{path}");
        assert!(answer.contains("web.allow") && !answer.contains("1.2.3"), "{answer}");
        assert!(answer.to_lowercase().contains("content-security-policy"), "{answer}");
    }
    let mut named = connect_from([127, 0, 0, 2], server.address);
    named
        .write_all(b"GET /api/state HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        .expect("open");
    let mut answer = String::new();
    named.read_to_string(&mut answer).expect("answered");
    assert!(status(&answer) == 200 && answer.contains("1.2.3"), "{answer}");
}

#[test]
fn who_asks_a_byte_at_a_time_is_ended_and_others_are_served() {
    let server = Server::start();
    let mut slow = server.connect();
    let start = Instant::now();
    // A head that never ends: no byte is late, the whole is.
    slow.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ").expect("open");
    while slow.write_all(b"x").is_ok() {
        assert!(start.elapsed() < PATIENCE, "it is waited for");
        assert_eq!(status(&server.get("/api/state")), 200, "others are served meanwhile");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn who_asks_and_takes_no_answer_is_ended_and_others_are_served() {
    let server = Server::start();
    let mut deaf = server.connect();
    deaf.set_write_timeout(Some(PATIENCE)).expect("a time");
    // When nothing is taken the server stops to read, and then this stops to write.
    let end = loop {
        if let Err(error) = deaf.write_all(b"GET /main.js HTTP/1.1\r\nHost: localhost\r\n\r\n") {
            break error.kind();
        }
    };
    assert!(matches!(end, ErrorKind::ConnectionReset | ErrorKind::BrokenPipe), "{end}");
    assert_eq!(status(&server.get("/api/state")), 200);
}

#[test]
fn who_does_not_finish_a_request_is_disconnected() {
    let server = Server::start();
    // Returns only when the server hangs up, before the reader's patience ends.
    let mut slow = server.connect();
    slow.write_all(b"GET / HTTP/1.1\r\nHost: loc").expect("open");
    let mut answer = Vec::new();
    slow.read_to_end(&mut answer).expect("ended by the server");
    assert!(answer.is_empty() || status(&String::from_utf8_lossy(&answer)) == 408);
}

#[test]
fn a_live_picture_comes_when_it_is_put_up_and_only_then() {
    let server = Server::start();
    assert_eq!(status(&server.get("/api/live/belt")), 204, "nobody makes pictures");
    let board = Arc::clone(&server.board);
    std::thread::scope(|scope| {
        let request = scope.spawn(|| server.get("/api/live/belt?after=6"));
        let start = Instant::now();
        while !board.is_wanted(View::Belt) {
            assert!(start.elapsed() < PATIENCE, "the request does not ask");
            std::thread::yield_now();
        }
        assert!(!board.is_wanted(View::Raw));
        board.picture(View::Belt, 7, b"{\"frame\":7}\nJPEG".to_vec());
        let answer = request.join().expect("answered");
        assert!(answer.ends_with("{\"frame\":7}\nJPEG"), "{answer}");
    });
    assert!(!board.is_wanted(View::Belt), "nobody looks any more");
}

fn parcel(seq: u32) -> Parcel {
    let record = ParcelRecord {
        seq,
        frame: 137,
        t_s: 3.425,
        length_mm: 235.1,
        width_mm: 124.8,
        height_mm: 70.2,
        yaw_deg: -12.4,
        x_mm: 61.0,
        y_mm: -40.3,
        sigma_length_mm: 0.3,
        sigma_width_mm: 0.2,
        sigma_height_mm: 0.5,
        belt_speed_mm_per_s: 500.3,
        shape: Shape::Box,
        flags: Flags::default(),
        not_measured: None,
        may_be_used: true,
        belt_travel_mm: 1712.5,
        by_encoder: false,
    };
    Parcel {
        n: 0,
        utc_ms: 1_795_000_000_123,
        record,
        picture: None,
        no_picture: Some(NoPicture::TooMany),
    }
}

#[test]
fn the_last_parcels_are_a_table_for_a_spreadsheet() {
    let server = Server::start();
    for seq in 41..=43 {
        server.board.parcel(parcel(seq), Vec::new());
    }
    let answer = server.get("/api/parcels.csv");
    assert!(answer.contains("content-type: text/csv; charset=utf-8\r\n"), "{answer}");
    assert!(answer.contains("content-disposition: attachment; filename=\"parcels.csv\"\r\n"));
    let (_, table) = answer.split_once("\r\n\r\n").expect("an answer");
    let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(lines.len(), 4, "{table}");
    let cell = |name: &str| {
        let column = lines[0].iter().position(|head| *head == name);
        lines[3][column.unwrap_or_else(|| panic!("no column {name}"))]
    };
    for (name, value) in [
        ("n", "3"),
        ("utc", "2026-11-18T11:06:40.123Z"),
        ("seq", "43"),
        ("length_mm", "235.1"),
        ("yaw_deg", "-12.4"),
        ("shape", "box"),
        ("flags", ""),
        ("not_measured", ""),
        ("may_be_used", "true"),
        ("version", "1.2.3"),
    ] {
        assert_eq!(cell(name), value, "{name}");
    }
}

/// Ask for the bundle and begin to take it; the status that is answered.
fn begin_bundle(server: &Server) -> (TcpStream, String) {
    let mut stream = server.connect();
    stream.write_all(b"GET /api/bundle.tar.gz HTTP/1.0\r\nHost: localhost\r\n\r\n").expect("open");
    let mut head = [0; 12];
    stream.read_exact(&mut head).expect("answered");
    (stream, String::from_utf8_lossy(&head[9..]).into_owned())
}

#[test]
fn the_bundle_has_the_files_of_page_and_machine() {
    let server = Server::start();
    server.board.parcel(parcel(41), Vec::new());
    let (mut stream, status) = begin_bundle(&server);
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("whole");
    let body = answer.windows(4).position(|end| end == b"\r\n\r\n").expect("an answer") + 4;
    let head = String::from_utf8_lossy(&answer[..body]).into_owned();
    assert_eq!(status, "200");
    assert!(head.contains("content-disposition: attachment; filename=\"beltgauge-bundle.tar.gz\""));
    let mut files = BTreeMap::new();
    let mut archive = tar::Archive::new(flate2::read::GzDecoder::new(&answer[body..]));
    for entry in archive.entries().expect("whole") {
        let mut entry = entry.expect("whole");
        let (name, mut bytes) = (entry.path().expect("a name").into_owned(), Vec::new());
        entry.read_to_end(&mut bytes).expect("whole");
        files.insert(name.strip_prefix("beltgauge-bundle").expect("inside").to_owned(), bytes);
    }
    let text = |name: &str| String::from_utf8_lossy(&files[Path::new(name)]).into_owned();
    assert!(text("state.json").contains("1.2.3") && text("plc.json").contains("map_version"));
    assert!(text("parcels.csv").contains(",41,235.1,") && text("events.json") == "[]");
    assert_eq!(files[Path::new("11.bin")], noise(11, 1 << 20));
    assert_eq!(text("contents.txt").lines().count(), 4 + BUNDLED as usize);
}

#[test]
fn who_is_slow_to_take_the_bundle_holds_nobody_up_and_few_are_made_at_once() {
    let server = Server::start();
    let mut slow: Vec<(TcpStream, String)> = (0..4).map(|_| begin_bundle(&server)).collect();
    assert!(slow.iter().all(|(_, status)| status == "200"));
    // There are fewer readers than slow visitors.
    assert_eq!(status(&server.get("/api/archive?limit=1")), 200);
    assert_eq!(begin_bundle(&server).1, "503");
    slow.pop();
    let start = Instant::now();
    while begin_bundle(&server).1 != "200" {
        assert!(start.elapsed() < PATIENCE, "its place is not given back");
    }
}

#[test]
fn the_trend_is_taken_in_pieces_until_there_is_no_more() {
    let server = Server::start();
    for parcels in 0..1200 {
        server.board.point(Point { parcels, ..Point::default() });
    }
    let (mut since, mut lengths, mut parcels) = (0, Vec::new(), Vec::new());
    while lengths.last() != Some(&0) {
        let part = body(&server.get(&format!("/api/trend?since={since}")));
        let items = part["items"].as_array().expect("a list");
        parcels.extend(items.iter().map(|point| point["parcels"].as_u64().expect("a number")));
        lengths.push(items.len());
        since = part["next"].as_u64().expect("a number");
    }
    assert_eq!(lengths, [500, 500, 200, 0]);
    assert!(parcels.into_iter().eq(0..1200));
}

#[test]
fn strange_words_stay_words() {
    let server = Server::start();
    let detail = "</script><script>alert(1)</script>\u{0}\"'";
    let event = Event { n: 0, utc_ms: 1, kind: "began", code: 2, detail: detail.into() };
    server.board.event(event);
    let answer = server.get("/api/events");
    assert!(answer.contains("content-type: application/json"), "never taken for a page");
    assert_eq!(body(&answer)["items"][0]["detail"], detail);
}

#[test]
fn questions_left_behind_at_a_disk_that_hangs_are_bounded_and_the_rest_is_served() {
    let answers = Arc::new(AtomicBool::new(false));
    let server = Server::of(Arc::new(Hung(Arc::clone(&answers))));
    let ask = "GET /api/archive HTTP/1.1\r\nHost: localhost\r\n\r\n";
    let start = Instant::now();
    // Each asks and goes away; more than there are places for.
    let refused = loop {
        let mut stream = server.connect();
        stream.set_read_timeout(Some(Duration::from_millis(50))).expect("a time");
        stream.write_all(ask.as_bytes()).expect("taken");
        let mut head = [0; 12];
        if stream.read_exact(&mut head).is_ok() {
            break String::from_utf8_lossy(&head).into_owned();
        }
        assert!(start.elapsed() < PATIENCE, "every question is kept");
    };
    assert_eq!(refused, "HTTP/1.1 503");
    assert!(server.get("/api/state").starts_with("HTTP/1.1 200"));
    answers.store(true, Ordering::Relaxed);
    while !server.get("/api/archive").starts_with("HTTP/1.1 200") {
        assert!(start.elapsed() < 2 * PATIENCE, "the places are not given back");
    }
}
