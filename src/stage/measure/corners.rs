//! Corners on the top face, followed through the pass: a second witness of the height.
//!
//! The top face is parallel to the belt, so in the belt view it only shifts, at the belt's speed
//! times the magnification of its height. Each corner is matched with the patch of the frame
//! in which it was chosen, so nothing drifts; its ratio is the slope of a straight line through
//! its places over the belt's travel.

use super::model::Outline;
use crate::camera::BeltView;
use crate::image::Plane;
use crate::kernel::Level;
use crate::kernel::scalar::flow::Patch;
use crate::kernel::simd::corners::{Area, minimum_eigenvalues};
use crate::units::BeltMm;
use nalgebra::{Matrix2, Vector2};

/// Cells of the top face along and across; the best corner of each is followed.
const CELLS: [usize; 2] = [5, 4];
/// Corners of a parcel.
pub const CORNERS: usize = CELLS[0] * CELLS[1];
/// Corners are chosen this far inside the outline, as a share of the side: its edges are not.
const INSIDE: f64 = 0.1;
/// A weaker corner, (grey levels a px)^2, drowns in noise: its mean gradient would be 3 levels.
const EIGENVALUE_MIN: f32 = 10.0;
/// A corner that leaves its row by this much is a reflection or something else, px.
const ROW_MAX_PX: f32 = 0.7;
/// A corner whose places are further from a straight line than this (root mean square, px) jumped,
/// from one bar of a code to the next.
const STRAIGHT_MAX_PX: f64 = 0.5;
/// A corner tells the height once it was followed over this share of the zone, ...
const TRAVEL_MIN: f64 = 0.25;
/// ... in this many views.
const VIEWS_MIN: u32 = 6;
/// Ratios that agree within this belong to one plane: 3 mm of height under a camera at 1.5 m.
const AGREE: f64 = 0.002;
/// So many must agree.
const AGREE_MIN: usize = 3;
/// Standard uncertainty that remains: interpolation, lens.
const RATIO_SIGMA_MIN: f64 = 0.0002;

/// A corner on its way. Places are image columns in mm from where it was chosen.
#[derive(Clone, Copy, Debug)]
pub struct Corner {
    patch: Patch,
    start_px: [f32; 2],
    start_travel_mm: f64,
    /// Views it was found in, and the sums of its straight line: t, x, tt, tx, xx.
    views: u32,
    sums: [f64; 5],
    followed: bool,
    /// Travel and place in the last view.
    last_mm: [f64; 2],
}

impl Corner {
    /// None.
    pub const EMPTY: Self = Self {
        patch: Patch::EMPTY,
        start_px: [0.0; 2],
        start_travel_mm: 0.0,
        views: 0,
        sums: [0.0; 5],
        followed: false,
        last_mm: [0.0; 2],
    };

    fn begin(patch: Patch, px: [usize; 2], travel_mm: f64) -> Self {
        let start_px = px.map(|c| c as f32);
        Self {
            patch,
            start_px,
            start_travel_mm: travel_mm,
            followed: true,
            views: 1,
            ..Self::EMPTY
        }
    }

    /// Image travel over belt travel, once it is known.
    fn ratio(&self, zone_length_mm: f64, mm_per_px: f64) -> Option<f64> {
        if self.views < VIEWS_MIN || self.last_mm[0] < TRAVEL_MIN * zone_length_mm {
            return None;
        }
        let n = f64::from(self.views);
        let [t, x, tt, tx, xx] = self.sums.map(|sum| sum / n);
        let slope = (tx - t * x) / (tt - t * t);
        let mean_square = (xx - x * x) - slope * (tx - t * x);
        let straight = mean_square < (STRAIGHT_MAX_PX * mm_per_px).powi(2);
        // Nothing lies below the belt.
        (straight && slope > 1.0 - AGREE).then_some(slope)
    }

    fn follow(&mut self, view: &BeltView, grey: Plane<'_>, travel_mm: f64, ratio: f64) {
        let t_mm = travel_mm - self.start_travel_mm;
        let x_mm = self.last_mm[1] + ratio * (t_mm - self.last_mm[0]);
        let near = [self.start_px[0] + (x_mm / view.mm_per_px) as f32, self.start_px[1]];
        let found = self.patch.find(grey, near);
        let Some([u, _]) = found.filter(|at| (at[1] - near[1]).abs() <= ROW_MAX_PX) else {
            self.followed = false;
            return;
        };
        let x_mm = f64::from(u - self.start_px[0]) * view.mm_per_px;
        self.views += 1;
        self.last_mm = [t_mm, x_mm];
        let more = [t_mm, x_mm, t_mm * t_mm, t_mm * x_mm, x_mm * x_mm];
        for (sum, more) in self.sums.iter_mut().zip(more) {
            *sum += more;
        }
    }
}

/// What the corners agree upon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TopMotion {
    /// Image travel over belt travel of the plane that most corners are on.
    pub ratio: f64,
    /// Its standard uncertainty, besides that of the belt's travel.
    pub sigma: f64,
    /// The largest ratio that two corners share: the highest texture there is.
    pub highest: f64,
}

impl TopMotion {
    /// Of a top face that shows as much texture as one can use.
    pub fn certain(ratio: f64) -> Self {
        Self { ratio, sigma: RATIO_SIGMA_MIN, highest: ratio }
    }
}

/// Follow the corners into a new view. `ratio`: expected image travel over belt travel.
pub fn follow(
    corners: &mut [Corner],
    view: &BeltView,
    grey: Plane<'_>,
    travel_mm: f64,
    ratio: f64,
) {
    for corner in corners.iter_mut().filter(|c| c.followed) {
        corner.follow(view, grey, travel_mm, ratio);
    }
}

/// The best corner of each cell of the top face, unless some are being followed.
pub fn choose(
    corners: &mut [Corner],
    (view, level): (&BeltView, Level),
    grey: Plane<'_>,
    outline: &Outline,
    travel_mm: f64,
) {
    if corners.iter().any(|c| c.followed) {
        return;
    }
    let top = outline.top.each_ref().map(|v| v.image);
    let Some(best) = best_of_cells(view, level, grey, top) else { return };
    for (corner, (score, px)) in corners.iter_mut().zip(best) {
        if corner.views >= VIEWS_MIN || score <= EIGENVALUE_MIN {
            continue;
        }
        if let Some(patch) = Patch::cut(grey, px[0], px[1]) {
            *corner = Corner::begin(patch, px, travel_mm);
        }
    }
}

/// Score and place of the best corner of each cell; `None` when the top face has no area.
fn best_of_cells(
    view: &BeltView,
    level: Level,
    grey: Plane<'_>,
    top: [Vector2<f64>; 4],
) -> Option<[(f32, [usize; 2]); CORNERS]> {
    let cells = Cells::new(view, top)?;
    let mut best = [(EIGENVALUE_MIN, [0; 2]); CORNERS];
    minimum_eigenvalues(level, grey, area(view, top), |left, v, scores| {
        for (u, &score) in (left..).zip(scores) {
            if score > EIGENVALUE_MIN
                && let Some(cell) = cells.at([u, v])
                && score > best[cell].0
            {
                best[cell] = (score, [u, v]);
            }
        }
    });
    Some(best)
}

/// The pixels around a quadrilateral.
fn area(view: &BeltView, corners: [Vector2<f64>; 4]) -> Area {
    let px = corners.map(|at| view.px(BeltMm { x: at.x, y: at.y }));
    let range = |c: [f64; 4]| {
        let (low, high) = c.iter().fold((f64::MAX, 0.0f64), |(l, h), &c| (l.min(c), h.max(c)));
        [low.max(0.0) as usize, high as usize]
    };
    Area { u: range(px.map(|px| px.u)), v: range(px.map(|px| px.v)) }
}

/// The cells that the inside of a top face is divided into, as an affine map from pixels.
struct Cells {
    origin: Vector2<f64>,
    cells_from_px: Matrix2<f64>,
}

impl Cells {
    /// Of a top face, its corners in order; `None` when it has no area.
    fn new(view: &BeltView, [a, b, _, d]: [Vector2<f64>; 4]) -> Option<Self> {
        let px = |at: Vector2<f64>| view.px(BeltMm { x: at.x, y: at.y });
        let [a, b, d] = [a, b, d].map(px).map(|px| Vector2::new(px.u, px.v));
        let sides = [d - a, b - a];
        let origin = a + (sides[0] + sides[1]) * INSIDE;
        let cell = |axis: usize| sides[axis] * ((1.0 - 2.0 * INSIDE) / CELLS[axis] as f64);
        let cells_from_px = Matrix2::from_columns(&[cell(0), cell(1)]).try_inverse()?;
        Some(Self { origin, cells_from_px })
    }

    /// The cell that a pixel is in.
    fn at(&self, px: [usize; 2]) -> Option<usize> {
        let at = self.cells_from_px * (Vector2::new(px[0] as f64, px[1] as f64) - self.origin);
        let cell = [at.x.floor(), at.y.floor()];
        let inside = (0..2).all(|axis| cell[axis] >= 0.0 && cell[axis] < CELLS[axis] as f64);
        inside.then(|| cell[0] as usize + cell[1] as usize * CELLS[0])
    }
}

/// The motion that most corners share; `None` when too few agree.
pub fn top_motion(corners: &[Corner], zone_length_mm: f64, mm_per_px: f64) -> Option<TopMotion> {
    let told = corners.iter().take(CORNERS).filter_map(|c| c.ratio(zone_length_mm, mm_per_px));
    let mut ratios: heapless::Vec<f64, CORNERS> = told.collect();
    ratios.sort_unstable_by(f64::total_cmp);
    let agreeing = |ratio: f64| ratios.iter().filter(move |r| (**r - ratio).abs() <= AGREE);
    // Of equal crowds the higher one: what is below the top face is on a side or a lid's flap.
    let crowd = ratios.iter().copied().max_by_key(|&r| agreeing(r).count())?;
    let count = agreeing(crowd).count();
    if count < AGREE_MIN.max(ratios.len() / 2) {
        return None;
    }
    let mean = agreeing(crowd).sum::<f64>() / count as f64;
    let variance = agreeing(crowd).map(|r| (r - mean).powi(2)).sum::<f64>() / (count - 1) as f64;
    let sigma = (variance / count as f64).sqrt().hypot(RATIO_SIGMA_MIN);
    let shared = |pair: &&[f64]| pair[1] - pair[0] <= AGREE;
    let highest = ratios.windows(2).rfind(shared).map_or(mean, |pair| pair[0]);
    Some(TopMotion { ratio: mean, sigma, highest })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::BeltPx;

    const ZONE_MM: f64 = 1000.0;
    const MM_PER_PX: f64 = 1.5;

    /// A corner seen every 25 mm over 500 mm; `jump_mm` of it at half the way.
    fn corner(ratio: f64, jump_mm: f64) -> Corner {
        let mut corner = Corner { views: 1, followed: true, ..Corner::EMPTY };
        for i in 1..=20 {
            let t = 25.0 * f64::from(i);
            let x = ratio * t + if i > 10 { jump_mm } else { 0.0 };
            corner.views += 1;
            corner.last_mm = [t, x];
            for (sum, more) in corner.sums.iter_mut().zip([t, x, t * t, t * x, x * x]) {
                *sum += more;
            }
        }
        corner
    }

    fn motion(corners: &[Corner]) -> Option<TopMotion> {
        top_motion(corners, ZONE_MM, MM_PER_PX)
    }

    #[test]
    fn corners_that_agree_tell_the_ratio_of_their_plane() {
        let corners = [1.0500, 1.0502, 1.0498, 1.0501].map(|r| corner(r, 0.0));
        let found = motion(&corners).expect("agreed");
        assert!((found.ratio - 1.050_025).abs() < 1e-6, "{found:?}");
        assert!(found.sigma >= RATIO_SIGMA_MIN && found.sigma < 3e-4, "{found:?}");
    }

    #[test]
    fn the_crowd_outvotes_what_is_elsewhere_and_two_make_a_height() {
        let ratios = [1.05, 1.0502, 1.0498, 1.05, 1.02, 1.071, 1.0705, 1.12];
        let found = motion(&ratios.map(|r| corner(r, 0.0))).expect("agreed");
        assert!((found.ratio - 1.05).abs() < 1e-4, "{found:?}");
        // One alone, at 1.12, may be wrong.
        assert!((found.highest - 1.0705).abs() < 1e-6, "{found:?}");
    }

    #[test]
    fn too_few_corners_or_none_that_agree_tell_nothing() {
        assert_eq!(motion(&[]), None);
        assert_eq!(motion(&[corner(1.05, 0.0), corner(1.05, 0.0)]), None);
        assert_eq!(motion(&[1.02, 1.03, 1.04, 1.05, 1.06].map(|r| corner(r, 0.0))), None);
    }

    #[test]
    fn a_corner_that_jumps_to_the_next_bar_or_goes_below_the_belt_is_none() {
        assert_eq!(motion(&[corner(1.05, 6.0); 4]), None);
        assert_eq!(motion(&[corner(0.95, 0.0); 4]), None);
    }

    #[test]
    fn a_corner_is_followed_through_the_pictures_of_its_way() {
        const SIZE: usize = 96;
        fn plane(data: &[u8]) -> Plane<'_> {
            Plane::packed(data, SIZE, SIZE).expect("square")
        }
        let view = BeltView {
            size_px: [SIZE, SIZE],
            mm_per_px: MM_PER_PX,
            origin: BeltMm { x: 0.0, y: 0.0 },
            nadir: Vector2::new(0.0, 0.0),
            camera_height_mm: 1500.0,
        };
        let picture = |u: f32| -> Vec<u8> {
            let edge = |x: f32| 1.0 / (1.0 + (-x / 0.6).exp());
            let at = |i: usize| edge((i % SIZE) as f32 - u) * edge((i / SIZE) as f32 - 40.0);
            (0..SIZE * SIZE).map(|i| (30.0 + 120.0 * at(i)) as u8).collect()
        };
        let first = picture(20.0);
        let patch = Patch::cut(plane(&first), 20, 40).expect("inside");
        let mut corners = [Corner::begin(patch, [20, 40], 1000.0)];
        for i in 1..=12 {
            let t_mm = 6.0 * f64::from(i);
            let data = picture(20.0 + (1.1 * t_mm / MM_PER_PX) as f32);
            // The expected ratio is that of a parcel half as high.
            follow(&mut corners, &view, plane(&data), 1000.0 + t_mm, 1.05);
        }
        let ratio = corners[0].ratio(200.0, MM_PER_PX).expect("followed");
        // A twentieth of a pixel over 48.
        assert!((ratio - 1.1).abs() < 0.001 * 1.1, "{ratio}");
    }

    #[test]
    fn the_best_corner_of_each_cell_is_chosen_and_none_outside() {
        const SIZE: usize = 160;
        let view = BeltView {
            size_px: [SIZE; 2],
            mm_per_px: 1.0,
            origin: BeltMm { x: 0.0, y: 0.0 },
            nadir: Vector2::new(0.0, 0.0),
            camera_height_mm: 1500.0,
        };
        // A square of 100 px, turned; a speck on every cell's middle, a stronger one outside.
        let px =
            |s: f64, t: f64| Vector2::new(30.0 + 96.0 * s + 28.0 * t, 20.0 + 28.0 * s + 96.0 * t);
        let mut data = vec![60u8; SIZE * SIZE];
        let mut speck = |at: Vector2<f64>, grey: u8| {
            let (u, v) = (at.x.round() as usize, at.y.round() as usize);
            (v - 1..=v + 1).for_each(|v| data[v * SIZE + u - 1..=v * SIZE + u + 1].fill(grey));
            [u, v]
        };
        let inside = |t: f64| INSIDE + (1.0 - 2.0 * INSIDE) * t;
        let middle = |k: usize, axis: usize| (k as f64 + 0.5) / CELLS[axis] as f64;
        let places: Vec<[usize; 2]> = (0..CORNERS)
            .map(|k| {
                let (s, t) = (middle(k % CELLS[0], 0), middle(k / CELLS[0], 1));
                speck(px(inside(s), inside(t)), 160)
            })
            .collect();
        speck(px(-0.15, 0.5), 255);
        let grey = Plane::packed(&data, SIZE, SIZE).expect("square");
        let belt = |s: f64, t: f64| {
            let at = px(s, t);
            view.belt_point(BeltPx { u: at.x, v: at.y })
        };
        let top = [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)].map(|(s, t)| belt(s, t));
        let top = top.map(|at| Vector2::new(at.x, at.y));
        let best = best_of_cells(&view, Level::new(), grey, top).expect("has an area");
        for ((score, [u, v]), place) in best.into_iter().zip(places) {
            // A speck is as good a corner wherever in the patch it is.
            let away = u.abs_diff(place[0]).max(v.abs_diff(place[1]));
            assert!(score > EIGENVALUE_MIN && away <= 6, "{u} {v}: {place:?}");
        }
    }

    #[test]
    fn a_corner_followed_over_a_short_way_is_none() {
        let mut short = corner(1.05, 0.0);
        short.last_mm[0] = 0.2 * ZONE_MM;
        assert_eq!(motion(&[short; 4]), None);
    }
}
