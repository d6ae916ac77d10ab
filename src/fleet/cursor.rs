//! How far the broker has acknowledged, and whose numbers these are: two files beside the archive.

use crate::error::{Error, Result};
use crate::store::files;
use serde::{Deserialize, Serialize};
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

const CURSOR: &str = "fleet.cursor";
const SERIAL: &str = "fleet.serial";
/// Of either file.
const BYTES_MAX: u64 = 1024;
/// Among ten thousand machines two have the same one with a chance of 3 in 10^12.
const SERIAL_BYTES: usize = 8;

/// The last entry of the archive that the broker has acknowledged, and all before it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cursor {
    /// Its number; 0: none yet.
    pub entry: u64,
    /// Its time, which tells an entry from that of another archive.
    pub utc_ms: u64,
}

/// Where they are kept.
#[derive(Clone, Debug)]
pub struct Kept {
    folder: PathBuf,
}

impl Kept {
    /// In the archive's folder: what the cursor points into goes with it.
    pub fn new(archive: &Path) -> Self {
        Self { folder: archive.to_owned() }
    }

    /// The cursor; at the beginning, if there is none or it is damaged: then all is told again.
    pub fn cursor(&self) -> Cursor {
        let path = self.folder.join(CURSOR);
        match files::read(&path, BYTES_MAX) {
            Err(e) if e.kind() == ErrorKind::NotFound => Cursor::default(),
            read => read
                .and_then(|bytes| serde_json::from_slice(&bytes).map_err(Into::into))
                .unwrap_or_else(|error| {
                    tracing::error!(path = %path.display(), %error, "the fleet's cursor cannot be read: \
                        all that is in the archive is told again");
                    Cursor::default()
                }),
        }
    }

    /// Keep the cursor: after a power cut it is this one or the one before.
    pub fn keep(&self, cursor: Cursor) -> std::io::Result<()> {
        files::replace(&self.folder.join(CURSOR), &serde_json::to_vec(&cursor)?)
    }

    /// Whose numbers the archive's parcels have: made once, at random.
    pub fn serial(&self) -> Result<String> {
        let path = self.folder.join(SERIAL);
        let failed = |e: std::io::Error| {
            Error::failure(format!("the fleet's serial number cannot be kept: {e}")).in_file(&path)
        };
        match files::read(&path, BYTES_MAX) {
            Ok(bytes) => {
                let text = String::from_utf8_lossy(&bytes).trim().to_owned();
                let digits = text.len() == 2 * SERIAL_BYTES;
                if digits && text.bytes().all(|b| b.is_ascii_hexdigit()) {
                    return Ok(text);
                }
                Err(Error::failure(format!("the fleet's serial number is damaged: {text:?}"))
                    .in_file(&path)
                    .allowed(format!("{} hexadecimal digits", 2 * SERIAL_BYTES))
                    .remedy("write it again as the parcels' ids have it, or remove the file: then a new one is made"))
            }
            Err(e) if e.kind() == ErrorKind::NotFound => {
                let mut bytes = [0; SERIAL_BYTES];
                let random = std::fs::File::open("/dev/urandom");
                random.and_then(|mut file| file.read_exact(&mut bytes)).map_err(failed)?;
                let serial = format!("{:016x}", u64::from_le_bytes(bytes));
                std::fs::create_dir_all(&self.folder).map_err(failed)?;
                files::replace(&path, format!("{serial}\n").as_bytes()).map_err(failed)?;
                Ok(serial)
            }
            Err(e) => Err(failed(e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_serial_is_made_once_and_a_damaged_cursor_is_at_the_beginning() {
        let folder = std::env::temp_dir().join(format!("beltgauge-fleet-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        let kept = Kept::new(&folder);
        assert_eq!(kept.cursor(), Cursor::default());
        let serial = kept.serial().expect("room");
        assert_eq!((serial.len(), kept.serial().expect("there")), (16, serial.clone()));
        let cursor = Cursor { entry: 77, utc_ms: 1_795_000_000_000 };
        kept.keep(cursor).expect("room");
        assert_eq!(Kept::new(&folder).cursor(), cursor);
        for damaged in ["", "{\"entry\":", "{\"entry\":-1,\"utc_ms\":2}"] {
            std::fs::write(folder.join(CURSOR), damaged).expect("room");
            assert_eq!(kept.cursor(), Cursor::default(), "{damaged}");
        }
        std::fs::write(folder.join(SERIAL), "../../x").expect("room");
        assert!(kept.serial().expect_err("damaged").to_string().contains("hexadecimal"));
        std::fs::remove_dir_all(folder).expect("ours");
    }
}
