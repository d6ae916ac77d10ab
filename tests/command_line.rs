//! The command line as people try it: help, arguments, pipes that end early, what is generated from it.

mod common;

use common::{beltgauge, run, scratch, write_site};
use std::fs;
use std::path::Path;
use std::process::Output;

const COMMANDS: &[&[&str]] = &[
    &["run"],
    &["demo"],
    &["measure"],
    &["calibrate", "lens"],
    &["calibrate", "belt"],
    &["board"],
    &["budget"],
    &["check"],
    &["import"],
    &["manifest"],
    &["update"],
    &["completions"],
    &["manual"],
];

fn text(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (text(&output.stdout), text(&output.stderr))
}

#[test]
fn what_every_command_has_comes_last_in_its_help() {
    for command in COMMANDS {
        let output = run(beltgauge().args(*command).arg("--help"));
        let (help, _) = text(&output);
        assert!(output.status.success(), "{command:?}");
        let (own, global) = help.split_once("Of every command:").expect("the last heading");
        assert!(global.contains("--log") && global.contains("--user"), "{help}");
        assert!(!own.contains("--log") && !global.contains("--help"), "{help}");
        assert_eq!(
            global.matches("\n  -").count() + global.matches("\n      --").count(),
            2,
            "{help}"
        );
    }
}

#[test]
fn check_and_run_take_the_file_as_an_argument_too() {
    let folder = scratch("argument");
    let config = write_site(&folder, [320, 240]);
    for option in [&[][..], &["--config"]] {
        let output = run(beltgauge().arg("check").args(option).arg(&config));
        assert!(output.status.success() && text(&output).0.contains("is valid"), "{output:?}");
    }
    let both = run(beltgauge().arg("check").arg(&config).arg("--config").arg(&config));
    assert_eq!(both.status.code(), Some(2), "{both:?}");
    // A file that is read and wrong: it would run until it is told to end otherwise.
    fs::write(&config, "[belt]\n").expect("room");
    let output = run(beltgauge().arg("run").arg(&config));
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output).1.contains("missing field"), "{output:?}");
}

#[test]
fn a_video_is_refused_with_the_whole_pipe_that_measures_it() {
    let folder = scratch("video");
    let config = write_site(&folder, [320, 240]);
    for (name, quoted) in [("pass.mkv", "pass.mkv"), ("a pass.mkv", "a pass.mkv'")] {
        let video = folder.join(name);
        fs::write(&video, [0x1a, 0x45, 0xdf, 0xa3]).expect("room");
        let output = run(beltgauge().arg("measure").arg(&video).arg("--config").arg(&config));
        let (_, error) = text(&output);
        assert_eq!(output.status.code(), Some(2), "{error}");
        let pipe = format!(
            "{quoted} -pix_fmt gray -f yuv4mpegpipe -strict -1 - | beltgauge measure - --config FILE"
        );
        assert!(error.contains("ffmpeg -v error -i ") && error.contains(&pipe), "{error}");
    }
}

#[test]
fn who_has_read_enough_is_told_nothing() {
    let folder = scratch("early");
    let config = write_site(&folder, [320, 240]);
    let manual = ["completions", "bash"];
    for arguments in
        [&["check", config.to_str().expect("text")][..], &manual, &["check", "--schema"]]
    {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        drop(reader);
        let output = beltgauge().args(arguments).stdout(writer).output().expect("starts");
        assert!(output.status.success() && output.stderr.is_empty(), "{arguments:?}: {output:?}");
    }
}

#[test]
fn completions_and_manual_pages_know_every_command() {
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let (script, _) = text(&run(beltgauge().args(["completions", shell])));
        assert!(script.contains("calibrate") && script.contains("annotate"), "{shell}: {script}");
    }
    let folder = scratch("manual");
    assert!(run(beltgauge().arg("manual").arg(&folder)).status.success());
    for command in COMMANDS {
        let page = folder.join(format!("beltgauge-{}.1", command.join("-")));
        let page = fs::read_to_string(&page).unwrap_or_else(|e| panic!("{}: {e}", page.display()));
        assert!(page.contains(".SH SYNOPSIS"), "{page}");
    }
    assert!(!folder.join("beltgauge-sandbox.1").exists());
}

#[test]
fn the_schema_beside_the_reference_is_the_one_that_is_printed() {
    let (printed, _) = text(&run(beltgauge().args(["check", "--schema"])));
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/beltgauge.schema.json");
    if std::env::var_os("BLESS").is_some() {
        fs::write(&path, &printed).expect("writable");
    }
    let committed = fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == printed,
        "config/beltgauge.schema.json is out of date: BLESS=1 cargo test --test command_line"
    );
    let reference = path.with_file_name("reference.toml");
    let reference = fs::read_to_string(reference).expect("committed");
    assert!(reference.starts_with("#:schema ./beltgauge.schema.json\n"), "{reference}");
}
