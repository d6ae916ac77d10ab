//! Reports of calibration and budget: self-contained HTML pages with their pictures inside.

mod belt;
mod budget;
mod lens;

pub(super) use belt::{belt, points};
pub(super) use budget::budget;
pub(super) use lens::lens;

use crate::error::{Error, Result};
use crate::source::Still;
use base64::Engine;
use std::fmt::{Display, Write};
use std::path::Path;

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:1080px;margin:2em auto;\
    padding:0 1em;color:#1d2733}h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}\
    table{border-collapse:collapse}td,th{padding:.15em .9em .15em 0;text-align:left}\
    td.n{text-align:right;font-variant-numeric:tabular-nums}svg,img{max-width:100%;height:auto;\
    background:#f4f6f8}.warning{background:#fff3d6;border-left:4px solid #e0a100;\
    padding:.4em .8em;margin:.4em 0}.good{color:#1b7f4b}.bad{color:#c0392b}p.note{color:#5b6875}";

const BLUE: &str = "#2563eb";
const RED: &str = "#d13b2e";
const GREEN: &str = "#1b9e5a";
const GREY: &str = "#9aa7b4";

/// A page that grows section by section.
struct Page(String);

impl Page {
    fn new(title: &str) -> Self {
        let mut page = Self(format!(
            "<!doctype html><html lang=en><meta charset=utf-8><title>{0}</title>\
             <style>{STYLE}</style><body><h1>{0}</h1>",
            escaped(title)
        ));
        page.add("\n");
        page
    }

    fn add(&mut self, html: impl AsRef<str>) {
        self.0.push_str(html.as_ref());
    }

    fn section(&mut self, title: &str, note: &str) {
        self.add(format!("<h2>{}</h2><p class=note>{}</p>\n", escaped(title), escaped(note)));
    }

    fn warnings(&mut self, warnings: &[String]) {
        if warnings.is_empty() {
            self.add("<p class=good>No warnings.</p>");
        }
        for warning in warnings {
            self.add(format!("<div class=warning>{}</div>\n", escaped(warning)));
        }
    }

    /// A table of names and values.
    fn table(&mut self, rows: &[(&str, String)]) {
        self.add("<table>");
        for (name, value) in rows {
            self.add(format!("<tr><td>{}<td class=n>{}\n", escaped(name), escaped(value)));
        }
        self.add("</table>");
    }

    fn save(self, path: &Path) -> Result<()> {
        std::fs::write(path, self.0)
            .map_err(|e| Error::failure(format!("cannot write the report: {e}")).in_file(path))
    }
}

/// A drawing in the coordinates of an image.
struct Drawing {
    size_px: [usize; 2],
    body: String,
}

impl Drawing {
    fn new(size_px: [usize; 2]) -> Self {
        Self { size_px, body: String::new() }
    }

    /// Over a picture.
    fn over(still: &Still) -> Result<Self> {
        let [width, height] = still.size_px;
        let mut drawing = Self::new(still.size_px);
        let picture = jpeg_url(&still.pixels, still.size_px)?;
        drawing.put(format_args!(
            "<image href=\"{picture}\" x=\"-.5\" y=\"-.5\" width=\"{width}\" height=\"{height}\"/>"
        ));
        Ok(drawing)
    }

    fn put(&mut self, element: impl Display) {
        let _ = writeln!(self.body, "{element}"); // writing to a String cannot fail
    }

    /// Lines scale with the image: `width` is for one of 1000 px.
    fn stroke(&self, width: f64) -> f64 {
        width * self.size_px[0] as f64 / 1000.0
    }

    fn line(&mut self, from: [f64; 2], to: [f64; 2], colour: &str, width: f64) {
        let width = self.stroke(width);
        self.put(format_args!(
            "<line x1=\"{:.2}\" y1=\"{:.2}\" x2=\"{:.2}\" y2=\"{:.2}\" stroke=\"{colour}\" stroke-width=\"{width:.2}\"/>",
            from[0], from[1], to[0], to[1]
        ));
    }

    /// A line through points; it breaks where there is none.
    fn curve(&mut self, points: impl Iterator<Item = Option<[f64; 2]>>, colour: &str, width: f64) {
        let mut path = String::new();
        let mut pen_is_down = false;
        for point in points {
            if let Some([x, y]) = point {
                let command = if pen_is_down { 'L' } else { 'M' };
                let _ = write!(path, "{command}{x:.1} {y:.1}");
            }
            pen_is_down = point.is_some();
        }
        let width = self.stroke(width);
        self.put(format_args!(
            "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width:.2}\"/>"
        ));
    }

    fn dot(&mut self, at: [f64; 2], colour: &str, radius: f64) {
        let radius = self.stroke(radius);
        self.put(format_args!(
            "<circle cx=\"{:.2}\" cy=\"{:.2}\" r=\"{radius:.2}\" fill=\"{colour}\"/>",
            at[0], at[1]
        ));
    }

    fn text(&mut self, at: [f64; 2], text: &str, colour: &str, size: f64) {
        let size = self.stroke(size);
        self.put(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size:.1}\" fill=\"{colour}\" \
             paint-order=\"stroke\" stroke=\"#fff\" stroke-width=\"{:.1}\">{}</text>",
            at[0],
            at[1],
            size / 6.0,
            escaped(text)
        ));
    }

    fn html(self) -> String {
        let [width, height] = self.size_px;
        format!(
            "<svg viewBox=\"-.5 -.5 {width} {height}\" width=\"1000\" role=\"img\">{}</svg>",
            self.body
        )
    }
}

/// Seen minus expected, drawn this many times as long, so that the typical one can be seen.
fn arrow_scale(size_px: [usize; 2], rms_px: f64) -> f64 {
    let wanted_px = 0.015 * size_px[0] as f64;
    let exact = wanted_px / rms_px.max(1e-6);
    // one significant digit
    let magnitude = 10_f64.powf(exact.log10().floor());
    (exact / magnitude).round() * magnitude
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A grey picture as a data URL.
fn jpeg_url(pixels: &[u8], size_px: [usize; 2]) -> Result<String> {
    const QUALITY: u8 = 80;
    let [width, height] = size_px.map(|s| s as u32);
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
        .encode(pixels, width, height, image::ExtendedColorType::L8)
        .map_err(|e| Error::failure(format!("cannot encode a picture of the report: {e}")))?;
    Ok(format!("data:image/jpeg;base64,{}", base64::engine::general_purpose::STANDARD.encode(jpeg)))
}
