//! The fleet's thread: connects, tells, keeps account of what was acknowledged, listens to one command.

use super::client::{Account, Acknowledgment, Connection, IN_FLIGHT_MAX, Told};
use super::command;
use super::cursor::{Cursor, Kept};
use super::feed::{self, Feed, Filled, Message, Ongoing, Origin, Sender};
use super::payload::Identity;
use super::tls::Way;
use super::topics::Topics;
use super::{Machine, client};
use crate::config::Fleet as Settings;
use crate::error::{Error, Result};
use crate::event::clock::utc_ms;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::{JoinHandle, spawn_blocking};

/// The end, and what is due, is looked for this often.
const TICK: Duration = Duration::from_millis(100);
/// New entries are looked for this often.
const LOOK: Duration = Duration::from_millis(500);
/// The cursor is kept at most this often.
const KEEP: Duration = Duration::from_secs(1);
/// The machine's condition is told this often.
const HEALTH: Duration = Duration::from_secs(10);
/// A broker that is not there is tried again after this, then after twice as long, at most so long.
const RETRY_MIN: Duration = Duration::from_secs(1);
const RETRY_MAX: Duration = Duration::from_secs(30);
/// A disk that fails is tried again after this.
const DISK_RETRY: Duration = Duration::from_secs(5);
/// The broker acknowledges the last messages within this, or not at all; the cursor is kept within it.
const FAREWELL: Duration = Duration::from_millis(500);
/// Replays that wait.
const REPLAYS_MAX: usize = 8;
/// A refused command is told at most this often.
const REFUSAL: Duration = Duration::from_secs(10);
/// Threads that wait for the disk: one reads, one keeps the cursor.
const DISK_THREADS: usize = 2;
/// Stack of each: locked memory counts all of it.
const STACK_BYTES: usize = 512 * 1024;

/// Tell the fleet until it is over. A broker, network or disk that fails is told once and tried again.
///
/// # Errors
/// When the thread cannot have what it needs from the system.
pub fn serve(
    settings: &Settings,
    archive: &Path,
    machine: &Arc<dyn Machine>,
    over: &(dyn Fn() -> bool + Sync),
) -> Result<()> {
    let failed = |e: std::io::Error| Error::failure(format!("the fleet's thread failed: {e}"));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(DISK_THREADS)
        .thread_stack_size(STACK_BYTES)
        .thread_name("fleet disk")
        .build()
        .map_err(failed)?;
    runtime.block_on(async {
        if let Some(mut outbox) = started(settings, archive, machine, over).await {
            outbox.run(over).await;
        }
    });
    // A disk that hangs is left behind.
    runtime.shutdown_background();
    Ok(())
}

/// Once it is known who this is; none: it was over before.
async fn started(
    settings: &Settings,
    archive: &Path,
    machine: &Arc<dyn Machine>,
    over: &(dyn Fn() -> bool + Sync),
) -> Option<Outbox> {
    let mut complaints = Complaints::default();
    loop {
        if let Some(boots) = machine.boots() {
            let (settings, archive) = (settings.clone(), archive.to_owned());
            let reads = spawn_blocking(move || Start::read(&settings, &archive));
            match finished(reads, over).await? {
                Ok(start) => return Some(Outbox::new(start, boots, Arc::clone(machine))),
                Err(e) => complaints.tell(&e.to_string()),
            }
            pause(DISK_RETRY, over).await?;
        }
        pause(TICK, over).await?;
    }
}

/// What a job for the disk comes to; none: it is over before.
async fn finished<T>(mut job: JoinHandle<T>, over: &(dyn Fn() -> bool + Sync)) -> Option<T> {
    loop {
        tokio::select! {
            done = &mut job => return done.ok(),
            () = tokio::time::sleep(TICK) => if over() { return None },
        }
    }
}

/// Wait; none: it is over.
async fn pause(time: Duration, over: &(dyn Fn() -> bool + Sync)) -> Option<()> {
    let start = Instant::now();
    while !over() {
        let rest = time.saturating_sub(start.elapsed());
        if rest.is_zero() {
            return Some(());
        }
        tokio::time::sleep(rest.min(TICK)).await;
    }
    None
}

/// Says what is wrong once, and again when it is something else.
#[derive(Default)]
struct Complaints(Option<String>);

impl Complaints {
    fn tell(&mut self, what: &str) {
        if self.0.as_deref() != Some(what) {
            tracing::warn!("fleet: {what}; trying again");
            self.0 = Some(what.to_owned());
        }
    }
}

/// What is read from files before all.
struct Start {
    account: Account,
    sender: (String, String, String),
    kept: Kept,
    cursor: Cursor,
}

impl Start {
    fn read(settings: &Settings, archive: &Path) -> Result<Self> {
        let kept = Kept::new(archive);
        let serial = kept.serial()?;
        let [site, lane] = [&settings.site, &settings.lane].map(|n| n.clone().unwrap_or_default());
        let broker =
            settings.broker.ok_or_else(|| Error::configuration("fleet.broker is not set"))?;
        let account = Account {
            way: Way::new(settings, broker)?,
            client_id: format!("beltgauge-{serial}"),
            login: settings.login_file.as_deref().map(client::login).transpose()?,
            will: (String::new(), String::new()),
        };
        let cursor = kept.cursor();
        Ok(Self { account, sender: (site, lane, serial), kept, cursor })
    }
}

/// Refused commands, not told more often than is good.
#[derive(Default)]
struct Refusals {
    told: Option<Instant>,
    held: u32,
}

impl Refusals {
    /// Whether this one is to be told; with how many were not since the last one.
    fn admits(&mut self, now: Instant) -> Option<u32> {
        if self.told.is_some_and(|at| now - at < REFUSAL) {
            self.held = self.held.saturating_add(1);
            return None;
        }
        self.told = Some(now);
        Some(std::mem::take(&mut self.held))
    }
}

/// How a connection has ended.
enum End {
    /// All is over.
    Over,
    /// Why; whether the broker had acknowledged anything.
    Broken(String, bool),
}

struct Outbox {
    sender: Sender,
    account: Account,
    machine: Arc<dyn Machine>,
    kept: Kept,
    cursor: Cursor,
    /// It was seen to be of this archive.
    is_checked: bool,
    /// The cursor that is on the disk.
    on_disk: Cursor,
    keeping: Option<(Cursor, JoinHandle<std::io::Result<()>>)>,
    kept_at: Instant,
    replays: VecDeque<Ongoing>,
    refusals: Refusals,
    complaints: Complaints,
    disk_complaints: Complaints,
    connects: u64,
    acknowledged: u64,
}

/// Where messages come from, unless that could not be read, and those that there were.
type Read = (Option<Feed>, std::result::Result<Filled, String>);

/// What belongs to one connection.
struct Visit {
    connection: Connection,
    in_flight: VecDeque<(Origin, Acknowledgment)>,
    /// Here, or away to read.
    feed: Option<Feed>,
    reading: Option<JoinHandle<Read>>,
    look_at: Instant,
    health_at: Instant,
    asked: Vec<Ongoing>,
    is_acknowledged: bool,
}

impl Outbox {
    fn new(start: Start, boots: u16, machine: Arc<dyn Machine>) -> Self {
        let Start { mut account, sender: (site, lane, serial), kept, cursor } = start;
        let topics = Topics::new(&site, &lane);
        let identity = Identity::new(&site, &lane, serial, boots);
        account.will = (topics.state(), identity.state("offline", None));
        Self {
            sender: Sender { identity, topics },
            account,
            machine,
            kept,
            cursor,
            is_checked: false,
            on_disk: cursor,
            keeping: None,
            kept_at: Instant::now(),
            replays: VecDeque::new(),
            refusals: Refusals::default(),
            complaints: Complaints::default(),
            disk_complaints: Complaints::default(),
            connects: 0,
            acknowledged: 0,
        }
    }

    async fn run(&mut self, over: &(dyn Fn() -> bool + Sync)) {
        let mut retry = RETRY_MIN;
        loop {
            match self.visit(over).await {
                End::Over => break,
                End::Broken(why, was_heard) => {
                    self.complaints.tell(&format!("broker {}: {why}", self.account.way.broker()));
                    retry = if was_heard { RETRY_MIN } else { retry };
                }
            }
            self.keep(KEEP).await;
            if pause(retry, over).await.is_none() {
                break;
            }
            retry = (2 * retry).min(RETRY_MAX);
        }
        let _ = tokio::time::timeout(FAREWELL, async {
            self.keep(Duration::ZERO).await;
            if let Some((_, job)) = self.keeping.take() {
                let _ = job.await;
            }
        })
        .await;
    }

    /// One connection, to its end.
    async fn visit(&mut self, over: &(dyn Fn() -> bool + Sync)) -> End {
        let mut connection = Connection::open(&self.account);
        loop {
            tokio::select! {
                told = connection.next() => match told {
                    Told::Connected => break,
                    Told::Message(_) => {}
                    Told::Ended(why) => return End::Broken(why, false),
                },
                () = tokio::time::sleep(TICK) => if over() { return End::Over },
            }
        }
        let now = Instant::now();
        let mut visit = Visit {
            connection,
            in_flight: VecDeque::new(),
            feed: None,
            reading: None,
            look_at: now,
            health_at: now,
            asked: Vec::new(),
            is_acknowledged: false,
        };
        match self.attend(&mut visit, over).await {
            Ok(()) => {
                self.leave(visit).await;
                End::Over
            }
            Err(why) => End::Broken(why, visit.is_acknowledged),
        }
    }

    /// Tell until it is over, or the connection breaks.
    async fn attend(
        &mut self,
        visit: &mut Visit,
        over: &(dyn Fn() -> bool + Sync),
    ) -> std::result::Result<(), String> {
        self.connects += 1;
        visit.connection.subscribe(&self.sender.topics.replay())?;
        let birth = self.sender.identity.state("online", Some(utc_ms()));
        let birth = visit.connection.tell(&self.sender.topics.state(), birth, true)?;
        visit.in_flight.push_back((Origin::Own, birth));
        let mut tick = tokio::time::interval(TICK);
        loop {
            tokio::select! {
                told = visit.connection.next() => match told {
                    Told::Connected => {}
                    Told::Message(payload) => self.command(visit, &payload),
                    Told::Ended(why) => return Err(why),
                },
                acknowledged = first(&mut visit.in_flight) => {
                    acknowledged?;
                    if let Some((origin, _)) = visit.in_flight.pop_front() {
                        self.acknowledge(visit, origin);
                    }
                }
                read = read(&mut visit.reading) => self.take(visit, read)?,
                _ = tick.tick() => {
                    if over() {
                        return Ok(());
                    }
                    self.mention_health(visit)?;
                    self.keep(KEEP).await;
                }
            }
            self.look(visit);
        }
    }

    fn acknowledge(&mut self, visit: &mut Visit, origin: Origin) {
        if !visit.is_acknowledged {
            visit.is_acknowledged = true;
            self.complaints = Complaints::default();
            tracing::info!(broker = %self.account.way.broker(), "the fleet's broker is there");
        }
        match origin {
            Origin::New(cursor) => {
                self.cursor = cursor;
                self.acknowledged += 1;
            }
            Origin::Again(entry) => {
                if let Some(ongoing) = self.replays.front_mut() {
                    (ongoing.entry, ongoing.told) = (entry, ongoing.told + 1);
                }
            }
            Origin::Replayed => drop(self.replays.pop_front()),
            Origin::Own => {}
        }
    }

    /// Look for something to tell, when there is room for it.
    fn look(&mut self, visit: &mut Visit) {
        // Half of the room, so that the broker always has something to do.
        let room = IN_FLIGHT_MAX.saturating_sub(visit.in_flight.len());
        if visit.reading.is_some() || room < IN_FLIGHT_MAX / 2 || Instant::now() < visit.look_at {
            return;
        }
        let asked = std::mem::take(&mut visit.asked);
        let made = visit.feed.take().map(|mut feed| {
            for ongoing in asked {
                feed.replay(ongoing);
            }
            feed
        });
        let (sender, machine) = (self.sender.clone(), Arc::clone(&self.machine));
        let (cursor, is_checked, replays) = (self.cursor, self.is_checked, self.replays.clone());
        let make = move || {
            let cursor = if is_checked { cursor } else { feed::checked(cursor, &*machine)? };
            Ok(Feed::new(sender, machine, cursor, &replays))
        };
        visit.reading = Some(spawn_blocking(move || match made.map_or_else(make, Ok) {
            Ok(mut feed) => {
                let filled = feed.fill(room);
                (Some(feed), filled)
            }
            Err(e) => (None, Err(e)),
        }));
    }

    /// What was read goes on its way.
    fn take(&mut self, visit: &mut Visit, (feed, filled): Read) -> std::result::Result<(), String> {
        (visit.feed, visit.reading) = (feed, None);
        match filled {
            Ok(Filled { messages, more }) => {
                self.is_checked = true;
                visit.look_at = Instant::now() + if more { Duration::ZERO } else { LOOK };
                self.disk_complaints = Complaints::default();
                for Message { origin, topic, payload } in messages {
                    let acknowledgment = visit.connection.tell(&topic, payload, false)?;
                    visit.in_flight.push_back((origin, acknowledgment));
                }
                Ok(())
            }
            Err(e) => {
                self.disk_complaints.tell(&e);
                visit.look_at = Instant::now() + DISK_RETRY;
                Ok(())
            }
        }
    }

    /// Tell the machine's condition when it is due.
    fn mention_health(&self, visit: &mut Visit) -> std::result::Result<(), String> {
        let now = Instant::now();
        if now < visit.health_at {
            return Ok(());
        }
        visit.health_at = now + HEALTH;
        let figures = self.machine.figures();
        let health = self.sender.identity.health(&figures, self.connects, self.acknowledged);
        visit.connection.mention(&self.sender.topics.health(), health)
    }

    fn command(&mut self, visit: &mut Visit, payload: &[u8]) {
        let parsed = command::parse(payload).and_then(|replay| {
            let why = || format!("{REPLAYS_MAX} replays wait already; ask again when one is over");
            (self.replays.len() < REPLAYS_MAX).then_some(replay).ok_or_else(why)
        });
        match parsed {
            Ok(asked) => {
                tracing::info!(from = asked.from, to = asked.to, "parcels are told again");
                let ongoing = Ongoing { asked, entry: 0, told: 0 };
                self.replays.push_back(ongoing);
                if visit.feed.is_some() || visit.reading.is_some() {
                    visit.asked.push(ongoing);
                }
                visit.look_at = Instant::now();
            }
            Err(why) => {
                let Some(held) = self.refusals.admits(Instant::now()) else { return };
                tracing::warn!(
                    "fleet: a command is refused: {why}; {held} more since the last line"
                );
                let event = self.sender.identity.own_event(("command_refused", held, &why));
                // One that finds no room is lost: it was no command.
                if let Ok(told) = visit.connection.tell(&self.sender.topics.event(), event, false) {
                    visit.in_flight.push_back((Origin::Own, told));
                }
            }
        }
    }

    /// Keep the cursor, if it has moved and was not kept for so long.
    async fn keep(&mut self, period: Duration) {
        if let Some((cursor, job)) = self.keeping.take_if(|(_, job)| job.is_finished()) {
            match job.await {
                Ok(Ok(())) => self.on_disk = cursor,
                Ok(Err(e)) => self.disk_complaints.tell(&format!("its cursor cannot be kept: {e}")),
                Err(_) => {}
            }
        }
        let is_due = self.cursor != self.on_disk && self.kept_at.elapsed() >= period;
        if is_due && self.keeping.is_none() {
            self.kept_at = Instant::now();
            let (kept, cursor) = (self.kept.clone(), self.cursor);
            self.keeping = Some((cursor, spawn_blocking(move || kept.keep(cursor))));
        }
    }

    /// Take leave: the will is for those who cannot.
    async fn leave(&mut self, mut visit: Visit) {
        let offline = self.sender.identity.state("offline", Some(utc_ms()));
        if let Ok(told) = visit.connection.tell(&self.sender.topics.state(), offline, true) {
            visit.in_flight.push_back((Origin::Own, told));
        }
        let Visit { connection, mut in_flight, .. } = visit;
        let closed = connection.close(FAREWELL);
        let acknowledged = async {
            while first(&mut in_flight).await.is_ok()
                && let Some((origin, _)) = in_flight.pop_front()
            {
                if let Origin::New(cursor) = origin {
                    self.cursor = cursor;
                }
                if in_flight.is_empty() {
                    break;
                }
            }
        };
        let _ =
            tokio::time::timeout(2 * FAREWELL, async { tokio::join!(acknowledged, closed) }).await;
    }
}

/// The acknowledgment that is due first: brokers acknowledge in the order in which they were told.
async fn first(
    in_flight: &mut VecDeque<(Origin, Acknowledgment)>,
) -> std::result::Result<(), String> {
    match in_flight.front_mut() {
        Some((_, acknowledgment)) => acknowledgment.as_mut().await,
        None => std::future::pending().await,
    }
}

/// What was read; never, if nothing is being read.
async fn read(reading: &mut Option<JoinHandle<Read>>) -> Read {
    match reading {
        // A panic there has ended the process.
        Some(job) => job.await.unwrap_or_else(|e| (None, Err(e.to_string()))),
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_told_now_and_then_with_how_many_there_were() {
        let (mut refusals, start) = (Refusals::default(), Instant::now());
        let told = (0..1000).filter(|_| refusals.admits(start).is_some()).count();
        assert_eq!(told, 1);
        assert_eq!(refusals.admits(start + REFUSAL), Some(999));
        assert_eq!(refusals.admits(start + REFUSAL), None);
        assert_eq!(refusals.admits(start + 2 * REFUSAL), Some(1));
    }
}
