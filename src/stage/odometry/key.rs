//! The texture that the current frame's is matched with.
//!
//! In: the texture of frames whose shift is known. Out: that of the belt in the zone, as one frame showed it,
//! or, where noise is stronger than the texture, the mean of the first frames that saw each pixel: noise differs from frame to
//! frame, the texture rides along. What the key knows stays as it is while the belt moves on, so that errors of matches do not add
//! up. Owns both.

use crate::error::Result;
use crate::kernel::Level;
use crate::kernel::scalar::texture::{NO_TEXTURE, overlap_range};
use crate::kernel::simd::texture::{Means, add_to_means};
use crate::plan::{Block, Memory, Plan};

/// A mean is that of so many frames at most: later ones follow errors of their matches.
const FRAMES_MAX: u8 = 16;

/// The texture of a key, in rows.
pub struct Key {
    row: usize,
    texture: Block<i8>,
    mean: Block<f32>,
    /// Frames in each mean.
    frames: Block<u8>,
    /// The texture is that of the means.
    is_mean: bool,
}

impl Key {
    /// Memory for a texture of `n` pixels.
    pub fn plan(n: usize, plan: &mut Plan) {
        plan.add::<i8>("odometry.key", n, "belt texture of the key frame, some of the rows");
        plan.add::<f32>("odometry.mean", n, "the same over several frames, where it is faint");
        plan.add::<u8>("odometry.frames", n, "frames in each mean");
    }

    /// No texture yet, in rows of `row` pixels.
    pub fn new(row: usize, memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            row,
            texture: memory.take("odometry.key", NO_TEXTURE)?,
            mean: memory.take("odometry.mean", 0.0)?,
            frames: memory.take("odometry.frames", 0)?,
            is_mean: false,
        })
    }

    /// All rows.
    pub fn texture(&self) -> &[i8] {
        &self.texture
    }

    /// Whether the texture is that of several frames.
    pub fn is_mean(&self) -> bool {
        self.is_mean
    }

    /// The current frame is the key from here on; `current` is what was the key.
    pub fn replace(&mut self, current: &mut Block<i8>) {
        std::mem::swap(&mut self.texture, current);
        self.is_mean = false;
    }

    /// Add what a frame shows, in which the belt has moved on by `shift_px`, to the means.
    pub fn add(&mut self, level: Level, current: &[i8], shift_px: f64) {
        self.become_mean();
        let whole = shift_px.floor();
        let (shift, fraction) = (whole as isize, (shift_px - whole) as f32);
        // Between two pixels of the current frame.
        let (from, to) = overlap_range(self.row, self.row - 1, shift);
        let means =
            self.mean.chunks_exact_mut(self.row).zip(self.frames.chunks_exact_mut(self.row));
        let keys = self.texture.chunks_exact_mut(self.row).zip(means);
        for ((texture, (mean, frames)), current) in keys.zip(current.chunks_exact(self.row)) {
            let current = &current[to.start..=to.end];
            let mut means = Means {
                texture: &mut texture[from.clone()],
                mean: &mut mean[from.clone()],
                frames: &mut frames[from.clone()],
            };
            add_to_means(level, current, fraction, FRAMES_MAX, &mut means);
        }
    }

    /// The key is where the belt is now, having moved on by whole pixels.
    pub fn move_on(&mut self, shift: isize) {
        self.become_mean();
        let (from, to) = overlap_range(self.row, self.row, shift);
        for texture in self.texture.chunks_exact_mut(self.row) {
            move_within(texture, from.clone(), to.clone(), NO_TEXTURE);
        }
        for mean in self.mean.chunks_exact_mut(self.row) {
            move_within(mean, from.clone(), to.clone(), 0.0);
        }
        for frames in self.frames.chunks_exact_mut(self.row) {
            move_within(frames, from.clone(), to.clone(), 0);
        }
    }

    fn become_mean(&mut self) {
        if !self.is_mean {
            let means = self.mean.iter_mut().zip(&mut *self.frames);
            for (&texture, (mean, frames)) in self.texture.iter().zip(means) {
                let is_known = texture != NO_TEXTURE;
                *mean = if is_known { f32::from(texture) } else { 0.0 };
                *frames = u8::from(is_known);
            }
            self.is_mean = true;
        }
    }
}

/// Move a part of a row; what is left free becomes `empty`.
fn move_within<T: Copy>(
    row: &mut [T],
    from: std::ops::Range<usize>,
    to: std::ops::Range<usize>,
    empty: T,
) {
    row.copy_within(from, to.start);
    row[..to.start].fill(empty);
    row[to.end..].fill(empty);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::scalar::texture::{Sums, correlate};
    use crate::stage::odometry::correlation::Correlation;

    const ROW: usize = 640;
    const ROWS: usize = 40;

    /// A belt's texture, smooth over 2 px, of about 4 units, under noise of 20.
    struct Belt {
        texture: Vec<f32>,
        state: u64,
    }

    impl Belt {
        fn random(state: &mut u64) -> f32 {
            let mut unit = || {
                *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (*state >> 40) as f32 / (1u64 << 24) as f32
            };
            // Nearly normal, of standard deviation 1.
            (0..12).map(|_| unit()).sum::<f32>() - 6.0
        }

        fn new() -> Self {
            let mut state = 1;
            let white: Vec<f32> = (0..ROWS * 2 * ROW).map(|_| Self::random(&mut state)).collect();
            let smooth = |i: usize| 4.0 * (white[i] + white[i.saturating_sub(1)]) / 1.4;
            Self { texture: (0..white.len()).map(smooth).collect(), state }
        }

        fn frame(&mut self, travel: usize) -> Vec<i8> {
            let mut frame = Vec::new();
            for j in 0..ROWS {
                for i in 0..ROW {
                    let texture = self.texture[j * 2 * ROW + ROW + i - travel];
                    let noise = 20.0 * Self::random(&mut self.state);
                    frame.push((texture + noise).round().clamp(-112.0, 112.0) as i8);
                }
            }
            frame
        }
    }

    fn likeness(key: &Key, current: &[i8], shift: isize) -> f64 {
        let mut sums = Sums::default();
        for (key, current) in key.texture().chunks_exact(ROW).zip(current.chunks_exact(ROW)) {
            correlate(key, current, shift, &mut sums);
        }
        Correlation::of(&sums).rho
    }

    fn key() -> (Key, Block<i8>) {
        let mut plan = Plan::default();
        Key::plan(ROW * ROWS, &mut plan);
        plan.add::<i8>("current", ROW * ROWS, "a frame");
        let mut memory = plan.reserve(16).expect("fits");
        (Key::new(ROW, &mut memory).expect("planned"), memory.take("current", 0).expect("planned"))
    }

    #[test]
    fn a_texture_under_noise_shows_in_the_mean_of_its_frames_also_after_the_key_has_moved_on() {
        let (mut belt, (mut key, mut current)) = (Belt::new(), key());
        current.copy_from_slice(&belt.frame(0));
        key.replace(&mut current);
        let single = likeness(&key, &belt.frame(8), 8);
        for k in 1..16 {
            key.add(Level::new(), &belt.frame(8 * k), 8.0 * k as f64);
        }
        let mean = likeness(&key, &belt.frame(128), 128);
        // 16 / (16 + 400) in one frame; the root of it in a mean of many.
        assert!((0.02..0.06).contains(&single), "{single}");
        assert!((0.11..0.21).contains(&mean), "{mean}");
        key.move_on(128);
        let moved = likeness(&key, &belt.frame(136), 8);
        assert!((moved - mean).abs() < 0.03, "{moved} {mean}");
    }

    #[test]
    fn what_the_key_did_not_see_comes_from_a_frame_that_does() {
        let (mut key, mut current) = key();
        current.fill(NO_TEXTURE);
        key.replace(&mut current);
        let frame: Vec<i8> = (0..ROW * ROWS).map(|i| (i % 7) as i8).collect();
        key.add(Level::new(), &frame, 2.0);
        let seen = &key.texture()[..ROW];
        assert_eq!(seen[..ROW - 3], frame[2..ROW - 1]);
        assert_eq!(seen[ROW - 3..], [NO_TEXTURE; 3]);
    }

    #[test]
    fn a_key_that_moves_on_further_than_its_length_knows_nothing() {
        for shift in [ROW as isize + 3, -(ROW as isize) - 3] {
            let (mut key, mut current) = key();
            current.fill(1);
            key.replace(&mut current);
            key.move_on(shift);
            assert!(key.texture().iter().all(|&t| t == NO_TEXTURE), "{shift}");
        }
    }
}
