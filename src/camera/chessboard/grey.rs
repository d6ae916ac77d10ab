//! A grey image in floating point, halved and smoothed: what the finder looks at.

use crate::image::Plane;
use nalgebra::Vector2;

/// Grey values by row.
pub(super) struct Grey {
    pub(super) width: usize,
    pub(super) height: usize,
    data: Vec<f32>,
}

impl Grey {
    pub(super) fn new(image: Plane<'_>) -> Self {
        let (width, height) = (image.width(), image.height());
        let data = (0..height).flat_map(|y| image.row(y).iter().map(|&g| f32::from(g))).collect();
        Self { width, height, data }
    }

    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// Half the size: the mean of 2 x 2 pixels.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let sum = self.at(2 * x, 2 * y)
                    + self.at(2 * x + 1, 2 * y)
                    + self.at(2 * x, 2 * y + 1)
                    + self.at(2 * x + 1, 2 * y + 1);
                data.push(0.25 * sum);
            }
        }
        Self { width, height, data }
    }

    /// Smoothed by the binomial kernel 1 4 6 4 1 (a standard deviation of one pixel) along rows
    /// and columns; the border repeats.
    pub(super) fn smoothed(&self) -> Self {
        let pass = |source: &[f32], step: usize, position: &dyn Fn(usize) -> (usize, usize)| {
            let taps = |i: usize| {
                let (k, end) = position(i);
                let tap = |offset: isize| {
                    let there = k.saturating_add_signed(offset).min(end - 1);
                    source[i + there * step - k * step]
                };
                (tap(-2) + tap(2) + 4.0 * (tap(-1) + tap(1)) + 6.0 * tap(0)) / 16.0
            };
            (0..source.len()).map(taps).collect::<Vec<f32>>()
        };
        let (width, height) = (self.width, self.height);
        let rows = pass(&self.data, 1, &|i| (i % width, width));
        let data = pass(&rows, width, &|i| (i / width, height));
        Self { width, height, data }
    }

    /// Bilinear value; `None` outside the outermost pixel centres.
    pub(super) fn sample(&self, at: Vector2<f64>) -> Option<f64> {
        let inside = at.x >= 0.0
            && at.y >= 0.0
            && at.x < self.width as f64 - 1.0
            && at.y < self.height as f64 - 1.0;
        if !inside {
            return None;
        }
        let (x, y) = (at.x as usize, at.y as usize);
        let (fx, fy) = (at.x - x as f64, at.y - y as f64);
        let value = |x, y| f64::from(self.at(x, y));
        let top = value(x, y) + fx * (value(x + 1, y) - value(x, y));
        let bottom = value(x, y + 1) + fx * (value(x + 1, y + 1) - value(x, y + 1));
        Some(top + fy * (bottom - top))
    }
}
