//! The one command: tell parcels again.

use serde::Deserialize;

/// A command of more bytes is none.
const BYTES_MAX: usize = 256;

/// Numbers of the parcels that are to be told again, both included.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Replay {
    /// The first.
    pub from: u32,
    /// The last.
    pub to: u32,
}

/// What a message on `cmd/replay` asks for, or why it is refused.
pub fn parse(payload: &[u8]) -> Result<Replay, String> {
    const ALLOWED: &str = "{\"from\": FIRST, \"to\": LAST}, the numbers (seq) of parcels, from 1";
    if payload.len() > BYTES_MAX {
        let bytes = payload.len();
        return Err(format!("{bytes} bytes; at most {BYTES_MAX} are allowed: {ALLOWED}"));
    }
    let replay: Replay = serde_json::from_slice(payload)
        .map_err(|e| format!("not understood: {e}; allowed: {ALLOWED}"))?;
    if replay.from == 0 || replay.from > replay.to {
        return Err(format!("from {} to {} is empty; allowed: {ALLOWED}", replay.from, replay.to));
    }
    Ok(replay)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_range_of_numbers_is_a_command() {
        assert_eq!(parse(br#"{"from":3,"to":7}"#), Ok(Replay { from: 3, to: 7 }));
        assert_eq!(parse(br#" {"to":4294967295,"from":1} "#), Ok(Replay { from: 1, to: u32::MAX }));
        for (wrong, part) in [
            (&b""[..], "not understood"),
            (b"\xff\x00", "not understood"),
            (b"[3,7,8]", "not understood"),
            (br#"{"from":3}"#, "missing field"),
            (br#"{"from":3,"to":7,"what":"all"}"#, "unknown field"),
            (br#"{"from":-3,"to":7}"#, "not understood"),
            (br#"{"from":3,"to":4294967296}"#, "not understood"),
            (br#"{"from":0,"to":7}"#, "is empty"),
            (br#"{"from":8,"to":7}"#, "is empty"),
            (&[b' '; 257], "257 bytes"),
        ] {
            let why = parse(wrong).expect_err("refused");
            assert!(why.contains(part) && why.contains("allowed"), "{why}");
        }
    }
}
