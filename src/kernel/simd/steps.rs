//! [`crate::kernel::scalar::steps`] in vectors.

use crate::kernel::scalar::steps::{self as scalar, Rows};
use fearless_simd::{Level, dispatch};

/// Steps to the right and upwards.
pub fn take_steps(level: Level, rows: Rows<'_>, along: &mut [i8], across: &mut [i8]) {
    dispatch!(level, _simd => scalar::take_steps(rows, along, across));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::each_level;

    #[test]
    fn every_level_takes_the_steps_of_the_specification() {
        const N: usize = 103;
        let value = |i: usize| ((i * 7919) % 1013) as f32 / 700.0 - 0.7;
        let line = |k: usize| -> Vec<f32> { (0..N + 2).map(|i| value(i + 311 * k)).collect() };
        let [above, mut here, below] = [0, 1, 2].map(line);
        here[17] = f32::NAN;
        let rows = Rows { above: &above, here: &here, below: &below };
        let steps = |take: &dyn Fn(&mut [i8], &mut [i8])| {
            let mut steps = [[0i8; N]; 2];
            let [along, across] = &mut steps;
            take(along, across);
            steps
        };
        let expected = steps(&|along, across| scalar::take_steps(rows, along, across));
        each_level(|level| {
            assert_eq!(steps(&|along, across| take_steps(level, rows, along, across)), expected);
        });
    }
}
