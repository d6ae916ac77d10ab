//! A fleet without machines: real brokers and subscribers (mosquitto), and lanes that have the
//! product's own archive and fleet thread, with parcels that no camera has seen.

use beltgauge::archive::{Archive, Entry, Kind, Reader};
use beltgauge::config::Fleet as Settings;
use beltgauge::event::{Flags, ParcelRecord, Shape};
use beltgauge::fleet::{self, Entries, Figures, Machine};
use beltgauge::store::files;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::fmt::Write as _;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The site of all lanes here.
pub const SITE: &str = "hall-1";
/// The archive of a lane.
const ARCHIVE_BYTES_MAX: u64 = 64 << 20;
const FAREWELL: Duration = Duration::from_secs(5);

/// A folder for a test, empty.
///
/// # Panics
/// When there is no room.
pub fn folder(name: &str) -> PathBuf {
    let folder = crate::project().join("target/hil-out").join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("room");
    folder.canonicalize().expect("there")
}

/// Send a signal to a child of ours.
///
/// # Panics
/// When it has been waited for.
pub fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).expect("our own child");
}

/// A mosquitto.
pub struct Broker {
    /// Where it listens.
    pub address: SocketAddr,
    configuration: PathBuf,
    child: Option<Child>,
}

impl Broker {
    /// On a free port, for everybody.
    ///
    /// # Panics
    /// When it does not start: `apt-get install mosquitto`.
    pub fn start(folder: &Path) -> Self {
        Self::start_with(folder, "allow_anonymous true\n")
    }

    /// On a free port, with more of a configuration.
    ///
    /// # Panics
    /// When it does not start.
    pub fn start_with(folder: &Path, more: &str) -> Self {
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = free.local_addr().expect("bound");
        drop(free);
        let configuration = folder.join("mosquitto.conf");
        let text = format!(
            "user root\npersistence true\npersistence_location {}/\nlistener {} 127.0.0.1\n{more}",
            folder.display(),
            address.port()
        );
        std::fs::write(&configuration, text).expect("room");
        let mut broker = Self { address, configuration, child: None };
        broker.again();
        broker
    }

    /// Start it again, with what it has kept.
    ///
    /// # Panics
    /// When it does not start.
    pub fn again(&mut self) {
        let log = self.configuration.with_extension("log");
        let log = std::fs::OpenOptions::new().create(true).append(true).open(log).expect("room");
        let child = Command::new("mosquitto")
            .arg("-c")
            .arg(&self.configuration)
            .stderr(log)
            .stdout(Stdio::null())
            .spawn()
            .expect("apt-get install mosquitto");
        self.child = Some(child);
        crate::wait_for("the broker", || TcpStream::connect(self.address).ok());
    }

    /// Hold it: what it is sent meanwhile it has not read.
    ///
    /// # Panics
    /// When it does not run.
    pub fn hold(&self) {
        signal(self.child.as_ref().expect("runs"), Signal::STOP);
    }

    /// End it by a signal, also when it is held.
    ///
    /// # Panics
    /// When it does not run.
    pub fn end(&mut self, by: Signal) {
        let mut child = self.child.take().expect("runs");
        signal(&child, by);
        signal(&child, Signal::CONT);
        child.wait().expect("a child");
    }

    /// Processor time used so far, s, and resident memory, MiB.
    ///
    /// # Panics
    /// When it does not run.
    pub fn used(&self) -> (f64, f64) {
        used(self.child.as_ref().expect("runs").id())
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        if self.child.is_some() {
            self.end(Signal::KILL);
        }
    }
}

/// Processor time of a process so far, s, and its resident memory, MiB.
///
/// # Panics
/// When there is none.
pub fn used(process: u32) -> (f64, f64) {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).expect("runs");
    let fields: Vec<&str> = stat.rsplit_once(')').expect("a name").1.split_whitespace().collect();
    let ticks = |at: usize| fields[at].parse::<f64>().expect("a number");
    // Ticks are 10 ms, pages 4 KiB.
    ((ticks(11) + ticks(12)) / 100.0, ticks(21) * 4.0 / 1024.0)
}

/// A message as it came.
#[derive(Clone, Debug)]
pub struct Received {
    /// The last part of its topic.
    pub what: String,
    /// The lane's name.
    pub lane: String,
    /// JSON; null: it is none.
    pub payload: Value,
    /// When it came, ms since 1970.
    pub at_ms: u64,
    /// Of topic and payload.
    pub bytes: usize,
}

/// A mosquitto_sub, with all that it has got.
pub struct Subscriber {
    child: Child,
    received: Arc<Mutex<Vec<Received>>>,
    reader: Option<JoinHandle<()>>,
}

impl Subscriber {
    /// Of all topics, in a session that outlives connections.
    ///
    /// # Panics
    /// When it does not start: `apt-get install mosquitto-clients`.
    pub fn start(broker: SocketAddr, name: &str, more: &[&str]) -> Self {
        let port = broker.port().to_string();
        let mut child = Command::new("mosquitto_sub")
            .args([
                "-V",
                "5",
                "-h",
                "127.0.0.1",
                "-p",
                &port,
                "-q",
                "1",
                "-i",
                name,
                "-c",
                "-x",
                "86400",
            ])
            .args(["-t", "beltgauge/#", "-v"])
            .args(more)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("apt-get install mosquitto-clients");
        let received = Arc::<Mutex<Vec<Received>>>::default();
        let (into, output) = (Arc::clone(&received), child.stdout.take().expect("piped"));
        let reader = std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let Some((topic, payload)) = line.split_once(' ') else { continue };
                let mut parts = topic.rsplit('/');
                let mut part = || parts.next().unwrap_or_default().to_owned();
                let (what, lane) = (part(), part());
                let payload_value = serde_json::from_str(payload).unwrap_or_default();
                into.lock().expect("whole").push(Received {
                    what,
                    lane,
                    payload: payload_value,
                    at_ms: now_ms(),
                    bytes: line.len() - 1,
                });
            }
        });
        Self { child, received, reader: Some(reader) }
    }

    /// Hold it: what comes meanwhile waits at the broker.
    ///
    /// # Panics
    /// When it has ended.
    pub fn hold(&self) {
        signal(&self.child, Signal::STOP);
    }

    /// Let it go on.
    ///
    /// # Panics
    /// When it has ended.
    pub fn go_on(&self) {
        signal(&self.child, Signal::CONT);
    }

    /// What has come so far.
    ///
    /// # Panics
    /// When its reader has panicked.
    pub fn received(&self) -> MutexGuard<'_, Vec<Received>> {
        self.received.lock().expect("whole")
    }

    /// Wait for a message.
    ///
    /// # Panics
    /// When none comes within a minute.
    pub fn wait(&self, name: &str, is: impl Fn(&Received) -> bool) -> Received {
        crate::wait_for(name, || self.received().iter().find(|message| is(message)).cloned())
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if let Some(reader) = self.reader.take() {
            let _ = reader.join();
        }
    }
}

/// Send a message. Whether the broker has taken it.
///
/// # Panics
/// When there is no mosquitto_pub.
pub fn publish(broker: SocketAddr, topic: &str, payload: &str, more: &[&str]) -> bool {
    let output = Command::new("mosquitto_pub")
        .args(["-V", "5", "-h", "127.0.0.1", "-p", &broker.port().to_string(), "-q", "1"])
        .args(["-t", topic, "-m", payload])
        .args(more)
        .output()
        .expect("apt-get install mosquitto-clients");
    // Refused by the broker's list of rights it is still sent, with a warning.
    output.status.success() && output.stderr.is_empty()
}

/// The wall clock.
///
/// # Panics
/// Before 1970.
pub fn now_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_millis() as u64
}

/// A lane: an archive with parcels, and its fleet thread.
pub struct Lane {
    archive: Archive,
    boots: u16,
    seq: u32,
    made: Arc<AtomicU64>,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct Side {
    folder: PathBuf,
    boots: u16,
    made: Arc<AtomicU64>,
}

impl Machine for Side {
    fn boots(&self) -> Option<u16> {
        Some(self.boots)
    }
    fn figures(&self) -> Figures {
        let parcels = self.made.load(Ordering::Relaxed);
        Figures { utc_ms: now_ms(), running: true, parcels, ..Figures::default() }
    }
    fn entries_after(&self, number: u64) -> Box<dyn Entries> {
        beltgauge::run::fleet::entries_after(&self.folder, number)
    }
    fn entry_time(&self, number: u64) -> Result<(Option<u64>, u64), String> {
        beltgauge::run::fleet::entry_time(&self.folder, number)
    }
}

impl Lane {
    /// Go on where it ended, however it ended: numbers from the archive, one more start.
    ///
    /// # Panics
    /// When the disk fails.
    pub fn start(folder: &Path, settings: Settings) -> Self {
        std::fs::create_dir_all(folder).expect("room");
        let starts = folder.join("boots");
        let boots = std::fs::read_to_string(&starts).ok().and_then(|text| text.parse().ok());
        let boots: u16 = boots.unwrap_or(0) + 1;
        files::replace(&starts, boots.to_string().as_bytes()).expect("room");
        let archive = Archive::start(folder, ARCHIVE_BYTES_MAX).expect("starts");
        let seq = last_seq(folder);
        let (made, over) = (Arc::<AtomicU64>::default(), Arc::<AtomicBool>::default());
        let side = Side { folder: folder.to_owned(), boots, made: Arc::clone(&made) };
        let (side, ended): (Arc<dyn Machine>, _) = (Arc::new(side), Arc::clone(&over));
        let folder = folder.to_owned();
        let thread = std::thread::spawn(move || {
            let is_over = || ended.load(Ordering::Relaxed);
            fleet::serve(&settings, &folder, &side, &is_over).expect("serves");
        });
        Self { archive, boots, seq, made, over, thread: Some(thread) }
    }

    /// Number of the last parcel.
    pub fn seq(&self) -> u32 {
        self.seq
    }

    /// A parcel leaves; its size tells which it is.
    ///
    /// # Panics
    /// When the disk fails.
    pub fn parcel(&mut self) {
        self.seq += 1;
        let (seq, boots, utc_ms) = (self.seq, self.boots, now_ms());
        let record = serde_json::to_string(&record(seq)).expect("JSON");
        let mut text = record.trim_end_matches('}').to_owned();
        // As the desk archives it.
        let _ = write!(
            text,
            ",\"n\":{seq},\"utc_ms\":{utc_ms},\"picture\":null,\"no_picture\":\"not_in_middle\",\
             \"boots\":{boots},\"version\":\"0\"}}"
        );
        let before = self.archive.condition().written;
        self.archive.put(Entry { kind: Kind::Parcel, utc_ms, text, picture: Vec::new() });
        // A ring that is full would lose one: that is no subject here.
        crate::wait_for("the archive", || {
            assert_eq!(self.archive.condition().lost, 0);
            (self.archive.condition().written + 32 > before).then_some(())
        });
        self.made.fetch_add(1, Ordering::Relaxed);
    }

    /// Let it end, without waiting for it.
    pub fn end(&self) {
        self.over.store(true, Ordering::Relaxed);
    }

    /// End it in order.
    ///
    /// # Panics
    /// When its thread has.
    pub fn finish(mut self) {
        self.end();
        if let Some(thread) = self.thread.take() {
            thread.join().expect("ends");
        }
        self.archive.finish(FAREWELL);
    }
}

fn last_seq(folder: &Path) -> u32 {
    let newest = Reader::open(folder).and_then(|reader| reader.before(None, 50));
    let seq = |text: &str| serde_json::from_str::<Value>(text).ok()?["seq"].as_u64();
    let newest = newest.unwrap_or_default();
    newest.entries.iter().find_map(|stored| seq(&stored.entry.text)).unwrap_or(0) as u32
}

/// A parcel whose length and width tell its number.
fn record(seq: u32) -> ParcelRecord {
    ParcelRecord {
        seq,
        frame: u64::from(seq) * 21,
        t_s: f64::from(seq) / 2.0,
        length_mm: 100.0 + f64::from(seq % 997),
        width_mm: 50.0 + f64::from(seq / 997),
        height_mm: 70.2,
        yaw_deg: 12.4,
        x_mm: 61.0,
        y_mm: -40.3,
        sigma_length_mm: 0.3,
        sigma_width_mm: 0.31,
        sigma_height_mm: 0.5,
        belt_speed_mm_per_s: 500.3,
        shape: Shape::Box,
        flags: Flags::default(),
        not_measured: None,
        may_be_used: true,
        belt_travel_mm: 250.0 * f64::from(seq),
        by_encoder: false,
    }
}

/// Settings of a lane of this name, on a broker for everybody.
pub fn settings(broker: SocketAddr, lane: &str) -> Settings {
    let (site, lane) = (Some(SITE.to_owned()), Some(lane.to_owned()));
    Settings { broker: Some(broker), site, lane, ..Settings::default() }
}
