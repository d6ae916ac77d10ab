//! What is on the belt of a world, and what comes into its picture besides.

use super::class::{Class, Property};
use super::generator::Room;
use beltgauge::source::synthetic::{Random, Scenario};
use std::fmt::Write as _;

pub const HEIGHT_MAX_MM: f64 = 500.0;
/// A parcel taller than this times its width falls over.
const SLENDER_MAX: f64 = 1.5;
/// What is nearer to the zone's sides than this leaves it.
const BESIDE_MM: f64 = 30.0;

const MATERIALS: [&str; 5] = ["kraft", "white", "dark", "glossy", "printed"];

fn choice<'a>(random: &mut Random, of: &[&'a str]) -> &'a str {
    of[(random.unit() * of.len() as f64) as usize]
}

/// Between ends, evenly in the logarithm.
pub fn ratio(random: &mut Random, range: [f64; 2]) -> f64 {
    random.between(range.map(f64::ln)).exp()
}

/// Sides, height, and how it lies.
struct Body {
    sides_mm: [f64; 3],
    yaw_deg: f64,
}

impl Body {
    fn draw(
        class: Class,
        has_any_size: bool,
        [across_max_mm, height_max_mm]: [f64; 2],
        random: &mut Random,
    ) -> Self {
        let (sides, heights) = match class {
            _ if has_any_size => ([20.0, 800.0], [3.0, height_max_mm]),
            Class::Easy => ([80.0, 300.0], [10.0, 250.0]),
            _ => ([60.0, 300.0], [4.0, height_max_mm.min(250.0)]),
        };
        let (a, b) = (ratio(random, sides), ratio(random, sides));
        let width = a.min(b).min(across_max_mm);
        let length = a.max(b);
        let height = ratio(random, heights).min(SLENDER_MAX * width);
        let yaw_deg = random.between([-90.0, 90.0]);
        let mut body = Self { sides_mm: [length, width, height], yaw_deg };
        if body.reach_mm()[1] > 0.5 * across_max_mm {
            // What is long comes along the belt.
            body.yaw_deg /= 12.0;
        }
        while body.reach_mm()[1] > 0.5 * across_max_mm {
            body.yaw_deg *= 0.5;
            body.sides_mm[1] *= 0.95;
        }
        body
    }

    /// Half of what it takes along and across the belt.
    fn reach_mm(&self) -> [f64; 2] {
        let [l, w, _] = self.sides_mm;
        let (sin, cos) = self.yaw_deg.to_radians().sin_cos();
        [0.5 * (l * cos.abs() + w * sin.abs()), 0.5 * (l * sin.abs() + w * cos.abs())]
    }
}

/// Parcels, all of them inside the zone's sides, and where the last one ends.
pub fn parcels(of: &impl Fn(Property) -> (Class, Random), room: &Room) -> (String, f64) {
    let (class, mut random) = of(Property::Parcels);
    let (start_class, mut start) = of(Property::Start);
    let (shape_class, mut shapes) = of(Property::Shapes);
    let (dress_class, mut dress) = of(Property::Dress);
    let (slip_class, mut slip) = of(Property::Slip);
    let dense = class.has(Class::Dense);
    let lanes = if dense && random.unit() < 0.5 { 2 } else { 1 };
    let (count, gaps, materials): (usize, [f64; 2], &[&str]) = match class {
        Class::Easy => (5, [100.0, 200.0], &["kraft", "kraft", "white"]),
        _ if dense => (8, [8.0, 60.0], &["dark", "dark", "kraft", "printed"]),
        _ => (5, [70.0, 200.0], &MATERIALS),
    };
    let any_size = shape_class.has(Class::Shapes);
    let mut text = String::new();
    // Some worlds have parcels on the belt in their first frame.
    let on_belt = start_class.has(Class::Periodic);
    let [half_x_mm, half_y_mm] = room.half_mm;
    let first_mm = if on_belt { start.between([0.0, 350.0]) } else { -half_x_mm - 500.0 };
    let zone_mm = 2.0 * (half_y_mm - BESIDE_MM);
    let mut ends_mm = [first_mm; 2];
    for k in 0..count {
        let lane = k % lanes;
        let across_max_mm = zone_mm / lanes as f64;
        let most = [across_max_mm, room.height_max_mm];
        let body = Body::draw(class, any_size, most, &mut random);
        let [half_x_mm, half_y_mm] = body.reach_mm();
        let [l, w, h] = body.sides_mm;
        let room_mm = 0.5 * across_max_mm - half_y_mm;
        let middle_mm = if lanes == 2 { (lane as f64 - 0.5) * (across_max_mm + 20.0) } else { 0.0 };
        // A parcel's height hides what is behind it.
        let gap_mm = random.between(gaps) + if dense { 0.0 } else { 0.5 * h };
        let material = choice(&mut random, materials);
        let _ = writeln!(
            text,
            "[[parcel]]\nlength_mm = {l}\nwidth_mm = {w}\nheight_mm = {h}\nyaw_deg = {}\n\
             x_mm = {}\ny_mm = {}\nmaterial = \"{material}\"",
            body.yaw_deg,
            ends_mm[lane] - half_x_mm,
            middle_mm + random.between([-room_mm, room_mm])
        );
        text += &shape(shape_class, &mut shapes);
        text += &clothes(dress_class, [w, h], &mut dress);
        text += &movement(slip_class, &mut slip);
        ends_mm[lane] -= 2.0 * half_x_mm + gap_mm;
    }
    (text, ends_mm[0].min(ends_mm[1]))
}

/// Frames until every parcel is well beyond the zone.
pub fn frames_until_all_have_left(scenario: &Scenario, room: &Room) -> u64 {
    const FRAMES_MAX: u64 = 4000;
    const BEYOND_MM: f64 = 60.0;
    let inside = |frame: u64| {
        scenario.parcels().iter().any(|parcel| {
            let place = scenario.place_at_frame(parcel, frame);
            let body = Body {
                sides_mm: [parcel.length_mm, parcel.width_mm, parcel.height_mm],
                yaw_deg: place.yaw_deg,
            };
            place.x_mm - body.reach_mm()[0] < room.half_mm[0] + BEYOND_MM
        })
    };
    (0..FRAMES_MAX).find(|frame| !inside(*frame)).expect("the belt moves")
}

fn shape(class: Class, random: &mut Random) -> String {
    const SHAPES: [&str; 8] = ["box", "box", "tube", "bag", "tote", "stack", "envelope", "book"];
    let name = choice(random, &SHAPES);
    if class.has(Class::Shapes) { format!("shape = \"{name}\"\n") } else { String::new() }
}

/// Edges; straps, shrink-wrap, tape, a label near the edge; a corner that was pressed in.
fn clothes(class: Class, [width_mm, height_mm]: [f64; 2], random: &mut Random) -> String {
    let radius_mm = ratio(random, [0.5, 4.0]);
    let pressed_mm = random.between([4.0, 20.0]).min(0.3 * width_mm.min(height_mm));
    let is_crushed = random.unit() < 0.2;
    let straps = if random.unit() < 0.3 { 1 + (random.unit() * 2.0) as u8 } else { 0 };
    let wrap = random.unit() - 0.6;
    let edge_mm = random.between([0.5, 20.0]);
    let (has_label, has_tape) = (random.unit() < 0.5, random.unit() < 0.3);
    if class == Class::Easy {
        return String::new();
    }
    let edges = format!("edge_radius_mm = {radius_mm}\n");
    if !class.has(Class::Shapes) {
        return edges;
    }
    let mut text = edges
        + &format!(
            "straps = {straps}\nwrap = {}\ntape = {has_tape}\n",
            (2.5 * wrap).clamp(0.0, 1.0)
        );
    if has_label {
        let _ = writeln!(text, "label_edge_mm = {edge_mm}");
    }
    if is_crushed {
        let _ = writeln!(text, "crush_mm = {pressed_mm}");
    }
    text
}

/// Sliding and turning a little.
fn movement(class: Class, random: &mut Random) -> String {
    let moves = random.unit() < 0.4;
    let slide = [random.between([-0.01, 0.01]), random.between([-0.01, 0.01])];
    let turn_deg_per_m = random.between([-3.0, 3.0]);
    if class.has(Class::Worn) && moves {
        format!("slide = {slide:?}\nturn_deg_per_m = {turn_deg_per_m}\n")
    } else {
        String::new()
    }
}

/// Hands, sleeves and cables.
pub fn visitors((class, mut random): (Class, Random), seconds: f64, room: &Room) -> String {
    let mut text = String::new();
    if !class.has(Class::Visited) {
        return text;
    }
    for _ in 0..=(random.unit() * 2.0) as usize {
        let from_s = random.between([0.3, 0.8]) * seconds;
        if random.unit() < 0.3 {
            text += &cable(&mut random, room.height_max_mm);
        } else {
            text += &arm(&mut random, from_s, room.height_max_mm);
        }
    }
    text
}

/// It hangs over the belt and swings.
fn cable(random: &mut Random, above_mm: f64) -> String {
    let (x, z) = (random.between([-350.0, 350.0]), above_mm + random.between([20.0, 300.0]));
    format!(
        "[[intruder]]\nfrom_s = 0\nto_s = 1000\nvelocity_mm_per_s = [0, 0, 0]\nswing_mm = [{}, 0, 0]\n\
         swing_period_s = 1.6\n[[intruder.rod]]\nfrom_mm = [{x}, -600, {z}]\nto_mm = [{}, 600, {z}]\n\
         radius_mm = {}\ngrey = {}\n",
        random.between([0.0, 25.0]),
        x + random.between([-200.0, 200.0]),
        random.between([3.0, 8.0]),
        random.between([8.0, 120.0])
    )
}

/// A sleeve with a hand that reaches in from a side and goes again.
fn arm(random: &mut Random, from_s: f64, above_mm: f64) -> String {
    let side = if random.unit() < 0.5 { 1.0 } else { -1.0 };
    let (x, z) = (random.between([-300.0, 300.0]), above_mm + random.between([55.0, 150.0]));
    let reach = random.between([150.0, 450.0]);
    // In and out again: a swing of half a period.
    let lasts_s = random.between([0.8, 2.0]);
    let tip = side * 420.0;
    let mut text = format!(
        "[[intruder]]\nfrom_s = {from_s}\nto_s = {}\nvelocity_mm_per_s = [{}, 0, 0]\n\
         swing_mm = [0, {}, 0]\nswing_period_s = {}\n[[intruder.rod]]\nfrom_mm = [{x}, {}, {z}]\n\
         to_mm = [{x}, {tip}, {z}]\nradius_mm = 48\ngrey = {}\n",
        from_s + lasts_s,
        random.between([-100.0, 100.0]),
        -side * reach,
        2.0 * lasts_s,
        tip + side * 700.0,
        random.between([10.0, 150.0])
    );
    let skin = random.between([60.0, 170.0]);
    for finger in -2..=2 {
        let at = x + 18.0 * f64::from(finger);
        let _ = write!(
            text,
            "[[intruder.rod]]\nfrom_mm = [{at}, {tip}, {z}]\nto_mm = [{}, {}, {z}]\nradius_mm = 9\ngrey = {skin}\n",
            at + 4.0 * f64::from(finger),
            tip - side * (100.0 - 12.0 * f64::from(finger * finger))
        );
    }
    text
}
