//! A simulated sorter PLC at the appliance's server, through reconnects, restarts of either side,
//! attacks and load.

use hil::plc::{Chute, Client, Plc};
use hil::server::{Server, record};
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

const ANY_PORT: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

/// Ten times what it takes.
const PATIENCE: Duration = Duration::from_mins(2);

/// Numbers that look random and are the same in every run.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 33) % n
    }
}

fn folder(name: &str) -> std::path::PathBuf {
    let folder = hil::project().join("target/hil-out").join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("writable");
    folder
}

fn check(plc: &Plc, parcels: u32) {
    assert!(plc.complaints.is_empty(), "{:?}", plc.complaints);
    assert_eq!(plc.taken.len(), parcels as usize, "parcels taken");
    for ((parcel, chute), number) in plc.taken.iter().zip(1..) {
        let expected = record(number);
        let size_mm = [expected.length_mm, expected.width_mm, expected.height_mm];
        assert_eq!((parcel.sequence[0], parcel.size_mm), (number, size_mm));
        assert_eq!(*chute == Chute::Small, size_mm[0] <= 400.0);
    }
}

#[test]
fn a_thousand_parcels_arrive_once_untorn_in_order_through_reconnects_and_restarts() {
    const PARCELS: u32 = 1000;
    let state = folder("plc").join("state.json");
    let mut server = Server::start(ANY_PORT, Some(&state));
    let mut plc = Plc::new(server.address);
    let mut random = Random(7);
    let (mut sent, mut restarts, mut reconnects) = (0, 0, 0);
    let start = Instant::now();
    while plc.taken.len() < PARCELS as usize {
        assert!(plc.complaints.is_empty(), "{:?}", plc.complaints);
        assert!(start.elapsed() < PATIENCE, "{} of {PARCELS} parcels", plc.taken.len());
        // Parcels come in bursts, but no more than the queue holds.
        let burst = random.below(4) as u32;
        while sent < PARCELS
            && sent < plc.taken.len() as u32 + 20
            && sent < server.published() + burst
        {
            sent += 1;
            server.parcel(sent);
        }
        let cycles = random.below(6);
        for _ in 0..cycles {
            // A connection that the other side has ended fails once.
            let _ = plc.cycle();
            std::thread::sleep(Duration::from_micros(500 * random.below(6)));
        }
        if random.below(12) == 0 {
            plc.disconnect();
            reconnects += 1;
        }
        if random.below(60) == 0 && server.published() == sent {
            let address = server.address;
            drop(server);
            server = Server::start(address, Some(&state));
            restarts += 1;
        }
    }
    eprintln!("{PARCELS} parcels, {reconnects} reconnects, {restarts} restarts of the appliance");
    assert!(restarts >= 5 && reconnects >= 20);
    check(&plc, PARCELS);
    let mut client = Client::connect(server.address).expect("accepted");
    let boots = client.read(plc_register("status.boots"), 1).expect("exists");
    assert_eq!(boots[0], restarts + 1);
}

/// Every command acknowledges one parcel more: one that were carried out twice, or not at all, would
/// show in the queue.
#[test]
fn a_command_is_carried_out_once_whatever_restarts() {
    const COMMANDS: u32 = 60;
    let state = folder("commands").join("state");
    let mut server = Server::start(ANY_PORT, Some(&state));
    let mut plc = Plc::new(server.address);
    let mut random = Random(11);
    let (start, mut done, mut restarts) = (Instant::now(), 0, 0);
    // The scale interval that each command sets is the next one: read back, it tells which was last.
    while done < COMMANDS {
        assert!(start.elapsed() < PATIENCE, "{done} of {COMMANDS} commands");
        if let Ok(Some(result)) = plc.command(5, 1 + done) {
            assert_eq!(result, 1, "command {done}");
            done += 1;
            let set = plc.status("scale_interval").expect("answers");
            assert_eq!(set, done, "carried out before it is told");
        }
        match random.below(5) {
            0 => {
                let address = server.address;
                drop(server);
                server = Server::start(address, Some(&state));
                restarts += 1;
            }
            1 => {
                // Its program restarts; what is retained goes on.
                let under_way = plc.under_way;
                plc = Plc::new(server.address);
                plc.under_way = under_way;
            }
            _ => {}
        }
    }
    assert!(restarts > 20);
    let boots = plc.status("boots").expect("answers");
    assert_eq!(boots, restarts + 1);
}

#[test]
fn reading_and_writing_in_one_request_is_the_default_block_of_several_plcs() {
    let server = Server::start(ANY_PORT, None);
    server.parcel(1);
    hil::wait_for("the parcel", || (server.published() == 1).then_some(()));
    let mut client = Client::connect(server.address).expect("accepted");
    // 32 registers from 140; the heartbeat to 60.
    let answer = client.request(&[23, 0, 140, 0, 32, 0, 60, 0, 1, 2, 0, 7]).expect("answered");
    assert_eq!(answer[..6], [23, 64, 0, 0, 0, 1]);
    assert_eq!(client.read(60, 1).expect("exists"), [7]);
}

#[test]
fn a_plc_that_polls_once_a_second_outlasts_a_thousand_connects_a_second() {
    let server = Server::start(ANY_PORT, None);
    let (address, stop) = (server.address, AtomicBool::new(false));
    let connects = AtomicU64::new(0);
    let polls = 12;
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let begun = Instant::now();
            let mut held = std::collections::VecDeque::new();
            while !stop.load(Ordering::Relaxed) {
                if let Ok(stream) =
                    std::net::TcpStream::connect_timeout(&address, Duration::from_secs(1))
                {
                    held.push_back(stream);
                    connects.fetch_add(1, Ordering::Relaxed);
                }
                if held.len() > 40 {
                    held.pop_front();
                }
                let due_s = connects.load(Ordering::Relaxed) as f64 / 1000.0;
                let ahead_s = due_s - begun.elapsed().as_secs_f64();
                std::thread::sleep(Duration::from_secs_f64(ahead_s.max(0.0)));
            }
        });
        let mut client = Client::connect(address).expect("accepted");
        for poll in 0..polls {
            let answered = client.read(100, 32);
            assert!(answered.is_ok(), "poll {poll}: {answered:?}");
            std::thread::sleep(Duration::from_secs(1));
        }
        stop.store(true, Ordering::Relaxed);
    });
    eprintln!("{polls} polls answered beside {} connects", connects.into_inner());
}

fn plc_register(name: &str) -> u16 {
    hil::plc::map()[name].address
}

#[test]
fn a_plc_that_is_away_too_long_is_told_how_many_it_lost() {
    let server = Server::start(ANY_PORT, None);
    (1..=40).for_each(|number| server.parcel(number));
    hil::wait_for("parcels", || (server.published() == 40).then_some(()));
    let mut client = Client::connect(server.address).expect("accepted");
    let overflows = client.read(plc_register("status.queue_overflows"), 2).expect("exists");
    assert_eq!(overflows, [0, 8]);
    let oldest = client.read(plc_register("queue.sequence"), 2).expect("exists");
    assert_eq!(oldest, [0, 9]);
}

#[test]
fn a_million_requests_of_anything_do_no_harm() {
    const CLIENTS: u64 = 4;
    const EACH: u64 = 250_000;
    let server = Server::start(ANY_PORT, None);
    let address = server.address;
    let answered = AtomicU64::new(0);
    let memory_kib = resident_kib();
    std::thread::scope(|scope| {
        for seed in 0..CLIENTS {
            let answered = &answered;
            scope.spawn(move || {
                let mut random = Random(seed + 1);
                let mut client = None;
                for _ in 0..EACH {
                    let known = [1, 2, 3, 4, 6, 16, 43, 5, 15, 22, 23, 24];
                    let mut pdu = vec![match random.below(4) {
                        0 => random.below(256) as u8,
                        _ => known[random.below(known.len() as u64) as usize],
                    }];
                    let bytes =
                        if random.below(8) == 0 { random.below(252) } else { 4 + random.below(12) };
                    pdu.extend((0..bytes).map(|_| match random.below(3) {
                        0 => 0,
                        1 => random.below(130) as u8,
                        _ => random.below(256) as u8,
                    }));
                    let mut connected = match client.take() {
                        Some(client) => client,
                        None => match Client::connect(address) {
                            Ok(client) => client,
                            Err(_) => continue,
                        },
                    };
                    let answer = connected.request(&pdu).expect("an answer or an exception");
                    assert!(answer[0] & 0x7f == pdu[0] & 0x7f, "{pdu:?}: {answer:?}");
                    answered.fetch_add(1, Ordering::Relaxed);
                    if random.below(5000) != 0 {
                        client = Some(connected);
                    }
                }
            });
        }
    });
    assert_eq!(answered.into_inner(), CLIENTS * EACH);
    let grown_kib = resident_kib().saturating_sub(memory_kib);
    eprintln!("a million requests: resident memory grew by {grown_kib} KiB");
    // Buffers of a few connections; a leak of 16 bytes a request would be 16 MB.
    assert!(grown_kib < 4096, "{grown_kib} KiB");
    server.parcel(1);
    hil::wait_for("the parcel", || (server.published() == 1).then_some(()));
}

fn resident_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).expect("Linux");
    line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).expect("a number")
}

#[test]
fn streams_that_are_no_modbus_end_and_leave_the_server_as_it_was() {
    let server = Server::start(ANY_PORT, None);
    let mut random = Random(3);
    for _ in 0..3000 {
        use std::io::{Read, Write};
        let mut stream = std::net::TcpStream::connect(server.address).expect("accepted");
        let bytes: Vec<u8> = (0..random.below(600)).map(|_| random.below(256) as u8).collect();
        // The server may hang up in the middle of it.
        let _ = stream.write_all(&bytes);
        let _ = stream.shutdown(std::net::Shutdown::Write);
        let _ = stream.read_to_end(&mut Vec::new());
    }
    let mut client = Client::connect(server.address).expect("accepted");
    assert_eq!(client.read(0, 1).expect("exists"), [0x4247]);
}

#[test]
fn sixteen_clients_at_100_hz_delay_no_parcel() {
    let server = Server::start(ANY_PORT, None);
    let (address, stop) = (server.address, AtomicBool::new(false));
    let polls = AtomicU64::new(0);
    let mut latencies_ms = Vec::new();
    std::thread::scope(|scope| {
        // 15 and the one that waits.
        for _ in 0..15 {
            scope.spawn(|| {
                let mut client = Client::connect(address).expect("accepted");
                while !stop.load(Ordering::Relaxed) {
                    assert_eq!(client.read(100, 125).expect("exists").len(), 125);
                    polls.fetch_add(1, Ordering::Relaxed);
                    std::thread::sleep(Duration::from_millis(10));
                }
            });
        }
        let mut client = Client::connect(address).expect("accepted");
        for number in 1..=200 {
            let left = Instant::now();
            server.parcel(number);
            while client.read(101, 1).expect("exists") != [number as u16] {
                assert!(left.elapsed() < Duration::from_secs(10), "parcel {number} never came");
            }
            latencies_ms.push(1e3 * left.elapsed().as_secs_f64());
            // At all phases of the server's own period.
            std::thread::sleep(Duration::from_micros(10_000 + 170 * u64::from(number % 12)));
        }
        stop.store(true, Ordering::Relaxed);
    });
    latencies_ms.sort_unstable_by(f64::total_cmp);
    let [median, most] = [100, 189].map(|i| latencies_ms[i]);
    eprintln!(
        "from leaving to the PLC's read, 16 clients: median {median:.2} ms, 95 % {most:.2} ms, \
         {} polls",
        polls.into_inner()
    );
}
