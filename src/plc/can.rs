//! CAN through the kernel's socket: parcels and status out, commands and encoder counts in.
//!
//! Never waits: a bus that takes no frame is tried again at the next step. One parcel at a time
//! is turned into frames; others wait in the link. After bus off, and after the interface was down,
//! the last parcels are sent again, for the controller may have forgotten their frames. A controller
//! that is off the bus takes frames and drops them: the interface's carrier tells, also when the
//! driver's word was missed.

use super::bus::{Bus, Event, would_block};
use super::frames::{self, Frame, Message, Received};
use super::link::{Link, REPEATED};
use super::registers::{CanState, CanStatus};
use crate::config::Can as Settings;
use crate::event::ParcelRecord;
use heapless::Deque;
use std::io::{Error, ErrorKind};
use std::time::{Duration, Instant};

const HEARTBEAT_PERIOD: Duration = Duration::from_millis(100);
const STATUS_PERIOD: Duration = Duration::from_secs(1);
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
                            link.command(ticket, command, argument);
                            self.answer(link);
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

    /// Every command is answered, a repeated one again.
    fn answer(&mut self, link: &Link) {
        if self.results.is_full() {
            self.results.pop_front();
        }
        let results = &mut self.results;
        // invariant: there is room
        frames::result(link.status(), |frame| drop(results.push_back(frame)));
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
            self.heartbeat_due = now + HEARTBEAT_PERIOD;
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
            self.status_due = now + STATUS_PERIOD;
            self.counter = self.counter.wrapping_add(1);
            frames::status(link.status(), self.counter, &mut emit);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Plc, WordOrder};
    use crate::plc::frames::Payload;
    use crate::plc::journal::Journal;
    use crate::plc::record;
    use crate::plc::registers::VisionStatus;
    use std::cell::RefCell;
    use std::collections::VecDeque;

    /// A bus in memory: what was sent, what comes, and the error that every call gives.
    #[derive(Default)]
    struct Wire {
        sent: Vec<(u16, Vec<u8>)>,
        coming: VecDeque<Event>,
        error: Option<i32>,
        room: usize,
        carrier: Option<bool>,
    }

    thread_local! {
        static WIRE: RefCell<Wire> = RefCell::default();
    }

    struct TestBus;

    impl Bus for TestBus {
        fn open(_: &str, _: bool) -> std::io::Result<Self> {
            WIRE.with_borrow(|wire| {
                wire.error.map_or(Ok(Self), |e| Err(Error::from_raw_os_error(e)))
            })
        }

        fn carrier(_: &str) -> Option<bool> {
            WIRE.with_borrow(|wire| wire.carrier)
        }

        fn send(&mut self, id: u16, payload: &[u8], _: bool) -> std::io::Result<()> {
            WIRE.with_borrow_mut(|wire| {
                if let Some(error) = wire.error {
                    return Err(Error::from_raw_os_error(error));
                }
                if wire.room == 0 {
                    return Err(Error::from_raw_os_error(rustix::io::Errno::NOBUFS.raw_os_error()));
                }
                wire.room -= 1;
                wire.sent.push((id, payload.to_vec()));
                Ok(())
            })
        }

        fn receive(&mut self) -> std::io::Result<Event> {
            WIRE.with_borrow_mut(|wire| wire.coming.pop_front().ok_or(ErrorKind::WouldBlock.into()))
        }
    }

    struct Bench {
        link: Link,
        can: CanLink<TestBus>,
        now: Instant,
    }

    impl Bench {
        fn new() -> Self {
            WIRE.set(Wire { room: usize::MAX, ..Wire::default() });
            let now = Instant::now();
            let settings = Settings { interface: Some("can0".into()), ..Settings::default() };
            let link =
                Link::new(Plc::default(), WordOrder::HighFirst, true, Journal::default(), now);
            let mut bench = Self { link, can: CanLink::new(settings, now), now };
            bench.settle();
            bench
        }

        /// 10 ms later, in visits of 2 ms.
        fn step(&mut self) {
            for _ in 0..5 {
                self.now += Duration::from_millis(2);
                self.link.update(&VisionStatus::default(), &self.can.status(), None, self.now);
                self.can.step(&mut self.link, self.now);
            }
        }

        /// Until a bus that is back is used.
        fn settle(&mut self) {
            (0..25).for_each(|_| self.step());
        }

        fn parcel(&mut self) {
            self.link.record(record(0), 0.0);
            self.step();
        }

        /// Sequence numbers of the parcels that were sent whole, by the rule of reassembly.
        fn received() -> Vec<u32> {
            let last = frames::parcel_places().last().expect("fields").segment;
            let mut whole = Vec::new();
            let (mut next, mut sequence) = (0, 0);
            WIRE.with_borrow(|wire| {
                for (_, bytes) in wire.sent.iter().filter(|(id, _)| *id == 0x502) {
                    if bytes[1] == 0 {
                        sequence = u32::from_be_bytes([bytes[2], bytes[3], bytes[4], bytes[5]]);
                        next = 0;
                    }
                    assert_eq!((bytes[0], bytes[1]), (sequence as u8, next));
                    next += 1;
                    if bytes[1] == last {
                        whole.push(sequence);
                    }
                }
            });
            whole
        }
    }

    fn wire(change: impl FnOnce(&mut Wire)) {
        WIRE.with_borrow_mut(change);
    }

    #[test]
    fn parcels_and_heartbeats_are_sent() {
        let mut bench = Bench::new();
        bench.parcel();
        (0..100).for_each(|_| bench.step());
        bench.parcel();
        bench.step();
        assert_eq!(Bench::received(), [1, 2]);
        let beats =
            WIRE.with_borrow(|wire| wire.sent.iter().filter(|(id, _)| *id == 0x500).count());
        assert!((10..=11).contains(&beats), "{beats} heartbeats in a second");
    }

    #[test]
    fn a_bus_without_room_delays_parcels_and_loses_none() {
        let mut bench = Bench::new();
        wire(|wire| wire.room = 3);
        (0..5).for_each(|_| bench.parcel());
        assert!(Bench::received().is_empty());
        for _ in 0..60 {
            wire(|wire| wire.room = 3);
            bench.step();
        }
        assert_eq!(Bench::received(), [1, 2, 3, 4, 5]);
    }

    #[test]
    fn after_bus_off_the_last_parcels_are_sent_again() {
        let mut bench = Bench::new();
        (0..3).for_each(|_| bench.parcel());
        bench.settle();
        let error = |class, data| wire(|wire| wire.coming.push_back(Event::Error { class, data }));
        error(0x40, [0; 8]);
        wire(|wire| wire.room = 0);
        bench.step();
        assert_eq!((bench.can.status().state, bench.can.status().bus_offs), (CanState::BusOff, 1));
        (0..2).for_each(|_| bench.parcel());
        error(0x100, [0; 8]);
        wire(|wire| wire.room = usize::MAX);
        (0..3).for_each(|_| bench.settle());
        assert_eq!(bench.can.status().state, CanState::Active);
        assert_eq!(Bench::received(), [1, 2, 3, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn a_frame_that_comes_in_ends_bus_off() {
        let mut bench = Bench::new();
        let event = |event| wire(|wire| wire.coming.push_back(event));
        event(Event::Error { class: 0x40, data: [0; 8] });
        bench.step();
        assert_eq!(bench.can.status().state, CanState::BusOff);
        event(Event::Frame { id: 0x123, payload: Payload::new() });
        bench.step();
        assert_eq!(bench.can.status().state, CanState::Active);
    }

    #[test]
    fn a_controller_that_is_off_the_bus_when_it_is_opened_is_waited_for() {
        let mut bench = Bench::new();
        // The driver told of it before anybody listened, and takes frames all the same.
        wire(|wire| wire.carrier = Some(false));
        bench.can.bus = None;
        (0..6).for_each(|_| bench.settle());
        assert_eq!(bench.can.status().state, CanState::BusOff);
        (0..2).for_each(|_| bench.parcel());
        bench.settle();
        assert!(Bench::received().is_empty());
        wire(|wire| wire.carrier = Some(true));
        (0..4).for_each(|_| bench.settle());
        assert_eq!((bench.can.status().state, bench.can.status().bus_offs), (CanState::Active, 1));
        assert_eq!(Bench::received(), [1, 2]);
    }

    #[test]
    fn a_frame_that_the_interface_never_takes_is_counted_and_holds_up_nothing() {
        let mut bench = Bench::new();
        wire(|wire| wire.error = Some(rustix::io::Errno::INVAL.raw_os_error()));
        bench.parcel();
        wire(|wire| wire.error = None);
        bench.settle();
        bench.parcel();
        bench.settle();
        assert!(bench.can.status().frames_refused > 0);
        assert_eq!(bench.can.status().state, CanState::Active);
        let last = WIRE.with_borrow(|wire| wire.sent.iter().rev().any(|(_, b)| b[..2] == [2, 0]));
        assert!(last, "the next parcel goes out");
    }

    #[test]
    fn every_command_is_answered_also_two_at_once_and_one_that_comes_again() {
        let mut bench = Bench::new();
        for ticket in [7, 8, 8] {
            let payload = Payload::from_slice(&[0, ticket, 0, 2, 0, 0, 0, 0]).expect("short");
            wire(|wire| wire.coming.push_back(Event::Frame { id: 0x508, payload }));
        }
        bench.step();
        let answers = WIRE.with_borrow(|wire| {
            let results = wire.sent.iter().filter(|(id, _)| *id == 0x504);
            results.map(|(_, bytes)| bytes[1]).collect::<Vec<_>>()
        });
        assert_eq!(answers, [7, 8, 8]);
    }

    #[test]
    fn an_interface_that_goes_and_comes_back_is_used_again() {
        let mut bench = Bench::new();
        bench.parcel();
        for gone in [rustix::io::Errno::NETDOWN, rustix::io::Errno::NODEV] {
            wire(|wire| wire.error = Some(gone.raw_os_error()));
            (0..20).for_each(|_| bench.step());
            assert_eq!(bench.can.status().state, CanState::Down);
            wire(|wire| wire.error = None);
            (0..200).for_each(|_| bench.step());
            assert_eq!(bench.can.status().state, CanState::Active);
        }
        assert_eq!(Bench::received(), [1, 1, 1]);
    }

    #[test]
    fn more_parcels_than_can_wait_are_counted() {
        let mut bench = Bench::new();
        wire(|wire| wire.error = Some(rustix::io::Errno::NETDOWN.raw_os_error()));
        bench.settle();
        (0..40).for_each(|_| bench.parcel());
        wire(|wire| wire.error = None);
        (0..200).for_each(|_| bench.step());
        assert!(Bench::received().into_iter().eq(9..=40));
        assert_eq!(bench.link.status().can.parcels_dropped, 8);
    }

    #[test]
    fn commands_counts_and_heartbeats_come_in_and_outcomes_go_out() {
        let mut bench = Bench::new();
        let frame = |id: u16, bytes: &[u8]| {
            let payload = Payload::from_slice(bytes).expect("short");
            wire(|wire| wire.coming.push_back(Event::Frame { id, payload }));
        };
        frame(0x508, &[0, 7, 0, 2, 0, 0, 0, 0]);
        frame(0x509, &[0, 0, 1, 0]);
        frame(0x509, &[0, 1]);
        frame(0x7ff, &[1; 8]);
        frame(0x000, &[1; 8]);
        bench.step();
        bench.step();
        assert!(bench.link.next_request().is_some());
        assert_eq!(bench.link.next_count().map(|(count, _)| count), Some(256));
        assert_eq!(bench.link.next_count(), None);
        let answered = WIRE.with_borrow(|wire| wire.sent.contains(&(0x504, vec![0, 7, 0, 1])));
        assert!(answered);
    }

    #[test]
    fn error_passive_and_its_counters_are_shown() {
        let mut bench = Bench::new();
        let data = [0, 0x20, 0, 0, 0, 0, 136, 3];
        wire(|wire| wire.coming.push_back(Event::Error { class: 0x204, data }));
        bench.step();
        let status = bench.can.status();
        assert_eq!(status.state, CanState::Passive);
        assert_eq!((status.transmit_errors, status.receive_errors), (136, 3));
    }

    #[test]
    fn a_million_frames_of_anything_do_no_harm() {
        let mut bench = Bench::new();
        let mut state = 1u64;
        let mut random = move || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as u32
        };
        for n in 0..1_000_000u32 {
            let bytes: Vec<u8> = (0..random() % 65).map(|_| random() as u8).collect();
            let payload = Payload::from_slice(&bytes).expect("at most 64");
            let event = match random() % 8 {
                0 => Event::Error {
                    class: random() & 0x3ff,
                    data: random().to_be_bytes().repeat(2).try_into().expect("8"),
                },
                1 => Event::Other,
                2 => Event::Frame { id: random() as u16, payload },
                _ => Event::Frame { id: 0x500 + (random() % 16) as u16, payload },
            };
            wire(|wire| {
                wire.coming.push_back(event);
                wire.sent.clear();
            });
            if n % 100 == 0 {
                bench.step();
                while bench.link.next_request().is_some() {}
            }
        }
        (0..400).for_each(|_| bench.step());
        wire(|wire| wire.coming.push_back(Event::Error { class: 0x100, data: [0; 8] }));
        bench.step();
        let before = bench.link.status().sequence;
        wire(|wire| wire.sent.clear());
        bench.parcel();
        (0..100).for_each(|_| bench.step());
        assert!(Bench::received().contains(&(before + 1)), "it still works");
    }
}
