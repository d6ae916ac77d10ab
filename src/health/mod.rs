//! The instrument watches itself: has the camera moved, is the picture sharp, is the light as it was?
//!
//! In: raw frames, and how the belt moves. Out: a [`Condition`]. Owns: what stands in the picture (rails,
//! frame, tunnels), learned while the belt runs, and its mean profiles. Limits: [`Finder`]'s cells.
//! Cost: a part of the rows, or of the points, a frame.
//!
//! What was learned is that of this start: a camera that was moved while the machine was off is not seen.
//!
//! [`Finder`]: edges::Finder

mod alarm;
mod blur;
mod edges;
mod geometry;
mod light;
mod parcels;
mod place;
mod profile;
mod scene;

pub use alarm::Level;
pub use light::{Light, REGIONS};

use crate::config::Site;
use crate::error::Result;
use crate::image::Plane;
use crate::plan::{Block, Memory, Plan};
use crate::units::BeltPx;
use alarm::Alarm;
use geometry::{Displacement, Effect};
use light::Places;
use parcels::Parcels;
use profile::SHIFT_MAX_PX;
use scene::{News, Scene};

/// Fewer edges that stand tell nothing.
const POINTS_MIN: usize = 24;
/// Fewer of them that agree, of those that were found: something else has happened.
const AGREE_MIN: f64 = 0.6;
/// So large a share of the picture that becomes saturated or black is as bad as light that has changed.
const SATURATED_MAX: f64 = 0.1;
/// A direction is watched when its displacement is known to this share of the warning, or of the error.
const SIGMA_SHARE: f64 = 0.5;

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

/// How sharp the picture is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sharpness {
    /// Standard deviation of its blur, px of the camera; `None`: not known.
    pub blur_px: Option<f64>,
    /// How bad that is.
    pub level: Level,
}

/// What the instrument knows of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Condition {
    /// The camera's.
    pub place: Place,
    /// The lens's.
    pub sharpness: Sharpness,
    /// The lamps'.
    pub light: Light,
}

impl Condition {
    /// Whether what is measured may be used, as far as the instrument goes.
    pub fn is_fit(&self) -> bool {
        self.place.level.max(self.sharpness.level) < Level::Fault
    }
}

/// What watches.
pub struct Watch {
    scene: Scene,
    places: Places,
    effect: Effect,
    scratch: Block<f32>,
    /// From where on the camera has moved, mm.
    moved_mm: [f64; 2],
    window_s: f64,
    place: Alarm,
    /// From where on the picture is unsharp, px.
    blur_px: [f64; 2],
    /// The blur that what stands shows, px.
    scene_blur_px: Option<f64>,
    sharpness: Alarm,
    parcels: Parcels,
    /// The blur that the parcels show, px of the camera, and how bad it is.
    parcels_blur_px: Option<f64>,
    parcels_sharpness: Alarm,
    /// Pixels of the camera in one of the belt view.
    px_per_view_px: f64,
    /// From where on the light has changed.
    light_change: f64,
    light: Alarm,
    condition: Condition,
}

/// How the belt has moved since the last frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ride<'a> {
    /// Bits of the belt view that parcels cover; empty: none are.
    pub covered: &'a [u64],
    /// Travel since start.
    pub travel_mm: f64,
    /// Time since the last frame; `None` while the belt stands.
    pub moving_s: Option<f64>,
}

impl Watch {
    /// Memory for a site.
    pub fn plan(site: &Site, plan: &mut Plan) {
        Scene::plan(site.camera.image_size_px, plan);
        Places::plan(plan);
        plan.add::<f32>("health.scratch", edges::POINTS_MAX, "residuals of the camera's motion");
    }

    /// Take the planned memory and compute the tables.
    pub fn new(site: &Site, memory: &mut Memory) -> Result<Self> {
        let scene = Scene::new(site, memory)?;
        let places = Places::new(site, memory)?;
        let scratch = memory.take("health.scratch", 0.0)?;
        let health = &site.config.health;
        Ok(Self {
            scene,
            places,
            effect: Effect::new(site),
            scratch,
            moved_mm: [health.moved_warning_mm(site.view.mm_per_px), health.moved_fault_mm],
            window_s: health.every_s,
            place: Alarm::default(),
            blur_px: [health.blur_warning_px, health.blur_fault_px],
            scene_blur_px: None,
            sharpness: Alarm::default(),
            parcels: Parcels::default(),
            parcels_blur_px: None,
            parcels_sharpness: Alarm::default(),
            px_per_view_px: site
                .camera
                .mm_per_px(site.config.zone.centre())
                .map_or(1.0, |mm| site.view.mm_per_px / mm),
            light_change: health.light_change_max,
            light: Alarm::default(),
            condition: Condition::default(),
        })
    }

    /// Look at a frame.
    pub fn step(&mut self, site: &Site, raw: Plane<'_>, ride: Ride<'_>) {
        let Some(dt_s) = ride.moving_s else { return };
        self.places.step(raw, ride.covered, site.view.size_px[0]);
        match self.scene.step(site, raw, ride.travel_mm, dt_s, self.window_s) {
            News::None => {}
            News::Learned => {
                self.places.learn();
                if self.scene.count() < POINTS_MIN {
                    self.condition.place.watching = Watching::Nothing;
                }
                self.judge_sharpness();
            }
            News::Compared => {
                self.judge_light();
                self.judge_sharpness();
                self.judge_place();
            }
        }
    }

    /// A parcel passes the middle of the zone: where its top is in the belt view.
    pub fn parcel(&mut self, view: Plane<'_>, top: &[BeltPx; 4]) {
        let Some(blur) = self.parcels.add(view, top) else { return };
        let blur_px = blur * self.px_per_view_px;
        self.parcels_blur_px = Some(blur_px);
        // Soft parcels look like that too: it is no fault by itself.
        self.parcels_sharpness.judge(blur_px, [self.blur_px[0], f64::INFINITY]);
        self.tell_sharpness();
    }

    /// What is known.
    pub fn condition(&self) -> Condition {
        self.condition
    }

    fn judge_sharpness(&mut self) {
        self.scene_blur_px = self.scene.blur_px(&mut self.scratch);
        if let Some(blur_px) = self.scene_blur_px {
            self.sharpness.judge(blur_px, self.blur_px);
        }
        self.tell_sharpness();
    }

    fn tell_sharpness(&mut self) {
        self.condition.sharpness = Sharpness {
            blur_px: self.scene_blur_px.or(self.parcels_blur_px),
            level: self.sharpness.level().max(self.parcels_sharpness.level()),
        };
    }

    fn judge_light(&mut self) {
        let light = self.places.changed();
        let share = light.saturated.max(light.black) / SATURATED_MAX * self.light_change;
        self.light.judge(light.change.abs().max(share), [self.light_change, f64::INFINITY]);
        self.condition.light = Light { level: self.light.level(), ..light };
    }

    fn judge_place(&mut self) {
        let (scene, count) = (&self.scene, self.scene.count());
        if count < POINTS_MIN {
            return;
        }
        let fitted = place::fit(&scene.compared(), &mut self.scratch);
        let place = &mut self.condition.place;
        // What stood is nowhere within reach.
        if fitted.found < count / 4 {
            let (px, [_, fault]) = (f64::from(SHIFT_MAX_PX), self.moved_mm);
            place.moved = Displacement { picture_px: px, error_mm: fault, ..place.moved };
            self.place.judge(f64::INFINITY, self.moved_mm);
            place.level = self.place.level();
            return;
        }
        // Where hardly anything is where it was, it has moved, however well that is understood.
        let enough = AGREE_MIN * fitted.found as f64;
        let moved_on = (fitted.still as f64) < fitted.found as f64 - enough;
        if (fitted.agree as f64) < enough && !moved_on {
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
