//! The link killed at random instants, on disks that are full or fail, with a PLC that acknowledges.

use hil::plc::Client;
use rustix::process::{Pid, Resource, Rlimit, Signal, kill_process, prlimit};
use std::collections::HashMap;
use std::net::SocketAddr;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

/// The journal's file, which was written whole when it was new.
const FILE_BYTES: u64 = 40 * 1024;

struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 33) % n
    }
}

/// What `BeltgaugeQueue` of config/plc.st does, with everything that it ever took.
#[derive(Default)]
struct Plc {
    /// Numbers that were taken last: `taken` there.
    last: std::collections::VecDeque<u32>,
    /// Which parcel each number was.
    parcel_of: HashMap<u32, u32>,
    /// In the order in which they were taken.
    taken: Vec<u32>,
    repeated: u32,
}

impl Plc {
    fn cycle(&mut self, client: &mut Client) -> std::io::Result<()> {
        let block = client.read(140, 32)?;
        let number = u32::from(block[0]) << 16 | u32::from(block[1]);
        if number == 0 {
            std::thread::sleep(Duration::from_millis(1));
            return Ok(());
        }
        // `record` of hil::server: length and width tell the parcel.
        let parcel = u32::from(block[4]) / 10 - 100 + 997 * (u32::from(block[5]) / 10 - 50);
        let before = *self.parcel_of.entry(number).or_insert(parcel);
        assert_eq!(before, parcel, "number {number} was given to two parcels");
        if self.last.contains(&number) {
            self.repeated += 1;
        } else {
            self.taken.push(number);
            self.last.push_back(number);
            if self.last.len() > 32 {
                self.last.pop_front();
            }
        }
        client.write(61, &[number as u16])
    }
}

/// Killed, also when the test fails.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(address: SocketAddr, state: &std::path::Path, first: u32) -> (Killed, Client) {
    let child = Command::new(env!("CARGO_BIN_EXE_link_server"))
        .args([address.to_string(), state.display().to_string(), first.to_string()])
        .spawn()
        .expect("starts");
    let begun = Instant::now();
    loop {
        match Client::connect(address) {
            Ok(client) => return (Killed(child), client),
            Err(e) => assert!(begun.elapsed() < Duration::from_secs(20), "no server: {e}"),
        }
        std::thread::sleep(Duration::from_millis(3));
    }
}

fn limit_files(child: &Child, bytes: Option<u64>) {
    let limit = Rlimit { current: bytes, maximum: None };
    prlimit(Pid::from_child(child).into(), Resource::Fsize, limit).expect("our own child");
}

/// Run, kill and start again; `disk` is what happens to the disk at a random instant of each run.
fn kills(name: &str, count: u32, disk: Option<u64>) -> Plc {
    let folder = hil::project().join("target/hil-out").join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("writable");
    let state = folder.join("state");
    let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr());
    let address = free.expect("a free port");
    let (mut plc, mut random) = (Plc::default(), Random(5));
    for kill in 0..count {
        // A parcel of its own for every time it is emitted.
        let (mut child, mut client) = start(address, &state, 1 + 200 * kill);
        let begun = Instant::now();
        let lives = Duration::from_millis(10 + random.below(150));
        let mut disk_at =
            disk.map(|bytes| (begun + lives.mul_f64(random.below(100) as f64 / 100.0), bytes));
        while begun.elapsed() < lives {
            if let Some((_, bytes)) = disk_at.take_if(|(at, _)| Instant::now() >= *at) {
                limit_files(&child.0, Some(bytes));
            }
            plc.cycle(&mut client).expect("answers");
        }
        // In the middle of a request as well.
        let pid = Pid::from_child(&child.0);
        let killer = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_micros(300));
            kill_process(pid, Signal::KILL).expect("our own child");
        });
        while plc.cycle(&mut client).is_ok() {}
        killer.join().expect("kills");
        child.0.wait().expect("killed");
    }
    // What is left in the queue.
    let (_child, mut client) = start(address, &state, 1 + 200 * count);
    (0..60).for_each(|_| plc.cycle(&mut client).expect("answers"));
    eprintln!(
        "{name}: {count} kills, {} parcels taken, {} seen again and known",
        plc.taken.len(),
        plc.repeated
    );
    plc
}

/// Every number is of one parcel: asked in each cycle. Every parcel has one number: asked here.
fn none_has_two_numbers(plc: &Plc) {
    let mut parcels: Vec<u32> = plc.parcel_of.values().copied().collect();
    parcels.sort_unstable();
    parcels.dedup();
    assert_eq!(parcels.len(), plc.parcel_of.len(), "a parcel with two numbers");
}

fn none_lost_or_twice(plc: &Plc) {
    let parcels = plc.taken.len() as u32;
    let wrong = plc.taken.iter().copied().zip(1..=parcels).find(|(taken, due)| taken != due);
    assert!(wrong.is_none(), "a gap or a repetition: {wrong:?}, taken and due, of {parcels}");
    none_has_two_numbers(plc);
}

#[test]
fn two_hundred_kills_lose_no_parcel_and_give_no_number_twice() {
    none_lost_or_twice(&kills("kills", 200, None));
}

#[test]
fn fifty_full_disks_lose_no_parcel_and_give_no_number_twice() {
    none_lost_or_twice(&kills("full", 50, Some(FILE_BYTES)));
}

/// What was published while nothing could be written is gone with the process, and what was acknowledged
/// then may come again, with its number. A parcel that the disk took just before it failed, unknown to
/// us, may come again with another number. No number is given to another parcel: asked in each cycle.
#[test]
fn fifty_failing_disks_give_no_number_twice() {
    let plc = kills("failing", 50, Some(0));
    assert!(plc.parcel_of.keys().any(|number| *number > 0xffff), "no disk has failed");
}
