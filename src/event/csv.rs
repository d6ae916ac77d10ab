//! Parcel records as CSV, as other programs read them.

use super::clock::utc;
use serde_json::Value;

/// The columns of a parcel's line, named as in its record.
const NAMES: [&str; 21] = [
    "seq",
    "length_mm",
    "width_mm",
    "height_mm",
    "sigma_length_mm",
    "sigma_width_mm",
    "sigma_height_mm",
    "yaw_deg",
    "x_mm",
    "y_mm",
    "shape",
    "may_be_used",
    "flags",
    "not_measured",
    "belt_speed_mm_per_s",
    "belt_travel_mm",
    "by_encoder",
    "frame",
    "t_s",
    "boots",
    "version",
];

/// The line above the others. `number`: what their first cell counts.
pub fn header(number: &str) -> String {
    format!("{number},utc,{}", NAMES.join(","))
}

/// A record, as JSON has it, as a line; what it lacks is empty.
pub fn line(number: u64, utc_ms: u64, record: &Value) -> String {
    let mut line = format!("{number},{}", utc(utc_ms));
    for name in NAMES {
        line.push(',');
        line.push_str(&cell(&record[name]));
    }
    line
}

/// Numbers and words as they are, lists with bars between. Whatever would end a cell is quoted; whatever
/// a spreadsheet would take for a formula is not one.
fn cell(value: &Value) -> String {
    let text = match value {
        Value::Null => return String::new(),
        Value::Number(number) => return number.to_string(),
        Value::Array(items) => {
            items.iter().map(|i| i.as_str().unwrap_or_default()).collect::<Vec<_>>().join("|")
        }
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let text =
        if text.starts_with(['=', '+', '-', '@', '\t', '\r']) { format!("'{text}") } else { text };
    if text.contains(['"', ',', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_a_cell_for_every_column_whatever_the_record_says() {
        let line = |text: &str| {
            line(3, 1_795_000_000_123, &serde_json::from_str(text).unwrap_or_default())
        };
        let whole =
            line(r#"{"seq":7,"length_mm":235.1,"flags":["merged","clipped"],"shape":"box"}"#);
        assert!(whole.starts_with("3,2026-11-18T"), "{whole}");
        assert!(whole.contains(",7,235.1,,") && whole.contains(",merged|clipped,"), "{whole}");
        let columns = header("entry").split(',').count();
        for text in ["", "null", "[1]", r#"{"seq":{"a":1}}"#] {
            assert_eq!(line(text).split(',').count(), columns, "{text}");
        }
        let hostile = line(r#"{"shape":"=cmd(\"x\"),1"}"#);
        assert!(hostile.contains(r#""'=cmd(""x""),1""#), "{hostile}");
    }
}
