//! The views of a pass, stacked on one plane: what lies at its height is sharp, everything else smears.
//!
//! In: the views kept, and a window on the plane z = h in belt-fixed coordinates. Out: its edge pixels,
//! each with the direction of its step. An edge pixel is one whose step is the same in all views
//! (semblance), beyond what noise does there, and not part of a slow ramp: a shadow's soft border is
//! as wide as its displacement and would look alike at every height.

use super::steps::{Scale, StepPicture, Steps};
use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::Level;
use crate::kernel::scalar::semblance::{StepRow, StepSums};
use crate::kernel::scalar::steps::STEP_ONE;
use crate::kernel::simd::semblance::add_steps;
use crate::plan::{Block, Memory, Plan};
use crate::stage::evidence::DARK_GREY;
use crate::stage::views::Views;
use crate::units::BeltRect;

/// A window's sides at most, mm: the longest parcel, with its surroundings.
pub const WINDOW_MAX_MM: f64 = 1000.0;
/// A step's share that is the same in all views.
const SEMBLANCE_MIN: f32 = 0.4;
/// From this share on the views agree wholly: focus is exact to a pixel or two over the pass.
const SEMBLANCE_WHOLE: f32 = 0.8;
/// A step is this many times its noise, ...
const STEP_SIGMA_MIN: f32 = 4.0;
/// ... and at least this, as a logarithm: 1 %.
const STEP_MIN: f32 = 0.012;
/// Fewer views than this agree by accident.
const VIEWS_MIN: u16 = 6;
/// Classes of brightness in which noise is told, each this wide (logarithm), ...
const CLASS_LOG: f32 = 0.15;
/// ... from 0 + [`DARK_GREY`] to 255.
const CLASSES: usize = 28;
/// Noise is told from the quietest quarter of the pixels of a brightness, ...
const QUIET_SHARE: f32 = 0.25;
/// ... of which every third is looked at.
const NOISE_EVERY_PX: usize = 3;
/// Fewer of a brightness tell none.
const NOISE_PX_MIN: u32 = 17;
/// Bins of energy, four to a factor of two, from 2^-24 on.
const ENERGY_BINS: usize = 128;

/// A part of the plane z = `height_mm`, belt-fixed: X less the belt's travel.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// Over the belt.
    pub height_mm: f64,
    /// X less travel, lowest and highest.
    pub x_mm: [f64; 2],
    /// Y, lowest and highest.
    pub y_mm: [f64; 2],
}

/// An edge pixel.
#[derive(Clone, Copy, Debug, Default)]
pub struct EdgePixel {
    /// X less travel, and Y, mm.
    pub at_mm: [f32; 2],
    /// Unit vector of the step, dark to bright.
    pub step: [f32; 2],
    /// How large the step is, as a logarithm.
    pub strength: f32,
    /// How well the views agree on it: 0 hardly, 1 wholly.
    pub agreement: f32,
}

/// The stack of one window at a time.
pub struct Stack {
    geometry: BeltView,
    zone: BeltRect,
    /// Pixels of the view to a side of a picture's, and the pictures' size.
    side_px: usize,
    picture_px: [usize; 2],
    /// Side of a pixel on the window's plane.
    px_mm: f64,
    columns: usize,
    rows: usize,
    origin_mm: [f64; 2],
    /// Logarithm of the grey values 0 to 255.
    log_of: [f32; 256],
    level: Level,
    /// Sums over the views: steps, their squared length, grey values, and how many views.
    along: Block<i16>,
    across: Block<i16>,
    energy: Block<i32>,
    grey: Block<u16>,
    views: Block<u16>,
    edges: Block<EdgePixel>,
    edge_count: usize,
}

/// Pixels of the largest window along and across.
fn size_max(view: &BeltView, scale: Scale, zone: &BeltRect, height_max_mm: f64) -> [usize; 2] {
    let (side_px, _) = scale.sizes(view);
    let least_mm = side_px as f64 * view.mm_per_px / view.magnification(height_max_mm);
    let count = |length_mm: f64| (length_mm.min(WINDOW_MAX_MM) / least_mm).ceil() as usize;
    [count(WINDOW_MAX_MM), count(zone.y_max_mm - zone.y_min_mm)]
}

const ALONG: [&str; 2] = ["stack.along", "coarse_stack.along"];
const ACROSS: [&str; 2] = ["stack.across", "coarse_stack.across"];
const ENERGY: [&str; 2] = ["stack.energy", "coarse_stack.energy"];
const GREY: [&str; 2] = ["stack.grey", "coarse_stack.grey"];
const VIEWS: [&str; 2] = ["stack.views", "coarse_stack.views"];
const EDGES: [&str; 2] = ["stack.edges", "coarse_stack.edges"];

impl Stack {
    /// Memory for a site.
    pub fn plan(
        view: &BeltView,
        scale: Scale,
        zone: &BeltRect,
        height_max_mm: f64,
        plan: &mut Plan,
    ) {
        let [columns, rows] = size_max(view, scale, zone, height_max_mm);
        let n = columns * rows;
        plan.add::<i16>(scale.name(ALONG), n, "a window's steps along X, summed over the views");
        plan.add::<i16>(scale.name(ACROSS), n, "the same along Y");
        plan.add::<i32>(scale.name(ENERGY), n, "their squares");
        plan.add::<u16>(scale.name(GREY), n, "its grey values");
        plan.add::<u16>(scale.name(VIEWS), n, "how many views show it");
        plan.add::<EdgePixel>(scale.name(EDGES), n, "edge pixels of a plane");
    }

    /// Nothing stacked.
    pub fn new(
        view: &BeltView,
        scale: Scale,
        zone: &BeltRect,
        level: Level,
        memory: &mut Memory,
    ) -> Result<Self> {
        let (side_px, picture_px) = scale.sizes(view);
        Ok(Self {
            geometry: view.clone(),
            zone: *zone,
            side_px,
            picture_px,
            px_mm: side_px as f64 * view.mm_per_px,
            columns: 0,
            rows: 0,
            origin_mm: [0.0; 2],
            log_of: std::array::from_fn(|grey| (grey as f32 + DARK_GREY).ln()),
            level,
            along: memory.take(scale.name(ALONG), 0)?,
            across: memory.take(scale.name(ACROSS), 0)?,
            energy: memory.take(scale.name(ENERGY), 0)?,
            grey: memory.take(scale.name(GREY), 0)?,
            views: memory.take(scale.name(VIEWS), 0)?,
            edges: memory.take(scale.name(EDGES), EdgePixel::default())?,
            edge_count: 0,
        })
    }

    /// Side of the window's pixels, mm.
    pub fn px_mm(&self) -> f64 {
        self.px_mm
    }

    /// Edge pixels of the window.
    pub fn edges(&self) -> &[EdgePixel] {
        &self.edges[..self.edge_count]
    }

    /// Which points of the window enough views see.
    pub fn seen(&self) -> Seen<'_> {
        Seen {
            views: &self.views[..self.columns * self.rows],
            size: [self.columns, self.rows],
            per_mm: (1.0 / self.px_mm) as f32,
            origin_mm: self.origin_mm.map(|mm| mm as f32),
        }
    }

    /// Stack the views on a window, cut to the zone's width and to what there is memory for. `usable`: 255 for
    /// a picture's pixels that tell of the belt, else 0.
    pub fn fill(&mut self, views: &Views, steps: &Steps, usable: &[u8], window: &Window) {
        let m = self.geometry.magnification(window.height_mm);
        self.px_mm = self.side_px as f64 * self.geometry.mm_per_px / m;
        let y_max_mm = window.y_mm[1].min(self.zone.y_max_mm);
        let y_min_mm = window.y_mm[0].max(self.zone.y_min_mm);
        let count = |length_mm: f64| (length_mm / self.px_mm).ceil().max(1.0) as usize;
        let columns_max = count(WINDOW_MAX_MM).min(self.views.len());
        self.columns = count(window.x_mm[1] - window.x_mm[0]).min(columns_max);
        let rows_max = count(WINDOW_MAX_MM).min(self.views.len() / self.columns);
        self.rows = count(y_max_mm - y_min_mm).min(rows_max);
        self.origin_mm = [window.x_mm[0], y_max_mm];
        let n = self.columns * self.rows;
        self.along[..n].fill(0);
        self.across[..n].fill(0);
        self.energy[..n].fill(0);
        self.grey[..n].fill(0);
        self.views[..n].fill(0);
        for place in views.places() {
            let travel_mm = views.kept(place).at.travel_mm;
            let (first_mm, last_mm) = (window.x_mm[0] + travel_mm, window.x_mm[1] + travel_mm);
            if last_mm > self.zone.x_min_mm && first_mm < self.zone.x_max_mm {
                self.add(steps.picture(place), usable, travel_mm, m);
            }
        }
        self.find_edges();
    }

    /// Add one view: on the plane its pixels are the window's, moved by whole pixels to the nearest.
    fn add(&mut self, picture: StepPicture<'_>, usable: &[u8], travel_mm: f64, m: f64) {
        let view = &self.geometry;
        let x_mm = view.nadir.x + m * (self.origin_mm[0] + travel_mm - view.nadir.x);
        let y_mm = view.nadir.y + m * (self.origin_mm[1] - view.nadir.y);
        // The middle of the pictures' first pixel.
        let middle_px = 0.5 * (self.side_px as f64 - 1.0);
        let at = |px: f64| ((px - middle_px) / self.side_px as f64).round() as i64;
        let i0 = at((x_mm - view.origin.x) / view.mm_per_px);
        let j0 = at((view.origin.y - y_mm) / view.mm_per_px);
        let [width, height] = self.picture_px.map(|px| px as i64);
        // In the zone and in the picture.
        let in_zone = [self.zone.x_min_mm, self.zone.x_max_mm]
            .map(|mm| (mm - travel_mm - self.origin_mm[0]) / self.px_mm);
        let first = (in_zone[0].ceil() as i64).max(-i0).max(0);
        let end = (in_zone[1].floor() as i64 + 1).min(width - i0).min(self.columns as i64);
        if first >= end {
            return;
        }
        for row in 0..self.rows as i64 {
            let j = j0 + row;
            if !(0..height).contains(&j) {
                continue;
            }
            let from = (j * width + i0 + first) as usize..(j * width + i0 + end) as usize;
            let to = row as usize * self.columns + first as usize
                ..row as usize * self.columns + end as usize;
            let row = StepRow {
                along: &picture.along[from.clone()],
                across: &picture.across[from.clone()],
                grey: &picture.grey[from.clone()],
                usable: &usable[from],
            };
            let mut sums = StepSums {
                along: &mut self.along[to.clone()],
                across: &mut self.across[to.clone()],
                energy: &mut self.energy[to.clone()],
                grey: &mut self.grey[to.clone()],
                views: &mut self.views[to],
            };
            add_steps(self.level, row, &mut sums);
        }
    }

    fn find_edges(&mut self) {
        let noise = self.noise();
        self.edge_count = 0;
        for row in 0..self.rows {
            for column in 0..self.columns {
                let i = row * self.columns + column;
                let n = f32::from(self.views[i]);
                let [x, y] = [f32::from(self.along[i]), f32::from(self.across[i])];
                let least = n * STEP_MIN * STEP_ONE;
                if self.views[i] < VIEWS_MIN || x * x + y * y < least * least {
                    continue;
                }
                let [x, y] = [x, y].map(|sum| sum / (n * STEP_ONE));
                let energy = self.energy[i] as f32 / (n * STEP_ONE * STEP_ONE);
                let noise = noise_at(&noise, self.log_at(i));
                let common = x * x + y * y;
                let semblance = (common - noise / n) / (energy - noise).max(0.15 * energy);
                let beyond_noise = common * n > STEP_SIGMA_MIN * STEP_SIGMA_MIN * noise;
                if semblance < SEMBLANCE_MIN || !beyond_noise {
                    continue;
                }
                let strength = common.sqrt();
                self.edges[self.edge_count] = EdgePixel {
                    at_mm: [
                        (self.origin_mm[0] + column as f64 * self.px_mm) as f32,
                        (self.origin_mm[1] - row as f64 * self.px_mm) as f32,
                    ],
                    step: [x / strength, y / strength],
                    strength,
                    agreement: ((semblance - SEMBLANCE_MIN) / (SEMBLANCE_WHOLE - SEMBLANCE_MIN))
                        .min(1.0),
                };
                self.edge_count += 1;
            }
        }
    }

    /// Logarithm of a pixel's mean grey value.
    fn log_at(&self, i: usize) -> f32 {
        self.log_of[usize::from(self.grey[i] / self.views[i]).min(255)]
    }

    /// Energy of noise in each class of brightness.
    fn noise(&self) -> [f32; CLASSES] {
        let mut counts = [[0u32; ENERGY_BINS]; CLASSES];
        for i in (0..self.columns * self.rows).step_by(NOISE_EVERY_PX) {
            if self.views[i] >= VIEWS_MIN {
                let energy =
                    self.energy[i] as f32 / (f32::from(self.views[i]) * STEP_ONE * STEP_ONE);
                counts[class_of(self.log_at(i)) as usize][energy_bin(energy)] += 1;
            }
        }
        let mut noise = counts.map(|counts| {
            let all: u32 = counts.iter().sum();
            if all < NOISE_PX_MIN {
                return f32::NAN;
            }
            let quiet = (QUIET_SHARE * all as f32) as u32;
            let mut below = 0;
            let within = |count: &u32| {
                below += count;
                below > quiet
            };
            energy_of(counts.iter().position(within).unwrap_or(0))
        });
        for classes in [1..CLASSES, 1..CLASSES] {
            for class in classes {
                if noise[class].is_nan() {
                    noise[class] = noise[class - 1];
                }
            }
            noise.reverse();
        }
        noise.map(|noise| if noise.is_nan() { 0.0 } else { noise })
    }
}

/// Which points of a window enough views see.
pub struct Seen<'a> {
    views: &'a [u16],
    size: [usize; 2],
    per_mm: f32,
    origin_mm: [f32; 2],
}

impl Seen<'_> {
    /// Whether enough views see a point: X less travel, Y, mm.
    pub fn at(&self, x_mm: f32, y_mm: f32) -> bool {
        let column = (x_mm - self.origin_mm[0]) * self.per_mm + 0.5;
        let row = (self.origin_mm[1] - y_mm) * self.per_mm + 0.5;
        let [columns, rows] = self.size;
        column >= 0.0
            && row >= 0.0
            && (column as usize) < columns
            && (row as usize) < rows
            && self.views[row as usize * columns + column as usize] >= VIEWS_MIN
    }
}

/// Bin of an energy: quarters of an octave, by the number's own bits.
fn energy_bin(energy: f32) -> usize {
    const FIRST: i32 = (127 - 24) << 2;
    ((energy.to_bits() >> 21) as i32 - FIRST).clamp(0, ENERGY_BINS as i32 - 1) as usize
}

/// The middle of a bin.
fn energy_of(bin: usize) -> f32 {
    let octave = (bin / 4) as f32 - 24.0;
    octave.exp2() * (1.0 + 0.25 * ((bin % 4) as f32 + 0.5))
}

fn class_of(log: f32) -> f32 {
    ((log - DARK_GREY.ln()) / CLASS_LOG).clamp(0.0, (CLASSES - 1) as f32)
}

fn noise_at(noise: &[f32; CLASSES], log: f32) -> f32 {
    let class = class_of(log) - 0.5;
    let low = class.max(0.0) as usize;
    let share = (class - low as f32).clamp(0.0, 1.0);
    noise[low] + share * (noise[(low + 1).min(CLASSES - 1)] - noise[low])
}
