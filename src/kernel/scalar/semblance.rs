//! Views added up on a plane, so that what is alike in all of them shows: sums, squares and counts, pixel by
//! pixel. Semblance is `(sum w)^2 / (n sum w^2)` (Neidell and Taner 1971). Here every level shares the source.
#![expect(clippy::inline_always, reason = "only inlined code is compiled for its level")]

/// Views that the sums hold at most.
pub const VIEWS_MAX: usize = 64;
/// Cells are read between two columns to this part of the distance.
pub const FRACTION_ONE: i16 = 16;
/// A cell's value of 1 in a sum.
pub const CELL_ONE: i16 = FRACTION_ONE >> CELL_SHIFT;
/// Bits of the parts that do not go into a sum, so that it holds [`VIEWS_MAX`] views.
const CELL_SHIFT: u32 = 2;

/// Two neighbouring columns of a view's cells: values, 0 where the view does not see, and 1 where it does.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// Values of the left and of the right column.
    pub values: [&'a [i8]; 2],
    /// Whether each is seen: 0 or 1.
    pub seen: [&'a [u8]; 2],
    /// From the left to the right, in parts of [`FRACTION_ONE`].
    pub fraction: i16,
}

/// Sums over the views for cells of one column at one height.
pub struct CellSums<'a> {
    /// Values, times [`CELL_ONE`].
    pub sum: &'a mut [i16],
    /// Their squares.
    pub squares: &'a mut [i32],
    /// Views that see both columns.
    pub views: &'a mut [i16],
}

/// Add a view's cells; all slices are as long as `out.sum`.
#[inline(always)]
pub fn add_cells(columns: Columns<'_>, out: &mut CellSums<'_>) {
    let n = out.sum.len();
    let [left, right] = columns.values.map(|values| &values[..n]);
    let [seen_left, seen_right] = columns.seen.map(|seen| &seen[..n]);
    let (squares, views) = (&mut out.squares[..n], &mut out.views[..n]);
    let [to_left, to_right] = [FRACTION_ONE - columns.fraction, columns.fraction];
    for i in 0..n {
        let seen = i16::from(seen_left[i] & seen_right[i]);
        let between = i16::from(left[i]) * to_left + i16::from(right[i]) * to_right;
        let value = seen * ((between + 2) >> CELL_SHIFT);
        out.sum[i] += value;
        squares[i] += i32::from(value) * i32::from(value);
        views[i] += seen;
    }
}

/// Sums over the views of the pixels of a plane's row.
pub struct StepSums<'a> {
    /// Steps along X.
    pub along: &'a mut [i16],
    /// Steps along Y.
    pub across: &'a mut [i16],
    /// Their squared length.
    pub energy: &'a mut [i32],
    /// Grey values.
    pub grey: &'a mut [u16],
    /// Views that tell.
    pub views: &'a mut [u16],
}

/// A row of a view's steps.
#[derive(Clone, Copy)]
pub struct StepRow<'a> {
    /// Along X.
    pub along: &'a [i8],
    /// Along Y.
    pub across: &'a [i8],
    /// Grey values.
    pub grey: &'a [u8],
    /// 255 where the view tells, else 0.
    pub usable: &'a [u8],
}

/// Add a view's pixels; all slices are as long as `out.along`.
#[inline(always)]
pub fn add_steps(row: StepRow<'_>, out: &mut StepSums<'_>) {
    let n = out.along.len();
    let [from_along, from_across] = [row.along, row.across].map(|steps| &steps[..n]);
    let [from_grey, usable] = [row.grey, row.usable].map(|bytes| &bytes[..n]);
    let (across, energy) = (&mut out.across[..n], &mut out.energy[..n]);
    let (grey, views) = (&mut out.grey[..n], &mut out.views[..n]);
    for i in 0..n {
        let here = usable[i];
        let x = i16::from(from_along[i] & here as i8);
        let y = i16::from(from_across[i] & here as i8);
        out.along[i] += x;
        across[i] += y;
        energy[i] += i32::from(x) * i32::from(x) + i32::from(y) * i32::from(y);
        grey[i] += u16::from(from_grey[i] & here);
        views[i] += u16::from(here & 1);
    }
}
