//! Corners and their flow: patches worth following, and where one has gone.
//!
//! Source: Shi and Tomasi 1994 (minimum eigenvalue); Lucas and Kanade 1981 in the inverse
//! compositional form of Baker and Matthews 2004. No pyramid: the belt's motion is known, so
//! a patch is expected within a pixel or two of where it is.

use crate::image::Plane;

/// Half the side of a patch, px.
pub const HALF: usize = 6;
/// Side of a patch, px.
pub const SIDE: usize = 2 * HALF + 1;
const BORDERED: usize = SIDE + 2;
/// Iterations, and the step in px below which no more are needed.
const ITERATIONS: usize = 10;
const STEP_MIN_PX: f32 = 0.01;
/// A patch that is expected here and found further away than this is another one, px.
const SEARCH_PX: f32 = 3.0;
/// Correlation below which it is not the same patch.
const CORRELATION_MIN: f32 = 0.8;

/// A square of grey values around a corner, with a border for its gradients.
#[derive(Clone, Copy, Debug)]
pub struct Patch {
    grey: [u8; BORDERED * BORDERED],
}

impl Patch {
    /// Nothing.
    pub const EMPTY: Self = Self { grey: [0; BORDERED * BORDERED] };

    /// Cut out around column `u`, row `v`; `None` at the border of the image.
    pub fn cut(image: Plane<'_>, u: usize, v: usize) -> Option<Self> {
        let (left, top) = (u.checked_sub(HALF + 1)?, v.checked_sub(HALF + 1)?);
        if left + BORDERED > image.width() || top + BORDERED > image.height() {
            return None;
        }
        let mut patch = Self::EMPTY;
        for (row, y) in patch.grey.chunks_exact_mut(BORDERED).zip(top..) {
            row.copy_from_slice(&image.row(y)[left..left + BORDERED]);
        }
        Some(patch)
    }

    fn at(&self, u: usize, v: usize) -> f32 {
        f32::from(self.grey[v * BORDERED + u])
    }

    /// Value and gradient at each place, row by row.
    fn places(&self) -> impl Iterator<Item = (f32, [f32; 2])> + '_ {
        (1..=SIDE).flat_map(move |v| {
            (1..=SIDE).map(move |u| {
                let gradient = [
                    0.5 * (self.at(u + 1, v) - self.at(u - 1, v)),
                    0.5 * (self.at(u, v + 1) - self.at(u, v - 1)),
                ];
                (self.at(u, v), gradient)
            })
        })
    }

    /// Sums of products of the gradient: xx, xy, yy.
    fn tensor(&self) -> [f32; 3] {
        self.places()
            .fold([0.0; 3], |[xx, xy, yy], (_, [x, y])| [xx + x * x, xy + x * y, yy + y * y])
    }

    /// The smaller eigenvalue of the mean structure tensor, (grey levels a px)^2: how well the
    /// patch can be located in its worst direction.
    pub fn minimum_eigenvalue(&self) -> f32 {
        // Whole numbers below 2^24, as everything that is summed here.
        minimum_eigenvalue(self.tensor().map(|sum| 4.0 * sum))
    }

    /// Where the patch is in `image`, expected at `near` (its centre, px). `None` when it is
    /// not there: gone, hidden, out of the image, or without texture.
    pub fn find(&self, image: Plane<'_>, near: [f32; 2]) -> Option<[f32; 2]> {
        let [xx, xy, yy] = self.tensor();
        let determinant = xx * yy - xy * xy;
        if determinant <= f32::EPSILON * xx * yy {
            return None;
        }
        let mean = self.places().map(|(grey, _)| grey).sum::<f32>() / (SIDE * SIDE) as f32;
        let spread = |values: &mut dyn Iterator<Item = f32>, mean: f32| {
            values.map(|g| (g - mean).powi(2)).sum::<f32>().sqrt()
        };
        let own = spread(&mut self.places().map(|(grey, _)| grey), mean);
        let mut at = near;
        let mut seen = [0.0; SIDE * SIDE];
        for _ in 0..ITERATIONS {
            let here = sample(image, at, &mut seen)?;
            // The same contrast: light that changed would pull towards one side.
            let gain = own / spread(&mut seen.iter().copied(), here).max(f32::MIN_POSITIVE);
            let [mut bx, mut by] = [0.0; 2];
            for (seen, (grey, [x, y])) in seen.iter().zip(self.places()) {
                let difference = gain * (seen - here) - (grey - mean);
                bx += x * difference;
                by += y * difference;
            }
            let step = [(yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant];
            at = [at[0] - step[0], at[1] - step[1]];
            if (at[0] - near[0]).hypot(at[1] - near[1]) > SEARCH_PX {
                return None;
            }
            if step[0].hypot(step[1]) < STEP_MIN_PX {
                break;
            }
        }
        let here = sample(image, at, &mut seen)?;
        let other = spread(&mut seen.iter().copied(), here);
        let both = seen.iter().zip(self.places()).map(|(s, (grey, _))| (s - here) * (grey - mean));
        (both.sum::<f32>() > CORRELATION_MIN * own * other).then_some(at)
    }
}

/// The smaller eigenvalue of a patch's mean structure tensor, from the sums of products of the
/// doubled gradient: xx, xy, yy.
#[inline]
pub fn minimum_eigenvalue([xx, xy, yy]: [f32; 3]) -> f32 {
    const SCALE: f32 = 0.5 * 0.25 / (SIDE * SIDE) as f32;
    let (difference, product) = (xx - yy, 2.0 * xy);
    SCALE * (xx + yy - (difference * difference + product * product).sqrt())
}

/// Bilinear samples around `at`; returns their mean.
fn sample(image: Plane<'_>, at: [f32; 2], seen: &mut [f32; SIDE * SIDE]) -> Option<f32> {
    let mut sum = 0.0;
    for (row, dv) in seen.chunks_exact_mut(SIDE).zip(-(HALF as i32)..) {
        for (out, du) in row.iter_mut().zip(-(HALF as i32)..) {
            *out = image.sample(at[0] + du as f32, at[1] + dv as f32)?;
            sum += *out;
        }
    }
    Some(sum / (SIDE * SIDE) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 48;

    /// A corner of a bright square at `at`, its edges blurred over a pixel and a half.
    fn corner(at: [f32; 2], gain: f32) -> Vec<u8> {
        let edge = |x: f32| 1.0 / (1.0 + (-x / 0.6).exp());
        let pixel = |i: usize| {
            let (x, y) = ((i % SIZE) as f32, (i / SIZE) as f32);
            30.0 + gain * edge(x - at[0]) * edge(y - at[1])
        };
        (0..SIZE * SIZE).map(|i| pixel(i).round() as u8).collect()
    }

    fn plane(data: &[u8]) -> Plane<'_> {
        Plane::packed(data, SIZE, SIZE).expect("square")
    }

    #[test]
    fn a_moved_corner_is_found_to_a_twentieth_of_a_pixel() {
        let first = corner([22.0, 22.0], 120.0);
        let patch = Patch::cut(plane(&first), 22, 22).expect("inside");
        for [du, dv] in [[0.0, 0.0], [0.3, 0.0], [0.5, -0.7], [-1.6, 0.4], [2.0, 1.5]] {
            let moved = corner([22.0 + du, 22.0 + dv], 120.0);
            let [u, v] = patch.find(plane(&moved), [22.0, 22.0]).expect("there");
            assert!((u - 22.0 - du).hypot(v - 22.0 - dv) < 0.05, "{du} {dv}: {u} {v}");
        }
    }

    #[test]
    fn a_change_of_light_moves_nothing() {
        let patch = Patch::cut(plane(&corner([22.0, 22.0], 120.0)), 22, 22).expect("inside");
        let [u, v] = patch.find(plane(&corner([22.4, 22.0], 138.0)), [22.0, 22.0]).expect("there");
        assert!((u - 22.4).hypot(v - 22.0) < 0.1, "{u} {v}");
    }

    #[test]
    fn a_corner_scores_higher_than_an_edge_or_nothing() {
        let score = |data: &[u8], u: usize, v: usize| {
            Patch::cut(plane(data), u, v).expect("inside").minimum_eigenvalue()
        };
        let data = corner([22.0, 22.0], 120.0);
        let (corner, edge, flat) = (score(&data, 22, 22), score(&data, 38, 22), score(&data, 9, 9));
        assert!(corner > 50.0 && edge < 1.0 && flat < 1.0, "{corner} {edge} {flat}");
    }

    #[test]
    fn what_is_gone_hidden_flat_or_at_the_border_is_not_found() {
        let data = corner([22.0, 22.0], 120.0);
        let patch = Patch::cut(plane(&data), 22, 22).expect("inside");
        let flat = vec![60; SIZE * SIZE];
        assert!(patch.find(plane(&flat), [22.0, 22.0]).is_none());
        assert!(patch.find(plane(&data), [f32::NAN, 22.0]).is_none());
        assert!(patch.find(plane(&data), [3.0, 22.0]).is_none());
        assert!(Patch::EMPTY.find(plane(&data), [22.0, 22.0]).is_none());
        for low_or_high in [0, 255] {
            let same = vec![low_or_high; SIZE * SIZE];
            let patch = Patch::cut(plane(&same), 20, 20).expect("inside");
            assert!(patch.find(plane(&same), [20.0, 20.0]).is_none());
        }
        assert!(Patch::cut(plane(&data), HALF, 22).is_none());
        assert!(Patch::cut(plane(&data), SIZE - HALF - 1, 22).is_none());
    }
}
