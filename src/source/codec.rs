//! What a video codec loses: a block quantiser of our own, as of H.264 without its search for motion.
//!
//! A frame is told as its difference to the frame before, in blocks of 8 x 8, as cosines (DCT-II) of one
//! coarse step. Small ones become nothing: faint texture freezes, or smears with the frame before. Every
//! so many frames one is told whole.

/// Side of a block.
const SIDE: usize = 8;
/// Frames from one that is told whole to the next.
const KEY_EVERY: u64 = 50;
/// What is added to a share of a step before it is cut to whole steps. Source: x264's default for
/// differences, a dead zone of 21/64.
const ROUNDING: f32 = 0.5 - 21.0 / 64.0;

/// An encoder and its decoder.
pub(super) struct Codec {
    step_grey: f32,
    size_px: [usize; 2],
    /// The frame before as it was decoded.
    decoded: Vec<u8>,
    frames: u64,
    /// Cosines by frequency and place.
    cosines: [[f32; SIDE]; SIDE],
}

impl Codec {
    /// With steps of so many grey levels.
    pub(super) fn new(step_grey: f64, size_px: [usize; 2]) -> Self {
        let cosine = |k: usize, n: usize| {
            let scale = if k == 0 { 1.0 } else { std::f32::consts::SQRT_2 } / (SIDE as f32).sqrt();
            let phase = std::f32::consts::PI * (n as f32 + 0.5) * k as f32 / SIDE as f32;
            scale * phase.cos()
        };
        Self {
            step_grey: step_grey as f32,
            size_px,
            decoded: vec![0; size_px[0] * size_px[1]],
            frames: 0,
            cosines: std::array::from_fn(|k| std::array::from_fn(|n| cosine(k, n))),
        }
    }

    /// Replace a frame by what is left of it.
    pub(super) fn pass(&mut self, frame: &mut [u8]) {
        let [width, height] = self.size_px;
        if self.frames.is_multiple_of(KEY_EVERY) {
            self.decoded.fill(128);
        }
        self.frames += 1;
        for top in (0..height).step_by(SIDE) {
            for left in (0..width).step_by(SIDE) {
                self.block(frame, left, top);
            }
        }
        frame.copy_from_slice(&self.decoded);
    }

    fn block(&mut self, frame: &[u8], left: usize, top: usize) {
        let [width, height] = self.size_px;
        // A block at the border repeats the last row and column.
        let at = |u: usize, v: usize| (top + v).min(height - 1) * width + (left + u).min(width - 1);
        let mut block = [[0.0f32; SIDE]; SIDE];
        for (v, row) in block.iter_mut().enumerate() {
            for (u, value) in row.iter_mut().enumerate() {
                *value = f32::from(frame[at(u, v)]) - f32::from(self.decoded[at(u, v)]);
            }
        }
        let told = self.transposed_transform(&block);
        let mut told = self.transposed_transform(&told);
        let mut is_empty = true;
        for cosine in told.iter_mut().flatten() {
            let steps = cosine.abs() / self.step_grey;
            let whole = (steps + ROUNDING).floor();
            *cosine = (whole * self.step_grey).copysign(*cosine);
            is_empty &= whole == 0.0;
        }
        if is_empty {
            return;
        }
        let back = self.transposed_inverse(&told);
        let back = self.transposed_inverse(&back);
        for (v, row) in back.iter().enumerate().take(height - top) {
            for (u, value) in row.iter().enumerate().take(width - left) {
                let old = &mut self.decoded[(top + v) * width + left + u];
                *old = (f32::from(*old) + value).round().clamp(0.0, 255.0) as u8;
            }
        }
    }

    /// Of every row, its cosines as a column.
    fn transposed_transform(&self, block: &[[f32; SIDE]; SIDE]) -> [[f32; SIDE]; SIDE] {
        let sum = |k: usize, row: &[f32; SIDE]| {
            row.iter().zip(&self.cosines[k]).map(|(value, cosine)| value * cosine).sum()
        };
        std::array::from_fn(|k| std::array::from_fn(|v| sum(k, &block[v])))
    }

    /// Of every row of cosines, the values as a column.
    fn transposed_inverse(&self, told: &[[f32; SIDE]; SIDE]) -> [[f32; SIDE]; SIDE] {
        let sum = |n: usize, row: &[f32; SIDE]| {
            row.iter().zip(&self.cosines).map(|(value, cosine)| value * cosine[n]).sum()
        };
        std::array::from_fn(|n| std::array::from_fn(|v| sum(n, &told[v])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::synthetic::Random;

    /// A belt of faint texture that moves by a px a frame under a bright box that does not.
    fn frame(index: usize) -> Vec<u8> {
        let mut random = Random(5);
        let texture: Vec<f64> = (0..200 * 40).map(|_| random.normal()).collect();
        let mut frame = vec![0; 61 * 37];
        for (i, grey) in frame.iter_mut().enumerate() {
            let (u, v) = (i % 61, i / 61);
            let belt = 45.0 + 1.3 * texture[v * 200 + u + 100 - index];
            *grey = if (20..40).contains(&u) && (10..30).contains(&v) { 160 } else { belt as u8 };
        }
        frame
    }

    /// On the belt beside the blocks of the box.
    fn mean_difference(a: &[u8], b: &[u8]) -> f64 {
        let belt = || (0..61 * 37).filter(|i| i % 61 >= 40);
        let sum: f64 = belt().map(|i| f64::from(a[i].abs_diff(b[i]))).sum();
        sum / belt().count() as f64
    }

    #[test]
    fn a_fine_step_loses_nothing() {
        let mut codec = Codec::new(0.1, [61, 37]);
        for index in 0..5 {
            let (truth, mut told) = (frame(index), frame(index));
            codec.pass(&mut told);
            assert_eq!(told, truth);
        }
    }

    #[test]
    fn a_coarse_step_freezes_faint_texture_and_keeps_what_stands_out() {
        let mut codec = Codec::new(24.0, [61, 37]);
        let mut before = frame(0);
        codec.pass(&mut before);
        let (mut moved, mut shown) = (0.0, 0.0);
        for index in 1..20 {
            let (truth, mut told) = (frame(index), frame(index));
            codec.pass(&mut told);
            let box_at = 20 * 61 + 30;
            assert!(told[box_at].abs_diff(160) < 24, "{}", told[box_at]);
            moved += mean_difference(&truth, &frame(index - 1));
            shown += mean_difference(&told, &before);
            before = told;
        }
        // The belt moved, the picture of it hardly did: a block's mean is told now and then.
        assert!(moved > 0.8 * 19.0 && shown < 0.25 * moved, "{shown} of {moved}");
    }
}
