//! `OpenCV` as oracle of the kernels, on frames of the synthetic belt with parcels in view.

use beltgauge::image::{FrameTime, Plane};
use beltgauge::kernel::scalar::bits::{self, Square, words};
use beltgauge::kernel::scalar::runs::{Run, collect, resolve};
use beltgauge::stage::rectify::Rectify;
use hil::opencv_chain::Chain;
use hil::scene::{FPS, Scene};
use opencv::core::Mat;
use opencv::prelude::*;

const WIDTH: usize = 640;
const FRAMES: u64 = 140;

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
