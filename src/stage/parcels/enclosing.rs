//! The smallest upright cuboid around a thing that has no flat top with straight edges: a tube, a heap.
//!
//! In: the cells of the scroll that are raised in one piece. Out: of all directions the rectangle of the smallest area
//! around them, each side moved to where the views, stacked at that side's own height, show an edge. So is defined
//! what a dimensioner must tell of a thing that is no cuboid (OIML R129: the smallest box that encloses it).

use super::rectangle::Rectangle;
use super::stack::EdgePixel;

/// Directions tried over a quarter turn.
const DIRECTIONS: usize = 90;
/// Cells at each end that may lie outside: a few scatter.
const OUTSIDE_SHARE: f64 = 0.005;
/// An edge spreads cells by four: 16 mm with half a cell. It is sought as far, and a little more, mm.
pub const REACH_MM: f64 = 18.0;
/// Where no edge is found it is there, mm inside.
pub const SPREAD_MM: f64 = 16.0;
/// A side's edges point across it: within 15 degrees.
const ACROSS_MIN: f64 = 0.966;
/// A side is where this share of it is edge.
const EDGE_SHARE_MIN: f64 = 0.4;
/// What is left beside a line has this share of its strength: two fifths, by a mean over five pixels.
const BESIDE_STRENGTH_MAX: f64 = 0.5;
/// Width of a place where a side may be, mm.
const PLACE_MM: f64 = 2.0;
const PLACES: usize = (2.0 * REACH_MM / PLACE_MM) as usize;
/// Steps along a side that are looked at, at most.
const STEPS_MAX: usize = 512;
/// What belongs to a side lies so far inside of the cells' border, mm.
const SIDE_DEPTH_MM: f64 = 30.0;

/// The rectangle of the smallest area around points (X less the belt's travel, Y, mm). `scratch` has room for as many
/// values.
pub fn smallest_rectangle(
    points: &(impl Iterator<Item = [f64; 2]> + Clone),
    scratch: &mut [f64],
) -> Rectangle {
    let mut best: Option<(f64, Rectangle)> = None;
    for direction in 0..DIRECTIONS {
        let yaw = (direction as f64 * 90.0 / DIRECTIONS as f64).to_radians();
        let (sin, cos) = yaw.sin_cos();
        let [u, v] = [[cos, sin], [-sin, cos]].map(|[a, b]| {
            let mut count = 0;
            for ([x, y], value) in points.clone().zip(&mut *scratch) {
                *value = a * x + b * y;
                count += 1;
            }
            extent(&mut scratch[..count])
        });
        let rectangle = Rectangle {
            x_mm: 0.5 * (cos * (u[0] + u[1]) - sin * (v[0] + v[1])),
            y_mm: 0.5 * (sin * (u[0] + u[1]) + cos * (v[0] + v[1])),
            yaw,
            length_mm: u[1] - u[0],
            width_mm: v[1] - v[0],
            ..Rectangle::default()
        };
        let area = rectangle.length_mm * rectangle.width_mm;
        if best.is_none_or(|(least, _)| area < least) {
            best = Some((area, rectangle));
        }
    }
    best.map_or(Rectangle::default(), |(_, rectangle)| rectangle)
}

/// Lowest and highest, but for a few.
fn extent(values: &mut [f64]) -> [f64; 2] {
    let Some(last) = values.len().checked_sub(1) else { return [0.0; 2] };
    let outside = (OUTSIDE_SHARE * last as f64) as usize;
    [outside, last - outside].map(|place| *values.select_nth_unstable_by(place, f64::total_cmp).1)
}

/// A side of a rectangle: front, back, left or right seen along the yaw.
pub struct Side<'a> {
    rectangle: &'a Rectangle,
    which: usize,
    /// From the rectangle's middle to the side, mm.
    reach_mm: f64,
    /// Length of the side, mm.
    length_mm: f64,
}

impl<'a> Side<'a> {
    /// The four sides.
    pub fn all(rectangle: &'a Rectangle) -> [Self; 4] {
        std::array::from_fn(|which| {
            let sizes_mm = [rectangle.length_mm, rectangle.width_mm];
            let reach_mm = 0.5 * sizes_mm[which / 2];
            Self { rectangle, which, reach_mm, length_mm: sizes_mm[1 - which / 2] }
        })
    }

    /// The rectangle.
    pub fn rectangle(&self) -> &Rectangle {
        self.rectangle
    }

    /// How far a point is inside of the side, and its place along it from its middle, mm.
    fn depth_and_place_mm(&self, x_mm: f64, y_mm: f64) -> [f64; 2] {
        let (along, across) = self.rectangle.along_across(x_mm, y_mm);
        let [out, place] =
            [[along, across], [-along, across], [across, along], [-across, along]][self.which];
        [self.reach_mm - out, place]
    }

    /// Whether a point is the side's.
    pub fn has(&self, [x_mm, y_mm]: [f64; 2]) -> bool {
        self.depth_and_place_mm(x_mm, y_mm)[0] < SIDE_DEPTH_MM
    }

    /// Share of the side along which cells lie, each `cell_mm` wide.
    pub fn covered(&self, points: impl Iterator<Item = [f64; 2]>, cell_mm: f64) -> f64 {
        // A longer side is looked at in wider steps.
        let count = ((self.length_mm / cell_mm).ceil().max(1.0) as usize).min(STEPS_MAX);
        let step_mm = self.length_mm / count as f64;
        let mut covered = [false; STEPS_MAX];
        for [x_mm, y_mm] in points {
            let [depth_mm, place_mm] = self.depth_and_place_mm(x_mm, y_mm);
            if depth_mm < SIDE_DEPTH_MM {
                let place = ((place_mm + 0.5 * self.length_mm) / step_mm).max(0.0) as usize;
                covered[place.min(count - 1)] = true;
            }
        }
        covered.iter().filter(|&&covered| covered).count() as f64 / count as f64
    }

    /// How far the side is outside of the outermost line of edges near it, mm. `px_mm`: side of the edges' pixels.
    pub fn excess_mm(&self, edges: &[EdgePixel], px_mm: f64) -> Option<f64> {
        let (sin, cos) = self.rectangle.yaw.sin_cos();
        let (mut lengths_mm, mut strengths) = ([0.0; PLACES], [0.0; PLACES]);
        for edge in edges {
            let [x, y] = edge.step.map(f64::from);
            let normal = [cos * x + sin * y, cos * y - sin * x][self.which / 2];
            let [x_mm, y_mm] = edge.at_mm.map(f64::from);
            let [depth_mm, place_mm] = self.depth_and_place_mm(x_mm, y_mm);
            let is_beside = place_mm.abs() < 0.5 * self.length_mm && depth_mm.abs() < REACH_MM;
            if is_beside && normal.abs() > ACROSS_MIN {
                let place = (((depth_mm + REACH_MM) / PLACE_MM) as usize).min(PLACES - 1);
                lengths_mm[place] += f64::from(edge.agreement) * px_mm;
                strengths[place] += f64::from(edge.strength);
            }
        }
        // A line may lie between two places. Beside a strong one the slow part leaves weak ones.
        let both = |values: &[f64; PLACES], k: usize| values[k] + values[k + 1];
        let strongest = (0..PLACES - 1).map(|k| both(&strengths, k)).fold(0.0, f64::max);
        let is_line = |&k: &usize| {
            both(&lengths_mm, k) > EDGE_SHARE_MIN * self.length_mm
                && both(&strengths, k) > BESIDE_STRENGTH_MAX * strongest
        };
        (0..PLACES - 1).find(is_line).map(|k| (k + 1) as f64 * PLACE_MM - REACH_MM)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points every 2 mm over a rectangle of 200 x 80 mm, turned by 30 degrees.
    fn points() -> Vec<[f64; 2]> {
        let (sin, cos) = 30f64.to_radians().sin_cos();
        (0..=100)
            .flat_map(|i| {
                (0..=40).map(move |j| [2.0 * f64::from(i) - 100.0, 2.0 * f64::from(j) - 40.0])
            })
            .map(|[u, v]| [500.0 + cos * u - sin * v, sin * u + cos * v - 20.0])
            .collect()
    }

    #[test]
    fn the_smallest_rectangle_around_a_turned_one_is_itself_and_a_few_strays_change_nothing() {
        let mut points = points();
        points.extend([[500.0, 300.0], [700.0, -20.0]]);
        let found = smallest_rectangle(&points.iter().copied(), &mut vec![0.0; points.len()]);
        let near = |value: f64, truth: f64| assert!((value - truth).abs() < 2.0, "{found:?}");
        near(found.yaw.to_degrees(), 30.0);
        near(found.length_mm, 200.0);
        near(found.width_mm, 80.0);
        near(found.x_mm, 500.0);
        near(found.y_mm, -20.0);
    }

    #[test]
    fn a_side_is_moved_to_its_outermost_line_of_edges() {
        let rectangle = Rectangle { length_mm: 200.0, width_mm: 80.0, ..Rectangle::default() };
        let line = |x_mm: f32| {
            (-20..20).map(move |k| EdgePixel {
                at_mm: [x_mm, 2.0 * k as f32],
                step: [-1.0, 0.0],
                agreement: 1.0,
                strength: 0.2,
            })
        };
        let edges: Vec<EdgePixel> = line(93.0).chain(line(86.0)).collect();
        let [front, back, left, _] = Side::all(&rectangle);
        assert!(front.excess_mm(&edges, 2.0).is_some_and(|mm| (mm - 7.0).abs() <= PLACE_MM));
        assert_eq!(back.excess_mm(&edges, 2.0), None, "none there");
        assert_eq!(left.excess_mm(&edges, 2.0), None, "none across");
    }

    #[test]
    fn a_side_is_covered_as_far_as_cells_lie_along_it() {
        let rectangle = Rectangle { length_mm: 200.0, width_mm: 80.0, ..Rectangle::default() };
        let half: Vec<[f64; 2]> = (0..20).map(|k| [95.0, 2.0 * f64::from(k)]).collect();
        let [front, back, ..] = Side::all(&rectangle);
        assert!((front.covered(half.iter().copied(), 2.0) - 0.5).abs() < 0.03);
        assert!(back.covered(half.iter().copied(), 2.0) < 1e-9);
    }
}
