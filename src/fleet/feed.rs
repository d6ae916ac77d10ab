//! Turns entries of the archive into messages: new ones first, then those that were asked for again.
//! All of it may wait for the disk.

use super::command::Replay;
use super::cursor::Cursor;
use super::payload::Identity;
use super::topics::Topics;
use super::{Entries, Entry, Machine};
use std::collections::VecDeque;
use std::sync::Arc;

/// Entries that are looked at for a replay before new ones are looked for again.
const LOOK_MAX: usize = 1024;

/// What a message's acknowledgment moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The cursor, to this entry.
    New(Cursor),
    /// The replay, to this entry.
    Again(u64),
    /// The replay is over.
    Replayed,
    /// Nothing.
    Own,
}

/// What is to be told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    pub origin: Origin,
    pub topic: String,
    pub payload: String,
}

/// A replay and how far it has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ongoing {
    pub asked: Replay,
    /// The last entry that was told again, or looked at before all.
    pub entry: u64,
    /// Parcels told again.
    pub told: u32,
}

/// What there was to tell.
#[derive(Debug, Default)]
pub struct Filled {
    pub messages: Vec<Message>,
    /// There may be more at once.
    pub more: bool,
}

/// Who the messages are from.
#[derive(Clone, Debug)]
pub struct Sender {
    pub identity: Identity,
    pub topics: Topics,
}

/// Where messages come from.
pub struct Feed {
    sender: Sender,
    machine: Arc<dyn Machine>,
    new: Box<dyn Entries>,
    /// The last new entry that became a message.
    last: u64,
    replays: VecDeque<(Ongoing, Option<Box<dyn Entries>>)>,
}

/// The cursor, or the beginning when it is that of another archive.
pub fn checked(cursor: Cursor, machine: &dyn Machine) -> Result<Cursor, String> {
    if cursor == Cursor::default() {
        return Ok(cursor);
    }
    let (time, newest) = machine.entry_time(cursor.entry)?;
    // One that is gone because it was old is no reason.
    let is_of_this = time.map_or(newest >= cursor.entry, |time| time == cursor.utc_ms);
    if is_of_this {
        return Ok(cursor);
    }
    tracing::warn!(
        entry = cursor.entry,
        newest,
        "the archive is another one than the fleet was told from: all that is in it is told"
    );
    Ok(Cursor::default())
}

impl Feed {
    /// What comes behind the cursor, and replays.
    pub fn new(
        sender: Sender,
        machine: Arc<dyn Machine>,
        cursor: Cursor,
        replays: &VecDeque<Ongoing>,
    ) -> Self {
        let new = machine.entries_after(cursor.entry);
        let replays = replays.iter().map(|ongoing| (*ongoing, None)).collect();
        Self { sender, machine, new, last: cursor.entry, replays }
    }

    /// Another replay.
    pub fn replay(&mut self, ongoing: Ongoing) {
        self.replays.push_back((ongoing, None));
    }

    /// At most so many messages, and those of the feed's own between them.
    pub fn fill(&mut self, limit: usize) -> Result<Filled, String> {
        let entries = self.new.next(limit)?;
        let mut filled = Filled { messages: Vec::new(), more: entries.len() == limit };
        for entry in &entries {
            if self.last > 0 && entry.number > self.last + 1 {
                filled.messages.push(self.gone(entry));
            }
            self.last = entry.number;
            let origin = Origin::New(Cursor { entry: entry.number, utc_ms: entry.utc_ms });
            filled.messages.push(self.message(entry, origin));
        }
        if filled.more || self.replays.is_empty() {
            return Ok(filled);
        }
        // What was found before the disk failed is told.
        match self.fill_again(limit - entries.len(), &mut filled) {
            Err(e) if filled.messages.is_empty() => Err(e),
            _ => Ok(filled),
        }
    }

    /// Entries that were pushed out of the archive, or damaged, before the broker had acknowledged them.
    fn gone(&self, next: &Entry) -> Message {
        let (from, to) = (self.last + 1, next.number - 1);
        let count = u32::try_from(next.number - from).unwrap_or(u32::MAX);
        let detail = format!("entries {from} to {to} are no longer in the archive: never told");
        self.event(next, "never_told", count, &detail)
    }

    fn event(&self, entry: &Entry, kind: &str, code: u32, detail: &str) -> Message {
        let Sender { identity, topics } = &self.sender;
        let payload = identity.entry_event(entry, (kind, code, detail));
        Message { origin: Origin::Own, topic: topics.event(), payload }
    }

    fn message(&self, entry: &Entry, origin: Origin) -> Message {
        let Sender { identity, topics } = &self.sender;
        match identity.message(topics, entry, false) {
            Ok((topic, payload, _)) => Message { origin, topic, payload },
            // What is behind it goes on.
            Err(e) => Message { origin, ..self.event(entry, "entry_damaged", 0, &e) },
        }
    }

    fn fill_again(&mut self, limit: usize, filled: &mut Filled) -> Result<(), String> {
        let Some((ongoing, entries)) = self.replays.front_mut() else { return Ok(()) };
        let entries = entries.get_or_insert_with(|| self.machine.entries_after(ongoing.entry));
        let Sender { identity, topics } = &self.sender;
        let asked = ongoing.asked;
        let (mut looked, mut told) = (0, 0);
        let is_over = loop {
            if told == limit || looked >= LOOK_MAX {
                break false;
            }
            let found = entries.next(limit - told)?;
            looked += found.len();
            let is_end = found.len() < limit - told;
            for entry in &found {
                // What is damaged was told when it was new.
                let Ok((topic, payload, Some(seq))) = identity.message(topics, entry, true) else {
                    continue;
                };
                if (asked.from..=asked.to).contains(&seq) {
                    let origin = Origin::Again(entry.number);
                    filled.messages.push(Message { origin, topic, payload });
                    told += 1;
                    ongoing.told += 1;
                }
            }
            if is_end {
                break true;
            }
        };
        if is_over {
            let detail = format!("{} to {}: {} parcels", asked.from, asked.to, ongoing.told);
            let payload = identity.own_event(("replayed", ongoing.told, &detail));
            let topic = topics.event();
            filled.messages.push(Message { origin: Origin::Replayed, topic, payload });
            self.replays.pop_front();
        }
        filled.more = !self.replays.is_empty();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::payload::tests::{archived, entry, identity};
    use crate::fleet::{Figures, Kind};
    use std::sync::Mutex;

    /// An archive in memory.
    struct Kept(Arc<Mutex<Vec<Entry>>>);

    struct Read(Arc<Mutex<Vec<Entry>>>, u64);

    impl Entries for Read {
        fn next(&mut self, limit: usize) -> Result<Vec<Entry>, String> {
            let entries = self.0.lock().expect("whole");
            let behind = entries.iter().filter(|e| e.number > self.1).take(limit);
            let found: Vec<Entry> = behind.cloned().collect();
            self.1 = found.last().map_or(self.1, |e| e.number);
            Ok(found)
        }
    }

    impl Machine for Kept {
        fn boots(&self) -> Option<u16> {
            Some(9)
        }
        fn figures(&self) -> Figures {
            Figures::default()
        }
        fn entries_after(&self, number: u64) -> Box<dyn Entries> {
            Box::new(Read(Arc::clone(&self.0), number))
        }
        fn entry_time(&self, number: u64) -> Result<(Option<u64>, u64), String> {
            let entries = self.0.lock().expect("whole");
            let entry = entries.iter().find(|e| e.number == number);
            Ok((entry.map(|e| e.utc_ms), entries.last().map_or(0, |e| e.number)))
        }
    }

    /// Parcels of these numbers, each an entry of the same number.
    fn parcels(seqs: impl Iterator<Item = u32>) -> Vec<Entry> {
        seqs.map(|seq| entry(u64::from(seq), Kind::Parcel, archived(seq, 7))).collect()
    }

    fn feed(entries: Vec<Entry>, cursor: u64) -> (Feed, Arc<Mutex<Vec<Entry>>>) {
        let entries = Arc::new(Mutex::new(entries));
        let sender = Sender { identity: identity(), topics: Topics::new("hall-1", "lane-3") };
        let cursor = Cursor { entry: cursor, utc_ms: 0 };
        let machine = Arc::new(Kept(Arc::clone(&entries)));
        (Feed::new(sender, machine, cursor, &VecDeque::new()), entries)
    }

    /// What moves, and for events what they are.
    fn origins(messages: &[Message]) -> Vec<String> {
        let origin = |message: &Message| match message.origin {
            Origin::New(cursor) => format!("new {}", cursor.entry),
            Origin::Again(entry) => format!("again {entry}"),
            Origin::Replayed | Origin::Own => {
                let event: serde_json::Value =
                    serde_json::from_str(&message.payload).expect("JSON");
                format!("{} {}", event["kind"].as_str().expect("text"), event["code"])
            }
        };
        messages.iter().map(origin).collect()
    }

    #[test]
    fn new_ones_come_in_order_and_before_those_asked_for_again() {
        let (mut feed, entries) = feed(parcels(1..=10), 7);
        feed.replay(Ongoing { asked: Replay { from: 2, to: 3 }, entry: 0, told: 0 });
        let filled = feed.fill(2).expect("read");
        assert_eq!(
            (origins(&filled.messages), filled.more),
            (vec!["new 8".into(), "new 9".into()], true)
        );
        entries.lock().expect("whole").extend(parcels(11..=11));
        let filled = feed.fill(64).expect("read");
        let due = ["new 10", "new 11", "again 2", "again 3", "replayed 2"];
        assert_eq!(
            (origins(&filled.messages), filled.more),
            (due.map(str::to_owned).to_vec(), false)
        );
        let again: serde_json::Value =
            serde_json::from_str(&filled.messages[2].payload).expect("JSON");
        assert_eq!(
            (&again["replay"], &again["id"]),
            (&true.into(), &"0123456789abcdef/7/2".into())
        );
        assert!(feed.fill(64).expect("read").messages.is_empty());
    }

    #[test]
    fn a_long_replay_comes_in_parts_and_goes_on_where_it_was_acknowledged() {
        let (mut feed, _) = feed(parcels(1..=5000), 5000);
        feed.replay(Ongoing { asked: Replay { from: 4000, to: 9999 }, entry: 0, told: 0 });
        let (mut told, mut fills) = (Vec::new(), 0);
        loop {
            let filled = feed.fill(64).expect("read");
            assert!(filled.messages.len() <= 65);
            told.extend(origins(&filled.messages));
            fills += 1;
            if !filled.more {
                break;
            }
        }
        let due = (4000..=5000).map(|i| format!("again {i}")).chain(["replayed 1001".to_owned()]);
        assert!(told.into_iter().eq(due) && fills > 1001 / 64);
        feed.replay(Ongoing { asked: Replay { from: 4000, to: 9999 }, entry: 4998, told: 999 });
        let due = ["again 4999", "again 5000", "replayed 1001"];
        assert_eq!(origins(&feed.fill(64).expect("read").messages), due);
    }

    #[test]
    fn what_is_damaged_or_gone_is_told_and_nothing_stops_behind_it() {
        let mut entries = parcels(20..=23);
        entries[1].text.truncate(20);
        let (mut feed, _) = feed(entries, 7);
        let due = ["never_told 12", "new 20", "new 21", "new 22", "new 23"];
        let messages = feed.fill(64).expect("read").messages;
        assert_eq!(origins(&messages), due);
        assert!(
            messages[2].topic.ends_with("/event") && messages[2].payload.contains("entry_damaged")
        );
        assert!(messages[0].payload.contains("entries 8 to 19"));
    }

    #[test]
    fn the_cursor_of_another_archive_is_not_used() {
        let machine = Kept(Arc::new(Mutex::new(parcels(20..=23))));
        let of = |entry, utc_ms| checked(Cursor { entry, utc_ms }, &machine).expect("read").entry;
        let time = machine.entry_time(21).expect("read").0.expect("there");
        assert_eq!(of(21, time), 21);
        assert_eq!(of(21, time + 1), 0, "another entry has its number");
        assert_eq!(of(5, 5), 5, "it is gone because it was old");
        assert_eq!(of(24, 5), 0, "it was never there");
    }
}
