//! Draws worlds: a seed and a class of difficulty for every property make a scenario.

use beltgauge::config::{Config, Site};
use beltgauge::source::synthetic::{Random, Scenario};
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::fmt::Write as _;

const FPS: f64 = 40.0;
const SIZE_PX: [f64; 2] = [800.0, 512.0];
const ZONE_HALF_MM: [f64; 2] = [420.0, 280.0];
const BELT_WIDTH_MM: f64 = 640.0;

/// How hard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Even light, free belt, single cartons.
    Easy,
    /// Large lamps, every material, light that drifts, a belt that swings a little.
    Industrial,
    /// One or two small lamps: hard shadows, glare.
    HardLight,
    /// Black cartons a few cm apart.
    Dense,
    /// Ribs or modules of strict pitch.
    Periodic,
    /// 2 to 6 grey levels of noise, blur, JPEG.
    Noisy,
    /// All of it.
    Extreme,
}

impl Class {
    pub const ALL: [(Self, &'static str); 7] = [
        (Self::Easy, "easy"),
        (Self::Industrial, "industrial"),
        (Self::HardLight, "hard_light"),
        (Self::Dense, "dense"),
        (Self::Periodic, "periodic"),
        (Self::Noisy, "noisy"),
        (Self::Extreme, "extreme"),
    ];

    /// Whether a world of this class has what `other` is about.
    fn has(self, other: Self) -> bool {
        self == other || self == Self::Extreme
    }
}

/// What can be drawn on its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Property {
    Camera,
    Belt,
    Light,
    Noise,
    Sensor,
    Parcels,
}

impl Property {
    pub const ALL: [Self; 6] =
        [Self::Camera, Self::Belt, Self::Light, Self::Noise, Self::Sensor, Self::Parcels];
}

/// A scenario, its text and the site that measures it.
pub struct World {
    pub text: String,
    pub scenario: Scenario,
    pub site: Site,
}

/// The world of a seed; `class_of` says how hard each property is.
pub fn draw(seed: u64, class_of: impl Fn(Property) -> Class) -> World {
    // Each property has its own generator: making one easy leaves the others as they are.
    let random = |property: Property| {
        Random(seed.wrapping_mul(0x9e37_79b9) ^ (property as u64 + 1).wrapping_mul(0x85eb_ca6b))
    };
    let mut belt_random = random(Property::Belt);
    let speed = belt_random.between([0.4_f64.ln(), 1.2_f64.ln()]).exp() * 1000.0;
    let nominal = speed * belt_random.between([0.97, 1.03]);
    let camera = camera(class_of(Property::Camera), &mut random(Property::Camera));
    let belt = belt(class_of(Property::Belt), speed, &mut belt_random);
    let light = light(class_of(Property::Light), &mut random(Property::Light));
    let noise = noise(class_of(Property::Noise), &mut random(Property::Noise));
    let sensor = sensor(class_of(Property::Sensor), &mut random(Property::Sensor));
    let (parcels, last_mm) = parcels(class_of(Property::Parcels), &mut random(Property::Parcels));
    let frames = ((ZONE_HALF_MM[0] + 400.0 - last_mm) / speed * FPS) as u64 + 5;
    let text = format!(
        "seed = {seed}\nfps = {FPS}\nframes = {frames}\nexposure_ms = 1.0\n\
         {camera}{belt}{light}{noise}{sensor}{parcels}"
    );
    let scenario = Scenario::parse(&text).expect("a valid scenario");
    let [x, y] = ZONE_HALF_MM;
    let config = format!(
        "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = {nominal}\n\
         [zone]\nx_min_mm = -{x}\nx_max_mm = {x}\ny_min_mm = -{y}\ny_max_mm = {y}\n"
    );
    let camera = scenario.camera().expect("a valid camera");
    let site = Site::new(Config::parse(&config).expect("valid"), camera).expect("a zone in view");
    World { text, scenario, site }
}

/// About 1.6 mm a pixel; looks at the middle of the zone.
fn camera(class: Class, random: &mut Random) -> String {
    let (heights, tilts) = match class {
        Class::Easy => ([1300.0, 1700.0], [0.0, 5.0]),
        Class::Extreme => ([900.0, 2500.0], [5.0, 25.0_f64]),
        _ => ([1200.0, 2200.0], [0.0, 12.0]),
    };
    let height_mm = random.between(heights);
    let tilt = random.between(tilts).to_radians();
    let direction = random.between([0.0, std::f64::consts::TAU]);
    let tilted = Rotation3::new(Vector3::new(direction.cos(), direction.sin(), 0.0) * tilt);
    // Looking straight down with +X to the right: y and z of the camera point to -Y and -Z.
    let down = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let r = tilted.matrix() * down;
    let centre = -r.row(2).transpose() * (height_mm / -r[(2, 2)]);
    let t = -r * centre;
    let f = centre.norm() / random.between([1.5, 1.7]);
    let [w, h] = SIZE_PX;
    let barrel = random.between([-0.2, -0.05]);
    let row = |i: usize| format!("[{}, {}, {}]", r[(i, 0)], r[(i, 1)], r[(i, 2)]);
    format!(
        "[camera]\nimage_size_px = [{w}, {h}]\n[camera.lens]\nmodel = \"brown\"\n\
         fx_px = {f}\nfy_px = {f}\ncx_px = {}\ncy_px = {}\ndistortion = [{barrel}, 0.06, 0, 0, 0]\n\
         [camera.pose]\nrotation = [{}, {}, {}]\ntranslation_mm = [{}, {}, {}]\n",
        0.5 * w + random.between([-15.0, 15.0]),
        0.5 * h + random.between([-15.0, 15.0]),
        row(0),
        row(1),
        row(2),
        t.x,
        t.y,
        t.z
    )
}

fn belt(class: Class, speed: f64, random: &mut Random) -> String {
    let texture = match class {
        Class::Easy => 1.3,
        Class::Extreme => random.between([0.1, 20.0]),
        _ => random.between([0.6, 4.0]),
    };
    let grey = if class == Class::Easy { 45.0 } else { random.between([25.0, 90.0]) };
    let ripple = if class == Class::Easy { 0.0 } else { random.between([0.0, 0.02]) };
    let mut text = format!(
        "[belt]\nspeed_mm_per_s = {speed}\nwidth_mm = {BELT_WIDTH_MM}\ngrey = {grey}\n\
         texture_grey = {texture}\nripple = {ripple}\nripple_period_s = 1.7\n"
    );
    if class.has(Class::Periodic) {
        let kind = ["woven", "ribbed", "modular"][(random.unit() * 3.0) as usize];
        let pitch = random.between([5.0_f64.ln(), 60.0_f64.ln()]).exp();
        let rows = if random.unit() < 0.5 { 0.0 } else { random.between([60.0, 150.0]) };
        let _ = write!(
            text,
            "[belt.pattern]\nkind = \"{kind}\"\npitch_mm = {pitch}\ncontrast_grey = {}\n\
             gap_mm = {}\nrow_mm = {rows}\n",
            random.between([8.0, 25.0]),
            0.15 * pitch
        );
    }
    text
}

fn light(class: Class, random: &mut Random) -> String {
    let hard = class.has(Class::HardLight);
    let (lamps, radius, ambient) = match class {
        Class::Easy => return "[light]\ndrift = 0.03\ndrift_period_s = 3.0\nshadow = 0.4\n".into(),
        _ if hard => (1 + (random.unit() * 2.0) as usize, [8.0, 60.0], [0.1, 0.3]),
        _ => (2 + (random.unit() * 3.0) as usize, [150.0, 350.0], [0.35, 0.6]),
    };
    let ambient = random.between(ambient);
    let mut text = format!(
        "[light]\ndrift = {}\ndrift_period_s = 5.0\nshadow = 0.2\nambient = {ambient}\n\
         flicker = {}\nflicker_hz = 100.6\n",
        random.between([0.0, 0.08]),
        random.between([0.0, 0.04])
    );
    if hard && random.unit() < 0.5 {
        let _ =
            write!(text, "[[light.step]]\nat_s = 2.5\nfactor = {}\n", random.between([0.7, 1.3]));
    }
    for _ in 0..lamps {
        let _ = write!(
            text,
            "[[light.lamp]]\nx_mm = {}\ny_mm = {}\nz_mm = {}\nradius_mm = {}\nstrength = {}\n",
            random.between([-900.0, 900.0]),
            random.between([-900.0, 900.0]),
            random.between([1300.0, 2800.0]),
            random.between(radius),
            (1.0 - ambient) / lamps as f64
        );
    }
    text
}

fn noise(class: Class, random: &mut Random) -> String {
    let read = match class {
        Class::Easy => 0.3,
        _ if class.has(Class::Noisy) => random.between([2.0, 6.0]),
        _ => random.between([0.5, 1.5]),
    };
    format!("[noise]\nread_grey = {read}\nelectrons_per_grey = 65\n")
}

fn sensor(class: Class, random: &mut Random) -> String {
    if class == Class::Easy {
        return String::new();
    }
    let harsh = class.has(Class::Noisy);
    let blur = random.between(if harsh { [0.6, 1.8] } else { [0.3, 0.8] });
    let vibration = random.between(if harsh { [0.0, 0.4] } else { [0.0, 0.1] });
    let gamma = if random.unit() < 0.5 { 1.0 } else { random.between([0.6, 1.0]) };
    let denoise = if harsh && random.unit() < 0.3 { random.between([0.2, 0.6]) } else { 0.0 };
    let jpeg = if harsh && random.unit() < 0.5 { random.between([50.0, 95.0]) as u8 } else { 0 };
    format!(
        "[sensor]\nblur_px = {blur}\nvibration_px = {vibration}\ngamma = {gamma}\n\
         denoise = {denoise}\njpeg_quality = {jpeg}\n"
    )
}

/// Parcels, all of them inside the zone's sides, and where the last one begins.
fn parcels(class: Class, random: &mut Random) -> (String, f64) {
    let dense = class.has(Class::Dense);
    let (count, gaps, materials): (usize, [f64; 2], &[&str]) = match class {
        Class::Easy => (5, [100.0, 200.0], &["kraft", "kraft", "white"]),
        _ if dense => (8, [10.0, 60.0], &["dark", "dark", "kraft", "printed"]),
        _ => (5, [70.0, 200.0], &["kraft", "white", "dark", "glossy", "printed"]),
    };
    let mut text = String::new();
    // The first ones of an extreme world lie on the belt in the first frame.
    let mut end_mm = if class == Class::Extreme { 100.0 } else { -ZONE_HALF_MM[0] - 500.0 };
    for _ in 0..count {
        let (a, b) = (random.between([60.0, 300.0]), random.between([60.0, 300.0]));
        let (l, w) = (a.max(b), a.min(b));
        let h = random.between([4.0_f64.ln(), 250.0_f64.ln()]).exp().min(1.5 * w);
        let yaw_deg = random.between([-90.0, 90.0]);
        let (sin, cos) = yaw_deg.to_radians().sin_cos();
        let half_x_mm = 0.5 * (l * cos.abs() + w * sin.abs());
        let room_mm = (ZONE_HALF_MM[1] - 0.5 * (l * sin.abs() + w * cos.abs())).max(0.0);
        // A parcel's height hides what is behind it.
        let gap_mm = random.between(gaps) + if dense { 0.1 * h } else { 0.5 * h };
        let material = materials[(random.unit() * materials.len() as f64) as usize];
        let _ = writeln!(
            text,
            "[[parcel]]\nlength_mm = {l}\nwidth_mm = {w}\nheight_mm = {h}\nyaw_deg = {yaw_deg}\n\
             x_mm = {}\ny_mm = {}\nmaterial = \"{material}\"",
            end_mm - half_x_mm,
            random.between([-room_mm, room_mm])
        );
        end_mm -= 2.0 * half_x_mm + gap_mm;
    }
    (text, end_mm)
}
