//! Run-based connected components (8-connected) of a bit-packed mask.
//!
//! Source: He, Chao and Suzuki 2008, run-based two-scan labelling; union by smaller index.

use super::bits::words;

/// A horizontal run of set pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Run {
    /// Row.
    pub v: u16,
    /// First column.
    pub start: u16,
    /// One past the last column.
    pub end: u16,
    /// Before [`resolve`]: parent run; after: label of the component, from 0.
    pub label: u32,
}

/// Collect the runs of a mask into `runs` and join them. Returns the number of runs found;
/// when that exceeds `runs.len()`, the rows below the last stored run were not read.
pub fn collect(mask: &[u64], width: usize, runs: &mut [Run]) -> usize {
    let n = words(width);
    let mut count = 0;
    let mut above = 0..0;
    for (v, row) in mask.chunks_exact(n).enumerate() {
        let first = count;
        let mut from = 0;
        while let Some(start) = next_bit(row, from, width, true) {
            let end = next_bit(row, start, width, false).unwrap_or(width);
            if count == runs.len() {
                return count + 1;
            }
            runs[count] =
                Run { v: v as u16, start: start as u16, end: end as u16, label: count as u32 };
            count += 1;
            from = end;
        }
        join_rows(runs, above, first..count);
        above = first..count;
    }
    count
}

/// First column from `from` on whose bit equals `set`.
fn next_bit(row: &[u64], from: usize, width: usize, set: bool) -> Option<usize> {
    let flip = if set { 0 } else { u64::MAX };
    let mut w = from / 64;
    let mut word = (row.get(w)? ^ flip) & (u64::MAX << (from % 64));
    while word == 0 {
        w += 1;
        word = row.get(w)? ^ flip;
    }
    let at = w * 64 + word.trailing_zeros() as usize;
    (at < width).then_some(at)
}

/// Join touching runs of two neighbouring rows, both in order of columns.
fn join_rows(runs: &mut [Run], above: std::ops::Range<usize>, below: std::ops::Range<usize>) {
    let (mut a, mut b) = (above.start, below.start);
    while a < above.end && b < below.end {
        // 8-connected: touching corners overlap by one after widening.
        if runs[a].start <= runs[b].end && runs[b].start <= runs[a].end {
            let (x, y) = (root(runs, a), root(runs, b));
            runs[x.max(y)].label = x.min(y) as u32;
        }
        if runs[a].end < runs[b].end { a += 1 } else { b += 1 }
    }
}

fn root(runs: &mut [Run], mut i: usize) -> usize {
    while runs[i].label as usize != i {
        let parent = runs[i].label as usize;
        runs[i].label = runs[parent].label; // halve the path
        i = runs[i].label as usize;
    }
    i
}

/// Turn parents into labels 0, 1, ... in order of first appearance; returns how many.
pub fn resolve(runs: &mut [Run]) -> usize {
    let mut labels = 0;
    for i in 0..runs.len() {
        let parent = runs[i].label as usize;
        // A parent is never later than its child, so it is already resolved.
        runs[i].label = if parent == i {
            labels += 1;
            labels - 1
        } else {
            runs[parent].label
        };
    }
    labels as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    fn label(rows: &[&str]) -> (usize, Vec<Run>) {
        let width = rows[0].len();
        let mut mask = vec![0u64; words(width) * rows.len()];
        for (v, row) in rows.iter().enumerate() {
            for (u, _) in row.bytes().enumerate().filter(|&(_, c)| c == b'#') {
                mask[v * words(width) + u / 64] |= 1 << (u % 64);
            }
        }
        let mut runs = vec![Run::default(); 1024];
        let count = collect(&mask, width, &mut runs);
        runs.truncate(count);
        (resolve(&mut runs), runs)
    }

    #[test]
    fn diagonal_neighbours_are_one_component() {
        assert_eq!(label(&["#..", ".#.", "..#"]).0, 1);
        assert_eq!(label(&["#..", "...", "..#"]).0, 2);
        assert_eq!(label(&["#.#", "...", "#.#"]).0, 4);
    }

    #[test]
    fn a_spiral_and_a_comb_are_one_component() {
        assert_eq!(label(&["#####", "....#", "###.#", "#...#", "#####"]).0, 1);
        assert_eq!(label(&["#.#.#.#", "#.#.#.#", "#######"]).0, 1);
        assert_eq!(label(&["#######", "#.#.#.#", "#.#.#.#"]).0, 1);
    }

    #[test]
    fn runs_across_word_borders_are_whole() {
        let row = "#".repeat(130);
        let (n, runs) = label(&[&row]);
        assert_eq!((n, runs[0].start, runs[0].end), (1, 0, 130));
    }

    #[test]
    fn a_full_table_is_reported_and_never_overrun() {
        let mut runs = [Run::default(); 3];
        assert_eq!(collect(&[0b101_0101], 64, &mut runs), 4);
    }

    #[test]
    fn equals_flood_fill_on_random_masks() {
        let mut state = 3u64;
        for density in [1, 2, 3, 5] {
            let (width, rows) = (70, 20);
            let grid: Vec<Vec<bool>> = (0..rows)
                .map(|_| {
                    (0..width)
                        .map(|_| {
                            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(7);
                            (state >> 33) % 6 < density
                        })
                        .collect()
                })
                .collect();
            let text: Vec<String> = grid
                .iter()
                .map(|r| r.iter().map(|&b| if b { '#' } else { '.' }).collect())
                .collect();
            let lines: Vec<&str> = text.iter().map(String::as_str).collect();
            assert_eq!(label(&lines).0, flood_fill(grid), "density {density}");
        }
    }

    fn flood_fill(mut grid: Vec<Vec<bool>>) -> usize {
        let (rows, width) = (grid.len(), grid[0].len());
        let mut components = 0;
        for v in 0..rows {
            for u in 0..width {
                let mut stack = vec![(v, u)];
                if !grid[v][u] {
                    continue;
                }
                components += 1;
                while let Some((y, x)) = stack.pop() {
                    if std::mem::take(&mut grid[y][x]) {
                        for ny in y.saturating_sub(1)..(y + 2).min(rows) {
                            stack.extend(
                                (x.saturating_sub(1)..(x + 2).min(width)).map(|nx| (ny, nx)),
                            );
                        }
                    }
                }
            }
        }
        components
    }
}
