//! Disks that fill up, break and lose power.

use super::segment::{HEAD_BYTES, list};
use super::writer::Space;
use super::*;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(10);
const MIB: u64 = 1 << 20;

fn folder(name: &str) -> PathBuf {
    let folder =
        std::env::temp_dir().join(format!("beltgauge-archive-{name}-{}", std::process::id()));
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("room");
    folder
}

/// On a disk with room, however full the disk is that the tests run on.
fn start(folder: &Path, bytes_max: u64) -> crate::error::Result<Archive> {
    Archive::start_on(folder, bytes_max, |_| Ok(Space { all: 2048 * MIB, free: 1024 * MIB }))
}

fn entry(i: u64, bytes: usize) -> Entry {
    Entry {
        kind: Kind::Parcel,
        utc_ms: 1_795_000_000_000 + i,
        text: format!("{{\"seq\":{i}}}"),
        picture: vec![i as u8; bytes],
    }
}

/// Write entries one at a time, so that the ring never fills.
fn write(archive: &Archive, entries: impl Iterator<Item = Entry>) {
    for entry in entries {
        let before = archive.condition();
        archive.put(entry);
        let start = Instant::now();
        while archive.condition().written + archive.condition().lost == before.written + before.lost
        {
            assert!(start.elapsed() < PATIENCE, "the writer does nothing");
            std::thread::yield_now();
        }
    }
}

fn newest(folder: &Path) -> PathBuf {
    list(folder).expect("readable").pop().expect("a segment").1
}

#[test]
fn what_was_written_is_read_again_newest_first_and_the_chain_holds() {
    let folder = folder("whole");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, (1..=120).map(|i| entry(i, 100_000)));
    archive.finish(PATIENCE);
    assert!(list(&folder).expect("readable").len() > 1, "several segments");
    let reader = Reader::open(&folder).expect("there");
    let verdict = reader.verify().expect("readable");
    assert_eq!((verdict.entries, verdict.first, verdict.last), (120, Some(1), Some(120)));
    assert!(verdict.broken.is_empty() && verdict.torn_bytes == 0, "{:?}", verdict.broken);
    let numbers = |before, limit| {
        let found = reader.before(before, limit).expect("readable");
        assert!(found.unread.is_empty(), "{found:?}");
        found.entries.iter().map(|stored| stored.number).collect::<Vec<_>>()
    };
    assert_eq!(numbers(None, 3), [120, 119, 118]);
    assert_eq!(numbers(Some(85), 100), (1..85).rev().collect::<Vec<_>>(), "over segments");
    assert!(numbers(Some(1), 10).is_empty());
    assert_eq!(reader.entry(77).expect("readable").expect("there").entry, entry(77, 100_000));
    assert_eq!(reader.entry(121).expect("readable"), None);
}

#[test]
fn it_goes_on_where_it_ended_and_the_oldest_go_first() {
    let folder = folder("goes-on");
    for run in 0..3 {
        let archive = start(&folder, 16 * MIB).expect("starts");
        write(&archive, (1..=100).map(|i| entry(100 * run + i, 100_000)));
        let condition = archive.condition();
        assert!(condition.bytes <= 16 * MIB && condition.lost == 0, "{condition:?}");
        archive.finish(PATIENCE);
    }
    let on_disk: u64 = list(&folder)
        .expect("readable")
        .iter()
        .map(|(_, path)| fs::metadata(path).expect("there").len())
        .sum();
    assert!(on_disk <= 16 * MIB && on_disk > 12 * MIB, "{on_disk}");
    let verdict = Reader::open(&folder).expect("there").verify().expect("readable");
    assert_eq!(verdict.last, Some(300));
    assert!(verdict.first > Some(100) && verdict.broken.is_empty(), "{verdict:?}");
}

#[test]
fn a_power_cut_at_any_byte_costs_the_entry_that_was_being_written_and_nothing_else() {
    let folder = folder("power");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, (1..=5).map(|i| entry(i, 40)));
    archive.finish(PATIENCE);
    let path = newest(&folder);
    let whole = fs::read(&path).expect("there");
    let entry_bytes = (whole.len() - HEAD_BYTES) / 5;
    for length in 0..=whole.len() {
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("room");
        fs::write(&path, &whole[..length]).expect("room");
        let left = length.saturating_sub(HEAD_BYTES) / entry_bytes;
        let archive = start(&folder, 64 * MIB).expect("starts");
        write(&archive, (101..=102).map(|i| entry(i, 40)));
        archive.finish(PATIENCE);
        let reader = Reader::open(&folder).expect("there");
        let verdict = reader.verify().expect("readable");
        assert_eq!(verdict.entries, left as u64 + 2, "cut at {length}");
        assert_eq!(verdict.last, Some(left as u64 + 2), "cut at {length}");
        assert!(verdict.broken.is_empty(), "cut at {length}: {:?}", verdict.broken);
    }
}

#[test]
fn a_changed_a_missing_and_a_swapped_entry_show() {
    let folder = folder("changed");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, (1..=250).map(|i| entry(i, 100_000)));
    archive.finish(PATIENCE);
    let reader = Reader::open(&folder).expect("there");
    let broken = || reader.verify().expect("readable").broken;
    assert!(broken().is_empty());
    let segments = list(&folder).expect("readable");
    assert!(segments.len() >= 3, "{}", segments.len());
    let middle = &segments[1].1;
    let bytes = fs::read(middle).expect("there");
    for at in [20, HEAD_BYTES + 9, HEAD_BYTES + 40, bytes.len() - 1] {
        let mut changed = bytes.clone();
        changed[at] ^= 1;
        fs::write(middle, &changed).expect("room");
        assert!(!broken().is_empty(), "byte {at}");
    }
    fs::remove_file(middle).expect("there");
    assert!(!broken().is_empty(), "a segment is missing");
    fs::write(middle, &bytes).expect("room");
    assert!(broken().is_empty(), "as it was");
}

#[test]
fn a_disk_that_does_not_obey_costs_entries_that_are_counted_and_told() {
    let folder = folder("fails");
    // A file where the folder should be: nothing can be written there.
    let inside = folder.join("archive");
    fs::write(&inside, "in the way").expect("room");
    let archive = start(&inside, 64 * MIB).expect("starts all the same");
    write(&archive, (1..=3).map(|i| entry(i, 10)));
    let condition = archive.condition();
    assert_eq!((condition.written, condition.lost), (0, 3));
    assert!(condition.fault.is_some());
    fs::remove_file(&inside).expect("there");
    let start = Instant::now();
    while archive.condition().fault.is_some() {
        assert!(start.elapsed() < PATIENCE, "it is not tried again");
        std::thread::sleep(Duration::from_millis(20));
    }
    write(&archive, std::iter::once(entry(4, 10)));
    archive.finish(PATIENCE);
    let verdict = Reader::open(&inside).expect("there").verify().expect("readable");
    assert_eq!((verdict.entries, verdict.told_lost), (2, 3), "the gap and the parcel");
}

#[test]
fn more_entries_than_the_ring_holds_are_counted_and_nobody_waits() {
    let folder = folder("ring");
    let inside = folder.join("pipe");
    fs::create_dir(&inside).expect("room");
    // Opening a pipe waits for ever: the slowest disk there is.
    let pipe = std::process::Command::new("mkfifo").arg(inside.join("lock")).status();
    assert!(pipe.is_ok_and(|status| status.success()));
    let archive = start(&inside, 64 * MIB).expect("starts");
    (1..=1000).for_each(|i| archive.put(entry(i, 10)));
    let condition = archive.condition();
    // One may be in the writer's hands.
    assert!(condition.written == 0 && (935..=936).contains(&condition.lost), "{condition:?}");
    archive.finish(Duration::from_millis(1));
}

static DISK_ANSWERS: [AtomicBool; 2] = [const { AtomicBool::new(false) }; 2];

/// A disk for each test that has one.
fn disk_that_hangs<const DISK: usize>(folder: &Path) -> std::io::Result<Space> {
    while !DISK_ANSWERS[DISK].load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(1));
    }
    small_disk(folder)
}

#[test]
fn what_a_hanging_disk_cost_is_told_in_the_chain_too() {
    let folder = folder("hangs");
    let archive = Archive::start_on(&folder, 64 * MIB, disk_that_hangs::<0>).expect("starts");
    (1..=1000).for_each(|i| archive.put(entry(i, 10)));
    let lost = archive.condition().lost;
    assert!(lost > 900, "{lost}");
    DISK_ANSWERS[0].store(true, Ordering::Relaxed);
    archive.finish(PATIENCE);
    let verdict = Reader::open(&folder).expect("there").verify().expect("readable");
    assert_eq!(verdict.told_lost, lost, "{verdict:?}");
    // Twice told: what was lost before the first was written, and the rest.
    assert!((1..=2).contains(&(verdict.entries + lost - 1000)), "{verdict:?}");
}

#[test]
fn a_disk_that_does_not_answer_is_told_while_it_is_so_before_anything_is_lost() {
    let folder = folder("silent");
    let archive = Archive::start_on(&folder, 64 * MIB, disk_that_hangs::<1>).expect("starts");
    assert!(!archive.condition().is_bad());
    archive.put(entry(1, 10));
    let start = Instant::now();
    while !archive.condition().is_bad() {
        assert!(start.elapsed() < PATIENCE, "{:?}", archive.condition());
        std::thread::sleep(Duration::from_millis(10));
    }
    let condition = archive.condition();
    assert!(condition.lost == 0 && condition.fault.is_some(), "{condition:?}");
    DISK_ANSWERS[1].store(true, Ordering::Relaxed);
    while archive.condition().is_bad() {
        assert!(start.elapsed() < 2 * PATIENCE, "{:?}", archive.condition());
        std::thread::sleep(Duration::from_millis(10));
    }
    archive.finish(PATIENCE);
}

#[test]
fn two_processes_do_not_write_one_archive() {
    let folder = folder("two");
    let first = start(&folder, 64 * MIB).expect("starts");
    write(&first, std::iter::once(entry(1, 10)));
    let second = start(&folder, 64 * MIB).expect("starts");
    write(&second, std::iter::once(entry(2, 10)));
    assert!(second.condition().fault.is_some_and(|fault| fault.contains("another process")));
    first.finish(PATIENCE);
    second.finish(PATIENCE);
}

/// A disk of 64 MiB, as the flashed image's, on which everything else takes 10 MiB.
fn small_disk(folder: &Path) -> std::io::Result<Space> {
    let mut used = 10 * MIB;
    for (_, path) in list(folder)? {
        used += fs::metadata(path)?.len();
    }
    Ok(Space { all: 64 * MIB, free: (64 * MIB).saturating_sub(used) })
}

fn full_disk(folder: &Path) -> std::io::Result<Space> {
    small_disk(folder).map(|disk| Space { free: 20 * MIB, ..disk })
}

#[test]
fn it_leaves_room_on_a_disk_that_is_smaller_than_it_may_be() {
    let folder = folder("small");
    let archive = Archive::start_on(&folder, 2048 * MIB, small_disk).expect("starts");
    write(&archive, (1..=600).map(|i| entry(i, 100_000)));
    assert_eq!(archive.condition().lost, 0, "the oldest went instead");
    archive.finish(PATIENCE);
    let left = small_disk(&folder).expect("readable").free;
    assert!((24 * MIB..34 * MIB).contains(&left), "{left}");
    let verdict = Reader::open(&folder).expect("there").verify().expect("readable");
    assert!(verdict.last == Some(600) && verdict.broken.is_empty(), "{verdict:?}");
    let archive = Archive::start_on(&folder, 2048 * MIB, full_disk).expect("starts");
    write(&archive, std::iter::once(entry(601, 10)));
    let condition = archive.condition();
    assert!(condition.lost == 1 && condition.fault.is_some(), "{condition:?}");
    archive.finish(PATIENCE);
}

#[test]
fn a_large_disk_that_others_have_nearly_filled_takes_entries() {
    let folder = folder("large");
    let disk = |_: &Path| Ok(Space { all: 252 << 30, free: 300 * MIB });
    let archive = Archive::start_on(&folder, 64 * MIB, disk).expect("starts");
    write(&archive, (1..=5).map(|i| entry(i, 40)));
    assert!(!archive.condition().is_bad(), "{:?}", archive.condition());
    archive.finish(PATIENCE);
}

/// What verifying finds, and the newest entry's number.
fn verified(folder: &Path) -> (Verdict, u64) {
    let verdict = Reader::open(folder).expect("there").verify().expect("readable");
    let last = verdict.last.unwrap_or(0);
    (verdict, last)
}

#[test]
fn damage_in_the_newest_segment_is_no_power_cut_and_no_number_is_given_again() {
    let folder = folder("damaged");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, (1..=5).map(|i| entry(i, 40)));
    archive.finish(PATIENCE);
    let path = newest(&folder);
    let whole = fs::read(&path).expect("there");
    let entry_bytes = (whole.len() - HEAD_BYTES) / 5;
    // The segment's head; the head of the first, of a middle and of the last entry; sizes of two.
    let heads = [0, 2, 4].map(|i| HEAD_BYTES + i * entry_bytes);
    let places =
        [3, 10, HEAD_BYTES - 1, heads[0], heads[1], heads[2], heads[0] + 30, heads[1] + 25];
    for at in places {
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("room");
        let mut damaged = whole.clone();
        damaged[at] ^= 1;
        fs::write(&path, &damaged).expect("room");
        let (verdict, _) = verified(&folder);
        assert!(!verdict.broken.is_empty() && verdict.torn_bytes == 0, "byte {at}: {verdict:?}");
        let archive = start(&folder, 64 * MIB).expect("starts");
        write(&archive, std::iter::once(entry(6, 40)));
        let condition = archive.condition();
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
        assert!(condition.fault.is_none() && condition.damaged == name, "{condition:?}");
        archive.finish(PATIENCE);
        assert_eq!(fs::read(&path).expect("there"), damaged, "left as it was");
        let (verdict, last) = verified(&folder);
        assert!(!verdict.broken.is_empty(), "byte {at}: it is still told");
        assert!(last > 6, "byte {at}: number {last} may be another entry's");
        let reader = Reader::open(&folder).expect("there");
        let newest = reader.before(None, 2).expect("readable").entries;
        assert_eq!(newest[0].entry.text, entry(6, 40).text);
        assert!(newest[1].entry.text.contains("\"damaged\":\"0000"), "{newest:?}");
        let all = reader.before(None, 99).expect("readable");
        let [unread] = &all.unread[..] else { panic!("byte {at}: {all:?}") };
        assert!(unread.starts_with(&name.unwrap_or_default()), "byte {at}: {unread}");
    }
}

#[test]
fn a_tail_of_zeros_is_what_a_power_cut_leaves() {
    let folder = folder("zeros");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, (1..=3).map(|i| entry(i, 40)));
    archive.finish(PATIENCE);
    let path = newest(&folder);
    let mut bytes = fs::read(&path).expect("there");
    bytes.resize(bytes.len() + 10_000, 0);
    fs::write(&path, &bytes).expect("room");
    let (verdict, _) = verified(&folder);
    assert!(verdict.broken.is_empty() && verdict.torn_bytes == 10_000, "{verdict:?}");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, std::iter::once(entry(4, 40)));
    assert_eq!(archive.condition().damaged, None);
    archive.finish(PATIENCE);
    assert_eq!(verified(&folder).1, 4);
}

#[test]
fn what_cannot_be_read_is_passed_over_and_told() {
    let folder = folder("unreadable");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, (1..=3).map(|i| entry(i, 40)));
    archive.finish(PATIENCE);
    // A folder opens and cannot be read, as a file on a bad sector.
    fs::create_dir(folder.join(format!("{:020}.bga", 4))).expect("room");
    let archive = start(&folder, 64 * MIB).expect("starts");
    write(&archive, std::iter::once(entry(6, 40)));
    let condition = archive.condition();
    assert!(condition.written == 1 && condition.fault.is_none(), "{condition:?}");
    assert!(condition.damaged.is_some(), "{condition:?}");
    archive.finish(PATIENCE);
    let (verdict, last) = verified(&folder);
    assert!(verdict.entries == 5 && last > 5 && !verdict.broken.is_empty(), "{verdict:?}");
    let found =
        Reader::open(&folder).expect("there").before(None, 9).expect("the rest is readable");
    assert_eq!(found.entries.len(), 5);
    let [unread] = &found.unread[..] else { panic!("{:?}", found.unread) };
    assert!(unread.starts_with("00000000000000000004.bga: cannot be read: "), "{unread}");
}

/// Numbers of what follows, read so many at a time.
fn follow(follower: &mut Follower, limit: usize) -> Vec<u64> {
    let found = follower.read(limit).expect("readable");
    assert!(found.iter().all(|stored| stored.entry.picture.is_empty()));
    found.iter().map(|stored| stored.number).collect()
}

#[test]
fn a_follower_reads_every_entry_once_in_order_while_they_are_written() {
    let folder = folder("follow");
    let mut follower = Follower::after(&folder, 0);
    assert!(follow(&mut follower, 9).is_empty(), "nothing is there yet");
    let archive = start(&folder, 16 * MIB).expect("starts");
    let (mut read, mut written) = (Vec::<u64>::new(), 0);
    for (part, limit) in [(1, 64), (70, 7), (3, 1), (26, 64)] {
        write(&archive, (written + 1..=written + part).map(|i| entry(i, 100_000)));
        written += part;
        loop {
            let found = follow(&mut follower, limit);
            read.extend(&found);
            if found.len() < limit {
                break;
            }
        }
        assert_eq!(read, (1..=written).collect::<Vec<_>>());
    }
    assert!(list(&folder).expect("readable").len() > 1, "several segments");
    assert_eq!(follow(&mut Follower::after(&folder, 42), 3), [43, 44, 45]);
    assert!(follow(&mut Follower::after(&folder, written), 3).is_empty());
    archive.finish(PATIENCE);
}

#[test]
fn a_follower_passes_over_what_is_gone_torn_or_damaged() {
    let folder = folder("follow-gone");
    let archive = start(&folder, 16 * MIB).expect("starts");
    write(&archive, (1..=400).map(|i| entry(i, 100_000)));
    archive.finish(PATIENCE);
    let segments = list(&folder).expect("readable");
    let (oldest, second) = (segments[0].0, segments[1].0);
    assert!(oldest > 1, "the oldest are gone");
    assert_eq!(follow(&mut Follower::after(&folder, 0), 2), [oldest, oldest + 1]);
    // The head of its fourth entry: what is behind it is not found. Before that, a picture.
    let fourth = fs::read(&segments[0].1).expect("there");
    let is_head = |at: &usize| fourth[*at..].starts_with(b"BGEN");
    let at = (0..fourth.len()).filter(is_head).nth(3).expect("more than three") as u64;
    let damaged = fs::OpenOptions::new().write(true).open(&segments[0].1).expect("there");
    let overwrite = |at| std::os::unix::fs::FileExt::write_all_at(&damaged, &[7; 4], at);
    overwrite(at).and_then(|()| overwrite(at - 1000)).expect("room");
    let due = [oldest, oldest + 1, oldest + 2, second, second + 1];
    let mut follower = Follower::after(&folder, 0);
    let found = follower.read(5).expect("readable");
    assert!(found.iter().map(|stored| stored.number).eq(due));
    assert!(
        found.iter().map(|stored| stored.entry.kind == Kind::Gap).eq(due.map(|n| n == oldest + 2))
    );
    // Its last entry is not whole: it is not read, and then it is.
    let path = newest(&folder);
    let whole = fs::read(&path).expect("there");
    fs::write(&path, &whole[..whole.len() - 1]).expect("room");
    let mut follower = Follower::after(&folder, 398);
    assert_eq!(follow(&mut follower, 9), [399]);
    fs::write(&path, &whole).expect("room");
    assert_eq!(follow(&mut follower, 9), [400]);
}
