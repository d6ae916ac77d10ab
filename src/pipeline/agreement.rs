//! What two witnesses of one parcel say together.

use crate::event::{Flags, ParcelRecord, Shape};

/// Dimensions that differ by more than this many sigmas disagree.
pub(super) const DISAGREE_SIGMA: f64 = 3.0;

/// What is not so many sigmas over the belt may be the belt.
const RISES_SIGMA: f64 = 2.0;

/// Whether a record's height is more than none.
pub(super) fn rises(record: &ParcelRecord) -> bool {
    record.height_mm > RISES_SIGMA * record.sigma_height_mm
}

/// Whether a record is without a doubt.
pub(super) fn is_sure(record: &ParcelRecord) -> bool {
    record.not_measured.is_none() && record.flags.is_empty()
}

/// The record of a parcel that both saw: of what is not in doubt, else of the one that more edges confirm; of two
/// that are no cuboids the smaller one. A silhouette that may be one of the belt is no witness of a parcel.
/// `edge_shares`: of the edges that silhouettes and heights led to.
pub(super) fn agreed(
    silhouettes: &ParcelRecord,
    heights: &ParcelRecord,
    edge_shares: [f64; 2],
    sigma_max_mm: f64,
) -> ParcelRecord {
    let volume = |r: &ParcelRecord| r.length_mm * r.width_mm * r.height_mm;
    let neither_is_box = [silhouettes, heights].iter().all(|r| r.shape != Shape::Box);
    let by_silhouettes = silhouettes.not_measured.is_none()
        && match (is_sure(silhouettes) && rises(silhouettes), is_sure(heights)) {
            (false, false) if neither_is_box => volume(silhouettes) < volume(heights),
            (true, true) => edge_shares[0] > edge_shares[1],
            (sure, other) => sure && !other,
        };
    let (record, other) =
        if by_silhouettes { (*silhouettes, heights) } else { (*heights, silhouettes) };
    let mut record =
        if other.shape == Shape::Box { spread(record, other, sigma_max_mm) } else { record };
    let both = |flag| silhouettes.flags.has(flag) && heights.flags.has(flag);
    let either = |flag| silhouettes.flags.has(flag) || heights.flags.has(flag);
    record.flags.clear(Flags::UNFINISHED);
    record.flags.set(Flags::UNFINISHED, both(Flags::UNFINISHED));
    record.flags.set(Flags::LOST, silhouettes.flags.has(Flags::LOST));
    record.flags.set(Flags::CLIPPED, either(Flags::CLIPPED));
    if silhouettes.not_measured.is_none() { held_at(record, silhouettes) } else { record }
}

/// The same parcel where it was at another record's frame: that of the silhouettes is where its picture is taken.
fn held_at(record: ParcelRecord, other: &ParcelRecord) -> ParcelRecord {
    ParcelRecord {
        frame: other.frame,
        t_s: other.t_s,
        x_mm: record.x_mm + other.belt_travel_mm - record.belt_travel_mm,
        belt_travel_mm: other.belt_travel_mm,
        ..record
    }
}

/// Where another cuboid was seen than in a record, by more than the sigmas, its sigmas span both.
pub(super) fn spread(
    mut record: ParcelRecord,
    other: &ParcelRecord,
    sigma_max_mm: f64,
) -> ParcelRecord {
    if [Flags::MERGED, Flags::CLIPPED].iter().any(|&flag| other.flags.has(flag)) {
        return record;
    }
    let off_mm = [
        record.length_mm - other.length_mm,
        record.width_mm - other.width_mm,
        record.height_mm - other.height_mm,
    ];
    let sigmas_mm =
        [&mut record.sigma_length_mm, &mut record.sigma_width_mm, &mut record.sigma_height_mm];
    let others_mm = [other.sigma_length_mm, other.sigma_width_mm, other.sigma_height_mm];
    for ((off_mm, sigma_mm), other_mm) in off_mm.into_iter().zip(sigmas_mm).zip(others_mm) {
        if off_mm.abs() > DISAGREE_SIGMA * sigma_mm.hypot(other_mm) {
            *sigma_mm = sigma_mm.hypot(0.5 * off_mm);
        }
    }
    let footprint_sigma_mm = record.sigma_length_mm.max(record.sigma_width_mm);
    record.flags.set(Flags::HEIGHT_UNCERTAIN, record.sigma_height_mm > sigma_max_mm);
    record.flags.set(Flags::FOOTPRINT_UNCERTAIN, footprint_sigma_mm > sigma_max_mm);
    record
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    const SIGMA_MAX_MM: f64 = 3.0;

    /// A cuboid without a doubt, every sigma the same.
    pub fn record([length_mm, width_mm, height_mm]: [f64; 3], sigma_mm: f64) -> ParcelRecord {
        ParcelRecord {
            seq: 0,
            frame: 0,
            t_s: 0.0,
            length_mm,
            width_mm,
            height_mm,
            yaw_deg: 0.0,
            x_mm: 0.0,
            y_mm: 0.0,
            sigma_length_mm: sigma_mm,
            sigma_width_mm: sigma_mm,
            sigma_height_mm: sigma_mm,
            belt_speed_mm_per_s: 500.0,
            shape: Shape::Box,
            flags: Flags::default(),
            not_measured: None,
            may_be_used: false,
            belt_travel_mm: 0.0,
            by_encoder: false,
        }
    }

    fn flagged(mut record: ParcelRecord, flag: Flags) -> ParcelRecord {
        record.flags.set(flag, true);
        record
    }

    fn told(silhouettes: &ParcelRecord, heights: &ParcelRecord) -> ParcelRecord {
        agreed(silhouettes, heights, [0.8, 0.9], SIGMA_MAX_MM)
    }

    #[test]
    fn two_that_agree_leave_no_doubt_and_no_wider_sigma() {
        let (one, two) = (record([200.0, 150.0, 60.0], 0.5), record([201.0, 150.5, 61.0], 0.5));
        assert_eq!(told(&one, &two), two);
        // More edges confirm the first.
        assert_eq!(agreed(&one, &two, [0.9, 0.8], SIGMA_MAX_MM), one);
    }

    #[test]
    fn two_that_are_sure_of_different_things_are_a_doubt_with_a_sigma_that_spans_both() {
        let (one, two) = (record([200.0, 150.0, 60.0], 0.5), record([180.0, 150.0, 40.0], 0.5));
        let record = told(&one, &two);
        assert!(record.sigma_length_mm > 10.0 && record.sigma_height_mm > 10.0, "{record:?}");
        let told_mm = (record.length_mm, record.height_mm, record.sigma_width_mm);
        assert_eq!(told_mm, (180.0, 40.0, 0.5));
        assert!(record.flags.has(Flags::HEIGHT_UNCERTAIN), "{record:?}");
        assert!(record.flags.has(Flags::FOOTPRINT_UNCERTAIN), "{record:?}");
    }

    #[test]
    fn what_is_in_doubt_gives_way_to_what_is_not() {
        let sure = record([200.0, 150.0, 60.0], 0.5);
        let doubt = flagged(record([205.0, 155.0, 66.0], 6.0), Flags::HEIGHT_UNCERTAIN);
        assert_eq!(told(&sure, &doubt), sure);
        assert_eq!(told(&doubt, &sure), sure);
    }

    #[test]
    fn a_silhouette_that_may_be_one_of_the_belt_makes_no_doubtful_height_sure() {
        let flat = record([126.0, 51.0, 0.5], 1.2);
        let doubt = flagged(record([126.0, 52.0, 0.1], 1.5), Flags::HEIGHT_DISPUTED);
        assert!(!is_sure(&told(&flat, &doubt)));
        // Heights that are sure need no witness.
        let sure = record([126.0, 52.0, 4.0], 0.7);
        assert_eq!(agreed(&flat, &sure, [0.9, 0.8], SIGMA_MAX_MM), sure);
    }

    #[test]
    fn an_image_that_ran_together_with_another_disputes_nothing() {
        let merged = flagged(record([300.0, 250.0, 90.0], 0.5), Flags::MERGED);
        let sure = record([200.0, 150.0, 60.0], 0.5);
        assert_eq!(told(&merged, &sure), sure);
    }

    #[test]
    fn of_two_that_are_no_cuboids_the_smaller_is_told() {
        let irregular = |size| ParcelRecord {
            shape: Shape::Irregular,
            ..flagged(record(size, 5.0), Flags::FOOTPRINT_UNCERTAIN)
        };
        let (small, large) = (irregular([300.0, 90.0, 90.0]), irregular([320.0, 110.0, 95.0]));
        assert_eq!(told(&small, &large), small);
        assert_eq!(told(&large, &small), small);
    }

    #[test]
    fn a_silhouette_without_a_size_is_no_witness_of_one_and_what_it_says_of_the_pass_stays() {
        let mut lost = flagged(record([0.0; 3], 0.0), Flags::LOST);
        lost.not_measured = Some(crate::event::NotMeasured::Lost);
        lost.shape = Shape::Irregular;
        let record = told(&lost, &record([200.0, 150.0, 60.0], 0.5));
        assert_eq!((record.length_mm, record.not_measured), (200.0, None));
        assert!(record.flags.has(Flags::LOST));
    }

    #[test]
    fn what_both_saw_is_told_where_its_picture_is_taken() {
        let frame = |frame, x_mm, belt_travel_mm| ParcelRecord {
            frame,
            x_mm,
            belt_travel_mm,
            ..record([200.0, 150.0, 60.0], 0.5)
        };
        let (seen, heights) = (frame(30, 4.0, 500.0), frame(32, 39.0, 535.0));
        assert_eq!(told(&seen, &heights), frame(30, 4.0, 500.0));
    }

    #[test]
    fn what_one_saw_leave_is_finished() {
        let sure = record([200.0, 150.0, 60.0], 0.5);
        let unfinished = flagged(sure, Flags::UNFINISHED);
        assert!(told(&sure, &unfinished).flags.is_empty());
        assert!(told(&unfinished, &sure).flags.is_empty());
        assert!(told(&unfinished, &unfinished).flags.has(Flags::UNFINISHED));
    }
}
