//! Parcels on their way to the site, with machines and brokers that are killed. The brokers and
//! subscribers are mosquitto's.

use beltgauge::config::Fleet as Settings;
use hil::Demo;
use hil::fleet::{
    Broker, Lane as Simulated, Received, SITE, Subscriber, folder, publish, settings, signal, used,
};
use rustix::process::Signal;
use serde_json::Value;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

/// Parcels, unless the environment asks for more.
const RECORDS: u32 = 600;
/// One every so many ms.
const PERIOD_MS: u32 = 25;
/// Of each kind.
const KILLS_OF_EACH: usize = 4;
/// The broker passes 20 messages on unacknowledged: more come within this, and a machine tells them.
const HOLD: Duration = Duration::from_millis(1200);

struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 33) % n
    }
}

/// Killed, also when the test fails.
struct Lane(Child);

impl Lane {
    fn start(broker: &Broker, folder: &Path, records: u32) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_fleet_lane"))
            .arg(broker.address.to_string())
            .arg(folder)
            .args([PERIOD_MS.to_string(), records.to_string()])
            .spawn()
            .expect("starts");
        Self(child)
    }

    fn end(&mut self, by: Signal) {
        signal(&self.0, by);
        self.0.wait().expect("a child");
    }
}

impl Drop for Lane {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn is_replay(message: &Received) -> bool {
    message.payload["replay"] == Value::Bool(true)
}

fn seq(message: &Received) -> u32 {
    message.payload["seq"].as_u64().expect("a number") as u32
}

/// The parcels that never came, of so many.
fn missing(subscriber: &Subscriber, records: u32) -> Vec<u32> {
    let mut has = vec![false; records as usize + 1];
    for message in subscriber.received().iter().filter(|m| m.what == "parcel") {
        has[seq(message) as usize] = true;
    }
    (1..=records).filter(|seq| !has[*seq as usize]).collect()
}

/// What is killed.
#[derive(Clone, Copy, Debug)]
enum Kill {
    Machine(Signal),
    Broker(Signal),
}

/// Parcels on their way while all that is killed; at the end the broker has acknowledged the last one.
fn deliver(name: &str, kinds: &[Kill], records: u32) -> (Broker, Subscriber, Lane) {
    let folder = folder(name);
    let mut broker = Broker::start(&folder);
    let subscriber = Subscriber::start(broker.address, "database", &[]);
    let archive = folder.join("lane");
    let mut lane = Lane::start(&broker, &archive, records);
    let mut kills = kinds.repeat(KILLS_OF_EACH);
    // Spread over the time that the parcels take.
    let pause = u64::from(records * PERIOD_MS) / kills.len() as u64;
    let mut random = Random(7);
    while !kills.is_empty() {
        std::thread::sleep(Duration::from_millis(pause / 2 + random.below(pause)));
        match kills.swap_remove(random.below(kills.len() as u64) as usize) {
            Kill::Machine(by) => {
                lane.end(by);
                lane = Lane::start(&broker, &archive, records);
            }
            Kill::Broker(by) => {
                if by == Signal::KILL {
                    // What it has acknowledged and not passed on is lost with it.
                    subscriber.hold();
                } else {
                    // What it was sent and has not acknowledged is on its way.
                    broker.hold();
                }
                std::thread::sleep(HOLD);
                broker.end(by);
                subscriber.go_on();
                std::thread::sleep(Duration::from_millis(random.below(1500)));
                broker.again();
            }
        }
    }
    // Every entry of this archive is a parcel.
    let cursor = archive.join("fleet.cursor");
    hil::wait_for("the last acknowledgment", || {
        let cursor: Value = serde_json::from_slice(&std::fs::read(&cursor).ok()?).ok()?;
        (cursor["entry"] == records).then_some(())
    });
    (broker, subscriber, lane)
}

/// Whatever comes twice is the same; whatever is new comes in order. How many came twice unasked.
fn judge(subscriber: &Subscriber) -> usize {
    let received = subscriber.received();
    let mut by_id = HashMap::new();
    let (mut highest, mut twice) = (0, 0);
    for message in received.iter().filter(|m| m.what == "parcel") {
        let (seq, mut payload) = (seq(message), message.payload.clone());
        payload.as_object_mut().expect("fields").remove("replay");
        let id = payload["id"].as_str().expect("text").to_owned();
        let parts: Vec<&str> = id.split('/').collect();
        assert!(parts.len() == 3 && parts[2] == seq.to_string(), "{id}");
        let is_new = !by_id.contains_key(&id);
        let first = by_id.entry(id).or_insert_with(|| payload.clone());
        assert_eq!(*first, payload, "another parcel has its id");
        if is_replay(message) {
            continue;
        }
        assert!(!is_new || seq > highest, "{seq} came behind {highest} for the first time");
        highest = highest.max(seq);
        twice += usize::from(!is_new);
    }
    let mut seqs: Vec<&str> = by_id.keys().filter_map(|id| id.rsplit('/').next()).collect();
    seqs.sort_unstable();
    seqs.dedup();
    assert_eq!(seqs.len(), by_id.len(), "a parcel has two ids");
    twice
}

/// As asked for by the environment.
fn records() -> u32 {
    std::env::var("FLEET_RECORDS").ok().and_then(|n| n.parse().ok()).unwrap_or(RECORDS)
}

#[test]
fn every_parcel_arrives_unasked_over_killed_machines_and_a_broker_that_keeps_what_it_acknowledges()
{
    let (records, begun) = (records() / 2, Instant::now());
    let kills = [Signal::TERM, Signal::KILL].map(Kill::Machine);
    let kills = [kills[0], kills[1], Kill::Broker(Signal::TERM)];
    let (_broker, subscriber, _lane) = deliver("fleet-kills", &kills, records);
    subscriber.wait("the last parcel", |m| m.what == "parcel" && seq(m) == records);
    assert_eq!(missing(&subscriber, records), [0; 0]);
    let twice = judge(&subscriber);
    eprintln!(
        "{records} parcels in {:.0} s, killed {KILLS_OF_EACH} times each: machine by TERM, machine by KILL, broker by \
         TERM: none missing, {twice} came twice, each with its id",
        begun.elapsed().as_secs_f64(),
    );
}

#[test]
fn what_a_killed_broker_loses_comes_when_it_is_asked_for() {
    let (records, begun) = (records() / 2, Instant::now());
    let kills = [Kill::Machine(Signal::KILL), Kill::Broker(Signal::KILL)];
    let (broker, subscriber, lane) = deliver("fleet-lost", &kills, records);
    // What it has not lost has come by now.
    std::thread::sleep(HOLD);
    let lost = missing(&subscriber, records);
    let (Some(from), Some(to)) = (lost.first(), lost.last()) else {
        panic!("the broker has lost nothing: nothing is tested here")
    };
    let topic = format!("beltgauge/{SITE}/lane-1/cmd/replay");
    let command = format!("{{\"from\": {from}, \"to\": {to}}}");
    assert!(publish(broker.address, &topic, &command, &[]));
    subscriber.wait("the end of the replay", |m| m.payload["kind"] == "replayed");
    assert_eq!(missing(&subscriber, records), [0; 0]);
    let twice = judge(&subscriber);
    let (_, resident_mib) = used(lane.0.id());
    // 3 MiB without a connection; the client's own tables would take 18.
    assert!(resident_mib < 12.0, "{resident_mib} MiB");
    eprintln!(
        "{records} parcels in {:.0} s, killed by KILL {KILLS_OF_EACH} times each: machine, broker: {} lost by the \
         broker after it had acknowledged them, none after a replay; {twice} came twice unasked, each with its id; \
         the machine's process has {resident_mib:.1} MiB",
        begun.elapsed().as_secs_f64(),
        lost.len(),
    );
}

#[test]
fn an_appliance_is_born_takes_leave_and_obeys_one_command() {
    let folder = folder("fleet-appliance");
    let broker = Broker::start(&folder);
    let subscriber = Subscriber::start(broker.address, "database", &[]);
    let tables = folder.join("tables.toml");
    let text = format!(
        "[plc]\nstate_file = \"state\"\n[archive]\nfolder = \"archive\"\n[fleet]\nbroker = \"{}\"\n\
         site = \"{SITE}\"\nlane = \"lane-7\"\n",
        broker.address
    );
    std::fs::write(&tables, text).expect("room");
    let arguments = ["--config", tables.to_str().expect("text")];
    let topic = format!("beltgauge/{SITE}/lane-7/cmd/replay");
    let is = |what: &'static str, boots: u64| {
        move |m: &Received| m.what == what && m.lane == "lane-7" && m.payload["boots"] == boots
    };
    // Before it is there: not kept for it.
    let retained = ["--retain"];
    assert!(publish(broker.address, &topic, "{\"from\":1,\"to\":9}", &retained));

    let demo = Demo::start_with("fleet-demo", 600, false, &arguments);
    let state = subscriber.wait("its birth", is("state", 1));
    assert_eq!(state.payload["state"], "online");
    assert_eq!(subscriber.wait("its condition", is("health", 1)).payload["camera_present"], true);
    let started = subscriber.wait("its start", |m| m.what == "event");
    assert_eq!(started.payload["kind"], "started");
    let first = subscriber.wait("a parcel", is("parcel", 1));
    assert_eq!((seq(&first), is_replay(&first)), (1, false));
    assert!(first.payload["length_mm"].as_f64().is_some_and(|mm| mm > 50.0), "{first:?}");
    // Killed: the broker tells its will.
    drop(demo);
    let is_offline = |m: &Received| m.what == "state" && m.payload["state"] == "offline";
    assert!(subscriber.wait("its will", is_offline).payload.get("since").is_none());
    let later = Subscriber::start(broker.address, "later", &[]);
    assert!(is_offline(&later.wait("what is retained", |m| m.what == "state")));
    drop(later);

    let demo = Demo::start_with("fleet-demo", 600, false, &arguments);
    assert_eq!(subscriber.wait("its birth", is("state", 2)).payload["state"], "online");
    let known =
        seq(&subscriber.received().iter().rfind(|m| is("parcel", 1)(m)).cloned().expect("one"));
    assert_eq!(seq(&subscriber.wait("a parcel", is("parcel", 2))), known + 1);
    // What is no command is told, once in a while.
    for nonsense in ["x".repeat(300), "delete everything".to_owned(), "{}".to_owned()] {
        assert!(publish(broker.address, &topic, &nonsense, &[]));
    }
    let is_refusal = |m: &Received| m.payload["kind"] == "command_refused";
    let detail = subscriber.wait("a refusal", is_refusal).payload["detail"].to_string();
    assert!(detail.contains("300 bytes"), "{detail}");
    assert!(publish(broker.address, &topic, "{\"from\":1,\"to\":1}", &[]));
    let again = subscriber.wait("the parcel again", is_replay);
    assert_eq!(again.payload["id"], first.payload["id"]);
    let replayed = subscriber.wait("the end of the replay", |m| m.payload["kind"] == "replayed");
    assert_eq!(replayed.payload["code"], 1);
    let received = subscriber.received().clone();
    assert_eq!(received.iter().filter(|m| is_refusal(m)).count(), 1);
    assert_eq!(
        received.iter().filter(|m| is_replay(m)).count(),
        1,
        "the retained command was obeyed"
    );
    drop(demo);
}

/// Certificates, rights and passwords, as config/fleet/README.md makes them.
fn secured(folder: &Path) -> Broker {
    let run = |program: &str, arguments: &[&str]| {
        run(Command::new(program).args(arguments).current_dir(folder));
    };
    let shipped = hil::project().join("config/fleet");
    let script = std::fs::read_to_string(shipped.join("certificates.sh")).expect("shipped");
    run("bash", &["-c", &script, "certificates.sh", "127.0.0.1"]);
    run("mosquitto_passwd", &["-b", "-c", "passwords", "lane-1", "first"]);
    run("mosquitto_passwd", &["-b", "passwords", "database", "second"]);
    std::fs::copy(shipped.join("acl"), folder.join("acl")).expect("room");
    let text = std::fs::read_to_string(shipped.join("mosquitto.conf")).expect("shipped");
    let text = text.replace("/etc/mosquitto", folder.to_str().expect("text"));
    // The listener and where it keeps what it has are the test's.
    let ours = |line: &&str| !line.starts_with("listener") && !line.starts_with("persistence");
    let text: Vec<&str> = text.lines().filter(ours).collect();
    Broker::start_with(folder, &(text.join("\n") + "\n"))
}

#[test]
fn the_shipped_broker_lets_every_machine_tell_of_itself_only_and_every_machine_knows_its_broker() {
    let folder = folder("fleet-secured");
    let broker = secured(&folder);
    let file = |name: &str| folder.join(name).to_str().expect("text").to_owned();
    let ca = file("ca.crt");
    let tls = ["--cafile", &ca, "-u", "database", "-P", "second"];
    let subscriber = Subscriber::start(broker.address, "database", &tls);
    std::fs::write(folder.join("login"), "lane-1\nfirst\n").expect("room");
    std::fs::write(folder.join("wrong"), "lane-1\nsecond\n").expect("room");
    let trusted = |lane: &str| Settings {
        login_file: Some(folder.join("login")),
        ca_file: Some(folder.join("ca.crt")),
        ..settings(broker.address, lane)
    };
    let other_ca = {
        let other = hil::fleet::folder("fleet-other-ca");
        drop(secured(&other));
        other.join("ca.crt")
    };
    // Told by the lane's name and the parcel's number.
    let start = |lane: &str, settings: Settings| {
        let mut lane = Simulated::start(&folder.join(lane), settings);
        lane.parcel();
        lane
    };
    let refused = [
        ("another-lane", trusted("lane-2")),
        ("no-tls", Settings { ca_file: None, ..trusted("lane-1") }),
        (
            "wrong-password",
            Settings { login_file: Some(folder.join("wrong")), ..trusted("lane-1") },
        ),
        ("no-login", Settings { login_file: None, ..trusted("lane-1") }),
        ("wrong-ca", Settings { ca_file: Some(other_ca), ..trusted("lane-1") }),
        ("wrong-name", Settings { tls_name: Some("b.example.com".into()), ..trusted("lane-1") }),
    ];
    let refused: Vec<_> = refused.into_iter().map(|(name, s)| (name, start(name, s))).collect();
    // They are refused at once, and again.
    std::thread::sleep(Duration::from_secs(3));
    assert!(subscriber.received().is_empty(), "{:?}", subscriber.received());
    for (name, lane) in refused {
        lane.finish();
        assert!(!folder.join(name).join("fleet.cursor").exists(), "{name}: its cursor has moved");
    }
    let lane = start("trusted", trusted("lane-1"));
    let parcel = subscriber.wait("a parcel over TLS", |m| m.what == "parcel");
    assert_eq!((parcel.lane.as_str(), seq(&parcel)), ("lane-1", 1));
    // The database may ask for it again; the machine of another lane may not.
    let topic = format!("beltgauge/{SITE}/lane-1/cmd/replay");
    let command = "{\"from\":1,\"to\":1}";
    assert!(!publish(
        broker.address,
        &topic,
        command,
        &["--cafile", &ca, "-u", "lane-1", "-P", "first"]
    ));
    assert!(publish(broker.address, &topic, command, &tls));
    subscriber.wait("the end of the replay", |m| m.payload["kind"] == "replayed");
    assert_eq!(subscriber.received().iter().filter(|m| is_replay(m)).count(), 1);
    lane.finish();
    // What was refused was not lost.
    let kept = Simulated::start(&folder.join("another-lane"), trusted("lane-1"));
    let is_its =
        |m: &Received| m.what == "parcel" && m.payload["serial"] != parcel.payload["serial"];
    assert_eq!(seq(&subscriber.wait("what was refused before", is_its)), 1);
    kept.finish();
}

/// A PostgreSQL of its own, in a folder that its user may enter.
struct Database(PathBuf);

impl Database {
    fn start() -> Self {
        let folder = std::env::temp_dir().join(format!("beltgauge-sql-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("room");
        let database = Self(folder);
        let path = database.0.to_str().expect("text");
        let script = format!(
            "chown postgres {path} && bin=$(ls -d /usr/lib/postgresql/*/bin) && cd {path} && \
             runuser -u postgres -- $bin/initdb -D {path}/data -A trust >/dev/null && \
             runuser -u postgres -- $bin/pg_ctl -w -D {path}/data -l {path}/log \
             -o \"-k {path} -c listen_addresses=''\" start >/dev/null"
        );
        run(Command::new("bash").args(["-c", &script]));
        database
    }

    fn client(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("PGHOST", &self.0).env("PGUSER", "postgres").env("PGDATABASE", "postgres");
        command
    }

    /// The only value of the only row.
    fn ask(&self, sql: &str) -> String {
        run(self.client("psql").args(["-v", "ON_ERROR_STOP=1", "-qtA", "-c", sql]))
    }
}

impl Drop for Database {
    fn drop(&mut self) {
        let path = self.0.display();
        let script = format!(
            "bin=$(ls -d /usr/lib/postgresql/*/bin); runuser -u postgres -- $bin/pg_ctl -w -m immediate \
             -D {path}/data stop; rm -rf {path}"
        );
        let _ = Command::new("bash").args(["-c", &script]).current_dir("/").output();
    }
}

/// What it prints.
fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// The shipped bridge; ended with all that it has started.
struct Bridge(Child);

impl Bridge {
    fn start(database: &Database, broker: &Broker) -> Self {
        let script = hil::project().join("config/fleet/bridge.sh");
        let mut command = database.client("bash");
        command.arg(script).args(["127.0.0.1", "-p", &broker.address.port().to_string()]);
        Self(
            std::os::unix::process::CommandExt::process_group(&mut command, 0)
                .spawn()
                .expect("bash"),
        )
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        let group = rustix::process::Pid::from_child(&self.0);
        let _ = rustix::process::kill_process_group(group, Signal::KILL);
        let _ = self.0.wait();
    }
}

#[test]
fn the_shipped_database_has_every_parcel_once_and_knows_what_is_missing() {
    const PARCELS: u32 = 200;
    let folder = folder("fleet-sql");
    let (broker, database) = (Broker::start(&folder), Database::start());
    let sql = hil::project().join("config/fleet/timescaledb.sql");
    // Twice: it may be run again.
    for _ in 0..2 {
        run(database.client("psql").args(["-v", "ON_ERROR_STOP=1", "-q", "-f"]).arg(&sql));
    }
    // What is told before the bridge has subscribed is no gap that it could know: a message that the broker
    // keeps is there when it has.
    let kept = format!(r#"{{"schema":1,"site":"{SITE}","lane":"kept","state":"offline"}}"#);
    assert!(publish(broker.address, &format!("beltgauge/{SITE}/kept/state"), &kept, &["-r"]));
    let mut bridge = Bridge::start(&database, &broker);
    let state =
        |lane| database.ask(&format!("SELECT state FROM beltgauge.state WHERE lane = '{lane}'"));
    hil::wait_for("the bridge", || (state("kept") == "offline").then_some(()));
    let lane = Lane::start(&broker, &folder.join("lane"), PARCELS);
    let count =
        || database.ask("SELECT count(*) FROM beltgauge.parcel").parse::<u32>().expect("a number");
    // Killed on the way, and what it had in hand with it.
    hil::wait_for("some parcels", || (count() >= PARCELS / 4).then_some(()));
    drop(bridge);
    std::thread::sleep(Duration::from_secs(1));
    bridge = Bridge::start(&database, &broker);
    let last = format!("SELECT count(*) FROM beltgauge.parcel WHERE seq = {PARCELS}");
    hil::wait_for("the last parcel", || (database.ask(&last) == "1").then_some(()));
    // As if the broker had lost some.
    database.ask("DELETE FROM beltgauge.parcel WHERE seq BETWEEN 31 AND 44 OR seq = 70");
    let topic = format!("beltgauge/{SITE}/lane-1/cmd/replay");
    let missing = "SELECT coalesce(string_agg(format('{\"from\":%s,\"to\":%s}', \"from\", \"to\"), ' ' ORDER BY \
                   \"from\"), '') FROM beltgauge.missing";
    let gaps = database.ask(missing);
    assert!(gaps.contains("{\"from\":70,\"to\":70}"), "{gaps}");
    for gap in gaps.split(' ') {
        assert!(publish(broker.address, &topic, gap, &[]));
    }
    hil::wait_for("all parcels", || (count() == PARCELS).then_some(()));
    assert_eq!(database.ask(missing), "");
    // Again: nothing is there twice.
    assert!(publish(broker.address, &topic, "{\"from\":1,\"to\":200}", &[]));
    let replays = "SELECT count(*) FROM beltgauge.event WHERE kind = 'replayed' AND code = 200";
    hil::wait_for("the end of the replay", || (database.ask(replays) == "1").then_some(()));
    assert_eq!(count(), PARCELS);
    let sizes =
        "SELECT count(*) FROM beltgauge.parcel WHERE length_mm = 100 + seq % 997 AND width_mm = 50";
    assert_eq!(database.ask(sizes), PARCELS.to_string());
    // What is broken is told, and nothing stops behind it.
    for (what, payload) in
        [("parcel", "nonsense"), ("event", "{\"schema\":1}"), ("health", "{\"schema\":2}")]
    {
        assert!(publish(broker.address, &format!("beltgauge/{SITE}/x/{what}"), payload, &[]));
    }
    hil::wait_for("the refused", || {
        (database.ask("SELECT count(*) FROM beltgauge.refused") == "3").then_some(())
    });
    assert_eq!(state("lane-1"), "online");
    drop(lane);
    hil::wait_for("the will", || (state("lane-1") == "offline").then_some(()));
    assert!(
        database.ask("SELECT count(*) FROM beltgauge.health").parse::<u32>().expect("a number") > 0
    );
    drop(bridge);
}
