//! Bands of rows, each worked on by a thread of its own.
//!
//! What a band gives does not depend on how many there are. With one band nothing but the calling
//! thread is used; with more, the thread pool that it runs in (`rayon`, whose `join` allocates
//! nothing).

/// The most bands there can be: more threads than a small edge box has.
pub const BANDS_MAX: usize = 8;

/// The jobs of a plane, one a band.
pub type Jobs<J> = heapless::Vec<J, BANDS_MAX>;

/// Rows of each band but the last.
pub fn rows_per_band(rows: usize, bands: usize) -> usize {
    rows.div_ceil(bands.clamp(1, BANDS_MAX)).max(1)
}

/// Do all jobs.
pub fn run<J: Send>(jobs: &mut [J], work: &(impl Fn(&mut J) + Sync)) {
    match jobs {
        [] => {}
        [job] => work(job),
        _ => {
            let (first, second) = jobs.split_at_mut(jobs.len() / 2);
            rayon::join(|| run(first, work), || run(second, work));
        }
    }
}

/// Do two different things, side by side when there is more than one band.
pub fn join(bands: usize, one: impl FnOnce() + Send, other: impl FnOnce() + Send) {
    if bands > 1 {
        rayon::join(one, other);
    } else {
        one();
        other();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_job_is_done_once() {
        for count in 0..=BANDS_MAX {
            let mut jobs: Jobs<usize> = (0..count).collect();
            run(&mut jobs, &|job| *job += 100);
            assert!(jobs.iter().copied().eq(100..100 + count));
        }
    }

    #[test]
    fn bands_cover_all_rows() {
        for rows in [0, 1, 7, 8, 9, 1200] {
            for bands in [0, 1, 2, 3, 8, 100] {
                let each = rows_per_band(rows, bands);
                assert!(rows.div_ceil(each) <= BANDS_MAX && each > 0);
            }
        }
    }
}
