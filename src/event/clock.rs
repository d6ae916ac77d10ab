//! The wall clock, as people's records have it. Nothing is measured with it.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The machine's clock, ms since 1970.
pub fn utc_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

/// A time as RFC 3339 has it, in UTC.
pub fn utc(utc_ms: u64) -> String {
    // Up to the year 9999, as the format goes.
    let since_1970 = Duration::from_millis(utc_ms.min(253_402_300_799_999));
    humantime::format_rfc3339_millis(UNIX_EPOCH + since_1970).to_string()
}
