//! The light, region by region: how bright the picture is against how it was.
//!
//! In: raw frames, and what covers the belt. Out: the region that has changed most. Owns: places on a
//! grid over the picture, each with a running median of its grey, which parcels that pass do not move.
//! A place on the belt is looked at only while no parcel covers it.

use crate::config::Site;
use crate::error::Result;
use crate::image::Plane;
use crate::kernel::scalar::bits::{self, words};
use crate::plan::{Block, Memory, Plan};
use crate::units::RawPx;

/// Regions along and across the picture.
pub const REGIONS: [usize; 2] = [4, 3];
const REGION_COUNT: usize = REGIONS[0] * REGIONS[1];
/// Places in a region, along and across.
const PLACES: usize = 12;
const PLACE_COUNT: usize = REGION_COUNT * PLACES * PLACES;
/// A frame looks at one of so many parts of the places.
const PARTS: usize = 4;
/// Grey levels are kept in sixteenths; a median moves by no more than a half at a time.
const FINE: i32 = 16;
const STEP: i32 = 8;
/// Below this mean grey level a region's changes count as if it were as bright: noise and stray light.
const GREY_MIN: f64 = 8.0;
/// From here on a pixel is saturated, up to there it is black.
const SATURATED_GREY: i32 = 250;
const BLACK_GREY: i32 = 2;
/// Not looked at yet.
const UNKNOWN: i16 = -1;

/// One place.
#[derive(Clone, Copy, Debug)]
struct Spot {
    at: [u16; 2],
    /// Its pixel of the belt view, when it lies in the zone.
    on_belt: Option<[u16; 2]>,
    /// Sixteenths of a grey level.
    median: i16,
    learned: i16,
}

/// The light against how it was learned.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Light {
    /// The region that has changed most, from 1, row by row from the top left; 0: not known yet.
    pub region: u8,
    /// Its brightness over that when it was learned, less 1.
    pub change: f64,
    /// Share of the picture that has become saturated, or black, since then; negative: is so no more.
    pub saturated: f64,
    /// The same.
    pub black: f64,
    /// How bad that is.
    pub level: super::Level,
}

/// The places.
pub(super) struct Places {
    spots: Block<Spot>,
    part: usize,
    is_learned: bool,
}

impl Places {
    pub(super) fn plan(plan: &mut Plan) {
        plan.add::<Spot>("health.spots", PLACE_COUNT, "a median of the grey at each");
    }

    pub(super) fn new(site: &Site, memory: &mut Memory) -> Result<Self> {
        let none = Spot { at: [0; 2], on_belt: None, median: UNKNOWN, learned: UNKNOWN };
        let mut spots = memory.take("health.spots", none)?;
        let [width, height] = site.camera.image_size_px;
        let (columns, rows) = (REGIONS[0] * PLACES, REGIONS[1] * PLACES);
        for (i, spot) in spots.iter_mut().enumerate() {
            // In the middle of its share of the picture.
            let x = (2 * (i % columns) + 1) * width / (2 * columns);
            let y = (2 * (i / columns) + 1) * height / (2 * rows);
            let on_belt = site.camera.belt_point(RawPx { x: x as f64, y: y as f64 });
            let in_zone = on_belt.filter(|at| site.config.zone.contains(at.x, at.y));
            let px = in_zone.map(|at| site.view.px(at));
            let on_belt = px.map(|px| [px.u.round() as u16, px.v.round() as u16]);
            *spot = Spot { at: [x as u16, y as u16], on_belt, ..none };
        }
        Ok(Self { spots, part: 0, is_learned: false })
    }

    /// Look at a part of the places. `covered`: bits of the belt view, rows of `view_width` pixels; empty:
    /// nothing is.
    pub(super) fn step(&mut self, raw: Plane<'_>, covered: &[u64], view_width: usize) {
        let row = words(view_width);
        for spot in self.spots.iter_mut().skip(self.part).step_by(PARTS) {
            let hidden = spot.on_belt.is_some_and(|[u, v]| {
                let row = covered.get(usize::from(v) * row..);
                row.is_some_and(|row| !row.is_empty() && bits::get(row, usize::from(u)))
            });
            if hidden {
                continue;
            }
            let [x, y] = spot.at.map(usize::from);
            let now = FINE * i32::from(raw.at(x, y));
            let before = i32::from(spot.median);
            let moved = before + (now - before).clamp(-STEP, STEP);
            spot.median = if spot.median == UNKNOWN { now } else { moved } as i16;
        }
        self.part = (self.part + 1) % PARTS;
    }

    /// As it is now, it shall be.
    pub(super) fn learn(&mut self) {
        self.spots.iter_mut().for_each(|spot| spot.learned = spot.median);
        self.is_learned = true;
    }

    /// What has changed since then; the level is left open.
    pub(super) fn changed(&self) -> Light {
        let mut light = Light::default();
        if !self.is_learned {
            return light;
        }
        let mut regions = [[0.0, 0.0, 0.0]; REGION_COUNT];
        let mut known = 0.0;
        for (i, spot) in self.spots.iter().enumerate() {
            if spot.learned == UNKNOWN || spot.median == UNKNOWN {
                continue;
            }
            let (column, row) = (i % (REGIONS[0] * PLACES), i / (REGIONS[0] * PLACES));
            let region = &mut regions[row / PLACES * REGIONS[0] + column / PLACES];
            let grey = |fine: i16| f64::from(fine) / f64::from(FINE);
            *region =
                [region[0] + 1.0, region[1] + grey(spot.learned), region[2] + grey(spot.median)];
            known += 1.0;
            let became = |is: fn(i32) -> bool| {
                let is = |fine: i16| f64::from(u8::from(is(i32::from(fine))));
                is(spot.median) - is(spot.learned)
            };
            light.saturated += became(|fine| fine >= FINE * SATURATED_GREY);
            light.black += became(|fine| fine <= FINE * BLACK_GREY);
        }
        let known = f64::max(known, 1.0);
        (light.saturated, light.black) = (light.saturated / known, light.black / known);
        for (k, [count, learned, now]) in
            regions.into_iter().enumerate().filter(|(_, r)| r[0] > 0.0)
        {
            let change = (now - learned) / learned.max(GREY_MIN * count);
            if light.region == 0 || change.abs() > light.change.abs() {
                (light.region, light.change) = (k as u8 + 1, change);
            }
        }
        light
    }
}
