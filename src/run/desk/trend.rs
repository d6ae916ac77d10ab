//! The trend: what happens, summed up in pieces of ten seconds, for the page's charts.

use super::insight::PlcSide;
use crate::event::ParcelRecord;
use crate::web::Point;
use std::time::{Duration, Instant};

/// Length of a piece.
const PIECE: Duration = Duration::from_secs(10);

/// Sums up the piece that goes on.
pub struct Trend {
    begun: Instant,
    point: Point,
    sigma_sums_mm: [f64; 3],
    /// As they were when it began.
    frames_missing: Option<u64>,
}

impl Trend {
    /// A first piece begins.
    pub fn new(now: Instant) -> Self {
        Self { begun: now, point: Point::default(), sigma_sums_mm: [0.0; 3], frames_missing: None }
    }

    /// A parcel was told.
    pub fn parcel(&mut self, record: &ParcelRecord) {
        self.point.parcels += 1;
        self.point.refused += u32::from(!record.may_be_used);
        if record.not_measured.is_some() {
            self.point.unmeasured += 1;
            return;
        }
        let sigmas_mm = [record.sigma_length_mm, record.sigma_width_mm, record.sigma_height_mm];
        for (sum, mm) in self.sigma_sums_mm.iter_mut().zip(sigmas_mm) {
            *sum += mm;
        }
    }

    /// The piece that ends now, if it is long enough; the next one begins.
    pub fn look(&mut self, plc: &PlcSide, utc_ms: u64, now: Instant) -> Option<Point> {
        let span = now - self.begun;
        if !plc.is_known() || span < PIECE {
            return None;
        }
        let vision = &plc.status.vision;
        let missing = vision.frames_dropped + vision.frames_lost + vision.frames_torn;
        let before = self.frames_missing.unwrap_or(missing);
        let measured = self.point.parcels - self.point.unmeasured;
        let mean = |sum: f64| (sum / f64::from(measured)) as f32;
        let point = Point {
            utc_ms,
            span_s: span.as_secs_f32(),
            sigma_mm: (measured > 0).then(|| self.sigma_sums_mm.map(mean)),
            belt_speed_mm_per_s: vision.belt_measured.then_some(vision.belt_speed_mm_per_s as f32),
            blur_px: vision.health.blur_px.map(|px| px as f32),
            frames_missing: missing.saturating_sub(before) as u32,
            ..self.point
        };
        *self = Self { frames_missing: Some(missing), ..Self::new(now) };
        Some(point)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Flags, NotMeasured, Shape};
    use crate::run::desk::insight::tests::insight;

    fn record(sigma_mm: f64, may_be_used: bool, not_measured: Option<NotMeasured>) -> ParcelRecord {
        ParcelRecord {
            seq: 1,
            frame: 1,
            t_s: 0.0,
            length_mm: 1.0,
            width_mm: 1.0,
            height_mm: 1.0,
            yaw_deg: 0.0,
            x_mm: 0.0,
            y_mm: 0.0,
            sigma_length_mm: sigma_mm,
            sigma_width_mm: 2.0 * sigma_mm,
            sigma_height_mm: 3.0 * sigma_mm,
            belt_speed_mm_per_s: 500.0,
            shape: Shape::Box,
            flags: Flags::default(),
            not_measured,
            may_be_used,
            belt_travel_mm: 0.0,
            by_encoder: false,
        }
    }

    #[test]
    fn each_piece_sums_up_what_happened_in_it_and_nothing_before() {
        let start = Instant::now();
        let mut plc = insight().plc_side();
        let mut trend = Trend::new(start);
        let at = |s: u64| start + Duration::from_secs(s);
        assert!(trend.look(&plc, 1, at(11)).is_none(), "nothing is known");
        plc.told_utc_ms = 1;
        plc.status.vision.frames_lost = 70;
        let first = trend.look(&plc, 5, at(12)).expect("long enough");
        assert_eq!((first.parcels, first.frames_missing), (0, 0), "lost before the start");
        assert!(first.sigma_mm.is_none() && first.belt_speed_mm_per_s.is_none());

        trend.parcel(&record(0.2, true, None));
        trend.parcel(&record(0.4, false, None));
        trend.parcel(&record(0.0, false, Some(NotMeasured::Lost)));
        (plc.status.vision.frames_lost, plc.status.vision.frames_torn) = (73, 1);
        (plc.status.vision.belt_measured, plc.status.vision.belt_speed_mm_per_s) = (true, 499.5);
        assert!(trend.look(&plc, 6, at(21)).is_none(), "it goes on");
        let second = trend.look(&plc, 7, at(24)).expect("long enough");
        assert_eq!((second.parcels, second.refused, second.unmeasured), (3, 2, 1));
        assert_eq!((second.utc_ms, second.frames_missing), (7, 4));
        assert_eq!((second.span_s, second.belt_speed_mm_per_s), (12.0, Some(499.5)));
        let sigma_mm = second.sigma_mm.expect("two were measured");
        for (got, want) in sigma_mm.into_iter().zip([0.3, 0.6, 0.9]) {
            assert!((got - want).abs() < 1e-6, "{got} {want}");
        }
        let third = trend.look(&plc, 8, at(34)).expect("long enough");
        assert_eq!((third.parcels, third.frames_missing, third.sigma_mm), (0, 0, None));
    }
}
