//! What lens and camera do to a clean frame before and after its noise: blur, vibration, gamma,
//! temporal noise reduction, JPEG.

use super::random::Random;
use serde::Deserialize;

/// Reach of the largest blur, px.
const REACH: usize = 9;

/// `[sensor]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorTable {
    /// Standard deviation of the blur.
    pub blur_px: f64,
    /// Standard deviation of the image's place, from frame to frame.
    pub vibration_px: f64,
    /// Exponent from light to grey: 1 is linear.
    pub gamma: f64,
    /// Share of the frame before that a noise reduction leaves in this one, 0 to 0.9.
    pub denoise: f64,
    /// Mean grey level that the automatic exposure holds the picture at; 0: it is off.
    pub auto_exposure_grey: f64,
    /// How many frames it takes for most of the way there.
    pub auto_exposure_frames: f64,
    /// Quality of a JPEG between camera and program, 1 to 100; 0: none.
    pub jpeg_quality: u8,
}

impl Default for SensorTable {
    fn default() -> Self {
        Self {
            blur_px: 0.0,
            vibration_px: 0.0,
            gamma: 1.0,
            denoise: 0.0,
            auto_exposure_grey: 0.0,
            auto_exposure_frames: 10.0,
            jpeg_quality: 0,
        }
    }
}

impl SensorTable {
    /// Whether every value makes sense.
    pub(super) fn is_usable(&self) -> bool {
        (0.0..=2.5).contains(&self.blur_px)
            && (0.0..=1.0).contains(&self.vibration_px)
            && (0.3..=3.0).contains(&self.gamma)
            && (0.0..=0.9).contains(&self.denoise)
            && (0.0..=200.0).contains(&self.auto_exposure_grey)
            && self.auto_exposure_frames >= 1.0
            && self.jpeg_quality <= 100
    }
}

/// The camera's electronics and what they remember.
pub(super) struct Sensor {
    table: SensorTable,
    seed: u64,
    size_px: [usize; 2],
    scratch: Vec<u16>,
    /// A row with its ends repeated, and the sums of one.
    row: Vec<f32>,
    sums: Vec<f32>,
    /// Grey out for light in, 1/256 grey levels both; empty when linear.
    curve: Vec<u16>,
    /// The frame that went out last, and its index.
    before: Vec<u8>,
    before_index: Option<u64>,
    /// Of the automatic exposure.
    gain: Option<f64>,
}

impl Sensor {
    pub(super) fn new(table: &SensorTable, seed: u64, size_px: [usize; 2]) -> Self {
        let bytes = size_px[0] * size_px[1];
        let bent = |grey: usize| ((grey as f64 / 65535.0).powf(table.gamma) * 65535.0) as u16;
        let linear = (table.gamma - 1.0).abs() < 1e-9;
        let moves = table.blur_px > 0.0 || table.vibration_px > 0.0;
        Self {
            scratch: vec![0; if moves { bytes } else { 0 }],
            row: vec![0.0; size_px[0] + 2 * REACH],
            sums: vec![0.0; size_px[0]],
            curve: if linear { Vec::new() } else { (0..65536).map(bent).collect() },
            before: vec![0; if table.denoise > 0.0 { bytes } else { 0 }],
            before_index: None,
            gain: None,
            table: table.clone(),
            seed,
            size_px,
        }
    }

    /// The automatic exposure: this frame with the gain that the frames before it led to. It remembers
    /// them: frames in order only.
    fn hold_brightness(&mut self, clean: &mut [u16]) {
        let sum: u64 = clean.iter().map(|grey| u64::from(*grey)).sum();
        let mean_grey = sum as f64 / 256.0 / clean.len().max(1) as f64;
        let wanted = (self.table.auto_exposure_grey / mean_grey.max(1.0)).clamp(0.25, 4.0);
        let gain = *self.gain.get_or_insert(wanted);
        for grey in clean {
            *grey = (f64::from(*grey) * gain).min(65535.0) as u16;
        }
        let share = 1.0 - (-1.0 / self.table.auto_exposure_frames).exp();
        self.gain = Some(gain * (wanted / gain).powf(share));
    }

    /// Exposure, blur, vibration and gamma of a clean frame, 1/256 grey levels.
    pub(super) fn expose(&mut self, index: u64, clean: &mut [u16]) {
        if self.table.auto_exposure_grey > 0.0 {
            self.hold_brightness(clean);
        }
        let width = self.size_px[0];
        if !self.scratch.is_empty() {
            let mut random = Random(self.seed ^ 0x7669_6272 ^ index.wrapping_mul(0x9e37_79b9));
            let shift = [0; 2].map(|_| self.table.vibration_px * random.normal());
            let height = self.size_px[1];
            let rows = Kernel::new(self.table.blur_px, shift[0]);
            for (from, to) in clean.chunks(width).zip(self.scratch.chunks_mut(width)) {
                let row = &mut self.row[..width + 2 * REACH];
                for (u, at) in row.iter_mut().enumerate() {
                    *at = f32::from(from[u.saturating_sub(REACH).min(width - 1)]);
                }
                let sums = &mut self.sums[..width];
                sums.fill(0.0);
                for (d, weight) in rows.taps() {
                    add(sums, weight, row[d..d + width].iter().copied());
                }
                round(sums, to);
            }
            let columns = Kernel::new(self.table.blur_px, shift[1]);
            for (v, to) in clean.chunks_mut(width).enumerate() {
                let sums = &mut self.sums[..width];
                sums.fill(0.0);
                for (d, weight) in columns.taps() {
                    let row = (v + d).saturating_sub(REACH).min(height - 1);
                    let from = &self.scratch[row * width..][..width];
                    add(sums, weight, from.iter().map(|grey| f32::from(*grey)));
                }
                round(sums, to);
            }
        }
        if !self.curve.is_empty() {
            for grey in clean {
                *grey = self.curve[usize::from(*grey)];
            }
        }
    }

    /// Noise reduction and JPEG of a noisy frame. Remembers it: frames in order only.
    pub(super) fn process(&mut self, index: u64, frame: &mut [u8]) {
        if !self.before.is_empty() {
            let follows = index > 0 && self.before_index == Some(index - 1);
            let share = (self.table.denoise * 256.0) as u32;
            for (grey, before) in frame.iter_mut().zip(&mut self.before) {
                if follows {
                    let sum = u32::from(*before) * share + u32::from(*grey) * (256 - share);
                    *grey = ((sum + 128) >> 8) as u8;
                }
                *before = *grey;
            }
            self.before_index = Some(index);
        }
        if self.table.jpeg_quality > 0 {
            through_jpeg(self.table.jpeg_quality, self.size_px, frame);
        }
    }
}

/// Weights of a Gaussian at whole px around a shift; a blur of 0 is a linear interpolation.
struct Kernel([f32; 2 * REACH + 1]);

impl Kernel {
    fn new(sigma_px: f64, shift_px: f64) -> Self {
        let weight = |k: usize| {
            let far = k as f64 - REACH as f64 + shift_px;
            if sigma_px > 0.0 {
                (-0.5 * (far / sigma_px).powi(2)).exp()
            } else {
                (1.0 - far.abs()).max(0.0)
            }
        };
        let sum: f64 = (0..=2 * REACH).map(weight).sum();
        Self(std::array::from_fn(|k| (weight(k) / sum) as f32))
    }

    /// Places and weights, but for those that are nothing.
    fn taps(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.0.iter().copied().enumerate().filter(|(_, weight)| *weight > 1e-4)
    }
}

fn add(sums: &mut [f32], weight: f32, values: impl Iterator<Item = f32>) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += weight * value;
    }
}

fn round(sums: &[f32], to: &mut [u16]) {
    for (to, sum) in to.iter_mut().zip(sums) {
        *to = (sum + 0.5) as u16;
    }
}

/// Into a JPEG and back, in memory. A frame that does not make the way stays as it is.
fn through_jpeg(quality: u8, [width, height]: [usize; 2], frame: &mut [u8]) {
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality);
    let grey = image::ExtendedColorType::L8;
    let encoded =
        image::ImageEncoder::write_image(encoder, frame, width as u32, height as u32, grey);
    let decoded = encoded
        .and_then(|()| image::load_from_memory_with_format(&bytes, image::ImageFormat::Jpeg));
    if let Ok(picture) = decoded {
        frame.copy_from_slice(&picture.into_luma8());
    }
}
