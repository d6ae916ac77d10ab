//! `beltgauge calibrate` as a technician runs it: on pictures rendered here, and on bad input.

mod common;
#[path = "common/chessboard.rs"]
mod scene;

use beltgauge::camera::calibrate::Pose;
use beltgauge::camera::chessboard::Chessboard;
use beltgauge::camera::{CameraFile, Lens, LensModel};
use beltgauge::source::Still;
use common::{beltgauge, run, scratch};
use nalgebra::{Matrix3, Rotation3, Vector3};
use scene::{Shot, photograph, pose};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::time::{Duration, Instant};

const SIZE: [usize; 2] = [800, 600];

fn board() -> Chessboard {
    Chessboard::new([8, 5], 30.0)
}

fn lens() -> Lens {
    Lens::new(
        LensModel::Brown,
        [620.0, 621.0],
        [405.0, 296.0],
        [-0.22, 0.09, 0.0004, -0.0006, -0.01],
    )
}

fn save(still: &Still, path: &Path) {
    let [width, height] = still.size_px.map(|s| s as u32);
    image::save_buffer(path, &still.pixels, width, height, image::ColorType::L8).expect("writable");
}

/// Twelve pictures of the board at all places and tilts.
fn write_views(folder: &Path) {
    for k in 0..12 {
        let (u, v) = (f64::from(k % 3) - 1.0, f64::from(k / 3 % 3) - 1.0);
        let tilt = [[30.0, 0.0], [-30.0, 10.0], [5.0, 35.0], [-10.0, -35.0]][k as usize % 4];
        let z = 400.0 + 15.0 * f64::from(k);
        let angles = [tilt[0], tilt[1], 20.0 * f64::from(k)];
        let pose = pose(&board(), angles, [0.32 * z * u, 0.24 * z * v, z]);
        let still = photograph(&board(), &lens(), &pose, Shot::sharp(SIZE));
        save(&still, &folder.join(format!("view_{k:02}.png")));
    }
}

/// Height of the camera over the synthetic belt, and its pose.
const HEIGHT_MM: f64 = 900.0;

fn belt_pose() -> Pose {
    let down = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let tilt = Rotation3::new(Vector3::new(6.0, -3.0, 8.0) * f64::to_radians(1.0));
    let rotation = tilt.into_inner() * down;
    Pose { rotation, translation_mm: -(rotation * Vector3::new(0.0, 0.0, HEIGHT_MM)) }
}

/// Three stills of the board, 3 mm thick, carried along.
fn write_pass(folder: &Path) {
    let belt = belt_pose();
    for (k, x) in [-330.0, -60.0, 180.0].into_iter().enumerate() {
        let flat = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
        let turned = Rotation3::new(Vector3::z() * 0.3).into_inner() * flat;
        let pose = Pose {
            rotation: belt.rotation * turned,
            translation_mm: belt.apply(Vector3::new(x, 60.0, 3.0)),
        };
        let still = photograph(&board(), &lens(), &pose, Shot::sharp(SIZE));
        save(&still, &folder.join(format!("belt_{k}.png")));
    }
}

fn calibrate(what: &str, arguments: &[&str], folder: &Path) -> Output {
    run(beltgauge().current_dir(folder).args(["calibrate", what]).args(arguments))
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn refused(output: &Output, status: i32, words: &[&str]) {
    let errors = text(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{errors}");
    for word in words {
        assert!(errors.contains(word), "no {word:?} in:\n{errors}");
    }
    assert!(!errors.contains("panicked"), "{errors}");
}

#[test]
fn from_pictures_to_a_camera_over_its_belt() {
    let folder = scratch("calibrate");
    fs::create_dir(folder.join("views")).expect("writable");
    fs::create_dir(folder.join("pass")).expect("writable");
    write_views(&folder.join("views"));
    write_pass(&folder.join("pass"));

    let board = ["--board", "5x8", "--square-mm", "30"];
    let arguments = [&["views", "--out", "lens.toml"], &board[..]].concat();
    let output = calibrate("lens", &arguments, &folder);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let written = fs::read_to_string(folder.join("lens.toml")).expect("written");
    let file: toml::Table = written.parse().expect("TOML");
    let found = CameraFile::load_lens(&folder.join("lens.toml")).expect("a lens").lens;
    // A dozen views: five standard deviations are 0.1 % of the focal length and 1 px.
    assert!((found.fx_px / 620.0 - 1.0).abs() < 1e-3, "{found:?}");
    assert!((found.fy_px / 621.0 - 1.0).abs() < 1e-3, "{found:?}");
    assert!((found.cx_px - 405.0).abs() < 1.0 && (found.cy_px - 296.0).abs() < 1.0, "{found:?}");
    assert!(file["rms_px"].as_float().is_some_and(|r| r < 0.1), "{written}");
    assert!(!file.contains_key("pose"));
    let images = file["image"].as_array().expect("every image");
    assert_eq!(images.len(), 12);
    assert!(images.iter().all(|i| i["rms_px"].as_float().is_some()));
    let report = fs::read_to_string(folder.join("lens.html")).expect("written");
    for part in ["view_07.png", "Coverage", "Distortion", "data:image/jpeg;base64,", "<svg"] {
        assert!(report.contains(part), "no {part} in the report");
    }
    assert!(!report.contains("http"), "the report is not self-contained");

    let more = ["--board-thickness-mm", "3", "--lens", "lens.toml", "--out", "camera.toml"];
    let stills = ["pass/belt_0.png", "pass/belt_1.png", "pass/belt_2.png"];
    let output = calibrate("belt", &[&stills[..], &board, &more].concat(), &folder);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let camera = CameraFile::load(&folder.join("camera.toml")).expect("a camera");
    let truth = belt_pose();
    let turn = camera.camera_from_belt.transpose() * truth.rotation;
    let tilt_deg = turn[(0, 2)].hypot(turn[(1, 2)]).to_degrees();
    // 0.1 % of the focal length; a board of 21 cm from 0.9 m.
    assert!((camera.centre_in_belt().z - HEIGHT_MM).abs() < 1.5, "{camera:?}");
    assert!(tilt_deg < 0.15, "{tilt_deg}");
    assert!(turn[(1, 0)].to_degrees().abs() < 0.05, "{turn}");
    let report = fs::read_to_string(folder.join("camera.html")).expect("written");
    assert!(report.contains("belt_2.png") && report.contains("<image"));

    let folder_instead = calibrate("belt", &[&["pass"][..], &board, &more].concat(), &folder);
    assert_eq!(folder_instead.status.code(), Some(0), "{}", text(&folder_instead.stderr));
    let one = calibrate("belt", &[&stills[..1], &board, &more].concat(), &folder);
    assert_eq!(one.status.code(), Some(0));
    assert!(text(&one.stderr).contains("warning: the direction of travel"));

    // What is wrong with an image is said of that image.
    fs::write(folder.join("views/view_03.png"), b"no picture").expect("writable");
    refused(&calibrate("lens", &arguments, &folder), 1, &["unreadable image", "view_03.png"]);
    save(&Still { pixels: vec![9; 64 * 64], size_px: [64, 64] }, &folder.join("views/view_03.png"));
    let output = calibrate("lens", &arguments, &folder);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let written = fs::read_to_string(folder.join("lens.toml")).expect("written");
    assert!(written.contains("64 x 64 px, not 800 x 600"), "{written}");
    assert!(written.contains("image_size_px = [800, 600]"), "{written}");
    save(&Still { pixels: vec![9; 480_000], size_px: SIZE }, &folder.join("views/view_03.png"));
    let output = calibrate("lens", &arguments, &folder);
    assert_eq!(output.status.code(), Some(0));
    let written = fs::read_to_string(folder.join("lens.toml")).expect("written");
    assert!(written.contains("no board of 5x8 inner corners"), "{written}");

    for k in [0, 1, 2, 4, 5, 6] {
        let other = Still { pixels: vec![9; 640 * 480], size_px: [640, 480] };
        save(&other, &folder.join(format!("views/view_{k:02}.png")));
    }
    let tie = calibrate("lens", &arguments, &folder);
    refused(&tie, 2, &["6 images of 640 x 480 px", "6 of 800 x 600 px as view_03.png", "one size"]);
    write_views(&folder.join("views"));

    let wrong = ["views", "--board", "9x6", "--square-mm", "30", "--out", "wrong.toml"];
    let output = calibrate("lens", &wrong, &folder);
    refused(&output, 2, &["0 usable views", "the board found in 0", "8x5 inner corners"]);
    assert!(text(&output.stdout).contains("8x5 inner corners, not 9x6"));
    assert!(!folder.join("wrong.toml").exists());
}

#[test]
fn a_wrong_command_line_names_what_it_wants() {
    let folder = scratch("calibrate_usage");
    let lens = |board: &str, square: &str| {
        calibrate(
            "lens",
            &["a.png", "--board", board, "--square-mm", square, "--out", "x"],
            &folder,
        )
    };
    refused(&lens("9", "25"), 2, &["--board", "9x6"]);
    refused(&lens("9x2", "25"), 2, &["3 to 60"]);
    refused(&lens("9x6", "-1"), 2, &["--square-mm"]);
    refused(&lens("9x6", "0"), 2, &["above 0"]);
    refused(&lens("9x6", "nan"), 2, &["at most 10000"]);
    refused(&lens("9x6", "25"), 1, &["a.png"]);
    let half = ["a.png", "--board", "9x6", "--square-mm", "25", "--out", "x", "--focal-mm", "8"];
    refused(&calibrate("lens", &half, &folder), 2, &["--sensor-width-mm"]);
    refused(&calibrate("belt", &["a.png", "--lens", "l", "--out", "x"], &folder), 2, &["--board"]);
    refused(&calibrate("belt", &["--lens", "l", "--out", "x"], &folder), 2, &["IMAGES"]);
}

fn write_lens(folder: &Path) -> PathBuf {
    let path = folder.join("lens.toml");
    let text = "image_size_px = [800, 600]\n[lens]\nmodel = \"brown\"\nfx_px = 620\nfy_px = 620\n\
                cx_px = 400\ncy_px = 300\ndistortion = [0, 0, 0, 0, 0]\n";
    fs::write(&path, text).expect("writable");
    path
}

#[test]
fn surveyed_points_from_a_table() {
    let folder = scratch("calibrate_points");
    write_lens(&folder);
    let run = |csv: &str| {
        fs::write(folder.join("points.csv"), csv).expect("writable");
        let arguments = ["--points", "points.csv", "--lens", "lens.toml", "--out", "camera.toml"];
        calibrate("belt", &arguments, &folder)
    };
    // A camera 1000 mm above (100, 50), looking straight down: 0.62 px a mm.
    let good = "\u{feff}X;Y;Z;u;v\n# the four corners\n\n-200;-250;0;214;486\n400;-250;0;586;486\n\
                400;350;0;586;114\n-200;350;0;214;114\n100;50;0;400;300\n";
    let output = run(good);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let camera = CameraFile::load(&folder.join("camera.toml")).expect("a camera");
    // Exact points.
    assert!((camera.centre_in_belt() - Vector3::new(0.0, 0.0, 1000.0)).norm() < 1e-3, "{camera:?}");
    let written = fs::read_to_string(folder.join("camera.toml")).expect("written");
    assert!(written.contains("surveyed_origin_mm"), "{written}");
    assert!(folder.join("camera.html").exists());

    let before = fs::read(folder.join("camera.toml")).expect("written");
    let html = ["--points", "points.csv", "--lens", "lens.toml", "--out", "camera.html"];
    refused(&calibrate("belt", &html, &folder), 2, &["camera.html", ".toml"]);
    let itself = ["--points", "points.csv", "--lens", "lens.toml", "--out", "points.csv"];
    refused(&calibrate("belt", &itself, &folder), 2, &["points.csv", "one of the inputs"]);
    let lens = ["--points", "points.csv", "--lens", "lens.toml", "--out", "lens.toml"];
    refused(&calibrate("belt", &lens, &folder), 2, &["lens.toml", "one of the inputs"]);
    fs::create_dir(folder.join("folder")).expect("writable");
    let special = ["--points", "points.csv", "--lens", "lens.toml", "--out", "folder"];
    refused(&calibrate("belt", &special, &folder), 2, &["not a plain file"]);
    refused(&run("1,2,3\n"), 2, &["points.csv, line 1", "five numbers"]);
    refused(&run("X,Y,Z,u,v\n1,2,0,3,x\n"), 2, &["line 2"]);
    refused(&run("1,2,0,3,inf\n"), 2, &["line 1"]);
    refused(&run(""), 2, &["0 points"]);
    refused(&run("1,2,0,3,4\n1,2,0,3,4\n1,2,0,3,4\n1,2,0,3,4\n"), 2, &["on one line"]);
    assert_eq!(
        fs::read(folder.join("camera.toml")).expect("kept"),
        before,
        "an error changes nothing"
    );
}

#[test]
fn a_lens_file_that_is_none_is_named() {
    let folder = scratch("calibrate_lens_file");
    fs::write(folder.join("lens.toml"), "image_size_px = 3").expect("writable");
    fs::write(folder.join("p.csv"), "").expect("writable");
    let arguments = ["--points", "p.csv", "--lens", "lens.toml", "--out", "camera.toml"];
    refused(&calibrate("belt", &arguments, &folder), 2, &["lens.toml", "not a camera calibration"]);
    let good = fs::read_to_string(write_lens(&folder)).expect("written");
    for sigma in ["fx_px = nan", "fx_px = -1.0"] {
        let table =
            "\n[lens_sigma]\nfy_px = 1\ncx_px = 1\ncy_px = 1\ndistortion = [0, 0, 0, 0, 0]\n";
        fs::write(folder.join("lens.toml"), format!("{good}{table}{sigma}\n")).expect("writable");
        refused(&calibrate("belt", &arguments, &folder), 2, &["lens.toml", "lens_sigma"]);
    }
    let missing = ["--points", "p.csv", "--lens", "no.toml", "--out", "camera.toml"];
    refused(&calibrate("belt", &missing, &folder), 2, &["no.toml", "calibrate lens"]);
}

#[test]
fn a_stick_with_stills_is_calibrated_as_it_is_imported() {
    let root = scratch("import-stills");
    let stick = root.join("stick/beltgauge");
    for folder in ["lens", "belt"] {
        fs::create_dir_all(stick.join(folder)).expect("writable");
    }
    write_views(&stick.join("lens"));
    write_pass(&stick.join("belt"));
    let config = "[camera]\ncalibration = \"camera.toml\"\n[zone]\nx_min_mm = -250\nx_max_mm = 250\n\
                  y_min_mm = -150\ny_max_mm = 150\n[belt]\nspeed_mm_per_s = 500\n";
    fs::write(stick.join("beltgauge.toml"), config).expect("writable");
    let board = "board = [5, 8]\nsquare_mm = 30\nboard_thickness_mm = 3\n";
    fs::write(stick.join("calibration.toml"), board).expect("writable");
    let (store, temporary) = (root.join("store"), root.join("tmp"));
    fs::create_dir(&temporary).expect("writable");
    let command = || {
        let mut command = beltgauge();
        command.arg("import").arg(root.join("stick")).arg("--store").arg(&store);
        command.env("TMPDIR", &temporary);
        command
    };
    let import = || run(&mut command());
    // Killed while it computes: the next one removes what it left, and says so.
    let left = || fs::read_dir(&temporary).expect("there").count();
    let mut killed = command().stderr(Stdio::null()).spawn().expect("starts");
    let start = Instant::now();
    while left() == 0 {
        assert!(start.elapsed() < Duration::from_mins(1), "it never began");
        std::thread::sleep(Duration::from_millis(1));
    }
    killed.kill().expect("it runs");
    killed.wait().expect("it ended");
    assert!(left() == 1 && !store.join("current").exists());
    let output = import();
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(left() == 0 && text(&output.stderr).contains("cut off"), "{}", text(&output.stderr));
    let record = fs::read_to_string(store.join("import.toml")).expect("kept");
    assert!(record.contains("count = 2"), "{record}");
    let report = text(&output.stdout);
    assert!(report.contains("view_07.png") && report.contains("is in force"), "{report}");
    let camera = CameraFile::load(&root.join("store/current/camera.toml")).expect("a camera");
    // As in the test above.
    assert!((camera.centre_in_belt().z - HEIGHT_MM).abs() < 1.5, "{camera:?}");
    // What it came to is left on the stick, and does not stand in for the next calibration.
    let results = stick.join("results");
    let result = |name: &str| fs::read(results.join(name)).expect("left");
    assert_eq!(result("camera.toml"), fs::read(store.join("current/camera.toml")).expect("there"));
    assert!(["lens.toml", "lens.html", "camera.html"].iter().all(|name| !result(name).is_empty()));
    fs::remove_dir_all(&results).expect("there");
    // A still that is none is rejected with its reason; no still of the belt is an error.
    fs::write(stick.join("lens/view_03.png"), "no picture").expect("writable");
    refused(&import(), 1, &["view_03.png"]);
    fs::remove_dir_all(stick.join("belt")).expect("there");
    fs::remove_file(stick.join("lens/view_03.png")).expect("there");
    refused(&import(), 2, &["belt", "no stills"]);
    assert!(results.join("lens.html").exists(), "the lens is told all the same");
    fs::write(stick.join("calibration.toml"), "board = [1, 8]\nsquare_mm = 30\n")
        .expect("writable");
    refused(&import(), 2, &["calibration.toml", "3 to 60 inner corners"]);
}
