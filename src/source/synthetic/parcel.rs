//! What rides: parcels one by one, or drawn at random.

use super::random::Random;
use super::shape::Shape;
use serde::Deserialize;

/// What a parcel is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Material {
    /// Brown cardboard with tape.
    #[default]
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

/// `[[parcel]]`: its sides are those of the smallest upright cuboid that holds it, whatever its shape.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
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
    /// A box, if nothing is said.
    #[serde(default)]
    pub shape: Shape,
    /// Straps around it, across its length, dark on what is bright and bright on what is dark.
    #[serde(default)]
    pub straps: u8,
    /// Shrink-wrap: how much of a lamp its creases throw back, 0 to 1.
    #[serde(default)]
    pub wrap: f64,
    /// A white label, this far from a long and a short edge of the top; none given: a small one further in.
    pub label_edge_mm: Option<f64>,
    /// Broad tape along the middle of the top, brown on white and white on brown. Kraft always has some.
    #[serde(default)]
    pub tape: bool,
    /// Radius of its edges; none given: the scenario's. Of boxes only.
    pub edge_radius_mm: Option<f64>,
    /// One corner of its top is pressed in, by so much along each of the three edges. Its sides stay what they
    /// are.
    #[serde(default)]
    pub crush_mm: f64,
    /// How much further than the belt it goes, along and across travel, as a share of the way; nothing
    /// of it under the origin.
    #[serde(default)]
    pub slide: [f64; 2],
    /// How much it turns on its way; as `yaw_deg` says at the origin.
    #[serde(default)]
    pub turn_deg_per_m: f64,
}

/// Where a parcel is at some moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Footprint centre along travel.
    pub x_mm: f64,
    /// Footprint centre across the belt.
    pub y_mm: f64,
    /// Length axis against +X.
    pub yaw_deg: f64,
}

impl Parcel {
    /// Whether it can be rendered.
    pub(super) fn is_usable(&self) -> bool {
        self.length_mm >= self.width_mm
            && self.width_mm > 0.0
            && self.height_mm > 0.0
            && self.straps <= 4
            && (0.0..=1.0).contains(&self.wrap)
            && self.label_edge_mm.is_none_or(|mm| mm >= 0.0)
            && self.edge_radius_mm.is_none_or(|mm| mm >= 0.0)
            && (0.0..=0.5 * self.width_mm.min(self.height_mm)).contains(&self.crush_mm)
            && self.slide.iter().all(|share| share.abs() <= 0.2)
            && self.turn_deg_per_m.abs() <= 90.0
    }

    /// Where it is when the belt has moved so far, and has swung to the side so far.
    pub fn place(&self, travel_mm: f64, aside_mm: f64) -> Place {
        let way_mm = self.x_mm + travel_mm;
        Place {
            x_mm: way_mm + self.slide[0] * way_mm,
            y_mm: self.y_mm + self.slide[1] * way_mm + aside_mm,
            yaw_deg: self.yaw_deg + 1e-3 * self.turn_deg_per_m * way_mm,
        }
    }
}

/// `[random]`: parcels one behind the other.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RandomTable {
    pub(super) count: usize,
    /// After the last one the first comes again.
    #[serde(default)]
    pub(super) again: bool,
    /// Centre of the first one before the belt has moved.
    first_x_mm: f64,
    /// Free belt between neighbours, along travel.
    gap_mm: [f64; 2],
    y_mm: [f64; 2],
    length_mm: [f64; 2],
    width_mm: [f64; 2],
    height_mm: [f64; 2],
}

impl RandomTable {
    pub(super) fn draw(&self, random: &mut Random) -> Vec<Parcel> {
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
                ..Parcel::default()
            });
            end_mm -= half_mm;
        }
        parcels
    }

    /// How much belt they take, with a gap before the first comes again.
    pub(super) fn loop_mm(&self, parcels: &[Parcel]) -> f64 {
        let last_mm = parcels.last().map_or(self.first_x_mm, |parcel| parcel.x_mm);
        // Half of the longest of both, whichever way they are turned.
        let half_mm = 0.5 * self.length_mm[1].hypot(self.width_mm[1]);
        self.first_x_mm - last_mm + 2.0 * half_mm + self.gap_mm[0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parcel_that_slides_and_turns_is_as_told_under_the_origin() {
        let told = Parcel {
            x_mm: -900.0,
            y_mm: 40.0,
            yaw_deg: 30.0,
            slide: [0.02, -0.01],
            turn_deg_per_m: 4.0,
            ..Parcel::default()
        };
        let at = |travel| told.place(travel, 2.0);
        assert_eq!(at(900.0), Place { x_mm: 0.0, y_mm: 42.0, yaw_deg: 30.0 });
        let later = at(1400.0);
        let expected = Place { x_mm: 510.0, y_mm: 37.0, yaw_deg: 32.0 };
        let off = [later.x_mm - expected.x_mm, later.y_mm - expected.y_mm, later.yaw_deg - 32.0];
        assert!(off.iter().all(|d| d.abs() < 1e-9), "{later:?}");
    }
}
