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
        WIRE.with_borrow(|wire| wire.error.map_or(Ok(Self), |e| Err(Error::from_raw_os_error(e))))
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
        let link = Link::new(Plc::default(), WordOrder::HighFirst, true, Journal::default(), now);
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
    let beats = WIRE.with_borrow(|wire| wire.sent.iter().filter(|(id, _)| *id == 0x500).count());
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
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
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
