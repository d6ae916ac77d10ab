use super::*;
use crate::plc::record;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

fn folder(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("beltgauge-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("writable");
    folder
}

fn open(path: &Path) -> Journal {
    Journal::open(path).expect("a file of ours")
}

/// Number parcels and wait until the disk has them.
fn number(journal: &mut Journal, count: u32) -> u32 {
    let mut last = (record(0), 0);
    for i in 0..count {
        last = journal.number(record(1000 + i), journal.is_failing());
    }
    journal.save();
    while !journal.is_kept(last.1) {
        std::thread::sleep(Duration::from_millis(1));
    }
    last.0.seq
}

/// As a kill does: nothing is written at the end. Here the file is closed all the same.
fn kill(journal: Journal) {
    drop(journal);
}

fn until(what: &str, holds: impl Fn() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < Duration::from_secs(20), "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_restart_continues_where_the_last_run_ended_and_counts_itself() {
    let path = folder("journal").join("state");
    let mut journal = open(&path);
    assert_eq!((journal.state().boots, journal.state().sequence), (1, 0));
    assert_eq!(number(&mut journal, 40), 40);
    journal.sent(35);
    let noted = journal.change(|state| (state.acknowledged, state.ticket) = (30, 9));
    assert!(!journal.is_kept(noted), "nobody was told to save");
    journal.save();
    until("saved", || journal.is_kept(noted));
    kill(journal);
    let mut journal = open(&path);
    let state = journal.state();
    assert_eq!((state.boots, state.sequence), (2, 40));
    assert_eq!((state.acknowledged, state.sent, state.ticket), (30, 35, 9));
    assert!(journal.records().iter().map(|r| r.seq).eq(9..=40));
    assert_eq!(*journal.records().front().expect("32"), ParcelRecord { seq: 9, ..record(1008) });
    assert_eq!(number(&mut journal, 1), 41);
}

/// What a power cut can leave: each byte range of a commit written or not.
#[test]
fn a_torn_commit_leaves_what_was_before() {
    let path = folder("torn").join("state");
    let mut journal = open(&path);
    number(&mut journal, 5);
    kill(journal);
    let before = std::fs::read(&path).expect("readable");
    let mut journal = open(&path);
    number(&mut journal, 1);
    kill(journal);
    let after = std::fs::read(&path).expect("readable");
    let blocks: Vec<usize> = (0..before.len())
        .step_by(512)
        .filter(|&at| before[at..at + 512] != after[at..at + 512])
        .collect();
    assert!(blocks.len() >= 2, "the parcel and its state: {blocks:?}");
    for written in 0..1 << blocks.len() {
        for torn_at in [512, 100] {
            let mut bytes = before.clone();
            for (i, &at) in blocks.iter().enumerate().filter(|(i, _)| written >> i & 1 == 1) {
                let end = if i + 1 == blocks.len() { torn_at } else { 512 };
                bytes[at..at + end].copy_from_slice(&after[at..at + end]);
            }
            let found = slots::parse(&bytes);
            assert!(!found.damaged);
            let sequence = found.state.map_or(0, |state| state.sequence);
            assert!([5, 6].contains(&sequence), "{written:b}: {sequence}");
            let published = found.records.iter().filter(|r| r.seq <= 5).count();
            assert_eq!(published, 5, "{written:b}");
        }
    }
}

#[test]
fn a_parcel_that_was_written_before_its_state_is_not_numbered_again() {
    let path = folder("between").join("state");
    let mut journal = open(&path);
    number(&mut journal, 5);
    let state = *journal.state();
    kill(journal);
    let file = open_for_writing(&path).expect("writable");
    slots::commit(&file, [record(6)].iter(), &state, 100).expect("room");
    drop(file);
    let mut journal = open(&path);
    assert_eq!(journal.records().back().map(|r| r.seq), Some(6));
    assert_eq!(number(&mut journal, 1), 7);
}

#[test]
fn a_damaged_file_is_set_aside_and_its_numbers_are_not_given_again() {
    let folder = folder("damaged");
    let path = folder.join("state");
    for damaged in [b"{\"boots\":1}".to_vec(), vec![0xff; 64], vec![1; 100_000]] {
        std::fs::write(&path, &damaged).expect("writable");
        let mut journal = open(&path);
        until("written", || journal.keeping() == Keeping::Disk);
        assert_eq!(std::fs::read(folder.join("state.damaged")).expect("kept"), damaged);
        let first = number(&mut journal, 1);
        assert!(first > 0xffff, "{first}");
        kill(journal);
        assert_eq!(number(&mut open(&path), 1), first + 1);
    }
}

#[test]
fn half_a_new_file_is_a_new_file() {
    let path = folder("half").join("state");
    for bytes in [0, 1, 4096, slots::FILE_BYTES] {
        std::fs::write(&path, vec![0; bytes]).expect("writable");
        let mut journal = open(&path);
        assert_eq!(number(&mut journal, 1), 1, "{bytes} bytes");
    }
}

#[test]
fn a_record_of_another_version_keeps_its_number() {
    let path = folder("version").join("state");
    let mut journal = open(&path);
    number(&mut journal, 3);
    kill(journal);
    let mut found = slots::parse(&std::fs::read(&path).expect("readable"));
    found.records.retain(|r| r.seq != 3);
    found.unknown.push(3);
    let mut journal = Journal::default();
    journal.take_up(found);
    assert_eq!((journal.state().sequence, journal.records().len()), (3, 2));
}

#[test]
fn a_disk_that_is_not_there_is_told_and_numbers_never_meet() {
    let folder = folder("absent");
    let path = folder.join("later/state");
    let mut journal = open(&path);
    assert_eq!(journal.keeping(), Keeping::Failing);
    let mut given = vec![number(&mut journal, 1), number(&mut journal, 1)];
    assert_eq!(given[1], given[0] + 1);
    // It is mounted while the belt runs.
    std::fs::create_dir(folder.join("later")).expect("writable");
    until("written again", || journal.keeping() == Keeping::Disk);
    given.push(number(&mut journal, 1));
    kill(journal);
    let mut journal = open(&path);
    given.push(number(&mut journal, 1));
    assert_eq!(given[3], given[0] + 3);
}

/// A folder that is there, or is not.
fn mount(folder: &Path, mounted: bool) {
    let (there, away) = (folder.join("mounted"), folder.join("away"));
    let (from, to) = if mounted { (away, there) } else { (there, away) };
    std::fs::rename(from, to).expect("renamed");
}

#[test]
fn a_file_that_turns_up_after_the_start_is_taken_up_and_not_overwritten() {
    let folder = folder("turns-up");
    std::fs::create_dir(folder.join("mounted")).expect("writable");
    let path = folder.join("mounted/state");
    let mut journal = open(&path);
    // More commits than the run that does not see them makes.
    for _ in 0..40 {
        number(&mut journal, 1);
    }
    journal.change(|state| (state.acknowledged, state.ticket, state.stopped) = (38, 9, true));
    kill(journal);
    mount(&folder, false);
    let mut journal = open(&path);
    assert!(journal.meet().is_none());
    let given = [number(&mut journal, 1), number(&mut journal, 1)];
    mount(&folder, true);
    let mut met = None;
    let begun = Instant::now();
    while met.is_none() {
        assert!(begun.elapsed() < Duration::from_secs(20), "nothing turned up");
        std::thread::sleep(Duration::from_millis(2));
        met = journal.meet();
    }
    assert!(met.expect("met").iter().map(|r| r.seq).eq([39, 40]), "not acknowledged yet");
    assert!(journal.meet().is_none(), "once");
    assert_eq!(journal.keeping(), Keeping::Failing, "nothing is written before");
    journal.save();
    until("written again", || journal.keeping() == Keeping::Disk);
    let next = number(&mut journal, 1);
    assert_eq!(next, given[1] + 1);
    kill(journal);
    let journal = open(&path);
    let state = journal.state();
    assert_eq!((state.boots, state.sequence, state.acknowledged), (3, next, 38));
    assert!(state.ticket == 9 && state.stopped);
    let kept: Vec<u32> = journal.records().iter().map(|r| r.seq).collect();
    assert_eq!(kept[kept.len() - 5..], [39, 40, given[0], given[1], next]);
}

#[test]
fn a_file_that_turns_up_with_later_numbers_is_gone_beyond() {
    let folder = folder("later");
    std::fs::create_dir(folder.join("mounted")).expect("writable");
    let path = folder.join("mounted/state");
    let mut journal = open(&path);
    journal.state.sequence = 0x6000_0000;
    let last = number(&mut journal, 1);
    kill(journal);
    mount(&folder, false);
    let mut journal = open(&path);
    let given = number(&mut journal, 1);
    mount(&folder, true);
    until("turned up", || journal.writer.as_ref().expect("a disk").has_met());
    journal.meet().expect("turned up");
    let next = number(&mut journal, 1);
    assert!(is_after(given, 0) && is_after(last, given) && is_after(next, last), "{next:#x}");
    // An acknowledgment, a low word, is of one or the other.
    assert_eq!(next as u16, (given as u16 ^ 0x8000).wrapping_add(1));
}

#[test]
fn numbers_given_while_the_disk_fails_are_not_given_after_a_restart() {
    let folder = folder("fails");
    let path = folder.join("state");
    let mut journal = open(&path);
    assert_eq!(number(&mut journal, 3), 3);
    // The disk of the first run, for the restart.
    let kept = std::fs::read(&path).expect("readable");
    let writer = journal.writer.take().expect("on a disk");
    drop(writer);
    journal.writer =
        Some(Writer::start(&folder.join("gone/state"), None, Some(9)).expect("starts"));
    assert!(journal.is_failing() && !journal.is_elsewhere());
    let elsewhere: Vec<u32> = (0..100).map(|_| number(&mut journal, 1)).collect();
    assert!(journal.is_elsewhere());
    assert_eq!(elsewhere[0] as u16 ^ 0x8000, 4, "the low word is half a turn away");
    kill(journal);
    std::fs::write(&path, kept).expect("writable");
    let mut journal = open(&path);
    for _ in 0..1000 {
        let given = number(&mut journal, 1);
        assert!(!elsewhere.contains(&given), "{given}");
    }
}

#[test]
fn a_batch_is_of_one_block_whatever_the_disk_does_meanwhile() {
    let path = folder("batch").join("state");
    let mut journal = open(&path);
    number(&mut journal, 3);
    // It fails when it is asked about, and no more when the batch is numbered.
    let failing = true;
    let batch = [4, 5, 6].map(|seq| journal.number(record(seq), failing).0.seq);
    assert!(batch[0] > 0xffff && batch[2] == batch[0] + 2, "{batch:?}");
}

#[test]
fn what_is_no_file_of_ours_alone_is_refused_with_the_reason() {
    let folder = folder("refused");
    let fifo = folder.join("fifo");
    rustix::fs::mknodat(
        rustix::fs::CWD,
        &fifo,
        rustix::fs::FileType::Fifo,
        rustix::fs::Mode::RWXU,
        0,
    )
    .expect("made");
    let error = Journal::open(&fifo).expect_err("a pipe").to_string();
    assert!(error.contains("no regular file"), "{error}");
    let path = folder.join("state");
    let first = open(&path);
    let error = Journal::open(&path).expect_err("in use").to_string();
    assert!(error.contains("another process"), "{error}");
    drop(first);
    assert_eq!(open(&path).state().boots, 2);
}

/// The claim of the module's cost: bytes that a parcel changes.
#[test]
fn a_parcel_and_its_acknowledgment_change_four_blocks() {
    let path = folder("wear").join("state");
    let mut journal = open(&path);
    number(&mut journal, 40);
    let read = || {
        let mut bytes = vec![0; slots::FILE_BYTES];
        File::open(&path).and_then(|f| f.read_exact_at(&mut bytes, 0)).expect("readable");
        bytes
    };
    let changed =
        |a: &[u8], b: &[u8]| a.chunks(4096).zip(b.chunks(4096)).filter(|(a, b)| a != b).count();
    let start = read();
    number(&mut journal, 1);
    let numbered = read();
    assert_eq!(changed(&start, &numbered), 2);
    let noted = journal.change(|state| state.acknowledged = 41);
    journal.save();
    until("saved", || journal.is_kept(noted));
    assert_eq!(changed(&numbered, &read()), 1);
}
