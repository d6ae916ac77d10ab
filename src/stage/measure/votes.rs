//! Which steps of the profiles are the cuboid's edges: votes of a whole pass on where each face's
//! top edge is, and the choice of one step near a predicted edge.

use super::fit::{Problem, SIDE_DEPTH_MIN_PX};
use super::model::{HEIGHT, LENGTH, Params, WIDTH};
use super::observe::PassView;

/// Votes on where a face's top edge is, relative to the silhouette's: bins of half a pixel,
/// from well inside (shadows and dark sides widen a silhouette) to a little outside.
const VOTE_BINS: usize = 76;
const VOTE_BIN_PX: f64 = 0.5;
const VOTE_FIRST_PX: f64 = -30.0;
/// Steeper than this votes no more: a label must not outvote an edge.
const VOTE_SLOPE_MAX: f32 = 1.5;
/// The outermost place with this share of the most votes is the edge; stripes lie inside it.
const VOTE_SHARE: f64 = 0.85;
/// No edge of a face is further inside the silhouette than this share of the parcel.
const INSIDE_MAX: f64 = 0.3;

/// Light comes from above: a visible side is rarely brighter than the top, and a rising step
/// there is rather that from a dark side to the belt.
pub(super) const RISING_TRUST: f64 = 0.5;
/// Steeper than this, grey levels a px, is no better: a label must not outdo a dark edge.
pub(super) const SLOPE_ENOUGH: f32 = 3.0;

/// What the profiles say about a face.
#[derive(Clone, Copy, Debug)]
pub struct FaceVote {
    /// Outward from the silhouette's face to the edge agreed upon, mm.
    pub offset_mm: f64,
    /// How far its base edge appears outside its top edge, where that could be mistaken.
    pub side_depth_mm: Option<f64>,
}

impl Problem<'_> {
    /// Where most profiles of the whole pass agree on an edge at each face.
    pub(super) fn face_votes(&self, views: &[PassView], params: &Params) -> [FaceVote; 4] {
        let mut votes = [[[0.0f64; VOTE_BINS]; 2]; 4];
        let mut depth = [(0.0, 0u32); 4];
        let mut sampled = 0;
        for view in self.sampled(views) {
            let outline = self.outline(view, params);
            sampled += 1;
            for (k, (sum, count)) in depth.iter_mut().enumerate() {
                if outline.side_visible[k] {
                    *sum += outline.side_depth_mm(k);
                    *count += 1;
                }
            }
            for sample in view.samples().iter().filter(|s| !s.edge.is_base()) {
                let Some((at, _)) = self.predict(&outline, sample) else { continue };
                for (step_mm, slope) in sample.steps(self.geometry.mm_per_px) {
                    let offset_px = (step_mm - at) / self.geometry.mm_per_px;
                    let bin = ((offset_px - VOTE_FIRST_PX) / VOTE_BIN_PX).floor();
                    if (0.0..VOTE_BINS as f64).contains(&bin) {
                        let face = sample.edge.face();
                        let facing = outline.side_visible[face];
                        votes[face][usize::from(facing)][bin as usize] +=
                            f64::from(slope.clamp(-VOTE_SLOPE_MAX, VOTE_SLOPE_MAX));
                    }
                }
            }
        }
        let m = self.geometry.magnification(params[HEIGHT]);
        std::array::from_fn(|k| {
            let (sum, count) = depth[k];
            let mean = sum / f64::from(count.max(1));
            // A side seen in passing shows its base edge smeared: no peak to mistake.
            let confusing =
                2 * count > sampled && mean > SIDE_DEPTH_MIN_PX * self.geometry.mm_per_px;
            // An edge further inside than this is the other side's, or a stripe's.
            let extent_mm = params[if k % 2 == 0 { LENGTH } else { WIDTH }];
            let inside_mm = INSIDE_MAX * extent_mm;
            let inside_px = m * inside_mm / self.geometry.mm_per_px;
            FaceVote {
                offset_mm: outermost_peak(&votes[k], -inside_px)
                    .map_or(0.0, |px| px * self.geometry.mm_per_px / m),
                side_depth_mm: confusing.then_some(mean / m),
            }
        })
    }
}

/// Offset, px, from `first_px` on, of the outermost place where the signed votes agree, those
/// above a hidden side and those above a visible one each among themselves; `None` without votes.
fn outermost_peak(votes: &[[f64; VOTE_BINS]; 2], first_px: f64) -> Option<f64> {
    // Neighbours within a pixel and a half are the same edge.
    let smooth = |i: usize| -> f64 {
        votes.iter().map(|votes| votes[i - 1..=i + 1].iter().sum::<f64>().abs()).sum()
    };
    let first = ((first_px - VOTE_FIRST_PX) / VOTE_BIN_PX).ceil().max(1.0) as usize;
    let inner = || first.min(VOTE_BINS - 1)..VOTE_BINS - 1;
    let most = inner().map(smooth).fold(0.0, f64::max);
    let peak = inner().rev().find(|&i| {
        let here = smooth(i);
        let below = i + 1 == VOTE_BINS - 1 || smooth(i + 1) <= here;
        most > 0.0 && here >= VOTE_SHARE * most && below && (i == first || smooth(i - 1) <= here)
    })?;
    Some(VOTE_FIRST_PX + (peak as f64 + 0.5) * VOTE_BIN_PX)
}

/// The step that belongs to the predicted edge: inside the gate, of the edge's polarity once
/// that is known, the strongest for its distance. Returns residual and slope.
pub(super) fn choose(
    steps: impl Iterator<Item = (f64, f32)>,
    predicted_mm: f64,
    gate_mm: f64,
    polarity: f64,
    rising: f64,
) -> Option<(f64, f32)> {
    let mut best: Option<(f64, f64, f32)> = None;
    for (step_mm, slope) in steps {
        let residual = step_mm - predicted_mm;
        let near = 1.0 - (residual / gate_mm).powi(2);
        if near <= 0.0 || f64::from(slope) * polarity < 0.0 {
            continue;
        }
        let sign = if slope > 0.0 { rising } else { 1.0 };
        let score = f64::from(slope.abs().min(SLOPE_ENOUGH)) * near * sign;
        if best.is_none_or(|(s, _, _)| score > s) {
            best = Some((score, residual, slope));
        }
    }
    best.map(|(_, residual, slope)| (residual, slope))
}

#[cfg(test)]
mod tests {
    use super::super::observe::{EdgeSample, KeptStep};
    use super::*;

    fn votes(places: &[(f64, f64)]) -> [f64; VOTE_BINS] {
        let mut votes = [0.0; VOTE_BINS];
        for (px, count) in places {
            votes[((px - VOTE_FIRST_PX) / VOTE_BIN_PX) as usize] = *count;
        }
        votes
    }

    #[test]
    fn of_edges_that_are_as_good_the_outermost_is_taken_and_a_weak_one_is_not() {
        let none = [0.0; VOTE_BINS];
        let seen = votes(&[(-12.0, 100.0), (-3.0, 90.0), (4.0, 50.0)]);
        let found = outermost_peak(&[seen, none], -30.0).expect("votes");
        assert!((found + 3.0).abs() <= 1.0, "{found}");
        assert_eq!(outermost_peak(&[none, none], -30.0), None);
    }

    #[test]
    fn a_dark_parcel_s_rising_and_falling_edge_add_up() {
        // In one histogram they would cancel, and the label inside would win.
        let hidden = votes(&[(-1.0, 60.0), (-14.0, -70.0)]);
        let visible = votes(&[(-1.0, -60.0)]);
        let found = outermost_peak(&[hidden, visible], -30.0).expect("votes");
        assert!((found + 1.0).abs() <= 1.0, "{found}");
    }

    fn sample(steps: [(f32, f32); 2]) -> EdgeSample {
        EdgeSample::with_steps(steps.map(|(at, slope)| KeptStep::new(at, slope)))
    }

    #[test]
    fn a_label_further_away_does_not_outdo_a_dark_edge() {
        let chosen = choose(sample([(0.5, -4.0), (-4.0, -60.0)]).steps(1.0), 0.0, 6.0, 0.0, 1.0);
        assert_eq!(chosen, Some((0.5, -4.0)));
    }

    #[test]
    fn above_a_visible_side_the_falling_edge_is_the_top_one() {
        let steps = sample([(1.0, 3.0), (-1.0, -3.0)]);
        let chosen = choose(steps.steps(1.0), 0.2, 6.0, 0.0, RISING_TRUST);
        assert_eq!(chosen.map(|c| c.1), Some(-3.0));
        // Where rising edges are as likely, the nearer one is taken.
        assert_eq!(choose(steps.steps(1.0), 0.2, 6.0, 0.0, 1.0).map(|c| c.1), Some(3.0));
    }
}
