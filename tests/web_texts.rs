//! The page's own files: its texts in both languages, and nothing from elsewhere.

use beltgauge::event::{Flags, NotMeasured};
use beltgauge::plc::codes::REASONS;
use beltgauge::plc::command::COMMANDS;
use beltgauge::web::NoPicture;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

fn page(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/web/page").join(name);
    std::fs::read_to_string(path).expect("committed")
}

const SCRIPTS: [&str; 11] = [
    "main.js",
    "common.js",
    "live.js",
    "overview.js",
    "parcels.js",
    "trend.js",
    "plc.js",
    "events.js",
    "setup.js",
    "site.js",
    "stills.js",
];

#[test]
fn the_page_makes_no_markup_from_words_and_fetches_nothing_from_elsewhere() {
    for name in SCRIPTS {
        let text = page(name);
        for word in
            ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "Function("]
        {
            assert!(!text.contains(word), "{name} has {word}");
        }
        let elsewhere = text.replace("http://www.w3.org/2000/svg", "");
        assert!(!elsewhere.contains("http:") && !elsewhere.contains("https:"), "{name}");
    }
    let html = page("index.html");
    for word in ["http:", "https:", "style=", "<style", "onclick", "javascript:", "<script>"] {
        assert!(!html.contains(word), "index.html has {word}");
    }
}

#[test]
fn every_word_is_there_in_both_languages() {
    let texts = |name: &str| -> BTreeMap<String, String> {
        serde_json::from_str(&page(name)).expect("texts")
    };
    let (english, german) = (texts("en.json"), texts("de.json"));
    assert!(english.keys().eq(german.keys()), "the same keys");
    let mut needed: BTreeSet<String> = BTreeSet::new();
    needed.extend(Flags::ALL.iter().map(|(_, name, _)| format!("flag.{name}")));
    needed.extend(NotMeasured::ALL.iter().map(|(_, name, _)| format!("not_measured.{name}")));
    needed.extend(COMMANDS.iter().map(|(code, ..)| format!("command.{code}")));
    for (code, ..) in REASONS {
        needed.extend([format!("reason.{code}"), format!("remedy.{code}")]);
    }
    for why in NoPicture::ALL {
        let name = serde_json::to_value(why).expect("a word");
        needed.insert(format!("no_picture.{}", name.as_str().expect("a word")));
    }
    for name in ["none", "lens", "belt"] {
        needed.insert(format!("setup.board.for_{name}"));
    }
    for name in ["columns", "rows", "square_mm", "thickness_mm", "good", "no_grid", "another_grid"]
        .into_iter()
        .chain(["markers", "corner_hidden", "moves", "known", "full", "ready"])
    {
        needed.insert(format!("setup.board.{name}"));
    }
    needed.extend((0..9).map(|part| format!("setup.part.{part}")));
    for kind in ["started", "stopped", "began", "ended", "camera_lost", "command", "import"]
        .into_iter()
        .chain(["signed_in", "site_check", "site_apply", "site_go_back"])
    {
        needed.insert(format!("event.{kind}"));
    }
    for name in ["check", "apply", "reset", "back", "calibrate", "backup", "sign_out"] {
        needed.insert(format!("site.{name}"));
    }
    for name in ["busy", "bringing", "would", "done", "refused", "no_site"] {
        needed.insert(format!("site.words.{name}"));
    }
    for name in SCRIPTS {
        let script = page(name);
        for (at, _) in script.match_indices("t(\"") {
            // Not the end of another function's name.
            if !script[..at].ends_with(|c: char| c.is_alphanumeric()) {
                needed.extend(script[at + 3..].split('"').next().map(str::to_owned));
            }
        }
    }
    assert!(needed.len() > 100, "only {} were found", needed.len());
    for key in &needed {
        assert!(english.contains_key(key), "{key} has no text");
    }
    // What is replaced in one language is replaced in the other.
    let places = |text: &str| -> BTreeSet<String> {
        text.split('{').skip(1).filter_map(|t| t.split('}').next()).map(str::to_owned).collect()
    };
    for (key, text) in &english {
        assert_eq!(places(text), places(&german[key]), "{key}");
        assert!(!text.is_empty() && !german[key].is_empty(), "{key}");
    }
}
