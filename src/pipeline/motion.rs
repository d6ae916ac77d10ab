//! Which witness of the belt's motion is believed: encoder, texture, what lies on the belt.
//!
//! In: the encoder's position, what the texture and the silhouettes showed. Out: the belt's step, and
//! what disagrees. The encoder outdoes the texture until the two are seen to disagree over a
//! distance; then the texture, which is measured in the same picture as the parcels, is believed.

use crate::belt::EncoderRatio;
use crate::stage::odometry::{Knowledge, Motion, Odometry};
use crate::stage::riders::Ride;

/// An encoder, or a belt, that shows less than this share of a speed stands still.
pub const STILL: f64 = 0.1;
/// A belt further than this share from its nominal speed is not as configured.
const NOMINAL_ERROR_MAX: f64 = 0.1;
/// A parcel must differ from the belt by no more than this, grey levels, to be found.
const CONTRAST_MAX_GREY: f64 = 100.0;

/// What the pipeline knows of its own condition.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Health {
    /// The belt's texture or the camera's noise is so strong that only parcels of extreme brightness
    /// can be told from the belt.
    pub belt_hides_parcels: bool,
    /// Grey levels by which a parcel must differ from the belt.
    pub contrast_min_grey: f64,
    /// What is known of the belt's motion from its texture.
    pub texture: Knowledge,
    /// Speed that texture or silhouettes show, mm/s; negative: against +X.
    pub belt_seen_mm_per_s: Option<f64>,
    /// The belt runs otherwise than configured: another speed, or against +X.
    pub belt_not_as_configured: bool,
    /// The encoder's travel over that of the texture, and its standard uncertainty.
    pub encoder_ratio: Option<(f64, f64)>,
    /// The encoder shows another travel than the belt: it is not used.
    pub encoder_disagrees: bool,
}

/// The witnesses, over time.
#[derive(Debug, Default)]
pub struct Witnesses {
    /// The encoder's belt position at the coming frame, and at the last one, mm.
    encoder_mm: [Option<f64>; 2],
    ratio: EncoderRatio,
    /// By the encoder, in the last frame.
    encoder_speed_mm_per_s: Option<f64>,
    encoder_disagrees: bool,
}

/// The belt's motion in one frame, from all witnesses.
#[derive(Clone, Copy, Debug)]
pub struct Decided {
    /// The step and whether it was measured.
    pub motion: Motion,
    /// Measured, and none.
    pub stands_still: bool,
    /// Another witness is believed from here on: what was before is in doubt.
    pub changed: bool,
}

impl Witnesses {
    /// The encoder's position at the coming frame.
    pub fn encoder(&mut self, position_mm: f64) {
        self.encoder_mm[0] = Some(position_mm).filter(|mm| mm.is_finite());
    }

    /// The encoder has another scale from here on.
    pub fn forget_encoder(&mut self) {
        *self = Self::default();
    }

    /// The belt's step since the last frame, if the encoder was read at both.
    pub fn encoder_step_mm(&mut self) -> Option<f64> {
        let [here, before] = self.encoder_mm;
        self.encoder_mm = [None, here];
        Some(here? - before?)
    }

    /// The belt's motion in a frame of `dt_s`.
    pub fn decide(
        &mut self,
        encoder_step_mm: Option<f64>,
        texture: Motion,
        odometry: &Odometry,
        ride: Ride,
        dt_s: f64,
    ) -> Decided {
        if let Some(encoder_mm) = encoder_step_mm.filter(|_| texture.measured) {
            self.ratio.add(encoder_mm, texture.step_mm);
        }
        // What moves on a belt that stands, by the texture too, is moved by a hand.
        let stuck = encoder_step_mm.is_some_and(|encoder_mm| {
            let stands = |mm: f64, ride: f64| mm.abs() < STILL * ride.abs() * dt_s;
            matches!(ride, Ride::Moves(ride)
                if stands(encoder_mm, ride) && !(texture.measured && stands(texture.step_mm, ride)))
        });
        let disagreed = self.encoder_disagrees;
        self.encoder_disagrees = stuck || self.ratio.disagrees();
        let believed = encoder_step_mm.filter(|_| !self.encoder_disagrees);
        self.encoder_speed_mm_per_s =
            believed.filter(|_| dt_s > 0.0).map(|encoder_mm| encoder_mm / dt_s);
        let still_mm = STILL * odometry.nominal_mm_per_s() * dt_s;
        Decided {
            motion: believed.map_or(texture, |step_mm| Motion { step_mm, measured: true }),
            stands_still: believed.map_or(odometry.stands_still(), |mm| mm.abs() < still_mm),
            changed: self.encoder_disagrees != disagreed,
        }
    }

    /// Before the belt is learned: by the encoder alone.
    pub fn encoder_alone(&mut self, step_mm: Option<f64>, dt_s: f64) {
        self.encoder_speed_mm_per_s = step_mm.filter(|_| dt_s > 0.0).map(|mm| mm / dt_s);
    }

    /// The encoder's step over a gap, if it is believed: nothing else is there to compare it with.
    pub fn over_gap(&mut self, step_mm: Option<f64>, dt_s: f64) -> Option<f64> {
        let believed = step_mm.filter(|_| !self.encoder_disagrees);
        self.encoder_alone(believed, dt_s);
        believed
    }

    /// By the encoder, if it is believed, in the last frame.
    pub fn encoder_speed_mm_per_s(&self) -> Option<f64> {
        self.encoder_speed_mm_per_s
    }

    /// What the witnesses say of the machine.
    pub fn health(&self, odometry: &Odometry, ride: Ride, contrast_min_grey: f64) -> Health {
        let nominal_mm_per_s = odometry.nominal_mm_per_s();
        let (speed, measured) = odometry.speed();
        let belt_seen_mm_per_s = match ride {
            _ if measured => Some(speed),
            Ride::Moves(ride) => Some(ride),
            Ride::Stands | Ride::Unknown => None,
        };
        // What lies on the belt moves up to the magnification faster than the belt.
        let most = if measured { 1.0 } else { odometry.magnification_max() };
        let as_configured = |speed: f64| {
            speed.abs() < STILL * nominal_mm_per_s
                || (1.0 - NOMINAL_ERROR_MAX..=most * (1.0 + NOMINAL_ERROR_MAX))
                    .contains(&(speed / nominal_mm_per_s))
        };
        Health {
            belt_hides_parcels: contrast_min_grey > CONTRAST_MAX_GREY,
            contrast_min_grey,
            texture: odometry.knowledge(),
            belt_seen_mm_per_s,
            belt_not_as_configured: belt_seen_mm_per_s.is_some_and(|speed| !as_configured(speed)),
            encoder_ratio: self.ratio.ratio(),
            encoder_disagrees: self.encoder_disagrees,
        }
    }
}
