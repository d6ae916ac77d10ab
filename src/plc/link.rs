//! What a PLC sees and does, by whatever wire: parcels in the order and rounding it asked for, a
//! queue that it acknowledges, a watched heartbeat, commands with their outcome.
//!
//! In: records and status from vision; register writes and CAN commands from the PLC. Out: the
//! register image; records to be sent over CAN; requests to vision. Owns: sequence numbers.

use super::command::{Outcome, Request};
use super::journal::Journal;
use super::present::presented;
use super::registers::{
    COMMAND, COMMAND_COUNT, COMMAND_FIELDS, CanStatus, CommandBlock, RING_PARCELS, RegisterImage,
    Status, VisionStatus,
};
use super::table::join;
use crate::config::{Plc as Settings, WordOrder};
use crate::event::ParcelRecord;
use heapless::Deque;
use std::time::{Duration, Instant};

/// Parcels that wait for the belt to carry them to where they are published.
const WAITING_MAX: usize = 64;
/// Parcels that wait to be acknowledged, or to be sent.
pub const QUEUE_PARCELS: usize = RING_PARCELS as usize;
/// Parcels that are sent over CAN again after a restart or a disturbance. With CAN FD, where a parcel
/// is a frame, so many may have been in the kernel's queue of ten and the controller.
pub(super) const REPEATED: usize = 12;
/// Encoder counts between two frames.
const COUNTS_MAX: usize = 64;
/// Commands between two visits of the vision thread.
const REQUESTS_MAX: usize = 8;
/// Without a frame for this long the heartbeat stops.
const SILENCE: Duration = Duration::from_secs(1);
/// Largest scale interval that a command may set, tenths of a mm.
const SCALE_INTERVAL_MAX: u32 = 500;

/// Why a register write was refused; it then has changed nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Outside of the command block, or half of a value.
    Address,
    /// A value that cannot be.
    Value,
}

/// The state between vision and PLC.
pub struct Link {
    settings: Settings,
    order: WordOrder,
    image: RegisterImage,
    status: Status,
    block: CommandBlock,
    journal: Journal,
    waiting: Deque<(ParcelRecord, f64), WAITING_MAX>,
    /// Numbered, and on their way to the disk: with what the journal must have saved.
    numbered: Deque<(ParcelRecord, u64), WAITING_MAX>,
    queue: Deque<ParcelRecord, QUEUE_PARCELS>,
    /// There is a CAN bus.
    sends: bool,
    to_send: Deque<ParcelRecord, QUEUE_PARCELS>,
    /// Parcels that found `to_send` full.
    unsent: u64,
    counts: Deque<(u32, Instant), COUNTS_MAX>,
    requests: Deque<Request, REQUESTS_MAX>,
    plc_alive: Instant,
    encoder_alive: Option<Instant>,
    beats: Beats,
}

/// Rises ten times a second while frames arrive.
struct Beats {
    start: Instant,
    frames: u64,
    last_frame: Instant,
}

impl Link {
    /// What was known at the last start is taken up again from the journal. `sends`: parcels are
    /// kept for [`Link::next_to_send`].
    pub fn new(
        settings: Settings,
        order: WordOrder,
        sends: bool,
        journal: Journal,
        now: Instant,
    ) -> Self {
        let status = Status {
            scale_interval_mm: settings.scale_interval_mm,
            boots: journal.boots(),
            sequence: journal.sequence(),
            outcome: Outcome::None as u16,
            ..Status::default()
        };
        let mut link = Self {
            settings,
            order,
            image: RegisterImage::new(order),
            status,
            block: CommandBlock::default(),
            journal,
            waiting: Deque::new(),
            numbered: Deque::new(),
            queue: Deque::new(),
            sends,
            to_send: Deque::new(),
            unsent: 0,
            counts: Deque::new(),
            requests: Deque::new(),
            plc_alive: now,
            encoder_alive: None,
            beats: Beats { start: now, frames: 0, last_frame: now },
        };
        let (acknowledged, sent) = (link.journal.acknowledged(), link.journal.sent());
        // The last that were sent may have got no further than the kernel.
        let repeated_from = sent.wrapping_sub(REPEATED as u32);
        // The journal keeps no more than either has room for.
        for record in link.journal.records().to_vec() {
            link.image.publish(&record);
            if sends && is_after(record.seq, repeated_from) {
                let _ = link.to_send.push_back(record); // invariant: there is room
            }
            if link.settings.queue && is_after(record.seq, acknowledged) {
                let _ = link.queue.push_back(record); // invariant: there is room
            }
        }
        link.show();
        link
    }

    /// A parcel has left the zone, the belt being at `travel_mm`.
    pub fn record(&mut self, record: ParcelRecord, travel_mm: f64) {
        // At once, or when the belt is known to be there.
        let due_mm = match self.settings.publish_after_mm {
            0.0 => f64::NEG_INFINITY,
            after_mm => travel_mm + after_mm,
        };
        if self.waiting.is_full() {
            // Better early than never.
            self.number_first();
        }
        let _ = self.waiting.push_back((record, due_mm)); // invariant: there is room
    }

    /// Renew the status, publish what is due.
    pub fn update(
        &mut self,
        vision: &VisionStatus,
        can: &CanStatus,
        encoder_timeout: Option<Duration>,
        now: Instant,
    ) {
        while self.waiting.front().is_some_and(|(_, due_mm)| vision.belt_travel_mm >= *due_mm) {
            self.number_first();
        }
        self.publish_saved();
        let status = &mut self.status;
        (status.vision, status.can) = (*vision, *can);
        status.can.parcels_dropped += self.unsent;
        let beats = &mut self.beats;
        if vision.counters.frames != beats.frames {
            (beats.frames, beats.last_frame) = (vision.counters.frames, now);
        }
        status.running =
            beats.frames > 0 && now - beats.last_frame < SILENCE && !vision.source_ended;
        if status.running {
            status.heartbeat = ((now - beats.start).as_millis() / 100) as u16;
        }
        let timeout_s = self.settings.heartbeat_timeout_s;
        status.plc_silent = timeout_s > 0.0 && (now - self.plc_alive).as_secs_f64() > timeout_s;
        status.encoder_silent = encoder_timeout
            .is_some_and(|timeout| self.encoder_alive.is_none_or(|at| now - at > timeout));
        self.show();
    }

    /// All that is left, whatever the belt does: the input has ended.
    pub fn flush(&mut self) {
        while !self.waiting.is_empty() {
            self.number_first();
        }
        self.publish_saved();
        self.show();
    }

    /// Whether nothing waits to be published or sent.
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.numbered.is_empty() && self.to_send.is_empty()
    }

    /// The next parcel gets its sequence number, which the journal notes before anybody sees it: it is
    /// never given to another.
    fn number_first(&mut self) {
        let Some((record, _)) = self.waiting.pop_front() else { return };
        let mut record = presented(record, &self.settings);
        let last = self.numbered.back().map_or(self.status.sequence, |(last, _)| last.seq);
        // 0 is no parcel.
        record.seq = last.wrapping_add(1).max(1);
        if let Err((record, _)) = self.numbered.push_back((record, self.journal.note(&record))) {
            // The disk has not answered for so many parcels: the belt does not wait for it.
            if let Some((first, _)) = self.numbered.pop_front() {
                self.publish(first);
            }
            let noted = self.journal.saved();
            let _ = self.numbered.push_back((record, noted)); // invariant: there is room
        }
        self.journal.save();
    }

    fn publish_saved(&mut self) {
        let saved = self.journal.saved();
        while self.numbered.front().is_some_and(|(_, noted)| *noted <= saved) {
            if let Some((record, _)) = self.numbered.pop_front() {
                self.publish(record);
            }
        }
    }

    fn publish(&mut self, record: ParcelRecord) {
        self.status.sequence = record.seq;
        self.image.publish(&record);
        if self.settings.queue {
            if self.queue.is_full() {
                self.queue.pop_front();
                self.status.queue_overflows += 1;
            }
            let _ = self.queue.push_back(record); // invariant: there is room
        } else {
            // A queue that is turned on later begins with what comes then.
            self.journal.acknowledge(record.seq);
        }
        if self.sends {
            if self.to_send.is_full() {
                self.to_send.pop_front();
                self.unsent += 1;
            }
            let _ = self.to_send.push_back(record); // invariant: there is room
        }
    }

    fn show(&mut self) {
        self.status.queued = self.queue.len() as u16;
        self.image.set_queue_head(self.queue.front());
        self.image.set_command(&self.block);
        self.image.set_status(&self.status);
        self.journal.save();
    }

    /// `count` registers from `address`; `None` when any of them does not exist.
    pub fn read(&self, address: u16, count: u16) -> Option<&[u16]> {
        self.image.read(address, count)
    }

    /// Bits as discrete inputs and coils: 16 of status, 16 of faults.
    pub fn bits(&self, address: u16, count: u16) -> Option<impl Iterator<Item = bool>> {
        let all = u32::from(self.status.status_bits()) | u32::from(self.status.fault_bits()) << 16;
        let end = u32::from(address) + u32::from(count);
        (end <= 32).then(|| (u32::from(address)..end).map(move |bit| all >> bit & 1 == 1))
    }

    /// What the status block shows.
    pub fn status(&self) -> &Status {
        &self.status
    }

    /// Write registers, all or none of them.
    pub fn write(&mut self, address: u16, values: &[u16], now: Instant) -> Result<(), Refusal> {
        let first = address.checked_sub(COMMAND).ok_or(Refusal::Address)?;
        let end = usize::from(first) + values.len();
        if values.is_empty() || end > usize::from(COMMAND_COUNT) {
            return Err(Refusal::Address);
        }
        let mut registers = [0; COMMAND_COUNT as usize];
        for field in COMMAND_FIELDS {
            let (start, size) = (usize::from(field.offset), usize::from(field.kind.registers()));
            let written = (start..start + size).filter(|i| (usize::from(first)..end).contains(i));
            if ![0, size].contains(&written.count()) {
                return Err(Refusal::Address); // half of a value
            }
            field.write(&self.block, self.order, &mut registers);
        }
        registers[usize::from(first)..end].copy_from_slice(values);
        let written = |offset: u16| (usize::from(first)..end).contains(&usize::from(offset));
        let pair = |at: usize| join([registers[at], registers[at + 1]], self.order);
        let block = CommandBlock {
            heartbeat: registers[0],
            acknowledge: registers[1],
            encoder_count: pair(2),
            ticket: registers[4],
            command: registers[5],
            argument: pair(6),
        };
        // A PLC that writes the whole block all the time may hold a number from before a restart: its
        // heartbeat and its counts are welcome all the same.
        if values.len() == 1 && written(1) && self.acknowledged_by(block.acknowledge).is_none() {
            return Err(Refusal::Value);
        }
        if written(0) {
            self.heartbeat(block.heartbeat, now);
        }
        if written(1) {
            self.acknowledge(block.acknowledge);
        }
        if written(2) {
            self.count(block.encoder_count, now);
        }
        self.block = block;
        if written(4) {
            self.command(block.ticket, block.command, block.argument);
        }
        self.show();
        Ok(())
    }

    /// The PLC is alive, if the value has changed.
    pub fn heartbeat(&mut self, value: u16, now: Instant) {
        if value != self.block.heartbeat {
            (self.block.heartbeat, self.plc_alive) = (value, now);
        }
    }

    /// A count of the encoder. One too many between two frames takes the place of the oldest.
    pub fn count(&mut self, count: u32, now: Instant) {
        if self.counts.is_full() {
            self.counts.pop_front();
        }
        let _ = self.counts.push_back((count, now)); // invariant: there is room
        (self.block.encoder_count, self.encoder_alive) = (count, Some(now));
    }

    /// Carry out a command, once for each ticket.
    pub fn command(&mut self, ticket: u16, command: u16, argument: u32) {
        if ticket == 0 || ticket == self.status.ticket {
            return;
        }
        let outcome = match command {
            1 => match self.acknowledged_by(argument as u16) {
                Some(_) => {
                    self.acknowledge(argument as u16);
                    Outcome::Done
                }
                None => Outcome::Argument,
            },
            2 => self.request(Request::Learn),
            3 => self.request(Request::Report(true)),
            4 => self.request(Request::Report(false)),
            5 if (1..=SCALE_INTERVAL_MAX).contains(&argument) => {
                self.settings.scale_interval_mm = f64::from(argument) / 10.0;
                self.status.scale_interval_mm = self.settings.scale_interval_mm;
                Outcome::Done
            }
            5 => Outcome::Argument,
            _ => Outcome::Unknown,
        };
        (self.status.ticket, self.status.outcome) = (ticket, outcome as u16);
    }

    fn request(&mut self, request: Request) -> Outcome {
        if self.requests.push_back(request).is_err() {
            return Outcome::Busy;
        }
        if let Request::Report(reporting) = request {
            self.status.stopped = !reporting;
        }
        Outcome::Done
    }

    /// How many of the queue an acknowledgment takes; `None` when it is of a parcel that was
    /// never published.
    fn acknowledged_by(&self, low_word: u16) -> Option<usize> {
        let behind = (self.status.sequence as u16).wrapping_sub(low_word);
        if behind > u16::MAX / 2 {
            return None;
        }
        Some(self.queue.len().saturating_sub(usize::from(behind)))
    }

    fn acknowledge(&mut self, low_word: u16) {
        let count = self.acknowledged_by(low_word).unwrap_or(0);
        for _ in 0..count {
            if let Some(record) = self.queue.pop_front() {
                self.journal.acknowledge(record.seq);
            }
        }
        self.block.acknowledge = low_word;
    }

    /// The next parcel to send over CAN.
    pub fn next_to_send(&mut self) -> Option<ParcelRecord> {
        let record = self.to_send.pop_front()?;
        self.journal.send(record.seq);
        Some(record)
    }

    /// The next count of the encoder, and when it came.
    pub fn next_count(&mut self) -> Option<(u32, Instant)> {
        self.counts.pop_front()
    }

    /// The next request to vision.
    pub fn next_request(&mut self) -> Option<Request> {
        self.requests.pop_front()
    }
}

/// Whether sequence number `a` was given after `b`, numbers wrapping around.
fn is_after(a: u32, b: u32) -> bool {
    a != b && a.wrapping_sub(b) < u32::MAX / 2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::record;
    use crate::plc::registers::{LATEST, QUEUE_HEAD, RING};

    fn link(settings: Settings) -> Link {
        Link::new(settings, WordOrder::HighFirst, true, Journal::default(), Instant::now())
    }

    fn queueing() -> Settings {
        Settings { queue: true, ..Settings::default() }
    }

    /// Publish parcels of the pipeline.
    fn publish(link: &mut Link, count: u32) {
        for seq in 1..=count {
            link.record(record(seq), 0.0);
            link.update(&VisionStatus::default(), &CanStatus::default(), None, Instant::now());
        }
    }

    fn sequence_at(link: &Link, address: u16) -> u32 {
        let registers = link.read(address, 2).expect("exists");
        join([registers[0], registers[1]], WordOrder::HighFirst)
    }

    #[test]
    fn the_queue_shows_the_oldest_until_it_is_acknowledged() {
        let mut link = link(queueing());
        assert_eq!(sequence_at(&link, QUEUE_HEAD), 0);
        publish(&mut link, 3);
        assert_eq!((sequence_at(&link, QUEUE_HEAD), link.status().queued), (1, 3));
        for (acknowledged, head) in [(1, 2), (1, 2), (3, 0), (2, 0), (3, 0)] {
            link.write(COMMAND + 1, &[acknowledged], Instant::now()).expect("known");
            assert_eq!(sequence_at(&link, QUEUE_HEAD), head, "after {acknowledged}");
        }
        assert_eq!(link.status().queue_overflows, 0);
    }

    #[test]
    fn a_parcel_that_was_never_published_cannot_be_acknowledged() {
        let mut link = link(queueing());
        publish(&mut link, 2);
        assert_eq!(link.write(COMMAND + 1, &[3], Instant::now()), Err(Refusal::Value));
        assert_eq!((sequence_at(&link, QUEUE_HEAD), link.status().queued), (1, 2));
        link.command(1, 1, 9);
        assert_eq!(link.status().outcome, Outcome::Argument as u16);
    }

    #[test]
    fn an_unknown_acknowledgment_in_a_write_of_the_whole_block_is_left_out() {
        let mut link = link(queueing());
        publish(&mut link, 2);
        link.write(COMMAND, &[9, 500, 0, 77, 0, 0, 0, 0], Instant::now()).expect("taken");
        assert_eq!((sequence_at(&link, QUEUE_HEAD), link.status().queued), (1, 2));
        assert_eq!(link.next_count().map(|(count, _)| count), Some(77));
    }

    #[test]
    fn a_queue_that_is_turned_on_begins_with_what_comes_then() {
        let path = std::env::temp_dir().join(format!("beltgauge-queue-{}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        let restarted = |settings: Settings, sends: bool| {
            let journal = Journal::open(&path).expect("writable");
            Link::new(settings, WordOrder::HighFirst, sends, journal, Instant::now())
        };
        let publish_all = |link: &mut Link, count: u32| {
            publish(link, count);
            while !link.numbered.is_empty() {
                link.flush();
            }
        };
        publish_all(&mut restarted(Settings::default(), false), 5);
        let mut link = restarted(queueing(), true);
        assert_eq!((link.status().sequence, link.status().queued), (5, 0));
        publish_all(&mut link, 25);
        // 20 were sent, the last 12 of them may have got lost with the controller; the others wait.
        (0..20).for_each(|_| assert!(link.next_to_send().is_some()));
        link.flush();
        drop(link);
        let mut link = restarted(queueing(), true);
        assert_eq!((link.status().sequence, link.status().queued), (30, 25));
        let waiting: Vec<u32> = std::iter::from_fn(|| link.next_to_send()).map(|r| r.seq).collect();
        assert!(waiting.iter().copied().eq(9..=30), "{waiting:?}");
        let _ = std::fs::remove_file(&path);
    }

    #[test]
    fn a_full_queue_lets_the_oldest_go_and_counts_it() {
        let mut link = link(queueing());
        publish(&mut link, 35);
        assert_eq!((sequence_at(&link, QUEUE_HEAD), link.status().queue_overflows), (4, 3));
        assert_eq!(link.status().fault_bits() & 4, 4);
        // What was lost from the queue is acknowledged without harm.
        link.write(COMMAND + 1, &[2], Instant::now()).expect("was published");
        assert_eq!(sequence_at(&link, QUEUE_HEAD), 4);
    }

    #[test]
    fn a_parcel_is_published_when_the_belt_has_carried_it_on() {
        let mut link = link(Settings { publish_after_mm: 500.0, ..Settings::default() });
        link.record(record(1), 1000.0);
        for (travel_mm, sequence) in [(1000.0, 0), (1499.0, 0), (1500.0, 1)] {
            let vision = VisionStatus { belt_travel_mm: travel_mm, ..VisionStatus::default() };
            link.update(&vision, &CanStatus::default(), None, Instant::now());
            assert_eq!(sequence_at(&link, LATEST), sequence, "at {travel_mm}");
        }
        link.record(record(2), 1600.0);
        link.flush();
        assert_eq!(sequence_at(&link, RING + 32), 2);
    }

    #[test]
    fn a_command_is_carried_out_once_for_each_ticket() {
        let mut link = link(Settings::default());
        let mut command = |ticket: u16, command: u16, argument: u16| {
            let registers = [ticket, command, 0, argument];
            link.write(COMMAND + 4, &registers, Instant::now()).expect("inside");
            let status = link.status();
            (status.ticket, status.outcome, link.next_request())
        };
        let (done, unknown, argument) =
            (Outcome::Done as u16, Outcome::Unknown as u16, Outcome::Argument as u16);
        assert_eq!(command(7, 2, 0), (7, done, Some(Request::Learn)));
        assert_eq!(command(7, 2, 0), (7, done, None));
        assert_eq!(command(8, 4, 0), (8, done, Some(Request::Report(false))));
        assert_eq!(command(9, 3, 0), (9, done, Some(Request::Report(true))));
        assert_eq!(command(10, 99, 0), (10, unknown, None));
        assert_eq!(command(11, 5, 501), (11, argument, None));
        assert_eq!(command(12, 5, 50), (12, done, None));
        publish(&mut link, 1);
        // 235.14, 124.8, 70.2 to multiples of 5.
        assert_eq!(link.read(LATEST + 4, 3), Some(&[2350, 1250, 700][..]));
        (20..30).for_each(|ticket| link.command(ticket, 2, 0));
        assert_eq!(link.status().outcome, Outcome::Busy as u16);
    }

    #[test]
    fn writes_outside_the_command_block_or_of_half_a_value_change_nothing() {
        let mut link = link(Settings::default());
        let all = |link: &Link| link.read(0, 1224).expect("exists").to_vec();
        let before = all(&link);
        for (address, count) in [
            (0, 1),
            (59, 1),
            (59, 3),
            (70, 1),
            (69, 2),
            (60, 11),
            (62, 1),
            (63, 1),
            (66, 1),
            (65535, 1),
            (60, 0),
        ] {
            let refused = link.write(address, &vec![5; count], Instant::now());
            assert_eq!(refused, Err(Refusal::Address), "{address} {count}");
        }
        assert_eq!(all(&link), before);
        link.write(COMMAND, &[1, 0, 0, 7, 0, 0, 0, 0], Instant::now()).expect("the whole block");
        assert_eq!(link.next_count().map(|(count, _)| count), Some(7));
    }

    #[test]
    fn a_heartbeat_that_stands_still_is_noticed() {
        let mut link = link(Settings { heartbeat_timeout_s: 1.0, ..Settings::default() });
        let start = Instant::now();
        let mut silent = |value: Option<u16>, ms: u64| {
            let now = start + Duration::from_millis(ms);
            if let Some(value) = value {
                link.write(COMMAND, &[value], now).expect("inside");
            }
            link.update(&VisionStatus::default(), &CanStatus::default(), None, now);
            link.status().plc_silent
        };
        assert!(!silent(Some(1), 500));
        assert!(!silent(Some(1), 1400));
        assert!(silent(Some(1), 1600));
        assert!(!silent(Some(2), 1700));
    }

    #[test]
    fn sequence_numbers_wrap_around_past_0() {
        let mut link = link(queueing());
        link.status.sequence = u32::MAX - 1;
        publish(&mut link, 3);
        assert_eq!((link.status().sequence, sequence_at(&link, QUEUE_HEAD)), (2, u32::MAX));
        link.write(COMMAND + 1, &[1], Instant::now()).expect("published");
        assert_eq!(sequence_at(&link, QUEUE_HEAD), 2);
    }
}
