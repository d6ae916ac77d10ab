//! The house rules that a compiler does not check.

use std::fs;
use std::path::{Path, PathBuf};

/// A room and the rooms it may use. `run`, and `main` with its `cli`, may use all.
const MAY_USE: &[(&str, &[&str])] = &[
    ("units", &[]),
    ("error", &[]),
    ("image", &["units"]),
    ("event", &[]),
    ("belt", &["units"]),
    ("plan", &["error"]),
    ("camera", &["image", "units", "error"]),
    ("config", &["camera", "units", "error"]),
    ("kernel", &["image"]),
    ("stage", &["kernel", "camera", "config", "belt", "plan", "image", "units", "error"]),
    ("health", &["stage", "kernel", "camera", "config", "plan", "image", "units", "error"]),
    (
        "pipeline",
        &[
            "health", "stage", "kernel", "camera", "config", "belt", "plan", "image", "event",
            "units", "error",
        ],
    ),
    ("sandbox", &["error"]),
    ("source", &["camera", "config", "plan", "sandbox", "image", "units", "error"]),
    ("plc", &["config", "event", "error"]),
    ("store", &["camera", "config", "error"]),
    ("archive", &["error"]),
    ("web", &["config", "event", "error"]),
    ("fleet", &["config", "event", "store", "error"]),
];

/// The only places for `unsafe`.
const UNSAFE_ROOMS: &[&str] = &[
    "src/kernel/avx2",
    "src/kernel/neon",
    "src/source/v4l2",
    "src/source/aravis.rs",
    "src/plan.rs",
];

const LINES_MAX: usize = 600;

fn sources(folder: &str) -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    let mut folders = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("a folder of the project") {
            let path = entry.expect("readable").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                let text = fs::read_to_string(&path).expect("text");
                let root = Path::new(env!("CARGO_MANIFEST_DIR"));
                found.push((path.strip_prefix(root).expect("inside").to_owned(), text));
            }
        }
    }
    assert!(!found.is_empty());
    found
}

/// Source without its unit tests and comments.
fn code(text: &str) -> String {
    let product = text.split("#[cfg(test)]").next().unwrap_or_default();
    product.lines().map(|l| l.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// Rooms named as `crate::room` or `crate::{room, ...}`.
fn rooms_used(code: &str) -> Vec<String> {
    let mut rooms = Vec::new();
    for after in code.split("crate::").skip(1) {
        let list = match after.strip_prefix('{') {
            Some(rest) => rest.split('}').next().unwrap_or_default().to_owned(),
            None => after.to_owned(),
        };
        let parts: Vec<&str> =
            if after.starts_with('{') { list.split(',').collect() } else { vec![&list] };
        for part in parts {
            let name: String =
                part.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
            rooms.push(name);
        }
    }
    rooms
}

#[test]
fn dependencies_point_one_way() {
    let mut checked = 0;
    for (path, text) in sources("src") {
        let room = path.components().nth(1).expect("src/room").as_os_str().to_string_lossy();
        let room = room.trim_end_matches(".rs");
        if ["run", "main", "cli", "lib"].contains(&room) {
            continue;
        }
        let (_, allowed) = MAY_USE.iter().find(|(name, _)| *name == room).unwrap_or_else(|| {
            panic!("{room} is no room of the house: add it to MAY_USE and to lib.rs")
        });
        for used in rooms_used(&code(&text)) {
            checked += 1;
            assert!(
                used == room || allowed.contains(&used.as_str()),
                "{} uses {used}; {room} may use {allowed:?}",
                path.display()
            );
        }
    }
    assert!(checked > 50, "the check found only {checked} uses: it no longer reads the code");
}

#[test]
fn unsafe_is_only_where_it_may_be() {
    let mut rooms_with_unsafe = 0;
    for (path, text) in sources("src") {
        let has_unsafe =
            code(&text).split(|c: char| !c.is_alphanumeric() && c != '_').any(|w| w == "unsafe");
        let name = path.to_string_lossy();
        assert!(
            !has_unsafe || UNSAFE_ROOMS.iter().any(|r| name.starts_with(r)),
            "{name} has unsafe code"
        );
        rooms_with_unsafe += usize::from(has_unsafe);
    }
    assert!(rooms_with_unsafe > 0, "plan.rs has unsafe code: the check no longer sees it");
}

#[test]
fn every_expect_states_an_invariant() {
    for (path, text) in sources("src").into_iter().filter(|(path, _)| !path.ends_with("tests.rs")) {
        let product = text.split("#[cfg(test)]").next().unwrap_or_default();
        for (number, line) in product.lines().enumerate() {
            let panics = [".unwrap()", ".expect(", "panic!(", "todo!(", "unimplemented!("];
            assert!(
                !panics.iter().any(|p| line.contains(p)) || line.contains("// invariant"),
                "{}:{}: return an error, or say `// invariant` and why",
                path.display(),
                number + 1
            );
        }
    }
}

#[test]
fn files_fit_in_the_head() {
    for folder in ["src", "tests", "hil"] {
        for (path, text) in sources(folder) {
            let lines = text.lines().count();
            assert!(
                lines <= LINES_MAX,
                "{} has {lines} lines: what is it really two of?",
                path.display()
            );
        }
    }
}
