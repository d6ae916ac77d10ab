//! Keeps what a camera showed: a feed's frames in a Y4M file, their times in a file beside it.
//!
//! A thread of its own writes, behind a ring of frames: a slow disk costs recorded frames, which are
//! counted and told, and never a captured one.

use super::times::{HEADER, times_beside};
use super::{Feed, FeedStatus, Next, Taken};
use crate::error::{Error, Result};
use crate::image::FrameTime;
use crate::plan::{Block, Plan};
use std::fs::{File, OpenOptions};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

/// Frames that wait for the disk: most of a second of the reference camera.
const RING: usize = 32;
/// Their name in the memory plan.
const FRAMES: &str = "recorder.frames";
/// Losses are told this often at most.
const TELL_EVERY: Duration = Duration::from_secs(10);
/// How long a disk may take for what is in the ring at the end.
const FAREWELL: Duration = Duration::from_secs(10);
/// The rate in the header until two frames have shown it; the times beside it are what counts.
const RATE_UNKNOWN: f64 = 25.0;

/// A frame on its way to the disk.
struct Frame {
    pixels: Block<u8>,
    time: FrameTime,
}

/// Any feed, whose frames are recorded as they pass.
pub struct Recorder<'a> {
    feed: &'a mut dyn Feed,
    path: PathBuf,
    free: Receiver<Frame>,
    ready: SyncSender<Frame>,
    lost: Arc<AtomicU64>,
    ended: Receiver<Result<u64>>,
}

/// What became of a recording.
#[derive(Debug)]
pub struct Recorded {
    /// Frames in the file.
    pub written: u64,
    /// Frames that passed while the ring was full, or after the disk had failed.
    pub lost: u64,
}

impl std::fmt::Display for Recorded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} frames recorded", self.written)?;
        if self.lost > 0 {
            write!(f, ", {} missing: the disk is too slow for all of them", self.lost)?;
        }
        Ok(())
    }
}

impl<'a> Recorder<'a> {
    /// Demand the ring of a recorder of frames of this size.
    pub fn plan(size_px: [usize; 2], plan: &mut Plan) {
        let bytes: usize = size_px.iter().product();
        plan.add::<u8>(FRAMES, RING * bytes, "raw frames that wait for the recorder's disk");
    }

    /// Record the frames of `feed` into a new file and its times beside it. All memory is taken now: as
    /// [`Recorder::plan`] says, up to `mib_max`.
    pub fn create(feed: &'a mut dyn Feed, path: &Path, mib_max: usize) -> Result<Self> {
        let ring = ring(feed.size_px(), mib_max)?;
        let create = |path: &Path| {
            OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| {
                Error::configuration(format!("--record: cannot create the recording: {e}"))
                    .in_file(path)
                    .allowed("a new file in a folder that can be written to")
                    .remedy("give another name: an earlier recording is never overwritten")
            })
        };
        let files = Files::<File> {
            frames: create(path)?,
            times: create(&times_beside(path))?,
            size_px: feed.size_px(),
            first: None,
            last: FrameTime::default(),
            written: 0,
        };
        Self::start(feed, path, files, ring)
    }

    fn start<W: Write + Seek + Send + 'static>(
        feed: &'a mut dyn Feed,
        path: &Path,
        files: Files<W>,
        ring: Vec<Block<u8>>,
    ) -> Result<Self> {
        let (give_back, free) = sync_channel(RING);
        let (ready, frames) = sync_channel(RING);
        for pixels in ring {
            // There is room for all of them.
            let frame = Frame { pixels, time: FrameTime::default() };
            let _ = give_back.try_send(frame);
        }
        let (tell_end, ended) = sync_channel(1);
        let lost = Arc::<AtomicU64>::default();
        let writer = Writer { files, frames, give_back, lost: Arc::clone(&lost) };
        std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || {
                let result = writer.run();
                let _ = tell_end.try_send(result);
            })
            .map_err(|e| Error::failure(format!("cannot start the recorder thread: {e}")))?;
        Ok(Self { feed, path: path.to_owned(), free, ready, lost, ended })
    }

    /// Into the ring, if there is room.
    fn keep(&self, pixels: &[u8], taken: &Taken) {
        let [width, height] = self.feed.size_px();
        let sent = self.free.try_recv().is_ok_and(|mut frame| {
            let rows = pixels.chunks(taken.stride.max(1)).take(height);
            for (from, to) in rows.zip(frame.pixels.chunks_mut(width)) {
                let count = from.len().min(to.len());
                to[..count].copy_from_slice(&from[..count]);
            }
            frame.time = taken.time;
            self.ready.try_send(frame).is_ok()
        });
        self.lost.fetch_add(u64::from(!sent), Ordering::Relaxed);
    }

    /// Let the disk take what is in the ring.
    ///
    /// # Errors
    /// The disk failed, or did not take it in time: the recording ends early.
    pub fn finish(self) -> Result<Recorded> {
        let Self { path, ready, lost, ended, .. } = self;
        drop(ready);
        match ended.recv_timeout(FAREWELL) {
            Ok(Ok(written)) => Ok(Recorded { written, lost: lost.load(Ordering::Relaxed) }),
            Ok(Err(error)) => Err(error.in_file(&path)),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                Err(Error::failure("the disk did not take the end of the recording")
                    .in_file(&path)
                    .remedy("record to a faster disk"))
            }
        }
    }
}

impl Feed for Recorder<'_> {
    fn size_px(&self) -> [usize; 2] {
        self.feed.size_px()
    }

    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Next> {
        let next = self.feed.next(buffer)?;
        if let Next::Frame(taken) = &next {
            self.keep(buffer, taken);
        }
        Ok(next)
    }

    fn skip(&mut self) -> Result<u64> {
        self.feed.skip()
    }

    fn status(&self) -> FeedStatus {
        self.feed.status()
    }
}

/// The frames of the ring.
fn ring(size_px: [usize; 2], mib_max: usize) -> Result<Vec<Block<u8>>> {
    let mut plan = Plan::default();
    Recorder::plan(size_px, &mut plan);
    let mut memory = plan.reserve(mib_max)?;
    let frames = memory.take_parts(FRAMES, RING, 0)?;
    memory.seal()?;
    Ok(frames)
}

/// The thread behind the ring.
struct Writer<W> {
    files: Files<W>,
    frames: Receiver<Frame>,
    give_back: SyncSender<Frame>,
    lost: Arc<AtomicU64>,
}

impl<W: Write + Seek> Writer<W> {
    /// Until the other end is closed; how many frames were written.
    fn run(mut self) -> Result<u64> {
        let failed = |e: std::io::Error| {
            tracing::error!("the recording ends here, measuring goes on: {e}");
            Error::failure(format!("the recording ended early: {e}"))
        };
        self.files.header(RATE_UNKNOWN).map_err(failed)?;
        write_whole(&mut self.files.times, HEADER).map_err(failed)?;
        let (mut told, mut told_at) = (0, None::<Instant>);
        while let Ok(frame) = self.frames.recv() {
            self.files.frame(&frame).map_err(failed)?;
            // Never full: there are as many places as frames.
            let _ = self.give_back.try_send(frame);
            let lost = self.lost.load(Ordering::Relaxed);
            if lost > told && told_at.is_none_or(|at| at.elapsed() > TELL_EVERY) {
                tracing::warn!("{lost} frames are missing in the recording: the disk is too slow");
                (told, told_at) = (lost, Some(Instant::now()));
            }
        }
        self.files.rate().map_err(failed)?;
        Ok(self.files.written)
    }
}

/// The recording and the times beside it.
struct Files<W> {
    frames: W,
    times: W,
    size_px: [usize; 2],
    first: Option<FrameTime>,
    last: FrameTime,
    written: u64,
}

impl<W: Write + Seek> Files<W> {
    /// The stream header, always of the same length.
    fn header(&mut self, fps: f64) -> std::io::Result<()> {
        let [width, height] = self.size_px;
        let rate = (fps * 1e3).round().clamp(1.0, 99_999_999.0);
        self.frames.seek(SeekFrom::Start(0))?;
        write_whole(
            &mut self.frames,
            &format!("YUV4MPEG2 W{width} H{height} F{rate:08}:1000 Ip A1:1 Cmono\n"),
        )?;
        self.frames.seek(SeekFrom::End(0)).map(drop)
    }

    /// Put the mean rate so far into the header.
    fn rate(&mut self) -> std::io::Result<()> {
        let Some(first) = self.first else { return Ok(()) };
        let (frames, seconds) = (self.last.index - first.index, self.last.t_s - first.t_s);
        if frames > 0 && seconds > 0.0 {
            self.header(frames as f64 / seconds)?;
        }
        Ok(())
    }

    /// A frame, then its time: a time never lacks its frame.
    fn frame(&mut self, frame: &Frame) -> std::io::Result<()> {
        let FrameTime { index, t_s } = frame.time;
        write_whole(&mut self.frames, "FRAME\n")?;
        self.frames.write_all(&frame.pixels)?;
        write_whole(&mut self.times, &format!("{index} {t_s}\n"))?;
        self.first.get_or_insert(frame.time);
        self.last = frame.time;
        self.written += 1;
        if self.written == 2 {
            // A recording that is cut off has a rate, too.
            self.rate()?;
        }
        Ok(())
    }
}

/// Text in one call to the system.
fn write_whole(to: &mut impl Write, text: &str) -> std::io::Result<()> {
    to.write_all(text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::{FrameSource, Pace, Paced, open};
    use std::sync::Mutex;

    /// Frames filled with their number; every tenth is missing.
    struct Counting(u64);

    impl FrameSource for Counting {
        fn size_px(&self) -> [usize; 2] {
            [32, 16]
        }
        fn fps(&self) -> f64 {
            50.0
        }
        fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
            self.0 += if self.0 % 10 == 9 { 2 } else { 1 };
            frame.fill(self.0 as u8);
            Ok(Some(FrameTime { index: self.0, t_s: self.0 as f64 / 50.0 + 0.001 / 3.0 }))
        }
    }

    fn scratch(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("beltgauge-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).expect("room");
        folder
    }

    #[test]
    fn a_recording_read_back_has_its_frames_numbers_and_times() {
        let path = scratch("recorder").join("a.y4m");
        let mut source = Counting(3);
        let mut feed = Paced::new(&mut source, Pace::Unhurried);
        let mut recorder = Recorder::create(&mut feed, &path, 1).expect("room");
        let mut buffer = Block::own(32 * 16).expect("small");
        let mut passed = Vec::new();
        for _ in 0..RING {
            let next = recorder.next(&mut buffer).expect("counts");
            let Next::Frame(taken) = next else { panic!("{next:?}") };
            passed.push((taken.time, buffer[0]));
        }
        let recorded = recorder.finish().expect("room");
        assert_eq!((recorded.written, recorded.lost), (RING as u64, 0));
        let mut replay = open(&path, None).expect("a recording");
        assert!((replay.fps() - 50.0).abs() < 0.001, "{}", replay.fps());
        let mut frame = vec![0; 32 * 16];
        for (time, grey) in passed {
            assert_eq!(replay.next_into(&mut frame).expect("whole"), Some(time));
            assert!(frame.iter().all(|g| *g == grey));
        }
        assert_eq!(replay.next_into(&mut frame).expect("whole"), None);
        let doubt = replay.doubt().expect("gaps");
        assert!(doubt.contains("3 frames are missing"), "{doubt}");
    }

    #[test]
    fn an_earlier_recording_is_not_overwritten() {
        let path = scratch("recorder-twice").join("a.y4m");
        std::fs::write(&path, "mine").expect("room");
        let mut source = Counting(0);
        let mut feed = Paced::new(&mut source, Pace::Unhurried);
        let error = Recorder::create(&mut feed, &path, 1).err().expect("refused").to_string();
        assert!(error.contains("a.y4m") && error.contains("another name"), "{error}");
        assert_eq!(std::fs::read_to_string(&path).expect("there"), "mine");
    }

    #[test]
    fn a_ring_beyond_the_memory_that_is_allowed_is_refused_before_any_file_is_made() {
        struct Large;
        impl Feed for Large {
            fn size_px(&self) -> [usize; 2] {
                [1024, 1024]
            }
            fn next(&mut self, _: &mut Block<u8>) -> Result<Next> {
                Ok(Next::End)
            }
            fn skip(&mut self) -> Result<u64> {
                Ok(0)
            }
            fn status(&self) -> FeedStatus {
                FeedStatus::default()
            }
        }
        let path = scratch("recorder-large").join("a.y4m");
        let error = Recorder::create(&mut Large, &path, 31).err().expect("refused").to_string();
        assert!(error.contains("memory_mib_max") && error.contains("recorder.frames"), "{error}");
        assert!(!path.exists());
        assert!(Recorder::create(&mut Large, &path, 32).is_ok());
    }

    /// A disk that takes nothing while it is held, and fails when it is full.
    struct Disk(Arc<Mutex<()>>, usize);

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            let _held = self.0.lock();
            self.1 = self.1.checked_sub(bytes.len()).ok_or(std::io::ErrorKind::StorageFull)?;
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    impl Seek for Disk {
        fn seek(&mut self, _: SeekFrom) -> std::io::Result<u64> {
            Ok(0)
        }
    }

    fn files(gate: &Arc<Mutex<()>>, bytes: usize) -> Files<Disk> {
        let (frames, times) = (Disk(Arc::clone(gate), bytes), Disk(Arc::clone(gate), bytes));
        let (first, last) = (None, FrameTime::default());
        Files { frames, times, size_px: [32, 16], first, last, written: 0 }
    }

    #[test]
    fn a_slow_disk_costs_recorded_frames_and_never_a_captured_one() {
        let gate = Arc::<Mutex<()>>::default();
        let mut source = Counting(0);
        let mut feed = Paced::new(&mut source, Pace::Unhurried);
        let files = files(&gate, usize::MAX);
        let mut recorder =
            Recorder::start(&mut feed, Path::new("slow"), files, ring([32, 16], 1).expect("small"))
                .expect("a thread");
        let mut buffer = Block::own(32 * 16).expect("small");
        let held = gate.lock();
        for _ in 0..3 * RING {
            assert!(matches!(recorder.next(&mut buffer), Ok(Next::Frame(_))));
        }
        drop(held);
        let recorded = recorder.finish().expect("in time");
        assert_eq!((recorded.written, recorded.lost), (RING as u64, 2 * RING as u64));
    }

    #[test]
    fn a_full_disk_ends_the_recording_alone() {
        let gate = Arc::<Mutex<()>>::default();
        let mut source = Counting(0);
        let mut feed = Paced::new(&mut source, Pace::Unhurried);
        let files = files(&gate, 4000);
        let mut recorder =
            Recorder::start(&mut feed, Path::new("full"), files, ring([32, 16], 1).expect("small"))
                .expect("a thread");
        let mut buffer = Block::own(32 * 16).expect("small");
        for _ in 0..3 * RING {
            assert!(matches!(recorder.next(&mut buffer), Ok(Next::Frame(_))));
        }
        let error = recorder.finish().expect_err("a full disk").to_string();
        assert!(error.contains("ended early") && error.contains("storage"), "{error}");
    }
}
