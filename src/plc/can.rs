//! CAN through the kernel's socket: parcels and status out, commands and encoder counts in.
//!
//! Never waits: a bus that takes no frame is tried again at the next step. One parcel at a time
//! is turned into frames; others wait in the link. After bus off, and after the interface was down,
//! the last parcels are sent again, for the controller may have forgotten their frames.

use super::frames::{self, Frame, Message, Payload, Received};
use super::link::{Link, Outcome, REPEATED};
use super::registers::{CanState, CanStatus};
use crate::config::Can as Settings;
use crate::event::ParcelRecord;
use heapless::Deque;
use socketcan::{
    CanAnyFrame, CanDataFrame, CanFdFrame, CanFdSocket, EmbeddedFrame, Frame as _, Socket,
    SocketOptions, StandardId,
};
use std::io::{Error, ErrorKind};
use std::time::{Duration, Instant};

const HEARTBEAT_PERIOD: Duration = Duration::from_millis(100);
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// An interface that is not there is looked for this often.
const REOPEN_PERIOD: Duration = Duration::from_secs(1);
/// Frames of one parcel, or of the status block.
const OUTGOING_MAX: usize = 32;
/// Frames sent in one step, of 2 ms: a quarter of what a bus of 500 kbit/s carries, so that others get
/// their turn and a receiver with a short buffer keeps up. A parcel is out in 10 ms.
const SENT_MAX: usize = 2;
/// Frames taken in one step: a flood does not hold up the rest.
const RECEIVED_MAX: usize = 128;
/// What a bus brings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// A data frame with a standard identifier.
    Frame {
        /// Its identifier.
        id: u16,
        /// Its bytes.
        payload: Payload,
    },
    /// An error frame of the driver, `linux/can/error.h`.
    Error {
        /// Classes of errors, as bits.
        class: u32,
        /// Details.
        data: [u8; 8],
    },
    /// Something that is none of ours.
    Other,
}

/// A CAN bus: the kernel's, or a test's.
pub trait Bus: Sized {
    /// Open an interface.
    fn open(interface: &str) -> std::io::Result<Self>;
    /// Send a frame, or fail at once with [`ErrorKind::WouldBlock`] or `ENOBUFS`.
    fn send(&mut self, id: u16, payload: &[u8], fd: bool) -> std::io::Result<()>;
    /// The next event, [`ErrorKind::WouldBlock`] when there is none.
    fn receive(&mut self) -> std::io::Result<Event>;
}

impl Bus for CanFdSocket {
    fn open(interface: &str) -> std::io::Result<Self> {
        let socket = <Self as Socket>::open(interface)?;
        socket.set_nonblocking(true)?;
        socket.set_error_filter_accept_all()?;
        Ok(socket)
    }

    fn send(&mut self, id: u16, payload: &[u8], fd: bool) -> std::io::Result<()> {
        let wrong = || Error::from(ErrorKind::InvalidInput);
        let id = StandardId::new(id).ok_or_else(wrong)?;
        if fd {
            self.write_frame(&CanFdFrame::new(id, payload).ok_or_else(wrong)?)
        } else {
            self.write_frame(&CanDataFrame::new(id, payload).ok_or_else(wrong)?)
        }
    }

    fn receive(&mut self) -> std::io::Result<Event> {
        let data = |id: u32, extended: bool, bytes: &[u8]| {
            if extended {
                return Event::Other;
            }
            // A frame of the kernel has at most 64 bytes.
            Payload::from_slice(bytes)
                .map_or(Event::Other, |payload| Event::Frame { id: id as u16, payload })
        };
        Ok(match self.read_frame()? {
            CanAnyFrame::Normal(frame) => data(frame.raw_id(), frame.is_extended(), frame.data()),
            CanAnyFrame::Fd(frame) => data(frame.raw_id(), frame.is_extended(), frame.data()),
            CanAnyFrame::Remote(_) => Event::Other,
            CanAnyFrame::Error(frame) => {
                let mut bytes = [0; 8];
                for (byte, value) in bytes.iter_mut().zip(frame.data()) {
                    *byte = *value;
                }
                Event::Error { class: frame.error_bits(), data: bytes }
            }
        })
    }
}

/// The appliance on a CAN bus.
pub struct CanLink<B> {
    settings: Settings,
    bus: Option<B>,
    status: CanStatus,
    outgoing: Deque<Frame, OUTGOING_MAX>,
    recent: Deque<ParcelRecord, REPEATED>,
    /// Parcels of `recent` that are to be sent again.
    repeat: usize,
    counter: u8,
    ticket: u16,
    heartbeat_due: Instant,
    status_due: Instant,
    open_due: Instant,
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
            counter: 0,
            ticket: 0,
            heartbeat_due: now,
            status_due: now,
            open_due: now,
        }
    }

    /// State and counters.
    pub fn status(&self) -> CanStatus {
        self.status
    }

    /// Take what has come, send what is due.
    pub fn step(&mut self, link: &mut Link, now: Instant) {
        let Some(interface) = &self.settings.interface else { return };
        if self.bus.is_none() && now >= self.open_due {
            self.open_due = now + REOPEN_PERIOD;
            match B::open(interface) {
                Ok(bus) => {
                    tracing::info!(interface, "CAN interface opened");
                    self.bus = Some(bus);
                    self.status.state = CanState::Active;
                }
                Err(error) => self.lost(&error),
            }
        }
        self.receive(link, now);
        self.send(link, now);
    }

    /// The interface is down or gone.
    fn lost(&mut self, error: &Error) {
        if self.status.state != CanState::Down {
            tracing::error!(interface = self.settings.interface, %error, "CAN interface lost");
            self.status.state = CanState::Down;
            self.repeat = self.recent.len();
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
                        self.status.state = CanState::Active;
                    }
                    match frames::decode(id.wrapping_sub(self.settings.base_id), &payload) {
                        Some(Received::Command(ticket, command, argument)) => {
                            link.command(ticket, command, argument);
                        }
                        Some(Received::Encoder(count)) => link.count(count, now),
                        Some(Received::Heartbeat(value)) => link.heartbeat(value, now),
                        None => {}
                    }
                }
                Ok(Event::Error { class, data }) => self.error(class, data),
                Ok(Event::Other) => {}
                Err(error) if would_block(&error) => return,
                Err(error) => return self.lost(&error),
            }
        }
    }

    /// Error frames, `linux/can/error.h`.
    fn error(&mut self, class: u32, data: [u8; 8]) {
        const CONTROLLER: u32 = 0x04;
        const ACKNOWLEDGE: u32 = 0x20;
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
            if status.state != CanState::BusOff {
                status.bus_offs += 1;
                self.repeat = self.recent.len();
                tracing::error!(interface = self.settings.interface, "CAN bus off");
            }
            status.state = CanState::BusOff;
        } else if class & RESTARTED != 0 || class & CONTROLLER != 0 && data[1] & ACTIVE != 0 {
            status.state = CanState::Active;
        } else if class & ACKNOWLEDGE != 0 || class & CONTROLLER != 0 && data[1] & PASSIVE != 0 {
            status.state = CanState::Passive;
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
                        tracing::info!(interface = self.settings.interface, "CAN is back");
                        self.status.state = CanState::Active;
                    }
                }
                Err(error) if would_block(&error) => return,
                Err(error) => return self.lost(&error),
            }
        }
    }

    /// What is most urgent: a parcel, then an outcome, then what is due.
    fn next_frames(&mut self, link: &mut Link, now: Instant) {
        let outgoing = &mut self.outgoing;
        // invariant: a message has fewer frames than there is room for
        let mut emit = |frame: Frame| drop(outgoing.push_back(frame));
        let reachable = matches!(self.status.state, CanState::Active | CanState::Passive);
        if reachable && self.repeat > 0 {
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
        } else if link.status().ticket != self.ticket {
            self.ticket = link.status().ticket;
            if link.status().outcome != Outcome::None as u16 {
                frames::result(link.status(), emit);
            }
        } else if now >= self.heartbeat_due {
            self.heartbeat_due = now + HEARTBEAT_PERIOD;
            frames::heartbeat(link.status(), emit);
        } else if now >= self.status_due {
            self.status_due = now + STATUS_PERIOD;
            self.counter = self.counter.wrapping_add(1);
            frames::status(link.status(), self.counter, &mut emit);
        }
    }
}

/// The bus takes or has no frame at the moment.
fn would_block(error: &Error) -> bool {
    let no_buffers = rustix::io::Errno::NOBUFS.raw_os_error();
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted)
        || error.raw_os_error() == Some(no_buffers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Plc, WordOrder};
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
    }

    thread_local! {
        static WIRE: RefCell<Wire> = RefCell::default();
    }

    struct TestBus;

    impl Bus for TestBus {
        fn open(_: &str) -> std::io::Result<Self> {
            WIRE.with_borrow(|wire| {
                wire.error.map_or(Ok(Self), |e| Err(Error::from_raw_os_error(e)))
            })
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
            let link = Link::new(Plc::default(), WordOrder::HighFirst, Journal::default(), now);
            Self { link, can: CanLink::new(settings, now), now }
        }

        /// 10 ms later, in visits of 2 ms.
        fn step(&mut self) {
            for _ in 0..5 {
                self.now += Duration::from_millis(2);
                self.link.update(&VisionStatus::default(), &self.can.status(), None, self.now);
                self.can.step(&mut self.link, self.now);
            }
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
        let error = |class, data| wire(|wire| wire.coming.push_back(Event::Error { class, data }));
        error(0x40, [0; 8]);
        wire(|wire| wire.room = 0);
        bench.step();
        assert_eq!((bench.can.status().state, bench.can.status().bus_offs), (CanState::BusOff, 1));
        (0..2).for_each(|_| bench.parcel());
        error(0x100, [0; 8]);
        wire(|wire| wire.room = usize::MAX);
        (0..8).for_each(|_| bench.step());
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
        (0..40).for_each(|_| bench.parcel());
        wire(|wire| wire.error = None);
        (0..200).for_each(|_| bench.step());
        // One was on its way; of the others 32 could wait.
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
