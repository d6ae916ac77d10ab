//! The instrument watches itself: has the camera moved?
//!
//! In: raw frames, and how the belt moves. Out: a [`Condition`]. Owns: what stands in the picture (rails,
//! frame, tunnels), learned while the belt runs, and its mean profiles. Limits: [`Finder`]'s cells.
//! Cost: a part of the rows, or of the points, a frame.
//!
//! What was learned is that of this start: a camera that was moved while the machine was off is not seen.
//!
//! [`Finder`]: edges::Finder

mod alarm;
mod edges;
mod geometry;
mod place;
mod profile;
mod scene;

pub use alarm::Level;

use crate::config::Site;
use crate::error::Result;
use crate::image::Plane;
use crate::plan::{Block, Memory, Plan};
use alarm::Alarm;
use geometry::{Displacement, Effect};
use profile::SHIFT_MAX_PX;
use scene::{News, Scene};

/// Fewer edges that stand tell nothing.
const POINTS_MIN: usize = 24;
/// Fewer of them that agree, of those that were found: something else has happened.
const AGREE_MIN: f64 = 0.6;
/// A direction is watched when its displacement is known to this share of the warning, or of the error.
const SIGMA_SHARE: f64 = 0.3;

/// How well the camera's place is watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Watching {
    /// What stands is being learned.
    #[default]
    Learning = 0,
    /// Too little stands in the picture, or what does disagrees: nothing is known.
    Nothing = 1,
    /// Across travel alone: only edges along it stand.
    Across = 2,
    /// Along travel alone.
    Along = 3,
    /// Both.
    Both = 4,
}

/// Where the camera is, against where it was when it was learned.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Place {
    /// How well it is watched.
    pub watching: Watching,
    /// How far the picture has moved, and what that does.
    pub moved: Displacement,
    /// How bad that is.
    pub level: Level,
}

/// What the instrument knows of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Condition {
    /// The camera's.
    pub place: Place,
}

impl Condition {
    /// Whether what is measured may be used, as far as the instrument goes.
    pub fn is_fit(&self) -> bool {
        self.place.level < Level::Fault
    }
}

/// What watches.
pub struct Watch {
    scene: Scene,
    effect: Effect,
    scratch: Block<f32>,
    /// From where on the camera has moved, mm.
    moved_mm: [f64; 2],
    window_s: f64,
    place: Alarm,
    condition: Condition,
}

/// How the belt has moved since the last frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ride {
    /// Travel since start.
    pub travel_mm: f64,
    /// Time since the last frame; `None` while the belt stands.
    pub moving_s: Option<f64>,
}

impl Watch {
    /// Memory for a site.
    pub fn plan(site: &Site, plan: &mut Plan) {
        Scene::plan(site.camera.image_size_px, plan);
        plan.add::<f32>("health.scratch", edges::POINTS_MAX, "residuals of the camera's motion");
    }

    /// Take the planned memory and compute the tables.
    pub fn new(site: &Site, memory: &mut Memory) -> Result<Self> {
        let scene = Scene::new(site, memory)?;
        let scratch = memory.take("health.scratch", 0.0)?;
        let health = &site.config.health;
        Ok(Self {
            scene,
            effect: Effect::new(site),
            scratch,
            moved_mm: [health.moved_warning_mm(site.view.mm_per_px), health.moved_fault_mm],
            window_s: health.every_s,
            place: Alarm::default(),
            condition: Condition::default(),
        })
    }

    /// Look at a frame.
    pub fn step(&mut self, site: &Site, raw: Plane<'_>, ride: Ride) {
        let Some(dt_s) = ride.moving_s else { return };
        match self.scene.step(site, raw, ride.travel_mm, dt_s, self.window_s) {
            News::None => {}
            News::Learned if self.scene.count() < POINTS_MIN => {
                self.condition.place.watching = Watching::Nothing;
            }
            News::Learned => {}
            News::Compared => self.judge_place(),
        }
    }

    /// What is known.
    pub fn condition(&self) -> Condition {
        self.condition
    }

    fn judge_place(&mut self) {
        let (scene, count) = (&self.scene, self.scene.count());
        if count < POINTS_MIN {
            return;
        }
        let fitted = place::fit(scene.compared(), &mut self.scratch);
        let place = &mut self.condition.place;
        // What stood is nowhere within reach.
        if fitted.found < count / 4 {
            let (px, [_, fault]) = (f64::from(SHIFT_MAX_PX), self.moved_mm);
            place.moved = Displacement { picture_px: px, error_mm: fault, ..place.moved };
            self.place.judge(f64::INFINITY, self.moved_mm);
            place.level = self.place.level();
            return;
        }
        if (fitted.agree as f64) < AGREE_MIN * fitted.found as f64 {
            place.watching = Watching::Nothing;
            return;
        }
        let moved = self.effect.displacement(&fitted.motion);
        let sigma_max_mm = SIGMA_SHARE * self.moved_mm[0].max(moved.error_mm);
        let known = self.effect.sigma_mm(&fitted.covariance).map(|sigma| sigma < sigma_max_mm);
        place.watching = match known {
            [true, true] => Watching::Both,
            [true, false] => Watching::Along,
            [false, true] => Watching::Across,
            [false, false] => Watching::Nothing,
        };
        place.moved = moved;
        self.scene.look_near(&fitted.motion);
        self.place.judge(place.moved.error_mm, self.moved_mm);
        place.level = self.place.level();
    }
}
