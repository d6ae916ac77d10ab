//! The views of a pass, stacked on one plane: what lies at its height is sharp, everything else smears.
//!
//! In: the views kept, and a window on the plane z = h in belt-fixed coordinates. Out: its edge pixels,
//! each with the direction of its step. An edge pixel is one whose step is the same in all views
//! (semblance), beyond what noise does there, and not part of a slow ramp: a shadow's soft border is
//! as wide as its displacement and would look alike at every height.

use crate::camera::BeltView;
use crate::error::Result;
use crate::kernel::scalar::bits::{self, words};
use crate::kernel::scalar::box_filter::{self, box_filter};
use crate::plan::{Block, Memory, Plan};
use crate::stage::evidence::DARK_GREY;
use crate::stage::views::Views;
use crate::units::BeltRect;

/// Pixels of the stack, about: coarser than the fit's, finer than any gap that matters.
const PX_MM: f64 = 2.0;
/// A window's sides at most, mm: the longest parcel, with its surroundings.
const WINDOW_MAX_MM: f64 = 1000.0;
/// A step's share that is the same in all views.
const SEMBLANCE_MIN: f32 = 0.4;
/// From this share on the views agree wholly: focus is exact to a pixel or two over the pass.
const SEMBLANCE_WHOLE: f32 = 0.8;
/// A step is this many times its noise, ...
const STEP_SIGMA_MIN: f32 = 4.0;
/// ... and at least this, as a logarithm: 1 %.
const STEP_MIN: f32 = 0.012;
/// Fewer views than this agree by accident.
const VIEWS_MIN: f32 = 6.0;
/// A step is told with this many pixels to either side.
const REACH_PX: usize = 2 * box_filter::REACH + 1;
/// Classes of brightness in which noise is told, each this wide (logarithm), ...
const CLASS_LOG: f32 = 0.15;
/// ... from 0 + [`DARK_GREY`] to 255.
const CLASSES: usize = 28;
/// Noise is told from the quietest quarter of the pixels of a brightness.
const QUIET_SHARE: f32 = 0.25;
/// Bins of the logarithm of energy, four to a factor of two, from 2^-24 on.
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
    /// How much it counts where directions are sought.
    pub weight: f32,
    /// How well the views agree on it: 0 hardly, 1 wholly.
    pub agreement: f32,
}

/// Sums over the views.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Step along X and Y.
    step: [f32; 2],
    /// Its squared length.
    energy: f32,
    /// Logarithm of the grey value.
    log: f32,
    views: f32,
}

/// The stack of one window at a time.
pub struct Stack {
    geometry: BeltView,
    zone: BeltRect,
    px_mm: f64,
    columns: usize,
    rows: usize,
    origin_mm: [f64; 2],
    /// Logarithm of the grey values 0 to 255.
    log_of: [f32; 256],
    log: Block<f32>,
    slow: Block<f32>,
    sums: Block<Sums>,
    edges: Block<EdgePixel>,
    edge_count: usize,
}

fn sides_max(view: &BeltView, zone: &BeltRect) -> (f64, usize, usize) {
    let px_mm = PX_MM.max(view.mm_per_px);
    let columns = (WINDOW_MAX_MM / px_mm).ceil() as usize;
    let rows = ((zone.y_max_mm - zone.y_min_mm).min(WINDOW_MAX_MM) / px_mm).ceil() as usize;
    (px_mm, columns, rows)
}

impl Stack {
    /// Memory for a view and a zone.
    pub fn plan(view: &BeltView, zone: &BeltRect, plan: &mut Plan) {
        let (_, columns, rows) = sides_max(view, zone);
        let n = columns * rows;
        plan.add::<f32>("stack.log", n, "one view on a plane");
        plan.add::<f32>("stack.slow", n, "its slow part");
        plan.add::<Sums>("stack.sums", n, "steps and energies over the views");
        plan.add::<EdgePixel>("stack.edges", n, "edge pixels of a plane");
    }

    /// Nothing stacked.
    pub fn new(view: &BeltView, zone: &BeltRect, memory: &mut Memory) -> Result<Self> {
        let (px_mm, columns, rows) = sides_max(view, zone);
        Ok(Self {
            geometry: view.clone(),
            zone: *zone,
            px_mm,
            columns,
            rows,
            origin_mm: [0.0; 2],
            log_of: std::array::from_fn(|grey| (grey as f32 + DARK_GREY).ln()),
            log: memory.take("stack.log", 0.0)?,
            slow: memory.take("stack.slow", 0.0)?,
            sums: memory.take("stack.sums", Sums::default())?,
            edges: memory.take("stack.edges", EdgePixel::default())?,
            edge_count: 0,
        })
    }

    /// The largest window, pixels along and across.
    pub fn sides_max_px(view: &BeltView, zone: &BeltRect) -> (usize, usize) {
        let (_, columns, rows) = sides_max(view, zone);
        (columns, rows)
    }

    /// Side of a pixel, mm.
    pub fn px_mm(&self) -> f64 {
        self.px_mm
    }

    /// Edge pixels of the window.
    pub fn edges(&self) -> &[EdgePixel] {
        &self.edges[..self.edge_count]
    }

    /// Whether enough views see a point of the window.
    pub fn is_seen(&self, x_mm: f32, y_mm: f32) -> bool {
        let column = (x_mm - self.origin_mm[0] as f32) / self.px_mm as f32 + 0.5;
        let row = (self.origin_mm[1] as f32 - y_mm) / self.px_mm as f32 + 0.5;
        let inside = column >= 0.0 && row >= 0.0;
        let (column, row) = (column as usize, row as usize);
        inside
            && column < self.columns
            && row < self.rows
            && self.sums[row * self.columns + column].views >= VIEWS_MIN
    }

    /// Stack the views on a window, cut to the zone's width and to what there is memory for.
    pub fn fill(&mut self, views: &Views, seen: &[u64], window: &Window) {
        let (_, columns_max, rows_max) = sides_max(&self.geometry, &self.zone);
        let y_max_mm = window.y_mm[1].min(self.zone.y_max_mm);
        let y_min_mm = window.y_mm[0].max(self.zone.y_min_mm);
        let count = |length_mm: f64| (length_mm / self.px_mm).ceil().max(1.0) as usize;
        self.columns = count(window.x_mm[1] - window.x_mm[0]).min(columns_max);
        self.rows = count(y_max_mm - y_min_mm).min(rows_max);
        self.origin_mm = [window.x_mm[0], y_max_mm];
        self.sums[..self.columns * self.rows].fill(Sums::default());
        for place in views.places() {
            let travel_mm = views.kept(place).at.travel_mm;
            let (first_mm, last_mm) = (window.x_mm[0] + travel_mm, window.x_mm[1] + travel_mm);
            if last_mm > self.zone.x_min_mm && first_mm < self.zone.x_max_mm {
                let columns = self.project(views, place, seen, window.height_mm);
                self.add(columns);
            }
        }
        self.find_edges();
    }

    /// One view on the plane: logarithms, NaN where it is not seen. Returns the columns in the zone.
    fn project(
        &mut self,
        views: &Views,
        place: usize,
        seen: &[u64],
        height_mm: f64,
    ) -> std::ops::Range<usize> {
        let (grey, view) = (views.grey(place), &self.geometry);
        let travel_mm = views.kept(place).at.travel_mm;
        let m = view.magnification(height_mm);
        let step_px = m * self.px_mm / view.mm_per_px;
        let x_mm = view.nadir.x + m * (self.origin_mm[0] + travel_mm - view.nadir.x);
        let y_mm = view.nadir.y + m * (self.origin_mm[1] - view.nadir.y);
        let u0 = (x_mm - view.origin.x) / view.mm_per_px;
        let v0 = (view.origin.y - y_mm) / view.mm_per_px;
        let [width, height] = view.size_px;
        // In the zone and in the picture.
        let in_zone = [self.zone.x_min_mm, self.zone.x_max_mm]
            .map(|mm| (mm - travel_mm - self.origin_mm[0]) / self.px_mm);
        let in_view = [-u0 / step_px, ((width - 2) as f64 - u0) / step_px];
        let first = in_zone[0].max(in_view[0]).ceil().max(0.0) as usize;
        let end =
            (in_zone[1].min(in_view[1]).floor() + 1.0).clamp(0.0, self.columns as f64) as usize;
        let columns = first.min(end)..end;
        let n = words(width);
        for row in 0..self.rows {
            let log = &mut self.log[row * self.columns..][..self.columns];
            let v = v0 + row as f64 * step_px;
            if v < 0.0 || v >= (height - 1) as f64 {
                log[columns.clone()].fill(f32::NAN);
                continue;
            }
            let (j, fv) = (v as usize, v.fract() as f32);
            let (above, below, seen) = (grey.row(j), grey.row(j + 1), &seen[j * n..][..n]);
            let mut u = u0 + columns.start as f64 * step_px;
            for out in &mut log[columns.clone()] {
                let (i, fu) = (u as usize, (u - u.floor()) as f32);
                *out = if bits::get(seen, i) {
                    let [a, b, c, d] = [above[i], above[i + 1], below[i], below[i + 1]]
                        .map(|grey| self.log_of[usize::from(grey)]);
                    let (top, bottom) = (a + fu * (b - a), c + fu * (d - c));
                    top + fv * (bottom - top)
                } else {
                    f32::NAN
                };
                u += step_px;
            }
        }
        columns
    }

    /// Add the steps of the view just projected.
    fn add(&mut self, columns: std::ops::Range<usize>) {
        let (width, rows) = (self.columns, self.rows);
        if columns.len() <= 2 * REACH_PX || rows <= 2 * REACH_PX {
            return;
        }
        // `log` becomes the fine part where all of its surroundings are seen, `slow` is scratch.
        self.take_out_the_slow_part(&columns);
        for row in REACH_PX..rows - REACH_PX {
            for column in columns.start + REACH_PX..columns.end - REACH_PX {
                let i = row * width + column;
                let fine = &self.log;
                let dx = fine[i + 1] - fine[i - 1];
                let dy = fine[i - width] - fine[i + width];
                let energy = dx * dx + dy * dy;
                if energy.is_nan() {
                    continue;
                }
                let sums = &mut self.sums[i];
                sums.step[0] += dx;
                sums.step[1] += dy;
                sums.energy += energy;
                sums.log += fine[i] + self.slow[i];
                sums.views += 1.0;
            }
        }
    }

    fn take_out_the_slow_part(&mut self, columns: &std::ops::Range<usize>) {
        let (width, rows) = (self.columns, self.rows);
        self.slow[..rows * width].copy_from_slice(&self.log[..rows * width]);
        for _ in 0..2 {
            for row in 0..rows {
                let line = &mut self.slow[row * width + columns.start..];
                box_filter(line, 1, columns.len());
            }
            for column in columns.clone() {
                box_filter(&mut self.slow[column..], width, rows);
            }
        }
        for row in 0..rows {
            for i in row * width + columns.start..row * width + columns.end {
                self.log[i] -= self.slow[i];
            }
        }
    }

    fn find_edges(&mut self) {
        let noise = self.noise();
        self.edge_count = 0;
        for row in 0..self.rows {
            for column in 0..self.columns {
                let Sums { step: [x, y], energy, log, views: n } =
                    self.sums[row * self.columns + column];
                if n < VIEWS_MIN {
                    continue;
                }
                let (x, y, energy) = (x / n, y / n, energy / n);
                let noise = noise_at(&noise, log / n);
                let common = x * x + y * y;
                let semblance = (common - noise / n) / (energy - noise).max(0.15 * energy);
                let beyond_noise = common * n > STEP_SIGMA_MIN * STEP_SIGMA_MIN * noise;
                if semblance < SEMBLANCE_MIN || !beyond_noise || common < STEP_MIN * STEP_MIN {
                    continue;
                }
                let strength = common.sqrt();
                self.edges[self.edge_count] = EdgePixel {
                    at_mm: [
                        (self.origin_mm[0] + column as f64 * self.px_mm) as f32,
                        (self.origin_mm[1] - row as f64 * self.px_mm) as f32,
                    ],
                    step: [x / strength, y / strength],
                    weight: strength.min(0.1),
                    agreement: ((semblance - SEMBLANCE_MIN) / (SEMBLANCE_WHOLE - SEMBLANCE_MIN))
                        .min(1.0),
                };
                self.edge_count += 1;
            }
        }
    }

    /// Energy of noise in each class of brightness.
    fn noise(&self) -> [f32; CLASSES] {
        let mut counts = [[0u32; ENERGY_BINS]; CLASSES];
        for &Sums { energy, log, views: n, .. } in &self.sums[..self.columns * self.rows] {
            if n >= VIEWS_MIN {
                let bin = 4.0 * ((energy / n).max(1e-9).log2() + 24.0);
                let bin = (bin.max(0.0) as usize).min(ENERGY_BINS - 1);
                counts[class_of(log / n) as usize][bin] += 1;
            }
        }
        let mut noise = counts.map(|counts| {
            let all: u32 = counts.iter().sum();
            if all < 50 {
                return f32::NAN;
            }
            let quiet = (QUIET_SHARE * all as f32) as u32;
            let mut below = 0;
            let within = |count: &u32| {
                below += count;
                below > quiet
            };
            let bin = counts.iter().position(within).unwrap_or(0);
            (0.25 * (bin as f32 + 0.5) - 24.0).exp2()
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

fn class_of(log: f32) -> f32 {
    ((log - DARK_GREY.ln()) / CLASS_LOG).clamp(0.0, (CLASSES - 1) as f32)
}

fn noise_at(noise: &[f32; CLASSES], log: f32) -> f32 {
    let class = class_of(log) - 0.5;
    let low = class.max(0.0) as usize;
    let share = (class - low as f32).clamp(0.0, 1.0);
    noise[low] + share * (noise[(low + 1).min(CLASSES - 1)] - noise[low])
}
