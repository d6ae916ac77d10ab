//! Heights by known motion, cell by cell, and what is found in them, on a belt of the project's own.

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::image::Plane;
use beltgauge::kernel::Level;
use beltgauge::plan::Plan;
use beltgauge::run;
use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::stage::measure::Rounding;
use beltgauge::stage::parcels::Face;
use beltgauge::stage::passes::Passes;

/// Neighbours 12 mm apart, of other heights, and a flat envelope.
const PARCELS: &str = r#"
[[parcel]]
length_mm = 180.0
width_mm = 120.0
height_mm = 130.0
yaw_deg = 20.0
x_mm = -1200.0
y_mm = 120.0
material = "kraft"
[[parcel]]
length_mm = 180.0
width_mm = 120.0
height_mm = 60.0
yaw_deg = 20.0
x_mm = -1154.85
y_mm = -4.04
material = "kraft"
[[parcel]]
length_mm = 240.0
width_mm = 160.0
height_mm = 5.0
yaw_deg = -30.0
x_mm = -1500.0
y_mm = -180.0
material = "white"
"#;

const CONFIG: &str = "[camera]\ncalibration = \"the scenario's\"\n[zone]\nx_min_mm = -600\nx_max_mm = 600\n\
                      y_min_mm = -380\ny_max_mm = 380\n[belt]\nspeed_mm_per_s = 500\n";

/// Cells of a face agree on its height; what is left are the cells' own 3.5 mm over the zone's parallax.
const HEIGHT_MM: f64 = 2.0;
/// More than half of the cells within a top face lie within 6 mm of its height, so that the median
/// holds; the others are blurred with a side or a neighbour.
const SHARE_MIN: f64 = 0.5;

/// At the zone's end the taller neighbour's image lies over the lower parcel: 600 mm off, 70 mm higher, from
/// 1.5 m above, by 28 mm. A border behind it is known to that.
const BORDER_MM: f64 = 28.0;

/// What was seen of a belt.
struct Seen {
    scenario: Scenario,
    passes: Passes,
    faces: Vec<Face>,
    /// From belt-fixed X to the scenario's.
    offset_mm: f64,
}

fn look_at(parcels: &str, frames: u32) -> Seen {
    look_at_broken(parcels, frames, u64::MAX)
}

/// From frame `broken` on the belt's position has nothing to do with what it was.
fn look_at_broken(parcels: &str, frames: u32, broken: u64) -> Seen {
    let camera = common::camera_above([1280, 800], 680.0, 1500.0, [-0.18, 0.08, 0.0, 0.0, -0.008]);
    let text = format!(
        "seed = 5\nfps = 30\nframes = {frames}\nexposure_ms = 1.5\n{camera}\
         [belt]\nspeed_mm_per_s = 500\nwidth_mm = 800\ngrey = 45\ntexture_grey = 1.3\n{parcels}"
    );
    let scenario = Scenario::parse(&text).expect("valid");
    let config = Config::parse(CONFIG).expect("valid");
    let site = Site::new(config, scenario.camera().expect("valid")).expect("a zone in view");
    let (view, zone, height_max_mm) = (site.view.clone(), site.config.zone, site.height_max_mm);
    let (mut frames, mut pipeline) = run::build(site).expect("fits");
    let seen = pipeline.seen().to_vec();
    let mut plan = Plan::default();
    Passes::plan(&view, &zone, height_max_mm, &mut plan);
    let (mut memory, level) = (plan.reserve(512).expect("fits"), Level::new());
    let rounding = Rounding::of_radius(0.0);
    let mut passes = Passes::new(&view, &zone, height_max_mm, rounding, level, &seen, &mut memory)
        .expect("planned");
    memory.seal().expect("all taken");
    let (mut faces, mut offset_mm) = (Vec::new(), 0.0);
    let mut source = Synthetic::new(scenario.clone()).expect("a belt");
    let frame = &mut frames[0];
    while let Some(time) = source.next_into(frame).expect("frames") {
        let raw = Plane::packed(frame, 1280, 800).expect("its size");
        pipeline.step(raw, time, &mut |_| ()).expect("measures");
        let mut at = pipeline.belt_position();
        at.breaks += u32::from(time.index >= broken);
        passes.step(pipeline.pixels(), at, time, &mut |passed| faces.push(passed.face));
        offset_mm = scenario.travel_at_frame_mm(time.index) - at.travel_mm;
    }
    passes.finish(&mut |passed| faces.push(passed.face));
    Seen { scenario, passes, faces, offset_mm }
}

#[test]
fn cells_of_a_top_face_agree_on_its_height_and_its_border_is_found() {
    let Seen { scenario, passes, faces, offset_mm } = look_at(PARCELS, 170);
    let evidence = passes.evidence();
    assert_eq!(faces.len(), scenario.parcels().len(), "{faces:?}");
    assert!(faces.iter().all(|face| face.is_cuboid), "{faces:?}");
    let decided = evidence.decided();
    for parcel in scenario.parcels() {
        let mut heights = Vec::new();
        for column in decided.clone() {
            let x_mm = evidence.column_mm(column) - offset_mm;
            for (row, cell) in evidence.column(column).iter().enumerate() {
                let (dx, dy) = (x_mm - parcel.x_mm, evidence.row_mm(row) - parcel.y_mm);
                let (sin, cos) = parcel.yaw_deg.to_radians().sin_cos();
                let (along, across) = (cos * dx + sin * dy, cos * dy - sin * dx);
                let inside = along.abs() < 0.5 * parcel.length_mm - 4.0
                    && across.abs() < 0.5 * parcel.width_mm - 4.0;
                if inside && cell.strength > 0.0 {
                    heights.push(f64::from(cell.height_mm));
                }
            }
        }
        heights.sort_by(f64::total_cmp);
        assert!(heights.len() > 100, "{parcel:?}: {} cells", heights.len());
        let median_mm = heights[heights.len() / 2];
        let near = heights.iter().filter(|h| (*h - parcel.height_mm).abs() < 6.0).count();
        let share = near as f64 / heights.len() as f64;
        eprintln!("{} mm high: median {median_mm:.1}, {share:.2} near it", parcel.height_mm);
        assert!((median_mm - parcel.height_mm).abs() < HEIGHT_MM, "{parcel:?}: {median_mm}");
        assert!(share > SHARE_MIN, "{parcel:?}: {share}");

        let near =
            |x_mm: f64, y_mm: f64| (x_mm - parcel.x_mm).hypot(y_mm - parcel.y_mm) < BORDER_MM;
        let face =
            faces.iter().map(|face| face.rectangle).find(|r| near(r.x_mm + offset_mm, r.y_mm));
        let face = face.unwrap_or_else(|| panic!("no face for {parcel:?} in {faces:?}"));
        let sides = [face.length_mm.max(face.width_mm), face.length_mm.min(face.width_mm)];
        eprintln!("face {:.0} x {:.0} mm", sides[0], sides[1]);
        for (side_mm, true_mm) in sides.into_iter().zip([parcel.length_mm, parcel.width_mm]) {
            assert!((side_mm - true_mm).abs() < BORDER_MM, "{parcel:?}: {face:?}");
        }
    }
}

/// What has no flat top with straight edges.
const OTHERS: &str = r#"
[[parcel]]
shape = "tube"
length_mm = 300.0
width_mm = 90.0
height_mm = 90.0
yaw_deg = 25.0
x_mm = -1200.0
y_mm = 150.0
material = "kraft"
[[parcel]]
shape = "bag"
length_mm = 270.0
width_mm = 180.0
height_mm = 45.0
yaw_deg = 35.0
x_mm = -1250.0
y_mm = -180.0
material = "white"
"#;

/// What encloses a thing is known at each side to the dark line of its own shadow, 6 mm, and to a place of 2 mm.
const ENCLOSED_MM: f64 = 16.0;

#[test]
fn a_tube_and_a_bag_are_enclosed() {
    let Seen { scenario, faces, offset_mm, .. } = look_at(OTHERS, 180);
    assert_eq!(faces.len(), scenario.parcels().len(), "{faces:?}");
    for parcel in scenario.parcels() {
        let near = |face: &&Face| {
            let r = &face.rectangle;
            (r.x_mm + offset_mm - parcel.x_mm).hypot(r.y_mm - parcel.y_mm) < 2.0 * BORDER_MM
        };
        let face = faces.iter().find(near).unwrap_or_else(|| panic!("{parcel:?}: {faces:?}"));
        let r = &face.rectangle;
        let found = [r.length_mm.max(r.width_mm), r.length_mm.min(r.width_mm), face.height_mm];
        let truth = [parcel.length_mm, parcel.width_mm, parcel.height_mm];
        for (found_mm, true_mm) in found.into_iter().zip(truth) {
            assert!((found_mm - true_mm).abs() < ENCLOSED_MM, "{parcel:?}: {face:?}");
        }
        assert!(!face.is_cuboid, "{parcel:?}");
    }
}

/// In the middle of the zone when the recording ends.
const LAST: &str = r#"
[[parcel]]
length_mm = 240.0
width_mm = 160.0
height_mm = 60.0
yaw_deg = 30.0
x_mm = -1200.0
y_mm = 60.0
material = "kraft"
"#;

#[test]
fn what_is_in_the_zone_at_the_end_is_told() {
    let Seen { scenario, faces, offset_mm, .. } = look_at(LAST, 76);
    let [face] = faces[..] else { panic!("{faces:?}") };
    let parcel = &scenario.parcels()[0];
    let r = &face.rectangle;
    let off_mm = (r.x_mm + offset_mm - parcel.x_mm).hypot(r.y_mm - parcel.y_mm);
    let sides = [r.length_mm.max(r.width_mm), r.length_mm.min(r.width_mm)];
    let near = |found_mm: f64, true_mm: f64| (found_mm - true_mm).abs() < BORDER_MM;
    assert!(near(off_mm, 0.0) && near(sides[0], 240.0) && near(sides[1], 160.0), "{face:?}");
    assert!(face.is_cuboid && (face.height_mm - 60.0).abs() < HEIGHT_MM, "{face:?}");
}

#[test]
fn what_is_in_the_zone_when_the_belt_s_position_breaks_is_told_once() {
    // In frame 45 all of it is in the zone, its middle 450 mm before the zone's.
    let Seen { faces, .. } = look_at_broken(LAST, 140, 45);
    let [face] = faces[..] else { panic!("{faces:?}") };
    assert!(face.is_cuboid && (face.height_mm - 60.0).abs() < HEIGHT_MM, "{face:?}");
}
