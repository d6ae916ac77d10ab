//! The scenario file: everything about a synthetic sequence, and nothing twice.

use super::belt::PatternTable;
use super::lamps::Lamp;
use super::random::Random;
use super::sensor::SensorTable;
use crate::camera::{Camera, CameraFile};
use crate::error::{Error, Result};
use serde::Deserialize;

/// Random parcels: a day at one a second.
const RANDOM_PARCELS_MAX: usize = 100_000;

/// A synthetic sequence.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Seed of everything random.
    pub seed: u64,
    /// Frames a second.
    pub fps: f64,
    /// Length of the sequence.
    pub frames: u64,
    /// Shutter time.
    pub exposure_ms: f64,
    /// Radius of the parcels' edges.
    #[serde(default = "edge_radius_mm")]
    pub edge_radius_mm: f64,
    /// Lens, image size and pose, as in camera.toml.
    camera: CameraFile,
    /// The belt.
    pub belt: BeltTable,
    /// The light.
    #[serde(default)]
    pub light: LightTable,
    /// Sensor noise.
    #[serde(default)]
    pub noise: NoiseTable,
    /// Lens and electronics.
    #[serde(default)]
    pub sensor: SensorTable,
    /// Parcels, one by one.
    #[serde(default, rename = "parcel")]
    parcels: Vec<Parcel>,
    /// Parcels drawn at random, after those.
    random: Option<RandomTable>,
}

/// A carton's.
fn edge_radius_mm() -> f64 {
    1.2
}

/// `[belt]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BeltTable {
    /// True speed.
    pub speed_mm_per_s: f64,
    /// Width; rails on both sides.
    pub width_mm: f64,
    /// Mean grey level.
    pub grey: f64,
    /// Standard deviation of its texture.
    pub texture_grey: f64,
    /// What repeats on it.
    pub pattern: Option<PatternTable>,
    /// Its speed swings by this share.
    #[serde(default)]
    pub ripple: f64,
    /// Period of that.
    #[serde(default = "ripple_period_s")]
    pub ripple_period_s: f64,
    /// Stops, in order of time.
    #[serde(default, rename = "stop")]
    pub stops: Vec<StopTable>,
}

fn ripple_period_s() -> f64 {
    1.0
}

/// `[[belt.stop]]`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StopTable {
    /// Begins to slow down.
    pub at_s: f64,
    /// Stands still, between slowing down and starting.
    pub for_s: f64,
    /// Slowing down takes this long, starting the same.
    pub ramp_s: f64,
}

/// `[light]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LightTable {
    /// Relative amplitude of the drift.
    pub drift: f64,
    /// Period of the drift.
    pub drift_period_s: f64,
    /// Darkening right beside a parcel, 0 to 1.
    pub shadow: f64,
    /// Share of full brightness that comes from everywhere. Only with lamps.
    pub ambient: f64,
    /// Lamps. None: even light that casts no shadow but the one beside a parcel.
    #[serde(rename = "lamp")]
    pub lamps: Vec<Lamp>,
    /// Relative amplitude of the mains' flicker.
    pub flicker: f64,
    /// Frequency of that: twice the mains'.
    pub flicker_hz: f64,
    /// Steps of brightness.
    #[serde(rename = "step")]
    pub steps: Vec<StepTable>,
}

/// `[[light.step]]`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepTable {
    /// When.
    pub at_s: f64,
    /// All light is multiplied by this from then on.
    pub factor: f64,
}

impl Default for LightTable {
    fn default() -> Self {
        Self {
            drift: 0.0,
            drift_period_s: 10.0,
            shadow: 0.45,
            ambient: 0.4,
            lamps: Vec::new(),
            flicker: 0.0,
            flicker_hz: 100.0,
            steps: Vec::new(),
        }
    }
}

/// `[noise]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NoiseTable {
    /// Standard deviation of the read noise.
    pub read_grey: f64,
    /// Photo-electrons a grey level.
    pub electrons_per_grey: f64,
}

impl Default for NoiseTable {
    fn default() -> Self {
        Self { read_grey: 0.3, electrons_per_grey: 65.0 }
    }
}

/// What a parcel is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Material {
    /// Brown cardboard with tape.
    Kraft,
    /// White cardboard.
    White,
    /// Black, with a label.
    Dark,
    /// White under a film that mirrors the lamps.
    Glossy,
    /// Printed all over.
    Printed,
}

/// `[[parcel]]`: a cuboid on the belt.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parcel {
    /// Longer side of the footprint.
    pub length_mm: f64,
    /// Shorter side of the footprint.
    pub width_mm: f64,
    /// Height.
    pub height_mm: f64,
    /// Length axis against +X.
    pub yaw_deg: f64,
    /// Footprint centre before the belt has moved.
    pub x_mm: f64,
    /// Footprint centre across the belt.
    pub y_mm: f64,
    /// Surface.
    pub material: Material,
}

/// `[random]`: parcels one behind the other.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RandomTable {
    count: usize,
    /// Centre of the first one before the belt has moved.
    first_x_mm: f64,
    /// Free belt between neighbours, along travel.
    gap_mm: [f64; 2],
    y_mm: [f64; 2],
    length_mm: [f64; 2],
    width_mm: [f64; 2],
    height_mm: [f64; 2],
}

impl Scenario {
    /// Parse and check.
    pub fn parse(text: &str) -> Result<Self> {
        let mut scenario: Self = toml::from_str(text).map_err(|e| {
            Error::configuration(format!("not a scenario: {}", e.to_string().trim_end()))
        })?;
        let belt = &scenario.belt;
        let usable = scenario.fps > 0.0
            && belt.speed_mm_per_s > 0.0
            && belt.ripple.abs() < 1.0
            && belt.ripple_period_s > 0.0
            && belt.pattern.is_none_or(|p| p.pitch_mm > 0.0)
            && belt.stops.iter().all(|s| s.at_s >= 0.0 && s.for_s >= 0.0 && s.ramp_s > 0.0)
            && scenario.sensor.is_usable()
            && scenario.light.lamps.iter().all(|l| l.radius_mm >= 0.0 && l.strength >= 0.0)
            && scenario.parcels.iter().all(|p| p.length_mm >= p.width_mm && p.height_mm > 0.0);
        if !usable {
            return Err(Error::configuration("the scenario cannot be rendered").allowed(
                "fps, speed and ramp_s above 0, stops not negative, length >= width, height above 0, \
                 ripple below 1, periods and pitch above 0, lamps above every parcel, blur_px 0 to 2.5, vibration_px \
                 0 to 1, gamma 0.3 to 3, denoise 0 to 0.9, jpeg_quality 0 to 100",
            ));
        }
        if let Some(random) = scenario.random.take() {
            if random.count > RANDOM_PARCELS_MAX {
                return Err(Error::configuration(format!("random.count = {}", random.count))
                    .allowed(format!("up to {RANDOM_PARCELS_MAX} parcels")));
            }
            let mut generator = Random(scenario.seed);
            scenario.parcels.extend(random.draw(&mut generator));
        }
        let height_max_mm = scenario.parcels.iter().map(|p| p.height_mm).fold(0.0, f64::max);
        if scenario.light.lamps.iter().any(|l| l.z_mm <= height_max_mm) {
            return Err(Error::configuration("light.lamp: z_mm is below a parcel's top")
                .allowed(format!("above {height_max_mm} mm")));
        }
        Ok(scenario)
    }

    /// The camera.
    pub fn camera(&self) -> Result<Camera> {
        self.camera.clone().into_camera()
    }

    /// Every parcel: the truth.
    pub fn parcels(&self) -> &[Parcel] {
        &self.parcels
    }

    /// Belt travel at a time, mm.
    pub fn travel_mm(&self, t_s: f64) -> f64 {
        let lost_s: f64 = self.belt.stops.iter().map(|s| s.lost_s(t_s)).sum();
        let run_s = t_s - lost_s;
        let pulse = std::f64::consts::TAU / self.belt.ripple_period_s;
        let ahead_s = self.belt.ripple * (1.0 - (pulse * run_s).cos()) / pulse;
        self.belt.speed_mm_per_s * (run_s + ahead_s)
    }

    /// Belt travel in the middle of a frame's exposure.
    pub fn travel_at_frame_mm(&self, index: u64) -> f64 {
        self.travel_mm(index as f64 / self.fps)
    }

    /// Brightness of the light at a time, around 1.
    pub fn brightness(&self, t_s: f64) -> f64 {
        let phase = std::f64::consts::TAU * t_s / self.light.drift_period_s;
        let mains = std::f64::consts::TAU * t_s * self.light.flicker_hz;
        let steps = self.light.steps.iter().filter(|s| t_s >= s.at_s).map(|s| s.factor);
        (1.0 + self.light.drift * phase.sin())
            * (1.0 + self.light.flicker * mains.sin())
            * steps.product::<f64>()
    }
}

impl StopTable {
    /// Running time lost to the stop until `t_s`: the integral of the missing speed.
    fn lost_s(&self, t_s: f64) -> f64 {
        let ramp = |since_s: f64| {
            let s = since_s.clamp(0.0, self.ramp_s);
            s * s / (2.0 * self.ramp_s) + (since_s - self.ramp_s).max(0.0)
        };
        // The speed that is missing rises in one ramp and falls again in the other.
        ramp(t_s - self.at_s) - ramp(t_s - self.at_s - self.ramp_s - self.for_s)
    }
}

impl RandomTable {
    fn draw(&self, random: &mut Random) -> Vec<Parcel> {
        let mut end_mm = self.first_x_mm;
        let mut parcels = Vec::with_capacity(self.count);
        for i in 0..self.count {
            let (a, b) = (random.between(self.length_mm), random.between(self.width_mm));
            let (length_mm, width_mm) = (a.max(b), a.min(b));
            let yaw_deg = random.between([-90.0, 90.0]);
            let (sin, cos) = yaw_deg.to_radians().sin_cos();
            let half_mm = 0.5 * (length_mm * cos.abs() + width_mm * sin.abs());
            if i > 0 {
                end_mm -= random.between(self.gap_mm) + half_mm;
            }
            let material = match random.bits() % 5 {
                0 => Material::Dark,
                1 => Material::White,
                _ => Material::Kraft,
            };
            let height_mm = random.between(self.height_mm);
            let y_mm = random.between(self.y_mm);
            parcels.push(Parcel {
                length_mm,
                width_mm,
                height_mm,
                yaw_deg,
                x_mm: end_mm,
                y_mm,
                material,
            });
            end_mm -= half_mm;
        }
        parcels
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_random_parcels_than_memory_holds_are_refused() {
        let demo = include_str!("../../../config/demo/scenario.toml");
        let parse = |count: &str| Scenario::parse(&demo.replace("count = 500", count));
        assert_eq!(parse("count = 100000").expect("a day").parcels().len(), 100_000);
        for count in ["count = 100001", "count = 9223372036854775807"] {
            let error = parse(count).expect_err(count).to_string();
            assert!(error.contains("random.count = ") && error.contains("100000"), "{error}");
        }
    }

    #[test]
    fn a_stop_costs_its_standstill_and_one_ramp() {
        let stop = StopTable { at_s: 2.0, for_s: 3.0, ramp_s: 0.5 };
        assert!(stop.lost_s(2.0).abs() < 1e-12);
        assert!((stop.lost_s(100.0) - 3.5).abs() < 1e-12);
        // Standing still: all time is lost.
        assert!((stop.lost_s(5.0) - stop.lost_s(3.0) - 2.0).abs() < 1e-12);
    }
}
