//! Strided views of 8-bit images, and a frame's time. Views only: the bytes are owned elsewhere.

/// A frame's place in its stream.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameTime {
    /// From 0; gaps are dropped frames.
    pub index: u64,
    /// From the first frame.
    pub t_s: f64,
}

/// A read-only view of a mono image, one byte a pixel.
#[derive(Clone, Copy, Debug)]
pub struct Plane<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> Plane<'a> {
    /// View `height` rows of `width` bytes, `stride` bytes apart.
    ///
    /// `None` when the rows do not fit into `data`.
    pub fn new(data: &'a [u8], width: usize, height: usize, stride: usize) -> Option<Self> {
        let bytes_min = match height {
            0 => 0,
            rows => stride.checked_mul(rows - 1)?.checked_add(width)?,
        };
        (stride >= width && data.len() >= bytes_min).then_some(Self { data, width, height, stride })
    }

    /// Rows without gaps: the whole of `data` must be the image.
    pub fn packed(data: &'a [u8], width: usize, height: usize) -> Option<Self> {
        (data.len() == width.checked_mul(height)?).then_some(())?;
        Self::new(data, width, height, width)
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Row `y`, exactly `width` bytes.
    pub fn row(&self, y: usize) -> &'a [u8] {
        &self.data[y * self.stride..][..self.width]
    }

    /// Bytes from one row to the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// All bytes from column `x`, row `y` on, those between the rows included.
    pub fn from(&self, x: usize, y: usize) -> &'a [u8] {
        &self.data[y * self.stride + x..]
    }

    /// Value at column `x`, row `y`.
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.row(y)[x]
    }

    /// Bilinear value at (`x`, `y`); `None` outside the outermost pixel centres.
    pub fn sample(&self, x: f32, y: f32) -> Option<f32> {
        let inside = x >= 0.0
            && y >= 0.0
            && x < self.width.saturating_sub(1) as f32
            && y < self.height.saturating_sub(1) as f32;
        if !inside {
            return None;
        }
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let top = &self.row(row)[column..column + 2];
        let bottom = &self.row(row + 1)[column..column + 2];
        let lerp =
            |pair: &[u8]| f32::from(pair[0]) + fx * (f32::from(pair[1]) - f32::from(pair[0]));
        let (t, b) = (lerp(top), lerp(bottom));
        Some(t + fy * (b - t))
    }
}
