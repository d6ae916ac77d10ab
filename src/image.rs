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
    #[inline]
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
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.row(y)[x]
    }

    /// Whether pixels surround (`x`, `y`): inside the outermost pixel centres.
    #[inline]
    pub fn surrounds(&self, x: f32, y: f32) -> bool {
        let inside = |at: f32, size: usize| at >= 0.0 && at < size.saturating_sub(1) as f32;
        inside(x, self.width) && inside(y, self.height)
    }

    /// Bilinear value at (`x`, `y`); `None` outside the outermost pixel centres.
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> Option<f32> {
        self.surrounds(x, y).then(|| self.between(x, y))
    }

    /// Bilinear value at a point that pixels surround, but for rounding.
    #[inline]
    pub(crate) fn between(&self, x: f32, y: f32) -> f32 {
        let column = (x as usize).min(self.width.saturating_sub(2));
        let row = (y as usize).min(self.height.saturating_sub(2));
        let (fx, fy) = (x - column as f32, y - row as f32);
        let first = row * self.stride + column;
        let top = &self.data[first..first + 2];
        let bottom = &self.data[first + self.stride..first + self.stride + 2];
        let lerp =
            |pair: &[u8]| f32::from(pair[0]) + fx * (f32::from(pair[1]) - f32::from(pair[0]));
        let (t, b) = (lerp(top), lerp(bottom));
        t + fy * (b - t)
    }
}
