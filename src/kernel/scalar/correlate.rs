//! Sums for matching two stretches of belt texture at a shift.

/// Sums over the overlap of a key row and a current row.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sums {
    /// Sum of products.
    pub ab: i64,
    /// Sum of squares of the key row.
    pub aa: i64,
    /// Sum of squares of the current row.
    pub bb: i64,
    /// Pixel pairs with texture on both sides.
    pub n: u32,
}

/// Value of a pixel that shows no belt texture (foreground, not seen).
pub const NO_TEXTURE: i8 = i8::MIN;

/// Add the products of `key[i]` and `current[i + shift]` over their overlap.
pub fn correlate(key: &[i8], current: &[i8], shift: isize, sums: &mut Sums) {
    let from = shift.max(0) as usize;
    let skip = (-shift).max(0) as usize;
    let (Some(key), Some(current)) = (key.get(skip..), current.get(from..)) else { return };
    let (mut ab, mut aa, mut bb, mut n) = (0i32, 0i32, 0i32, 0u32);
    for (&a, &b) in key.iter().zip(current) {
        let both = i32::from(a != NO_TEXTURE && b != NO_TEXTURE);
        let (a, b) = (i32::from(a) * both, i32::from(b) * both);
        ab += a * b;
        aa += a * a;
        bb += b * b;
        n += both as u32;
    }
    // A row of 8192 px times 127^2 stays below 2^31.
    sums.ab += i64::from(ab);
    sums.aa += i64::from(aa);
    sums.bb += i64::from(bb);
    sums.n += n;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_true_shift_correlates_fully_both_ways() {
        let texture: Vec<i8> = (0..200).map(|i: i32| (i * i % 17 - 8) as i8).collect();
        for (key, current, shift) in
            [(&texture[..150], &texture[20..170], -20), (&texture[20..170], &texture[..150], 20)]
        {
            let mut sums = Sums::default();
            correlate(key, current, shift, &mut sums);
            assert_eq!((sums.n, sums.ab), (130, sums.aa));
            assert_eq!(sums.aa, sums.bb);
        }
    }

    #[test]
    fn pixels_without_texture_do_not_count() {
        let mut sums = Sums::default();
        correlate(&[3, NO_TEXTURE, 5], &[3, 4, NO_TEXTURE], 0, &mut sums);
        assert_eq!(sums, Sums { ab: 9, aa: 9, bb: 9, n: 1 });
    }

    #[test]
    fn a_shift_beyond_the_row_adds_nothing() {
        let mut sums = Sums::default();
        correlate(&[1; 4], &[1; 4], 9, &mut sums);
        correlate(&[1; 4], &[1; 4], -9, &mut sums);
        assert_eq!(sums, Sums::default());
    }
}
