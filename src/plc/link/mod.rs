//! What a PLC sees and does, by whatever wire: parcels in the order and rounding it asked for, a
//! queue that it acknowledges, a watched heartbeat, commands with their outcome.
//!
//! In: records and status from vision; register writes and CAN commands from the PLC. Out: the
//! register image; records to be sent over CAN; requests to vision.

mod commands;

pub use commands::{Answer, Refusal};

use crate::config::{Plc as Settings, WordOrder};
use crate::event::ParcelRecord;
use crate::plc::command::{Outcome, Request, Sender};
use crate::plc::journal::{Journal, Keeping, Override, State, is_after};
use crate::plc::present::presented;
use crate::plc::registers::{
    CanStatus, CommandBlock, RING_PARCELS, RegisterImage, Status, VisionStatus,
};
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
/// Commands between two visits of those who watch.
const COMMANDED_MAX: usize = 64;
/// Without a frame for this long the heartbeat stops.
const SILENCE: Duration = Duration::from_secs(1);
/// The state between vision and PLC.
pub struct Link {
    settings: Settings,
    /// What the configuration says, whatever a command has set.
    configured_scale_interval_mm: f64,
    configured_mm_per_count: Option<f64>,
    order: WordOrder,
    image: RegisterImage,
    status: Status,
    block: CommandBlock,
    journal: Journal,
    waiting: Deque<(ParcelRecord, f64), WAITING_MAX>,
    /// Numbered, and on their way to the disk: with what the journal must have kept.
    numbered: Deque<(ParcelRecord, u64), WAITING_MAX>,
    /// Commands whose outcome is on its way to the disk.
    decided: Deque<Decided, REQUESTS_MAX>,
    queue: Deque<ParcelRecord, QUEUE_PARCELS>,
    /// There is a CAN bus.
    sends: bool,
    to_send: Deque<ParcelRecord, QUEUE_PARCELS>,
    /// Parcels that found `to_send` full.
    unsent: u64,
    /// Published, and not yet told to those who watch.
    published: Deque<ParcelRecord, WAITING_MAX>,
    /// Who wrote registers last, and when.
    written: Option<(Sender, Instant)>,
    /// Carried out or refused, and not yet told to those who watch.
    commanded: Deque<Commanded, COMMANDED_MAX>,
    /// Commands that found `commanded` full.
    commands_untold: u64,
    /// The last one that was refused before it was decided on: a PLC may write it again and again.
    refused: Option<Commanded>,
    /// Parcels that found `waiting` full.
    unpublished: u64,
    counts: Deque<(u32, Instant), COUNTS_MAX>,
    requests: Deque<Request, REQUESTS_MAX>,
    /// Vision still shows the ratio of the scale before the last command 6.
    ratio_is_old: bool,
    /// Of the last acknowledgment, for [`Link::is_kept`].
    acknowledgment: u64,
    plc_alive: Instant,
    encoder_alive: Option<Instant>,
    beats: Beats,
}

/// A command as it was given, and what became of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Commanded {
    /// By whom.
    pub sender: Sender,
    /// Its ticket.
    pub ticket: u16,
    /// Its code.
    pub command: u16,
    /// Its argument.
    pub argument: u32,
    /// See [`Outcome`].
    pub outcome: u16,
}

/// A command that was decided on, and is carried out and told when the disk has it.
struct Decided {
    noted: u64,
    ticket: u16,
    outcome: Outcome,
    request: Option<Request>,
    /// For those who watch; none: ticket 0 is no command.
    given: Option<Commanded>,
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
        let state = *journal.state();
        let status = Status {
            boots: if journal.keeping() == Keeping::Memory { 0 } else { state.boots },
            sequence: journal.records().back().map_or(0, |last| last.seq),
            ticket: state.ticket,
            outcome: state.outcome,
            stopped: state.stopped,
            ..Status::default()
        };
        let mut link = Self {
            configured_scale_interval_mm: settings.scale_interval_mm,
            configured_mm_per_count: None,
            settings,
            order,
            image: RegisterImage::new(order),
            status,
            block: CommandBlock::default(),
            journal,
            waiting: Deque::new(),
            numbered: Deque::new(),
            decided: Deque::new(),
            queue: Deque::new(),
            sends,
            to_send: Deque::new(),
            unsent: 0,
            published: Deque::new(),
            written: None,
            commanded: Deque::new(),
            commands_untold: 0,
            refused: None,
            unpublished: 0,
            counts: Deque::new(),
            requests: Deque::new(),
            ratio_is_old: false,
            acknowledgment: 0,
            plc_alive: now,
            encoder_alive: None,
            beats: Beats { start: now, frames: 0, last_frame: now },
        };
        link.take_up(&state);
        link.show();
        link
    }

    /// An encoder is configured: its scale, unless a command has set another one.
    #[must_use]
    pub fn with_encoder(mut self, mm_per_count: Option<f64>) -> Self {
        self.configured_mm_per_count = mm_per_count;
        self.status.mm_per_count = mm_per_count
            .map(|configured| Override::of(self.journal.state().mm_per_count, configured));
        if let Some(set) = self.status.mm_per_count.filter(|set| Some(*set) != mm_per_count) {
            let _ = self.requests.push_back(Request::MmPerCount(set)); // invariant: there is room
        }
        self.show();
        self
    }

    /// What was before the restart holds again.
    fn take_up(&mut self, state: &State) {
        let configured_mm = self.settings.scale_interval_mm;
        self.settings.scale_interval_mm = Override::of(state.scale_interval_mm, configured_mm);
        self.status.scale_interval_mm = self.settings.scale_interval_mm;
        if state.stopped {
            let _ = self.requests.push_back(Request::Report(false)); // invariant: there is room
        }
        // The last that were sent may have got no further than the kernel.
        let repeated_from = state.sent.wrapping_sub(REPEATED as u32);
        // The journal keeps no more than either has room for.
        for record in self.journal.records().clone() {
            self.image.publish(&record);
            if self.sends && is_after(record.seq, repeated_from) {
                let _ = self.to_send.push_back(record); // invariant: there is room
            }
            if self.settings.queue && is_after(record.seq, state.acknowledged) {
                let _ = self.queue.push_back(record); // invariant: there is room
            }
        }
    }

    /// A state file that could not be read at the start has turned up: what it keeps holds again, but
    /// for what this run was told since. What waited in it to be acknowledged goes first.
    fn meet(&mut self) {
        // What holds again may be two requests.
        if self.requests.len() + self.decided.len() + 2 > REQUESTS_MAX {
            return;
        }
        let Some(unacknowledged) = self.journal.meet() else { return };
        let state = *self.journal.state();
        if self.settings.queue {
            for record in unacknowledged.into_iter().rev() {
                let no_room = self.queue.push_front(record).is_err();
                self.status.queue_overflows += u64::from(no_room);
            }
        }
        if state.stopped != self.status.stopped {
            let _ = self.requests.push_back(Request::Report(!state.stopped)); // invariant: there is room
        }
        let mm_per_count =
            self.configured_mm_per_count.map(|mm| Override::of(state.mm_per_count, mm));
        if let Some(set) = mm_per_count.filter(|_| mm_per_count != self.status.mm_per_count) {
            let _ = self.requests.push_back(Request::MmPerCount(set)); // invariant: there is room
            self.status.mm_per_count = mm_per_count;
        }
        self.status.boots = state.boots;
        if self.decided.is_empty() {
            (self.status.ticket, self.status.outcome) = (state.ticket, state.outcome);
        }
        self.show_settings();
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
        self.unpublished += u64::from(self.waiting.push_back((record, due_mm)).is_err());
    }

    /// Renew the status, publish what is due.
    pub fn update(
        &mut self,
        vision: &VisionStatus,
        can: &CanStatus,
        encoder_timeout: Option<Duration>,
        now: Instant,
    ) {
        self.meet();
        while self.waiting.front().is_some_and(|(_, due_mm)| vision.belt_travel_mm >= *due_mm)
            && self.number_first()
        {}
        self.publish_kept();
        let status = &mut self.status;
        (status.vision, status.can) = (*vision, *can);
        // It is forgotten by vision when the new scale has arrived there.
        self.ratio_is_old &= vision.belt.encoder_ratio.is_some();
        if self.ratio_is_old {
            status.vision.belt.encoder_ratio = None;
        }
        status.can.parcels_dropped += self.unsent;
        status.vision.counters.event_overflows += self.unpublished;
        status.keeping = self.journal.keeping();
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
        while !self.waiting.is_empty() && self.number_first() {}
        self.publish_kept();
        self.show();
    }

    /// Whether nothing waits to be published or sent.
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty()
            && self.numbered.is_empty()
            && self.decided.is_empty()
            && self.to_send.is_empty()
    }

    /// The next parcel gets its sequence number, which the journal keeps before anybody sees it: it is
    /// never given to another. False when that has to wait: the disk has not answered for many
    /// parcels, and will soon count as failing.
    fn number_first(&mut self) -> bool {
        let failing = self.journal.is_failing();
        self.publish(failing);
        if self.numbered.is_full() {
            return false;
        }
        let Some((record, _)) = self.waiting.pop_front() else { return false };
        let numbered = self.journal.number(presented(record, &self.settings), failing);
        if !self.settings.queue {
            // A queue that is turned on later begins with what comes then.
            self.journal.taken(numbered.0.seq);
        }
        let _ = self.numbered.push_back(numbered); // invariant: there is room
        self.journal.save();
        true
    }

    fn publish_kept(&mut self) {
        self.publish(self.journal.is_failing());
    }

    /// Publish what the disk has. When it fails the belt goes on: what was numbered and not seen by
    /// anybody is numbered again, beyond what the disk may have.
    fn publish(&mut self, failing: bool) {
        while self.numbered.front().is_some_and(|(_, noted)| self.journal.is_on_disk(*noted)) {
            self.publish_first();
        }
        if failing && !self.journal.is_elsewhere() && !self.numbered.is_empty() {
            self.journal.take_back(self.numbered.len());
            for (record, noted) in &mut self.numbered {
                (*record, *noted) = self.journal.number(*record, failing);
            }
        }
        while failing && !self.numbered.is_empty() {
            self.publish_first();
        }
        while let Some(decided) = self.decided.front()
            && (failing || self.journal.is_on_disk(decided.noted))
            && let Some(decided) = self.decided.pop_front()
        {
            self.carry_out(&decided);
        }
    }

    fn publish_first(&mut self) {
        if let Some((record, _)) = self.numbered.pop_front() {
            self.show_parcel(record);
        }
    }

    fn carry_out(&mut self, decided: &Decided) {
        if let Some(request) = decided.request {
            if let Request::MmPerCount(set) = request {
                self.status.mm_per_count = Some(set);
                self.ratio_is_old = true;
                self.status.vision.belt.encoder_ratio = None;
            }
            let _ = self.requests.push_back(request); // invariant: room was asked for
        }
        (self.status.ticket, self.status.outcome) = (decided.ticket, decided.outcome as u16);
        if let Some(given) = decided.given {
            self.tell(given);
        }
        self.show_settings();
    }

    fn tell(&mut self, given: Commanded) {
        self.commands_untold += u64::from(self.commanded.push_back(given).is_err());
    }

    /// What commands have set.
    fn show_settings(&mut self) {
        let state = self.journal.state();
        self.status.stopped = state.stopped;
        let configured_mm = self.configured_scale_interval_mm;
        self.settings.scale_interval_mm = Override::of(state.scale_interval_mm, configured_mm);
        self.status.scale_interval_mm = self.settings.scale_interval_mm;
    }

    fn show_parcel(&mut self, record: ParcelRecord) {
        self.status.sequence = record.seq;
        self.image.publish(&record);
        if self.published.is_full() {
            // Nobody watches.
            self.published.pop_front();
        }
        let _ = self.published.push_back(record); // invariant: there is room
        if self.settings.queue {
            if self.queue.is_full() {
                self.queue.pop_front();
                self.status.queue_overflows += 1;
            }
            let _ = self.queue.push_back(record); // invariant: there is room
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

    /// The next parcel to send over CAN.
    pub fn next_to_send(&mut self) -> Option<ParcelRecord> {
        let record = self.to_send.pop_front()?;
        self.journal.sent(record.seq);
        Some(record)
    }

    /// The next parcel that was published since this was last asked; the last ones, when it was long ago.
    pub fn next_published(&mut self) -> Option<ParcelRecord> {
        self.published.pop_front()
    }

    /// The next command that was carried out or refused.
    pub fn next_commanded(&mut self) -> Option<Commanded> {
        self.commanded.pop_front()
    }

    /// Commands that nobody was told of, because too many came at once.
    pub fn commands_untold(&self) -> u64 {
        self.commands_untold
    }

    /// Who wrote registers last, and when.
    pub fn written(&self) -> Option<(Sender, Instant)> {
        self.written
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

#[cfg(test)]
mod tests;
