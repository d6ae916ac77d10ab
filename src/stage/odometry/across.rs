//! The belt's travel over a gap in the frames, by its texture before and after.

use super::{Knowledge, MATCH_MIN, Odometry, PAIRS_MIN, RIDE_MARGIN, TEXTURE_GREY_MIN, chance};
use crate::stage::background::Background;

/// Over a gap so much is looked at, once and on all rows: a parcel is still in view.
const ACROSS_SHARE: f64 = 0.8;

/// A belt that stops may roll back by so much.
const BACK_SHARE: f64 = 0.05;

/// What the texture shows of the travel over a gap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Across {
    /// So much, mm.
    Travel(f64),
    /// More than this, mm: more than the zone shows.
    Beyond(f64),
    /// Nothing.
    Unknown,
}

impl Odometry {
    /// Travel since the last frame, `dt_s` ago, which may be anything. Looks once at every shift of
    /// the whole texture.
    pub fn across(
        &mut self,
        grey: &[u8],
        background: &Background,
        covered: &[u64],
        dt_s: f64,
    ) -> Across {
        let was_known = self.knowledge == Knowledge::Measured;
        let follows = self.shift_px.is_some();
        // The last frame becomes the key, if it is not.
        if self.shift_px != Some(0.0) {
            self.take_key();
        }
        self.extract(grey, background, covered);
        (self.key_age_s, self.seen, self.locked, self.misses) = (0.0, None, false, 0);
        let columns = self.columns.len() as f64;
        let most = (self.travel_max_mm(dt_s) / self.mm_per_px + 2.0).min(ACROSS_SHARE * columns);
        let back = BACK_SHARE * columns;
        let forward = self.speed_mm_per_s >= 0.0;
        let (from, to) = if forward { (-back, most) } else { (-most, back) };
        let found = self.best(from, to).filter(|m| {
            m.rho > chance(m.pairs).max(MATCH_MIN)
                && (m.shift_px.abs() > 2.0 || m.texture_grey >= TEXTURE_GREY_MIN)
        });
        let half = self.shift_max_px();
        let peaks = self.peaks(-half, half, None);
        let found = found.filter(|m| follows && !peaks.rival_of(m.shift_px));
        let Some(found) = found else {
            let [here, ..] = self.correlations(0);
            self.take_key();
            // A faint texture may well not show what a gap's one look needs.
            let was_clear = was_known && self.rho >= MATCH_MIN;
            let would_show = follows && was_clear && here.pairs >= 2 * PAIRS_MIN;
            return if would_show {
                Across::Beyond(most * self.mm_per_px)
            } else {
                Across::Unknown
            };
        };
        self.take_key();
        Across::Travel(found.shift_px * self.mm_per_px)
    }

    /// The furthest that the belt may have gone in a time, mm; any way when the time cannot be.
    pub fn travel_max_mm(&self, dt_s: f64) -> f64 {
        let fastest_mm_per_s = self.speed_mm_per_s.abs().max(self.expected.nominal_mm_per_s);
        let travel_mm = (1.0 + RIDE_MARGIN) * fastest_mm_per_s * dt_s;
        if travel_mm >= 0.0 { travel_mm } else { f64::INFINITY }
    }
}
