//! Binary morphology on bit-packed rows: pixel u of a row is bit `u % 64` of word `u / 64`.
//!
//! Bits beyond the width are kept 0. Outside the image counts as 0 for dilation and as 1 for
//! erosion, so a shape at the border is not eaten from outside (`OpenCV`'s default).

/// Words in a row of `width` pixels.
pub const fn words(width: usize) -> usize {
    width.div_ceil(64)
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

/// 3x3 dilation of `src` into `dst`, rows of `width` pixels.
pub fn dilate3x3(src: &[u64], dst: &mut [u64], width: usize) {
    filter3x3(src, dst, width, false);
}

/// 3x3 erosion of `src` into `dst`: the dilation of the complement, complemented.
pub fn erode3x3(src: &[u64], dst: &mut [u64], width: usize) {
    filter3x3(src, dst, width, true);
}

/// Dilation of `src ^ invert`, written `^ invert`.
fn filter3x3(src: &[u64], dst: &mut [u64], width: usize, invert: bool) {
    let n = words(width);
    let rows = src.len() / n;
    let flip = if invert { u64::MAX } else { 0 };
    let mask = |w: usize| if w + 1 == n { last_word_mask(width) } else { u64::MAX };
    for y in 0..rows {
        let above = y.saturating_sub(1);
        let below = (y + 1).min(rows - 1);
        // A row outside repeats the centre row, which changes no maximum.
        let column = |w: usize| {
            let any = [above, y, below].iter().fold(0, |acc, r| acc | (src[r * n + w] ^ flip));
            any & mask(w)
        };
        let mut left = 0;
        let mut centre = column(0);
        for w in 0..n {
            let right = if w + 1 < n { column(w + 1) } else { 0 };
            let spread = centre | centre << 1 | left >> 63 | centre >> 1 | right << 63;
            dst[y * n + w] = (spread ^ flip) & mask(w);
            (left, centre) = (centre, right);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn naive(src: &[u64], width: usize, rows: usize, erode: bool) -> Vec<u64> {
        let n = words(width);
        let get = |x: i64, y: i64| {
            let inside = x >= 0 && y >= 0 && x < width as i64 && y < rows as i64;
            if inside { src[y as usize * n + x as usize / 64] >> (x % 64) & 1 == 1 } else { erode }
        };
        let mut out = vec![0; src.len()];
        for y in 0..rows as i64 {
            for x in 0..width as i64 {
                let mut near = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)));
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
                    let mut out = vec![0xa5a5; n * rows];
                    dilate3x3(&src, &mut out, width);
                    assert_eq!(out, naive(&src, width, rows, false), "dilate {width}x{rows}");
                    erode3x3(&src, &mut out, width);
                    assert_eq!(out, naive(&src, width, rows, true), "erode {width}x{rows}");
                }
            }
        }
    }
}
