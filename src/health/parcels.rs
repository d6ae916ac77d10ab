//! How sharp the parcels are: where too little stands in the picture, and sooner than what stands tells.
//!
//! In: the belt view at the moment at which a parcel passes the middle of the zone, and where its top is. Out:
//! the median over the last parcels of the blur of each one's sharpest quarter of clean steps.

use super::blur;
use crate::image::Plane;
use crate::kernel::scalar::profile::sample;
use crate::units::BeltPx;

/// Profiles on each side of a parcel's top.
const PER_SIDE: usize = 8;
/// A profile's samples to both sides, and how far from its middle the edge is looked for.
const REACH: usize = 20;
const SEARCH: usize = 8;
/// A side that is shorter has no room for them, px.
const SIDE_MIN_PX: f32 = 24.0;
/// The weakest step, grey levels over two pixels.
const SLOPE_MIN: f32 = 8.0;
/// Clean steps that a parcel must have.
const CLEAN_MIN: usize = 4;
/// Parcels that are remembered, and how many of them tell.
const PARCELS: usize = 7;
const PARCELS_MIN: usize = 5;

/// The last parcels.
#[derive(Default)]
pub(super) struct Parcels {
    blur_px: heapless::HistoryBuf<f32, PARCELS>,
}

impl Parcels {
    /// A parcel's top in the belt view; the median of the last ones, px of the view, once they are enough.
    pub(super) fn add(&mut self, view: Plane<'_>, top: &[BeltPx; 4]) -> Option<f64> {
        let mut widths = heapless::Vec::<f32, { 4 * PER_SIDE }>::new();
        for (a, b) in top.iter().zip(top.iter().cycle().skip(1)) {
            for edge in side(view, *a, *b).filter(|edge| edge.is_clean()) {
                // There are no more than places.
                let _ = widths.push(edge.sigma_px);
            }
        }
        let count = widths.len();
        if count < CLEAN_MIN {
            return None;
        }
        let (_, quartile, _) = widths.select_nth_unstable_by(count / 4, f32::total_cmp);
        self.blur_px.write(*quartile);
        let mut all: heapless::Vec<f32, PARCELS> = self.blur_px.oldest_ordered().copied().collect();
        let count = all.len();
        let (_, median, _) = all.select_nth_unstable_by(count / 2, f32::total_cmp);
        (count >= PARCELS_MIN).then_some(f64::from(*median))
    }
}

/// The steps across a side from `a` to `b`.
fn side(view: Plane<'_>, a: BeltPx, b: BeltPx) -> impl Iterator<Item = blur::Edge> {
    let (a, b) = ([a.u as f32, a.v as f32], [b.u as f32, b.v as f32]);
    let along = [b[0] - a[0], b[1] - a[1]];
    let length = along[0].hypot(along[1]);
    let places = if length < SIDE_MIN_PX { 0 } else { PER_SIDE };
    (0..places).filter_map(move |k| {
        let across = [along[1] / length, -along[0] / length];
        // Not at the corners.
        let t = 0.15 + 0.7 * (k as f32 + 0.5) / PER_SIDE as f32;
        let start = [0, 1].map(|i| a[i] + t * along[i] - REACH as f32 * across[i]);
        let mut profile = [0.0f32; 2 * REACH + 1];
        sample(view, start, across, 1, &mut profile)?;
        let slope = |i: usize| (profile[i + 1] - profile[i - 1]).abs();
        let steepest = (REACH - SEARCH..=REACH + SEARCH)
            .max_by(|a, b| slope(*a).total_cmp(&slope(*b)))
            .filter(|i| slope(*i) > SLOPE_MIN)?;
        blur::edge(&profile, steepest as f32)
    })
}
