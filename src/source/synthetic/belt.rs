//! What a belt looks like: faint texture, and what repeats: weave, ribs, modules.

use super::random::Random;
use serde::Deserialize;

/// Texture tile: side in texels (a power of two) and their size.
pub(super) const TILE: usize = 1024;
pub(super) const TEXEL_MM: f32 = 1.5;

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
    pub(super) fn grey(&self, x_mm: f32, y_mm: f32, px_mm: f32) -> f32 {
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

/// Smooth belt texture with scratches, mean 0, standard deviation `sigma`.
pub(super) fn texture(seed: u64, sigma: f64) -> Vec<f32> {
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
