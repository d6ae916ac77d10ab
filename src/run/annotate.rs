//! Annotated pictures: the fitted cuboid as a wire frame over the frame where it holds.

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::pipeline::Pipeline;
use embedded_graphics::mono_font::{MonoTextStyleBuilder, ascii::FONT_9X18_BOLD};
use embedded_graphics::pixelcolor::Rgb888;
use embedded_graphics::prelude::*;
use embedded_graphics::primitives::{Line, PrimitiveStyle};
use embedded_graphics::text::Text;
use nalgebra::Vector3;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

const TOP: Rgb888 = Rgb888::new(80, 255, 120);
const BASE: Rgb888 = Rgb888::new(255, 170, 40);
const SIDE: Rgb888 = Rgb888::new(90, 190, 255);
/// Raw belts are dark; pictures are for people.
const BRIGHTEN_PERCENTILE: usize = 99;

/// Captions stay this far inside of the picture.
const CAPTION_MARGIN_PX: i32 = 4;

/// Keeps, for each parcel in view, the frame where its record will hold, and draws it.
pub struct Annotator {
    folder: PathBuf,
    size_px: [usize; 2],
    /// By frame: the raw image. Frames that no parcel refers to are dropped.
    kept: HashMap<u64, Vec<u8>>,
    pictures: u64,
    /// Pictures that could not be written, and why the first could not.
    missing: u64,
    first_error: Option<Error>,
}

impl Annotator {
    /// Pictures go to `folder`, which is created.
    pub fn new(folder: &Path, size_px: [usize; 2]) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|e| {
            Error::failure(format!("cannot create the picture folder: {e}")).in_file(folder)
        })?;
        let (kept, first_error) = Default::default();
        let folder = folder.to_owned();
        Ok(Self { folder, size_px, kept, pictures: 0, missing: 0, first_error })
    }

    /// Draw the records that a frame emitted, then keep it if parcels refer to it. A picture that
    /// cannot be written is counted: it is no reason to stop measuring.
    pub fn frame(&mut self, raw: &[u8], index: u64, pipeline: &Pipeline, records: &[ParcelRecord]) {
        for record in records {
            let frame = self.kept.get(&record.frame).map_or(raw, Vec::as_slice);
            let drawn = draw(frame, self.size_px, record, &pipeline.site().camera, &self.folder);
            self.pictures += 1;
            if let Err(e) = drawn {
                self.missing += 1;
                self.first_error.get_or_insert(e);
            }
        }
        self.kept.retain(|&kept, _| pipeline.reference_frames().any(|f| f == kept));
        if pipeline.reference_frames().any(|f| f == index) {
            self.kept.insert(index, raw.to_vec());
        }
    }

    /// Whether every picture was written.
    ///
    /// # Errors
    /// Says how many were not, and why the first was not.
    pub fn finish(self) -> Result<()> {
        let (pictures, missing) = (self.pictures, self.missing);
        self.first_error.map_or(Ok(()), |first| {
            Err(Error::failure(format!("{missing} of {pictures} pictures are missing: {first}"))
                .remedy("the records are complete; make room and run again for the pictures"))
        })
    }
}

/// Draw a record over the frame where it holds, as `folder/parcel_NNNN.png`.
pub fn draw(
    raw: &[u8],
    [width, height]: [usize; 2],
    record: &ParcelRecord,
    camera: &Camera,
    folder: &Path,
) -> Result<()> {
    let mut canvas = Canvas::new(raw, width, height);
    let (sin, cos) = record.yaw_deg.to_radians().sin_cos();
    let corner = |a: f64, b: f64, z: f64| {
        let (l, w) = (0.5 * a * record.length_mm, 0.5 * b * record.width_mm);
        let at = Vector3::new(record.x_mm + cos * l - sin * w, record.y_mm + sin * l + cos * w, z);
        camera.project(at).map(|px| Point::new(px.x.round() as i32, px.y.round() as i32))
    };
    let ring = [(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)];
    let [base, top] = [0.0, record.height_mm].map(|z| ring.map(|(a, b)| corner(a, b, z)));
    for k in 0..4 {
        canvas.line(base[k], base[(k + 1) % 4], BASE);
        canvas.line(base[k], top[k], SIDE);
        canvas.line(top[k], top[(k + 1) % 4], TOP);
    }
    let text = match record.not_measured {
        Some(reason) => format!("#{}\nnot measured:\n{reason}", record.seq),
        None => format!(
            "#{} {:?}\nL {:.1} +- {:.1} mm\nW {:.1} +- {:.1} mm\nH {:.1} +- {:.1} mm\n{}",
            record.seq,
            record.shape,
            record.length_mm,
            record.sigma_length_mm,
            record.width_mm,
            record.sigma_width_mm,
            record.height_mm,
            record.sigma_height_mm,
            record.flags.to_string().replace(", ", "\n")
        ),
    };
    let seen = || base.iter().chain(&top).flatten();
    let right = seen().map(|p| p.x).max().unwrap_or(0) + 10;
    let above = seen().map(|p| p.y).min().unwrap_or(0);
    canvas.text(&text, Point::new(right, above));
    let path = folder.join(format!("parcel_{:04}.png", record.seq));
    image::save_buffer(&path, &canvas.rgb, width as u32, height as u32, image::ColorType::Rgb8)
        .map_err(|e| {
            // Half a picture is none.
            let _ = std::fs::remove_file(&path);
            Error::failure(format!("cannot write the picture: {e}")).in_file(&path)
        })
}

/// An RGB picture to draw on.
struct Canvas {
    rgb: Vec<u8>,
    width: usize,
    height: usize,
}

impl Canvas {
    /// The frame, stretched so that its bright parts are bright.
    fn new(raw: &[u8], width: usize, height: usize) -> Self {
        let mut histogram = [0usize; 256];
        for &g in raw {
            histogram[usize::from(g)] += 1;
        }
        let mut below = 0;
        let white = histogram
            .iter()
            .position(|&n| {
                below += n;
                below * 100 >= raw.len() * BRIGHTEN_PERCENTILE
            })
            .unwrap_or(255)
            .max(32);
        let stretched = |g: u8| (usize::from(g) * 230 / white).min(255) as u8;
        Self { rgb: raw.iter().flat_map(|&g| [stretched(g); 3]).collect(), width, height }
    }

    fn line(&mut self, from: Option<Point>, to: Option<Point>, colour: Rgb888) {
        if let (Some(from), Some(to)) = (from, to) {
            let Ok(()) =
                Line::new(from, to).into_styled(PrimitiveStyle::with_stroke(colour, 2)).draw(self);
        }
    }

    /// At a place, or as near to it as all of it is in the picture.
    fn text(&mut self, text: &str, at: Point) {
        let style = MonoTextStyleBuilder::new()
            .font(&FONT_9X18_BOLD)
            .text_color(Rgb888::YELLOW)
            .background_color(Rgb888::BLACK)
            .build();
        let text = Text::new(text, at, style);
        let caption = text.bounding_box();
        let shift = |from: i32, length: u32, side: usize| {
            let last = side as i32 - length as i32 - CAPTION_MARGIN_PX;
            from.min(last).max(CAPTION_MARGIN_PX) - from
        };
        let by = Point::new(
            shift(caption.top_left.x, caption.size.width, self.width),
            shift(caption.top_left.y, caption.size.height, self.height),
        );
        let Ok(_) = text.translate(by).draw(self);
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.width as u32, self.height as u32)
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = std::convert::Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(
        &mut self,
        pixels: I,
    ) -> std::result::Result<(), Self::Error> {
        for Pixel(at, colour) in pixels {
            let (Ok(x), Ok(y)) = (usize::try_from(at.x), usize::try_from(at.y)) else { continue };
            if x < self.width && y < self.height {
                let start = 3 * (y * self.width + x);
                self.rgb[start..start + 3].copy_from_slice(&[colour.r(), colour.g(), colour.b()]);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caption_is_all_in_the_picture_wherever_its_parcel_is() {
        let [width, height] = [400, 150];
        let yellow = |at: Point| {
            let mut canvas = Canvas::new(&vec![0; width * height], width, height);
            canvas.text("#12 Irregular\nfootprint_uncertain\nheight_uncertain", at);
            canvas.rgb.chunks(3).filter(|px| px[0] == 255 && px[1] == 255).count()
        };
        let whole = yellow(Point::new(100, 60));
        assert!(whole > 500, "{whole}");
        for at in [[395, 60], [100, 149], [-50, 60], [100, -40], [399, 149], [5000, -9000]] {
            assert_eq!(yellow(Point::new(at[0], at[1])), whole, "{at:?}");
        }
    }
}
