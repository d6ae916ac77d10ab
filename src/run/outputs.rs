//! Results must not destroy what they are made from.

use crate::error::{Error, Result};
use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Refuse an output that is one of the inputs, or a file of one that is a folder, by whatever name,
/// link or hard link. An input `-` is what standard input reads from.
///
/// # Errors
/// Names `option` and both paths.
pub fn refuse_inputs(option: &str, output: &Path, inputs: &[&Path]) -> Result<()> {
    let Ok(found) = std::fs::metadata(output) else { return Ok(()) };
    match inputs.iter().find(|input| is_or_holds(input, &found)) {
        None => Ok(()),
        Some(input) => Err(Error::configuration(format!(
            "{option} {} is one of the inputs: {}",
            output.display(),
            input.display()
        ))
        .allowed("a new file or folder, or one of earlier results")
        .remedy("give another name")),
    }
}

fn is_or_holds(input: &Path, output: &Metadata) -> bool {
    let input = if input == Path::new("-") { Path::new("/dev/stdin") } else { input };
    let Ok(found) = std::fs::metadata(input) else { return false };
    // A terminal is read from and written to.
    let is_kept = found.is_file() || found.is_dir();
    if is_kept && (found.dev(), found.ino()) == (output.dev(), output.ino()) {
        return true;
    }
    let inside: Vec<PathBuf> = match std::fs::read_dir(input) {
        Ok(entries) if output.is_file() => entries.flatten().map(|entry| entry.path()).collect(),
        _ => Vec::new(),
    };
    inside.iter().any(|file| {
        let found = std::fs::metadata(file);
        found.is_ok_and(|found| (found.dev(), found.ino()) == (output.dev(), output.ino()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn inputs_are_known_by_any_name() {
        let folder = std::env::temp_dir().join(format!("beltgauge-outputs-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        let frames = folder.join("frames");
        fs::create_dir_all(&frames).expect("room");
        let (input, frame, other) =
            (folder.join("input"), frames.join("1.png"), folder.join("other"));
        for file in [&input, &frame, &other] {
            fs::write(file, "").expect("room");
        }
        let (link, hard, around) =
            (folder.join("link"), folder.join("hard"), folder.join("frames/../input"));
        symlink(&input, &link).expect("room");
        fs::hard_link(&frame, &hard).expect("room");
        let inputs = [&*input, &*frames, Path::new("/dev/null"), Path::new("/no/where")];
        for (output, refused) in [
            (&input, true),
            (&link, true),
            (&around, true),
            (&frames, true),
            (&frame, true),
            (&hard, true),
            (&other, false),
            (&folder, false),
            (&folder.join("new"), false),
            (&PathBuf::from("/dev/null"), false),
        ] {
            let result = refuse_inputs("--out", output, &inputs);
            assert_eq!(result.is_err(), refused, "{}", output.display());
        }
    }
}
