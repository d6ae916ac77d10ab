//! `beltgauge measure`: a replay through the pipeline, as fast as it goes.

use super::explain::Explainer;
use super::outputs::refuse_inputs;
use super::{Annotator, memory};
use crate::config::Site;
use crate::error::{Error, Result};
use crate::event::{Counters, ParcelRecord};
use crate::health::{Condition, Level};
use crate::image::Plane;
use crate::pipeline::Pipeline;
use crate::source::FrameSource;
use crate::stage::odometry::Knowledge;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Where the results of a replay go, besides the table on standard output.
#[derive(Clone, Copy, Debug, Default)]
pub struct Outputs<'a> {
    /// One JSON line a parcel.
    pub jsonl: Option<&'a Path>,
    /// Annotated pictures.
    pub annotate: Option<&'a Path>,
    /// Why each parcel was told as it was, and a picture of the belt's heights.
    pub explain: Option<&'a Path>,
}

/// Who watches a replay.
pub trait Observer {
    /// A frame is about to be processed.
    fn frame(&mut self, _index: u64) {}
    /// A parcel was measured.
    fn record(&mut self, record: &ParcelRecord);
    /// At the end: what makes the recording doubtful.
    fn doubt(&mut self, _doubt: &str) {}
}

impl Outputs<'_> {
    /// Refuse outputs that would overwrite what is read: the recording, the configuration, the camera.
    pub fn refuse_inputs(&self, inputs: &[&Path]) -> Result<()> {
        for (option, output) in [("--jsonl", self.jsonl), ("--annotate", self.annotate)] {
            output.map_or(Ok(()), |output| refuse_inputs(option, output, inputs))?;
        }
        Ok(())
    }
}

/// Measure a replay. Pictures that could not be written are an error at the end. After a broken input
/// what was measured until there is written, with the parcels still inside flagged unfinished, and the
/// error returned.
pub fn measure(
    mut source: Box<dyn FrameSource>,
    site: Site,
    outputs: Outputs<'_>,
    observer: &mut dyn Observer,
) -> Result<Counters> {
    let [width, height] = source.size_px();
    site.check_image_size([width, height])?;
    let mut annotator = outputs.annotate.map(|f| Annotator::new(f, [width, height])).transpose()?;
    let (mut frames, mut pipeline) = memory::build(site)?;
    let mut explainer = outputs.explain.map(Explainer::new).transpose()?;
    let mut frame = frames.pop().ok_or_else(|| Error::failure("no frame was planned"))?;
    // Only now: an earlier run's records survive a start that fails.
    let mut lines = outputs.jsonl.map(JsonLines::create).transpose()?;
    let mut records: Vec<ParcelRecord> = Vec::new();
    let mut last_index = 0;
    loop {
        let next = source.next_into(&mut frame);
        records.clear();
        let ended = match next {
            Ok(Some(time)) => {
                last_index = time.index;
                observer.frame(time.index);
                let raw = Plane::packed(&frame, width, height)
                    .ok_or_else(|| Error::failure("a frame of another size"))?;
                pipeline.step(raw, time, &mut |r| records.push(r))?;
                if let Some(explainer) = &mut explainer {
                    explainer.frame(&pipeline);
                }
                None
            }
            Ok(None) => Some(Ok(pipeline.counters())),
            Err(error) => Some(Err(error)),
        };
        if ended.is_some() {
            pipeline.finish(&mut |r| records.push(r));
        }
        for record in &records {
            if let Some(lines) = &mut lines {
                lines.write(record)?;
            }
            observer.record(record);
        }
        if let Some(annotator) = &mut annotator {
            annotator.frame(&frame, last_index, &pipeline, &records);
        }
        if let Some(result) = ended {
            if let Some(doubt) = source.doubt() {
                observer.doubt(&doubt);
            }
            if let Some(doubt) = gap_doubt(pipeline.untold_gaps()) {
                observer.doubt(&doubt);
            }
            if let Some(doubt) = belt_doubt(&pipeline) {
                observer.doubt(&doubt);
            }
            if let Some(doubt) = condition_doubt(&pipeline.condition()) {
                observer.doubt(&doubt);
            }
            if let Some(mut explainer) = explainer {
                explainer.frame(&pipeline);
                explainer.finish(&pipeline)?;
            }
            result?;
            annotator.map_or(Ok(()), Annotator::finish)?;
            return Ok(pipeline.counters());
        }
    }
}

/// Frames that are missing in a recording without times of its own.
fn gap_doubt(frames: u64) -> Option<String> {
    (frames > 0).then(|| {
        format!(
            "the recording lacks {frames} frames, by the belt's steps: its travel was measured over them, but \
             times and speeds are wrong by as much: record without dropping frames"
        )
    })
}

/// What of the instrument is not as it was at the start of a recording.
fn condition_doubt(condition: &Condition) -> Option<String> {
    let Condition { place, sharpness, light } = condition;
    let moved = (place.level > Level::Good).then(|| {
        format!(
            "the camera has moved by {:.2} px: places or dimensions are wrong by up to {:.1} mm since then",
            place.moved.picture_px, place.moved.error_mm
        )
    });
    let unsharp = sharpness.blur_px.filter(|_| sharpness.level > Level::Good).map(|px| {
        format!("the picture is blurred by {px:.1} px: heights are wrong; focus or clean the lens")
    });
    let other_light = (light.level > Level::Good).then(|| {
        let (percent, region) = (100.0 * light.change, light.region);
        format!("the light has changed by {percent:.0} % in part {region} of the picture (4 x 3, from the top left)")
    });
    let all: Vec<String> = [moved, unsharp, other_light].into_iter().flatten().collect();
    (!all.is_empty()).then(|| all.join("; "))
}

/// What of the belt is not as the configuration says, at the end of a recording.
fn belt_doubt(pipeline: &Pipeline) -> Option<String> {
    let health = pipeline.health();
    let nominal = pipeline.site().config.belt.speed_mm_per_s;
    let seen = health.belt_seen_mm_per_s.filter(|_| health.belt_not_as_configured);
    if let Some(speed) = seen {
        let against = if speed < 0.0 { " against +X" } else { "" };
        let speed = speed.abs();
        return Some(format!(
            "the belt runs at {speed:.0} mm/s{against}; belt.speed_mm_per_s = {nominal}: correct it, or \
             the travel direction of the calibration"
        ));
    }
    if health.belt_hides_parcels {
        return Some(format!(
            "a parcel must differ from this belt by {:.0} grey levels: less light on the belt, a smaller \
             gain, or another belt would show more",
            health.contrast_min_grey
        ));
    }
    match health.texture {
        Knowledge::Ambiguous => Some(
            "the belt's texture repeats itself: its motion is ambiguous; an encoder tells it"
                .into(),
        ),
        Knowledge::Refuted => {
            Some("what the belt's texture shows is not its motion: parcels move against it".into())
        }
        Knowledge::NoTexture => Some(
            "the belt shows no texture: its nominal speed was assumed; an encoder tells it".into(),
        ),
        Knowledge::Measured => None,
    }
}

/// A file of JSON lines, complete after every line.
struct JsonLines<'a> {
    path: &'a Path,
    file: BufWriter<std::fs::File>,
}

impl<'a> JsonLines<'a> {
    fn create(path: &'a Path) -> Result<Self> {
        let file = std::fs::File::create(path).map_err(|e| {
            Error::failure(format!("cannot create the record file: {e}")).in_file(path)
        })?;
        Ok(Self { path, file: BufWriter::new(file) })
    }

    fn write(&mut self, record: &ParcelRecord) -> Result<()> {
        serde_json::to_writer(&mut self.file, record)
            .map_err(std::io::Error::from)
            .and_then(|()| self.file.write_all(b"\n"))
            .and_then(|()| self.file.flush())
            .map_err(|e| Error::failure(format!("cannot write a record: {e}")).in_file(self.path))
    }
}
