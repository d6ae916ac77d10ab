//! Properties of the synthetic belt: what a scenario says shows.

use super::*;

/// FNV-1a. Source: Fowler, Noll and Vo 1991.
fn hash(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}

#[test]
fn a_scenario_without_lamps_looks_as_it_always_did() {
    let text = include_str!("../../../config/demo/scenario.toml");
    let mut source = Synthetic::new(Scenario::parse(text).expect("valid")).expect("renders");
    let mut frame = vec![0; 1280 * 800];
    let hashes = [90, 150].map(|index| {
        source.render(index, &mut frame);
        hash(&frame)
    });
    assert_eq!(hashes, [579_411_251_160_323_890, 6_585_253_849_508_366_193]);
}

/// A white box and a flat kraft one beside it, under one small lamp at the white one's other side.
const SMALL: &str = "
seed = 3
fps = 40
frames = 400
exposure_ms = 1.0
[camera]
image_size_px = [320, 200]
[camera.lens]
model = \"brown\"
fx_px = 340
fy_px = 340
cx_px = 159.5
cy_px = 99.5
distortion = [0, 0, 0, 0, 0]
[camera.pose]
rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
translation_mm = [0, 0, 1500]
[belt]
speed_mm_per_s = 500
width_mm = 900
grey = 45
texture_grey = 1
#BELT
[light]
ambient = 0.3
[[light.lamp]]
x_mm = -700
y_mm = 0
z_mm = 1600
radius_mm = 20
strength = 0.7
#LAMP
[sensor]
#SENSOR
[[parcel]]
length_mm = 200
width_mm = 120
height_mm = 150
yaw_deg = 90
x_mm = -150
y_mm = 0
material = \"white\"
#TALL
[[parcel]]
length_mm = 200
width_mm = 150
height_mm = 10
yaw_deg = 90
x_mm = 10
y_mm = 0
material = \"white\"
#FLAT
";

fn small(with: &[(&str, &str)]) -> Synthetic {
    let text = with.iter().fold(SMALL.to_owned(), |text, (place, more)| {
        assert!(text.contains(place));
        text.replace(place, more)
    });
    Synthetic::new(Scenario::parse(&text).expect(&text)).expect("renders")
}

fn rendered(source: &mut Synthetic, index: u64) -> Vec<u8> {
    let mut frame = vec![0; 320 * 200];
    source.render(index, &mut frame);
    frame
}

/// Mean grey around the image of a point.
fn grey_at(source: &Synthetic, frame: &[u8], at: [f64; 3]) -> f64 {
    let px = source.renderer.camera().project(nalgebra::Vector3::from(at)).expect("in view");
    let (u, v) = (px.x.round() as usize, px.y.round() as usize);
    let near = (v - 1..=v + 1).flat_map(|v| (u - 1..=u + 1).map(move |u| v * 320 + u));
    near.map(|i| f64::from(frame[i])).sum::<f64>() / 9.0
}

#[test]
fn a_tall_parcel_throws_its_shadow_on_its_flat_neighbour() {
    let mut source = small(&[]);
    let frame = rendered(&mut source, 0);
    // The lamp sees over the edge at x = -90, z = 150: its light meets z = 10 at about x = -31.
    let (dark, bright) = (
        grey_at(&source, &frame, [-48.0, 60.0, 10.0]),
        grey_at(&source, &frame, [50.0, 60.0, 10.0]),
    );
    assert!(dark < 0.55 * bright && dark > 0.2 * bright, "{dark} beside {bright}");
    let mut alone = small(&[("x_mm = -150", "x_mm = -1150")]);
    let frame = rendered(&mut alone, 0);
    let lit = grey_at(&alone, &frame, [-48.0, 60.0, 10.0]);
    assert!(lit > 0.9 * bright, "{lit} beside {bright}");
}

#[test]
fn what_hangs_in_throws_its_shadow_on_belt_and_parcel() {
    // The lamp is at x = -700, z = 1600: light that passes z = 700 at x = -263 meets z = 10 at x = 75.
    let rod = "[[intruder]]\nfrom_s = 0\nto_s = 9\nvelocity_mm_per_s = [0, 0, 0]\n\
               rod = [{ from_mm = [-263, -300, 700], to_mm = [-263, 300, 700], radius_mm = 15, grey = 20 }]";
    let (mut free, mut hung) = (small(&[]), small(&[("#FLAT", rod)]));
    let (without, with) = (rendered(&mut free, 0), rendered(&mut hung, 0));
    for at in [[75.0, 60.0, 10.0], [82.0, 150.0, 0.0]] {
        let (lit, dark) = (grey_at(&free, &without, at), grey_at(&free, &with, at));
        assert!(dark < 0.6 * lit, "{at:?}: {dark} of {lit}");
    }
    let beside = [140.0, 150.0, 0.0];
    assert_eq!(grey_at(&free, &without, beside).to_bits(), grey_at(&free, &with, beside).to_bits());
}

#[test]
fn a_tote_is_in_its_own_light_and_a_box_is_not() {
    // Lit from -X: inside, the wall there throws its shadow on the floor; the other wall is lit.
    let mut tote = small(&[("#TALL", "shape = \"tote\""), ("ambient = 0.3", "ambient = 0.05")]);
    let frame = rendered(&mut tote, 12);
    let floor = grey_at(&tote, &frame, [-30.0, 0.0, 4.0]);
    let wall = grey_at(&tote, &frame, [54.0, 0.0, 140.0]);
    assert!(floor < 0.3 * wall, "floor {floor}, wall {wall}");
}

#[test]
fn a_long_exposure_smears_the_belt_along_its_way_only() {
    let lines = "pattern = { kind = \"ribbed\", pitch_mm = 30, contrast_grey = 40, gap_mm = 8 }";
    let contrast = |exposure: &str| {
        let mut belt = small(&[("#BELT", lines), ("exposure_ms = 1.0", exposure)]);
        let frame = rendered(&mut belt, 0);
        let row: Vec<u8> = frame[180 * 320 + 200..180 * 320 + 300].to_vec();
        row.iter().max().copied().unwrap_or(0) - row.iter().min().copied().unwrap_or(0)
    };
    // 15 mm of way: half a pitch; the groove is a quarter of it.
    let (sharp, smeared) = (contrast("exposure_ms = 1.0"), contrast("exposure_ms = 30"));
    assert!(f64::from(smeared) < 0.75 * f64::from(sharp), "{smeared} of {sharp}");
}

#[test]
fn the_sun_through_a_window_lights_a_patch_and_no_more() {
    let sun = "[[light.lamp]]\nx_mm = 0\ny_mm = 0\nz_mm = 100000\nradius_mm = 470\nstrength = 1\n\
               window = { x_mm = 250, y_mm = -150, length_mm = 100, width_mm = 80, yaw_deg = 0, edge_mm = 5 }";
    let mut source = small(&[("#LAMP", sun)]);
    let frame = rendered(&mut source, 0);
    let inside = grey_at(&source, &frame, [250.0, -150.0, 0.0]);
    let outside = grey_at(&source, &frame, [250.0, -250.0, 0.0]);
    assert!(inside > 1.7 * outside, "{inside} and {outside}");
}

#[test]
fn every_property_can_be_said_and_shows() {
    let plain = rendered(&mut small(&[]), 30);
    for (place, more) in [
        ("#TALL", "shape = \"tube\""),
        ("#TALL", "shape = \"bag\""),
        ("#TALL", "shape = \"tote\""),
        ("#TALL", "shape = \"stack\""),
        ("#FLAT", "shape = \"envelope\""),
        ("#TALL", "shape = \"book\""),
        ("#TALL", "straps = 2"),
        ("#TALL", "wrap = 0.8"),
        ("#TALL", "label_edge_mm = 2"),
        ("#TALL", "tape = true"),
        ("#TALL", "crush_mm = 40"),
        ("#TALL", "edge_radius_mm = 40"),
        ("#TALL", "slide = [0.02, 0.02]"),
        ("#TALL", "turn_deg_per_m = 20"),
        ("#BELT", "side_drift_mm = 8"),
        ("#BELT", "shine = 0.5"),
        ("#BELT", "stop = [{ at_s = 0.1, for_s = 0.2, ramp_s = 0.1, back_mm = 10 }]"),
        ("#BELT", "mark = [{ x_mm = 0, y_mm = 0, length_mm = 80, width_mm = 300, grey = 200 }]"),
        ("#BELT", "dirt = { per_m2 = 100, size_mm = [5, 60], grey = [10, 150] }"),
        ("#SENSOR", "auto_exposure_grey = 90"),
        (
            "#FLAT",
            "[[intruder]]\nfrom_s = 0\nto_s = 2\nvelocity_mm_per_s = [0, 10, 0]\n\
             rod = [{ from_mm = [0, -300, 400], to_mm = [0, 0, 400], radius_mm = 40, grey = 100 }]",
        ),
    ] {
        let shown = rendered(&mut small(&[(place, more)]), 30);
        let changed = shown.iter().zip(&plain).filter(|(a, b)| a.abs_diff(**b) > 8).count();
        assert!(changed > 40, "{more}: {changed} px");
        assert_eq!(rendered(&mut small(&[(place, more)]), 30), shown, "{more}");
    }
}

#[test]
fn the_automatic_exposure_holds_the_mean() {
    let mut source = small(&[("#SENSOR", "auto_exposure_grey = 60\nauto_exposure_frames = 3")]);
    let mean = |frame: &[u8]| frame.iter().map(|g| f64::from(*g)).sum::<f64>() / frame.len() as f64;
    // The parcels leave the picture: darker and darker, but for the exposure.
    let mut frame = vec![0; 320 * 200];
    for index in 0..80 {
        source.render(index, &mut frame);
    }
    assert!((mean(&frame) - 60.0).abs() < 4.0, "{}", mean(&frame));
    let mut without = small(&[]);
    without.render(79, &mut frame);
    assert!((mean(&frame) - 60.0).abs() > 10.0, "{}", mean(&frame));
}
