//! Log lines that strangers can cause: so many a minute, the others are counted.

use std::time::{Duration, Instant};

const WINDOW: Duration = Duration::from_mins(1);
const LINES_MAX: u32 = 20;

/// Counts lines of one kind.
#[derive(Debug, Default)]
pub(super) struct LogLimit {
    window: Option<Instant>,
    told: u32,
    held: u64,
}

impl LogLimit {
    /// Whether a line may be written; with how many were not since the last one.
    pub(super) fn admits(&mut self, now: Instant) -> Option<u64> {
        if self.window.is_none_or(|began| now.saturating_duration_since(began) >= WINDOW) {
            (self.window, self.told) = (Some(now), 0);
        }
        if self.told == LINES_MAX {
            self.held += 1;
            return None;
        }
        self.told += 1;
        Some(std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_some_lines_a_minute_and_its_number() {
        let (mut limit, start) = (LogLimit::default(), Instant::now());
        let told = (0..1000).filter(|_| limit.admits(start).is_some()).count();
        assert_eq!(told, 20);
        assert_eq!(limit.admits(start + Duration::from_secs(59)), None);
        assert_eq!(limit.admits(start + WINDOW), Some(981));
        assert_eq!(limit.admits(start + WINDOW), Some(0));
    }
}
