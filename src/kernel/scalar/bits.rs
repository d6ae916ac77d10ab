//! Binary morphology on bit-packed rows: pixel u of a row is bit `u % 64` of word `u / 64`.
//!
//! Bits beyond the width are kept 0. Outside the image counts as 0 for dilation and as 1 for
//! erosion, so a shape at the border is not eaten from outside (`OpenCV`'s default).

use crate::kernel::bands::{self, Jobs, rows_per_band};
use std::ops::Range;

/// Words in a row of `width` pixels.
pub const fn words(width: usize) -> usize {
    width.div_ceil(64)
}

/// Pixels from one row to the next in a plane beside such a mask: rows are whole words.
pub const fn stride(width: usize) -> usize {
    words(width) * 64
}

/// The valid bits of a row's last word.
pub const fn last_word_mask(width: usize) -> u64 {
    match width % 64 {
        0 => u64::MAX,
        n => (1 << n) - 1,
    }
}

/// Bit `u` of a row.
pub fn get(row: &[u64], u: usize) -> bool {
    row[u / 64] >> (u % 64) & 1 == 1
}

/// Set bits `start..end` of a row.
pub fn set(row: &mut [u64], start: u16, end: u16) {
    for_words(start, end, |w, mask| row[w] |= mask);
}

/// Count the set bits of `row[start..end]`.
pub fn count(row: &[u64], start: u16, end: u16) -> u32 {
    let mut sum = 0;
    for_words(start, end, |w, mask| sum += (row[w] & mask).count_ones());
    sum
}

/// The words that bits `start..end` lie in, each with the mask of these bits.
fn for_words(start: u16, end: u16, mut visit: impl FnMut(usize, u64)) {
    if start >= end {
        return;
    }
    let (first, last) = (usize::from(start) / 64, usize::from(end - 1) / 64);
    for w in first..=last {
        let from = if w == first { u64::MAX << (start % 64) } else { u64::MAX };
        let to = if w == last { u64::MAX >> (63 - (end - 1) % 64) } else { u64::MAX };
        visit(w, from & to);
    }
}

/// A square that masks of `width` pixels a row are filtered with.
#[derive(Clone, Copy, Debug)]
pub struct Square {
    /// Pixels of a row.
    pub width: usize,
    /// Pixels to all sides of the middle; at most 63.
    pub radius: usize,
    /// Bands of rows that are filtered side by side.
    pub bands: usize,
}

impl Square {
    /// Widen every shape of a mask. `scratch` has its size.
    pub fn dilate(&self, mask: &mut [u64], scratch: &mut [u64]) {
        let Some(rows) = self.along_rows(mask, scratch, 0) else { return };
        let reached = rows.start.saturating_sub(self.radius)..rows.end + self.radius;
        self.across_rows(mask, scratch, &reached, 0);
    }

    /// Narrow every shape: the dilation of the complement, complemented.
    pub fn erode(&self, mask: &mut [u64], scratch: &mut [u64]) {
        let Some(rows) = self.along_rows(mask, scratch, u64::MAX) else { return };
        self.across_rows(mask, scratch, &rows, u64::MAX);
    }

    /// Dilate each row of `mask ^ flip` into `out`, `^ flip`. Returns the rows that are not empty;
    /// `None` when there is nothing to do.
    fn along_rows(&self, mask: &[u64], out: &mut [u64], flip: u64) -> Option<Range<usize>> {
        let n = words(self.width);
        if n == 0 || self.radius == 0 {
            return None;
        }
        let rows = rows_per_band(mask.len() / n, self.bands);
        let parts = mask.chunks(rows * n).zip(out.chunks_mut(rows * n)).enumerate();
        let mut jobs: Jobs<_> = parts.map(|(i, part)| (i * rows, part, None)).collect();
        bands::run(&mut jobs, &|(first, (mask, out), filled)| {
            let filled_rows = self.along_rows_of_band(mask, out, flip);
            *filled = filled_rows.map(|rows| *first + rows.start..*first + rows.end);
        });
        let filled = jobs.into_iter().filter_map(|(_, _, filled)| filled);
        filled.reduce(|all, more| all.start..more.end)
    }

    fn along_rows_of_band(&self, mask: &[u64], out: &mut [u64], flip: u64) -> Option<Range<usize>> {
        let n = words(self.width);
        let last = last_word_mask(self.width);
        let mut filled: Option<Range<usize>> = None;
        for (y, (row, out)) in mask.chunks_exact(n).zip(out.chunks_exact_mut(n)).enumerate() {
            if row.iter().all(|&word| word == 0) {
                out.fill(0);
                continue;
            }
            filled = Some(filled.map_or(y, |rows| rows.start)..y + 1);
            let word = |w: usize| {
                let valid = if w + 1 == n { last } else { u64::MAX };
                row.get(w).map_or(0, |bits| (bits ^ flip) & valid)
            };
            let (mut before, mut here) = (0, word(0));
            for (w, out) in out.iter_mut().enumerate() {
                let after = word(w + 1);
                *out = spread([before, here, after], self.radius) ^ flip;
                (before, here) = (here, after);
            }
            out[n - 1] &= last;
        }
        filled
    }

    /// Dilate each column of `src ^ flip` into `mask`, `^ flip`; outside of the rows `reached`
    /// there is nothing.
    fn across_rows(&self, mask: &mut [u64], src: &[u64], reached: &Range<usize>, flip: u64) {
        let n = words(self.width);
        let rows = src.len() / n;
        let each = rows_per_band(rows, self.bands);
        let mut jobs: Jobs<_> = mask.chunks_mut(each * n).enumerate().collect();
        bands::run(&mut jobs, &|(band, mask)| {
            for (y, out) in (*band * each..).zip(mask.chunks_exact_mut(n)) {
                if !reached.contains(&y) {
                    out.fill(0);
                    continue;
                }
                let near = y.saturating_sub(self.radius)..(y + self.radius + 1).min(rows);
                out.copy_from_slice(&src[y * n..(y + 1) * n]);
                for row in src[near.start * n..near.end * n].chunks_exact(n) {
                    for (out, bits) in out.iter_mut().zip(row) {
                        *out = ((*out ^ flip) | (bits ^ flip)) ^ flip;
                    }
                }
            }
        });
    }
}

/// The middle one of three words, its bits spread by `radius` places to both sides.
fn spread([before, here, after]: [u64; 3], radius: usize) -> u64 {
    if before | here | after == 0 {
        return 0;
    }
    let mut up = u128::from(here) << 64 | u128::from(before);
    let mut down = u128::from(after) << 64 | u128::from(here);
    let mut reached = 0;
    while reached < radius {
        let step = (reached + 1).min(radius - reached);
        up |= up << step;
        down |= down >> step;
        reached += step;
    }
    (up >> 64) as u64 | down as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn naive(src: &[u64], width: usize, rows: usize, radius: i64, erode: bool) -> Vec<u64> {
        let n = words(width);
        let get = |x: i64, y: i64| {
            let inside = x >= 0 && y >= 0 && x < width as i64 && y < rows as i64;
            if inside { src[y as usize * n + x as usize / 64] >> (x % 64) & 1 == 1 } else { erode }
        };
        let mut out = vec![0; src.len()];
        for y in 0..rows as i64 {
            for x in 0..width as i64 {
                let mut near =
                    (-radius..=radius).flat_map(|dy| (-radius..=radius).map(move |dx| (dx, dy)));
                let set = if erode {
                    near.all(|(dx, dy)| get(x + dx, y + dy))
                } else {
                    near.any(|(dx, dy)| get(x + dx, y + dy))
                };
                out[y as usize * n + x as usize / 64] |= u64::from(set) << (x % 64);
            }
        }
        out
    }

    #[test]
    fn bits_are_set_and_counted_across_words() {
        let row = [u64::MAX, 0b1011, u64::MAX];
        let counts = [(0, 64, 64), (60, 66, 6), (66, 67, 0), (63, 129, 5), (9, 9, 0)];
        for (start, end, expected) in counts {
            assert_eq!(count(&row, start, end), expected, "{start}..{end}");
        }
        for (start, end) in [(0, 64), (60, 66), (63, 129), (5, 5), (64, 128)] {
            let mut row = [0; 3];
            set(&mut row, start, end);
            assert_eq!(count(&row, 0, 192), u32::from(end - start));
            assert!((start..end).all(|u| get(&row, usize::from(u))));
        }
    }

    #[test]
    fn equals_the_naive_filter_for_every_width_and_fill() {
        for width in [1, 2, 63, 64, 65, 127, 128, 130] {
            for rows in [1, 2, 5] {
                let n = words(width);
                let mut state = 9u64;
                let random = std::iter::repeat_with(|| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    state ^ state >> 29
                });
                let mut fills = vec![vec![0; n * rows], vec![u64::MAX; n * rows]];
                fills.push(random.take(n * rows).collect());
                for mut src in fills {
                    for row in src.chunks_mut(n) {
                        row[n - 1] &= last_word_mask(width);
                    }
                    for (radius, bands) in [(0, 1), (1, 1), (2, 3), (3, 2), (8, 8), (63, 1)] {
                        let square = Square { width, radius, bands };
                        let mut scratch = vec![0xa5a5; n * rows];
                        let mut out = src.clone();
                        square.dilate(&mut out, &mut scratch);
                        let side = radius as i64;
                        let expected = naive(&src, width, rows, side, false);
                        assert_eq!(out, expected, "dilate {width}x{rows} by {radius}");
                        out.copy_from_slice(&src);
                        square.erode(&mut out, &mut scratch);
                        let expected = naive(&src, width, rows, side, true);
                        assert_eq!(out, expected, "erode {width}x{rows} by {radius}");
                    }
                }
            }
        }
    }
}
