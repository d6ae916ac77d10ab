//! Steps between neighbours but one, along and across, in bytes.
#![expect(clippy::inline_always, reason = "only inlined code is compiled for its level")]

/// A step of 1 in units of a stored one.
pub const STEP_ONE: f32 = 256.0;
/// The longest step that is stored; longer ones keep their direction.
const STEP_MOST: f32 = 127.0;

/// A row of a picture, with its neighbours: `here` one pixel longer at each end than the steps, the others as long.
#[derive(Clone, Copy)]
pub struct Rows<'a> {
    /// The row above.
    pub above: &'a [f32],
    /// The row itself.
    pub here: &'a [f32],
    /// The row below.
    pub below: &'a [f32],
}

/// Steps to the right and upwards, in units of 1 / [`STEP_ONE`].
#[inline(always)]
pub fn take_steps(rows: Rows<'_>, along: &mut [i8], across: &mut [i8]) {
    let n = along.len();
    let (left, right) = (&rows.here[..n], &rows.here[2..][..n]);
    let (above, below) = (&rows.above[..n], &rows.below[..n]);
    let across = &mut across[..n];
    for i in 0..n {
        [along[i], across[i]] = stored([right[i] - left[i], above[i] - below[i]]);
    }
}

#[inline(always)]
fn stored([x, y]: [f32; 2]) -> [i8; 2] {
    let length = STEP_ONE * (x * x + y * y).sqrt();
    let scale = STEP_ONE * STEP_MOST / length.max(STEP_MOST);
    [rounded(scale * x), rounded(scale * y)]
}

/// To the nearest: a cast cuts off. No closure: those are not compiled for the level.
#[inline(always)]
fn rounded(step: f32) -> i8 {
    (step + 0.5_f32.copysign(step)) as i32 as i8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_stored_with_its_direction_however_long() {
        assert_eq!(stored([0.1, -0.2]), [26, -51]);
        assert_eq!(stored([3.0, 4.0]), [76, 102], "of length 127");
    }

    #[test]
    fn steps_go_to_the_right_and_upwards() {
        let (above, here, below) = ([0.5f32; 2], [0.0f32, 0.1, 0.3, 0.1], [0.25f32; 2]);
        let (mut along, mut across) = ([0; 2], [0; 2]);
        let rows = Rows { above: &above, here: &here, below: &below };
        take_steps(rows, &mut along, &mut across);
        assert_eq!((along, across), ([77, 0], [64, 64]));
    }
}
