//! Properties over random input: parsers never panic, geometry inverts.

use beltgauge::camera::{BeltView, Camera, Lens, LensModel};
use beltgauge::config::{Config, Site};
use beltgauge::source::synthetic::Scenario;
use beltgauge::source::{FrameSource, Y4m};
use beltgauge::units::{BeltMm, BeltRect, RawPx};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;

const ZONE: BeltRect =
    BeltRect { x_min_mm: -400.0, x_max_mm: 400.0, y_min_mm: -250.0, y_max_mm: 250.0 };

/// A camera `height_mm` above the belt, tilted and rolled, with barrel distortion.
fn camera(height_mm: f64, tilt_deg: f64, roll_deg: f64, k1: f64) -> Camera {
    let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), tilt_deg.to_radians());
    let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), roll_deg.to_radians());
    let down = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let rotation = (tilt * roll * down).into_inner();
    Camera {
        image_size_px: [1280, 800],
        lens: Lens::new(LensModel::Brown, [700.0; 2], [640.0, 400.0], [k1, 0.02, 0.0, 0.0, 0.0]),
        camera_from_belt: rotation,
        translation_mm: rotation * Vector3::new(0.0, 0.0, -height_mm),
    }
}

proptest! {
    #[test]
    fn a_pixel_of_the_belt_projects_back_to_itself(
        height_mm in 500.0..3000.0, tilt_deg in -40.0..40.0, roll_deg in -180.0..180.0,
        k1 in -0.2..0.05, x in 0.0..1279.0, y in 0.0..799.0,
    ) {
        let camera = camera(height_mm, tilt_deg, roll_deg, k1);
        if let Some(at) = camera.belt_point(RawPx { x, y }) {
            let back = camera.project(Vector3::new(at.x, at.y, 0.0));
            // Newton stops at 1e-12 of a focal length of 700 px.
            prop_assert!(back.is_some_and(|px| (px.x - x).hypot(px.y - y) < 1e-6), "{back:?}");
        }
    }

    #[test]
    fn the_belt_view_holds_the_zone_and_what_stands_in_it(
        height_mm in 900.0..2500.0, tilt_deg in -20.0..20.0, object_mm in 10.0..400.0,
        x in -400.0..400.0, y in -250.0..250.0,
    ) {
        let camera = camera(height_mm, tilt_deg, 0.0, -0.1);
        let view = BeltView::covering(&camera, &ZONE, 400.0, 2.0);
        let at = view.project(nalgebra::Vector2::new(x, y), object_mm);
        let px = view.px(BeltMm { x: at.x, y: at.y });
        let inside = |v: f64, n: usize| v >= 0.0 && v <= (n - 1) as f64;
        let raw = camera.project(Vector3::new(at.x, at.y, 0.0));
        // What the camera does not see is cut off; everything else must be there.
        if raw.is_some_and(|px| camera.sees(px)) {
            prop_assert!(inside(px.u, view.size_px[0]) && inside(px.v, view.size_px[1]), "{px:?}");
        }
        // Both sides look at the same ray.
        let direct = camera.project(Vector3::new(x, y, object_mm));
        if let (Some(a), Some(b)) = (raw, direct) {
            prop_assert!((a.x - b.x).hypot(a.y - b.y) < 1e-6, "{a:?} {b:?}");
        }
    }

    #[test]
    fn any_bytes_are_a_stream_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = Y4m::new(Box::new(std::io::Cursor::new(bytes)), "random", None);
    }

    #[test]
    fn any_header_fields_are_a_stream_or_an_error(
        fields in "( [WHFCIAX][0-9:a-z]{0,12}){0,6}", rest in prop::collection::vec(any::<u8>(), 0..2000),
    ) {
        let mut bytes = format!("YUV4MPEG2{fields}\nFRAME\n").into_bytes();
        bytes.extend(rest);
        if let Ok(mut stream) = Y4m::new(Box::new(std::io::Cursor::new(bytes)), "random", None) {
            let [width, height] = stream.size_px();
            if width * height < 1 << 20 {
                let mut frame = vec![0; width * height];
                while let Ok(Some(_)) = stream.next_into(&mut frame) {}
            }
        }
    }

    #[test]
    fn any_text_is_a_configuration_or_an_error(text in "(\\[?[a-z_.]{1,10}\\]?( = [-0-9.a-z\"]{1,8})?\n){0,8}") {
        let _ = Config::parse(&text);
        let _ = Scenario::parse(&text);
    }

    #[test]
    fn any_zone_is_a_site_or_an_error(
        x_min in -3000.0..3000.0, length in 0.0..4000.0, y_min in -3000.0..3000.0, width in 0.0..4000.0,
        height_mm in 60.0..5000.0, tilt_deg in -85.0..85.0, mm_per_px in 0.05..20.0,
    ) {
        let text = format!(
            "[camera]\ncalibration = \"c\"\n[view]\nmm_per_px = {mm_per_px}\n\
             [zone]\nx_min_mm = {x_min}\nx_max_mm = {}\ny_min_mm = {y_min}\ny_max_mm = {}\n\
             [belt]\nspeed_mm_per_s = 500\n", x_min + length, y_min + width,
        );
        let camera = camera(height_mm, tilt_deg, 0.0, -0.1);
        if let Ok(site) = Config::parse(&text).and_then(|config| Site::new(config, camera)) {
            prop_assert!(site.view.size_px.iter().all(|&n| (1..=8192).contains(&n)));
        }
    }
}
