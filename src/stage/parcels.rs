//! Which cells of the scroll are one parcel's top face.
//!
//! In: the decided part of the scroll. Out: upright rectangles at a height, best first. A top face is
//! flat, so its border and whatever is printed on it lie in one plane; what is higher or lower is
//! something else. In each trial plane, neighbouring cells of that height make a piece; pieces are joined when the
//! rectangle around both is better supported than each alone. A border along the travel looks
//! the same at every height: it supports a rectangle and begins none.
//! Coarse by nature: sizes are good to two or three cells. The fit on edges begins from here.

use super::evidence::{Cell, Evidence};

/// Trial planes are this far apart, mm.
const PLANE_STEP_MM: f32 = 3.0;
/// A cell belongs to a plane that is this near, mm.
const TOLERANCE_MM: f32 = 6.0;
/// Lower than this is the belt, mm: cells of the belt scatter by 1 mm.
const HEIGHT_MIN_MM: f32 = 2.4;
/// A cell whose possible heights span more than this, mm, tells none.
const NARROW_MM: f32 = 40.0;
/// Cells of one piece are at most this far apart, cells.
const GAP: i32 = 2;
/// A piece of fewer cells is an accident.
const PIECE_CELLS_MIN: usize = 12;
/// Blur of lines by the cells' filters: a rectangle around cells is wider by this, cells.
const BLUR_CELLS: f32 = 3.0;
/// A border's cells reach beyond it by this, cells: its rectangle is wider than the face on every side.
const BORDER_CELLS: f32 = 2.0;
/// The shorter side of a face, cells: lines are no faces.
const SIDE_MIN_CELLS: f32 = 5.0;
/// Of a rectangle's border this share must be seen for pieces to be joined, ...
const JOIN_SUPPORT: f32 = 0.85;
/// ... and for it to be a face at all.
const FACE_SUPPORT: f32 = 0.6;
/// Pieces further apart than this, mm, are not joined.
const JOIN_REACH_MM: f32 = 600.0;
/// A cell of the border seen at the height, at one of its possible heights, not at all, elsewhere.
const BORDER_VALUE: [f32; 4] = [1.0, 0.7, -0.5, -1.0];
/// The cells inside count this much less than those of the border.
const INSIDE_WEIGHT: f32 = 0.15;
/// A face with a lower score is an accident.
const SCORE_MIN: f32 = 20.0;
/// Cells this far around a face are its own: its sides.
const SIDE_CELLS: f32 = 3.0;

/// A rectangle in the scroll, in cells: columns against travel, rows to the right.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Rectangle {
    column: f32,
    row: f32,
    length: f32,
    width: f32,
    yaw: f32,
}

/// A parcel's top face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Middle, belt-fixed: X less the belt's travel, mm.
    pub x_less_travel_mm: f64,
    /// Middle across the belt, mm.
    pub y_mm: f64,
    /// Direction of the length against +X, radians.
    pub yaw: f64,
    /// Along the yaw, mm.
    pub length_mm: f64,
    /// Across it, mm.
    pub width_mm: f64,
    /// Over the belt, mm.
    pub height_mm: f64,
    /// Share of its border that is seen at its height.
    pub support: f64,
    /// Cells that are seen at its height.
    pub cells: usize,
}

/// What a cell says of a plane.
#[derive(Clone, Copy, PartialEq)]
enum Says {
    Here,
    MayBe,
    Nothing,
    Elsewhere,
}

/// Cells that may be one face.
#[derive(Clone)]
struct Piece {
    rectangle: Rectangle,
    members: Vec<usize>,
    score: f32,
}

/// The undecided part of the scroll.
pub struct Parcels {
    /// First column that is looked at, and its cells and whether they are free.
    first: i64,
    cells: Vec<Cell>,
    free: Vec<bool>,
    /// Cells that may begin a piece.
    beginning: Vec<usize>,
    rows: usize,
    cell_mm: f32,
    height_max_mm: f32,
}

impl Parcels {
    /// Nothing seen.
    pub fn new(evidence: &Evidence, height_max_mm: f64) -> Self {
        Self {
            first: 0,
            cells: Vec::new(),
            free: Vec::new(),
            beginning: Vec::new(),
            rows: evidence.rows(),
            cell_mm: evidence.side_mm() as f32,
            height_max_mm: height_max_mm as f32,
        }
    }

    /// The faces whose trailing end has passed `end_mm`, belt-fixed.
    pub fn passed(&mut self, evidence: &Evidence, end_mm: f64) -> Vec<Face> {
        self.take_columns(evidence);
        let mut faces = Vec::new();
        let count = ((self.height_max_mm - HEIGHT_MIN_MM) / PLANE_STEP_MM) as usize;
        let height = |k: usize| HEIGHT_MIN_MM + 1.0 + PLANE_STEP_MM * k as f32;
        let kept_free = self.free.clone();
        self.beginning.clear();
        let begins = |i: &usize| self.may_begin(*i);
        self.beginning = (0..self.cells.len()).filter(begins).collect();
        let mut waiting = Vec::new();
        let mut planes: Vec<Vec<Piece>> = (0..count).map(|k| self.pieces(height(k))).collect();
        loop {
            let best = planes.iter().flatten().max_by(|a, b| a.score.total_cmp(&b.score));
            let Some(best) = best.filter(|best| best.score >= SCORE_MIN).cloned() else { break };
            let height_mm = self.height_of(&best.members);
            let (rectangle, support) = self.refined(best.rectangle, height_mm);
            let taken = self.take(&rectangle, &best.members);
            if evidence.column_mm(self.first + rectangle.end_column()) < end_mm {
                // Not yet whole: it keeps its cells, and nobody else gets them.
                waiting.extend(taken);
            } else if support >= FACE_SUPPORT
                && rectangle.length.min(rectangle.width) >= SIDE_MIN_CELLS
            {
                faces.push(self.face(evidence, &rectangle, height_mm, support, best.members.len()));
            }
            for (k, pieces) in planes.iter_mut().enumerate() {
                if pieces.iter().any(|p| p.members.iter().any(|&i| !self.free[i])) {
                    *pieces = self.pieces(height(k));
                }
            }
        }
        for i in waiting {
            self.free[i] = kept_free[i];
        }
        faces
    }

    /// Columns decided since the last time; old ones go.
    fn take_columns(&mut self, evidence: &Evidence) {
        let decided = evidence.decided();
        if decided.start > self.first {
            let gone = ((decided.start - self.first) as usize * self.rows).min(self.cells.len());
            self.cells.drain(..gone);
            self.free.drain(..gone);
            self.first = decided.start;
        }
        let known = self.first + (self.cells.len() / self.rows) as i64;
        for column in known..decided.end {
            self.cells.extend(evidence.column(column));
            self.free.extend(evidence.column(column).iter().map(|cell| cell.strength > 0.0));
        }
    }

    fn face(
        &self,
        evidence: &Evidence,
        rectangle: &Rectangle,
        height_mm: f32,
        support: f32,
        cells: usize,
    ) -> Face {
        let cell_mm = f64::from(self.cell_mm);
        Face {
            x_less_travel_mm: evidence.column_mm(self.first)
                - f64::from(rectangle.column) * cell_mm,
            y_mm: evidence.row_mm(0) - f64::from(rectangle.row) * cell_mm,
            yaw: f64::from(rectangle.yaw),
            length_mm: f64::from(rectangle.length - 2.0 * BORDER_CELLS) * cell_mm,
            width_mm: f64::from(rectangle.width - 2.0 * BORDER_CELLS) * cell_mm,
            height_mm: f64::from(height_mm),
            support: f64::from(support),
            cells,
        }
    }

    fn height_of(&self, members: &[usize]) -> f32 {
        let mut heights: Vec<f32> = members.iter().map(|&i| self.cells[i].height_mm).collect();
        heights.sort_by(f32::total_cmp);
        heights[heights.len() / 2]
    }

    fn is_narrow(cell: &Cell) -> bool {
        cell.possible_mm[1] - cell.possible_mm[0] < NARROW_MM
    }

    fn may_begin(&self, i: usize) -> bool {
        let cell = &self.cells[i];
        self.free[i]
            && cell.height_mm > HEIGHT_MIN_MM
            && Self::is_narrow(cell)
            && cell.possible_mm[1] < self.height_max_mm
    }

    fn begins(&self, i: usize, height_mm: f32) -> bool {
        (self.cells[i].height_mm - height_mm).abs() <= TOLERANCE_MM && self.may_begin(i)
    }

    fn says(&self, column: f32, row: f32, height_mm: f32) -> Option<Says> {
        let (column, row) = (column.round(), row.round());
        let columns = self.cells.len() / self.rows;
        let inside =
            column >= 0.0 && row >= 0.0 && column < columns as f32 && row < self.rows as f32;
        if !inside {
            return None;
        }
        let i = column as usize * self.rows + row as usize;
        let cell = &self.cells[i];
        let narrow = Self::is_narrow(cell);
        Some(if cell.strength <= 0.0 || !self.free[i] {
            Says::Nothing
        } else if narrow && cell.height_mm < HEIGHT_MIN_MM {
            Says::Elsewhere
        } else if narrow && (cell.height_mm - height_mm).abs() <= TOLERANCE_MM {
            Says::Here
        } else if (cell.possible_mm[0] - 1.0..=cell.possible_mm[1] + 1.0).contains(&height_mm) {
            Says::MayBe
        } else {
            Says::Elsewhere
        })
    }

    /// Pieces of a plane, joined as far as it pays.
    fn pieces(&self, height_mm: f32) -> Vec<Piece> {
        let mut pieces: Vec<Piece> = Vec::new();
        let begins = |i: &&usize| self.begins(**i, height_mm);
        if self.beginning.iter().filter(begins).count() < PIECE_CELLS_MIN {
            return pieces;
        }
        let mut seen = vec![false; self.cells.len()];
        for &start in &self.beginning {
            if seen[start] || !self.begins(start, height_mm) {
                continue;
            }
            let members = self.connected(start, height_mm, &mut seen);
            if members.len() >= PIECE_CELLS_MIN {
                pieces.push(self.enclosing(members, height_mm).0);
            }
        }
        while let Some((a, b, joined)) = self.best_join(&pieces, height_mm) {
            pieces.swap_remove(b);
            pieces.swap_remove(a);
            pieces.push(joined);
        }
        pieces
    }

    fn connected(&self, start: usize, height_mm: f32, seen: &mut [bool]) -> Vec<usize> {
        let columns = (self.cells.len() / self.rows) as i32;
        let mut members = vec![start];
        seen[start] = true;
        let mut next = 0;
        while next < members.len() {
            let (column, row) =
                ((members[next] / self.rows) as i32, (members[next] % self.rows) as i32);
            next += 1;
            for c in (column - GAP).max(0)..=(column + GAP).min(columns - 1) {
                for r in (row - GAP).max(0)..=(row + GAP).min(self.rows as i32 - 1) {
                    let i = c as usize * self.rows + r as usize;
                    if !seen[i] && self.begins(i, height_mm) {
                        seen[i] = true;
                        members.push(i);
                    }
                }
            }
        }
        members
    }

    /// The two pieces whose rectangle is better than both.
    fn best_join(&self, pieces: &[Piece], height_mm: f32) -> Option<(usize, usize, Piece)> {
        let mut best: Option<(usize, usize, Piece)> = None;
        for (a, one) in pieces.iter().enumerate() {
            for (b, other) in pieces.iter().enumerate().skip(a + 1) {
                let (x, y) = (one.rectangle, other.rectangle);
                if (x.column - y.column).hypot(x.row - y.row) * self.cell_mm > JOIN_REACH_MM {
                    continue;
                }
                let members = one.members.iter().chain(&other.members).copied().collect();
                let (joined, support) = self.enclosing(members, height_mm);
                let pays = joined.score > one.score.max(0.0) + other.score.max(0.0);
                let better = best.as_ref().is_none_or(|(_, _, best)| joined.score > best.score);
                if support >= JOIN_SUPPORT && pays && better {
                    best = Some((a, b, joined));
                }
            }
        }
        best
    }

    /// The rectangle of least area around cells, and its border's support.
    fn enclosing(&self, members: Vec<usize>, height_mm: f32) -> (Piece, f32) {
        let points = || members.iter().map(|&i| ((i / self.rows) as f32, (i % self.rows) as f32));
        let mut rectangle = Rectangle::around(points);
        rectangle.length -= BLUR_CELLS;
        rectangle.width -= BLUR_CELLS;
        let (score, support) = if rectangle.length.min(rectangle.width) < SIDE_MIN_CELLS {
            (0.0, 0.0)
        } else {
            self.score(&rectangle, height_mm)
        };
        (Piece { rectangle, members, score }, support)
    }

    /// Score of a rectangle at a height, and the share of its border that is seen there.
    fn score(&self, rectangle: &Rectangle, height_mm: f32) -> (f32, f32) {
        let (mut border, mut seen, mut all) = (0.0f32, 0.0f32, 0.0f32);
        for side in 0..4 {
            let along = if side % 2 == 0 { rectangle.width } else { rectangle.length };
            let n = (along.ceil() as usize).max(2);
            for i in 0..n {
                let t = ((i as f32 + 0.5) / n as f32 - 0.5) * along;
                // A border is two cells wide.
                let value = [0.0, -1.0, 1.0].into_iter().fold(-1.0f32, |best, outward| {
                    let (column, row) = rectangle.border(side, t, outward);
                    let says = self.says(column, row, height_mm);
                    let value = says.map_or(0.0, |says| BORDER_VALUE[says as usize]);
                    best.max(if outward == 0.0 { value } else { 0.9 * value })
                });
                border += value;
                seen += f32::from(value > 0.5);
                all += 1.0;
            }
        }
        // Every second cell inside, both ways.
        let [length, width] = [rectangle.length, rectangle.width].map(|s| (s / 2.0) as i32);
        let mut inside = 0.0;
        for i in 0..length {
            for j in 0..width {
                let share = |i: i32, n: i32| (i as f32 + 0.5) / n as f32 - 0.5;
                let (column, row) = rectangle
                    .point(share(i, length) * rectangle.length, share(j, width) * rectangle.width);
                inside += match self.says(column, row, height_mm) {
                    Some(Says::Here) => 4.0,
                    Some(Says::Elsewhere) => -4.0,
                    _ => 0.0,
                };
            }
        }
        (border + INSIDE_WEIGHT * inside, seen / all)
    }

    /// Sides and yaw moved a little to where the score is best.
    fn refined(&self, start: Rectangle, height_mm: f32) -> (Rectangle, f32) {
        let mut rectangle = start;
        let (mut score, mut support) = self.score(&rectangle, height_mm);
        for _ in 0..3 {
            for side in 0..4 {
                let (mut top, mut from, mut to) = (score, 0.0, 0.0);
                for half in -8..=6 {
                    let by = 0.5 * half as f32;
                    let here = self.score(&rectangle.moved(side, by), height_mm).0;
                    if here > top + 0.01 {
                        (top, from, to) = (here, by, by);
                    } else if here >= top - 0.01 && by <= to + 0.5 {
                        to = by;
                    }
                }
                rectangle = rectangle.moved(side, 0.5 * (from + to));
                (score, support) = self.score(&rectangle, height_mm);
            }
            for turn in [-0.025f32, -0.012, 0.012, 0.025] {
                let turned = Rectangle { yaw: rectangle.yaw + turn, ..rectangle };
                let here = self.score(&turned, height_mm);
                if here.0 > score {
                    (rectangle, score, support) = (turned, here.0, here.1);
                }
            }
        }
        (rectangle, support)
    }

    /// A face's cells, its members and its sides', are free no more. Returns which were.
    fn take(&mut self, rectangle: &Rectangle, members: &[usize]) -> Vec<usize> {
        let mut taken = Vec::new();
        let (sin, cos) = rectangle.yaw.sin_cos();
        for i in 0..self.cells.len() {
            let (dc, dr) =
                ((i / self.rows) as f32 - rectangle.column, (i % self.rows) as f32 - rectangle.row);
            let along = (cos * dc + sin * dr).abs() - 0.5 * rectangle.length;
            let across = (cos * dr - sin * dc).abs() - 0.5 * rectangle.width;
            if self.free[i] && along.max(across) <= SIDE_CELLS {
                taken.push(i);
            }
        }
        taken.extend(members.iter().filter(|&&i| self.free[i]));
        for &i in &taken {
            self.free[i] = false;
        }
        taken
    }
}

impl Rectangle {
    /// The one of least area around points.
    fn around<I: Iterator<Item = (f32, f32)>>(points: impl Fn() -> I) -> Self {
        const TURNS: usize = 45;
        let extent = |yaw: f32| {
            let (sin, cos) = yaw.sin_cos();
            let start = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
            points().fold(start, |[a, b, c, d], (x, y)| {
                let (u, v) = (cos * x + sin * y, cos * y - sin * x);
                [a.min(u), b.max(u), c.min(v), d.max(v)]
            })
        };
        let area = |[a, b, c, d]: [f32; 4]| (b - a + 1.0) * (d - c + 1.0);
        let yaws = (0..TURNS).map(|k| k as f32 * std::f32::consts::FRAC_PI_2 / TURNS as f32);
        let best = yaws.min_by(|&x, &y| area(extent(x)).total_cmp(&area(extent(y))));
        let yaw = best.unwrap_or(0.0);
        let [a, b, c, d] = extent(yaw);
        let (sin, cos) = yaw.sin_cos();
        let (u, v) = (0.5 * (a + b), 0.5 * (c + d));
        Self { column: cos * u - sin * v, row: sin * u + cos * v, length: b - a, width: d - c, yaw }
    }

    fn point(&self, along: f32, across: f32) -> (f32, f32) {
        let (sin, cos) = self.yaw.sin_cos();
        (self.column + cos * along - sin * across, self.row + sin * along + cos * across)
    }

    /// A point of a side, `t` cells from its middle, `outward` cells outside of it.
    fn border(&self, side: usize, t: f32, outward: f32) -> (f32, f32) {
        let (length, width) = (0.5 * self.length + outward, 0.5 * self.width + outward);
        match side {
            0 => self.point(length, t),
            1 => self.point(t, width),
            2 => self.point(-length, t),
            _ => self.point(t, -width),
        }
    }

    /// With one side moved outward.
    fn moved(&self, side: usize, by: f32) -> Self {
        let half = if side < 2 { 0.5 * by } else { -0.5 * by };
        let along_length = side.is_multiple_of(2);
        let (column, row) =
            if along_length { self.point(half, 0.0) } else { self.point(0.0, half) };
        let (length, width) = if along_length { (by, 0.0) } else { (0.0, by) };
        Self { column, row, length: self.length + length, width: self.width + width, yaw: self.yaw }
    }

    /// The last column that it reaches.
    fn end_column(&self) -> i64 {
        let (sin, cos) = self.yaw.sin_cos();
        let reach = 0.5 * (self.length * cos.abs() + self.width * sin.abs());
        (self.column + reach).ceil() as i64
    }
}
