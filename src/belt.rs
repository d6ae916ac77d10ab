//! Belt position over time, and how far it can be trusted; an encoder's counts as its witness.

use heapless::Deque;

/// Relative standard uncertainty of a nominal speed that may be off by 5 % (uniform).
const NOMINAL_SIGMA: f64 = 0.05 / 1.732;
/// What remains when the belt's texture was seen all along: interpolation and calibration.
const MEASURED_SIGMA: f64 = 0.0003;

/// Where a codec's blocks pull a faint texture along: seen are up to 0.0035, by JPEG of quality 40.
const CODED_SIGMA: f64 = 0.0035;

/// Where the belt is: accumulated travel since start.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BeltPosition {
    /// Travel since start, mm.
    pub travel_mm: f64,
    /// The part of it that was measured rather than assumed from the speed.
    pub measured_mm: f64,
    /// The part of it along which a codec's blocks may have pulled the measurement.
    pub coded_mm: f64,
    /// Times that the belt was lost: nothing is known of the travel over such a break.
    pub breaks: u32,
}

impl BeltPosition {
    /// One frame on.
    pub fn advance(&mut self, step_mm: f64, measured: bool) {
        self.travel_mm += step_mm;
        if measured {
            self.measured_mm += step_mm;
        }
    }

    /// The last step may have been pulled by a codec's blocks.
    pub fn doubt(&mut self, step_mm: f64) {
        self.coded_mm += step_mm;
    }

    /// What comes is no travel from here.
    pub fn lose(&mut self) {
        self.breaks = self.breaks.wrapping_add(1);
    }

    /// Relative standard uncertainty of the travel since `start`.
    pub fn sigma_since(&self, start: &Self) -> f64 {
        if self.breaks != start.breaks {
            return 1.0;
        }
        let travel = self.travel_mm - start.travel_mm;
        let assumed = travel - (self.measured_mm - start.measured_mm);
        let coded = self.coded_mm - start.coded_mm;
        let [assumed, coded] = [assumed, coded]
            .map(|part| if travel.abs() > 1e-6 { (part / travel).clamp(0.0, 1.0) } else { 1.0 });
        MEASURED_SIGMA.hypot(NOMINAL_SIGMA * assumed).hypot(CODED_SIGMA * coded)
    }
}

/// Travel over which encoder and texture are compared, mm: beyond it, older travel fades.
const COMPARED_MM: f64 = 4000.0;
/// Less travel compares nothing, mm.
const COMPARED_MIN_MM: f64 = 300.0;
/// Standard uncertainty of either end of the compared travel, mm: jitter of the counts.
const COMPARED_SIGMA_MM: f64 = 0.7;
/// Beyond so many standard uncertainties encoder and texture disagree.
const DISAGREE_SIGMA: f64 = 4.0;

/// An encoder's travel over that of the belt's texture.
#[derive(Clone, Copy, Debug, Default)]
pub struct EncoderRatio {
    encoder_mm: f64,
    texture_mm: f64,
}

impl EncoderRatio {
    /// The travel of a frame, by both.
    pub fn add(&mut self, encoder_mm: f64, texture_mm: f64) {
        self.encoder_mm += encoder_mm;
        self.texture_mm += texture_mm;
        if self.texture_mm.abs() > COMPARED_MM {
            self.encoder_mm *= 0.5;
            self.texture_mm *= 0.5;
        }
    }

    /// The ratio and its standard uncertainty; `None` before the belt has travelled far enough.
    pub fn ratio(&self) -> Option<(f64, f64)> {
        let travel_mm = self.texture_mm.abs();
        let sigma = MEASURED_SIGMA.hypot(2f64.sqrt() * COMPARED_SIGMA_MM / travel_mm);
        (travel_mm >= COMPARED_MIN_MM).then(|| (self.encoder_mm / self.texture_mm, sigma))
    }

    /// Whether the encoder shows another travel than the texture.
    pub fn disagrees(&self) -> bool {
        self.ratio().is_some_and(|(ratio, sigma)| (ratio - 1.0).abs() > DISAGREE_SIGMA * sigma)
    }
}

/// Counts that a position is told from: more take the jitter of their arrival out, fewer follow a
/// belt that slows down or starts.
const COUNTS: usize = 8;
/// The oldest of them, s: a belt that changes its speed by 1 m/s in a second is 1 mm from the line.
const WINDOW_S: f64 = 0.1;

/// Belt position from the counts of an encoder that come when they come.
///
/// The position at a time lies on the straight line through the last counts (least squares), so
/// that jitter of their arrival is averaged; a count that is missing changes nothing else.
#[derive(Clone, Debug)]
pub struct Encoder {
    mm_per_count: f64,
    bits: u32,
    timeout_s: f64,
    /// A step beyond this is a counter that was set anew, mm/s.
    speed_max_mm_per_s: f64,
    last: Option<u32>,
    /// It began anew: the next position is from elsewhere.
    anew: bool,
    /// Time in s and position in mm, oldest first.
    positions: Deque<(f64, f64), COUNTS>,
}

impl Encoder {
    /// A counter that wraps around after `bits` bits. Silence of `timeout_s`, or a step faster than
    /// `speed_max_mm_per_s`, begins anew.
    pub fn new(mm_per_count: f64, bits: u32, timeout_s: f64, speed_max_mm_per_s: f64) -> Self {
        let (last, positions) = (None, Deque::new());
        Self { mm_per_count, bits, timeout_s, speed_max_mm_per_s, last, anew: false, positions }
    }

    /// Another scale from here on: what was before has no common zero with it.
    pub fn set_mm_per_count(&mut self, mm_per_count: f64) {
        self.mm_per_count = mm_per_count;
        self.positions.clear();
        self.anew = true;
    }

    /// A count that came at `t_s`.
    pub fn count(&mut self, count: u32, t_s: f64) {
        let unused = 32 - self.bits;
        let step = |last: u32| {
            // Wrapping around, whichever way: sign-extended difference of so many bits.
            let difference = count.wrapping_sub(last) << unused;
            f64::from(difference as i32 >> unused) * self.mm_per_count
        };
        let here = match (self.last, self.positions.back()) {
            (Some(last), Some(&(before_s, before_mm))) => {
                let (dt_s, step_mm) = (t_s - before_s, step(last));
                // Two counts that come in one packet have no time between them.
                let possible_mm = self.speed_max_mm_per_s * dt_s.max(0.01);
                if dt_s > self.timeout_s || step_mm.abs() > possible_mm {
                    self.positions.clear();
                    self.anew = true;
                    0.0
                } else {
                    before_mm + step_mm
                }
            }
            _ => 0.0,
        };
        self.last = Some(count);
        if self.positions.is_full() {
            self.positions.pop_front();
        }
        let _ = self.positions.push_back((t_s, here)); // invariant: there is room
    }

    /// Position at `t_s`, mm from anywhere; `None` without counts, when they are too old, and once
    /// when it began anew: what was before and what comes after have no common zero.
    pub fn position_mm(&mut self, t_s: f64) -> Option<f64> {
        let &(newest_s, newest_mm) = self.positions.back()?;
        if self.positions.len() < 2 || t_s - newest_s > self.timeout_s {
            return None;
        }
        if std::mem::take(&mut self.anew) {
            return None;
        }
        let old = self.positions.iter().filter(|(at_s, _)| newest_s - at_s > WINDOW_S).count();
        // Two make a line, however old the first.
        let recent = || self.positions.iter().skip(old.min(self.positions.len() - 2));
        let n = recent().count() as f64;
        let mean_s = recent().map(|(at_s, _)| at_s).sum::<f64>() / n;
        let mean_mm = recent().map(|(_, mm)| mm).sum::<f64>() / n;
        let (mut spread, mut slope) = (0.0, 0.0);
        for (at_s, mm) in recent() {
            spread += (at_s - mean_s).powi(2);
            slope += (at_s - mean_s) * (mm - mean_mm);
        }
        if spread <= f64::EPSILON {
            return Some(newest_mm);
        }
        Some(mean_mm + slope / spread * (t_s - mean_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uncertainty_grows_with_the_share_that_was_only_assumed() {
        let start = BeltPosition { travel_mm: 100.0, measured_mm: 40.0, ..BeltPosition::default() };
        let mut all = start;
        all.advance(500.0, true);
        let mut half = start;
        half.advance(250.0, true);
        half.advance(250.0, false);
        assert!(all.sigma_since(&start) < 0.0004);
        assert!((half.sigma_since(&start) - NOMINAL_SIGMA / 2.0).abs() < 1e-4);
        let mut coded = all;
        coded.doubt(500.0);
        assert!((coded.sigma_since(&start) - CODED_SIGMA).abs() < 1e-4);
        assert!(start.sigma_since(&start) > 0.02, "no travel, nothing measured");
        all.lose();
        assert!(all.sigma_since(&start) > 0.5, "nothing is known over a break");
    }

    #[test]
    fn an_encoder_a_percent_off_or_stuck_disagrees_and_a_right_one_does_not() {
        let compared = |ratio: f64, frames: u32| {
            let mut compared = EncoderRatio::default();
            for k in 0..frames {
                // Jitter of half a mm, to and fro.
                let jitter_mm = if k % 2 == 0 { 0.5 } else { -0.5 };
                compared.add(ratio * 12.5 + jitter_mm, 12.5);
            }
            compared
        };
        assert!(compared(1.01, 10).ratio().is_none(), "too early to tell");
        for frames in [30, 100, 1000, 10_000] {
            assert!(!compared(1.0, frames).disagrees(), "{frames}");
            assert!(compared(0.0, frames).disagrees(), "{frames}");
        }
        let (ratio, sigma) = compared(1.01, 1000).ratio().expect("far enough");
        assert!((ratio - 1.01).abs() < 2.0 * sigma && sigma < 0.001, "{ratio} {sigma}");
        assert!(compared(1.01, 1000).disagrees());
    }

    /// 0.05 mm a count, 16 bits, at 500 mm/s; a count every `period_s`, `jitter_s` late at times.
    fn position_errors_mm(period_s: f64, jitter_s: f64, missing: impl Fn(u32) -> bool) -> Vec<f64> {
        let mut encoder = Encoder::new(0.05, 16, 0.2, 2500.0);
        let mut errors = Vec::new();
        let mut offset = None;
        for i in 0..2000u32 {
            let t_s = f64::from(i) * period_s;
            // From just below the end of 16 bits: it wraps on the way, more than once.
            let count = 65000u32.wrapping_add((500.0 * t_s / 0.05) as u32) & 0xffff;
            if !missing(i) {
                let late_s = jitter_s * f64::from(i * 7919 % 101) / 100.0;
                encoder.count(count, t_s + late_s);
            }
            let now_s = t_s + jitter_s + 0.4 * period_s;
            if let Some(mm) = encoder.position_mm(now_s) {
                let error = mm - 500.0 * now_s;
                errors.push(error - *offset.get_or_insert(error));
            }
        }
        errors
    }

    #[test]
    fn an_encoder_s_position_follows_its_counts_over_wraps_jitter_and_gaps() {
        let worst = |errors: &[f64]| errors.iter().fold(0.0f64, |worst, e| worst.max(e.abs()));
        let regular = position_errors_mm(0.01, 0.0, |_| false);
        // A count is 0.05 mm.
        assert!(regular.len() > 1990 && worst(&regular) < 0.1, "{}", worst(&regular));
        let missing = position_errors_mm(0.01, 0.0, |i| i % 50 > 40);
        assert!(missing.len() > 1990 && worst(&missing) < 0.1, "{}", worst(&missing));
        // Up to 4 ms late are up to 2 mm of belt, 0.58 mm rms: the line leaves less than that.
        let jitter = position_errors_mm(0.01, 0.004, |_| false);
        let mean = jitter.iter().sum::<f64>() / jitter.len() as f64;
        let rms =
            (jitter.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / jitter.len() as f64).sqrt();
        assert!(rms < 0.58, "{rms}");
    }

    #[test]
    fn a_silent_encoder_says_nothing_and_then_begins_anew() {
        let mut encoder = Encoder::new(-0.1, 32, 0.2, 2500.0);
        assert_eq!(encoder.position_mm(0.0), None);
        encoder.count(100, 0.0);
        encoder.count(0, 0.01);
        // It counts backwards, through 0.
        encoder.count(u32::MAX - 99, 0.02);
        let before = encoder.position_mm(0.02).expect("three counts");
        assert!((before - 20.0).abs() < 0.01, "{before}");
        assert_eq!(encoder.position_mm(0.3), None, "too old");
        for (i, t_s) in [(5000, 1.0), (4900, 1.01)] {
            encoder.count(i, t_s);
        }
        assert_eq!(encoder.position_mm(1.01), None, "from elsewhere");
        assert!(encoder.position_mm(1.02).is_some());
        // A counter that was set anew.
        encoder.count(4_000_000, 1.03);
        assert_eq!(encoder.position_mm(1.03), None);
    }

    #[test]
    fn counts_in_one_packet_have_no_time_between_them() {
        let mut encoder = Encoder::new(0.1, 32, 0.2, 2500.0);
        encoder.count(0, 1.0);
        encoder.count(10, 1.0);
        assert!((encoder.position_mm(1.0).expect("two counts") - 1.0).abs() < 1e-9);
    }
}
