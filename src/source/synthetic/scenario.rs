//! The scenario file: everything about a synthetic sequence, and nothing twice.

use super::belt::PatternTable;
use super::intruder::Intruder;
use super::lamps::{LAMPS_MAX, Lamp};
use super::marks::{DirtTable, Mark};
use super::parcel::{Parcel, Place, RandomTable};
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
    /// Length of the sequence; not given: it goes on for ever.
    #[serde(default = "without_end")]
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
    /// The same parcels come again after so much belt, if they do.
    #[serde(skip)]
    loop_mm: Option<f64>,
    /// What comes into the picture and does not ride.
    #[serde(default, rename = "intruder")]
    pub(super) intruders: Vec<Intruder>,
}

/// Further from the origin than this nobody sees a parcel: there it may be put back behind the others.
const OUT_OF_SIGHT_MM: f64 = 5000.0;

fn without_end() -> u64 {
    u64::MAX
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
    /// It wanders to its side by so much.
    #[serde(default)]
    pub side_drift_mm: f64,
    /// Period of that.
    #[serde(default = "side_drift_period_s")]
    pub side_drift_period_s: f64,
    /// How much of a lamp's image it throws back, 0 to 1.
    #[serde(default)]
    pub shine: f64,
    /// Flat things on it, one by one.
    #[serde(default, rename = "mark")]
    pub marks: Vec<Mark>,
    /// Spots drawn at random.
    pub dirt: Option<DirtTable>,
}

fn side_drift_period_s() -> f64 {
    5.0
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
    /// Creeps back by so much while it stands.
    #[serde(default)]
    pub back_mm: f64,
    /// Happens again after so much time, and again; not given: once.
    pub every_s: Option<f64>,
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
            && belt.stops.iter().all(StopTable::is_usable)
            && belt.side_drift_period_s > 0.0
            && (0.0..=1.0).contains(&belt.shine)
            && belt.marks.iter().all(Mark::is_usable)
            && belt.dirt.is_none_or(|dirt| dirt.is_usable())
            && scenario.intruders.iter().all(Intruder::is_usable)
            && scenario.sensor.is_usable()
            && scenario.light.lamps.len() <= LAMPS_MAX
            && scenario.light.lamps.iter().all(Lamp::is_usable)
            && scenario.parcels.iter().all(Parcel::is_usable);
        if !usable {
            return Err(Error::configuration("the scenario cannot be rendered").allowed(
                "fps, speed and ramp_s above 0, stops not negative, length >= width, width and height above 0, \
                 ripple below 1, periods, pitch and radii above 0, up to 8 lamps above every parcel, blur_px 0 to \
                 2.5, vibration_px 0 to 1, gamma 0.3 to 3, denoise 0 to 0.9, jpeg_quality 0 to 100, shine, cover and \
                 wrap 0 to 1, straps 0 to 4, slide up to 0.2, turn_deg_per_m up to 90, up to 2000 spots a square metre",
            ));
        }
        if let Some(random) = scenario.random.take() {
            if random.count > RANDOM_PARCELS_MAX {
                return Err(Error::configuration(format!("random.count = {}", random.count))
                    .allowed(format!("up to {RANDOM_PARCELS_MAX} parcels")));
            }
            let mut generator = Random(scenario.seed);
            let parcels = random.draw(&mut generator);
            if random.again {
                let loop_mm = random.loop_mm(&parcels);
                if loop_mm < 2.0 * OUT_OF_SIGHT_MM {
                    return Err(Error::configuration("random.again: too few parcels").allowed(
                        format!("parcels on {} mm of belt or more", 2.0 * OUT_OF_SIGHT_MM),
                    ));
                }
                scenario.loop_mm = Some(loop_mm);
            }
            scenario.parcels.extend(parcels);
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
        let back_mm: f64 = self.belt.stops.iter().map(|s| s.gone_back_mm(t_s)).sum();
        let pulse = std::f64::consts::TAU / self.belt.ripple_period_s;
        let ahead_s = self.belt.ripple * (1.0 - (pulse * run_s).cos()) / pulse;
        self.belt.speed_mm_per_s * (run_s + ahead_s) - back_mm
    }

    /// How far the belt has wandered to its side at a time, mm.
    pub fn aside_mm(&self, t_s: f64) -> f64 {
        let phase = std::f64::consts::TAU * t_s / self.belt.side_drift_period_s;
        self.belt.side_drift_mm * phase.sin()
    }

    /// Where a parcel is in the middle of a frame's exposure.
    pub fn place_at_frame(&self, parcel: &Parcel, index: u64) -> Place {
        let t_s = index as f64 / self.fps;
        self.place(parcel, self.travel_mm(t_s), self.aside_mm(t_s))
    }

    /// Where a parcel is when the belt has moved so far, and has swung to the side so far. One that comes
    /// again is put back behind the others once it is out of sight.
    pub(super) fn place(&self, parcel: &Parcel, travel_mm: f64, aside_mm: f64) -> Place {
        let rounds = self.loop_mm.map_or(0.0, |loop_mm| {
            let beyond_mm = parcel.x_mm + travel_mm - OUT_OF_SIGHT_MM;
            let rounds = (beyond_mm / loop_mm).floor() + 1.0;
            rounds.max(0.0) * loop_mm
        });
        parcel.place(travel_mm - rounds, aside_mm)
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
    fn is_usable(&self) -> bool {
        self.at_s >= 0.0
            && self.for_s >= 0.0
            && self.ramp_s > 0.0
            && self.back_mm >= 0.0
            && self.every_s.is_none_or(|s| s >= 2.0 * self.ramp_s + self.for_s)
    }

    /// How often it is over at a time, and the time as it is for the one that is not.
    fn round(&self, t_s: f64) -> (f64, f64) {
        let every_s = self.every_s.unwrap_or(f64::INFINITY);
        let rounds = ((t_s - self.at_s) / every_s).floor().max(0.0);
        if rounds > 0.0 { (rounds, t_s - rounds * every_s) } else { (0.0, t_s) }
    }

    /// How far it has crept back until `t_s`: gently from standstill to standstill.
    fn gone_back_mm(&self, t_s: f64) -> f64 {
        let (rounds, t_s) = self.round(t_s);
        let stands_s = t_s - self.at_s - self.ramp_s;
        let share = (stands_s / self.for_s.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        self.back_mm * (rounds + share * share * (3.0 - 2.0 * share))
    }

    /// Running time lost to the stop until `t_s`: the integral of the missing speed.
    fn lost_s(&self, t_s: f64) -> f64 {
        let (rounds, t_s) = self.round(t_s);
        let ramp = |since_s: f64| {
            let s = since_s.clamp(0.0, self.ramp_s);
            s * s / (2.0 * self.ramp_s) + (since_s - self.ramp_s).max(0.0)
        };
        // The speed that is missing rises in one ramp and falls again in the other.
        let this_one = ramp(t_s - self.at_s) - ramp(t_s - self.at_s - self.ramp_s - self.for_s);
        rounds * (self.for_s + self.ramp_s) + this_one
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
        let stop = StopTable { at_s: 2.0, for_s: 3.0, ramp_s: 0.5, back_mm: 12.0, every_s: None };
        assert!(stop.lost_s(2.0).abs() < 1e-12);
        assert!((stop.lost_s(100.0) - 3.5).abs() < 1e-12);
        // Standing still: all time is lost.
        assert!((stop.lost_s(5.0) - stop.lost_s(3.0) - 2.0).abs() < 1e-12);
        // It creeps back while it stands, and only then.
        let gone = [2.5, 4.0, 5.5, 9.0].map(|t_s| stop.gone_back_mm(t_s));
        assert_eq!(gone.map(|mm| mm.round() as i32), [0, 6, 12, 12]);
        let again = StopTable { every_s: Some(10.0), ..stop };
        assert!((again.lost_s(100.0) - 10.0 * 3.5).abs() < 1e-9, "{}", again.lost_s(100.0));
        assert!((again.gone_back_mm(100.0) - 120.0).abs() < 1e-9);
        // Without a jump where one ends and the next begins.
        let steps = (0..100_000).map(|k| again.lost_s(f64::from(k) * 1e-3));
        let steps: Vec<f64> = steps.collect();
        assert!(steps.windows(2).all(|w| (-1e-9..=1.001e-3).contains(&(w[1] - w[0]))));
    }

    #[test]
    fn the_demo_never_runs_out_of_parcels_and_none_jumps_in_sight() {
        let demo = include_str!("../../../config/demo/scenario.toml");
        let scenario = Scenario::parse(demo).expect("committed");
        let frames_a_day = (86_400.0 * scenario.fps) as u64;
        let in_sight = |index: u64| {
            let places = scenario.parcels().iter().map(|p| scenario.place_at_frame(p, index).x_mm);
            places.filter(|x| x.abs() < 1000.0).count()
        };
        // At any time of any day, also where the first follows the last.
        for index in (0..20_000).chain(frames_a_day..frames_a_day + 20_000).step_by(25).skip(4) {
            let count = in_sight(index);
            assert!((2..12).contains(&count), "{count} parcels in sight in frame {index}");
        }
        let frame_mm = scenario.belt.speed_mm_per_s / scenario.fps;
        for parcel in scenario.parcels() {
            for index in 0..20_000 {
                let [before, after] =
                    [index, index + 1].map(|n| scenario.place_at_frame(parcel, n).x_mm);
                let moved_mm = after - before;
                let jumped = !(-1e-6..=1.001 * frame_mm).contains(&moved_mm);
                assert!(!jumped || before.min(after.abs()) > 4900.0, "{before} to {after}");
            }
        }
    }
}
