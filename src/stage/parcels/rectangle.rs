//! The rectangle whose four sides the edge pixels of a plane explain best.
//!
//! In: the edge pixels of a stack, and a point that must lie inside. Out: the rectangle of the largest score:
//! what of its sides is edge, less what is not. So the outermost rectangle with whole sides wins over
//! every label and print inside it, and a line further out that the other sides do not reach (a shadow, a
//! neighbour) costs more than it brings. Tried is every combination of the most promising lines, for
//! the directions that most edges have.

use super::stack::{Stack, WINDOW_MAX_MM};
use crate::error::Result;
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltRect;

/// Directions tried: so many peaks of the edges' directions, ...
const DIRECTIONS: usize = 4;
/// ... each turned by this, degrees, in coarse pictures, ...
const TURNS_DEG: [f32; 3] = [-1.0, 0.0, 1.0];
/// ... and what is found by this in fine ones, ...
const FINE_TURNS_DEG: [f32; 3] = [-0.5, 0.0, 0.5];
/// ... so far around it, mm: three coarse pixels.
pub const CROP_MM: f64 = 12.0;
/// Around a known direction it is turned by this.
const NEAR_TURNS_DEG: [f32; 3] = [-0.4, 0.0, 0.4];
/// Peaks of direction are this far apart, half degrees.
const DIRECTIONS_APART: usize = 8;
/// A stronger edge tells no more of the direction.
const STRENGTH_MAX: f32 = 0.1;
/// Edges count for the direction with this distance from the middle, mm.
const DIRECTION_REACH_MM: f32 = 150.0;
/// Bins of the direction within a quarter turn: half degrees.
const BINS: usize = 180;
/// A side's edges point across it: within 15 degrees.
const ACROSS_MIN: f32 = 0.966;
/// Lines tried on each of the four sides.
const LINES: usize = 12;
/// A line's longest stretch is at least this, px.
const STRETCH_MIN_PX: i32 = 5;
/// A line this far inside of a side is another one, mm, ...
const APART_MM: f64 = 6.0;
/// ... and the side's rival up to this share of the rectangle, ...
const NARROWER_SHARE: f64 = 0.4;
/// ... if it is edge for this share of what the side is.
const NEARLY: f64 = 0.75;
/// Side of the turned grid's cells, mm, if the stack's pixels are not larger.
pub const GRID_MM: f64 = 2.0;
/// Sides shorter than this are no parcel, mm.
const SIDE_MIN_MM: f64 = 12.0;

/// A rectangle on a plane, belt-fixed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rectangle {
    /// Middle: X less the belt's travel, mm.
    pub x_mm: f64,
    /// Middle across the belt, mm.
    pub y_mm: f64,
    /// Direction of the length against +X, radians.
    pub yaw: f64,
    /// Along the yaw, mm.
    pub length_mm: f64,
    /// Across it, mm.
    pub width_mm: f64,
    /// Edge along the sides less what is none, mm.
    pub score_mm: f64,
    /// Share of each side that is edge: front, back, left, right seen along the yaw.
    pub sides: [f64; 4],
}

impl Rectangle {
    /// Most of an area: more than this share.
    pub const MOST: f64 = 0.5;

    /// Position along and across the rectangle, from its middle, mm.
    pub fn along_across(&self, x_mm: f64, y_mm: f64) -> (f64, f64) {
        let (sin, cos) = self.yaw.sin_cos();
        let (dx, dy) = (x_mm - self.x_mm, y_mm - self.y_mm);
        (cos * dx + sin * dy, cos * dy - sin * dx)
    }

    /// How far a point is outside, mm; negative inside.
    pub fn outside_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        let (along, across) = self.along_across(x_mm, y_mm);
        (along.abs() - 0.5 * self.length_mm).max(across.abs() - 0.5 * self.width_mm)
    }

    /// Its corners: X less travel, Y, mm.
    fn corners_mm(&self) -> [[f32; 2]; 4] {
        let (sin, cos) = self.yaw.sin_cos();
        [(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)].map(|(a, b)| {
            let (along, across) = (a * self.length_mm, b * self.width_mm);
            let x_mm = self.x_mm + cos * along - sin * across;
            [x_mm as f32, (self.y_mm + sin * along + cos * across) as f32]
        })
    }

    /// The lowest X less travel that it reaches: its trailing end.
    pub fn trailing_mm(&self) -> f64 {
        self.x_mm - self.reach_mm()
    }

    /// Half of its extent along travel.
    pub fn reach_mm(&self) -> f64 {
        let (sin, cos) = self.yaw.sin_cos();
        0.5 * (self.length_mm * cos.abs() + self.width_mm * sin.abs())
    }

    /// Each side further inside by this, mm; outside if negative.
    #[must_use]
    pub fn shrunk(&self, by_mm: f64) -> Self {
        let shrink = |length_mm: f64| (length_mm - 2.0 * by_mm).max(0.0);
        Self { length_mm: shrink(self.length_mm), width_mm: shrink(self.width_mm), ..*self }
    }

    /// Its front, back, left and right side each further inside by so much, mm; `sides`: share of each that is edge.
    #[must_use]
    pub fn moved_in(&self, by_mm: [f64; 4], sides: [f64; 4]) -> Self {
        let (sin, cos) = self.yaw.sin_cos();
        let [front, back, left, right] = by_mm;
        let (along, across) = (0.5 * (back - front), 0.5 * (right - left));
        Self {
            x_mm: self.x_mm + cos * along - sin * across,
            y_mm: self.y_mm + sin * along + cos * across,
            length_mm: (self.length_mm - front - back).max(0.0),
            width_mm: (self.width_mm - left - right).max(0.0),
            sides,
            ..*self
        }
    }

    /// Share of this rectangle that lies inside another, by a grid of points.
    pub fn share_inside(&self, other: &Self) -> f64 {
        const POINTS: usize = 9;
        let (sin, cos) = self.yaw.sin_cos();
        let at = |i: usize| (i as f64 + 0.5) / POINTS as f64 - 0.5;
        let inside = (0..POINTS * POINTS).filter(|i| {
            let (along, across) = (at(i / POINTS) * self.length_mm, at(i % POINTS) * self.width_mm);
            let x_mm = self.x_mm + cos * along - sin * across;
            let y_mm = self.y_mm + sin * along + cos * across;
            other.outside_mm(x_mm, y_mm) < 0.0
        });
        inside.count() as f64 / (POINTS * POINTS) as f64
    }

    /// Whether most of one lies inside the other.
    pub fn overlaps(&self, other: &Self) -> bool {
        self.share_inside(other).max(other.share_inside(self)) > Self::MOST
    }

    /// Whether most of each lies inside the other.
    pub fn is_same_place(&self, other: &Self) -> bool {
        self.share_inside(other).min(other.share_inside(self)) > Self::MOST
    }

    /// Whether it is a small part of another: a label on a parcel, say.
    pub fn is_detail_of(&self, other: &Self) -> bool {
        self.share_inside(other) > Self::MOST && other.share_inside(self) <= Self::MOST
    }

    /// Share of its border that is edge.
    pub fn support(&self) -> f64 {
        let [front, back, left, right] = self.sides;
        let (length, width) = (self.length_mm, self.width_mm);
        ((front + back) * width + (left + right) * length) / (2.0 * (length + width))
    }
}

/// The search.
pub struct RectangleSearch {
    /// Edge pixels in the turned grid whose step is along u, and along v: 0 none, [`WHOLE`] all views agree;
    /// [`UNSEEN`].
    grid: Block<[u8; 2]>,
    /// Sums down the columns and along the rows: from [`WHOLE`] for an edge to -[`WHOLE`] for none.
    down: Block<i32>,
    along: Block<i32>,
    /// Of each column and each row the largest rise of its sums.
    column_stretch: Block<i32>,
    row_stretch: Block<i32>,
    /// Of each column the lowest of its sums so far.
    lowest: Block<i32>,
}

/// What no view sees, or only beside a thing that stands still, tells nothing.
const UNSEEN: u8 = u8::MAX;

/// The grid of one direction: u along the yaw, v to its left.
struct Turned {
    sin: f32,
    cos: f32,
    origin: [f32; 2],
    columns: usize,
    rows: usize,
    px_mm: f32,
}

impl Turned {
    fn cell(&self, x_mm: f32, y_mm: f32) -> (usize, usize) {
        let u = (self.cos * x_mm + self.sin * y_mm - self.origin[0]) / self.px_mm;
        let v = (self.cos * y_mm - self.sin * x_mm - self.origin[1]) / self.px_mm;
        (u.round().max(0.0) as usize, v.round().max(0.0) as usize)
    }

    fn point(&self, column: f32, row: f32) -> (f32, f32) {
        let (u, v) = (self.origin[0] + column * self.px_mm, self.origin[1] + row * self.px_mm);
        (self.cos * u - self.sin * v, self.sin * u + self.cos * v)
    }
}

/// An edge pixel on which all views agree.
const WHOLE: u8 = 8;

impl RectangleSearch {
    /// Memory for the largest window turned by 45 degrees.
    pub fn plan(zone: &BeltRect, plan: &mut Plan) {
        let n = Self::cells_max(zone);
        plan.add::<[u8; 2]>("rectangle.grid", n, "edge pixels along a direction");
        plan.add::<i32>("rectangle.down", n, "their sums down the columns");
        plan.add::<i32>("rectangle.along", n, "their sums along the rows");
        let side = Self::side_max(zone);
        plan.add::<i32>("rectangle.column_stretch", side, "longest stretch of each column");
        plan.add::<i32>("rectangle.row_stretch", side, "longest stretch of each row");
        plan.add::<i32>("rectangle.lowest", side, "lowest sum of each column");
    }

    /// Columns or rows at most, whatever the direction.
    fn side_max(zone: &BeltRect) -> usize {
        let count = |mm: f64| (mm.min(WINDOW_MAX_MM) / GRID_MM).ceil() as usize;
        let (columns, rows) = (count(WINDOW_MAX_MM), count(zone.y_max_mm - zone.y_min_mm));
        columns + rows + 2 * usize::from(MARGIN)
    }

    fn cells_max(zone: &BeltRect) -> usize {
        let side = Self::side_max(zone);
        side * side / 2 + 10 * side + 49
    }

    /// Nothing searched.
    pub fn new(memory: &mut Memory) -> Result<Self> {
        Ok(Self {
            grid: memory.take("rectangle.grid", [0; 2])?,
            down: memory.take("rectangle.down", 0)?,
            along: memory.take("rectangle.along", 0)?,
            column_stretch: memory.take("rectangle.column_stretch", 0)?,
            row_stretch: memory.take("rectangle.row_stretch", 0)?,
            lowest: memory.take("rectangle.lowest", 0)?,
        })
    }

    /// The best rectangle around a point (X less travel, Y, mm) in each of the most promising directions, best first,
    /// by a stack of coarse pictures.
    pub fn candidates(
        &mut self,
        stack: &Stack,
        inside_mm: [f32; 2],
    ) -> heapless::Vec<Rectangle, DIRECTIONS> {
        let directions = directions(stack, inside_mm).map(|direction| {
            let turned = TURNS_DEG.iter().filter_map(|turn| {
                self.best_at(stack, inside_mm, direction? + turn.to_radians(), None)
            });
            best_of(turned)
        });
        let mut found: heapless::Vec<_, DIRECTIONS> = directions.into_iter().flatten().collect();
        found.sort_unstable_by(|a, b| b.score_mm.total_cmp(&a.score_mm));
        found
    }

    /// The best rectangle around a point and near one that was found in coarse pictures.
    pub fn refined(
        &mut self,
        stack: &Stack,
        inside_mm: [f32; 2],
        coarse: &Rectangle,
    ) -> Option<Rectangle> {
        let turned = FINE_TURNS_DEG.iter().filter_map(|turn| {
            let yaw = coarse.yaw as f32 + turn.to_radians();
            self.best_at(stack, inside_mm, yaw, Some(coarse))
        });
        best_of(turned)
    }

    /// The best rectangle around a point whose direction is known to a degree.
    pub fn near(&mut self, stack: &Stack, inside_mm: [f32; 2], yaw: f32) -> Option<Rectangle> {
        let turned = NEAR_TURNS_DEG
            .into_iter()
            .filter_map(|turn| self.best_at(stack, inside_mm, yaw + turn.to_radians(), None));
        best_of(turned)
    }

    /// The best rectangle of one direction; `around`: not far from this one.
    fn best_at(
        &mut self,
        stack: &Stack,
        inside_mm: [f32; 2],
        yaw: f32,
        around: Option<&Rectangle>,
    ) -> Option<Rectangle> {
        let turned = self.turn(stack, yaw, around)?;
        self.sum_up(&turned);
        let (columns, rows) = (turned.columns, turned.rows);
        let (column, row) = turned.cell(inside_mm[0], inside_mm[1]);
        let (mut left, mut right) = ([0usize; LINES], [0usize; LINES]);
        let (mut low, mut high) = ([0usize; LINES], [0usize; LINES]);
        let down = |c: usize, r: usize| self.down[r * columns + c];
        let along = |c: usize, r: usize| self.along[r * columns + c];
        let stretch_down = |c: usize| self.column_stretch[c];
        let stretch_along = |r: usize| self.row_stretch[r];
        let lefts = lines(0..column.min(columns), stretch_down, &mut left);
        let rights = lines(column + 1..columns, stretch_down, &mut right);
        let lows = lines(0..row.min(rows), stretch_along, &mut low);
        let highs = lines(row + 1..rows, stretch_along, &mut high);
        let side_min_px = (SIDE_MIN_MM / f64::from(turned.px_mm)) as usize;
        let mut best: Option<(i32, [usize; 4])> = None;
        for &l in lefts {
            for &r in rights {
                if r - l < side_min_px {
                    continue;
                }
                for &b in lows {
                    let base = along(r, b) - along(l, b);
                    for &t in highs {
                        if t - b < side_min_px {
                            continue;
                        }
                        let score = base + along(r, t) - along(l, t) + down(l, t) - down(l, b)
                            + down(r, t)
                            - down(r, b);
                        if best.is_none_or(|(most, _)| score > most) {
                            best = Some((score, [l, r, b, t]));
                        }
                    }
                }
            }
        }
        let (score, [l, r, b, t]) = best.filter(|(score, _)| *score > 0)?;
        Some(self.rectangle(&turned, yaw, score, [l, r, b, t]))
    }

    fn rectangle(
        &self,
        turned: &Turned,
        yaw: f32,
        score: i32,
        [l, r, b, t]: [usize; 4],
    ) -> Rectangle {
        let (x, y) = turned.point(0.5 * (l + r) as f32, 0.5 * (b + t) as f32);
        let px_mm = f64::from(turned.px_mm);
        let cell = |column: usize, row: usize| self.grid[row * turned.columns + column];
        Rectangle {
            x_mm: f64::from(x),
            y_mm: f64::from(y),
            yaw: f64::from(yaw),
            length_mm: (r - l) as f64 * px_mm,
            width_mm: (t - b) as f64 * px_mm,
            score_mm: f64::from(score) * px_mm / f64::from(WHOLE),
            sides: [
                share((b + 1..=t).map(|row| cell(r, row)[0])),
                share((b + 1..=t).map(|row| cell(l, row)[0])),
                share((l + 1..=r).map(|column| cell(column, t)[1])),
                share((l + 1..=r).map(|column| cell(column, b)[1])),
            ],
        }
    }

    /// For each side the best rectangle whose side is further inside, if it is nearly as well explained:
    /// of two lines one may be a shadow's, and the fit must tell.
    pub fn narrower(&mut self, stack: &Stack, outer: &Rectangle) -> [Option<Rectangle>; 4] {
        let yaw = outer.yaw as f32;
        let Some(turned) = self.turn(stack, yaw, None) else { return [None; 4] };
        let px_mm = f64::from(turned.px_mm);
        let (column, row) = turned.cell(outer.x_mm as f32, outer.y_mm as f32);
        let half = |length_mm: f64| (0.5 * length_mm / px_mm).round() as usize;
        let (du, dv) = (half(outer.length_mm), half(outer.width_mm));
        if column < du || row < dv || column + du >= turned.columns || row + dv >= turned.rows {
            return [None; 4];
        }
        let whole = [column - du, column + du, row - dv, row + dv];
        let least_px = (APART_MM / px_mm).ceil() as usize;
        std::array::from_fn(|side| {
            let most_px = (NARROWER_SHARE * 2.0 * [du, dv][side / 2] as f64) as usize;
            let rectangles = (least_px..=most_px).map(|by| {
                let mut lines = whole;
                if side % 2 == 0 {
                    lines[side] += by;
                } else {
                    lines[side] -= by;
                }
                self.rectangle(&turned, yaw, 0, lines)
            });
            let best = rectangles.max_by(|a, b| a.support().total_cmp(&b.support()))?;
            let which = [1, 0, 3, 2][side];
            (best.sides[which] > NEARLY * outer.sides[which]).then_some(best)
        })
    }

    /// The edge pixels in a grid turned by `yaw`, each as wide as two pixels across its side; `around`: of this
    /// rectangle's surroundings alone.
    fn turn(&mut self, stack: &Stack, yaw: f32, around: Option<&Rectangle>) -> Option<Turned> {
        let (sin, cos) = yaw.sin_cos();
        let px_mm = grid_mm(stack);
        let along_across = |[x, y]: [f32; 2]| [cos * x + sin * y, cos * y - sin * x];
        let [low, high] = match around {
            None => extent(stack.edges().iter().map(|edge| along_across(edge.at_mm)))?,
            Some(rectangle) => {
                let margin = CROP_MM as f32;
                let [low, high] = extent(rectangle.corners_mm().map(along_across).into_iter())?;
                [low.map(|mm| mm - margin), high.map(|mm| mm + margin)]
            }
        };
        let margin = f32::from(MARGIN);
        let count = |k: usize| ((high[k] - low[k]) / px_mm + 2.0 * margin + 1.0) as usize;
        let origin = low.map(|low| low - margin * px_mm);
        let turned = Turned { sin, cos, origin, columns: count(0), rows: count(1), px_mm };
        let (columns, rows) = (turned.columns, turned.rows);
        if columns * rows > self.grid.len() || columns.max(rows) > self.row_stretch.len() {
            return None;
        }
        let seen = stack.seen();
        for (row, line) in self.grid[..columns * rows].chunks_exact_mut(columns).enumerate() {
            let from = turned.point(0.0, row as f32);
            let step = [cos * px_mm, sin * px_mm];
            for (column, cell) in line.iter_mut().enumerate() {
                let x = from.0 + column as f32 * step[0];
                let y = from.1 + column as f32 * step[1];
                *cell = [if seen.at(x, y) { 0 } else { UNSEEN }; 2];
            }
        }
        // A pixel to each side, too: turned pixels leave holes.
        let grid = &mut self.grid[..columns * rows];
        for edge in stack.edges() {
            let [along, across] = along_across(edge.at_mm);
            let [u, v] = [(along - origin[0]) / px_mm + 0.5, (across - origin[1]) / px_mm + 0.5];
            let inside = u >= margin && v >= margin;
            if !inside || u >= columns as f32 - margin || v >= rows as f32 - margin {
                continue;
            }
            let steps = along_across(edge.step);
            let value = (edge.agreement * f32::from(WHOLE)).round() as u8;
            for k in (0..2).filter(|&k| steps[k].abs() > ACROSS_MIN) {
                let cells = [(u, v), (u - 1.0, v), (u + 1.0, v), (u, v - 1.0), (u, v + 1.0)];
                for (u, v) in cells {
                    let cell = &mut grid[v as usize * columns + u as usize][k];
                    *cell = if *cell == UNSEEN { UNSEEN } else { value.max(*cell) };
                }
            }
        }
        Some(turned)
    }

    fn sum_up(&mut self, turned: &Turned) {
        let (columns, rows) = (turned.columns, turned.rows);
        let grid = &self.grid[..columns * rows];
        let (down, along) = (&mut self.down[..columns * rows], &mut self.along[..columns * rows]);
        let (lowest, most) = (&mut self.lowest[..columns], &mut self.column_stretch[..columns]);
        lowest.fill(0);
        most.fill(0);
        for row in 0..rows {
            let here = row * columns..(row + 1) * columns;
            let mut rise = Rise::default();
            for (cell, sum) in grid[here.clone()].iter().zip(&mut along[here.clone()]) {
                *sum = rise.add(worth(cell[1]));
            }
            self.row_stretch[row] = rise.most;
            let (before, down) = down.split_at_mut(here.start);
            let above = before.len().checked_sub(columns).map(|from| &before[from..]);
            for (column, cell) in grid[here].iter().enumerate() {
                let sum = above.map_or(0, |above| above[column]) + worth(cell[0]);
                down[column] = sum;
                most[column] = most[column].max(sum - lowest[column]);
                lowest[column] = lowest[column].min(sum);
            }
        }
    }
}

/// What a cell counts for: from [`WHOLE`] for an edge to -[`WHOLE`] for none.
fn worth(edge: u8) -> i32 {
    if edge == UNSEEN { 0 } else { 2 * i32::from(edge) - i32::from(WHOLE) }
}

/// A running sum, and its largest rise.
#[derive(Default)]
struct Rise {
    sum: i32,
    lowest: i32,
    most: i32,
}

impl Rise {
    fn add(&mut self, value: i32) -> i32 {
        self.sum += value;
        self.most = self.most.max(self.sum - self.lowest);
        self.lowest = self.lowest.min(self.sum);
        self.sum
    }
}

/// The lowest and the highest coordinates of points.
fn extent(points: impl Iterator<Item = [f32; 2]>) -> Option<[[f32; 2]; 2]> {
    points.fold(None, |extent, point| {
        let [low, high] = extent.unwrap_or([point; 2]);
        Some([
            std::array::from_fn(|k| low[k].min(point[k])),
            std::array::from_fn(|k| high[k].max(point[k])),
        ])
    })
}

fn best_of(rectangles: impl Iterator<Item = Rectangle>) -> Option<Rectangle> {
    rectangles.max_by(|a, b| a.score_mm.total_cmp(&b.score_mm))
}

/// Side of the grid's cells, mm: [`GRID_MM`], or a pixel of the stack.
fn grid_mm(stack: &Stack) -> f32 {
    stack.px_mm().max(GRID_MM) as f32
}

/// Pixels around the edges in the turned grid.
const MARGIN: u8 = 3;

/// Directions of the sides, radians, that most edges around a point have.
fn directions(stack: &Stack, inside_mm: [f32; 2]) -> [Option<f32>; DIRECTIONS] {
    let mut counts = [0.0f32; BINS];
    for edge in stack.edges() {
        let [dx, dy] = [edge.at_mm[0] - inside_mm[0], edge.at_mm[1] - inside_mm[1]];
        let distance = (dx * dx + dy * dy) / (DIRECTION_REACH_MM * DIRECTION_REACH_MM);
        let degrees = edge.step[1].atan2(edge.step[0]).to_degrees().rem_euclid(90.0);
        counts[(2.0 * degrees) as usize % BINS] +=
            edge.strength.min(STRENGTH_MAX) * (-0.5 * distance).exp();
    }
    let smooth: [f32; BINS] = std::array::from_fn(|i| {
        (0..9).map(|d| SMOOTH[d] * counts[(i + BINS + d - 4) % BINS]).sum()
    });
    let mut found = [None; DIRECTIONS];
    let mut taken = [false; BINS];
    for direction in &mut found {
        let free = (0..BINS).filter(|&i| !taken[i] && smooth[i] > 0.0);
        let Some(best) = free.max_by(|&a, &b| smooth[a].total_cmp(&smooth[b])) else { break };
        for d in 0..=2 * DIRECTIONS_APART {
            taken[(best + BINS + d - DIRECTIONS_APART) % BINS] = true;
        }
        *direction = Some((0.5 * best as f32 + 0.25).to_radians());
    }
    found
}

/// A Gaussian of two bins.
const SMOOTH: [f32; 9] = [0.03, 0.07, 0.12, 0.18, 0.2, 0.18, 0.12, 0.07, 0.03];

/// Share of a side that is edge; of what is seen, if half of it is.
fn share(side: impl Iterator<Item = u8>) -> f64 {
    let (mut edge, mut seen, mut all) = (0u32, 0u32, 0u32);
    for value in side {
        all += 1;
        if value != UNSEEN {
            seen += 1;
            edge += u32::from(value);
        }
    }
    f64::from(edge) / f64::from((u32::from(WHOLE) * seen.max(all / 2)).max(1))
}

/// The lines of longest stretches, no two side by side; as many as there is room for.
fn lines(
    places: std::ops::Range<usize>,
    stretch: impl Fn(usize) -> i32,
    found: &mut [usize; LINES],
) -> &[usize] {
    let mut stretches = [0i32; LINES];
    let mut count = 0;
    let mut run: Option<(usize, usize, i32)> = None;
    let mut keep = |place: usize, stretch: i32| {
        let at = stretches[..count].iter().position(|&s| s < stretch).unwrap_or(count);
        if at == LINES {
            return;
        }
        count = (count + 1).min(LINES);
        stretches.copy_within(at..count - 1, at + 1);
        found.copy_within(at..count - 1, at + 1);
        (stretches[at], found[at]) = (stretch, place);
    };
    // Local maxima; of a plateau its middle.
    let mut before = 0;
    for place in places.clone() {
        let here = stretch(place);
        if here > before {
            run = Some((place, place, here));
        } else if here == before {
            run = run.map(|(from, _, s)| (from, place, s));
        } else if let Some((from, to, s)) = run.take() {
            keep(usize::midpoint(from, to), s);
        }
        before = here;
    }
    if let Some((from, to, s)) = run {
        keep(usize::midpoint(from, to), s);
    }
    let enough =
        stretches[..count].iter().take_while(|&&s| s >= STRETCH_MIN_PX * i32::from(WHOLE)).count();
    &found[..enough]
}
