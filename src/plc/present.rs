//! How a PLC wants to see dimensions: which one is called length, and how they are rounded.

use crate::config::{DimensionOrder, Plc as Settings};
use crate::event::ParcelRecord;

/// Dimensions in the order and rounding that were asked for.
pub(super) fn presented(mut record: ParcelRecord, settings: &Settings) -> ParcelRecord {
    let swap_sides = |record: &mut ParcelRecord| {
        std::mem::swap(&mut record.length_mm, &mut record.width_mm);
        std::mem::swap(&mut record.sigma_length_mm, &mut record.sigma_width_mm);
        record.yaw_deg += if record.yaw_deg > 0.0 { -90.0 } else { 90.0 };
    };
    match settings.order {
        DimensionOrder::LongestFirst => {}
        DimensionOrder::TravelFirst => {
            if record.yaw_deg.abs() > 45.0 {
                swap_sides(&mut record);
            }
        }
        DimensionOrder::Descending => {
            let mut sides = [
                (record.length_mm, record.sigma_length_mm),
                (record.width_mm, record.sigma_width_mm),
                (record.height_mm, record.sigma_height_mm),
            ];
            sides.sort_by(|a, b| b.0.total_cmp(&a.0));
            (record.length_mm, record.sigma_length_mm) = sides[0];
            (record.width_mm, record.sigma_width_mm) = sides[1];
            (record.height_mm, record.sigma_height_mm) = sides[2];
        }
    }
    for mm in [&mut record.length_mm, &mut record.width_mm, &mut record.height_mm] {
        *mm = (*mm / settings.scale_interval_mm).round() * settings.scale_interval_mm;
    }
    record
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::record;

    #[test]
    fn dimensions_come_in_the_order_that_was_asked_for() {
        let of = |order: DimensionOrder, yaw_deg: f64| {
            let settings = Settings { order, ..Settings::default() };
            let record = ParcelRecord {
                yaw_deg,
                length_mm: 300.0,
                width_mm: 200.0,
                height_mm: 250.0,
                ..record(1)
            };
            let shown = presented(record, &settings);
            ([shown.length_mm, shown.width_mm, shown.height_mm], shown.yaw_deg)
        };
        assert_eq!(of(DimensionOrder::LongestFirst, 80.0), ([300.0, 200.0, 250.0], 80.0));
        assert_eq!(of(DimensionOrder::TravelFirst, 80.0), ([200.0, 300.0, 250.0], -10.0));
        assert_eq!(of(DimensionOrder::TravelFirst, -80.0), ([200.0, 300.0, 250.0], 10.0));
        assert_eq!(of(DimensionOrder::TravelFirst, 30.0), ([300.0, 200.0, 250.0], 30.0));
        assert_eq!(of(DimensionOrder::Descending, 30.0), ([300.0, 250.0, 200.0], 30.0));
    }
}
