//! What the capture thread takes frames from: a recording at its own pace, or a live camera that is
//! opened again when it was lost.

use super::FrameSource;
use crate::config::CameraTable;
use crate::error::{Error, Result};
use crate::image::FrameTime;
use crate::plan::Block;
use std::time::{Duration, Instant};

/// A lost camera is looked for this often.
const RETRY: Duration = Duration::from_secs(1);
/// A camera's clock that runs away from ours by more than this was set.
const CLOCK_JUMP_S: f64 = 1.0;

/// A camera whose numbers jump by more began to count anew.
const FRAMES_LOST_MAX: u64 = 100_000;

/// A frame's circumstances; its pixels are in the buffer that was exchanged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Taken {
    /// Index and time since the first frame.
    pub time: FrameTime,
    /// When it was exposed, by this machine's clock.
    pub captured: Instant,
    /// Bytes from one row to the next.
    pub stride: usize,
}

/// What there was when a frame was asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Next {
    /// A frame.
    Frame(Taken),
    /// A frame with parts missing; the buffer's contents are of no use.
    Torn,
    /// Nothing for a while, or no camera: ask again.
    Nothing,
    /// There will be no more.
    End,
}

/// How a feed fares.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FeedStatus {
    /// There is no camera, or it does not do what the configuration asks for.
    pub absent: bool,
    /// How often a camera was lost after it had been there.
    pub losses: u64,
    /// Frames that were left out because they came too late.
    pub late: u64,
    /// Parts of frames that were asked for again.
    pub resends: u64,
}

/// What the capture thread takes frames from.
pub trait Feed: Send {
    /// Width and height of every frame.
    fn size_px(&self) -> [usize; 2];

    /// Exchange an empty buffer for one with the next frame, waiting for it a fraction of a
    /// second. The buffer that comes back may be another one.
    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Next>;

    /// There is no buffer: let the next frame go by, and say how many went.
    fn skip(&mut self) -> Result<u64>;

    /// How it fares.
    fn status(&self) -> FeedStatus;
}

/// When the frames of a recording are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// As soon as there is a buffer for one.
    Unhurried,
    /// At the recording's frame rate by the clock; a frame that is late is left out.
    RealTime,
}

/// A recording, or the synthetic belt, in place of a camera.
pub struct Paced<'a> {
    source: &'a mut dyn FrameSource,
    pace: Pace,
    start: Option<Instant>,
    taken: u64,
    late: u64,
}

impl<'a> Paced<'a> {
    /// Frames of `source` at a pace.
    pub fn new(source: &'a mut dyn FrameSource, pace: Pace) -> Self {
        Self { source, pace, start: None, taken: 0, late: 0 }
    }

    fn due(&mut self) -> Instant {
        let start = *self.start.get_or_insert_with(Instant::now);
        start + Duration::from_secs_f64(self.taken as f64 / self.source.fps())
    }

    /// Sleep until the next frame is due; leave out those that are over already.
    fn wait(&mut self) {
        let (due, now) = (self.due(), Instant::now());
        std::thread::sleep(due.saturating_duration_since(now));
        let late = (now.saturating_duration_since(due).as_secs_f64() * self.source.fps()) as u64;
        if late > 0 {
            self.source.skip(late);
            self.taken += late;
            self.late += late;
        }
    }
}

impl Feed for Paced<'_> {
    fn size_px(&self) -> [usize; 2] {
        self.source.size_px()
    }

    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Next> {
        if self.pace == Pace::RealTime {
            self.wait();
        }
        let due = self.due();
        let Some(time) = self.source.next_into(buffer)? else { return Ok(Next::End) };
        self.taken += 1;
        let captured = if self.pace == Pace::RealTime { due } else { Instant::now() };
        Ok(Next::Frame(Taken { time, captured, stride: self.source.size_px()[0] }))
    }

    fn skip(&mut self) -> Result<u64> {
        if self.pace == Pace::RealTime {
            self.wait();
            self.source.skip(1);
            self.taken += 1;
            return Ok(1);
        }
        std::thread::sleep(Duration::from_secs_f64(1.0 / self.source.fps()));
        Ok(0)
    }

    fn status(&self) -> FeedStatus {
        FeedStatus { late: self.late, ..FeedStatus::default() }
    }
}

/// What an open camera had when asked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Arrival {
    /// A frame: its number, which wraps around nowhere, when it was exposed by the camera's clock,
    /// and when by ours.
    Frame {
        /// Counts frames that were lost too.
        sequence: u64,
        /// From any moment on.
        stamp_s: f64,
        /// By this machine's clock.
        captured: Instant,
        /// Bytes from one row to the next.
        stride: usize,
    },
    /// A frame with parts missing.
    Torn,
    /// Nothing for a while.
    Nothing,
}

/// One open camera, by one protocol. An error means that it has to be opened again.
pub trait Driver: Send {
    /// As [`Feed::next`].
    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Arrival>;

    /// Take a frame and let it go; whether there was one.
    fn skip(&mut self) -> Result<bool>;

    /// Parts of frames that were asked for again.
    fn resends(&self) -> u64 {
        0
    }
}

/// Opens the camera of a configuration for frames of a size.
pub type Open = fn(&CameraTable, [usize; 2]) -> Result<Box<dyn Driver>>;

/// A live camera, opened again when it was lost.
pub struct Live {
    settings: CameraTable,
    size_px: [usize; 2],
    open: Open,
    driver: Option<Box<dyn Driver>>,
    retry_at: Instant,
    /// When it was opened, or a frame came.
    heard: Instant,
    timeline: Timeline,
    status: FeedStatus,
    complaint: String,
}

impl Live {
    /// The camera of a configuration, which need not be there yet.
    pub fn new(settings: CameraTable, size_px: [usize; 2], open: Open) -> Self {
        Self {
            settings,
            size_px,
            open,
            driver: None,
            retry_at: Instant::now(),
            heard: Instant::now(),
            timeline: Timeline::default(),
            status: FeedStatus { absent: true, ..FeedStatus::default() },
            complaint: String::new(),
        }
    }

    /// The open camera, opened now if it is time to.
    fn driver(&mut self) -> Option<&mut Box<dyn Driver>> {
        if self.driver.is_none() {
            let now = Instant::now();
            if now < self.retry_at {
                // Short, for whoever wants this thread to end.
                std::thread::sleep((self.retry_at - now).min(RETRY / 20));
                return None;
            }
            self.retry_at = now + RETRY;
            match (self.open)(&self.settings, self.size_px) {
                Ok(driver) => {
                    self.heard = now;
                    self.timeline.reopened();
                    self.driver = Some(driver);
                    if self.settings.frame_timeout_s <= 0.0 {
                        // It waits for its trigger.
                        self.is_there();
                    }
                }
                Err(error) => self.complain(&error),
            }
        }
        self.driver.as_mut()
    }

    /// Say so once, not every second.
    fn complain(&mut self, error: &Error) {
        let complaint = error.to_string();
        if complaint != self.complaint {
            tracing::error!("no camera: {complaint}");
            self.complaint = complaint;
        }
    }

    /// Something came of it.
    fn is_there(&mut self) {
        self.heard = Instant::now();
        if self.status.absent {
            tracing::info!("the camera is there");
            self.complaint.clear();
            self.status.absent = false;
        }
    }

    /// A camera may be open and yet send nothing, or nothing that becomes a frame.
    fn check_silence(&mut self) {
        let timeout_s = self.settings.frame_timeout_s;
        if timeout_s > 0.0 && self.heard.elapsed().as_secs_f64() > timeout_s {
            self.lose(
                &Error::failure(format!("the camera is open, and no frame came for {timeout_s} s"))
                    .remedy("check its trigger, or set camera.frame_timeout_s to 0 if it has one"),
            );
        }
    }

    fn lose(&mut self, error: &Error) {
        self.complain(error);
        self.driver = None;
        // One that never sent anything was not lost.
        self.status.losses += u64::from(!self.status.absent);
        self.status.absent = true;
        self.retry_at = Instant::now() + RETRY;
    }
}

impl Feed for Live {
    fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    fn next(&mut self, buffer: &mut Block<u8>) -> Result<Next> {
        let bytes = self.size_px.iter().product();
        let Some(driver) = self.driver() else {
            // What a lost camera had lent keeps its device busy.
            if buffer.is_foreign() {
                *buffer = Block::own(bytes)?;
            }
            return Ok(Next::Nothing);
        };
        let resends = driver.resends();
        match driver.next(buffer) {
            Ok(Arrival::Frame { sequence, stamp_s, captured, stride }) => {
                self.status.resends += self.driver.as_ref().map_or(0, |d| d.resends()) - resends;
                self.is_there();
                let time = self.timeline.frame(sequence, stamp_s, captured);
                Ok(Next::Frame(Taken { time, captured, stride }))
            }
            Ok(Arrival::Torn) => {
                self.is_there();
                Ok(Next::Torn)
            }
            Ok(Arrival::Nothing) => {
                self.check_silence();
                Ok(Next::Nothing)
            }
            Err(error) => {
                self.lose(&error);
                Ok(Next::Nothing)
            }
        }
    }

    fn skip(&mut self) -> Result<u64> {
        let Some(driver) = self.driver() else { return Ok(0) };
        match driver.skip() {
            Ok(skipped) => {
                if skipped {
                    self.is_there();
                }
                Ok(u64::from(skipped))
            }
            Err(error) => {
                self.lose(&error);
                Ok(0)
            }
        }
    }

    fn status(&self) -> FeedStatus {
        self.status
    }
}

/// From a camera's numbers and clock to index and time since the first frame, over losses of the
/// camera. Each begins anew by itself when it jumps; some drivers number every frame 0.
#[derive(Default)]
struct Timeline {
    /// The newest frame, and when it was exposed by our clock.
    last: Option<(FrameTime, Instant)>,
    /// The camera's number that belongs to an index of ours.
    numbers: Option<(u64, u64)>,
    /// The camera's time that belongs to a time of ours.
    clock: Option<(f64, f64)>,
}

impl Timeline {
    /// The camera's numbers and clock begin anew.
    fn reopened(&mut self) {
        (self.numbers, self.clock) = (None, None);
    }

    fn frame(&mut self, sequence: u64, stamp_s: f64, captured: Instant) -> FrameTime {
        let time = match self.last {
            None => FrameTime::default(),
            Some((last, at)) => {
                let elapsed_s = captured.saturating_duration_since(at).as_secs_f64();
                FrameTime {
                    index: self.index(sequence, last.index),
                    t_s: self.t_s(stamp_s, last.t_s, elapsed_s),
                }
            }
        };
        self.numbers.get_or_insert((sequence, time.index));
        self.clock.get_or_insert((stamp_s, time.t_s));
        self.last = Some((time, captured));
        time
    }

    fn index(&mut self, sequence: u64, last: u64) -> u64 {
        let by_camera = self.numbers.and_then(|(first, index)| {
            let ahead = sequence.checked_sub(first)?;
            index
                .checked_add(ahead)
                .filter(|index| (last + 1..=last + FRAMES_LOST_MAX).contains(index))
        });
        by_camera.unwrap_or_else(|| {
            self.numbers = None;
            last + 1
        })
    }

    fn t_s(&mut self, stamp_s: f64, last_s: f64, elapsed_s: f64) -> f64 {
        let by_camera = self.clock.map(|(first_s, t_s)| t_s + (stamp_s - first_s));
        let follows = |t_s: &f64| *t_s > last_s && (t_s - last_s - elapsed_s).abs() < CLOCK_JUMP_S;
        by_camera.filter(follows).unwrap_or_else(|| {
            self.clock = None;
            last_s + elapsed_s.max(0.001)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(start: Instant, ms: u64) -> Instant {
        start + Duration::from_millis(ms)
    }

    #[test]
    fn time_and_index_follow_the_camera_and_go_on_after_it_was_lost() {
        let (mut timeline, start) = (Timeline::default(), Instant::now());
        let time = |t: FrameTime| (t.index, (t.t_s * 1000.0).round() as i64);
        assert_eq!(time(timeline.frame(700, 50.0, start)), (0, 0));
        assert_eq!(time(timeline.frame(701, 50.025, at(start, 31))), (1, 25));
        // Two frames were lost on the way.
        assert_eq!(time(timeline.frame(704, 50.1, at(start, 102))), (4, 100));
        timeline.reopened();
        assert_eq!(time(timeline.frame(0, 0.0, at(start, 5102))), (5, 5100));
        assert_eq!(time(timeline.frame(1, 0.025, at(start, 5130))), (6, 5125));
    }

    #[test]
    fn a_camera_whose_clock_or_numbers_jump_does_not_turn_time_back() {
        let (mut timeline, start) = (Timeline::default(), Instant::now());
        timeline.frame(10, 100.0, start);
        // Time goes on by our clock where the camera's jumps; of two frames with one number the second
        // is the next one.
        for (sequence, stamp_s) in [
            (11, 9000.0),
            (12, 0.0),
            (0, 0.025),
            (1, f64::NAN),
            (2, 0.1),
            (u64::MAX, 0.1),
            (3, 0.125),
        ] {
            let before = timeline.last.expect("one came").0;
            let time = timeline.frame(sequence, stamp_s, at(start, 25 * (before.index + 1)));
            assert!(time.index == before.index + 1 && time.t_s > before.t_s, "{time:?}");
            assert!((time.t_s - 0.025 * time.index as f64).abs() < 1e-6, "{time:?}");
        }
    }

    #[test]
    fn a_driver_that_numbers_every_frame_0_has_its_clock_followed() {
        let (mut timeline, start) = (Timeline::default(), Instant::now());
        for n in 0..50u64 {
            // Its clock is even, ours is late by up to 20 ms.
            let captured = at(start, 40 * n + n * 7 % 20);
            let time = timeline.frame(0, 7.0 + 0.04 * n as f64, captured);
            assert!(time.index == n && (time.t_s - 0.04 * n as f64).abs() < 1e-9, "{time:?}");
        }
    }

    /// A camera that is lost after a few frames, and cannot be opened at every second try.
    struct Fragile(u64);

    impl Driver for Fragile {
        fn next(&mut self, _: &mut Block<u8>) -> Result<Arrival> {
            self.0 += 1;
            if self.0 > 3 {
                return Err(Error::failure("unplugged"));
            }
            let captured = Instant::now();
            let stamp_s = captured.elapsed().as_secs_f64() + self.0 as f64 / 40.0;
            Ok(Arrival::Frame { sequence: self.0, stamp_s, captured, stride: 4 })
        }

        fn skip(&mut self) -> Result<bool> {
            Ok(false)
        }
    }

    #[test]
    fn a_lost_camera_is_opened_again() {
        use std::sync::atomic::{AtomicU64, Ordering};
        static OPENED: AtomicU64 = AtomicU64::new(0);
        let open: Open = |_, _| match OPENED.fetch_add(1, Ordering::Relaxed) % 2 {
            0 => Err(Error::failure("not there")),
            _ => Ok(Box::new(Fragile(0))),
        };
        let settings = CameraTable::new("camera.toml".into());
        let mut live = Live::new(settings, [4, 4], open);
        let (mut buffer, start) = (Block::own(16).expect("small"), Instant::now());
        let mut indices = Vec::new();
        while indices.len() < 6 && start.elapsed() < Duration::from_secs(30) {
            assert!(live.next(&mut buffer).is_ok_and(|next| {
                if let Next::Frame(taken) = next {
                    indices.push(taken.time.index);
                }
                next != Next::End
            }));
        }
        assert_eq!((indices, live.status().losses), (vec![0, 1, 2, 3, 4, 5], 1));
        assert!(!live.status().absent);
        let _ = live.next(&mut buffer);
        assert!(live.status().absent && live.driver.is_none());
    }

    /// A camera that opens and sends nothing but what is skipped.
    struct Silent;

    impl Driver for Silent {
        fn next(&mut self, _: &mut Block<u8>) -> Result<Arrival> {
            std::thread::sleep(Duration::from_millis(10));
            Ok(Arrival::Nothing)
        }

        fn skip(&mut self) -> Result<bool> {
            Ok(true)
        }
    }

    #[test]
    fn a_camera_that_is_open_and_silent_is_opened_again_unless_it_waits_for_a_trigger() {
        let mut buffer = Block::own(16).expect("small");
        for (frame_timeout_s, absent) in [(0.05, true), (0.0, false)] {
            let mut settings = CameraTable::new("camera.toml".into());
            settings.frame_timeout_s = frame_timeout_s;
            let mut live = Live::new(settings, [4, 4], |_, _| Ok(Box::new(Silent)));
            (0..20).for_each(|_| assert_eq!(live.next(&mut buffer).ok(), Some(Next::Nothing)));
            let status = live.status();
            assert_eq!((status.absent, live.driver.is_none(), status.losses), (absent, absent, 0));
        }
    }

    #[test]
    fn a_camera_whose_frames_are_skipped_is_not_silent() {
        let mut buffer = Block::own(16).expect("small");
        let mut settings = CameraTable::new("camera.toml".into());
        settings.frame_timeout_s = 0.5;
        let mut live = Live::new(settings, [4, 4], |_, _| Ok(Box::new(Silent)));
        let _ = live.next(&mut buffer);
        for _ in 0..12 {
            std::thread::sleep(Duration::from_millis(50));
            assert_eq!(live.skip().ok(), Some(1));
        }
        let _ = live.next(&mut buffer);
        assert!(live.driver.is_some() && !live.status().absent);
    }
}
