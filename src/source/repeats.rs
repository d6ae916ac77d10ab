//! Pictures that a recording repeats, left out: a variable frame rate that was made constant fills
//! its gaps so.
//!
//! A repeated picture is no evidence that the belt stood still. Left out, its time slot stays empty,
//! as of a frame that was lost, and the belt's motion between its neighbours fits their times.

use super::FrameSource;
use crate::error::Result;
use crate::image::FrameTime;
use std::fmt::Write as _;

/// One pixel in so many is compared: a prime, so that all columns are.
const STEP: usize = 7;
/// A picture that differs from the one before by less than this share of what is usual is that one
/// again: noise alone makes two photographs differ by more, what a codec leaves by a tenth of it.
const SHARE: f32 = 0.25;
/// Frames from which the usual difference is known.
const USUAL: usize = 15;
/// The fewest of them.
const USUAL_MIN: usize = 5;
/// More equal pictures in turn are a belt that stands still, seen without noise.
const IN_TURN_MAX: usize = 4;
/// Frames that are named at the end.
const NAMED: usize = 8;

/// A recording without the pictures that it repeats.
pub struct WithoutRepeats<S> {
    source: S,
    /// Pixels of the newest picture.
    newest: Vec<u8>,
    /// Mean differences of new pictures to those before them, grey levels.
    usual: heapless::HistoryBuf<f32, USUAL>,
    /// Repeats since the newest picture.
    in_turn: heapless::Vec<u64, IN_TURN_MAX>,
    repeats: u64,
    named: heapless::Vec<u64, NAMED>,
}

impl<S: FrameSource> WithoutRepeats<S> {
    /// The new pictures of a recording.
    pub fn new(source: S) -> Self {
        Self {
            source,
            newest: Vec::new(),
            usual: heapless::HistoryBuf::new(),
            in_turn: heapless::Vec::new(),
            repeats: 0,
            named: heapless::Vec::new(),
        }
    }

    /// Whether this is the newest picture again.
    fn is_repeat(&mut self, frame: &[u8], index: u64) -> bool {
        let pixels = || frame.iter().step_by(STEP);
        let sum: u64 = pixels().zip(&self.newest).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        let difference = sum as f32 / self.newest.len().max(1) as f32;
        if difference < SHARE * self.usual_difference() {
            if self.in_turn.push(index).is_ok() {
                return true;
            }
            // What is usual is learnt anew.
            self.in_turn.clear();
            self.usual.clear();
        }
        for index in &self.in_turn {
            self.repeats += 1;
            let _ = self.named.push(*index);
        }
        self.in_turn.clear();
        if !self.newest.is_empty() {
            self.usual.write(difference);
        }
        self.newest.clear();
        self.newest.extend(pixels());
        false
    }

    /// The median; 0 while it is not known.
    fn usual_difference(&self) -> f32 {
        let mut usual: heapless::Vec<f32, USUAL> = self.usual.oldest_ordered().copied().collect();
        if usual.len() < USUAL_MIN {
            return 0.0;
        }
        usual.sort_unstable_by(f32::total_cmp);
        usual[usual.len() / 2]
    }
}

impl<S: FrameSource> FrameSource for WithoutRepeats<S> {
    fn size_px(&self) -> [usize; 2] {
        self.source.size_px()
    }

    fn fps(&self) -> f64 {
        self.source.fps()
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        loop {
            match self.source.next_into(frame)? {
                Some(time) if self.is_repeat(frame, time.index) => {}
                next => return Ok(next),
            }
        }
    }

    fn skip(&mut self, count: u64) {
        self.source.skip(count);
    }

    fn doubt(&self) -> Option<String> {
        if self.repeats == 0 {
            return None;
        }
        let mut text = format!("{} frames repeat the picture before them: ", self.repeats);
        for (i, index) in self.named.iter().enumerate() {
            let _ = write!(text, "{}{index}", if i == 0 { "" } else { ", " });
        }
        if self.repeats > NAMED as u64 {
            text.push_str(", ...");
        }
        text.push_str(
            ". They were left out, but times beside them may be wrong: record at a constant frame \
             rate; a variable one must not be made constant (ffmpeg: -fps_mode passthrough)",
        );
        Some(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [64, 16];

    /// Frames by number of the picture: noise of its own over a slope that moves.
    struct Film(std::vec::IntoIter<u64>, u64, u64);

    impl Film {
        /// Of pictures with noise of so many grey levels.
        fn new(pictures: Vec<u64>, noise: u64) -> WithoutRepeats<Self> {
            WithoutRepeats::new(Self(pictures.into_iter(), 0, noise))
        }
    }

    impl FrameSource for Film {
        fn size_px(&self) -> [usize; 2] {
            SIZE
        }

        fn fps(&self) -> f64 {
            30.0
        }

        fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
            let Some(picture) = self.0.next() else { return Ok(None) };
            for (i, pixel) in (0u64..).zip(frame.iter_mut()) {
                let noise = (i + 1000 * picture).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
                *pixel = (noise % (1 + self.2) + 90) as u8;
            }
            let index = self.1;
            self.1 += 1;
            Ok(Some(FrameTime { index, t_s: index as f64 / 30.0 }))
        }
    }

    fn indices(source: &mut impl FrameSource) -> Vec<u64> {
        let mut frame = vec![0; SIZE[0] * SIZE[1]];
        std::iter::from_fn(|| source.next_into(&mut frame).expect("frames").map(|t| t.index))
            .collect()
    }

    #[test]
    fn a_repeated_picture_is_left_out_and_told() {
        // Every tenth picture is the one before it again.
        let pictures = (0..40).map(|i| if i % 10 == 9 { i - 1 } else { i }).collect();
        let mut film = Film::new(pictures, 4);
        let expected: Vec<u64> = (0..40).filter(|i| i % 10 != 9).collect();
        let mut seen = indices(&mut film);
        // The last one may yet be followed by more.
        seen.retain(|i| *i != 39);
        assert_eq!(seen, expected);
        let doubt = film.doubt().expect("repeats");
        assert!(doubt.contains("3 frames") && doubt.contains("9, 19, 29"), "{doubt}");
    }

    #[test]
    fn noise_on_a_belt_that_stands_still_is_no_repeat() {
        let mut film = Film::new((0..60).collect(), 1);
        assert_eq!(indices(&mut film).len(), 60);
        assert_eq!(film.doubt(), None);
    }

    #[test]
    fn a_long_stop_without_noise_is_a_stop() {
        let pictures = (0..20).chain(std::iter::repeat_n(20, 40)).chain(21..40).collect();
        let mut film = Film::new(pictures, 4);
        let seen = indices(&mut film);
        assert!(seen.len() >= 79 - IN_TURN_MAX && seen.contains(&59), "{seen:?}");
        assert_eq!(film.doubt(), None);
    }
}
