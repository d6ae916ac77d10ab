//! The search for the right start of the final fit, in jobs of about equal cost, so that it can be
//! spread over the frames before a parcel leaves.
//!
//! Tried are both silhouettes, each face's edges as the silhouette or the votes place them, and
//! on sides that face the camera the strongest edge as the top one or as the one on the belt. The
//! cuboid that explains most contrast wins. First with the corners on the top face, then, if that is
//! no box, without them: they may be on a side.

use super::fit::{Estimate, GATES_PX, Problem, Silhouette};
use super::model::{Params, named_like};
use super::observe::PassView;
use super::votes::FaceVote;

/// Which silhouette, and whether corners count.
const ROUNDS: [(Silhouette, bool); 4] = [
    (Silhouette::Whole, true),
    (Silhouette::Bright, true),
    (Silhouette::Whole, false),
    (Silhouette::Bright, false),
];
/// Ways of taking the four faces' edges for top or base ones: bit k says base for face k ...
const WAYS: u32 = 16;
/// ... and one more, tried first: the faces of the silhouette itself.
const AS_SEEN: u32 = WAYS;
/// Jobs of a round whose votes are not known yet.
const JOBS_EXPECTED: usize = 6;

/// A start worth refining.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    /// The silhouette it was found with.
    pub silhouette: Silhouette,
    /// The fit on some of the views.
    pub estimate: Estimate,
}

/// What is left to be tried in a round.
#[derive(Clone, Copy, Debug)]
struct Candidates {
    start: Params,
    votes: [FaceVote; 4],
    /// Bit: the way is not tried yet.
    left: u32,
}

/// The search and what it has found so far.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    round: usize,
    candidates: Option<Candidates>,
    /// The best with corners, and without.
    found: [Option<Found>; 2],
}

impl Search {
    /// Nothing tried.
    pub const NEW: Self = Self { round: 0, candidates: None, found: [None; 2] };

    /// The best start with corners.
    pub fn with_corners(&self) -> Option<Found> {
        self.found[0]
    }

    /// The best start without them, where that was searched.
    pub fn without_corners(&self) -> Option<Found> {
        self.found[1]
    }

    /// Jobs that are left, as far as that is known; none when it has ended.
    pub fn jobs_left(&self) -> usize {
        let rounds = ROUNDS.len() - self.round;
        self.candidates.map_or(rounds * JOBS_EXPECTED, |candidates| {
            candidates.left.count_ones() as usize + (rounds - 1) * JOBS_EXPECTED
        })
    }

    /// Do one job. `problem`: that of a silhouette, with or without corners; `running`: the estimate
    /// across whose faces the profiles were taken.
    pub fn step<'a>(
        &mut self,
        problem: impl Fn(Silhouette, bool) -> Problem<'a>,
        views: &[PassView],
        running: Option<Params>,
        is_box: impl Fn(&Estimate) -> bool,
    ) {
        let Some(&(silhouette, corners)) = ROUNDS.get(self.round) else { return };
        let problem = problem(silhouette, corners).on_some_of(views);
        let Some(candidates) = &mut self.candidates else {
            if let Some(reach) = problem.fit_reach(views, None) {
                let start = named_like(reach.params, &running.unwrap_or(reach.params));
                let votes = problem.face_votes(views, &start);
                self.candidates = Some(Candidates::new(start, votes));
                self.offer(Found { silhouette, estimate: Estimate { params: start, ..reach } });
            } else {
                self.end_round(&is_box, problem.top_motion.is_some());
            }
            return;
        };
        let start = candidates.take(&problem);
        let ended = candidates.left == 0;
        if let Some(estimate) = problem.refine_edges(views, start, &GATES_PX) {
            self.offer(Found { silhouette, estimate });
        }
        if ended {
            self.end_round(&is_box, problem.top_motion.is_some());
        }
    }

    fn offer(&mut self, found: Found) {
        let best = &mut self.found[usize::from(!ROUNDS[self.round].1)];
        if best.is_none_or(|best| found.estimate.score() > best.estimate.score()) {
            *best = Some(found);
        }
    }

    fn end_round(&mut self, is_box: &impl Fn(&Estimate) -> bool, has_corners: bool) {
        self.candidates = None;
        self.round += 1;
        let settled = !has_corners || self.with_corners().is_some_and(|f| is_box(&f.estimate));
        if settled && ROUNDS.get(self.round).is_some_and(|(_, corners)| !corners) {
            self.round = ROUNDS.len();
        }
    }
}

impl Candidates {
    fn new(start: Params, votes: [FaceVote; 4]) -> Self {
        // Only a side that is seen wide enough shows a base edge to be mistaken for the top's.
        let confusing = |way: &u32| {
            (0..4).all(|k| way >> k & 1 == 0 || votes[k as usize].side_depth_mm.is_some())
        };
        let ways = (0..WAYS).filter(confusing).fold(1 << AS_SEEN, |left, way| left | 1 << way);
        Self { start, votes, left: ways }
    }

    /// The next start.
    fn take(&mut self, problem: &Problem<'_>) -> Params {
        let way = if self.left >> AS_SEEN == 1 { AS_SEEN } else { self.left.trailing_zeros() };
        self.left &= !(1 << way);
        if way == AS_SEEN {
            return self.start;
        }
        let offsets = std::array::from_fn(|k| {
            let depth = self.votes[k].side_depth_mm.filter(|_| way >> k & 1 == 1);
            self.votes[k].offset_mm - depth.unwrap_or(0.0)
        });
        problem.moved(self.start, offsets)
    }
}
