//! Why each parcel of a recording was told as it was.
//!
//! Written are, one JSON line a parcel, its record with what each witness showed of it, and a picture of the heights:
//! the belt from above, each cell with its height, blue low to red high.

use crate::error::{Error, Result};
use crate::pipeline::{Decision, Pipeline};
use crate::stage::evidence::Evidence;
use crate::stage::passes::Passed;
use image::{Rgb, RgbImage};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Columns of the picture at most: an hour of belt is no picture.
const PICTURE_COLUMNS_MAX: usize = 20_000;
/// Pixels of a picture's cell.
const PICTURE_PX: u32 = 2;

/// The reasons of a recording.
pub struct Explainer {
    folder: PathBuf,
    records: Vec<serde_json::Value>,
    /// Heights of the columns decided, and the next one's number.
    picture: Vec<Vec<Option<f32>>>,
    pictured: i64,
}

impl Explainer {
    /// Results go to `folder`, which is created.
    pub fn new(folder: &Path) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|e| {
            Error::failure(format!("cannot create the folder: {e}")).in_file(folder)
        })?;
        Ok(Self {
            folder: folder.to_owned(),
            records: Vec::new(),
            picture: Vec::new(),
            pictured: 0,
        })
    }

    /// A frame more, after the pipeline's step, or its end.
    pub fn frame(&mut self, pipeline: &Pipeline) {
        self.records.extend(pipeline.decisions().iter().filter_map(reasons));
        self.draw(pipeline.evidence());
    }

    fn draw(&mut self, evidence: &Evidence) {
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

    /// The end of the recording: the files.
    pub fn finish(self, pipeline: &Pipeline) -> Result<()> {
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
fn reasons(decision: &Decision) -> Option<serde_json::Value> {
    let mut told = serde_json::to_value(decision.record).ok()?;
    if let Some(silhouettes) = decision.silhouettes {
        told["silhouettes"] = serde_json::to_value(silhouettes.rounded()).ok()?;
    }
    if let Some((heights, passed)) = &decision.heights {
        told["heights"] = serde_json::to_value(heights.rounded()).ok()?;
        told["face"] = reasons_of(passed);
    }
    Some(told)
}

/// What was seen of a top face, and the edges that were fitted to it.
fn reasons_of(passed: &Passed) -> serde_json::Value {
    let (face, estimate) = (&passed.face, &passed.measured.estimate);
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
        "edges": estimate.edge_count,
        "edge_share": (1e3 * estimate.edge_share).round() / 1e3,
    })
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
