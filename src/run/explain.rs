//! A second opinion on a recording: heights by known motion over the whole pass, decided at its end.
//!
//! It runs beside the pipeline, from the same belt views and belt positions, and decides nothing for
//! it. Written are its records, one JSON line a parcel, and a picture of the evidence: the belt from above, each
//! cell with its height, blue low to red high.

use crate::config::Site;
use crate::error::{Error, Result};
use crate::event::{Flags, ParcelRecord, Shape};
use crate::image::FrameTime;
use crate::kernel::Level;
use crate::pipeline::{Pipeline, doubts};
use crate::plan::Plan;
use crate::stage::measure::{self, Measured, Rounding, canonical_estimate};
use crate::stage::parcels::Face;
use crate::stage::passes::{Passed, Passes};
use crate::stage::views::Kept;
use image::{Rgb, RgbImage};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Columns of the picture at most: an hour of belt is no picture.
const PICTURE_COLUMNS_MAX: usize = 20_000;
/// Pixels of a picture's cell.
const PICTURE_PX: u32 = 2;

/// The second opinion.
pub struct Explainer {
    folder: PathBuf,
    passes: Passes,
    /// As JSON: each record, and what it was decided from.
    records: Vec<serde_json::Value>,
    /// Heights of the columns decided, and the next one's number.
    picture: Vec<Vec<Option<f32>>>,
    pictured: i64,
}

impl Explainer {
    /// Results go to `folder`, which is created.
    pub fn new(folder: &Path, pipeline: &Pipeline) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|e| {
            Error::failure(format!("cannot create the folder: {e}")).in_file(folder)
        })?;
        let site = pipeline.site();
        let (view, zone, height_max_mm) = (&site.view, &site.config.zone, site.height_max_mm);
        let mut plan = Plan::default();
        Passes::plan(view, zone, height_max_mm, &mut plan);
        let mib = plan.bytes().div_ceil(1 << 20);
        let mut memory = plan.reserve(mib)?;
        let rounding = Rounding::of_radius(site.config.measure.edge_radius_mm);
        let (level, seen) = (Level::new(), pipeline.seen());
        let passes = Passes::new(view, zone, height_max_mm, rounding, level, seen, &mut memory)?;
        memory.seal()?;
        let (folder, records, picture) = (folder.to_owned(), Vec::new(), Vec::new());
        Ok(Self { folder, passes, records, picture, pictured: 0 })
    }

    /// A frame more, after the pipeline's step.
    pub fn frame(&mut self, pipeline: &Pipeline, time: FrameTime) {
        let Self { passes, records, .. } = self;
        let mut emit =
            |passed: &Passed| records.extend(told(pipeline.site(), passed, records.len()));
        passes.step(pipeline.pixels(), pipeline.belt_position(), time, &mut emit);
        self.draw();
    }

    fn draw(&mut self) {
        let evidence = self.passes.evidence();
        let decided = evidence.decided();
        if self.picture.is_empty() {
            self.pictured = decided.start;
        }
        for column in self.pictured.max(decided.start)..decided.end {
            let cells = evidence.column(column).iter();
            let heights = cells.map(|cell| (cell.strength > 0.0).then_some(cell.height_mm));
            if self.picture.len() < PICTURE_COLUMNS_MAX {
                self.picture.push(heights.collect());
            }
            self.pictured = column + 1;
        }
    }

    /// The end of the recording: what is left, and the files.
    pub fn finish(mut self, pipeline: &Pipeline) -> Result<()> {
        let Self { passes, records, .. } = &mut self;
        passes.finish(&mut |passed| records.extend(told(pipeline.site(), passed, records.len())));
        let overflows = passes.overflows();
        if overflows > 0 {
            tracing::warn!("{overflows} parcels more than the second opinion has room for");
        }
        self.draw();
        let path = self.folder.join("parcels.jsonl");
        let io = |e: std::io::Error| Error::failure(format!("cannot write: {e}")).in_file(&path);
        let mut file = std::fs::File::create(&path).map_err(io)?;
        for record in &self.records {
            writeln!(file, "{record}").map_err(io)?;
        }
        let path = self.folder.join("evidence.png");
        let height_max_mm = pipeline.site().height_max_mm as f32;
        let picture = paint(&self.picture, height_max_mm);
        picture
            .save(&path)
            .map_err(|e| Error::failure(format!("cannot write the picture: {e}")).in_file(&path))
    }
}

/// A parcel's record, and what it was decided from.
fn told(site: &Site, passed: &Passed, before: usize) -> Option<serde_json::Value> {
    let Passed { face, measured, travel_sigma, newest } = passed;
    let mut record = record_of(measured, *newest, before as u32 + 1);
    record.flags.set(doubts(site, measured, *travel_sigma), true);
    let mut told = serde_json::to_value(record.rounded()).ok()?;
    let share = (1e3 * measured.estimate.edge_share).round() / 1e3;
    told["edge_share"] = share.into();
    told["edges"] = measured.estimate.edge_count.into();
    told["face"] = told_of(face);
    Some(told)
}

/// What the evidence showed of a top face, before edges were fitted.
fn told_of(face: &Face) -> serde_json::Value {
    let tenths = |value: f64| (10.0 * value).round() / 10.0;
    serde_json::json!({
        "length_mm": tenths(face.rectangle.length_mm),
        "width_mm": tenths(face.rectangle.width_mm),
        "height_mm": tenths(face.height_mm),
        "yaw_deg": tenths(face.rectangle.yaw.to_degrees()),
        "border_share": (1e2 * face.rectangle.support()).round() / 1e2,
        "sides": face.rectangle.sides.map(|share| (1e2 * share).round() / 1e2),
        "cells": face.cells,
        "is_cuboid": face.is_cuboid,
    })
}

fn record_of(measured: &Measured, kept: Kept, seq: u32) -> ParcelRecord {
    let estimate = canonical_estimate(measured.estimate);
    let (p, s) = (&estimate.params, &estimate.sigma);
    let shape = if measured.is_box { Shape::Box } else { Shape::Irregular };
    ParcelRecord {
        seq,
        frame: kept.time.index,
        t_s: kept.time.t_s,
        length_mm: p[measure::LENGTH],
        width_mm: p[measure::WIDTH],
        height_mm: p[measure::HEIGHT],
        yaw_deg: p[measure::YAW].to_degrees(),
        x_mm: p[measure::X],
        y_mm: p[measure::Y],
        sigma_length_mm: s[measure::LENGTH],
        sigma_width_mm: s[measure::WIDTH],
        sigma_height_mm: s[measure::HEIGHT],
        belt_speed_mm_per_s: 0.0,
        shape,
        flags: Flags::default(),
        not_measured: None,
        // A second opinion: nobody may sort by it.
        may_be_used: false,
        belt_travel_mm: kept.at.travel_mm,
        by_encoder: false,
    }
}

fn paint(columns: &[Vec<Option<f32>>], height_max_mm: f32) -> RgbImage {
    let rows = columns.first().map_or(1, Vec::len) as u32;
    let width = (columns.len() as u32).max(1);
    RgbImage::from_fn(width * PICTURE_PX, rows * PICTURE_PX, |x, y| {
        // The belt runs to the right: what came first is on the right.
        let column = columns.len().saturating_sub(1 + (x / PICTURE_PX) as usize);
        let cell = columns.get(column).and_then(|rows| rows.get((y / PICTURE_PX) as usize));
        cell.copied().flatten().map_or(Rgb([0, 0, 0]), |mm| colour(mm / height_max_mm))
    })
}

/// Blue to red over 0 to 1.
fn colour(share: f32) -> Rgb<u8> {
    let t = 4.0 * share.clamp(0.0, 1.0);
    let part = |centre: f32| (255.0 * (1.5 - (t - centre).abs()).clamp(0.0, 1.0)) as u8;
    Rgb([part(3.0), part(2.0), part(1.0)])
}
