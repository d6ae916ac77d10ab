//! Belts as they are: woven, plain, seen by a noisy camera. What passes on them is told, once.

mod common;
#[path = "belts/ribs.rs"]
mod ribs;

use beltgauge::config::Site;
use beltgauge::event::{Flags, NotMeasured, ParcelRecord};
use beltgauge::image::{FrameTime, Plane};
use beltgauge::pipeline::Pipeline;
use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::stage::odometry::Knowledge;
use common::measure_scenario;
use std::fmt::Write as _;

/// 640 x 400, 1 m above the belt, 2 mm a pixel.
fn camera() -> String {
    common::camera_above([640, 400], 512.0, 1000.0, [0.0; 5])
}

const SIZE_MM: [f64; 3] = [200.0, 120.0, 80.0];
const SPEED_MM_PER_S: f64 = 500.0;

/// Boxes half a metre apart, on a belt of this texture, with `tables` besides.
fn boxes(count: usize, grey: f64, texture_grey: f64, tables: &str) -> Scenario {
    belt(&vec![(SIZE_MM, 8.0); count], grey, texture_grey, tables)
}

/// Parcels, size and yaw in degrees, half a metre apart.
fn belt(parcels: &[([f64; 3], f64)], grey: f64, texture_grey: f64, tables: &str) -> Scenario {
    let frames = 105 + 30 * parcels.len();
    let mut text = format!(
        "seed = 3\nfps = 30\nframes = {frames}\nexposure_ms = 1\n{}\
         [belt]\nspeed_mm_per_s = {SPEED_MM_PER_S}\nwidth_mm = 800\ngrey = {grey}\n\
         texture_grey = {texture_grey}\n{tables}\n",
        camera()
    );
    for (k, ([l, w, h], yaw_deg)) in parcels.iter().enumerate() {
        let x_mm = -1000.0 - 500.0 * k as f64;
        let _ = writeln!(
            text,
            "[[parcel]]\nlength_mm = {l}\nwidth_mm = {w}\nheight_mm = {h}\nyaw_deg = {yaw_deg}\n\
             x_mm = {x_mm}\ny_mm = 20\nmaterial = \"white\""
        );
    }
    Scenario::parse(&text).expect("a valid scenario")
}

fn site(scenario: &Scenario, nominal_mm_per_s: f64) -> Site {
    common::site_of(scenario, [500.0, 300.0], nominal_mm_per_s)
}

fn is_right(record: &ParcelRecord) -> bool {
    let sides_mm = [record.length_mm, record.width_mm, record.height_mm];
    sides_mm.iter().zip(SIZE_MM).all(|(side, truth)| (side - truth).abs() <= 2.0)
}

#[test]
fn boxes_on_a_woven_belt_are_measured() {
    for (grey, texture_grey) in [(60.0, 4.5), (70.0, 8.0), (80.0, 12.0)] {
        let scenario = boxes(2, grey, texture_grey, "");
        let records = measure_scenario(&scenario, site(&scenario, 490.0));
        assert!(
            records.len() == 2 && records.iter().all(|r| is_right(r) && r.may_be_used),
            "{texture_grey}: {records:#?}"
        );
    }
}

/// Records and pipeline after a scenario whose frames and times `change` may alter.
fn run(
    scenario: &Scenario,
    site: Site,
    mut change: impl FnMut(&mut Pipeline, &mut [u8], &mut FrameTime),
) -> (Vec<ParcelRecord>, Pipeline) {
    let mut source = Synthetic::new(scenario.clone()).expect("renders");
    let (mut frames, mut pipeline) = beltgauge::run::build(site).expect("fits");
    let mut frame = frames.pop().expect("planned");
    let mut records = Vec::new();
    while let Some(mut time) = source.next_into(&mut frame).expect("renders") {
        change(&mut pipeline, &mut frame, &mut time);
        let raw = Plane::packed(&frame, 640, 400).expect("this size");
        pipeline.step(raw, time, &mut |r| records.push(r)).expect("this size");
    }
    pipeline.finish(&mut |r| records.push(r));
    (records, pipeline)
}

/// Each record is right or says that it may not be used.
fn assert_honest(records: &[ParcelRecord], count: usize) {
    assert!(
        records.len() == count && records.iter().all(|r| is_right(r) || !r.may_be_used),
        "{records:#?}"
    );
}

#[test]
fn a_plain_belt_frozen_by_compression_does_not_stand() {
    let scenario = boxes(3, 60.0, 0.0, "");
    let mut last: Option<Vec<u8>> = None;
    let mut stood = 0;
    let (records, _) = run(&scenario, site(&scenario, 500.0), |pipeline, frame, _| {
        let (speed, measured) = pipeline.belt_motion();
        stood += u32::from(measured && speed.abs() < 0.5 * SPEED_MM_PER_S);
        // What differs by noise only is repeated, as encoders do.
        if let Some(last) = &last {
            for (new, &old) in frame.iter_mut().zip(last) {
                *new = if new.abs_diff(old) < 8 { old } else { *new };
            }
        }
        last = Some(frame.to_vec());
    });
    assert_eq!(stood, 0, "frames in which a standstill was measured");
    assert_honest(&records, 3);
}

const NOISY: &str = "[noise]\nread_grey = 5.0\n";
/// Five times the texture: its correlation is below what a single search takes for clear.
const VERY_NOISY: &str = "[noise]\nread_grey = 7.0\n";

#[test]
fn a_texture_fainter_than_the_camera_s_noise_gives_the_speed() {
    let mut scenario = boxes(0, 60.0, 1.3, VERY_NOISY);
    scenario.frames = 200;
    let (mut measured, mut locked) = (0, None);
    let (mut shown_mm, mut true_mm) = (0.0, 0.0);
    run(&scenario, site(&scenario, 490.0), |pipeline, _, time| {
        // What is known before a frame is the last one's.
        let at_mm = scenario.travel_at_frame_mm(time.index.saturating_sub(1));
        let travel_mm = pipeline.belt_position().travel_mm;
        measured += u32::from(pipeline.belt_motion().1);
        if pipeline.belt_motion().1 {
            let (from_mm, from_true_mm) = *locked.get_or_insert((travel_mm, at_mm));
            (shown_mm, true_mm) = (travel_mm - from_mm, at_mm - from_true_mm);
        }
    });
    eprintln!("{measured} frames measured, {shown_mm:.1} for {true_mm:.1} mm");
    // Single frames are good to 0.2 px of 2 mm, and do not add up.
    assert!(measured > 100 && (shown_mm / true_mm - 1.0).abs() < 5e-4, "{shown_mm} {true_mm}");
}

#[test]
fn boxes_on_a_texture_far_below_the_camera_s_noise_are_measured() {
    let scenario = boxes(3, 60.0, 1.0, VERY_NOISY);
    let records = measure_scenario(&scenario, site(&scenario, 490.0));
    let is_well = |r: &ParcelRecord| is_right(r) && r.may_be_used;
    assert!(records.len() == 3 && records.iter().all(is_well), "{records:#?}");
}

#[test]
fn a_speed_far_from_the_nominal_one_is_found_and_said() {
    let scenario = boxes(2, 60.0, 2.0, "");
    for nominal_mm_per_s in [200.0, 1100.0] {
        let (records, pipeline) = run(&scenario, site(&scenario, nominal_mm_per_s), |_, _, _| {});
        assert!(records.len() == 2 && records.iter().all(is_right), "{records:#?}");
        let health = pipeline.health();
        let seen = health.belt_seen_mm_per_s.expect("seen");
        assert!((seen / SPEED_MM_PER_S - 1.0).abs() < 0.01 && health.belt_not_as_configured);
    }
}

#[test]
fn a_belt_that_runs_backwards_is_said_and_its_parcels_are_told() {
    let mut scenario = boxes(2, 60.0, 2.0, "");
    // Until the last has left the picture.
    scenario.frames += 60;
    let (records, pipeline) = run(&scenario, site(&scenario, 500.0), |_, frame, _| {
        frame.chunks_exact_mut(640).for_each(<[u8]>::reverse);
    });
    assert!(records.len() == 2 && records.iter().all(|r| !r.may_be_used), "{records:#?}");
    let health = pipeline.health();
    assert!(health.belt_seen_mm_per_s.is_some_and(|seen| seen < -450.0), "{health:?}");
    assert!(health.belt_not_as_configured);
}

#[test]
fn what_rides_backwards_and_never_gets_a_shape_is_told() {
    let mut scenario = belt(&[(SIZE_MM, 0.0); 2], 90.0, 2.0, "");
    scenario.frames += 60;
    let mut site = site(&scenario, 500.0);
    // To the ends of the picture: nothing is seen beyond the exit.
    (site.config.zone.x_min_mm, site.config.zone.x_max_mm) = (-562.0, 562.0);
    let site = Site::new(site.config, site.camera).expect("a zone in view");
    let (records, _) = run(&scenario, site, |_, frame, _| {
        frame.chunks_exact_mut(640).for_each(<[u8]>::reverse);
    });
    assert!(records.len() == 2 && records.iter().all(|r| !r.may_be_used), "{records:#?}");
}

#[test]
fn over_a_gap_that_the_view_cannot_bridge_nothing_is_lost_silently() {
    let scenario = boxes(3, 60.0, 2.0, "");
    // The first box is in the middle, the second about to come, the third far.
    for jump_s in [4.0 * 3600.0, -100.0, f64::NAN, f64::INFINITY] {
        let began = std::time::Instant::now();
        let (records, _) = run(&scenario, site(&scenario, 500.0), |_, _, time| {
            time.t_s += if time.index == 60 || time.index > 60 && jump_s.is_finite() {
                jump_s
            } else {
                0.0
            };
        });
        assert!(began.elapsed().as_secs() < 60, "a step's cost follows the time stamps");
        // The belt's texture shows that it has moved by a frame's travel.
        assert!(records.len() == 3, "{jump_s}: {records:#?}");
        assert!(records.iter().all(|r| is_right(r) && r.may_be_used), "{records:#?}");
        let seq: Vec<u32> = records.iter().map(|r| r.seq).collect();
        assert!(seq.iter().zip(1..).all(|(&seq, n)| seq == n), "{seq:?}");
    }
}

/// What shows the belt's travel over a gap.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Witness {
    Encoder,
    Texture,
    Nobody,
}

/// Frames missing from the 66th on, a parcel in the middle of the zone and another at its start;
/// the clock goes on by so much more, as when the belt stood.
#[derive(Clone, Copy, Debug)]
struct Gap {
    frames: u64,
    more_s: f64,
}

/// A belt of five parcels, each of a width of its own, and its frames.
fn five(texture_grey: f64) -> (Scenario, Vec<(Vec<u8>, FrameTime)>) {
    let parcels: Vec<_> =
        (0..5).map(|k| ([200.0, 60.0 + 30.0 * f64::from(k), 80.0], 0.0)).collect();
    let scenario = belt(&parcels, 60.0, texture_grey, "");
    let mut source = Synthetic::new(scenario.clone()).expect("renders");
    let mut frame = vec![0; 640 * 400];
    let mut frames = Vec::new();
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        frames.push((frame.clone(), time));
    }
    (scenario, frames)
}

/// What is told of them, and how many there must be at least and at most: what the gap leaves only a
/// moment of may be told or not.
fn over(
    (scenario, frames): &(Scenario, Vec<(Vec<u8>, FrameTime)>),
    gap: Gap,
    witness: Witness,
) -> (Vec<ParcelRecord>, std::ops::RangeInclusive<usize>) {
    let missing = 66..66 + gap.frames;
    let (_, mut pipeline) = beltgauge::run::build(site(scenario, 500.0)).expect("fits");
    let (mut records, mut seen) = (Vec::new(), [[0u32; 2]; 5]);
    for (frame, time) in frames.iter().filter(|(_, time)| !missing.contains(&time.index)) {
        let travel_mm = scenario.travel_at_frame_mm(time.index);
        for (k, [inside, in_view]) in seen.iter_mut().enumerate() {
            // Its middle is in the zone; a part of it is in view.
            let x_mm = -1000.0 - 500.0 * k as f64 + travel_mm;
            *inside += u32::from((-500.0..500.0).contains(&x_mm));
            *in_view += u32::from((-750.0..750.0).contains(&x_mm));
        }
        if witness == Witness::Encoder {
            pipeline.encoder(travel_mm);
        }
        let more_s = if time.index >= missing.end { gap.more_s } else { 0.0 };
        let time = FrameTime { t_s: time.t_s + more_s, ..*time };
        let raw = Plane::packed(frame, 640, 400).expect("this size");
        pipeline.step(raw, time, &mut |r| records.push(r)).expect("this size");
    }
    pipeline.finish(&mut |r| records.push(r));
    let [least, most] =
        [0, 1].map(|i| seen.iter().filter(|seen| seen[i] > 6 * (1 - i as u32)).count());
    (records, least..=most)
}

#[test]
fn over_any_gap_every_parcel_is_told_once() {
    let mut wrong = String::new();
    let (plain, textured) = (five(0.0), five(2.0));
    for witness in [Witness::Encoder, Witness::Texture, Witness::Nobody] {
        let belt = if witness == Witness::Texture { &textured } else { &plain };
        for (frames, more_s) in [
            // The belt runs on ...
            (6, 0.0),
            (36, 0.0),
            (54, 0.0),
            (90, 0.0),
            // ... or stands for a while, or all the time.
            (0, 3600.0),
            (12, 60.0),
            (90, 3600.0),
        ] {
            let gap = Gap { frames, more_s };
            let (records, expected) = over(belt, gap, witness);
            let mut widths: Vec<i64> = records
                .iter()
                .filter(|r| r.not_measured.is_none() && r.width_mm > 50.0)
                .map(|r| ((r.width_mm - 60.0) / 30.0).round() as i64)
                .collect();
            widths.sort_unstable();
            let once = widths.windows(2).all(|pair| pair[0] != pair[1]);
            if !expected.contains(&records.len()) || !once {
                let _ = writeln!(wrong, "{witness:?} {gap:?}: {expected:?} {widths:?}");
                for r in &records {
                    let _ = writeln!(wrong, "  {r}");
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn a_parcel_lost_over_a_gap_says_that_the_belt_s_motion_was_not_known() {
    // Textured belt: nothing of what was there is in view any more.
    let (records, _) = over(&five(2.0), Gap { frames: 90, more_s: 0.0 }, Witness::Texture);
    let lost: Vec<_> = records.iter().filter(|r| r.flags.has(Flags::LOST)).collect();
    assert!(!lost.is_empty() && lost.iter().all(|r| !r.may_be_used), "{records:#?}");
    let reasons: Vec<_> = lost.iter().filter_map(|r| r.not_measured).collect();
    assert!(reasons.iter().all(|r| *r == NotMeasured::BeltMotionUnknown), "{reasons:?}");
    assert!(!reasons.is_empty(), "the one that had just come in: {records:#?}");
}

#[test]
fn an_encoder_that_shows_another_travel_than_the_belt_is_found_out() {
    let scenario = boxes(6, 60.0, 2.0, "");
    for ratio in [1.01, 0.98, 0.0] {
        let (records, pipeline) = run(&scenario, site(&scenario, 500.0), |pipeline, _, time| {
            pipeline.encoder(ratio * scenario.travel_at_frame_mm(time.index));
        });
        assert_honest(&records, 6);
        assert!(records[2..].iter().all(|r| is_right(r) && r.may_be_used), "{records:#?}");
        let health = pipeline.health();
        let (found, sigma) = health.encoder_ratio.expect("compared");
        assert!(health.encoder_disagrees && (found - ratio).abs() < 0.002, "{found} +- {sigma}");
    }
}

#[test]
fn a_frame_that_comes_after_its_successor_is_left_out() {
    let scenario = boxes(2, 60.0, 2.0, "");
    let mut source = Synthetic::new(scenario.clone()).expect("renders");
    let (mut frames, mut pipeline) = beltgauge::run::build(site(&scenario, 500.0)).expect("fits");
    let mut frame = frames.pop().expect("planned");
    let (mut records, mut late) = (Vec::new(), None);
    while let Some(time) = source.next_into(&mut frame).expect("renders") {
        if time.index > 20 && time.index % 10 == 0 {
            late = Some((frame.to_vec(), time));
            continue;
        }
        let mut step = |frame: &[u8], time| {
            let raw = Plane::packed(frame, 640, 400).expect("this size");
            pipeline.step(raw, time, &mut |r| records.push(r)).expect("this size");
        };
        step(&frame, time);
        if let Some((frame, time)) = late.take() {
            step(&frame, time);
        }
    }
    let right = records.iter().all(|r| is_right(r) && r.may_be_used);
    assert!(records.len() == 2 && right, "{records:#?}");
}

#[test]
fn frames_missing_without_a_word_are_bridged_and_told() {
    let scenario = boxes(2, 60.0, 2.0, "");
    for every in [8, 30] {
        let mut source = Synthetic::new(scenario.clone()).expect("renders");
        let (mut frames, mut pipeline) =
            beltgauge::run::build(site(&scenario, 500.0)).expect("fits");
        let mut frame = frames.pop().expect("planned");
        let (mut records, mut index) = (Vec::new(), 0);
        while let Some(time) = source.next_into(&mut frame).expect("renders") {
            if time.index > 20 && time.index % every == 0 {
                continue;
            }
            // As a file that has no times of its own.
            let time = FrameTime { index, t_s: index as f64 / 30.0 };
            index += 1;
            let raw = Plane::packed(&frame, 640, 400).expect("this size");
            pipeline.step(raw, time, &mut |r| records.push(r)).expect("this size");
        }
        assert!(
            records.len() == 2 && records.iter().all(|r| is_right(r) && r.may_be_used),
            "{records:#?}"
        );
        assert_eq!(pipeline.untold_gaps(), scenario.frames - index, "every {every}");
    }
}

/// A belt that stops with nothing on it, on which a hand then slides a carton along.
fn with_a_hand(encoder: bool) {
    let stop = "[[belt.stop]]\nat_s = 1.8\nfor_s = 1.4\nramp_s = 0.1\n";
    let mut scenario = belt(&[], 60.0, 2.0, stop);
    scenario.frames = 120;
    let (mut refuted, mut moved) = (0, 0);
    let (_, pipeline) = run(&scenario, site(&scenario, 500.0), |pipeline, frame, time| {
        if encoder {
            pipeline.encoder(scenario.travel_at_frame_mm(time.index));
        }
        // That is of the frame before.
        let health = pipeline.health();
        refuted += u32::from(health.texture == Knowledge::Refuted || health.encoder_disagrees);
        if (65..90).contains(&time.index) {
            moved += u32::from(pipeline.belt_motion().0.abs() > 50.0);
            let start = 100 + 8 * (time.index as usize - 65);
            for row in frame.chunks_exact_mut(640).skip(160).take(60) {
                row[start..start + 90].fill(220);
            }
        }
    });
    assert_eq!((refuted, moved), (0, 0), "frames, of a belt that stands");
    let travel_mm = pipeline.belt_position().travel_mm;
    let truth_mm = scenario.travel_at_frame_mm(119) - scenario.travel_at_frame_mm(0);
    assert!((travel_mm - truth_mm).abs() < 5.0, "{travel_mm} for {truth_mm}");
}

#[test]
fn a_carton_slid_by_hand_on_a_stopped_belt_does_not_refute_its_texture() {
    with_a_hand(false);
}

#[test]
fn a_carton_slid_by_hand_on_a_stopped_belt_does_not_overrule_its_encoder() {
    with_a_hand(true);
}

/// Boxes of random size on random belts, of whose frames a random share is missing.
fn with_frames_dropped(belts: std::ops::Range<u64>) {
    let mut wrong = String::new();
    for seed in belts {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut random = move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f64 / f64::from(1 << 24)
        };
        let share = 0.6 * random();
        let mut parcel = || {
            let [w, h, yaw] = [100.0 * random(), 200.0 * random(), 180.0 * random()];
            ([200.0, 60.0 + w, 20.0 + h], yaw)
        };
        let parcels = [parcel(), parcel()];
        let mut scenario = belt(&parcels, 60.0, 2.0, "");
        scenario.frames += 20;
        let mut source = Synthetic::new(scenario.clone()).expect("renders");
        let (mut frames, mut pipeline) =
            beltgauge::run::build(site(&scenario, 500.0)).expect("fits");
        let mut frame = frames.pop().expect("planned");
        let mut records = Vec::new();
        while let Some(time) = source.next_into(&mut frame).expect("renders") {
            if time.index > 20 && random() < share {
                continue;
            }
            let raw = Plane::packed(&frame, 640, 400).expect("this size");
            pipeline.step(raw, time, &mut |r| records.push(r)).expect("this size");
        }
        pipeline.finish(&mut |r| records.push(r));
        if records.len() != 2 {
            let _ = writeln!(wrong, "belt {seed}, {share:.2} dropped: {records:#?}");
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn with_frames_dropped_at_random_every_parcel_is_told_once() {
    with_frames_dropped(0..8);
}

#[test]
#[ignore = "minutes"]
fn with_frames_dropped_on_many_belts_every_parcel_is_told_once() {
    with_frames_dropped(8..208);
}
