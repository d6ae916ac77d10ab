//! `OpenCV` as oracle of the kernels, on frames of the synthetic belt with parcels in view.

use beltgauge::image::{FrameTime, Plane};
use beltgauge::kernel::scalar::bits::{self, Square, words};
use beltgauge::kernel::scalar::flow::Patch;
use beltgauge::kernel::scalar::runs::{Run, collect, resolve};
use beltgauge::kernel::simd::corners::{Area, minimum_eigenvalues};
use beltgauge::stage::rectify::Rectify;
use beltgauge::units::BeltPx;
use hil::opencv_chain::{Chain, SCORE_UNIT};
use hil::scene::{FPS, Scene};
use opencv::core::Mat;
use opencv::prelude::*;

const WIDTH: usize = 640;
const FRAMES: u64 = 140;
/// What the belt moves in a frame: 500 mm/s at 42 frames/s, 4.4 mm a pixel.
const EXPECTED_PX: f32 = 2.7;

/// The mask as `OpenCV` keeps one: a byte a pixel.
fn bytes(mask: &[u64], width: usize) -> Vec<u8> {
    let rows = mask.chunks_exact(words(width));
    rows.flat_map(|row| (0..width).map(|u| if bits::get(row, u) { 255 } else { 0 })).collect()
}

#[test]
fn rectification_agrees_within_what_the_fractions_leave() {
    let scene = Scene::reference(WIDTH, FRAMES);
    let site = &scene.site;
    let mut plan = beltgauge::plan::Plan::default();
    Rectify::plan(&site.view, &mut plan);
    let mut memory = plan.reserve(64).expect("fits");
    let level = beltgauge::kernel::Level::new();
    let mut ours = Rectify::new(&site.camera, &site.view, level, 1, &mut memory).expect("planned");
    let mut theirs = Chain::new(site);
    let [width, height] = site.camera.image_size_px;
    let frame = scene.frames.last().expect("rendered");
    ours.step(Plane::packed(frame, width, height).expect("this size"));
    theirs.rectify(frame);
    let [columns, rows] = site.view.size_px;
    let (mut compared, mut sum) = (0u32, 0.0);
    for v in 1..rows - 1 {
        let at = |u: usize, v: usize| *theirs.view.at_2d::<u8>(v as i32, u as i32).expect("inside");
        for u in 1..columns - 1 {
            if !bits::get(&ours.seen()[v * words(columns)..], u) {
                continue;
            }
            let near = (v - 1..=v + 1).flat_map(|v| (u - 1..=u + 1).map(move |u| at(u, v)));
            let (low, high) = near.fold((255, 0), |(l, h), g: u8| (l.min(g), h.max(g)));
            let difference = f64::from(ours.view().at(u, v).abs_diff(at(u, v)));
            // Theirs rounds positions to 1/32 px in both axes, ours cuts to 1/128 and follows a
            // lens by chords of 8 px (0.03 px at most at this size): 0.1 px of the local range,
            // and half a grey level of rounding each.
            let bound = 1.0 + 0.1 * f64::from(high - low);
            assert!(difference <= bound, "({u}, {v}): {difference}, {low} to {high}");
            (compared, sum) = (compared + 1, sum + difference);
        }
    }
    let mean = sum / f64::from(compared);
    eprintln!("rectification: {compared} pixels compared, mean difference {mean:.3} grey levels");
    assert!(compared as usize > columns * rows / 2 && mean < 0.5);
}

/// A frame in view of `OpenCV`, and the same as our image.
fn view_of<'a>(theirs: &'a mut Chain, frame: &[u8]) -> Plane<'a> {
    theirs.rectify(frame);
    let (columns, rows) = (theirs.view.cols() as usize, theirs.view.rows() as usize);
    Plane::packed(theirs.view.data_bytes().expect("packed"), columns, rows).expect("this size")
}

#[test]
fn minimum_eigenvalues_agree_within_their_rounding() {
    let scene = Scene::reference(WIDTH, FRAMES);
    let mut theirs = Chain::new(&scene.site);
    theirs.rectify(scene.frames.last().expect("rendered"));
    theirs.score_corners();
    let (columns, rows) = (theirs.view.cols() as usize, theirs.view.rows() as usize);
    let bytes = theirs.view.data_bytes().expect("packed");
    let image = Plane::packed(bytes, columns, rows).expect("this size");
    let all = Area { u: [0, columns], v: [0, rows] };
    let (mut compared, mut largest, mut difference_max) = (0, 0.0f32, 0.0f32);
    minimum_eigenvalues(beltgauge::kernel::Level::new(), image, all, |left, v, scores| {
        for (u, ours) in (left..).zip(scores) {
            let score = theirs.scores.at_2d::<f32>(v as i32, u as i32).expect("inside");
            difference_max = difference_max.max((ours - SCORE_UNIT * score).abs());
            largest = largest.max(*ours);
            compared += 1;
        }
    });
    eprintln!("corners: {compared} compared, up to {largest}, difference {difference_max}");
    assert!(compared == (columns - 14) * (rows - 14) && largest > 100.0);
    // Ours are sums of whole numbers; theirs of 169 rounded ones, 2^-24 of the largest trace each:
    // two squares of 127.5 grey levels.
    assert!(difference_max < 169.0 * 2.0 * 127.5 * 127.5 / (1 << 24) as f32);
}

#[test]
fn corners_are_followed_to_the_same_places() {
    let scene = Scene::reference(WIDTH, FRAMES);
    let mut theirs = Chain::new(&scene.site);
    let pairs = scene.frames[FRAMES as usize - 20..].windows(2);
    let (mut differences, mut chosen) = (Vec::new(), 0);
    for pair in pairs {
        let before = view_of(&mut theirs, &pair[0]);
        let size = [before.width(), before.height()];
        let mut grey = Vec::new();
        (0..size[1]).for_each(|v| grey.extend_from_slice(before.row(v)));
        let before = theirs.view.try_clone().expect("a copy");
        let corners = theirs.good_corners();
        let after = view_of(&mut theirs, &pair[1]);
        let before_plane = Plane::packed(&grey, size[0], size[1]).expect("this size");
        let found: Vec<_> = corners
            .iter()
            .map(|at| {
                let patch = Patch::cut(before_plane, at.x as usize, at.y as usize)?;
                patch.find(after, [at.x + EXPECTED_PX, at.y])
            })
            .collect();
        let same = theirs.follow(&before, &corners, EXPECTED_PX);
        for ((at, ours), other) in corners.iter().zip(found).zip(same) {
            // What stands still is not on a parcel.
            let Some(other) = other.filter(|other| other.x - at.x > 0.5 * EXPECTED_PX) else {
                continue;
            };
            chosen += 1;
            if let Some([u, v]) = ours {
                differences.push((u - other.x).hypot(v - other.y));
            }
        }
    }
    differences.sort_unstable_by(f32::total_cmp);
    let n = differences.len();
    let [median, most] = [n / 2, n * 9 / 10].map(|i| differences[i]);
    eprintln!("flow: {n} of {chosen} followed by both, median {median} px, nine tenths {most} px");
    // Where noise or an edge leaves a direction open both may stop anywhere: a tenth of them.
    assert!(10 * n > 9 * chosen && n > 300);
    // Theirs has Scharr's gradients and no regard for contrast: on noisy corners, where the belt
    // behind moves otherwise, the two may differ by some hundredths of a pixel.
    assert!(median < 0.06 && most < 0.2);
}

#[test]
fn a_flat_parcel_is_as_long_and_wide_as_its_smallest_rectangle() {
    const PARCELS: [[f64; 4]; 3] =
        [[300.0, 180.0, 12.0, -420.0], [240.0, 150.0, 75.0, 0.0], [280.0, 120.0, -35.0, 420.0]];
    let parcel = |[length, width, yaw, y]: [f64; 4]| {
        format!(
            "[[parcel]]\nlength_mm = {length}\nwidth_mm = {width}\nheight_mm = 1\n\
             yaw_deg = {yaw}\nx_mm = -1800\ny_mm = {y}\nmaterial = \"white\"\n"
        )
    };
    let text: String = PARCELS.map(parcel).concat();
    let mut scene = Scene::reference_with(1280, 280, &text);
    let mut theirs = Chain::new(&scene.site);
    let (_, mut pipeline) = beltgauge::run::build(scene.site.clone()).expect("fits");
    let [width, height] = scene.site.camera.image_size_px;
    let view = scene.site.view.clone();
    let [columns, rows] = view.size_px;
    let mut records = Vec::new();
    let mut rectangles = vec![];
    for (n, frame) in scene.frames.iter().enumerate() {
        let raw = Plane::packed(frame, width, height).expect("this size");
        let time = FrameTime { index: n as u64, t_s: n as f64 / FPS };
        pipeline.step(raw, time, &mut |record| records.push(record)).expect("this size");
        let mut truth = vec![false; columns * rows];
        scene.source.parcel_mask(n as u64, &view, &mut truth);
        let bytes: Vec<u8> = truth.iter().map(|t| if *t { 255 } else { 0 }).collect();
        let mask = Mat::new_rows_cols_with_data(rows as i32, columns as i32, &bytes);
        theirs.mask = mask.expect("a mask").try_clone().expect("a copy");
        theirs.connect();
        rectangles.extend(theirs.rectangles());
    }
    assert_eq!(records.len(), PARCELS.len());
    let px = view.mm_per_px;
    for [length, width, _, y_mm] in PARCELS {
        let record = records.iter().find(|r| (r.y_mm - y_mm).abs() < 5.0).expect("measured");
        // Of those wholly in view.
        let sides: Vec<[f64; 2]> = rectangles
            .iter()
            .filter(|r| {
                (view.belt_point(BeltPx { u: 0.0, v: f64::from(r.center.y) }).y - y_mm).abs() < 5.0
            })
            .map(|r| [r.size.width.max(r.size.height), r.size.width.min(r.size.height)])
            .map(|sides| sides.map(|s| f64::from(s) * px))
            .filter(|sides| sides[0] > length - 3.0 * px)
            .collect();
        let mean = [0, 1].map(|k| sides.iter().map(|s| s[k]).sum::<f64>() / sides.len() as f64);
        assert!(sides.len() > 20);
        // The centres of a mask's pixels are half a pixel inside of its border, on the average.
        for (ours, theirs) in [record.length_mm, record.width_mm].into_iter().zip(mean) {
            assert!((ours - theirs).abs() < 0.5 * px, "{length} x {width}: {ours}, {theirs}");
        }
    }
}

#[test]
fn morphology_and_labels_are_the_same_to_the_bit() {
    let scene = Scene::reference(WIDTH, FRAMES);
    let [width, height] = scene.site.camera.image_size_px;
    let mut theirs = Chain::new(&scene.site);
    for frame in &scene.frames {
        theirs.rectify(frame);
        theirs.subtract();
    }
    let [columns, rows] = scene.site.view.size_px;
    let n = words(columns);
    // Their own noisy foreground, and every word of it full of noise.
    for noise in [false, true] {
        let mut mask = vec![0u64; n * rows];
        for v in 0..rows {
            for u in 0..columns {
                let hash = (v * 7919 + u * 104_729) % 1009;
                let set = *theirs.foreground.at_2d::<u8>(v as i32, u as i32).expect("inside") > 0;
                if if noise { hash < 700 } else { set } {
                    bits::set(&mut mask[v * n..], u as u16, u as u16 + 1);
                }
            }
        }
        let before = bytes(&mask, columns);
        theirs.foreground = Mat::new_rows_cols_with_data(rows as i32, columns as i32, &before)
            .expect("a mask")
            .try_clone()
            .expect("a copy");
        theirs.label();
        let settings = &scene.site.config.segment;
        let square = |radius: usize| Square { width: columns, radius, bands: 1 };
        let mut scratch = mask.clone();
        square(settings.open_px).erode(&mut mask, &mut scratch);
        square(settings.open_px + settings.close_px).dilate(&mut mask, &mut scratch);
        square(settings.close_px).erode(&mut mask, &mut scratch);
        assert_eq!(theirs.mask.data_bytes().expect("packed"), bytes(&mask, columns), "{noise}");
        let mut runs = vec![Run::default(); 1 << 18];
        let count = collect(&mask, columns, &mut runs);
        let labels = resolve(&mut runs[..count]);
        let mut areas = vec![0; labels];
        for run in &runs[..count] {
            areas[run.label as usize] += i32::from(run.end - run.start);
        }
        let mut expected = theirs.areas();
        areas.sort_unstable();
        expected.sort_unstable();
        assert_eq!(areas, expected, "{noise}");
        assert!(labels > 0, "an empty mask proves nothing");
    }
    // The frames did show parcels.
    let (_, mut pipeline) = beltgauge::run::build(scene.site.clone()).expect("fits");
    for (n, frame) in scene.frames.iter().enumerate() {
        let raw = Plane::packed(frame, width, height).expect("this size");
        let time = FrameTime { index: n as u64, t_s: n as f64 / FPS };
        pipeline.step(raw, time, &mut |_| {}).expect("this size");
    }
    assert!(pipeline.reference_frames().count() > 0);
}
