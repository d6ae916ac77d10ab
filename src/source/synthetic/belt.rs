//! What a belt looks like: faint texture, what repeats (weave, ribs, modules), and what lies flat on it.

use super::marks::{DIRT_LOOP_MM, Mark};
use super::random::Random;
use super::scenario::BeltTable;
use serde::Deserialize;

/// Texture tile: side in texels (a power of two) and their size.
const TILE: usize = 1024;
const TEXEL_MM: f32 = 1.5;

/// Kinds of pattern.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PatternKind {
    /// Threads along and across.
    Woven,
    /// Grooves across the belt.
    Ribbed,
    /// Plates with gaps between them, in rows like bricks.
    Modular,
}

/// `[belt.pattern]`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PatternTable {
    /// What it looks like.
    pub kind: PatternKind,
    /// Its period along travel.
    pub pitch_mm: f64,
    /// From its brightest to its darkest, grey levels.
    pub contrast_grey: f64,
    /// Width of a gap or groove.
    #[serde(default = "gap_mm")]
    pub gap_mm: f64,
    /// Width of a row of plates; every other row is offset by half a pitch. 0: one row.
    #[serde(default)]
    pub row_mm: f64,
}

fn gap_mm() -> f64 {
    3.0
}

impl PatternTable {
    /// Grey levels that are added at a point of the belt. `px_mm`: edges are as wide as a pixel.
    fn grey(&self, x_mm: f32, y_mm: f32, px_mm: f32) -> f32 {
        let (pitch, contrast) = (self.pitch_mm as f32, self.contrast_grey as f32);
        let half_gap = 0.5 * self.gap_mm as f32;
        // 1 in the middle of a gap, 0 outside it.
        let gap = |at: f32, period: f32| {
            let from_gap = (at - period * (at / period).round()).abs();
            ((half_gap - from_gap) / px_mm + 0.5).clamp(0.0, 1.0)
        };
        match self.kind {
            PatternKind::Woven => {
                let wave = |at: f32| (std::f32::consts::TAU * at / pitch).sin();
                0.5 * contrast * wave(x_mm) * wave(y_mm)
            }
            PatternKind::Ribbed => -contrast * gap(x_mm, pitch),
            PatternKind::Modular => {
                let row = self.row_mm as f32;
                if row <= 0.0 {
                    return -contrast * gap(x_mm, pitch);
                }
                let odd = (y_mm / row).floor().rem_euclid(2.0);
                -contrast * gap(x_mm + 0.5 * pitch * odd, pitch).max(gap(y_mm, row))
            }
        }
    }
}

/// A mark in a frame: with its middle, and its turn.
type Placed = (Mark, [f32; 2], [f32; 2]);

/// The surface of a belt, in its own coordinates.
pub(super) struct Surface {
    table: BeltTable,
    tile: Vec<f32>,
    /// Spots on the loop that comes again.
    dirt: Vec<Mark>,
    /// Marks in view in this frame, by columns of the belt.
    columns: Vec<Vec<Placed>>,
    /// How far tile and pattern have moved in this frame, and the belt to its side. Both repeat, so only
    /// the travel within one of them matters.
    tile_offset_mm: f32,
    pattern_offset_mm: f32,
    aside_mm: f32,
}

/// Columns that marks are looked up by, and how much of a belt they cover around the origin.
const COLUMN_MM: f32 = 20.0;
const COLUMNS: usize = 256;

/// Where a belt is in a frame.
#[derive(Clone, Copy)]
pub(super) struct Position {
    /// Along travel.
    pub(super) travel_mm: f64,
    /// To its side.
    pub(super) aside_mm: f64,
}

impl Surface {
    /// The belt of a scenario.
    pub(super) fn new(seed: u64, table: &BeltTable) -> Self {
        let mut random = Random(seed ^ 0x6469_7274);
        let dirt = table.dirt.map(|dirt| dirt.draw(table.width_mm, &mut random));
        let dirt = dirt.unwrap_or_default();
        let has_marks = !dirt.is_empty() || !table.marks.is_empty();
        Self {
            tile: texture(seed, table.texture_grey),
            dirt,
            columns: vec![Vec::new(); if has_marks { COLUMNS } else { 0 }],
            table: table.clone(),
            tile_offset_mm: 0.0,
            pattern_offset_mm: 0.0,
            aside_mm: 0.0,
        }
    }

    /// The column that holds a place along travel.
    fn column(x_mm: f32) -> Option<usize> {
        let at = x_mm / COLUMN_MM + 0.5 * COLUMNS as f32;
        (at >= 0.0 && at < COLUMNS as f32).then_some(at as usize)
    }

    /// Note where everything on it is.
    pub(super) fn place(&mut self, at: Position) {
        let tile_mm = f64::from(TEXEL_MM) * TILE as f64;
        self.tile_offset_mm = at.travel_mm.rem_euclid(tile_mm) as f32;
        let pattern = self.table.pattern.as_ref();
        self.pattern_offset_mm =
            pattern.map_or(0.0, |p| at.travel_mm.rem_euclid(p.pitch_mm)) as f32;
        self.aside_mm = at.aside_mm as f32;
        if self.columns.is_empty() {
            return;
        }
        self.columns.iter_mut().for_each(Vec::clear);
        let half_mm = 0.5 * f64::from(COLUMN_MM) * COLUMNS as f64;
        let once = self.table.marks.iter().map(|mark| (mark, mark.x_mm + at.travel_mm));
        let again = self.dirt.iter().flat_map(|mark| {
            let first = (mark.x_mm + at.travel_mm + half_mm).rem_euclid(DIRT_LOOP_MM) - half_mm;
            (0..3).map(move |k| (mark, first + f64::from(k) * DIRT_LOOP_MM))
        });
        for (mark, x_mm) in once.chain(again) {
            let reach = mark.reach_mm();
            let [low, high] =
                [x_mm - reach, x_mm + reach].map(|x| x.clamp(-half_mm, half_mm - 1.0));
            if x_mm + reach < -half_mm || x_mm - reach > half_mm {
                continue;
            }
            let columns = Self::column(low as f32).zip(Self::column(high as f32));
            let middle = [x_mm as f32, (mark.y_mm + at.aside_mm) as f32];
            let turn = mark.turn();
            for column in columns.map_or(0..0, |(low, high)| low..high + 1) {
                self.columns[column].push((*mark, middle, turn));
            }
        }
    }

    /// Grey level in full light at a point under the camera. `px_mm`: edges are as wide as a pixel.
    pub(super) fn grey(&self, [x, y]: [f32; 2], px_mm: f32) -> f32 {
        let y_on_belt = y - self.aside_mm;
        let pattern = self.table.pattern.as_ref();
        let repeated =
            pattern.map_or(0.0, |p| p.grey(x - self.pattern_offset_mm, y_on_belt, px_mm));
        let texture = self.texel(x - self.tile_offset_mm, y_on_belt);
        let bare = self.table.grey as f32 + texture + repeated;
        if self.columns.is_empty() {
            return bare.max(0.0);
        }
        let marks = Self::column(x).and_then(|column| self.columns.get(column));
        let marked = marks.into_iter().flatten().fold(bare, |grey, (mark, middle, turn)| {
            let share = mark.share(*turn, [x - middle[0], y - middle[1]], px_mm);
            grey + share * (mark.grey as f32 - grey)
        });
        marked.max(0.0)
    }

    /// Bilinear texture at a point of the belt.
    fn texel(&self, x_mm: f32, y_mm: f32) -> f32 {
        // Far enough from 0 that truncation is floor.
        let shift = (64 * TILE) as f32;
        let (u, v) = (x_mm / TEXEL_MM + shift, y_mm / TEXEL_MM + shift);
        let (iu, iv) = (u as usize, v as usize);
        let (fu, fv) = (u - iu as f32, v - iv as f32);
        let at = |u: usize, v: usize| self.tile[(v % TILE) * TILE + u % TILE];
        let top = at(iu, iv) * (1.0 - fu) + at(iu + 1, iv) * fu;
        let bottom = at(iu, iv + 1) * (1.0 - fu) + at(iu + 1, iv + 1) * fu;
        top * (1.0 - fv) + bottom * fv
    }
}

/// Smooth belt texture with scratches, mean 0, standard deviation `sigma`.
fn texture(seed: u64, sigma: f64) -> Vec<f32> {
    let mut random = Random(seed ^ 0x7465_7874);
    let mut tile: Vec<f32> = (0..TILE * TILE).map(|_| random.normal() as f32).collect();
    for _ in 0..3 {
        tile = blurred(&tile);
    }
    for _ in 0..40 {
        let (mut u, mut v) = (random.unit() * TILE as f64, random.unit() * TILE as f64);
        let angle = random.between([-0.4, 0.4]);
        let depth = random.between([-0.5, 0.5]) as f32;
        for _ in 0..60 {
            tile[(v as usize % TILE) * TILE + u as usize % TILE] += depth;
            u += angle.cos();
            v = (v + angle.sin()).rem_euclid(TILE as f64);
        }
    }
    tile = blurred(&tile);
    let variance = tile.iter().map(|t| t * t).sum::<f32>() / tile.len() as f32;
    let scale = sigma as f32 / variance.sqrt().max(f32::MIN_POSITIVE);
    tile.iter().map(|t| t * scale).collect()
}

/// 3x3 mean on the torus.
fn blurred(tile: &[f32]) -> Vec<f32> {
    let at = |u: usize, v: usize| tile[(v % TILE) * TILE + u % TILE];
    let mut out = Vec::with_capacity(tile.len());
    for v in TILE..2 * TILE {
        for u in TILE..2 * TILE {
            let near = (v - 1..v + 2).flat_map(|v| (u - 1..u + 2).map(move |u| (u, v)));
            out.push(near.map(|(u, v)| at(u, v)).sum::<f32>() / 9.0);
        }
    }
    out
}
