//! Whom the appliance trusts: the key that sets must be signed with, and the highest counter taken
//! with each key. Kept apart from the configuration, so that it outlives a damaged or missing one.

use super::manifest::Manifest;
use crate::config::public_key;
use crate::error::{Error, Result};
use minisign_verify::PublicKey;
use serde::{Deserialize, Serialize};

/// What is trusted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trust {
    /// The key in force, as minisign writes it; none: what is not signed is accepted.
    pub public_key: Option<String>,
    /// The last set that was taken with each key.
    #[serde(default)]
    taken: Vec<Taken>,
}

/// A set that was taken.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Taken {
    public_key: String,
    counter: u64,
    /// Of its manifest.
    sha256: String,
}

impl Trust {
    /// The key in force.
    pub fn key(&self) -> Result<Option<PublicKey>> {
        self.public_key.as_deref().map(public_key).transpose()
    }

    /// Note a set that is signed with the key in force. One that is older than the last is refused:
    /// who finds an old stick must not bring back an old weakness.
    pub fn take(&mut self, manifest: &Manifest, sha256: String) -> Result<()> {
        let Some(key) = self.public_key.clone() else { return Ok(()) };
        let counter = manifest.counter;
        let taken = Taken { public_key: key, counter, sha256 };
        let Some(last) = self.taken.iter_mut().find(|last| last.public_key == taken.public_key)
        else {
            self.taken.push(taken);
            return Ok(());
        };
        if counter > last.counter || taken == *last {
            *last = taken;
            return Ok(());
        }
        let what = if counter == last.counter {
            format!("another set with the counter {counter} was taken before")
        } else {
            format!(
                "the set's counter is {counter}, and one with {} was taken before",
                last.counter
            )
        };
        Err(Error::configuration(what).allowed(format!("counters above {}", last.counter)).remedy(
            "make the manifest with a higher counter and sign it; to go back to the configuration \
                 before: `beltgauge import --roll-back` on the appliance",
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_only_rise_for_each_key() {
        let mut trust = Trust { public_key: Some("a".into()), ..Trust::default() };
        let mut take = |key: &str, counter: u64, sha256: &str| {
            trust.public_key = Some(key.to_owned());
            let text = format!("counter = {counter}\nfile = []");
            let manifest = toml::from_str(&text).expect("a manifest");
            trust.take(&manifest, sha256.to_owned()).map_err(|e| e.to_string())
        };
        take("a", 5, "x").expect("the first");
        take("a", 5, "x").expect("the same again");
        let error = take("a", 5, "y").expect_err("another");
        assert!(error.contains("another set with the counter 5"), "{error}");
        let error = take("a", 4, "z").expect_err("older");
        assert!(error.contains("above 5") && error.contains("--roll-back"), "{error}");
        take("b", 1, "x").expect("another key counts for itself");
        take("a", 4, "z").expect_err("and the first is remembered");
        take("a", 7, "z").expect("newer");
    }

    #[test]
    fn its_file_reads_back() {
        let mut trust = Trust::default();
        let read = |trust: &Trust| -> Trust {
            toml::from_str(&toml::to_string(trust).expect("TOML")).expect("its own")
        };
        assert_eq!(read(&trust), trust);
        trust.public_key = Some("a".into());
        let taken = Taken { public_key: "a".into(), counter: 3, sha256: "x".into() };
        trust.taken.push(taken);
        assert_eq!(read(&trust), trust);
    }
}
