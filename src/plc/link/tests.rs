use super::*;
use crate::plc::command::Sender;
use crate::plc::record;
use crate::plc::registers::COMMAND;
use crate::plc::registers::{LATEST, QUEUE_HEAD, RING};
use crate::plc::table::join;

const SENDER: Sender = Sender::Can;

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
        link.write(COMMAND + 1, &[acknowledged], SENDER, Instant::now()).expect("known");
        assert_eq!(sequence_at(&link, QUEUE_HEAD), head, "after {acknowledged}");
    }
    assert_eq!(link.status().queue_overflows, 0);
}

#[test]
fn a_parcel_that_was_never_published_cannot_be_acknowledged() {
    let mut link = link(queueing());
    publish(&mut link, 2);
    assert_eq!(link.write(COMMAND + 1, &[3], SENDER, Instant::now()), Err(Refusal::Value));
    assert_eq!((sequence_at(&link, QUEUE_HEAD), link.status().queued), (1, 2));
    link.command(1, 1, 9, SENDER);
    assert_eq!(link.status().outcome, Outcome::Argument as u16);
}

#[test]
fn an_unknown_acknowledgment_in_a_write_of_the_whole_block_is_left_out() {
    let mut link = link(queueing());
    publish(&mut link, 2);
    link.write(COMMAND, &[9, 500, 0, 77, 0, 0, 0, 0], SENDER, Instant::now()).expect("taken");
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
    link.write(COMMAND + 1, &[2], SENDER, Instant::now()).expect("was published");
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
fn every_command_is_told_with_its_outcome_and_too_many_are_counted() {
    let mut link = link(Settings::default());
    let give = |link: &mut Link, ticket: u16, command: u16| {
        let registers = [ticket, command, 0, 50];
        link.write(COMMAND + 4, &registers, SENDER, Instant::now()).expect("inside");
    };
    // All between two visits of those who watch.
    for (ticket, command) in [(7, 5), (8, 99), (8, 99), (0, 0), (9, 5)] {
        give(&mut link, ticket, command);
    }
    let told = std::iter::from_fn(|| link.next_commanded());
    let told: Vec<_> = told.map(|c| (c.ticket, c.command, c.outcome)).collect();
    let (done, unknown) = (Outcome::Done as u16, Outcome::Unknown as u16);
    assert_eq!(told, [(7, 5, done), (8, 99, unknown), (9, 5, done)]);
    for ticket in 10..110 {
        give(&mut link, ticket, 5);
    }
    assert_eq!(std::iter::from_fn(|| link.next_commanded()).count(), COMMANDED_MAX);
    assert_eq!(link.commands_untold(), 100 - COMMANDED_MAX as u64);
}

#[test]
fn a_command_is_carried_out_once_for_each_ticket() {
    let mut link = link(Settings::default());
    let mut command = |ticket: u16, command: u16, argument: u16| {
        let registers = [ticket, command, 0, argument];
        link.write(COMMAND + 4, &registers, SENDER, Instant::now()).expect("inside");
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
    for ticket in 20..30 {
        link.command(ticket, 2, 0, SENDER);
    }
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
        let refused = link.write(address, &vec![5; count], SENDER, Instant::now());
        assert_eq!(refused, Err(Refusal::Address), "{address} {count}");
    }
    assert_eq!(all(&link), before);
    link.write(COMMAND, &[1, 0, 0, 7, 0, 0, 0, 0], SENDER, Instant::now())
        .expect("the whole block");
    assert_eq!(link.next_count().map(|(count, _)| count), Some(7));
}

#[test]
fn a_heartbeat_that_stands_still_is_noticed() {
    let mut link = link(Settings { heartbeat_timeout_s: 1.0, ..Settings::default() });
    let start = Instant::now();
    let mut silent = |value: Option<u16>, ms: u64| {
        let now = start + Duration::from_millis(ms);
        if let Some(value) = value {
            link.write(COMMAND, &[value], SENDER, now).expect("inside");
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
    link.journal.change(|state| state.sequence = u32::MAX - 1);
    link.status.sequence = u32::MAX - 1;
    publish(&mut link, 3);
    assert_eq!((link.status().sequence, sequence_at(&link, QUEUE_HEAD)), (2, u32::MAX));
    link.write(COMMAND + 1, &[1], SENDER, Instant::now()).expect("published");
    assert_eq!(sequence_at(&link, QUEUE_HEAD), 2);
}

#[test]
fn a_ticket_that_was_used_for_another_command_is_refused_with_the_reason() {
    let mut link = link(Settings::default());
    link.command(1, 4, 0, SENDER);
    link.command(1, 3, 0, SENDER);
    let status = link.status();
    assert_eq!((status.ticket, status.outcome), (1, Outcome::TicketUsed as u16));
    assert!(status.stopped);
    // What was done stays done, and is told to who repeats it.
    link.command(1, 4, 0, SENDER);
    assert_eq!(link.status().outcome, Outcome::Done as u16);
    // A PLC that starts writes 0 first: then it may begin with any ticket.
    link.command(0, 0, 0, SENDER);
    link.command(1, 3, 0, SENDER);
    let status = link.status();
    assert_eq!((status.ticket, status.outcome, status.stopped), (1, Outcome::Done as u16, false));
}

/// A link on a disk, as after a restart.
fn on_disk(path: &std::path::Path, settings: Settings) -> Link {
    let journal = Journal::open(path).expect("a file of ours");
    Link::new(settings, WordOrder::HighFirst, false, journal, Instant::now())
}

fn wait_until_kept(link: &mut Link, noted: u64) {
    while !link.is_kept(noted) {
        std::thread::sleep(Duration::from_millis(1));
    }
    link.flush();
}

#[test]
fn a_restart_neither_repeats_a_command_nor_forgets_it() {
    let path = std::env::temp_dir().join(format!("beltgauge-ticket-{}", std::process::id()));
    let _ = std::fs::remove_file(&path);
    let mut link = on_disk(&path, Settings::default());
    let noted = link.command(7, 4, 0, SENDER).noted;
    assert_eq!(link.status().ticket, 0, "not told before the disk has it");
    wait_until_kept(&mut link, noted);
    assert_eq!((link.status().ticket, link.next_request()), (7, Some(Request::Report(false))));
    let noted = link.command(8, 5, 50, SENDER).noted;
    wait_until_kept(&mut link, noted);
    let noted = link.command(9, 2, 0, SENDER).noted;
    wait_until_kept(&mut link, noted);
    assert_eq!(link.next_request(), Some(Request::Learn));
    drop(link);
    let mut link = on_disk(&path, Settings::default());
    // A PLC that writes its whole block all the time.
    link.command(9, 2, 0, SENDER);
    let status = link.status();
    assert_eq!((status.ticket, status.outcome), (9, Outcome::Done as u16));
    assert!(status.stopped && (status.scale_interval_mm - 5.0).abs() < 1e-9);
    assert_eq!(link.next_request(), Some(Request::Report(false)), "still stopped");
    assert_eq!(link.next_request(), None, "not learned again");
    drop(link);
    // A configuration that says something else since then outdoes the command.
    let changed = Settings { scale_interval_mm: 1.0, ..Settings::default() };
    assert!((on_disk(&path, changed).status().scale_interval_mm - 1.0).abs() < 1e-9);
    let _ = std::fs::remove_file(&path);
}

#[test]
fn a_disk_that_fails_is_told_and_holds_nobody_up() {
    let path = std::env::temp_dir().join(format!("beltgauge-gone-{}/state", std::process::id()));
    let mut link = on_disk(&path, queueing());
    publish(&mut link, 3);
    let first = sequence_at(&link, QUEUE_HEAD);
    assert!(first > 0xffff && link.status().queued == 3);
    assert_eq!((link.status().reason(), link.status().fault_bits() & 64), (2, 64));
    let noted = link.write(COMMAND + 1, &[first as u16], SENDER, Instant::now()).expect("known");
    assert!(link.is_kept(noted));
    assert_eq!(sequence_at(&link, QUEUE_HEAD), first + 1);
    link.command(3, 4, 0, SENDER);
    assert_eq!(link.status().ticket, 3);
}

#[test]
fn the_encoder_s_scale_is_corrected_by_the_belt_and_stays_so() {
    let path = std::env::temp_dir().join(format!("beltgauge-scale-{}", std::process::id()));
    let _ = std::fs::remove_file(&path);
    let mut link = on_disk(&path, Settings::default()).with_encoder(Some(0.05));
    assert_eq!(link.command(1, 6, 0, SENDER).outcome, Outcome::NotKnown as u16);
    let mut vision = VisionStatus::default();
    vision.belt.encoder_ratio = Some(1.25);
    vision.belt.encoder_disagrees = true;
    link.update(&vision, &CanStatus::default(), None, Instant::now());
    assert_eq!(link.status().fault_bits() & 128, 128);
    assert_eq!(link.read(72, 5), Some(&[12500, 0, 50000, 0, 40000][..]));
    // One that counts the other way is told as such, and no scale for command 6 to correct.
    vision.belt.encoder_ratio = Some(-1.0);
    link.update(&vision, &CanStatus::default(), None, Instant::now());
    assert_eq!(link.read(72, 1), Some(&[(-10_000i16) as u16][..]));
    vision.belt.encoder_ratio = Some(1.25);
    link.update(&vision, &CanStatus::default(), None, Instant::now());
    let noted = link.command(2, 6, 0, SENDER).noted;
    wait_until_kept(&mut link, noted);
    assert_eq!(link.next_request(), Some(Request::MmPerCount(0.04)));
    // Vision has not heard of it yet: the old ratio does not correct twice.
    link.update(&vision, &CanStatus::default(), None, Instant::now());
    assert_eq!(link.command(3, 6, 0, SENDER).outcome, Outcome::NotKnown as u16);
    link.flush();
    drop(link);
    let mut link = on_disk(&path, Settings::default()).with_encoder(Some(0.05));
    assert_eq!(link.next_request(), Some(Request::MmPerCount(0.04)));
    drop(link);
    // A configuration that was corrected since then outdoes the command.
    let mut link = on_disk(&path, Settings::default()).with_encoder(Some(0.041));
    assert_eq!(link.next_request(), None);
    let _ = std::fs::remove_file(&path);
}

#[test]
fn what_turns_up_with_the_state_file_waits_to_be_acknowledged_and_holds_again() {
    let folder = std::env::temp_dir().join(format!("beltgauge-met-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(folder.join("mounted")).expect("writable");
    let path = folder.join("mounted/state");
    let start = || {
        let journal = Journal::open(&path).expect("ours");
        Link::new(queueing(), WordOrder::HighFirst, false, journal, Instant::now())
    };
    let update = |link: &mut Link| {
        link.update(&VisionStatus::default(), &CanStatus::default(), None, Instant::now());
    };
    // Whatever the disk waits for.
    let until = |link: &mut Link, holds: &dyn Fn(&Link) -> bool| {
        let begun = Instant::now();
        while !holds(link) {
            assert!(begun.elapsed().as_secs() < 20, "{:?}", link.status());
            std::thread::sleep(Duration::from_millis(2));
            update(link);
        }
    };
    let mut link = start();
    publish(&mut link, 2);
    until(&mut link, &|link| link.status().queued == 2);
    link.command(9, 4, 0, SENDER);
    until(&mut link, &|link| link.status().stopped);
    drop(link);
    std::fs::rename(folder.join("mounted"), folder.join("away")).expect("renamed");
    let mut link = start();
    publish(&mut link, 1);
    let new = sequence_at(&link, QUEUE_HEAD);
    assert!(new > 0xffff && !link.status().stopped, "{new}");
    std::fs::rename(folder.join("away"), folder.join("mounted")).expect("renamed");
    until(&mut link, &|link| link.status().keeping == Keeping::Disk);
    let status = link.status();
    assert_eq!((status.boots, status.ticket, status.stopped), (2, 9, true));
    assert_eq!(link.next_request(), Some(Request::Report(false)));
    assert_eq!(sequence_at(&link, QUEUE_HEAD), 1);
    for (acknowledged, head) in [(1, 2), (2, new), (new as u16, 0)] {
        link.write(COMMAND + 1, &[acknowledged], SENDER, Instant::now()).expect("known");
        assert_eq!(sequence_at(&link, QUEUE_HEAD), head, "after {acknowledged}");
    }
    std::fs::remove_dir_all(&folder).expect("removed");
}

#[test]
fn a_sender_that_finds_the_disk_hanging_is_told_so_of_its_own_ticket() {
    let mut link = link(Settings::default());
    let (ticket, outcome) = (6, Outcome::Done);
    while !link.decided.is_full() {
        let _ = link.decided.push_back(Decided {
            noted: 0,
            ticket,
            outcome,
            request: None,
            given: None,
        });
    }
    // A PLC writes it again and again; those who watch are told once.
    for _ in 0..100 {
        let answer = link.command(77, 3, 0, SENDER);
        assert_eq!((answer.ticket, answer.outcome), (77, Outcome::Busy as u16));
        link.command(0, 0, 0, SENDER);
    }
    let told = |link: &mut Link| -> Vec<_> {
        std::iter::from_fn(|| link.next_commanded()).map(|c| (c.ticket, c.outcome)).collect()
    };
    assert_eq!(told(&mut link), [(77, Outcome::Busy as u16)]);
    // Nothing was noted of it: the same ticket may come again.
    link.publish_kept();
    assert_eq!(link.command(77, 3, 0, SENDER).outcome, Outcome::Done as u16);
    link.publish_kept();
    // The ticket was used for another command by then.
    link.command(77, 4, 0, SENDER);
    link.command(77, 4, 0, SENDER);
    let outcomes = [Outcome::Done, Outcome::TicketUsed].map(|outcome| (77, outcome as u16));
    assert_eq!(told(&mut link), outcomes);
}
