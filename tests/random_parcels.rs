//! Random parcels on random belts under random cameras: found once, measured, and the
//! uncertainty honest. `BELTS=50 cargo test --test random_parcels -- --nocapture` runs more of them.
//! Every parcel goes to `target/tmp/random_parcels.csv`, a plot of the errors to `.svg` beside it.
//! `VARIANT=` `no_blur`, `no_noise`, `no_rounding` or `true_speed` takes one source of error away.

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::event::{ParcelRecord, Shape};
use beltgauge::source::synthetic::{Parcel, Random, Scenario};
use common::measure_scenario;
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::fmt::Write as _;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

const BELTS: u64 = 12;
const PARCELS_PER_BELT: usize = 10;
const FPS: f64 = 40.0;
const SIZE_PX: [f64; 2] = [1280.0, 800.0];
const ZONE_HALF_MM: [f64; 2] = [480.0, 360.0];

/// One parcel of the table.
struct Row {
    belt: u64,
    truth: Parcel,
    record: ParcelRecord,
    errors_mm: [f64; 3],
    sigmas_mm: [f64; 3],
}

/// A camera 1.3 to 1.7 m above the belt, up to 10 degrees off its normal, 1.5 mm a pixel, looking
/// at the middle of the zone.
fn camera(random: &mut Random) -> String {
    let height_mm = random.between([1300.0, 1700.0]);
    let tilt = random.between([0.0, 10.0_f64]).to_radians();
    let direction = random.between([0.0, std::f64::consts::TAU]);
    let axis = Vector3::new(direction.cos(), direction.sin(), 0.0);
    // Looking straight down with +X to the right: y and z of the camera point to -Y and -Z.
    let down = Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0);
    let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), random.between([-0.03, 0.03]));
    let tilted = Rotation3::new(axis * tilt);
    let r = roll.matrix() * tilted.matrix() * down;
    // The optical axis meets the belt at the origin.
    let centre = -r.row(2).transpose() * (height_mm / -r[(2, 2)]);
    let t = -r * centre;
    let f = height_mm / random.between([1.4, 1.6]);
    let [w, h] = SIZE_PX;
    format!(
        "[camera]\nimage_size_px = [{w}, {h}]\n[camera.lens]\nmodel = \"brown\"\nfx_px = {f}\nfy_px = {}\n\
         cx_px = {}\ncy_px = {}\ndistortion = [{}, 0.06, 0.0005, -0.0004, 0.0]\n[camera.pose]\n\
         rotation = [[{}, {}, {}], [{}, {}, {}], [{}, {}, {}]]\ntranslation_mm = [{}, {}, {}]\n",
        f * random.between([0.999, 1.001]),
        0.5 * w + random.between([-20.0, 20.0]),
        0.5 * h + random.between([-20.0, 20.0]),
        random.between([-0.2, -0.1]),
        r[(0, 0)],
        r[(0, 1)],
        r[(0, 2)],
        r[(1, 0)],
        r[(1, 1)],
        r[(1, 2)],
        r[(2, 0)],
        r[(2, 1)],
        r[(2, 2)],
        t.x,
        t.y,
        t.z,
    )
}

/// 20 to 600 mm long and wide, 4 to 400 mm high, all of it in the zone.
fn parcels(random: &mut Random) -> String {
    let log =
        |random: &mut Random, [low, high]: [f64; 2]| (random.between([low.ln(), high.ln()])).exp();
    let mut text = String::new();
    // Out of sight while the empty belt is learned.
    let mut end_mm = -ZONE_HALF_MM[0] - 800.0;
    for _ in 0..PARCELS_PER_BELT {
        let (a, b) = (log(random, [20.0, 600.0]), log(random, [20.0, 600.0]));
        let (l, w) = (a.max(b), a.min(b));
        // What is higher than it is long falls over.
        let h = log(random, [4.0, 400.0]).min(1.5 * w.max(10.0));
        let yaw_deg = random.between([-90.0, 90.0]);
        let (sin, cos) = yaw_deg.to_radians().sin_cos();
        let half_x_mm = 0.5 * (l * cos.abs() + w * sin.abs());
        let half_y_mm = 0.5 * (l * sin.abs() + w * cos.abs());
        let room_mm = (ZONE_HALF_MM[1] - half_y_mm).max(0.0);
        if half_y_mm > ZONE_HALF_MM[1] {
            continue;
        }
        // A parcel's height hides what is behind it.
        let gap_mm = random.between([60.0, 200.0]) + 0.5 * h;
        let material = ["kraft", "kraft", "kraft", "white", "dark"][(random.unit() * 5.0) as usize];
        let _ = writeln!(
            text,
            "[[parcel]]\nlength_mm = {l}\nwidth_mm = {w}\nheight_mm = {h}\nyaw_deg = {yaw_deg}\n\
             x_mm = {}\ny_mm = {}\nmaterial = \"{material}\"",
            end_mm - half_x_mm,
            random.between([-room_mm, room_mm])
        );
        end_mm -= 2.0 * half_x_mm + gap_mm;
    }
    text
}

/// What a variant changes in the scenario, and in the configuration.
struct Variant {
    exposure_ms: f64,
    edge_radius_mm: f64,
    noise: &'static str,
    odometry: &'static str,
    true_speed: bool,
}

fn variant() -> Variant {
    let all = Variant {
        exposure_ms: 1.0,
        edge_radius_mm: 1.2,
        noise: "",
        odometry: "",
        true_speed: false,
    };
    match std::env::var("VARIANT").as_deref() {
        Err(_) => all,
        Ok("no_blur") => Variant { exposure_ms: 0.0, ..all },
        Ok("no_rounding") => Variant { edge_radius_mm: 0.0, ..all },
        Ok("no_noise") => {
            Variant { noise: "[noise]\nread_grey = 0\nelectrons_per_grey = 1e9\n", ..all }
        }
        Ok("true_speed") => {
            Variant { odometry: "[odometry]\nspeed_error_max = 0\n", true_speed: true, ..all }
        }
        Ok(other) => panic!("no variant {other}"),
    }
}

fn run_belt(seed: u64) -> (Vec<Row>, Vec<String>) {
    let variant = variant();
    let mut random = Random(seed.wrapping_mul(0x9e37_79b9) ^ 0xbe17);
    let speed = random.between([0.2_f64.ln(), 2.0_f64.ln()]).exp() * 1000.0;
    let camera = camera(&mut random);
    let parcels = parcels(&mut random);
    let wrong = random.between([0.95, 1.05]);
    let nominal = speed * if variant.true_speed { 1.0 } else { wrong };
    let drift = random.between([0.0, 0.1]);
    let base = format!(
        "seed = {seed}\nfps = {FPS}\nframes = FRAMES\nexposure_ms = {}\nedge_radius_mm = {}\n{camera}\
         [belt]\nspeed_mm_per_s = {speed}\nwidth_mm = 900\ngrey = 45\ntexture_grey = 1.3\n\
         [light]\ndrift = {drift}\ndrift_period_s = 3.0\nshadow = 0.4\n{}{parcels}",
        variant.exposure_ms, variant.edge_radius_mm, variant.noise
    );
    let first = Scenario::parse(&base.replace("FRAMES", "1")).expect("a valid scenario");
    let last_mm = first.parcels().iter().map(|p| p.x_mm).fold(0.0, f64::min);
    let frames = ((ZONE_HALF_MM[0] + 450.0 - last_mm) / speed * FPS) as u64 + 5;
    let scenario = Scenario::parse(&base.replace("FRAMES", &frames.to_string())).expect("valid");
    let [x, y] = ZONE_HALF_MM;
    let config = format!(
        "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = {nominal}\n\
         [zone]\nx_min_mm = -{x}\nx_max_mm = {x}\ny_min_mm = -{y}\ny_max_mm = {y}\n\
         [measure]\nedge_radius_mm = {}\n{}",
        variant.edge_radius_mm, variant.odometry
    );
    let site = Site::new(
        Config::parse(&config).expect("valid"),
        scenario.camera().expect("a valid camera"),
    );
    let records = measure_scenario(&scenario, site.expect("a zone in view"));
    matched(seed, &scenario, &records)
}

/// Rows of what was found, and complaints about what was not, or twice.
fn matched(belt: u64, scenario: &Scenario, records: &[ParcelRecord]) -> (Vec<Row>, Vec<String>) {
    let mut free: Vec<&Parcel> = scenario.parcels().iter().collect();
    let (mut rows, mut complaints) = (Vec::new(), Vec::new());
    for record in records {
        let travel_mm = scenario.travel_at_frame_mm(record.frame);
        let distance = |p: &&Parcel| (p.x_mm + travel_mm - record.x_mm).hypot(p.y_mm - record.y_mm);
        let nearest =
            (0..free.len()).min_by(|&a, &b| distance(&free[a]).total_cmp(&distance(&free[b])));
        let Some(at) = nearest.filter(|&i| distance(&free[i]) < 40.0) else {
            complaints.push(format!("belt {belt}: no parcel, or twice: {record:?}"));
            continue;
        };
        let truth = *free.remove(at);
        let found = [record.length_mm, record.width_mm, record.height_mm];
        let real = [truth.length_mm, truth.width_mm, truth.height_mm];
        rows.push(Row {
            belt,
            truth,
            record: *record,
            errors_mm: std::array::from_fn(|i| found[i] - real[i]),
            sigmas_mm: [record.sigma_length_mm, record.sigma_width_mm, record.sigma_height_mm],
        });
    }
    complaints.extend(free.iter().map(|p| format!("belt {belt}: lost: {p:?}")));
    (rows, complaints)
}

#[test]
fn random_parcels_are_found_once_and_measured_with_honest_sigma() {
    let belts = std::env::var("BELTS").map_or(BELTS, |n| n.parse().expect("a number of belts"));
    let next = AtomicU64::new(std::env::var("FIRST").map_or(0, |n| n.parse().expect("a number")));
    let end = next.load(Ordering::Relaxed) + belts;
    let all = Mutex::new((Vec::new(), Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= end {
                        break;
                    }
                    let (rows, complaints) = run_belt(seed);
                    let mut all = all.lock().expect("no panic");
                    all.0.extend(rows);
                    all.1.extend(complaints);
                }
            });
        }
    });
    let (rows, complaints) = all.into_inner().expect("no panic");
    judge(&rows, &complaints);
}

/// Errors of length (blue), width (green) and height (red), -4 to 4 mm, over height, yaw, place
/// across the belt and speed.
fn plot(rows: &[Row]) -> String {
    type Value = fn(&Row) -> f64;
    let panels: [(&str, [f64; 2], Value); 4] = [
        ("height, mm", [0.0, 400.0], |r| r.truth.height_mm),
        ("yaw, degrees", [-90.0, 90.0], |r| r.truth.yaw_deg),
        ("y, mm", [-360.0, 360.0], |r| r.truth.y_mm),
        ("belt speed, mm/s", [0.0, 2000.0], |r| r.record.belt_speed_mm_per_s),
    ];
    let mut svg = String::from(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 1000 520\" \
         font-family=\"sans-serif\" font-size=\"13\"><rect width=\"1000\" height=\"520\" fill=\"#fff\"/>",
    );
    for (k, (name, [low, high], value)) in panels.into_iter().enumerate() {
        let (left, top) = (50.0 + 490.0 * (k % 2) as f64, 15.0 + 260.0 * (k / 2) as f64);
        for mm in [-4.0, -2.0, 0.0, 2.0, 4.0] {
            let y = top + 110.0 - 25.0 * mm;
            let _ = write!(
                svg,
                "<path d=\"M{left} {y}h430\" stroke=\"#ccc\"/><text x=\"{}\" y=\"{}\">{mm}</text>",
                left - 25.0,
                y + 4.0
            );
        }
        let y = top + 230.0;
        let _ = write!(
            svg,
            "<text x=\"{left}\" y=\"{y}\">{low}</text><text x=\"{}\" y=\"{y}\">{high}</text>\
             <text x=\"{}\" y=\"{y}\">{name}</text>",
            left + 400.0,
            left + 180.0
        );
        for row in rows {
            let x = left + 430.0 * (value(row) - low) / (high - low);
            for (error_mm, colour) in row.errors_mm.iter().zip(["#2563eb", "#1b9e5a", "#d13b2e"]) {
                let y = top + 110.0 - 25.0 * error_mm.clamp(-4.2, 4.2);
                let _ = write!(
                    svg,
                    "<circle cx=\"{x:.0}\" cy=\"{y:.1}\" r=\"2\" fill=\"{colour}\" fill-opacity=\".6\"/>"
                );
            }
        }
    }
    svg + "</svg>\n"
}

fn judge(rows: &[Row], complaints: &[String]) {
    let mut csv = String::from("belt,l,w,h,yaw,y,material,el,ew,eh,sl,sw,sh,shape,flags,speed\n");
    let mut errors = Vec::new();
    let mut honest = 0;
    for r in rows {
        let (t, [el, ew, eh], [sl, sw, sh]) = (&r.truth, r.errors_mm, r.sigmas_mm);
        let _ = writeln!(
            csv,
            "{},{:.1},{:.1},{:.1},{:.1},{:.1},{:?},{el:.2},{ew:.2},{eh:.2},{sl:.2},{sw:.2},{sh:.2},{:?},{},{:.0}",
            r.belt,
            t.length_mm,
            t.width_mm,
            t.height_mm,
            t.yaw_deg,
            t.y_mm,
            t.material,
            r.record.shape,
            r.record.flags.to_string().replace(", ", "+"),
            r.record.belt_speed_mm_per_s
        );
        for (error, sigma) in r.errors_mm.iter().zip(r.sigmas_mm) {
            errors.push(error.abs());
            honest += usize::from(error.abs() <= 2.0 * sigma + 0.3);
        }
    }
    std::fs::write(concat!(env!("CARGO_TARGET_TMPDIR"), "/random_parcels.csv"), csv)
        .expect("writable");
    let svg = concat!(env!("CARGO_TARGET_TMPDIR"), "/random_parcels.svg");
    std::fs::write(svg, plot(rows)).expect("writable");
    errors.sort_unstable_by(f64::total_cmp);
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let p99 = errors[errors.len() * 99 / 100];
    let share = honest as f64 / errors.len() as f64;
    let irregular = rows.iter().filter(|r| r.record.shape == Shape::Irregular).count();
    eprintln!(
        "{} parcels: mean {mean:.3} mm, p99 {p99:.2} mm, largest {:.2} mm; within 2 sigma + 0.3 mm: {:.1} %; \
         {irregular} irregular; {} complaints",
        rows.len(),
        errors[errors.len() - 1],
        100.0 * share,
        complaints.len()
    );
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
    // 2.66 mm is reached, 2.5 is wanted: small black parcels with a white label near their edge. The
    // sixth largest of 600 errors moves by some tenths with any change: the gate leaves room for that.
    assert!(mean <= 0.6 && p99 <= 3.0, "mean {mean:.3} mm, p99 {p99:.2} mm");
    assert!(share >= 0.9, "only {share:.3} of the errors are within 2 sigma + 0.3 mm");
}
