//! From saddle points to a grid: neighbours are where the edges lead.
//!
//! A neighbour lies along an edge, has the same edge with bright and dark exchanged, and the
//! edge can be followed all the way. Nothing about the whole board is assumed, so strong
//! perspective and distortion do no harm.

use super::grey::Grey;
use super::saddle::Saddle;
use nalgebra::Vector2;
use std::collections::{HashMap, VecDeque};

/// Cosine of the largest angle between an edge and the way to the neighbour: 25 degrees.
const ALONG_COS_MIN: f64 = 0.906;
/// A predicted neighbour may be off by this part of the step.
const PREDICTION_ERROR_MAX: f64 = 0.35;
/// Along an edge the contrast may fall to this part of its mean.
const EDGE_CONTRAST_MIN: f64 = 0.25;
/// Fainter edges, grey levels, are noise.
const EDGE_GREY_MIN: f64 = 1.5;
/// Contrast and sharpness change slowly over a board: a neighbour has this part of the strength.
const STRENGTH_RATIO_MIN: f32 = 0.35;
/// And this part of the strongest: what lies around a board is smoother.
const SEED_RATIO_MIN: f32 = 0.03;
/// Grids are grown from this many saddles, the strongest that no grid holds yet.
const SEEDS_MAX: usize = 300;

/// A corner's place in a grid: column, row.
pub(super) type Cell = (i32, i32);

/// Place of saddles in a grid that was grown.
pub(super) type Grid = HashMap<Cell, Vector2<f64>>;

const NEIGHBOURS: [Cell; 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// The grids that hold at least `corners_min` saddles, those of about `corners_wanted` first; the
/// search ends with one of exactly so many.
pub(super) fn grids(
    smooth: &Grey,
    saddles: &[Saddle],
    corners_min: usize,
    corners_wanted: usize,
) -> Vec<Grid> {
    let mut in_grid = vec![false; saddles.len()];
    let mut grids = Vec::new();
    let mut seeds = 0;
    for seed in 0..saddles.len() {
        if in_grid[seed] || seeds == SEEDS_MAX {
            continue;
        }
        seeds += 1;
        let cells = grow(smooth, saddles, seed, in_grid.clone());
        // A lone saddle may still belong to the grid of another seed.
        if cells.len() >= 4 {
            for &s in cells.values() {
                in_grid[s] = true;
            }
        }
        let size = cells.len();
        if size >= corners_min {
            grids.push(cells.into_iter().map(|(cell, s)| (cell, saddles[s].at)).collect());
        }
        if size == corners_wanted {
            break;
        }
    }
    grids.sort_by_key(|g: &Grid| g.len().abs_diff(corners_wanted));
    grids
}

/// Breadth-first from `seed`; a saddle is used once, a cell is filled once.
fn grow(
    smooth: &Grey,
    saddles: &[Saddle],
    seed: usize,
    mut used: Vec<bool>,
) -> HashMap<Cell, usize> {
    let mut cells = HashMap::from([((0, 0), seed)]);
    let strength_min = SEED_RATIO_MIN * saddles[seed].strength;
    for (used, saddle) in used.iter_mut().zip(saddles) {
        *used |= saddle.strength < strength_min;
    }
    used[seed] = true;
    let mut queue = VecDeque::from([(0, 0)]);
    while let Some(cell) = queue.pop_front() {
        let own = cells[&cell];
        for step in NEIGHBOURS {
            let next = (cell.0 + step.0, cell.1 + step.1);
            if cells.contains_key(&next) {
                continue;
            }
            let towards = direction(saddles, &cells, cell, step);
            let predicted = predicted(saddles, &cells, cell, step);
            if let Some(found) = neighbour(smooth, saddles, own, towards, predicted, &used) {
                used[found] = true;
                cells.insert(next, found);
                queue.push_back(next);
            }
        }
    }
    cells
}

/// The direction of the edge that leads from `cell` along `step`: the saddle's edge nearest to
/// where a known neighbour says, or at the seed its first edge as columns, its second as rows.
fn direction(
    saddles: &[Saddle],
    cells: &HashMap<Cell, usize>,
    cell: Cell,
    step: Cell,
) -> Vector2<f64> {
    let own = &saddles[cells[&cell]];
    let [first, second] = own.edges.map(|e| e.along);
    // Columns and rows turn clockwise in the image, whose y points down.
    let second = second * first.perp(&second).signum();
    let (forward, sense) = (step.0.abs() == 1, f64::from(step.0 + step.1));
    let known =
        |from: Cell, to: Cell| Some(saddles[*cells.get(&to)?].at - saddles[*cells.get(&from)?].at);
    let (x, y) = cell;
    // Known links of this cell, as column direction when along columns, else turned.
    let along = |a: Cell, b: Cell| known(cell, a).or_else(|| known(b, cell));
    let columns = along((x + 1, y), (x - 1, y));
    let rows = along((x, y + 1), (x, y - 1));
    let nearest = |to: Vector2<f64>| {
        let edges = [first, second];
        let best = usize::from(edges[1].dot(&to).abs() > edges[0].dot(&to).abs());
        (best, edges[best] * edges[best].dot(&to).signum())
    };
    let (column_edge, row_edge) = match (columns, rows) {
        (Some(to), _) => {
            let (best, column) = nearest(to);
            let other = [second, first][best];
            (column, other * column.perp(&other).signum())
        }
        (None, Some(to)) => {
            let (best, row) = nearest(to);
            let other = [second, first][best];
            (other * other.perp(&row).signum(), row)
        }
        (None, None) => (first, second),
    };
    sense * if forward { column_edge } else { row_edge }
}

/// Where the neighbour should be, and how long the step is, from cells already known.
fn predicted(
    saddles: &[Saddle],
    cells: &HashMap<Cell, usize>,
    (x, y): Cell,
    (dx, dy): Cell,
) -> Option<(Vector2<f64>, f64)> {
    let at = |cell: Cell| cells.get(&cell).map(|&s| saddles[s].at);
    let own = at((x, y))?;
    let mut steps = Vec::with_capacity(3);
    if let Some(behind) = at((x - dx, y - dy)) {
        steps.push(own - behind);
    }
    for side in [(dy, dx), (-dy, -dx)] {
        let beside = (x + side.0, y + side.1);
        if let (Some(from), Some(to)) = (at(beside), at((beside.0 + dx, beside.1 + dy))) {
            steps.push(to - from);
        }
    }
    if steps.is_empty() {
        return None;
    }
    let mean = steps.iter().sum::<Vector2<f64>>() / steps.len() as f64;
    Some((own + mean, mean.norm()))
}

/// The nearest saddle along `towards` that continues the edge.
fn neighbour(
    smooth: &Grey,
    saddles: &[Saddle],
    own: usize,
    towards: Vector2<f64>,
    predicted: Option<(Vector2<f64>, f64)>,
    used: &[bool],
) -> Option<usize> {
    let from = &saddles[own];
    let brighter_left = edge_along(from, towards).brighter_left;
    let mut candidates: Vec<(f64, usize)> = saddles
        .iter()
        .enumerate()
        .filter(|&(i, s)| {
            let way = s.at - from.at;
            let length = way.norm();
            let near =
                predicted.is_none_or(|(at, step)| (s.at - at).norm() < PREDICTION_ERROR_MAX * step);
            let alike = s.strength > STRENGTH_RATIO_MIN * from.strength;
            !used[i] && near && alike && length > 0.0 && way.dot(&towards) > ALONG_COS_MIN * length
        })
        .map(|(i, s)| ((s.at - from.at).norm(), i))
        .collect();
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0));
    candidates.into_iter().map(|(_, i)| i).take(12).find(|&i| {
        let way = (saddles[i].at - from.at).normalize();
        let edge = edge_along(&saddles[i], way);
        edge.along.dot(&way).abs() > ALONG_COS_MIN
            && edge.brighter_left != brighter_left
            && edge_is_unbroken(smooth, from.at, saddles[i].at, brighter_left)
    })
}

/// The edge of a saddle that is nearest to a direction.
fn edge_along(saddle: &Saddle, towards: Vector2<f64>) -> super::saddle::Edge {
    let [a, b] = saddle.edges;
    if a.along.dot(&towards).abs() >= b.along.dot(&towards).abs() { a } else { b }
}

/// Whether the same side is brighter all the way, by about as much.
fn edge_is_unbroken(
    smooth: &Grey,
    from: Vector2<f64>,
    to: Vector2<f64>,
    brighter_left: bool,
) -> bool {
    let way = to - from;
    let sense = if brighter_left { 1.0 } else { -1.0 };
    let left =
        Vector2::new(-way.y, way.x) / way.norm() * (0.1 * way.norm()).clamp(1.0, 4.0) * sense;
    let contrasts = [0.3, 0.5, 0.7].map(|part| {
        let at = from + part * way;
        Some(smooth.sample(at + left)? - smooth.sample(at - left)?)
    });
    let [Some(a), Some(b), Some(c)] = contrasts else { return false };
    let mean = (a + b + c) / 3.0;
    mean > EDGE_GREY_MIN && a.min(b).min(c) > EDGE_CONTRAST_MIN * mean
}
