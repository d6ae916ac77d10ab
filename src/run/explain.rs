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
use crate::stage::evidence::Evidence;
use crate::stage::measure::{self, Measured, Rounding, WholePass, canonical_estimate};
use crate::stage::parcels::{Face, Parcels};
use crate::stage::views::{Kept, Views};
use image::{Rgb, RgbImage};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Columns of cells between two looks for parcels.
const LOOK_COLUMNS: i64 = 8;
/// Columns of the picture at most: an hour of belt is no picture.
const PICTURE_COLUMNS_MAX: usize = 20_000;
/// Pixels of a picture's cell.
const PICTURE_PX: u32 = 2;

/// The second opinion.
pub struct Explainer {
    folder: PathBuf,
    views: Views,
    evidence: Evidence,
    parcels: Parcels,
    looked: i64,
    breaks: u32,
    /// As JSON: each record, and what it was decided from.
    records: Vec<serde_json::Value>,
    /// Heights of the columns decided, and the first one's number.
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
        let (view, zone) = (&site.view, &site.config.zone);
        let mut plan = Plan::default();
        Views::plan(view, &mut plan);
        Evidence::plan(view, zone, site.height_max_mm, &mut plan);
        Parcels::plan(view, zone, site.height_max_mm, &mut plan);
        let mib = plan.bytes().div_ceil(1 << 20);
        let mut memory = plan.reserve(mib)?;
        let views = Views::new(view, zone, &mut memory)?;
        let (height_max_mm, level, seen) = (site.height_max_mm, Level::new(), pipeline.seen());
        let evidence = Evidence::new(view, zone, height_max_mm, level, seen, &mut memory)?;
        let parcels = Parcels::new(view, zone, &evidence, height_max_mm, level, seen, &mut memory)?;
        memory.seal()?;
        let (folder, records, picture) = (folder.to_owned(), Vec::new(), Vec::new());
        Ok(Self {
            folder,
            views,
            evidence,
            parcels,
            // Columns begin anywhere.
            looked: i64::MIN / 2,
            breaks: 0,
            records,
            picture,
            pictured: 0,
        })
    }

    /// A frame more, after the pipeline's step.
    pub fn frame(&mut self, pipeline: &Pipeline, time: FrameTime) {
        let at = pipeline.belt_position();
        if at.breaks != self.breaks {
            // What was before has no place in what comes.
            self.look(pipeline, f64::NEG_INFINITY);
            self.breaks = at.breaks;
        }
        if self.views.offer(pipeline.pixels(), at, time)
            && let Some(place) = self.views.newest()
        {
            self.evidence.add(&self.views, place);
            self.parcels.add(&self.views, place);
        }
        self.evidence.advance(&self.views, at.travel_mm, at.breaks);
        let decided = self.evidence.decided();
        if !decided.is_empty() && decided.end - self.looked >= LOOK_COLUMNS {
            self.look(pipeline, pipeline.site().config.zone.x_max_mm - at.travel_mm);
        }
    }

    fn look(&mut self, pipeline: &Pipeline, end_mm: f64) {
        self.looked = self.evidence.decided().end;
        self.draw();
        let pass = whole_pass(pipeline);
        let fit = |face: &Face| pass.cuboid(&self.views, face);
        for face in self.parcels.passed(&self.evidence, &self.views, end_mm, fit) {
            self.record(pipeline.site(), &pass, &face);
        }
    }

    fn record(&mut self, site: &Site, pass: &WholePass<'_>, face: &Face) {
        let Some((measured, travel_sigma)) = pass.measure(&self.views, face) else { return };
        let Some(place) = self.views.newest() else { return };
        let mut record =
            record_of(&measured, self.views.kept(place), self.records.len() as u32 + 1);
        record.flags.set(doubts(site, &measured, travel_sigma), true);
        let Ok(serde_json::Value::Object(mut told)) = serde_json::to_value(record.rounded()) else {
            return;
        };
        let share = (1e3 * measured.estimate.edge_share).round() / 1e3;
        told.insert("edge_share".into(), share.into());
        told.insert("edges".into(), measured.estimate.edge_count.into());
        told.insert("face".into(), told_of(face));
        self.records.push(told.into());
    }

    fn draw(&mut self) {
        let decided = self.evidence.decided();
        if self.picture.is_empty() {
            self.pictured = decided.start;
        }
        for column in self.pictured.max(decided.start)..decided.end {
            let cells = self.evidence.column(column).iter();
            let heights = cells.map(|cell| (cell.strength > 0.0).then_some(cell.height_mm));
            if self.picture.len() < PICTURE_COLUMNS_MAX {
                self.picture.push(heights.collect());
            }
            self.pictured = column + 1;
        }
    }

    /// The end of the recording: what is left, and the files.
    pub fn finish(mut self, pipeline: &Pipeline) -> Result<()> {
        self.look(pipeline, f64::NEG_INFINITY);
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

fn whole_pass(pipeline: &Pipeline) -> WholePass<'_> {
    let site = pipeline.site();
    WholePass {
        geometry: &site.view,
        zone: &site.config.zone,
        height_max_mm: site.height_max_mm,
        rounding: Rounding::of_radius(site.config.measure.edge_radius_mm),
        seen: pipeline.seen(),
    }
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
