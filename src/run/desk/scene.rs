//! What is drawn over pictures: belt coordinates to pixels.

use super::shots::{Framing, Shot, Subject};
use crate::camera::{BeltView, Camera};
use crate::config::Site;
use crate::event::ParcelRecord;
use crate::pipeline::Sight;
use crate::units::{BeltMm, BeltPx, BeltRect};
use crate::web;
use nalgebra::{Vector2, Vector3};

/// Distances of the grid's lines; the first that gives no more than so many lines is taken.
const GRID_MM: [f64; 7] = [10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0];
const LINES_MAX: f64 = 14.0;
/// A line is bent by the lens: it is drawn over so many pieces.
const PIECES: u32 = 12;
/// The arrow of travel, as a share of the zone's length.
const ARROW_SHARE: f64 = 0.12;

/// Where things on the belt are in pictures.
pub struct Geometry {
    camera: Camera,
    view: BeltView,
    zone: BeltRect,
    grid_mm: f64,
}

impl Geometry {
    /// Of a site.
    pub fn new(site: &Site) -> Self {
        let zone = site.config.zone;
        let longest = zone.length_mm().max(zone.y_max_mm - zone.y_min_mm);
        let fits = |step: &f64| longest / step <= LINES_MAX;
        let grid_mm = GRID_MM.into_iter().find(fits).unwrap_or(GRID_MM[GRID_MM.len() - 1]);
        Self { camera: site.camera.clone(), view: site.view.clone(), zone, grid_mm }
    }

    /// Scale of the belt view.
    pub fn mm_per_px(&self) -> f64 {
        self.view.mm_per_px
    }

    /// A point of the belt in a shot; none where the lens does not show it.
    fn px(&self, shot: &Framing, at: BeltMm) -> Option<[f32; 2]> {
        let in_source = match shot.subject {
            Subject::Raw | Subject::Whole => {
                let raw = self.camera.project(Vector3::new(at.x, at.y, 0.0))?;
                [raw.x, raw.y]
            }
            Subject::Belt | Subject::Parcel => {
                let px = self.view.px(at);
                [px.u, px.v]
            }
        };
        let at = shot.px(in_source).map(|v| (10.0 * v).round() as f32 / 10.0);
        at.iter().all(|v| v.is_finite()).then_some(at)
    }

    fn line(&self, shot: &Framing, from: BeltMm, to: BeltMm) -> Vec<[f32; 2]> {
        let pieces = if shot.subject == Subject::Raw { PIECES } else { 1 };
        (0..=pieces)
            .filter_map(|i| {
                let t = f64::from(i) / f64::from(pieces);
                let at =
                    BeltMm { x: from.x + t * (to.x - from.x), y: from.y + t * (to.y - from.y) };
                self.px(shot, at)
            })
            .collect()
    }

    /// What is drawn over a live picture.
    pub fn scene(&self, shot: &Shot) -> web::Scene {
        let (sights, shot) = (&shot.sights, &shot.framing);
        let zone = &self.zone;
        let [a, b, c, d] = zone.corners();
        let zone_px = [(a, b), (b, c), (c, d), (d, a)];
        let zone_px =
            zone_px.into_iter().flat_map(|(from, to)| self.line(shot, from, to)).collect();
        let mut grid_px = Vec::new();
        let at = |x: f64, y: f64| BeltMm { x, y };
        for x in steps(zone.x_min_mm, zone.x_max_mm, self.grid_mm) {
            grid_px.push(('x', x, self.line(shot, at(x, zone.y_min_mm), at(x, zone.y_max_mm))));
        }
        for y in steps(zone.y_min_mm, zone.y_max_mm, self.grid_mm) {
            grid_px.push(('y', y, self.line(shot, at(zone.x_min_mm, y), at(zone.x_max_mm, y))));
        }
        let centre = zone.centre();
        let half_mm = 0.5 * ARROW_SHARE * zone.length_mm();
        let arrow = [-half_mm, half_mm].map(|dx| at(centre.x + dx, centre.y));
        let travel_px = arrow.map(|at| self.px(shot, at).unwrap_or_default());
        web::Scene {
            frame: shot.time.index,
            t_s: shot.time.t_s,
            size_px: shot.size_px,
            zone_px,
            grid_px,
            travel_px,
            parcels: sights.iter().map(|sight| self.sight(shot, sight)).collect(),
        }
    }

    fn sight(&self, shot: &Framing, sight: &Sight) -> web::Sight {
        let [first, last] = sight.bounds;
        let corner = |u: f64, v: f64| self.view.belt_point(BeltPx { u, v });
        let ring = [
            corner(first.u, first.v),
            corner(last.u, first.v),
            corner(last.u, last.v),
            corner(first.u, last.v),
        ];
        web::Sight {
            phase: match (sight.riding, sight.told) {
                (true, _) => "riding",
                (_, true) => "told",
                _ => "candidate",
            },
            bounds_px: ring.iter().filter_map(|at| self.px(shot, *at)).collect(),
            cuboid_px: sight.cuboid.and_then(|cuboid| self.cuboid(shot, cuboid)),
        }
    }

    /// A cuboid, by where the view shows its corners on the belt plane: the same ray is the same pixel.
    fn cuboid(&self, shot: &Framing, corners: [BeltMm; 8]) -> Option<web::Cuboid> {
        let mut px = web::Cuboid::default();
        for (px, at) in px.iter_mut().zip(corners) {
            *px = self.px(shot, at)?;
        }
        Some(px)
    }

    /// A record's cuboid in the picture of its parcel.
    pub fn recorded(&self, shot: &Framing, record: &ParcelRecord) -> Option<web::Cuboid> {
        record.not_measured.is_none().then_some(())?;
        let (sin, cos) = record.yaw_deg.to_radians().sin_cos();
        let ring = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)];
        let corners = std::array::from_fn(|k| {
            let (a, b) = ring[k % 4];
            let (l, w) = (a * record.length_mm, b * record.width_mm);
            let over_belt =
                Vector2::new(record.x_mm + cos * l - sin * w, record.y_mm + sin * l + cos * w);
            let height_mm = if k < 4 { 0.0 } else { record.height_mm };
            let image = self.view.project(over_belt, height_mm);
            BeltMm { x: image.x, y: image.y }
        });
        self.cuboid(shot, corners)
    }

    /// How far from the place of a record a parcel in a picture stands, mm.
    pub fn distance_mm(&self, sight: &Sight, record: &ParcelRecord) -> f64 {
        let [a, c] = if let Some([a, _, c, ..]) = sight.cuboid {
            [a, c]
        } else {
            sight.bounds.map(|px| self.view.belt_point(px))
        };
        let middle = BeltMm { x: f64::midpoint(a.x, c.x), y: f64::midpoint(a.y, c.y) };
        (middle.x - record.x_mm).hypot(middle.y - record.y_mm)
    }
}

/// Multiples of a step in a range.
fn steps(from: f64, to: f64, step: f64) -> impl Iterator<Item = f64> {
    let first = (from / step).ceil() as i64;
    let last = (to / step).floor() as i64;
    (first..=last).map(move |i| i as f64 * step)
}
