//! Sensor noise, a step of its own: shot noise and read noise, then rounding to 8 bits.
//!
//! Deterministic: the noise of frame n depends on the seed and n alone.

use super::random::Random;
use super::scenario::NoiseTable;

const TABLE: usize = 1 << 16;

/// Noise generator.
pub struct Noise {
    seed: u64,
    /// Standard normal values, Q8.
    normal: Vec<i16>,
    /// Standard deviation for each grey level, Q8.
    sigma: [i32; 256],
}

impl Noise {
    /// Tables for a seed.
    pub fn new(seed: u64, table: &NoiseTable) -> Self {
        let mut random = Random(seed ^ 0x006e_6f69_7365);
        let normal = (0..TABLE).map(|_| (random.normal() * 256.0).round() as i16).collect();
        let variance = |grey: usize| {
            table.read_grey * table.read_grey + grey as f64 / table.electrons_per_grey
        };
        let sigma = std::array::from_fn(|grey| (variance(grey).sqrt() * 256.0).round() as i32);
        Self { seed, normal, sigma }
    }

    /// `noisy` = `clean` (1/256 grey levels, rows of `width`) with noise, rounded.
    pub fn apply(&self, index: u64, clean: &[u16], width: usize, noisy: &mut [u8]) {
        let mut random = Random(self.seed ^ index.wrapping_mul(0x0100_0000_01b3));
        for (clean, noisy) in clean.chunks(width).zip(noisy.chunks_mut(width)) {
            let start = random.bits() as usize;
            for (i, (&value, out)) in clean.iter().zip(noisy).enumerate() {
                let normal = i32::from(self.normal[(start + i) % TABLE]);
                let sigma = self.sigma[usize::from(value >> 8)];
                let sum = i32::from(value) + ((normal * sigma) >> 8) + 128;
                *out = (sum >> 8).clamp(0, 255) as u8;
            }
        }
    }
}
