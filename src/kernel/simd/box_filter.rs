//! [`crate::kernel::scalar::box_filter`] in vectors.

use crate::kernel::scalar::box_filter as scalar;
use fearless_simd::{Level, dispatch};

/// Mean over a square of neighbours, in place.
pub fn box_filter(level: Level, values: &mut [f32], scratch: &mut [f32], width: usize) {
    dispatch!(level, _simd => scalar::box_filter(values, scratch, width));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::simd::each_level;

    #[test]
    fn every_level_gives_the_bits_of_the_specification() {
        const WIDTH: usize = 61;
        let picture: Vec<f32> = (0..WIDTH * 23).map(|i| ((i * 7919) % 1013) as f32 / 7.0).collect();
        let mut scratch = vec![0.0; picture.len()];
        let mut expected = picture.clone();
        scalar::box_filter(&mut expected, &mut scratch, WIDTH);
        each_level(|level| {
            let mut values = picture.clone();
            box_filter(level, &mut values, &mut scratch, WIDTH);
            assert!(values.iter().zip(&expected).all(|(a, b)| a.to_bits() == b.to_bits()));
        });
    }
}
