//! CAN through the kernel's socket: parcels and status out, commands and encoder counts in.
//!
//! Never waits: a bus that takes no frame is tried again at the next step. One parcel at a time
//! is turned into frames; others wait in the link. After bus off, and after the interface was down,
//! the last parcels are sent again, for the controller may have forgotten their frames. A controller
//! that is off the bus takes frames and drops them: the interface's carrier tells, also when the
//! driver's word was missed.

use crate::config::Can as Settings;
use crate::event::ParcelRecord;
use crate::plc::bus::{Bus, Event, would_block};
use crate::plc::command::Sender;
use crate::plc::frames::{self, Frame, Message, Received};
use crate::plc::link::{Answer, Link, REPEATED};
use crate::plc::registers::{CanState, CanStatus, Status};
use heapless::Deque;
use std::io::{Error, ErrorKind};
use std::time::{Duration, Instant};

/// An interface that is not there is looked for this often.
const REOPEN_PERIOD: Duration = Duration::from_secs(1);
/// The carrier is looked at this often.
const CARRIER_PERIOD: Duration = Duration::from_millis(500);
/// After the bus is back the kernel drops frames until it has noticed.
const SETTLE: Duration = Duration::from_millis(200);
/// Outcomes that wait to be sent.
const RESULTS_MAX: usize = 8;
/// Frames of one parcel, or of the status block.
const OUTGOING_MAX: usize = 32;
/// Frames sent in one step, of 2 ms: a quarter of what a bus of 500 kbit/s carries, so that others get
/// their turn and a receiver with a short buffer keeps up. A parcel is out in 10 ms.
const SENT_MAX: usize = 2;
/// Frames taken in one step: a flood does not hold up the rest.
const RECEIVED_MAX: usize = 128;
/// The appliance on a CAN bus.
pub struct CanLink<B> {
    settings: Settings,
    bus: Option<B>,
    status: CanStatus,
    outgoing: Deque<Frame, OUTGOING_MAX>,
    recent: Deque<ParcelRecord, REPEATED>,
    /// Parcels of `recent` that are to be sent again.
    repeat: usize,
    /// Answers that wait for the disk.
    unanswered: Deque<Answer, RESULTS_MAX>,
    results: Deque<Frame, RESULTS_MAX>,
    counter: u8,
    /// Frames that the interface refused for ever.
    refused: u64,
    /// The carrier when it was last looked at.
    carrier: Option<bool>,
    carrier_due: Instant,
    heartbeat_due: Instant,
    status_due: Instant,
    open_due: Instant,
    /// Nothing is sent before.
    settled: Instant,
}

impl<B: Bus> CanLink<B> {
    /// Nothing is opened yet.
    pub fn new(settings: Settings, now: Instant) -> Self {
        Self {
            settings,
            bus: None,
            status: CanStatus::default(),
            outgoing: Deque::new(),
            recent: Deque::new(),
            repeat: 0,
            unanswered: Deque::new(),
            results: Deque::new(),
            counter: 0,
            refused: 0,
            carrier: None,
            carrier_due: now,
            heartbeat_due: now,
            status_due: now,
            open_due: now,
            settled: now,
        }
    }

    /// State and counters.
    pub fn status(&self) -> CanStatus {
        CanStatus { frames_refused: self.refused, ..self.status }
    }

    /// Whether nothing waits to be sent.
    pub fn is_idle(&self) -> bool {
        self.outgoing.is_empty() && self.results.is_empty() && self.repeat == 0
    }

    /// Take what has come, send what is due.
    pub fn step(&mut self, link: &mut Link, now: Instant) {
        let Some(interface) = self.settings.interface.clone() else { return };
        if self.bus.is_none() && now >= self.open_due {
            self.open_due = now + REOPEN_PERIOD;
            match B::open(&interface, self.settings.fd) {
                Ok(bus) => {
                    self.bus = Some(bus);
                    (self.carrier, self.carrier_due) = (None, now);
                    self.back(now);
                }
                Err(error) => self.lost(&error),
            }
        }
        if self.bus.is_some() && now >= self.carrier_due {
            self.carrier_due = now + CARRIER_PERIOD;
            self.look_at_carrier(B::carrier(&interface), now);
        }
        self.receive(link, now);
        self.answer(link);
        if now >= self.settled {
            self.send(link, now);
        }
    }

    /// A carrier that goes is bus off, one that comes is its end, whatever the driver reported. One
    /// that stays says nothing: virtual buses have theirs always.
    fn look_at_carrier(&mut self, carrier: Option<bool>, now: Instant) {
        let before = std::mem::replace(&mut self.carrier, carrier);
        match (before, carrier) {
            (Some(true) | None, Some(false)) => self.bus_off(),
            (Some(false), Some(true)) if self.status.state == CanState::BusOff => self.back(now),
            _ => {}
        }
    }

    /// The bus is there, or there again.
    fn back(&mut self, now: Instant) {
        if self.status.state == CanState::Active {
            return;
        }
        tracing::info!(interface = self.settings.interface, "CAN bus active");
        self.status.state = CanState::Active;
        self.repeat = self.recent.len();
        self.settled = now + SETTLE;
    }

    fn bus_off(&mut self) {
        if self.status.state != CanState::BusOff {
            self.status.bus_offs += 1;
            tracing::error!(interface = self.settings.interface, "CAN bus off");
        }
        self.status.state = CanState::BusOff;
    }

    /// The interface is down or gone.
    fn lost(&mut self, error: &Error) {
        if self.status.state != CanState::Down {
            tracing::error!(interface = self.settings.interface, %error, "CAN interface lost");
            self.status.state = CanState::Down;
        }
        // ENETDOWN alone ends by itself.
        if error.raw_os_error() != Some(rustix::io::Errno::NETDOWN.raw_os_error()) {
            self.bus = None;
        }
    }

    fn receive(&mut self, link: &mut Link, now: Instant) {
        for _ in 0..RECEIVED_MAX {
            let Some(bus) = &mut self.bus else { return };
            match bus.receive() {
                Ok(Event::Frame { id, payload }) => {
                    if self.status.state == CanState::BusOff {
                        // Who receives is on the bus, whatever was or was not reported.
                        self.back(now);
                    }
                    match frames::decode(id.wrapping_sub(self.settings.base_id), &payload) {
                        Some(Received::Command(ticket, command, argument)) => {
                            let answer = link.command(ticket, command, argument, Sender::Can);
                            if self.unanswered.is_full() {
                                self.unanswered.pop_front();
                            }
                            let _ = self.unanswered.push_back(answer); // invariant: there is room
                        }
                        Some(Received::Encoder(count)) => link.count(count, now),
                        Some(Received::Heartbeat(value)) => link.heartbeat(value, now),
                        None => {}
                    }
                }
                Ok(Event::Error { class, data }) => self.error(class, data, now),
                Ok(Event::Other) => {}
                Err(error) if would_block(&error) => return,
                Err(error) => return self.lost(&error),
            }
        }
    }

    /// Every command is answered, a repeated one again, when the disk has it.
    fn answer(&mut self, link: &Link) {
        while self.unanswered.front().is_some_and(|answer| link.is_kept(answer.noted)) {
            let Some(Answer { ticket, outcome, .. }) = self.unanswered.pop_front() else { return };
            if self.results.is_full() {
                self.results.pop_front();
            }
            let results = &mut self.results;
            let status = Status { ticket, outcome, ..*link.status() };
            // invariant: there is room
            frames::result(&status, |frame| drop(results.push_back(frame)));
        }
    }

    /// Error frames, `linux/can/error.h`.
    fn error(&mut self, class: u32, data: [u8; 8], now: Instant) {
        const CONTROLLER: u32 = 0x04;
        const BUS_OFF: u32 = 0x40;
        const RESTARTED: u32 = 0x100;
        const COUNTERS: u32 = 0x200;
        const PASSIVE: u8 = 0x30;
        const ACTIVE: u8 = 0x40;
        let status = &mut self.status;
        if class & (COUNTERS | CONTROLLER) != 0 {
            (status.transmit_errors, status.receive_errors) = (data[6], data[7]);
        }
        if class & BUS_OFF != 0 {
            self.bus_off();
        } else if class & RESTARTED != 0 {
            self.back(now);
        } else if class & CONTROLLER != 0 && status.state != CanState::BusOff {
            if data[1] & ACTIVE != 0 {
                status.state = CanState::Active;
            } else if data[1] & PASSIVE != 0 {
                status.state = CanState::Passive;
            }
        }
    }

    fn send(&mut self, link: &mut Link, now: Instant) {
        for _ in 0..SENT_MAX {
            if self.outgoing.is_empty() {
                self.next_frames(link, now);
            }
            let (Some(frame), Some(bus)) = (self.outgoing.front(), &mut self.bus) else { return };
            let fd = frame.message == Message::ParcelFd;
            match bus.send(self.settings.base_id + frame.message as u16, &frame.payload, fd) {
                Ok(()) => {
                    self.outgoing.pop_front();
                    if self.status.state == CanState::Down {
                        return self.back(now);
                    }
                }
                Err(error) if would_block(&error) => return,
                // Tried again it would be refused again.
                Err(error) if error.kind() == ErrorKind::InvalidInput => {
                    self.outgoing.pop_front();
                    self.refused += 1;
                }
                Err(error) => return self.lost(&error),
            }
        }
    }

    /// What is most urgent: an outcome, a heartbeat that is due, a parcel, the status.
    fn next_frames(&mut self, link: &mut Link, now: Instant) {
        let outgoing = &mut self.outgoing;
        // invariant: a message has fewer frames than there is room for
        let mut emit = |frame: Frame| drop(outgoing.push_back(frame));
        let reachable = matches!(self.status.state, CanState::Active | CanState::Passive);
        if let Some(result) = self.results.pop_front() {
            emit(result);
        } else if now >= self.heartbeat_due {
            self.heartbeat_due = now + frames::HEARTBEAT_PERIOD;
            frames::heartbeat(link.status(), emit);
        } else if reachable && self.repeat > 0 {
            if let Some(record) = self.recent.iter().nth(self.recent.len() - self.repeat) {
                frames::parcel(record, self.settings.fd, emit);
            }
            self.repeat -= 1;
        } else if reachable && let Some(record) = link.next_to_send() {
            frames::parcel(&record, self.settings.fd, emit);
            if self.recent.is_full() {
                self.recent.pop_front();
            }
            let _ = self.recent.push_back(record); // invariant: there is room
        } else if now >= self.status_due {
            self.status_due = now + frames::STATUS_PERIOD;
            self.counter = self.counter.wrapping_add(1);
            frames::status(link.status(), self.counter, &mut emit);
        }
    }
}

#[cfg(test)]
mod tests;
