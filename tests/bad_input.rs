//! Bad input gets a clear error (what, where, allowed, remedy), the promised exit status, and
//! loses nothing of what was measured before it.

mod common;

use common::{beltgauge, run, scratch, write_site};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

const SIZE: [usize; 2] = [320, 240];

/// Run with `arguments`; expects `status` and every one of `words` on standard error.
fn refused(arguments: &[&Path], status: i32, words: &[&str]) {
    let output = run(beltgauge().args(arguments));
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {text}");
    for word in words {
        assert!(text.contains(word), "{arguments:?}: no {word:?} in:\n{text}");
    }
    assert!(!text.contains("panicked"), "{text}");
}

/// A site whose configuration has been edited.
fn site_with(name: &str, from: &str, to: &str) -> PathBuf {
    let config = write_site(&scratch(name), SIZE);
    let text = fs::read_to_string(&config).expect("written");
    assert!(text.contains(from));
    fs::write(&config, text.replace(from, to)).expect("writable");
    config
}

fn check_refused(name: &str, from: &str, to: &str, words: &[&str]) {
    let config = site_with(name, from, to);
    refused(&["check".as_ref(), "--config".as_ref(), &config], 2, words);
}

#[test]
fn a_good_configuration_passes_and_prints_the_plan() {
    let config = write_site(&scratch("good"), SIZE);
    let output = run(beltgauge().arg("check").arg("--config").arg(config));
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0));
    for word in ["rectify.map", "background.mean", "capture.frames", "limits.tracks_max", "total"] {
        assert!(text.contains(word), "no {word} in:\n{text}");
    }
}

#[test]
fn an_unknown_key_is_named_with_its_line() {
    check_refused(
        "unknown",
        "x_min_mm",
        "x_minimum_mm",
        &["x_minimum_mm", "line 4", "beltgauge.toml"],
    );
    check_refused("unknown_table", "[belt]", "[belts]", &["belts", "line"]);
}

#[test]
fn a_missing_key_is_named() {
    check_refused("missing", "speed_mm_per_s = 500", "", &["speed_mm_per_s"]);
}

#[test]
fn a_wrong_unit_is_recognised() {
    check_refused("text", "x_max_mm = 300", "x_max_mm = \"300 mm\"", &["x_max_mm", "line 5"]);
    check_refused("m_per_s", "= 500", "= 0.5", &["belt.speed_mm_per_s = 0.5", "10 to 10000", "mm"]);
    let metres = "x_min_mm = -0.3\nx_max_mm = 0.3";
    check_refused("metres", "x_min_mm = -300\nx_max_mm = 300", metres, &["0.6", "50 to", "metres"]);
    check_refused("nan", "= 500", "= nan", &["belt.speed_mm_per_s"]);
}

#[test]
fn what_a_plc_has_to_write_needs_one_that_may() {
    for (name, table, key) in [
        ("writes_queue", "[plc]\nqueue = true", "plc.queue"),
        ("writes_heartbeat", "[plc]\nheartbeat_timeout_s = 2.0", "plc.heartbeat_timeout_s"),
        ("writes_counts", "[encoder]\nmm_per_count = 0.05", "encoder.mm_per_count"),
    ] {
        let words = [key, "nobody may", "modbus.write_allow", "can.interface", "remedy"];
        check_refused(name, "[belt]", &format!("{table}\n[belt]"), &words);
        for who in ["[modbus]\nwrite_allow = [\"192.168.1.10\"]", "[can]\ninterface = \"can0\""] {
            let config = site_with(name, "[belt]", &format!("{table}\n{who}\n[belt]"));
            let output = run(beltgauge().arg("check").arg("--config").arg(config));
            assert_eq!(output.status.code(), Some(0), "{who}: {output:?}");
        }
    }
}

#[test]
fn a_zone_outside_the_view_names_the_corner_and_what_is_seen() {
    let words = ["zone", "900", "outside the camera's view", "320 x 240", "reach x", "remedy"];
    check_refused("outside", "x_max_mm = 300", "x_max_mm = 900", &words);
}

#[test]
fn a_zone_turned_inside_out_is_refused() {
    check_refused(
        "inverted",
        "x_max_mm = 300",
        "x_max_mm = -400",
        &["zone.x_max_mm - zone.x_min_mm = -100"],
    );
}

#[test]
fn a_memory_limit_that_is_too_small_names_the_largest_buffer() {
    let limits = "[limits]\nmemory_mib_max = 1\n[belt]";
    let config = site_with("memory", "[belt]", limits);
    refused(&["check".as_ref(), "--config".as_ref(), &config], 2, &["memory_mib_max = 1"]);
    let y4m = config.with_file_name("one.y4m");
    write_y4m(&y4m, 1);
    refused(
        &["measure".as_ref(), &y4m, "--config".as_ref(), &config],
        2,
        &["memory_mib_max = 1", "largest buffer"],
    );
}

#[test]
fn a_rotation_that_is_none_is_refused() {
    for (name, rows) in [
        ("scaled", "[[2, 0, 0], [0, -2, 0], [0, 0, -2]]"),
        ("mirrored", "[[1, 0, 0], [0, 1, 0], [0, 0, -1]]"),
        ("sheared", "[[1, 0.1, 0], [0, -1, 0], [0, 0, -1]]"),
        ("nan", "[[nan, 0, 0], [0, -1, 0], [0, 0, -1]]"),
    ] {
        let folder = scratch(&format!("rotation_{name}"));
        let config = write_site(&folder, SIZE);
        let camera = folder.join("camera.toml");
        let text = fs::read_to_string(&camera).expect("written");
        fs::write(&camera, text.replace("[[1, 0, 0], [0, -1, 0], [0, 0, -1]]", rows))
            .expect("writable");
        let words = ["pose.rotation is not a rotation", "determinant", "camera.toml", "remedy"];
        refused(&["check".as_ref(), "--config".as_ref(), &config], 2, &words);
    }
}

#[test]
fn a_camera_below_the_belt_is_refused() {
    let folder = scratch("below");
    let config = write_site(&folder, SIZE);
    let camera = folder.join("camera.toml");
    let text = fs::read_to_string(&camera).expect("written");
    fs::write(&camera, text.replace("[0, 0, 1500]", "[0, 0, -1500]")).expect("writable");
    refused(
        &["check".as_ref(), "--config".as_ref(), &config],
        2,
        &["-1500.0 mm above the belt", "sign"],
    );
}

#[test]
fn an_absurd_lens_is_refused_or_survived() {
    for distortion in
        ["[0, 0, 0, 1.2346, 0]", "[0, 0, 1.5, 0, 0]", "[0, 0, -1.2, 1.2, 0]", "[9, -9, 0, 0, 9]"]
    {
        let folder = scratch("absurd_lens");
        let config = write_site(&folder, SIZE);
        let camera = folder.join("camera.toml");
        let text = fs::read_to_string(&camera).expect("written");
        fs::write(&camera, text.replace("[0, 0, 0, 0, 0]", distortion)).expect("writable");
        let input = folder.join("input.y4m");
        write_y4m(&input, 25); // the belt is learned in 15
        let output = run(beltgauge().arg("measure").arg(&input).arg("--config").arg(&config));
        let text = String::from_utf8_lossy(&output.stderr);
        assert!([Some(0), Some(2)].contains(&output.status.code()), "{distortion}: {text}");
    }
}

#[test]
fn missing_files_are_named() {
    let folder = scratch("missing_files");
    let config = write_site(&folder, SIZE);
    refused(
        &["check".as_ref(), "--config".as_ref(), "nowhere.toml".as_ref()],
        2,
        &["nowhere.toml"],
    );
    refused(
        &["measure".as_ref(), "none.y4m".as_ref(), "--config".as_ref(), &config],
        2,
        &["none.y4m"],
    );
    fs::remove_file(folder.join("camera.toml")).expect("there");
    refused(
        &["check".as_ref(), "--config".as_ref(), &config],
        2,
        &["camera.toml", "camera.calibration"],
    );
}

/// `frames` grey frames as Y4M.
fn write_y4m(path: &Path, frames: usize) {
    let mut file = fs::File::create(path).expect("writable");
    writeln!(file, "YUV4MPEG2 W{} H{} F30:1 Ip Cmono", SIZE[0], SIZE[1]).expect("written");
    for _ in 0..frames {
        file.write_all(b"FRAME\n").expect("written");
        file.write_all(&vec![90; SIZE[0] * SIZE[1]]).expect("written");
    }
}

fn measure_y4m(name: &str, bytes: &[u8], status: i32, words: &[&str]) {
    let folder = scratch(name);
    let config = write_site(&folder, SIZE);
    let input = folder.join("input.y4m");
    fs::write(&input, bytes).expect("writable");
    refused(&["measure".as_ref(), &input, "--config".as_ref(), &config], status, words);
}

#[test]
fn a_stream_that_is_no_y4m_says_how_to_make_one() {
    measure_y4m("empty", b"", 2, &["empty", "ffmpeg"]);
    measure_y4m("not_y4m", b"RIFF....AVI ", 2, &["not a YUV4MPEG2", "ffmpeg"]);
    measure_y4m("no_width", b"YUV4MPEG2 H240 F30:1 Cmono\n", 2, &["width W"]);
    measure_y4m("deep", b"YUV4MPEG2 W320 H240 F30:1 Cmono16\n", 2, &["Cmono16", "8-bit mono"]);
    measure_y4m("slow", b"YUV4MPEG2 W320 H240 F1:1000000 Cmono\n", 2, &["frame rate F", "--fps"]);
    measure_y4m("zero_rate", b"YUV4MPEG2 W320 H240 F0:0 Cmono\n", 2, &["frame rate F"]);
    for field in ["t", "b", "m"] {
        let header = format!("YUV4MPEG2 W320 H240 F30:1 I{field} Cmono\n");
        measure_y4m("interlaced", header.as_bytes(), 2, &["interlaced", "-vf yadif"]);
    }
    measure_y4m("long", &[b'Y'; 5000], 2, &["header is too long"]);
    measure_y4m("huge", b"YUV4MPEG2 W99999999999999999999 H240 F30:1 Cmono\n", 2, &["width W"]);
}

#[test]
fn another_image_size_than_the_calibration_is_a_configuration_error() {
    measure_y4m(
        "size",
        b"YUV4MPEG2 W640 H480 F30:1 Cmono\n",
        2,
        &["640 x 480", "320 x 240", "image_size_px"],
    );
}

#[test]
fn a_truncated_y4m_names_the_frame() {
    let folder = scratch("truncated");
    let config = write_site(&folder, SIZE);
    let input = folder.join("input.y4m");
    write_y4m(&input, 3);
    let bytes = fs::read(&input).expect("written");
    let words = ["ends in the middle of a frame", "frame 2", "input.y4m"];
    for cut in [1, 1000, SIZE[0] * SIZE[1] - 1] {
        fs::write(&input, &bytes[..bytes.len() - cut]).expect("writable");
        refused(&["measure".as_ref(), &input, "--config".as_ref(), &config], 1, &words);
    }
}

#[test]
fn a_broken_frame_header_names_the_frame() {
    let folder = scratch("broken_header");
    let config = write_site(&folder, SIZE);
    let input = folder.join("input.y4m");
    write_y4m(&input, 3);
    let mut bytes = fs::read(&input).expect("written");
    let at = bytes.len() - SIZE[0] * SIZE[1] - 6;
    bytes[at..at + 5].copy_from_slice(b"XXXXX");
    fs::write(&input, bytes).expect("writable");
    refused(
        &["measure".as_ref(), &input, "--config".as_ref(), &config],
        1,
        &["expected a FRAME header", "frame 2"],
    );
}

/// A directory of three grey frames and the arguments to measure it.
fn directory(name: &str) -> (PathBuf, PathBuf) {
    let folder = scratch(name);
    let config = write_site(&folder, SIZE);
    let frames = folder.join("frames");
    fs::create_dir(&frames).expect("writable");
    for i in 0..3 {
        write_pgm(&frames.join(format!("{i}.pgm")), SIZE);
    }
    (frames, config)
}

fn write_pgm(path: &Path, [width, height]: [usize; 2]) {
    let mut bytes = format!("P5 {width} {height} 255\n").into_bytes();
    bytes.resize(bytes.len() + width * height, 90);
    fs::write(path, bytes).expect("writable");
}

#[test]
fn a_directory_needs_a_frame_rate_and_frames() {
    let (frames, config) = directory("no_fps");
    refused(&["measure".as_ref(), &frames, "--config".as_ref(), &config], 2, &["--fps"]);
    let fps = |value: &'static str| ["--fps".as_ref(), value.as_ref()] as [&Path; 2];
    let [flag, zero] = fps("0");
    refused(
        &["measure".as_ref(), &frames, "--config".as_ref(), &config, flag, zero],
        2,
        &["--fps 0"],
    );
    let empty = scratch("no_frames");
    let [flag, thirty] = fps("30");
    refused(
        &["measure".as_ref(), &empty, "--config".as_ref(), &config, flag, thirty],
        2,
        &["no frames"],
    );
}

#[test]
fn a_lens_that_cannot_be_is_refused() {
    for focal_px in ["8", "340"] {
        let what = format!(
            "budget --camera-height-mm 1500 --focal-px {focal_px} --image 1920x1200 \
             --zone-mm 1200x760 --speed-mm-per-s 500 --fps 40"
        );
        let arguments: Vec<&Path> = what.split_whitespace().map(Path::new).collect();
        refused(&arguments, 2, &[&format!("--focal-px {focal_px}"), "346 to", "remedy"]);
    }
}

#[test]
fn two_frames_of_one_number_are_refused() {
    let (folder, config) = directory("one_number");
    for name in ["7.pgm", "07.pgm"] {
        write_pgm(&folder.join(name), SIZE);
    }
    refused(
        &[
            "measure".as_ref(),
            &folder,
            "--fps".as_ref(),
            "30".as_ref(),
            "--config".as_ref(),
            &config,
        ],
        2,
        &["7.pgm", "07.pgm", "same number", "remedy"],
    );
}

#[test]
fn a_frame_of_another_size_in_the_middle_names_the_file() {
    let (frames, config) = directory("other_size");
    write_pgm(&frames.join("1.pgm"), [160, 120]);
    refused(
        &[
            "measure".as_ref(),
            &frames,
            "--config".as_ref(),
            &config,
            "--fps".as_ref(),
            "30".as_ref(),
        ],
        1,
        &["160 x 120", "1.pgm", "320 x 240"],
    );
}

#[test]
fn an_unreadable_image_names_the_file() {
    for (name, bytes) in
        [("cut.pgm", &b"P5 320 240 255\nxx"[..]), ("text.png", b"no image"), ("empty.jpg", b"")]
    {
        let (frames, config) = directory("unreadable");
        fs::write(frames.join(format!("1_{name}")), bytes).expect("writable");
        refused(
            &[
                "measure".as_ref(),
                &frames,
                "--config".as_ref(),
                &config,
                "--fps".as_ref(),
                "30".as_ref(),
            ],
            1,
            &["unreadable image", name, "remedy"],
        );
    }
}

#[test]
fn a_port_in_use_is_named_before_anything_runs() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = taken.local_addr().expect("bound").to_string();
    let out = scratch("port");
    refused(
        &[
            "demo".as_ref(),
            "--seconds".as_ref(),
            "1".as_ref(),
            "--out".as_ref(),
            &out,
            "--listen".as_ref(),
            address.as_ref(),
        ],
        1,
        &["cannot listen for Modbus clients", &address, "another port"],
    );
}

#[test]
fn a_wrong_command_line_is_a_usage_error() {
    for arguments in
        [&["measure"][..], &["weigh"], &["demo", "--seconds", "soon"], &["demo", "--seconds", "-1"]]
    {
        let output = run(beltgauge().args(arguments));
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
    }
}

#[test]
fn a_start_that_fails_leaves_earlier_records_alone() {
    let folder = scratch("earlier_records");
    let config = write_site(&folder, SIZE);
    let (input, records) = (folder.join("input.y4m"), folder.join("parcels.jsonl"));
    fs::write(&input, b"YUV4MPEG2 W640 H480 F30:1 Cmono\n").expect("writable");
    fs::write(&records, "earlier").expect("writable");
    refused(
        &["measure".as_ref(), &input, "--config".as_ref(), &config, "--jsonl".as_ref(), &records],
        2,
        &["640 x 480"],
    );
    assert_eq!(fs::read_to_string(&records).expect("there"), "earlier");
}

#[test]
fn outputs_over_inputs_are_refused_before_anything_is_written() {
    let folder = scratch("over_inputs");
    let config = write_site(&folder, SIZE);
    let (input, camera) = (folder.join("input.y4m"), folder.join("camera.toml"));
    write_y4m(&input, 1);
    let link = folder.join("link");
    std::os::unix::fs::symlink(&config, &link).expect("writable");
    let before = [&input, &config, &camera].map(|path| fs::read(path).expect("there"));
    for output in [&input, &config, &camera, &link] {
        refused(
            &["measure".as_ref(), &input, "--config".as_ref(), &config, "--jsonl".as_ref(), output],
            2,
            &["--jsonl", "is one of the inputs"],
        );
    }
    let budget = ["budget", "--fps", "40", "--config"].map(Path::new);
    for output in [&config, &camera] {
        let more = [&config, Path::new("--out"), output];
        refused(&[&budget[..], &more].concat(), 2, &["--out", "is one of the inputs"]);
    }
    // What standard input reads from, and a folder of frames.
    let stdin = fs::File::open(&input).expect("there");
    let output = run(beltgauge()
        .args(["measure", "-", "--config"])
        .arg(&config)
        .arg("--jsonl")
        .arg(&input)
        .stdin(stdin));
    assert_eq!(output.status.code(), Some(2));
    refused(
        &[
            "measure".as_ref(),
            &folder,
            "--config".as_ref(),
            &config,
            "--annotate".as_ref(),
            &folder,
        ],
        2,
        &["--annotate", "is one of the inputs"],
    );
    let after = [&input, &config, &camera].map(|path| fs::read(path).expect("there"));
    assert_eq!(after, before);
}

#[test]
fn a_reader_that_hangs_up_is_no_crash() {
    let config = write_site(&scratch("hang_up"), SIZE);
    let full = fs::OpenOptions::new().write(true).open("/dev/full").expect("Linux");
    let output = beltgauge().arg("check").arg("--config").arg(config).stdout(full).output();
    let output = output.expect("starts");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("standard output") && !text.contains("panicked"), "{text}");
}

#[test]
fn a_record_file_that_cannot_be_written_is_named() {
    let folder = scratch("no_jsonl");
    let config = write_site(&folder, SIZE);
    let input = folder.join("input.y4m");
    write_y4m(&input, 1);
    let nowhere = folder.join("nowhere/parcels.jsonl");
    refused(
        &["measure".as_ref(), &input, "--config".as_ref(), &config, "--jsonl".as_ref(), &nowhere],
        1,
        &["nowhere/parcels.jsonl"],
    );
}
