//! From the pixel formats of cameras to 8-bit mono.
//!
//! Rows of Bayer mosaics are smoothed by the binomial kernel (1 2 1) in both directions: whatever the
//! mosaic's phase, every pixel becomes (R + 2 G + B) / 4 of its own surroundings, without a shift.

use crate::error::{Error, Result};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// How a camera sends its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelFormat {
    /// One byte a pixel; also the first plane of NV12.
    Mono8,
    /// Two bytes a pixel, low byte first, so many bits of them used.
    Mono16 {
        /// 10, 12 or 16.
        bits: u32,
    },
    /// 10 bits a pixel without gaps, low bits first.
    Mono10p,
    /// 12 bits a pixel without gaps, low bits first.
    Mono12p,
    /// 12 bits a pixel, two pixels in three bytes: high, low and low, high.
    Mono12Packed,
    /// 10 bits a pixel, two pixels in three bytes: high, low and low, high.
    Mono10Packed,
    /// Luma first of every two bytes.
    Yuyv,
    /// Luma second of every two bytes.
    Uyvy,
    /// A mosaic of 2 x 2 colours, one byte a pixel.
    Bayer8,
    /// A JPEG picture a frame.
    Jpeg,
}

/// Names of formats: ours, that of V4L2 (its four characters), those of GenICam, its code.
const NAMES: &[(PixelFormat, &str, &str, u32)] = &[
    (PixelFormat::Mono8, "GREY", "Mono8", 0x0108_0001),
    (PixelFormat::Mono16 { bits: 10 }, "Y10 ", "Mono10", 0x0110_0003),
    (PixelFormat::Mono16 { bits: 12 }, "Y12 ", "Mono12", 0x0110_0005),
    (PixelFormat::Mono16 { bits: 16 }, "Y16 ", "Mono16", 0x0110_0007),
    (PixelFormat::Mono10p, "", "Mono10p", 0x010a_0046),
    (PixelFormat::Mono12p, "", "Mono12p", 0x010c_0047),
    (PixelFormat::Mono10Packed, "", "Mono10Packed", 0x010c_0004),
    (PixelFormat::Mono12Packed, "", "Mono12Packed", 0x010c_0006),
    (PixelFormat::Yuyv, "YUYV", "YUV422_8", 0x0210_0032),
    (PixelFormat::Uyvy, "UYVY", "YUV422_8_UYVY", 0x0210_001f),
    (PixelFormat::Mono8, "NV12", "", 0),
    (PixelFormat::Bayer8, "RGGB", "BayerRG8", 0x0108_0009),
    (PixelFormat::Bayer8, "GRBG", "BayerGR8", 0x0108_0008),
    (PixelFormat::Bayer8, "GBRG", "BayerGB8", 0x0108_000a),
    (PixelFormat::Bayer8, "BA81", "BayerBG8", 0x0108_000b),
    (PixelFormat::Jpeg, "MJPG", "", 0),
];

#[cfg(any(feature = "v4l2", test))]
/// A format by its V4L2 name; returns the four characters too.
pub fn by_fourcc(name: &str) -> Result<(PixelFormat, [u8; 4])> {
    let found =
        NAMES.iter().find(|(_, fourcc, ..)| !fourcc.is_empty() && fourcc.trim() == name.trim());
    let fourcc = found.and_then(|(_, fourcc, ..)| fourcc.as_bytes().try_into().ok());
    found.zip(fourcc).map(|((format, ..), fourcc)| (*format, fourcc)).ok_or_else(|| {
        let known = NAMES.iter().map(|(_, fourcc, ..)| fourcc.trim());
        unknown(name, known.filter(|name| !name.is_empty()))
    })
}

/// A format by its GenICam name; returns its code too.
pub fn by_genicam(name: &str) -> Result<(PixelFormat, u32)> {
    let found = NAMES.iter().find(|(_, _, genicam, _)| !genicam.is_empty() && *genicam == name);
    found.map(|(format, .., code)| (*format, *code)).ok_or_else(|| {
        unknown(
            name,
            NAMES.iter().map(|(_, _, genicam, _)| *genicam).filter(|name| !name.is_empty()),
        )
    })
}

fn unknown(name: &str, known: impl Iterator<Item = &'static str>) -> Error {
    Error::configuration(format!("camera.format = {name:?}"))
        .allowed(known.collect::<Vec<_>>().join(", "))
        .remedy("choose one that the camera delivers")
}

impl PixelFormat {
    /// Bytes of a row of `width` pixels without gaps; 0 for compressed ones.
    pub fn row_bytes(self, width: usize) -> usize {
        match self {
            Self::Mono8 | Self::Bayer8 => width,
            Self::Mono16 { .. } | Self::Yuyv | Self::Uyvy => 2 * width,
            Self::Mono10p => (10 * width).div_ceil(8),
            Self::Mono12p | Self::Mono10Packed | Self::Mono12Packed => (12 * width).div_ceil(8),
            Self::Jpeg => 0,
        }
    }

    /// Fill `out`, `width` x `height` bytes, from an image whose rows are `stride` bytes apart.
    ///
    /// `false` when the image is shorter than that, or damaged.
    pub fn to_mono(
        self,
        image: &[u8],
        stride: usize,
        [width, height]: [usize; 2],
        out: &mut [u8],
    ) -> bool {
        if self == Self::Jpeg {
            return jpeg(image, [width, height], out);
        }
        let row_bytes = self.row_bytes(width);
        let whole = height > 0 && stride >= row_bytes && out.len() == width * height;
        if !whole || image.len() < stride * (height - 1) + row_bytes {
            return false;
        }
        let row = |y: usize| &image[y * stride..][..row_bytes];
        for (y, out) in out.chunks_exact_mut(width).enumerate() {
            if self == Self::Bayer8 {
                // Mirrored at the border, so that the mosaic goes on.
                let above = if y == 0 { 1.min(height - 1) } else { y - 1 };
                let below = if y + 1 < height { y + 1 } else { above };
                smooth([row(above), row(y), row(below)], out);
            } else {
                self.row_to_mono(row(y), out);
            }
        }
        true
    }

    fn row_to_mono(self, row: &[u8], out: &mut [u8]) {
        // Byte `at` of every group of `size`.
        let pick = |out: &mut [u8], size: usize, at: usize| {
            for (out, group) in out.iter_mut().zip(row.chunks_exact(size)) {
                *out = group[at];
            }
        };
        match self {
            Self::Yuyv => pick(out, 2, 0),
            Self::Uyvy => pick(out, 2, 1),
            Self::Mono16 { bits } => {
                for (out, pair) in out.iter_mut().zip(row.chunks_exact(2)) {
                    let value = u16::from_le_bytes([pair[0], pair[1]]) >> (bits - 8);
                    *out = value.min(255) as u8;
                }
            }
            Self::Mono10p => packed(row, 10, out),
            Self::Mono12p => packed(row, 12, out),
            Self::Mono10Packed | Self::Mono12Packed => {
                for (x, out) in out.iter_mut().enumerate() {
                    *out = row[x / 2 * 3 + x % 2 * 2];
                }
            }
            Self::Mono8 | Self::Bayer8 | Self::Jpeg => out.copy_from_slice(&row[..out.len()]),
        }
    }
}

/// The high 8 of so many bits a pixel, low bits first.
fn packed(row: &[u8], bits: usize, out: &mut [u8]) {
    for (x, out) in out.iter_mut().enumerate() {
        let bit = x * bits + bits - 8;
        let low = u16::from(row[bit / 8]);
        let high = row.get(bit / 8 + 1).copied().map_or(0, u16::from);
        *out = ((high << 8 | low) >> (bit % 8)) as u8;
    }
}

fn smooth([above, middle, below]: [&[u8]; 3], out: &mut [u8]) {
    let last = middle.len() - 1;
    let column = |x: usize| u16::from(above[x]) + 2 * u16::from(middle[x]) + u16::from(below[x]);
    for (x, out) in out.iter_mut().enumerate() {
        let left = if x == 0 { 1.min(last) } else { x - 1 };
        let right = if x < last { x + 1 } else { left };
        *out = ((column(left) + 2 * column(x) + column(right) + 8) / 16) as u8;
    }
}

/// Webcams leave the Huffman tables out: those of the standard (ITU-T T.81, K.3) are meant.
const MARKER_SOS: u8 = 0xda;
const MARKER_DHT: u8 = 0xc4;

fn jpeg(image: &[u8], [width, height]: [usize; 2], out: &mut [u8]) -> bool {
    let with_tables;
    let image = match start_of_scan(image) {
        Some((_, true)) => image,
        Some((at, false)) => {
            with_tables = [&image[..at], STANDARD_TABLES, &image[at..]].concat();
            &with_tables[..]
        }
        None => return false,
    };
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(width)
        .set_max_height(height)
        .jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(image), options);
    decoder.decode_headers().is_ok()
        && decoder.dimensions() == Some((width, height))
        && decoder.output_buffer_size() == Some(out.len())
        && decoder.decode_into(out).is_ok()
}

/// Where the scan begins, and whether Huffman tables come before it.
fn start_of_scan(image: &[u8]) -> Option<(usize, bool)> {
    let (mut at, mut tables) = (2, false);
    loop {
        let [0xff, marker, high, low] = *image.get(at..at + 4)? else { return None };
        tables |= marker == MARKER_DHT;
        if marker == MARKER_SOS {
            return Some((at, tables));
        }
        at += 2 + usize::from(u16::from_be_bytes([high, low]));
    }
}

/// The tables of ITU-T T.81, K.3.1 and K.3.2, as one segment.
#[rustfmt::skip]
const STANDARD_TABLES: &[u8] = &[
    0xff, 0xc4, 0x01, 0xa2, 0x00, 0x00, 0x01, 0x05, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
    0x00, 0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, 0x10, 0x00, 0x02, 0x01, 0x03, 0x03, 0x02,
    0x04, 0x03, 0x05, 0x05, 0x04, 0x04, 0x00, 0x00, 0x01, 0x7d, 0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31,
    0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52,
    0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a,
    0x34, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57,
    0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5,
    0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7,
    0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8,
    0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa, 0x01, 0x00, 0x03, 0x01, 0x01, 0x01, 0x01, 0x01,
    0x01, 0x01, 0x01, 0x01, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a,
    0x0b, 0x11, 0x00, 0x02, 0x01, 0x02, 0x04, 0x04, 0x03, 0x04, 0x07, 0x05, 0x04, 0x04, 0x00, 0x01, 0x02, 0x77, 0x00, 0x01,
    0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22, 0x32, 0x81, 0x08, 0x14,
    0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1, 0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25,
    0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46,
    0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a,
    0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94,
    0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6,
    0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8,
    0xd9, 0xda, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    /// 12-bit values of a picture 6 x 3.
    fn values() -> Vec<u16> {
        (0..18).map(|i| (i * 997 + 13) % 4096).collect()
    }

    fn expected(values: &[u16], bits: u32) -> Vec<u8> {
        values.iter().map(|v| (v >> (bits - 8)) as u8).collect()
    }

    #[test]
    fn rows_with_gaps_of_every_mono_format_become_their_high_bits() {
        let values = values();
        let tens: Vec<u16> = values.iter().map(|v| v >> 2).collect();
        // Rows of 6 pixels with 5 bytes of rubbish behind.
        let rows = |encode: &dyn Fn(&[u16]) -> Vec<u8>, values: &[u16]| -> (Vec<u8>, usize) {
            let rows: Vec<Vec<u8>> =
                values.chunks(6).map(|row| [encode(row), vec![0xa5; 5]].concat()).collect();
            (rows.concat(), rows[0].len())
        };
        let bits = |count: u32| {
            move |row: &[u16]| {
                let mut bytes = vec![0u8; (row.len() * count as usize).div_ceil(8)];
                for (i, bit) in (0..row.len() * count as usize).enumerate() {
                    let value = row[i / count as usize] >> (i % count as usize) & 1;
                    bytes[bit / 8] |= (value as u8) << (bit % 8);
                }
                bytes
            }
        };
        let words = |row: &[u16]| row.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let triples = |count: u32| {
            move |row: &[u16]| -> Vec<u8> {
                let high = |v: u16| (v >> (count - 8)) as u8;
                row.chunks(2).flat_map(|p| [high(p[0]), 0x5a, high(p[1])]).collect()
            }
        };
        let yuv = |luma_at: usize| {
            move |row: &[u16]| -> Vec<u8> {
                row.iter()
                    .flat_map(|v| {
                        if luma_at == 0 { [(v >> 4) as u8, 77] } else { [77, (v >> 4) as u8] }
                    })
                    .collect()
            }
        };
        let cases = [
            (PixelFormat::Mono16 { bits: 12 }, rows(&words, &values), expected(&values, 12)),
            (PixelFormat::Mono16 { bits: 10 }, rows(&words, &tens), expected(&tens, 10)),
            (PixelFormat::Mono10p, rows(&bits(10), &tens), expected(&tens, 10)),
            (PixelFormat::Mono12p, rows(&bits(12), &values), expected(&values, 12)),
            (PixelFormat::Mono10Packed, rows(&triples(10), &tens), expected(&tens, 10)),
            (PixelFormat::Mono12Packed, rows(&triples(12), &values), expected(&values, 12)),
            (PixelFormat::Yuyv, rows(&yuv(0), &values), expected(&values, 12)),
            (PixelFormat::Uyvy, rows(&yuv(1), &values), expected(&values, 12)),
            (
                PixelFormat::Mono8,
                rows(&|row: &[u16]| expected(row, 12), &values),
                expected(&values, 12),
            ),
        ];
        for (format, (image, stride), expected) in cases {
            let mut out = vec![0; 18];
            assert!(format.to_mono(&image, stride, [6, 3], &mut out), "{format:?}");
            assert_eq!(out, expected, "{format:?}");
            let needed = 2 * stride + format.row_bytes(6);
            assert!(format.to_mono(&image[..needed], stride, [6, 3], &mut out));
            assert!(!format.to_mono(&image[..needed - 1], stride, [6, 3], &mut out));
            assert!(!format.to_mono(&image, format.row_bytes(6) - 1, [6, 3], &mut out));
        }
    }

    #[test]
    fn a_mosaic_of_one_colour_is_even_at_every_phase_and_at_the_border() {
        let [red, green, blue] = [200u32, 100, 40];
        let luma = ((red + 2 * green + blue) / 4) as u8;
        for (phase_x, phase_y) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            for size in [[8, 6], [7, 5]] {
                let image: Vec<u8> = (0..size[0] * size[1])
                    .map(|i| (i % size[0] + phase_x, i / size[0] + phase_y))
                    .map(|(x, y)| match (x % 2, y % 2) {
                        (0, 0) => red as u8,
                        (1, 1) => blue as u8,
                        _ => green as u8,
                    })
                    .collect();
                let mut out = vec![0; image.len()];
                assert!(PixelFormat::Bayer8.to_mono(&image, size[0], size, &mut out));
                assert!(out.iter().all(|v| *v == luma), "{phase_x} {phase_y}: {out:?}");
            }
        }
    }

    fn gradient() -> Vec<u8> {
        (0..64 * 48).map(|i| (i % 64 * 3 + i / 64) as u8).collect()
    }

    fn encoded() -> Vec<u8> {
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 95)
            .encode(&gradient(), 64, 48, image::ExtendedColorType::L8)
            .expect("encodes");
        bytes
    }

    #[test]
    fn jpeg_pictures_are_read_with_and_without_their_tables() {
        let whole = encoded();
        let mut without = whole[..2].to_vec();
        let mut at = 2;
        while whole[at + 1] != MARKER_SOS {
            let end = at + 2 + usize::from(u16::from_be_bytes([whole[at + 2], whole[at + 3]]));
            if whole[at + 1] != MARKER_DHT {
                without.extend(&whole[at..end]);
            }
            at = end;
        }
        without.extend(&whole[at..]);
        assert!(without.len() < whole.len() - 100, "the tables are out");
        for image in [whole, without] {
            let mut out = vec![0; 64 * 48];
            assert!(PixelFormat::Jpeg.to_mono(&image, 0, [64, 48], &mut out));
            let worst = out.iter().zip(gradient()).map(|(a, b)| a.abs_diff(b)).max();
            // Quality 95 of a smooth picture.
            assert!(worst <= Some(4), "{worst:?}");
            assert!(!PixelFormat::Jpeg.to_mono(&image, 0, [48, 64], &mut out), "another size");
        }
    }

    #[test]
    fn damaged_jpeg_pictures_are_refused_not_believed() {
        let whole = encoded();
        let mut out = vec![0; 64 * 48];
        for length in [0, 1, 2, 3, 20, whole.len() / 2] {
            assert!(
                !PixelFormat::Jpeg.to_mono(&whole[..length], 0, [64, 48], &mut out),
                "{length}"
            );
        }
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] ^= 0xff;
            // Whatever comes of it: no panic.
            PixelFormat::Jpeg.to_mono(&damaged, 0, [64, 48], &mut out);
        }
    }

    #[test]
    fn unknown_formats_say_which_are_known() {
        let error = by_fourcc("RGB3").expect_err("unknown").to_string();
        assert!(error.contains("camera.format") && error.contains("GREY, Y10"), "{error}");
        assert_eq!(by_fourcc("Y16").expect("known"), (PixelFormat::Mono16 { bits: 16 }, *b"Y16 "));
        assert!(by_genicam("").is_err() && by_fourcc("").is_err());
        assert_eq!(by_genicam("Mono8").expect("known").1, 0x0108_0001);
    }
}
