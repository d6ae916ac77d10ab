//! Small blocks of a picture that are filled from their corners, where those are nearly alike: most of a
//! shadow is.

/// Side of a block, and of a tile of them.
pub(super) const BLOCK_PX: usize = 4;
pub(super) const TILE_PX: usize = 16;
/// Corners that differ by no more than this share of the light are alike.
const ALIKE: f32 = 0.1;

/// A block: first and one past last column and row.
#[derive(Clone, Copy)]
pub(super) struct BlockPx {
    from: [usize; 2],
    to: [usize; 2],
}

impl BlockPx {
    /// The block of a side that begins at a pixel, as far as it is within a bound.
    pub(super) fn within(from: [usize; 2], end: [usize; 2], side_px: usize) -> Self {
        Self { from, to: [0, 1].map(|k| (from[k] + side_px).min(end[k])) }
    }

    /// The blocks of a picture, or of a part of it, row by row.
    pub(super) fn all(
        from: [usize; 2],
        end: [usize; 2],
        side_px: usize,
    ) -> impl Iterator<Item = Self> {
        (from[1]..end[1]).step_by(side_px).flat_map(move |v| {
            (from[0]..end[0]).step_by(side_px).map(move |u| Self::within([u, v], end, side_px))
        })
    }

    /// The small blocks of a tile.
    pub(super) fn parts(self) -> impl Iterator<Item = Self> {
        Self::all(self.from, self.to, BLOCK_PX)
    }

    /// Pixels in the middle and in the middle of its sides.
    pub(super) fn middles(self, width: usize) -> [usize; 5] {
        let ([left, top], [right, bottom]) = (self.from, self.to);
        let (u, v) = (usize::midpoint(left, right - 1), usize::midpoint(top, bottom - 1));
        [[u, v], [u, top], [u, bottom - 1], [left, v], [right - 1, v]].map(|[u, v]| v * width + u)
    }

    /// Its pixels in a picture of a width.
    pub(super) fn pixels(self, width: usize) -> impl Iterator<Item = usize> {
        let ([left, top], [right, bottom]) = (self.from, self.to);
        (top..bottom).flat_map(move |v| v * width + left..v * width + right)
    }

    /// The pixels at its corners: the first row's, then the last row's.
    pub(super) fn corners(self, width: usize) -> [usize; 4] {
        let ([left, top], [right, bottom]) = (self.from, self.to);
        let at = |u: usize, v: usize| v * width + u;
        [at(left, top), at(right - 1, top), at(left, bottom - 1), at(right - 1, bottom - 1)]
    }

    /// The block between its corners, if they are alike in every value.
    pub(super) fn filled<const N: usize>(self, corners: [[f32; N]; 4]) -> Option<Filled<N>> {
        let alike = |k: usize| {
            let of = |pick: fn(f32, f32) -> f32, start: f32| {
                corners.iter().map(|c| c[k]).fold(start, pick)
            };
            of(f32::max, f32::MIN) - of(f32::min, f32::MAX) <= ALIKE
        };
        (0..N).all(alike).then_some(Filled { block: self, corners })
    }
}

/// Whether two values differ by so little.
pub(super) fn alike(a: f32, b: f32) -> bool {
    (a - b).abs() <= ALIKE
}

/// A block whose values lie between those of its corners.
pub(super) struct Filled<const N: usize> {
    block: BlockPx,
    corners: [[f32; N]; 4],
}

impl<const N: usize> Filled<N> {
    /// The values at a pixel of a picture of a width.
    pub(super) fn at(&self, i: usize, width: usize) -> [f32; N] {
        let BlockPx { from, to } = self.block;
        let part = |at: usize, axis: usize| {
            let last = (to[axis] - from[axis] - 1).max(1);
            (at - from[axis]) as f32 / last as f32
        };
        let (a, b) = (part(i % width, 0), part(i / width, 1));
        std::array::from_fn(|k| {
            let row = |first: usize| {
                let [left, right] = [self.corners[first][k], self.corners[first + 1][k]];
                left + a * (right - left)
            };
            row(0) + b * (row(2) - row(0))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_is_filled_between_corners_that_are_alike() {
        let block = BlockPx::within([8, 4], [100, 100], 4);
        assert_eq!(block.corners(100), [408, 411, 708, 711]);
        let filled = block.filled([[0.2], [0.23], [0.26], [0.29]]).expect("alike");
        let at = |u: usize, v: usize| filled.at(v * 100 + u, 100)[0];
        for (u, v, expected) in [(8, 4, 0.2), (11, 4, 0.23), (8, 7, 0.26), (9, 5, 0.23)] {
            assert!((at(u, v) - expected).abs() < 1e-6, "({u}, {v}): {}", at(u, v));
        }
        assert!(block.filled([[0.2], [0.2], [0.2], [0.4]]).is_none());
        let last = BlockPx::within([99, 99], [100, 100], 4);
        assert_eq!((last.corners(100), last.pixels(100).count()), ([9999; 4], 1));
        let mut pixels: Vec<usize> = BlockPx::all([0, 0], [21, 18], TILE_PX)
            .flat_map(BlockPx::parts)
            .flat_map(|block| block.pixels(21))
            .collect();
        pixels.sort_unstable();
        assert_eq!(pixels, (0..21 * 18).collect::<Vec<_>>(), "each pixel once");
    }
}
