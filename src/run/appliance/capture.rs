//! The capture thread: frames from the feed into the ring, as long as there are buffers.

use super::attendance::Attendance;
use super::{FRAME_RING, Frame, Shared};
use crate::error::Result;
use crate::plan::Block;
use crate::source::{Feed, Next};
use heapless::Deque;
use heapless::spsc::{Consumer, Producer};
use std::sync::atomic::{AtomicU64, Ordering};

/// The capture thread.
pub(super) struct Capture<'a> {
    feed: &'a mut dyn Feed,
    free: Consumer<'a, Block<u8>>,
    ready: Producer<'a, Frame>,
    shared: &'a Shared,
    /// Buffers that nothing was put into.
    empty: Deque<Block<u8>, FRAME_RING>,
    /// Index of the newest frame.
    newest: Option<u64>,
    /// Frames that were let go since then, for want of a buffer.
    let_go: u64,
    attendance: Attendance,
}

impl<'a> Capture<'a> {
    pub(super) fn new(
        feed: &'a mut dyn Feed,
        free: Consumer<'a, Block<u8>>,
        ready: Producer<'a, Frame>,
        shared: &'a Shared,
    ) -> Self {
        let (empty, attendance) = (Deque::new(), Attendance::default());
        Self { feed, free, ready, shared, empty, newest: None, let_go: 0, attendance }
    }

    pub(super) fn run(mut self) -> Result<()> {
        let result = self.frames();
        self.shared.source_ended.store(true, Ordering::Release);
        self.shared.wake_vision();
        result
    }

    fn keep(&mut self, pixels: Block<u8>) {
        // There are no more buffers than places.
        let _ = self.empty.push_back(pixels);
    }

    fn frames(&mut self) -> Result<()> {
        let add = |counter: &AtomicU64, count: u64| counter.fetch_add(count, Ordering::Relaxed);
        while !self.shared.stopped() {
            self.shared.beats.capture.beat();
            // In turn, so that a camera that is lost gets back all that it had lent.
            let next = self.free.dequeue().or_else(|| self.empty.pop_front());
            let Some(mut pixels) = next else {
                let count = self.feed.skip()?;
                self.let_go += count;
                add(&self.shared.frames_dropped, count);
                continue;
            };
            let late = self.feed.status().late;
            let next = self.feed.next(&mut pixels)?;
            // Never waits: whoever reads it sees the state before.
            if let Ok(mut status) = self.shared.feed.try_lock() {
                *status = self.feed.status();
            }
            match next {
                Next::Frame(taken) => {
                    self.let_go += self.feed.status().late - late;
                    let expected = self.newest.map_or(taken.time.index, |newest| newest + 1);
                    let missing = taken.time.index.saturating_sub(expected);
                    add(&self.shared.frames_lost, missing.saturating_sub(self.let_go));
                    self.attendance.frame(taken.time.t_s, missing);
                    let too_many = self.attendance.too_many_missing();
                    self.shared.frames_missing.store(too_many, Ordering::Relaxed);
                    (self.newest, self.let_go) = (Some(taken.time.index), 0);
                    // There are no more frames than places in the ring.
                    let _ = self.ready.enqueue(Frame { pixels, taken });
                    self.shared.wake_vision();
                }
                Next::Torn => {
                    // It is missing in the count of frames, but not lost on the way.
                    self.let_go += 1;
                    add(&self.shared.frames_torn, 1);
                    self.keep(pixels);
                }
                Next::Nothing => self.keep(pixels),
                Next::End => return Ok(()),
            }
        }
        Ok(())
    }
}
