//! What the cells within a border tell of it.

use super::enclosing::SPREAD_MM;
use super::face::{Face, STEP_MM};
use super::scroll::{Scroll, place_of};

/// A cell within this is the belt's, mm.
const BELT_MM: f64 = 1.2;
/// Cells so far inside of a border are its own, mm.
const BORDER_MM: f64 = 10.0;
/// A thing is as high as this share of its cells: a few scatter.
pub const HIGHEST_SHARE: f64 = 0.95;
/// At a top face's border this share of the cells tells its height.
const BORDER_LEVEL_MIN: f64 = 0.2;
/// On a parcel at most this many cells for one that is raised lie on the belt.
const BELT_SHARE_MAX: f64 = 0.3;
/// The belt was seen at a place when this share of the cells tells it: that many scatter on to it from other heights.
const BELT_SEEN_MIN: f64 = 0.05;
/// Of the cells on a flat face so many are higher: they scatter.
const HIGHER_MAX: f64 = 0.05;
/// What has no top face is full of raised cells: this share.
const RAISED_SHARE_MIN: f64 = 0.5;

/// Beyond what an edge spreads a surface that goes on is seen over this width, mm, ...
const BEYOND_MM: f64 = 16.0;
/// ... in this share of the cells ...
const BEYOND_SHARE: f64 = 0.5;
/// ... at the same height, mm, and as a share of it: lower down are other things.
const LEVEL_MM: f64 = 6.0;
const LEVEL_SHARE: f64 = 0.3;

/// What the cells within a border tell: shares of them.
pub struct Content {
    on_belt: f64,
    raised: f64,
    /// At the border's height: of all, and of those along the border.
    level: f64,
    border_level: f64,
    /// Beyond it.
    higher: f64,
    /// What nearly none of the raised ones exceeds, mm.
    pub highest_mm: f64,
}

impl Content {
    /// Whether the belt shows within.
    pub fn is_belt(&self) -> bool {
        self.on_belt >= BELT_SHARE_MAX * self.raised
    }

    /// Whether the belt shows within, and enough of it to say so.
    pub fn shows_belt(&self) -> bool {
        self.on_belt > BELT_SEEN_MIN && self.is_belt()
    }

    /// Whether nothing is beyond a face that is too flat for cells to tell it from the belt.
    pub fn is_low(&self) -> bool {
        self.higher < HIGHER_MAX
    }

    /// Whether this is what the cells of a top face tell.
    pub fn is_top(&self) -> bool {
        self.border_level > BORDER_LEVEL_MIN && self.higher <= self.level && !self.is_belt()
    }

    /// Whether this is what the cells of a thing tell whose border is not at its top.
    pub fn is_heap(&self) -> bool {
        self.raised > RAISED_SHARE_MIN && self.higher > self.level && !self.is_belt()
    }
}

impl Scroll {
    /// Whether a surface at a face's height goes on beyond one of its sides, and none of the `others` is there: then the
    /// side is a line on something larger.
    pub fn goes_on_beyond<'a>(
        &self,
        face: &Face,
        others: &(impl Iterator<Item = &'a Face> + Clone),
    ) -> bool {
        let r = &face.rectangle;
        let level_mm = LEVEL_MM.min(LEVEL_SHARE * face.height_mm);
        let (mut all, mut level) = ([0usize; 4], [0usize; 4]);
        for i in 0..self.len() {
            let [x_mm, y_mm] = self.place_mm(i);
            let (along, across) = r.along_across(x_mm, y_mm);
            let outside_mm = [along.abs() - 0.5 * r.length_mm, across.abs() - 0.5 * r.width_mm];
            let beyond = |k: usize| {
                (SPREAD_MM..SPREAD_MM + BEYOND_MM).contains(&outside_mm[k])
                    && outside_mm[1 - k] < 0.0
            };
            let Some(k) = [0, 1].into_iter().find(|&k| beyond(k)) else { continue };
            let is_near = |other: &Face| other.rectangle.outside_mm(x_mm, y_mm) < SPREAD_MM;
            if others.clone().any(is_near) {
                continue;
            }
            let side = 2 * k + usize::from([along, across][k] < 0.0);
            all[side] += 1;
            let off_mm = (self.height_mm(i) - face.height_mm).abs();
            level[side] += usize::from(self.is_raised(i) && off_mm <= level_mm);
        }
        let goes_on = |side: usize| level[side] as f64 > BEYOND_SHARE * all[side] as f64;
        (0..4).any(|side| all[side] > 0 && goes_on(side))
    }

    /// What the cells within a face's border tell.
    pub fn content(&mut self, face: &Face) -> Content {
        let [mut all, mut on_belt, mut raised, mut level, mut higher] = [0usize; 5];
        let [mut border, mut border_level] = [0usize; 2];
        for i in 0..self.len() {
            let [x_mm, y_mm] = self.place_mm(i);
            let outside_mm = face.rectangle.outside_mm(x_mm, y_mm);
            if outside_mm > 0.0 {
                continue;
            }
            let at_border = outside_mm > -BORDER_MM;
            all += 1;
            border += usize::from(at_border);
            let height_mm = self.height_mm(i);
            if self.is_raised(i) {
                let is_level = (height_mm - face.height_mm).abs() <= STEP_MM;
                self.scratch[raised] = height_mm;
                raised += 1;
                level += usize::from(is_level);
                border_level += usize::from(is_level && at_border);
                higher += usize::from(height_mm > face.height_mm + STEP_MM);
            } else {
                on_belt += usize::from(self.cells[i].strength > 0.0 && height_mm.abs() <= BELT_MM);
            }
        }
        let share = |count: usize, of: usize| count as f64 / of.max(1) as f64;
        Content {
            on_belt: share(on_belt, all),
            raised: share(raised, all),
            level: share(level, all),
            border_level: share(border_level, border),
            higher: share(higher, all),
            highest_mm: place_of(&mut self.scratch[..raised], HIGHEST_SHARE),
        }
    }
}
