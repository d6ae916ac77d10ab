//! The page of `beltgauge budget`: its table, and the expected sigma over the parcel's height.

use super::{BLUE, Drawing, GREEN, GREY, Page, RED, escaped};
use crate::error::Result;
use std::path::Path;

const SIZE_PX: [usize; 2] = [1000, 420];
/// Margins of the plot: left and bottom hold the numbers.
const LEFT_PX: f64 = 60.0;
const BOTTOM_PX: f64 = 380.0;
const TOP_PX: f64 = 20.0;
const RIGHT_PX: f64 = 980.0;

/// Heights, mm, and the expected standard deviations of length, width and height there.
pub type Curve = Vec<(f64, Option<[f64; 3]>)>;

/// Write the page.
pub fn budget(table: &str, curves: &[(&str, Curve)], out: &Path) -> Result<()> {
    let mut page = Page::new("Error budget");
    page.add(format!("<pre>{}</pre>", escaped(table)));
    for (name, curve) in curves {
        page.section(
            &format!("235 x 125 mm, {name}"),
            "Expected standard deviation, mm, over the height, mm: length blue, width green, height red.",
        );
        page.add(plot(curve));
    }
    page.save(out)
}

fn plot(curve: &Curve) -> String {
    let height_max_mm = curve.iter().map(|(h, _)| *h).fold(1.0, f64::max);
    let sigmas = curve.iter().filter_map(|(_, s)| *s).flatten();
    let sigma_max_mm = sigmas.fold(0.5, f64::max).ceil();
    let at = |height_mm: f64, sigma_mm: f64| {
        [
            LEFT_PX + (RIGHT_PX - LEFT_PX) * height_mm / height_max_mm,
            BOTTOM_PX - (BOTTOM_PX - TOP_PX) * sigma_mm / sigma_max_mm,
        ]
    };
    let mut drawing = Drawing::new(SIZE_PX);
    for i in 0..=4 {
        let share = f64::from(i) / 4.0;
        let (sigma_mm, height_mm) = (share * sigma_max_mm, share * height_max_mm);
        drawing.line(at(0.0, sigma_mm), at(height_max_mm, sigma_mm), GREY, 0.5);
        drawing.text([8.0, at(0.0, sigma_mm)[1] + 5.0], &format!("{sigma_mm:.2}"), GREY, 14.0);
        let [x, y] = at(height_mm, 0.0);
        drawing.text([x - 14.0, y + 24.0], &format!("{height_mm:.0}"), GREY, 14.0);
    }
    for (k, colour) in [BLUE, GREEN, RED].into_iter().enumerate() {
        let points = curve.iter().map(|(h, s)| s.map(|s| at(*h, s[k].min(sigma_max_mm))));
        drawing.curve(points, colour, 2.0);
    }
    drawing.html()
}
