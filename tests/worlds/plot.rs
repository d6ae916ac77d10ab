//! The table of the worlds as a picture.

use super::judge::Verdict;
use std::fmt::Write as _;

const LEFT: f64 = 100.0;
const WIDTH: f64 = 620.0;
const BAR: f64 = 20.0;
const STEP: f64 = 30.0;
const TOP: f64 = 56.0;

/// What becomes of a parcel, and its colour.
const FATES: [(&str, &str); 4] = [
    ("right", "#1b9e5a"),
    ("told as doubtful", "#e0b93a"),
    ("wrong without a word", "#d13b2e"),
    ("not told", "#9aa7b4"),
];

/// A bar a class, of shares of its parcels; records of nothing as numbers at its end.
pub fn svg(bars: &[(&str, &Verdict)], worlds: usize) -> String {
    let height = TOP + STEP * bars.len() as f64 + 16.0;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 820 {height}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"820\" height=\"{height}\" \
         fill=\"white\"/>\n<text x=\"{LEFT}\" y=\"18\">Parcels of every class, worlds drawn: \
         {worlds} of each; at the right, records of nothing</text>\n"
    );
    for (k, (name, colour)) in FATES.iter().enumerate() {
        let x = LEFT + 155.0 * k as f64;
        let _ = writeln!(
            svg,
            "<rect x=\"{x}\" y=\"28\" width=\"12\" height=\"12\" fill=\"{colour}\"/>\
             <text x=\"{}\" y=\"38\">{name}</text>",
            x + 17.0
        );
    }
    for (row, (name, verdict)) in bars.iter().enumerate() {
        let y = TOP + STEP * row as f64;
        let base = y + 14.0;
        let _ = writeln!(svg, "<text x=\"8\" y=\"{base}\">{name}</text>");
        let mut x = LEFT;
        for (share, (_, colour)) in verdict.fates().into_iter().zip(FATES) {
            let width = WIDTH * share;
            let _ = writeln!(
                svg,
                "<rect x=\"{x:.1}\" y=\"{y}\" width=\"{width:.1}\" height=\"{BAR}\" fill=\"{colour}\"/>"
            );
            if share >= 0.06 {
                let _ = writeln!(
                    svg,
                    "<text x=\"{:.1}\" y=\"{base}\" fill=\"white\">{:.0} %</text>",
                    x + 5.0,
                    100.0 * share
                );
            }
            x += width;
        }
        let _ = writeln!(
            svg,
            "<text x=\"{}\" y=\"{base}\">{} false</text>",
            LEFT + WIDTH + 10.0,
            verdict.false_records
        );
    }
    svg + "</svg>\n"
}
