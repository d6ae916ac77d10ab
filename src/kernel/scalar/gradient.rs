//! The gradient that stays: of the gradients of many frames the one nearest to zero, pixel by pixel.
//!
//! What moves leaves no gradient in some of the frames, or one of the other sign; what stands keeps
//! its own in all of them. Branch-free, so that the compiler makes vectors of it.

/// Sobel's sums are divided by this to fit 8 bits.
const SCALE: i16 = 8;

/// Gradients along x and y of the middle one of three rows, each as long as `least`'s, Sobel's sums
/// over 8; the outermost pixels have none. `first`: nothing was kept before.
pub fn keep_least(rows: [&[u8]; 3], least: [&mut [i8]; 2], first: bool) {
    if first {
        gradients(rows, least, |now, _| now);
    } else {
        gradients(rows, least, nearest_to_zero);
    }
}

fn gradients(rows: [&[u8]; 3], least: [&mut [i8]; 2], keep: impl Fn(i8, i8) -> i8) {
    let [along, across] = least;
    let width = along.len();
    if width < 3 {
        return;
    }
    let n = width - 2;
    let [[a0, a1, a2], [b0, _, b2], [c0, c1, c2]] =
        rows.map(|row| [&row[..n], &row[1..=n], &row[2..n + 2]]);
    let (xs, ys) = (&mut along[1..=n], &mut across[1..=n]);
    // All are as long: by index, so that nothing is in the way of vectors.
    for i in 0..n {
        let at = |row: &[u8]| i16::from(row[i]);
        let gx = at(a2) + 2 * at(b2) + at(c2) - at(a0) - 2 * at(b0) - at(c0);
        let gy = at(c0) + 2 * at(c1) + at(c2) - at(a0) - 2 * at(a1) - at(a2);
        xs[i] = keep((gx / SCALE) as i8, xs[i]);
        ys[i] = keep((gy / SCALE) as i8, ys[i]);
    }
}

/// Of two values of one sign the smaller; of two signs: 0.
#[inline]
fn nearest_to_zero(a: i8, b: i8) -> i8 {
    a.min(b).max(0) + a.max(b).min(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_is_kept_and_what_moves_is_not() {
        let frame = |moving: usize| {
            let mut row = [40u8; 24];
            row[4..8].fill(120);
            row[moving..moving + 3].fill(200);
            row
        };
        let (mut x, mut y) = ([0i8; 24], [0i8; 24]);
        for (k, moving) in [12, 15, 19].into_iter().enumerate() {
            let row = frame(moving);
            keep_least([&row, &row, &row], [&mut x, &mut y], k == 0);
        }
        let mut expected = [0i8; 24];
        for (at, value) in [(3, 40), (4, 40), (7, -40), (8, -40)] {
            expected[at] = value;
        }
        assert_eq!(x, expected);
        assert_eq!(y, [0; 24]);
    }

    #[test]
    fn no_contrast_overflows() {
        let (mut x, mut y) = ([0i8; 3], [0i8; 3]);
        let rows: [&[u8]; 3] = [&[0, 0, 255], &[0, 0, 255], &[0, 255, 255]];
        keep_least(rows, [&mut x, &mut y], true);
        assert_eq!((x[1], y[1]), (127, 63));
    }
}
