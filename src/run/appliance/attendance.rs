//! Which share of the frames has come of late.

/// Seconds looked back at.
const SECONDS: usize = 10;
/// One frame in so many may be missing: the fit of a parcel does not feel it.
const ONE_IN: u64 = 100;
/// A single one is no fault, however slow the camera.
const MISSING_MIN: u64 = 2;

/// Frames of one second.
#[derive(Clone, Copy, Default)]
struct Second {
    number: i64,
    came: u64,
    missing: u64,
}

/// Frames that came and frames that are missing, over the last seconds.
#[derive(Default)]
pub(super) struct Attendance {
    seconds: [Second; SECONDS],
    now: i64,
}

impl Attendance {
    /// A frame came, and `missing` before it did not.
    pub(super) fn frame(&mut self, t_s: f64, missing: u64) {
        self.now = t_s.floor() as i64;
        let second = &mut self.seconds[self.now.rem_euclid(SECONDS as i64) as usize];
        if second.number != self.now {
            *second = Second { number: self.now, ..Second::default() };
        }
        second.came += 1;
        second.missing = second.missing.saturating_add(missing);
    }

    /// Whether so many are missing that it must be told.
    pub(super) fn too_many_missing(&self) -> bool {
        let last = self.now - SECONDS as i64 + 1..=self.now;
        let seconds = self.seconds.iter().filter(|second| last.contains(&second.number));
        let [came, missing] = seconds.fold([0u64; 2], |[came, missing], second| {
            [came + second.came, missing.saturating_add(second.missing)]
        });
        missing >= MISSING_MIN && missing > came.saturating_add(missing) / ONE_IN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames at 50 a second, of which `is_missing` says which do not come; whether it is told at the end.
    fn told(seconds: u64, is_missing: impl Fn(u64) -> bool) -> bool {
        let (mut attendance, mut missing) = (Attendance::default(), 0);
        for frame in 0..50 * seconds {
            if is_missing(frame) {
                missing += 1;
            } else {
                attendance.frame(frame as f64 / 50.0, missing);
                missing = 0;
            }
        }
        attendance.too_many_missing()
    }

    #[test]
    fn more_than_one_missing_in_a_hundred_is_told_while_it_is_so() {
        assert!(!told(60, |_| false));
        assert!(told(60, |frame| frame % 3 == 0), "30 %");
        assert!(told(60, |frame| frame % 90 == 0), "a little more than 1 %");
        assert!(!told(60, |frame| frame % 110 == 0), "a little less");
        assert!(told(60, |frame| frame / 50 == 52), "a second, 8 s ago");
        assert!(!told(60, |frame| frame / 50 == 40), "a second, 20 s ago");
    }

    #[test]
    fn a_single_frame_of_a_slow_camera_and_a_clock_that_jumps_are_no_fault() {
        let mut attendance = Attendance::default();
        attendance.frame(0.0, 0);
        attendance.frame(0.4, 1);
        assert!(!attendance.too_many_missing());
        for t_s in [1e12, -5.0, 0.6] {
            attendance.frame(t_s, 0);
            assert!(!attendance.too_many_missing(), "{t_s}");
        }
        attendance.frame(0.8, u64::MAX);
        assert!(attendance.too_many_missing());
    }
}
