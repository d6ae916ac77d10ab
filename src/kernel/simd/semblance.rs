//! [`crate::kernel::scalar::semblance`] in vectors.

use crate::kernel::scalar::semblance::{self as scalar, CellSums, Columns, StepRow, StepSums};
use fearless_simd::{Level, dispatch};

/// Add a view's cells; all slices are as long as `out.sum`.
pub fn add_cells(level: Level, columns: Columns<'_>, out: &mut CellSums<'_>) {
    dispatch!(level, _simd => scalar::add_cells(columns, out));
}

/// Add a view's pixels; all slices are as long as `out.along`.
pub fn add_steps(level: Level, row: StepRow<'_>, out: &mut StepSums<'_>) {
    dispatch!(level, _simd => scalar::add_steps(row, out));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::scalar::semblance::VIEWS_MAX;
    use crate::kernel::simd::each_level;

    const N: usize = 101;

    fn random(seed: u64) -> impl FnMut() -> u64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            state >> 33
        }
    }

    type Cells = ([i16; N], [i32; N], [i16; N]);

    fn sum_cells(
        mut add: impl FnMut(Columns<'_>, &mut CellSums<'_>),
        value: fn(u64) -> i8,
    ) -> Cells {
        let mut next = random(1);
        let mut sums: Cells = ([0; N], [0; N], [0; N]);
        for view in 0..VIEWS_MAX {
            let values: [[i8; N]; 2] =
                std::array::from_fn(|_| std::array::from_fn(|_| value(next())));
            let seen: [[u8; N]; 2] = std::array::from_fn(|_| {
                std::array::from_fn(|i| u8::from(i < 50 || !next().is_multiple_of(5)))
            });
            let columns = Columns {
                values: values.each_ref().map(<[i8; N]>::as_slice),
                seen: seen.each_ref().map(<[u8; N]>::as_slice),
                fraction: (view % 17) as i16,
            };
            let mut out = CellSums { sum: &mut sums.0, squares: &mut sums.1, views: &mut sums.2 };
            add(columns, &mut out);
        }
        sums
    }

    #[test]
    fn every_level_adds_the_cells_of_the_specification_to_the_largest_sums() {
        for value in [|v| v as i8, |_| i8::MIN, |_| i8::MAX] {
            let expected = sum_cells(scalar::add_cells, value);
            each_level(|level| {
                let sums = sum_cells(|columns, out| add_cells(level, columns, out), value);
                assert!(sums == expected, "{level:?}");
            });
        }
    }

    type Steps = ([i16; N], [i16; N], [i32; N], [u16; N], [u16; N]);

    fn sum_steps(
        mut add: impl FnMut(StepRow<'_>, &mut StepSums<'_>),
        value: fn(u64) -> i8,
    ) -> Steps {
        let mut next = random(2);
        let mut sums: Steps = ([0; N], [0; N], [0; N], [0; N], [0; N]);
        for _ in 0..VIEWS_MAX {
            let steps: [[i8; N]; 2] =
                std::array::from_fn(|_| std::array::from_fn(|_| value(next())));
            let grey: [u8; N] = std::array::from_fn(|_| value(next()) as u8);
            let usable: [u8; N] =
                std::array::from_fn(|i| if i < 50 || !next().is_multiple_of(5) { 255 } else { 0 });
            let row = StepRow { along: &steps[0], across: &steps[1], grey: &grey, usable: &usable };
            let mut out = StepSums {
                along: &mut sums.0,
                across: &mut sums.1,
                energy: &mut sums.2,
                grey: &mut sums.3,
                views: &mut sums.4,
            };
            add(row, &mut out);
        }
        sums
    }

    #[test]
    fn every_level_adds_the_steps_of_the_specification_to_the_largest_sums() {
        for value in [|v| v as i8, |_| -127, |_| i8::MAX] {
            let expected = sum_steps(scalar::add_steps, value);
            each_level(|level| {
                let sums = sum_steps(|row, out| add_steps(level, row, out), value);
                assert!(sums == expected, "{level:?}");
            });
        }
    }
}
