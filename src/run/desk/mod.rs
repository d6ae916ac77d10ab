//! The desk: a thread that takes what vision and PLC leave behind, makes pictures of it and puts it up
//! for the page and into the archive. Nobody waits for it.
//!
//! ```text
//! vision -> [shots] -> desk -> Board: live pictures, parcels, events, trend -> page
//!    ^-- [empty shots] --'  '-> archive's ring -> archive's thread -> disk
//! PLC thread -> [published records] --^
//! ```

mod bundle;
mod insight;
mod lamps;
mod news;
mod scene;
mod setup;
pub mod shots;
mod trend;

pub use bundle::Papers;
pub use insight::{Insight, is_due};
pub use shots::{Album, Photographer, Rings, Shot};

use crate::archive::{self, Archive};
use crate::config::{Config, DimensionOrder, Site};
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::event::clock::utc_ms;
use crate::image::Plane;
use crate::plc::link::Commanded;
use crate::web::{self, Board, NoPicture, View};
use heapless::spsc::Consumer;
use jpeg_encoder::{ColorType, Encoder};
use news::{News, event};
use scene::Geometry;
use serde::Serialize;
use shots::{Framing, LIVE, Subject};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use trend::Trend;

/// The desk looks at what happens this often, woken or not.
const LOOK: Duration = Duration::from_millis(50);
/// State and events are looked at this often.
const NEWS: Duration = Duration::from_millis(200);
/// The archive takes the last entries within this, or not at all.
const FAREWELL: Duration = Duration::from_secs(2);
/// Pictures of parcels that have not been told yet.
const WAITING_MAX: usize = 64;
/// A picture belongs to the parcel whose record is of its frame and this near.
const MATCH_MM: f64 = 100.0;
/// Qualities of JPEG: what moves, and what is kept.
const LIVE_QUALITY: u8 = 70;
const PARCEL_QUALITY: u8 = 80;
/// Of a parcel's picture this share of the pixels may become white, and as many black.
const CLIPPED_SHARE: f64 = 0.005;

/// What the desk is told by, and what it tells.
pub struct Desk<'a> {
    /// Its side of the pictures.
    pub album: Album<'a>,
    /// What the PLC was told.
    pub published: Consumer<'a, ParcelRecord>,
    /// What the PLC has commanded.
    pub commanded: Consumer<'a, Commanded>,
    /// What the page asks.
    pub insight: Arc<Insight>,
    /// What the page shows.
    pub board: Arc<Board>,
    geometry: Geometry,
    archive: Option<Archive>,
    config: Config,
    /// Live shots that are here, and when each kind was last asked for.
    live: Vec<(Option<Shot>, Option<Instant>)>,
    waiting: VecDeque<Waiting>,
    /// The last frames with a parcel that there was no room for a picture of.
    missed: Missed,
    news: News,
    trend: Trend,
    looked: Option<Instant>,
}

/// A picture of a parcel that has not been told yet.
struct Waiting {
    framing: Framing,
    sight: crate::pipeline::Sight,
    jpeg: Vec<u8>,
}

/// Frames with a parcel that there was no room for a picture of.
#[derive(Default)]
struct Missed(VecDeque<u64>);

impl Missed {
    fn note(&mut self, frame: u64) {
        if self.0.len() == WAITING_MAX {
            self.0.pop_front();
        }
        self.0.push_back(frame);
    }

    /// Why there is no picture of a parcel whose record is of a frame.
    fn why(&self, frame: u64) -> NoPicture {
        if self.0.contains(&frame) { NoPicture::TooMany } else { NoPicture::NotInMiddle }
    }
}

/// An entry of the archive.
#[derive(Serialize)]
struct Kept<'a, T: Serialize> {
    #[serde(flatten)]
    what: &'a T,
    boots: u16,
    version: &'static str,
}

/// The board of a machine that starts now.
pub fn board() -> Arc<Board> {
    Arc::new(Board::new(utc_ms()))
}

impl<'a> Desk<'a> {
    /// Take the shots, start the archive.
    pub fn new(
        site: &Site,
        shots: Vec<Shot>,
        mut album: Album<'a>,
        (published, commanded): (Consumer<'a, ParcelRecord>, Consumer<'a, Commanded>),
        insight: Arc<Insight>,
        board: Arc<Board>,
    ) -> Result<Self> {
        let config = site.config.clone();
        let archive = config.archive.folder.as_deref();
        let bytes_max = (config.archive.mib_max as u64) << 20;
        let archive = archive.map(|folder| Archive::start(folder, bytes_max)).transpose()?;
        let mut live: Vec<(Option<Shot>, Option<Instant>)> =
            (0..LIVE).map(|_| (None, None)).collect();
        for shot in shots {
            match shot.framing.subject {
                Subject::Raw => live[View::Raw as usize].0 = Some(shot),
                Subject::Belt => live[View::Belt as usize].0 = Some(shot),
                Subject::Whole => live[View::Setup as usize].0 = Some(shot),
                Subject::Parcel => {
                    let _ = album.spare.enqueue(shot); // invariant: there is room for all
                }
            }
        }
        Ok(Self {
            album,
            published,
            commanded,
            insight,
            board,
            geometry: Geometry::new(site),
            archive,
            config,
            live,
            waiting: VecDeque::new(),
            missed: Missed::default(),
            news: News::new(Instant::now()),
            trend: Trend::new(Instant::now()),
            looked: None,
        })
    }

    /// Until it is over; what came before is told.
    pub fn run(mut self, over: &dyn Fn() -> bool) {
        self.board.is_served_here();
        let mut started = false;
        loop {
            // Asked before the rings are emptied.
            let over = over();
            self.take_shots();
            // The first entry says which start of the machine this is: the PLC's thread knows.
            if !started && (over || self.insight.plc_side().is_known()) {
                started = true;
                self.happened(event(utc_ms(), "started", 0, env!("CARGO_PKG_VERSION").to_owned()));
            }
            while started && let Some(record) = self.published.dequeue() {
                self.parcel(record);
            }
            while started && let Some(given) = self.commanded.dequeue() {
                self.happened(news::command(utc_ms(), &given));
            }
            for event in self.board.take_notes() {
                self.happened(event);
            }
            let now = Instant::now();
            if over || self.looked.is_none_or(|at| now - at >= NEWS) {
                self.looked = Some(now);
                let condition = self.archive.as_ref().map(Archive::condition);
                self.insight.desk_tells(condition);
                let plc = self.insight.plc_side();
                for event in self.news.look(&plc, utc_ms(), now) {
                    self.happened(event);
                }
                if let Some(point) = self.trend.look(&plc, utc_ms(), now) {
                    self.board.point(point);
                }
            }
            if over {
                break;
            }
            std::thread::park_timeout(self.ask(now));
        }
        self.happened(event(utc_ms(), "stopped", 0, String::new()));
        self.board.close();
        if let Some(archive) = self.archive {
            archive.finish(FAREWELL);
        }
    }

    /// Ask for the live pictures that somebody waits for; returns how long to sleep.
    fn ask(&mut self, now: Instant) -> Duration {
        let period = Duration::from_secs(1) / self.config.web.pictures_per_s_max.max(1);
        let mut sleep = LOOK;
        for view in [View::Raw, View::Belt, View::Setup] {
            let (shot, asked) = &mut self.live[view as usize];
            if shot.is_none() || !self.board.is_wanted(view) {
                continue;
            }
            let rest = asked.map_or(Duration::ZERO, |at| period.saturating_sub(now - at));
            if !rest.is_zero() {
                sleep = sleep.min(rest);
            } else if let Some(shot) = shot.take() {
                *asked = Some(now);
                let _ = self.album.asked.enqueue(shot); // invariant: there is room for all
            }
        }
        sleep
    }

    fn take_shots(&mut self) {
        while let Some(frame) = self.album.missed.dequeue() {
            self.missed.note(frame);
        }
        while let Some(shot) = self.album.taken.dequeue() {
            match shot.framing.subject {
                Subject::Raw => self.put_up(View::Raw, shot),
                Subject::Belt => self.put_up(View::Belt, shot),
                Subject::Whole => self.put_up(View::Setup, shot),
                Subject::Parcel => {
                    tell_failure(self.keep(&shot));
                    let _ = self.album.spare.enqueue(shot); // invariant: there is room for all
                }
            }
        }
    }

    fn put_up(&mut self, view: View, shot: Shot) {
        tell_failure(match view {
            View::Setup => self.set_up(&shot),
            View::Raw | View::Belt => self.show(view, &shot),
        });
        self.live[view as usize].0 = Some(shot);
    }

    fn show(&self, view: View, shot: &Shot) -> Result<()> {
        let scene = self.geometry.scene(shot);
        let bytes = described(&scene, shot.pixels(), shot.framing.size_px)?;
        self.board.picture(view, scene.frame, bytes);
        Ok(())
    }

    /// Show what helps to set the camera up, and keep the picture of a board for whoever wants it.
    fn set_up(&self, shot: &Shot) -> Result<()> {
        let Framing { size_px, time, .. } = shot.framing;
        let picture = Plane::packed(shot.pixels(), size_px[0], size_px[1])
            .ok_or_else(|| Error::failure("a picture of another size"))?;
        let motion_blur_px = setup::motion_blur_px(&self.config, self.geometry.mm_per_px());
        let (setup, size_px, pixels) =
            setup::look(picture, time, self.board.looked_for(), motion_blur_px);
        if setup.board.as_ref().is_some_and(|board| board.found == "found") {
            self.board.whole(setup.frame, setup::pgm(shot.pixels(), setup.size_px));
        }
        let bytes = described(&setup, &pixels, size_px)?;
        self.board.picture(View::Setup, setup.frame, bytes);
        Ok(())
    }

    /// Keep the picture of a parcel until it is told.
    fn keep(&mut self, shot: &Shot) -> Result<()> {
        let Some(sight) = shot.sights.first() else { return Ok(()) };
        let mut jpeg = Vec::new();
        encode(&stretched(shot.pixels()), shot.framing.size_px, PARCEL_QUALITY, &mut jpeg)?;
        if self.waiting.len() == WAITING_MAX
            && let Some(oldest) = self.waiting.pop_front()
        {
            self.missed.note(oldest.framing.time.index);
        }
        self.waiting.push_back(Waiting { framing: shot.framing, sight: *sight, jpeg });
        Ok(())
    }

    fn picture_of(&mut self, record: &ParcelRecord) -> Option<Waiting> {
        let candidates = self.waiting.iter().enumerate();
        let distances = candidates
            .filter(|(_, waiting)| waiting.framing.time.index == record.frame)
            .map(|(i, waiting)| (i, self.geometry.distance_mm(&waiting.sight, record)));
        let (nearest, distance_mm) = distances.min_by(|a, b| a.1.total_cmp(&b.1))?;
        if distance_mm > MATCH_MM {
            return None;
        }
        self.waiting.remove(nearest)
    }

    fn parcel(&mut self, record: ParcelRecord) {
        let waiting = self.picture_of(&record);
        let no_picture = waiting.is_none().then(|| self.missed.why(record.frame));
        if no_picture == Some(NoPicture::TooMany) {
            self.insight.pictures_missed.fetch_add(1, Ordering::Relaxed);
        }
        self.trend.parcel(&record);
        self.insight.usable.fetch_add(u64::from(record.may_be_used), Ordering::Relaxed);
        // In descending order it is not known which side is the height.
        let is_upright = self.config.plc.order != DimensionOrder::Descending;
        let picture = waiting.as_ref().map(|waiting| web::ParcelPicture {
            size_px: waiting.framing.size_px,
            cuboid_px: self.geometry.recorded(&waiting.framing, &record).filter(|_| is_upright),
        });
        let jpeg = waiting.map(|waiting| waiting.jpeg).unwrap_or_default();
        // What the PLC's rounding left behind the last digit is noise.
        let record = record.rounded();
        let parcel = web::Parcel { n: 0, utc_ms: utc_ms(), record, picture, no_picture };
        let parcel = self.board.parcel(parcel, jpeg.clone());
        self.archive(archive::Kind::Parcel, parcel.utc_ms, &*parcel, jpeg);
    }

    fn happened(&self, event: web::Event) {
        let event = self.board.event(event);
        self.archive(archive::Kind::Event, event.utc_ms, &*event, Vec::new());
    }

    fn archive<T: Serialize>(&self, kind: archive::Kind, utc_ms: u64, what: &T, picture: Vec<u8>) {
        let Some(archive) = &self.archive else { return };
        let boots = self.insight.plc_side().status.boots;
        let kept = Kept { what, boots, version: env!("CARGO_PKG_VERSION") };
        if let Ok(text) = json(&kept) {
            archive.put(archive::Entry { kind, utc_ms, text, picture });
        }
    }
}

/// A picture that fails is no reason to make no others.
fn tell_failure(made: Result<()>) {
    if let Err(e) = made {
        tracing::error!("{e}");
    }
}

fn json(what: &impl Serialize) -> Result<String> {
    serde_json::to_string(what).map_err(|e| Error::failure(format!("no JSON: {e}")))
}

/// A line of JSON, then the picture that it describes.
fn described(what: &impl Serialize, pixels: &[u8], size_px: [usize; 2]) -> Result<Vec<u8>> {
    let mut bytes = json(what)?.into_bytes();
    bytes.push(b'\n');
    encode(pixels, size_px, LIVE_QUALITY, &mut bytes)?;
    Ok(bytes)
}

fn encode(pixels: &[u8], size_px: [usize; 2], quality: u8, into: &mut Vec<u8>) -> Result<()> {
    let [width, height] = size_px.map(|n| n as u16);
    Encoder::new(into, quality)
        .encode(pixels, width, height, ColorType::Luma)
        .map_err(|e| Error::failure(format!("a picture cannot be encoded: {e}")))
}

/// Raw belts are dark; pictures are for people.
fn stretched(pixels: &[u8]) -> Vec<u8> {
    let mut histogram = [0usize; 256];
    for &grey in pixels {
        histogram[usize::from(grey)] += 1;
    }
    let clipped = (CLIPPED_SHARE * pixels.len() as f64) as usize;
    let end = |mut greys: Box<dyn Iterator<Item = usize>>| {
        let mut count = 0;
        let beyond = |grey: &usize| {
            count += histogram[*grey];
            count > clipped
        };
        greys.find(beyond).unwrap_or(0)
    };
    let (black, white) = (end(Box::new(0..256)), end(Box::new((0..256).rev())));
    let span = white.saturating_sub(black).max(32);
    let grey = |grey: usize| (grey.saturating_sub(black) * 255 / span).min(255) as u8;
    let table: [u8; 256] = std::array::from_fn(grey);
    pixels.iter().map(|&grey| table[usize::from(grey)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn why_there_is_no_picture_is_known_of_the_last_frames() {
        let mut missed = Missed::default();
        (0..1000).for_each(|frame| missed.note(2 * frame));
        assert_eq!(missed.why(1998), NoPicture::TooMany);
        assert_eq!(missed.why(1997), NoPicture::NotInMiddle);
        assert_eq!(missed.0.len(), WAITING_MAX);
    }

    #[test]
    fn a_dark_picture_is_stretched_and_a_plain_one_stays_plain() {
        let dark: Vec<u8> = (0..1000u32).map(|i| 30 + (i % 40) as u8).collect();
        let bright = stretched(&dark);
        assert!(bright.iter().max() > Some(&250) && bright.iter().min() < Some(&8));
        let plain = stretched(&[45; 1000]);
        assert!(plain.iter().all(|&grey| grey == plain[0]), "noise is not blown up");
        assert!(stretched(&[]).is_empty());
    }
}
