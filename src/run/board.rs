//! `beltgauge board`: a chessboard to print, in true size, as SVG or PDF.

use crate::error::{Error, Result};
use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str};
use std::fmt::Write as _;
use std::ops::RangeInclusive;
use std::path::Path;

/// Squares along a side: what `calibrate` accepts, in squares.
pub const SQUARES: RangeInclusive<usize> = 4..=61;
/// Side of a square.
pub const SQUARE_MM: RangeInclusive<f64> = 1.0..=500.0;

/// Sheets, longer side first.
const SHEETS_MM: [(&str, [f64; 2]); 5] = [
    ("A4", [297.0, 210.0]),
    ("A3", [420.0, 297.0]),
    ("A2", [594.0, 420.0]),
    ("A1", [841.0, 594.0]),
    ("A0", [1189.0, 841.0]),
];
/// What printers leave free.
const MARGIN_MM: f64 = 8.0;
/// Beside and below the squares, for the lines that are measured and for text.
const STRIP_MM: f64 = 16.0;
/// The line that is measured after printing, one along each side of the sheet.
const LINE_MM: f64 = 100.0;
/// More than a pixel of any screen: drawn without smoothing, a thinner one may fall between two rows.
const LINE_WIDTH_MM: f64 = 0.4;
const TEXT_MM: f64 = 3.5;
const PT_PER_MM: f64 = 72.0 / 25.4;

/// A board on a sheet. Places are from the sheet's top left, y down, as x, y, width, height.
#[derive(Clone, Debug)]
pub struct BoardSheet {
    /// Width and height.
    pub size_mm: [f64; 2],
    /// The dark squares.
    pub squares_mm: Vec<[f64; 4]>,
    /// The two lines of 100 mm, as thin rectangles.
    pub lines_mm: [[f64; 4]; 2],
    /// Lines of text below the squares.
    pub text: [String; 2],
}

/// Lay out a board on the smallest sheet of the A series that holds it, or on one of its own size.
///
/// # Errors
/// Counts or size of the squares out of range.
pub fn sheet(squares: [usize; 2], square_mm: f64) -> Result<BoardSheet> {
    let [columns, rows] = [squares[0].max(squares[1]), squares[0].min(squares[1])];
    if !(SQUARES.contains(&columns) && SQUARES.contains(&rows)) {
        return Err(Error::configuration(format!("--squares {}x{}", squares[0], squares[1]))
            .allowed(format!("{} to {} along both sides", SQUARES.start(), SQUARES.end()))
            .remedy("10x7 squares have the 9x6 inner corners that calibrate's --board counts"));
    }
    if !SQUARE_MM.contains(&square_mm) {
        return Err(Error::configuration(format!("--square-mm {square_mm}")).allowed(format!(
            "{} to {} mm",
            SQUARE_MM.start(),
            SQUARE_MM.end()
        )));
    }
    let board_mm = [columns as f64 * square_mm, rows as f64 * square_mm];
    let needed_mm = board_mm.map(|side| side.max(LINE_MM) + STRIP_MM + 2.0 * MARGIN_MM);
    let fits = |size: &[f64; 2]| size[0] >= needed_mm[0] && size[1] >= needed_mm[1];
    let (name, size_mm) = SHEETS_MM
        .iter()
        .find(|(_, size)| fits(size))
        .map_or((None, needed_mm), |(name, size)| (Some(*name), *size));
    let [left, top] = [0, 1].map(|k| 0.5 * (size_mm[k] - board_mm[k] - STRIP_MM));
    let dark = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
    let squares_mm = dark
        .filter(|(column, row)| (column + row).is_multiple_of(2))
        .map(|(column, row)| {
            let (x, y) = (left + column as f64 * square_mm, top + row as f64 * square_mm);
            [x, y, square_mm, square_mm]
        })
        .collect();
    let [right, below] = [left + board_mm[0], top + board_mm[1]];
    let lines_mm = [
        [left, below + 0.25 * STRIP_MM, LINE_MM, LINE_WIDTH_MM],
        [right + 0.5 * STRIP_MM, top, LINE_WIDTH_MM, LINE_MM],
    ];
    let [width, height] = size_mm;
    let name = name.map_or_else(|| "a sheet of".to_owned(), |name| format!("{name},"));
    let text = [
        format!(
            "{columns} x {rows} squares of {square_mm} mm: --board {}x{} --square-mm {square_mm}",
            columns - 1,
            rows - 1
        ),
        format!(
            "On {name} {width} x {height} mm. Print at 100 %, not fitted to the page; both lines must \
             measure {LINE_MM} mm."
        ),
    ];
    Ok(BoardSheet { size_mm, squares_mm, lines_mm, text })
}

impl BoardSheet {
    /// Write it, as SVG or PDF by the file's extension.
    ///
    /// # Errors
    /// Another extension, or a file that cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        let bytes = match extension.to_ascii_lowercase().as_str() {
            "svg" => self.svg().into_bytes(),
            "pdf" => self.pdf(),
            _ => {
                return Err(Error::configuration(format!("--out {}", path.display()))
                    .allowed("a name that ends in .svg or .pdf"));
            }
        };
        std::fs::write(path, bytes)
            .map_err(|e| Error::failure(format!("cannot write the board: {e}")).in_file(path))
    }

    /// Squares and lines. Edges are smoothed where they fall between pixels: true size, not whole pixels.
    fn rectangles(&self) -> impl Iterator<Item = &[f64; 4]> {
        self.squares_mm.iter().chain(&self.lines_mm)
    }

    /// Where a line of text begins: its base line.
    fn text_at(&self, line: usize) -> [f64; 2] {
        let [x, y, ..] = self.lines_mm[0];
        [x, y + (1.4 + 1.3 * line as f64) * TEXT_MM]
    }

    fn svg(&self) -> String {
        let [width, height] = self.size_mm;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" \
             viewBox=\"0 0 {width} {height}\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
        );
        for [x, y, width, height] in self.rectangles() {
            let _ =
                writeln!(svg, "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"/>");
        }
        for (line, text) in self.text.iter().enumerate() {
            let [x, y] = self.text_at(line);
            let _ = writeln!(
                svg,
                "<text x=\"{x}\" y=\"{y}\" font-family=\"Helvetica, Arial, sans-serif\" \
                 font-size=\"{TEXT_MM}\">{text}</text>"
            );
        }
        svg + "</svg>\n"
    }

    fn pdf(&self) -> Vec<u8> {
        let [catalog, pages, page, font, drawing] = [1, 2, 3, 4, 5].map(Ref::new);
        let pt = |mm: f64| (mm * PT_PER_MM) as f32;
        let [width, height] = self.size_mm;
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(pages).viewer_preferences().pair(
            // Viewers that heed it do not scale.
            Name(b"PrintScaling"),
            Name(b"None"),
        );
        pdf.pages(pages).kids([page]).count(1);
        let mut sheet = pdf.page(page);
        sheet.media_box(Rect::new(0.0, 0.0, pt(width), pt(height))).parent(pages).contents(drawing);
        sheet.resources().fonts().pair(Name(b"F1"), font);
        sheet.finish();
        pdf.type1_font(font).base_font(Name(b"Helvetica"));
        let mut content = Content::new();
        // From the bottom left, y up.
        for &[x, y, w, h] in self.rectangles() {
            content.rect(pt(x), pt(height - y - h), pt(w), pt(h));
        }
        content.fill_nonzero();
        for (line, text) in self.text.iter().enumerate() {
            let [x, y] = self.text_at(line);
            content.begin_text().set_font(Name(b"F1"), pt(TEXT_MM));
            content.next_line(pt(x), pt(height - y)).show(Str(text.as_bytes())).end_text();
        }
        pdf.stream(drawing, &content.finish());
        pdf.finish()
    }
}
