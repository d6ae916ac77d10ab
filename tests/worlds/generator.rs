//! Draws worlds: a seed and a class of difficulty for every property make a scenario.

use super::class::{Class, Property, WorldSeed};
use super::riders;
use beltgauge::config::{Config, Site};
use beltgauge::source::Faults;
use beltgauge::source::synthetic::{Random, Scenario};
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::fmt::Write as _;

pub const FPS: f64 = 30.0;
/// Half of the zone, along and across; of a camera that sees less, less.
const ZONE_HALF_MM: [f64; 2] = [420.0, 280.0];
const BELT_WIDTH_MM: f64 = 640.0;
/// The camera sees this much of the zone's sides beside it.
const MARGIN: f64 = 1.2;
/// Larger images take too long: what would need them gets fewer px.
const IMAGE_PX_MAX: [f64; 2] = [1024.0, 704.0];
/// A finer picture shows less of the belt.
const WHOLE_ZONE_MM_PER_PX: f64 = 0.9;

/// What a world's camera leaves room for.
#[derive(Clone, Copy)]
pub struct Room {
    /// Half of the zone, along and across.
    pub half_mm: [f64; 2],
    pub height_max_mm: f64,
    pub mm_per_px: f64,
}

/// A scenario, its text, the site that measures it, and what happens to its frames on the way.
pub struct World {
    pub text: String,
    pub scenario: Scenario,
    /// The site's configuration; its camera is the scenario's.
    pub config: String,
    pub site: Site,
    pub faults: Faults,
}

/// The world of a seed; `class_of` says how hard each property is.
pub fn draw(seed: u64, class_of: impl Fn(Property) -> Class) -> World {
    let seeds = WorldSeed(seed);
    let of = |property: Property| {
        let class = class_of(property).of_property(property, seeds);
        (class, seeds.random(property))
    };
    let (belt_class, mut belt_random) = of(Property::Belt);
    let speed = belt_random.between([0.4_f64.ln(), 1.2_f64.ln()]).exp() * 1000.0;
    let nominal = speed * belt_random.between([0.97, 1.03]);
    let (camera, room) = camera(of(Property::Camera));
    let belt = belt(belt_class, speed, &mut belt_random) + &motion(of(Property::Motion));
    let wear = wear(of(Property::Wear));
    let light = light(of(Property::Light), of(Property::Sun));
    let noise = noise(of(Property::Noise));
    let (sensor, smear_px) = sensor(of(Property::Sensor));
    let exposure_ms = smear_px * room.mm_per_px / speed * 1000.0;
    let (parcels, last_mm) = riders::parcels(&of, &room);
    let visitors =
        riders::visitors(of(Property::Visitors), (room.half_mm[0] - last_mm) / speed, &room);
    let faults = transport(of(Property::Transport), seed);
    let text = format!("{camera}{belt}{wear}{light}{noise}{sensor}{parcels}{visitors}");
    let of_length = |frames: u64| {
        format!(
            "seed = {seed}\nfps = {FPS}\nframes = {frames}\nexposure_ms = {exposure_ms}\n{text}"
        )
    };
    let parse = |text: &str| Scenario::parse(text).unwrap_or_else(|e| panic!("{e}\n{text}"));
    let text = of_length(riders::frames_until_all_have_left(&parse(&of_length(1)), &room));
    let scenario = parse(&text);
    let [x, y] = room.half_mm;
    let config = format!(
        "[camera]\ncalibration = \"camera.toml\"\n[belt]\nspeed_mm_per_s = {nominal}\n\
         [zone]\nx_min_mm = -{x}\nx_max_mm = {x}\ny_min_mm = -{y}\ny_max_mm = {y}\n\
         [view]\nheight_max_mm = {}\n",
        room.height_max_mm
    );
    let camera = scenario.camera().expect("a valid camera");
    let site = Site::new(Config::parse(&config).expect("valid"), camera).expect("a zone in view");
    World { text, scenario, config, site, faults }
}

/// Looks at the middle of the zone, and sees all of it.
fn camera((class, mut random): (Class, Random)) -> (String, Room) {
    let (heights, tilts, scales) = match class {
        Class::Easy => ([1300.0, 1700.0], [0.0, 5.0], [1.6, 1.6]),
        Class::Extreme => ([800.0, 3000.0], [5.0, 30.0_f64], [0.5, 3.0]),
        _ => ([1100.0, 2500.0], [0.0, 12.0], [1.2, 2.2]),
    };
    let height_mm = random.between(heights);
    let steep = random.between([30.0, 60.0]);
    let is_steep = class == Class::Extreme && random.unit() < 0.2;
    let tilt = if is_steep { steep } else { random.between(tilts) }.to_radians();
    let direction = random.between([0.0, std::f64::consts::TAU]);
    let mm_per_px = riders::ratio(&mut random, scales);
    // From a slant a single lane is seen.
    let part = (mm_per_px / WHOLE_ZONE_MM_PER_PX).min(if is_steep { 0.6 } else { 1.0 });
    let half_mm = ZONE_HALF_MM.map(|half| half * part);
    let tilted = Rotation3::new(Vector3::new(direction.cos(), direction.sin(), 0.0) * tilt);
    // Looking straight down with +X to the right: y and z of the camera point to -Y and -Z.
    let down = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let r = tilted.matrix() * down;
    let centre = -r.row(2).transpose() * (height_mm / -r[(2, 2)]);
    let t = -r * centre;
    // What the zone and something beside it take of a picture whose focal length is 1.
    let mut reach = [0.0f64; 2];
    for k in 0..4 {
        let sign = |bit: i32| if k >> bit & 1 == 1 { MARGIN } else { -MARGIN };
        let at = r * Vector3::new(sign(0) * half_mm[0], sign(1) * half_mm[1], 0.0) + t;
        reach = [reach[0].max((at.x / at.z).abs()), reach[1].max((at.y / at.z).abs())];
    }
    let finest = (0.5 * IMAGE_PX_MAX[0] / reach[0]).min(0.5 * IMAGE_PX_MAX[1] / reach[1]);
    let f = (centre.norm() / mm_per_px).min(finest);
    let [w, h] = reach.map(|reach| ((2.0 * f * reach) / 16.0).ceil() * 16.0);
    let barrel = random.between([-0.2, -0.05]);
    // The same view through a fisheye: r = f (angle + k1 angle^3), k1 about that of the barrel.
    let lens = if class != Class::Easy && random.unit() < 0.25 {
        format!("\"fisheye\"\ndistortion = [{}, 0.01, 0, 0]", 0.25 * barrel)
    } else {
        format!("\"brown\"\ndistortion = [{barrel}, 0.06, 0, 0, 0]")
    };
    let row = |i: usize| format!("[{}, {}, {}]", r[(i, 0)], r[(i, 1)], r[(i, 2)]);
    let text = format!(
        "[camera]\nimage_size_px = [{w}, {h}]\n[camera.lens]\nmodel = {lens}\n\
         fx_px = {f}\nfy_px = {f}\ncx_px = {}\ncy_px = {}\n[camera.pose]\nrotation = [{}, {}, {}]\ntranslation_mm = [{}, {}, {}]\n",
        0.5 * w + random.between([-15.0, 15.0]),
        0.5 * h + random.between([-15.0, 15.0]),
        row(0),
        row(1),
        row(2),
        t.x,
        t.y,
        t.z
    );
    let height_max_mm = riders::HEIGHT_MAX_MM.min(0.4 * height_mm);
    (text, Room { half_mm, height_max_mm, mm_per_px: centre.norm() / f })
}

fn belt(class: Class, speed: f64, random: &mut Random) -> String {
    let periodic = class.has(Class::Periodic);
    let texture = match class {
        Class::Easy => 1.3,
        // As moulded plastic: nothing but the pattern. What noise hides does no harm.
        _ if periodic && random.unit() < 0.75 => 0.0,
        Class::Extreme => random.between([0.1, 20.0]),
        _ => random.between([0.6, 4.0]),
    };
    let grey = if class == Class::Easy { 45.0 } else { random.between([25.0, 90.0]) };
    let mut text = format!(
        "[belt]\nspeed_mm_per_s = {speed}\nwidth_mm = {BELT_WIDTH_MM}\ngrey = {grey}\n\
         texture_grey = {texture}\n"
    );
    if periodic {
        let kind = ["modular", "modular", "ribbed", "woven"][(random.unit() * 4.0) as usize];
        let pitch = riders::ratio(random, [5.0, 60.0]);
        let rows = if random.unit() < 0.3 { 0.0 } else { random.between([60.0, 150.0]) };
        let pattern = format!(
            "kind = \"{kind}\", pitch_mm = {pitch}, contrast_grey = {}, gap_mm = {}, row_mm = {rows}",
            random.between([0.15, 0.7]) * grey,
            random.between([0.06, 0.15]) * pitch
        );
        let _ = writeln!(text, "pattern = {{ {pattern} }}");
    }
    text
}

/// How it runs: swings of speed, to the side, stops, and creeping back. Goes on with `[belt]`.
fn motion((class, mut random): (Class, Random)) -> String {
    if class == Class::Easy {
        return String::new();
    }
    let mut text = format!("ripple = {}\nripple_period_s = 1.7\n", random.between([0.0, 0.02]));
    if class.has(Class::Worn) {
        let _ = writeln!(
            text,
            "side_drift_mm = {}\nside_drift_period_s = {}",
            random.between([0.0, 6.0]),
            random.between([3.0, 9.0])
        );
        if random.unit() < 0.6 {
            let _ = writeln!(
                text,
                "stop = [{{ at_s = {}, for_s = {}, ramp_s = 0.3, back_mm = {} }}]",
                random.between([1.5, 3.0]),
                random.between([0.3, 1.2]),
                if random.unit() < 0.5 { 0.0 } else { random.between([2.0, 20.0]) }
            );
        }
    }
    text
}

/// Dirt, seams, labels that stick, shine. Goes on with `[belt]`, and has tables of it.
fn wear((class, mut random): (Class, Random)) -> String {
    if !class.has(Class::Worn) {
        return String::new();
    }
    let mut text = format!("shine = {}\n", random.between([0.0, 0.5]));
    let _ = write!(
        text,
        "[belt.dirt]\nper_m2 = {}\nsize_mm = [4, 70]\ngrey = [{}, {}]\n",
        random.between([5.0, 150.0]),
        random.between([5.0, 40.0]),
        random.between([60.0, 150.0])
    );
    // A seam, as belts have one, and labels that came off a parcel.
    let _ = write!(
        text,
        "[[belt.mark]]\nx_mm = {}\ny_mm = 0\nlength_mm = {}\nwidth_mm = {BELT_WIDTH_MM}\nyaw_deg = {}\n\
         grey = {}\n",
        random.between([-1800.0, 0.0]),
        random.between([3.0, 30.0]),
        random.between([-20.0, 20.0]),
        random.between([5.0, 120.0])
    );
    for _ in 0..(random.unit() * 4.0) as usize {
        let _ = write!(
            text,
            "[[belt.mark]]\nx_mm = {}\ny_mm = {}\nlength_mm = {}\nwidth_mm = {}\nyaw_deg = {}\n\
             grey = {}\n",
            random.between([-2000.0, 300.0]),
            random.between([-220.0, 220.0]),
            random.between([50.0, 150.0]),
            random.between([30.0, 100.0]),
            random.between([-90.0, 90.0]),
            random.between([120.0, 215.0])
        );
    }
    text
}

fn light((class, mut random): (Class, Random), (sun_class, sun): (Class, Random)) -> String {
    let sun = sunshine(sun_class, sun);
    let hard = class.has(Class::HardLight);
    let (lamps, radius, ambient) = match class {
        // Without lamps light comes from everywhere, and the sun would have no shadow to throw.
        Class::Easy if sun.is_empty() => {
            return "[light]\ndrift = 0.03\ndrift_period_s = 3.0\nshadow = 0.4\n".into();
        }
        Class::Easy => (3, [350.0, 350.0], [0.6, 0.6]),
        _ if hard => (1 + (random.unit() * 2.0) as usize, [8.0, 60.0], [0.1, 0.3]),
        _ => (2 + (random.unit() * 3.0) as usize, [150.0, 350.0], [0.35, 0.6]),
    };
    let ambient = random.between(ambient);
    let mut text = format!(
        "[light]\ndrift = {}\ndrift_period_s = 5.0\nshadow = 0.2\nambient = {ambient}\n\
         flicker = {}\nflicker_hz = {}\n",
        random.between([0.0, 0.08]),
        random.between([0.0, 0.04]),
        // Twice the mains', and what camera and mains are off by: a beat.
        [100.0, 120.0][usize::from(random.unit() < 0.5)] + random.between([-0.9, 0.9])
    );
    if hard && random.unit() < 0.5 {
        let _ =
            write!(text, "[[light.step]]\nat_s = 2.5\nfactor = {}\n", random.between([0.7, 1.3]));
    }
    let shares: Vec<f64> = (0..lamps).map(|_| random.between([0.5, 1.5])).collect();
    for share in &shares {
        let _ = write!(
            text,
            "[[light.lamp]]\nx_mm = {}\ny_mm = {}\nz_mm = {}\nradius_mm = {}\nstrength = {}\n",
            random.between([-900.0, 900.0]),
            random.between([-900.0, 900.0]),
            random.between([1300.0, 2800.0]),
            random.between(radius),
            (1.0 - ambient) * share / shares.iter().sum::<f64>()
        );
    }
    text + &sun
}

/// A patch of sun on the belt: a lamp far away, behind a window.
fn sunshine(class: Class, mut random: Random) -> String {
    const FAR_MM: f64 = 100_000.0;
    // The sun's radius in the sky.
    const SUN_RAD: f64 = 0.0047;
    if !class.has(Class::Visited) || random.unit() < 0.3 {
        return String::new();
    }
    let (azimuth, steep) =
        (random.between([0.0, std::f64::consts::TAU]), random.between([0.5, 1.2]));
    let aside_mm = FAR_MM / steep;
    let way = aside_mm.hypot(FAR_MM);
    // Of light that comes at a slant, less falls on the belt; the lamp's strength is that right under it.
    let strength = random.between([0.5, 1.2]) * (way / FAR_MM).powi(3);
    format!(
        "[[light.lamp]]\nx_mm = {}\ny_mm = {}\nz_mm = {FAR_MM}\nradius_mm = {}\nstrength = {strength}\n\
         window = {{ x_mm = {}, y_mm = {}, length_mm = {}, width_mm = {}, yaw_deg = {}, edge_mm = {} }}\n",
        aside_mm * azimuth.cos(),
        aside_mm * azimuth.sin(),
        SUN_RAD * way,
        random.between([-300.0, 300.0]),
        random.between([-200.0, 200.0]),
        random.between([150.0, 500.0]),
        random.between([80.0, 250.0]),
        random.between([-90.0, 90.0]),
        random.between([5.0, 25.0])
    )
}

fn noise((class, mut random): (Class, Random)) -> String {
    let read = match class {
        Class::Easy => 0.3,
        _ if class.has(Class::Noisy) => random.between([2.0, 6.0]),
        _ => random.between([0.5, 1.5]),
    };
    format!("[noise]\nread_grey = {read}\nelectrons_per_grey = 65\n")
}

/// And how far the belt moves while the shutter is open, px.
fn sensor((class, mut random): (Class, Random)) -> (String, f64) {
    if class == Class::Easy {
        return (String::new(), 0.5);
    }
    let harsh = class.has(Class::Noisy);
    let blur = random.between(if harsh { [0.6, 2.5] } else { [0.3, 0.8] });
    let vibration = random.between(if harsh { [0.0, 0.5] } else { [0.0, 0.1] });
    let gamma = if random.unit() < 0.5 { 1.0 } else { random.between([0.6, 1.0]) };
    let denoise = if harsh && random.unit() < 0.3 { random.between([0.2, 0.6]) } else { 0.0 };
    let jpeg = if harsh && random.unit() < 0.5 { random.between([50.0, 95.0]) as u8 } else { 0 };
    let auto = random.unit() < if harsh { 0.5 } else { 0.15 };
    let auto = if auto { random.between([35.0, 80.0]) } else { 0.0 };
    let smear_px = random.between(if harsh { [0.5, 3.0] } else { [0.2, 1.0] });
    let text = format!(
        "[sensor]\nblur_px = {blur}\nvibration_px = {vibration}\ngamma = {gamma}\n\
         denoise = {denoise}\njpeg_quality = {jpeg}\nauto_exposure_grey = {auto}\n\
         auto_exposure_frames = {}\n",
        random.between([4.0, 30.0])
    );
    (text, smear_px)
}

/// What happens to frames between camera and program.
fn transport((class, mut random): (Class, Random), seed: u64) -> Faults {
    if !class.has(Class::Transport) {
        return Faults::default();
    }
    let mut sometimes = |share: f64, range: [f64; 2]| {
        let value = random.between(range);
        if random.unit() < share { value } else { 0.0 }
    };
    Faults {
        drop: sometimes(0.6, [0.01, 0.2]),
        double: sometimes(0.3, [0.01, 0.1]),
        swap: sometimes(0.3, [0.01, 0.1]),
        late_ms: sometimes(0.5, [0.5, 8.0]),
        noise_grey: 0.0,
        codec_grey: sometimes(0.6, [4.0, 30.0]),
        seed,
    }
}
