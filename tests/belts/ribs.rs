//! Belts whose texture repeats itself, as modular ones.

use super::{NOISY, SPEED_MM_PER_S, assert_honest, belt, boxes, is_right, run, site};
use beltgauge::source::synthetic::Scenario;
use beltgauge::stage::odometry::Knowledge;

/// Draws ribs across the belt that ride on it: their height in grey levels, `period_mm` apart.
fn ribs(frame: &mut [u8], grey: f64, [rib_grey, period_mm]: [f64; 2], travel_mm: f64) {
    for row in frame.chunks_exact_mut(640) {
        for (u, pixel) in row.iter_mut().enumerate() {
            let x_mm = (u as f64 - 319.5) * 1000.0 / 512.0 - travel_mm;
            let rib = rib_grey * (std::f64::consts::TAU * x_mm / period_mm).sin();
            if (f64::from(*pixel) - grey).abs() < 9.0 {
                *pixel = (f64::from(*pixel) + rib) as u8;
            }
        }
    }
}

#[test]
fn boxes_on_a_belt_with_ribs_are_measured() {
    for period_mm in [7.0, 18.5, 30.0, 60.0] {
        let scenario = boxes(2, 60.0, 0.0, "");
        // As wrong as a nameplate is.
        let site = site(&scenario, 490.0);
        let (records, pipeline) = run(&scenario, site, |_, frame, time| {
            ribs(frame, 60.0, [5.0, period_mm], scenario.travel_at_frame_mm(time.index));
        });
        let all_right = records.iter().all(|r| is_right(r) && r.may_be_used);
        assert!(records.len() == 2 && all_right, "{period_mm} mm: {records:#?}");
        assert_eq!(pipeline.health().texture, Knowledge::Measured, "{period_mm} mm");
    }
}

#[test]
fn a_belt_with_ribs_is_never_silently_wrong_when_it_stops() {
    for stop in ["at_s = 3.2\nfor_s = 1.0\nramp_s = 0.2", "at_s = 3.0\nfor_s = 2.0\nramp_s = 0.05"]
    {
        for period_mm in [7.0, 18.5, 30.0, 60.0] {
            let mut scenario = boxes(2, 60.0, 0.0, &format!("[[belt.stop]]\n{stop}\n"));
            scenario.frames += 70;
            let (records, _) = run(&scenario, site(&scenario, 500.0), |_, frame, time| {
                ribs(frame, 60.0, [5.0, period_mm], scenario.travel_at_frame_mm(time.index));
            });
            eprintln!("{period_mm} mm, {stop:?}");
            assert_honest(&records, 2);
        }
    }
}

/// Steps that were measured on ribs this far apart, and how many of them are not the belt's.
fn steps_measured_and_wrong(
    scenario: &Scenario,
    nominal_mm_per_s: f64,
    period_mm: f64,
) -> (u32, u32) {
    let (mut measured, mut wrong, mut last_mm) = (0, 0, None::<f64>);
    run(scenario, site(scenario, nominal_mm_per_s), |pipeline, frame, time| {
        ribs(frame, 60.0, [5.0, period_mm], scenario.travel_at_frame_mm(time.index));
        // What is known before a frame is the last one's.
        let travel_mm = pipeline.belt_position().travel_mm;
        if let (Some(last_mm), Some(last)) = (last_mm, time.index.checked_sub(2))
            && pipeline.belt_motion().1
        {
            let true_mm = scenario.travel_at_frame_mm(last + 1) - scenario.travel_at_frame_mm(last);
            measured += 1;
            let is_wrong = (travel_mm - last_mm - true_mm).abs() > 1.5;
            if is_wrong {
                eprintln!("frame {last}: {:.1} for {true_mm:.1} mm", travel_mm - last_mm);
            }
            wrong += u32::from(is_wrong);
        }
        last_mm = Some(travel_mm);
    });
    (measured, wrong)
}

/// The ribs look the same when the belt moves by one of them more, or less, from frame to frame; so fast it is configured.
#[test]
fn ribs_that_seem_to_move_at_a_wrong_nominal_speed_make_no_size_silently_wrong() {
    for height_mm in [80.0, 10.0] {
        for (period_mm, nominal_mm_per_s) in [(7.0, 290.0), (7.0, 710.0), (18.5, 1055.0)] {
            let scenario = belt(&[([200.0, 120.0, height_mm], 8.0); 2], 60.0, 0.0, "");
            let site = site(&scenario, nominal_mm_per_s);
            let (records, _) = run(&scenario, site, |_, frame, time| {
                ribs(frame, 60.0, [5.0, period_mm], scenario.travel_at_frame_mm(time.index));
            });
            let case = format!("{period_mm} mm at {nominal_mm_per_s} mm/s, {height_mm} mm high");
            assert!(!records.is_empty(), "{case}");
            for record in &records {
                let told_mm = [record.length_mm, record.width_mm, record.height_mm];
                let is_right = told_mm
                    .iter()
                    .zip([200.0, 120.0, height_mm])
                    .all(|(told, truth)| (told - truth).abs() < 3.0);
                assert!(is_right || !record.may_be_used, "{case}: {record:#?}");
            }
        }
    }
}

#[test]
fn an_empty_belt_with_ribs_that_brakes_is_measured_rightly_or_not_at_all() {
    for (period_mm, tables) in [
        (7.0, "[[belt.stop]]\nat_s = 2.5\nfor_s = 2.0\nramp_s = 0.4\n"),
        (18.5, "[[belt.stop]]\nat_s = 2.5\nfor_s = 2.0\nramp_s = 0.4\n"),
        (30.0, "[[belt.stop]]\nat_s = 2.5\nfor_s = 2.0\nramp_s = 0.2\n"),
    ] {
        let mut scenario = boxes(0, 60.0, 0.0, tables);
        scenario.frames = 220;
        let (measured, wrong) = steps_measured_and_wrong(&scenario, 490.0, period_mm);
        eprintln!("{period_mm} mm: {measured} measured, {wrong} wrong");
        assert!(measured > 80 && wrong == 0, "{period_mm} mm: {measured} measured, {wrong} wrong");
    }
}

#[test]
fn an_empty_belt_with_ribs_that_stands_is_not_measured_as_running() {
    for period_mm in [7.0, 10.0, 30.0] {
        let stop = "[[belt.stop]]\nat_s = 0.0\nfor_s = 20.0\nramp_s = 0.1\n";
        let scenario = boxes(0, 60.0, 0.0, stop);
        let (measured, wrong) = steps_measured_and_wrong(&scenario, 500.0, period_mm);
        assert_eq!(wrong, 0, "{period_mm} mm: of {measured} measured");
    }
}

#[test]
fn faint_ribs_under_a_noisy_camera_give_the_right_speed_or_none() {
    for period_mm in [7.0, 18.5, 30.0] {
        let scenario = boxes(1, 60.0, 0.0, NOISY);
        let mut measured = 0;
        let (records, _) = run(&scenario, site(&scenario, 490.0), |pipeline, frame, time| {
            let (speed_mm_per_s, is_measured) = pipeline.belt_motion();
            measured += u32::from(is_measured);
            let off = (speed_mm_per_s / SPEED_MM_PER_S - 1.0).abs();
            // Found beginning from the nominal one, which is off by 0.02.
            assert!(off < 0.021 || !is_measured, "{period_mm} mm: {speed_mm_per_s}");
            ribs(frame, 60.0, [2.0, period_mm], scenario.travel_at_frame_mm(time.index));
        });
        eprintln!("{period_mm} mm: {measured} frames");
        assert_honest(&records, 1);
    }
}
