//! Whether pictures were coded in blocks, as JPEG and H.264 do.
//!
//! In: raw frames. Out: one bit. What such a codec leaves of a faint texture sticks to the picture's blocks, not to the belt; its
//! steps are larger where two blocks of 8 pixels meet than elsewhere.
//! Source: no-reference blockiness, Wang, Sheikh and Bovik 2002.

use crate::image::Plane;

/// Side of a block, px.
const SIDE_PX: usize = 8;
/// Of so many rows one is looked at, another in each frame: a codec shows in all of them, and all of them cost time.
const EVERY_ROW: usize = 64;
/// Larger steps than this are edges of things, grey levels.
const STEP_MAX: u8 = 8;
/// Steps from block to block are so many times larger. Seen: 1.0 to 1.15 without a codec, 1.5 to 10 with JPEG of quality 92 to
/// 30; H.264 at its default reaches 1.3 on a belt of strong texture, where little is lost, and 2.3 elsewhere.
const STEP_RATIO: f32 = 1.3;
/// How fast the sums are followed, a frame: half of them are those of the last 14.
const FOLLOW: f32 = 0.05;

/// Sums of the steps from one pixel to the next, for each place in a block, followed.
#[derive(Default)]
pub struct Blocks {
    steps: [f32; SIDE_PX],
    first_row: usize,
}

impl Blocks {
    /// One frame more.
    pub fn add(&mut self, raw: Plane<'_>) {
        let mut sums = [0u32; SIDE_PX];
        for row in (self.first_row..raw.height()).step_by(EVERY_ROW) {
            let row = raw.row(row);
            // Whole blocks and the pixel after.
            for from in (0..row.len().saturating_sub(SIDE_PX)).step_by(SIDE_PX) {
                let pixels = &row[from..=from + SIDE_PX];
                for (sum, pair) in sums.iter_mut().zip(pixels.windows(2)) {
                    *sum += u32::from(pair[0].abs_diff(pair[1]).min(STEP_MAX));
                }
            }
        }
        self.first_row = (self.first_row + 1) % EVERY_ROW;
        for (mean, &sum) in self.steps.iter_mut().zip(&sums) {
            *mean += FOLLOW * (sum as f32 - *mean);
        }
    }

    /// Whether the pictures were coded in blocks.
    pub fn are_seen(&self) -> bool {
        let mut steps = self.steps;
        steps.sort_unstable_by(f32::total_cmp);
        steps[SIDE_PX - 1] > STEP_RATIO * steps[SIDE_PX / 2]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames of noise, each mean over a block changed by up to `block_grey`.
    fn seen(block_grey: u64) -> bool {
        let mut state = 7u64;
        let mut random = |n: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 33) % n
        };
        let mut blocks = Blocks::default();
        for _ in 0..40 {
            let mut frame = vec![0u8; 640 * 400];
            for row in frame.chunks_exact_mut(640) {
                for block in row.chunks_exact_mut(SIDE_PX) {
                    let mean = 100 + random(block_grey + 1);
                    for grey in block {
                        *grey = (mean + random(4)) as u8;
                    }
                }
            }
            blocks.add(Plane::packed(&frame, 640, 400).expect("this size"));
        }
        blocks.are_seen()
    }

    #[test]
    fn what_a_codec_leaves_is_seen_and_noise_is_none() {
        assert!(!seen(0));
        assert!(seen(4));
    }

    #[test]
    fn a_frame_smaller_than_a_block_shows_none() {
        let mut blocks = Blocks::default();
        blocks.add(Plane::packed(&[5; 12], 4, 3).expect("this size"));
        blocks.add(Plane::packed(&[], 0, 0).expect("nothing"));
        assert!(!blocks.are_seen());
    }
}
