//! What a stick brings as one set: a counter, and every file with its size and SHA-256. One signature
//! over it signs them all.
//!
//! ```text
//! counter = 12
//!
//! [[file]]
//! name = "beltgauge.toml"
//! bytes = 312
//! sha256 = "9f86d081..."
//! ```

use super::stick::{FILE_BYTES_MAX, Stick};
use crate::error::{Error, Result};
use minisign_verify::{PublicKey, Signature};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::ops::RangeInclusive;
use std::path::Path;

/// Name of the manifest.
pub const MANIFEST: &str = "manifest.toml";
/// Name of its signature, as minisign gives it.
pub const SIGNATURE: &str = "manifest.toml.minisig";
/// Counters that are allowed; a date with a number of the day is one, as 2026112601.
pub const COUNTER: RangeInclusive<u64> = 1..=1_000_000_000_000;

/// A set of files.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Of two sets the later one has the higher counter.
    pub counter: u64,
    file: Vec<Entry>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    /// In the folder of the stick; of a file in a folder inside: `lens/1.png`.
    name: String,
    bytes: u64,
    sha256: String,
}

impl Manifest {
    /// Parse a manifest whose signature is right.
    pub fn verified(text: &[u8], signature: &[u8], key: &PublicKey) -> Result<Self> {
        let refused = |why: String| {
            Error::configuration(format!("the signature is not right: {why}"))
                .allowed("sets signed with the secret key that belongs to the key in force")
                .remedy(format!("sign the manifest: minisign -S -m {MANIFEST}"))
        };
        let signature = Signature::decode(&String::from_utf8_lossy(signature))
            .map_err(|e| refused(e.to_string()))?;
        key.verify(text, &signature, false).map_err(|e| refused(e.to_string()))?;
        Self::parse(&String::from_utf8_lossy(text))
    }

    /// Parse and check.
    pub fn parse(text: &str) -> Result<Self> {
        let manifest: Self = toml::from_str(text).map_err(|e| {
            Error::configuration(format!("no manifest: {}", e.to_string().trim_end()))
                .remedy("make it with `beltgauge manifest`")
        })?;
        check_counter(manifest.counter)?;
        Ok(manifest)
    }

    /// List the files of a stick that an import or an update may read.
    pub fn of(stick: &Stick, counter: u64) -> Result<Self> {
        check_counter(counter)?;
        let mut file = Vec::new();
        for name in stick.set()? {
            let bytes = stick.read(&name, FILE_BYTES_MAX)?;
            file.push(Entry { name, bytes: bytes.len() as u64, sha256: sha256(&bytes) });
        }
        Ok(Self { counter, file })
    }

    /// As text.
    pub fn to_text(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// The names of its files and their sizes.
    pub fn files(&self) -> impl Iterator<Item = (&str, u64)> {
        self.file.iter().map(|entry| (entry.name.as_str(), entry.bytes))
    }

    /// Whether it lists a file.
    pub fn has(&self, name: &str) -> bool {
        self.files().any(|(listed, _)| listed == name)
    }

    /// Refuse contents that are not those of the file when the manifest was made.
    pub fn check(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let Some(entry) = self.file.iter().find(|entry| entry.name == name) else {
            return Err(another_file("the file is not in the signed manifest"));
        };
        if entry.bytes != bytes.len() as u64 || entry.sha256 != sha256(bytes) {
            return Err(another_file("the file is not the one in the signed manifest"));
        }
        Ok(())
    }
}

/// A file that does not belong to the set.
pub(super) fn another_file(what: &str) -> Error {
    Error::configuration(what)
        .allowed(format!("the files of {MANIFEST}, unchanged and complete"))
        .remedy("make the manifest again with a higher counter, and sign it")
}

fn check_counter(counter: u64) -> Result<()> {
    if COUNTER.contains(&counter) {
        return Ok(());
    }
    Err(Error::configuration(format!("counter = {counter}"))
        .allowed(format!("{} to {}", COUNTER.start(), COUNTER.end()))
        .remedy("count the sets that you sign, or give the date: 2026112601"))
}

/// SHA-256 in hexadecimal digits.
pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// List the files in the folder of a stick and write the manifest beside them, to be signed.
/// Returns what was listed.
pub fn make(root: &Path, counter: u64) -> Result<String> {
    let stick = Stick::open(root)?;
    stick.check_name()?;
    let manifest = Manifest::of(&stick, counter)?;
    let path = stick.path().join(MANIFEST);
    let mut said = String::new();
    for (name, bytes) in manifest.files() {
        let _ = writeln!(said, "{bytes:>10}  {name}");
    }
    super::files::replace(&path, manifest.to_text().as_bytes())
        .map_err(|e| Error::failure(format!("cannot write the manifest: {e}")).in_file(&path))?;
    let _ = write!(said, "now sign it: minisign -S -m {}", path.display());
    Ok(said)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digests_are_those_of_the_standard() {
        // FIPS 180-2, B.1.
        let digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256(b"abc"), digest);
    }

    #[test]
    fn files_are_held_to_the_list() {
        let entry = Entry { name: "lens/1.png".into(), bytes: 3, sha256: sha256(b"abc") };
        let manifest = Manifest { counter: 1, file: vec![entry] };
        manifest.check("lens/1.png", b"abc").expect("the same");
        for (name, bytes) in
            [("lens/1.png", &b"abd"[..]), ("lens/1.png", b""), ("1.png", b"abc"), ("", b"abc")]
        {
            manifest.check(name, bytes).expect_err(name);
        }
        let text = manifest.to_text();
        assert_eq!(toml::from_str::<Manifest>(&text).expect("its own").to_text(), text);
    }

    #[test]
    fn counters_have_a_range() {
        for (counter, fits) in [(0, false), (1, true), (1_000_000_000_001, false)] {
            assert_eq!(check_counter(counter).is_ok(), fits, "{counter}");
        }
    }
}
