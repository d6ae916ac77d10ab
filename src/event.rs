//! What leaves the pipeline: parcel records and counters.

pub mod clock;
pub mod csv;

use serde::de::{Deserializer, Error as _};
use serde::ser::{SerializeSeq, Serializer};
use std::fmt;

/// Doubts about a record, as a set.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flags(u16);

impl Flags {
    /// Still inside when the input ended.
    pub const UNFINISHED: Self = Self(1 << 0);
    /// Its image ran together with a neighbour's for some of the pass.
    pub const MERGED: Self = Self(1 << 1);
    /// It reached over the side of the zone; parts outside are not used.
    pub const CLIPPED: Self = Self(1 << 2);
    /// The height's standard deviation is above `measure.sigma_max_mm`.
    pub const HEIGHT_UNCERTAIN: Self = Self(1 << 3);
    /// The belt speed was assumed, not measured, for most of the pass.
    pub const SPEED_ASSUMED: Self = Self(1 << 4);
    /// It vanished inside the zone, or over a gap in the frames.
    pub const LOST: Self = Self(1 << 5);
    /// Taller than `view.height_max_mm`: nothing of it can be trusted.
    pub const TOO_TALL: Self = Self(1 << 7);
    /// The standard deviation of length or width is above `measure.sigma_max_mm`.
    pub const FOOTPRINT_UNCERTAIN: Self = Self(1 << 8);
    /// Too few edges were found: size from the silhouette alone.
    pub const SILHOUETTE_ONLY: Self = Self(1 << 6);

    /// Corners on the top face and its edges disagree about the height.
    pub const HEIGHT_DISPUTED: Self = Self(1 << 9);

    /// Every flag: its name in records and its meaning, in bit order.
    pub const ALL: [(Self, &'static str, &'static str); 10] = [
        (Self::UNFINISHED, "unfinished", "still inside when the input ended"),
        (Self::MERGED, "merged", "its image ran together with a neighbour's for some of the pass"),
        (
            Self::CLIPPED,
            "clipped",
            "it reached over the side of the zone; parts outside are not used",
        ),
        (
            Self::HEIGHT_UNCERTAIN,
            "height_uncertain",
            "standard deviation of the height above measure.sigma_max_mm",
        ),
        (Self::SPEED_ASSUMED, "speed_assumed", "belt speed assumed, not measured: trust no height"),
        (Self::LOST, "lost", "it vanished inside the zone, or over a gap in the frames"),
        (
            Self::SILHOUETTE_ONLY,
            "silhouette_only",
            "too few edges: a rough size, trust no dimension",
        ),
        (Self::TOO_TALL, "too_tall", "taller than view.height_max_mm: trust no dimension"),
        (
            Self::FOOTPRINT_UNCERTAIN,
            "footprint_uncertain",
            "standard deviation of length or width above measure.sigma_max_mm",
        ),
        (
            Self::HEIGHT_DISPUTED,
            "height_disputed",
            "texture on the top and its edges disagree about the height",
        ),
    ];

    /// Add `flag` when `condition` holds.
    pub fn set(&mut self, flag: Self, condition: bool) {
        if condition {
            self.0 |= flag.0;
        }
    }

    /// Take `flag` out.
    pub fn clear(&mut self, flag: Self) {
        self.0 &= !flag.0;
    }

    /// Whether `flag` is in the set.
    pub fn has(self, flag: Self) -> bool {
        self.0 & flag.0 == flag.0
    }

    /// The set as bits, as the PLC reads it.
    pub fn bits(self) -> u16 {
        self.0
    }

    /// Whether there is no doubt.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }
}

impl fmt::Display for Flags {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut names =
            Self::ALL.iter().filter(|(flag, ..)| self.has(*flag)).map(|(_, name, _)| name);
        match names.next() {
            Some(first) => write!(f, "{first}")?,
            None => return Ok(()),
        }
        names.try_for_each(|name| write!(f, ", {name}"))
    }
}

/// By name where people read them. As bits on the disk of an appliance, where a flag that a later
/// version of the program has added is kept as it is.
impl serde::Serialize for Flags {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if !serializer.is_human_readable() {
            return self.0.serialize(serializer);
        }
        let mut seq = serializer.serialize_seq(None)?;
        for (_, name, _) in Self::ALL.iter().filter(|(flag, ..)| self.has(*flag)) {
            seq.serialize_element(name)?;
        }
        seq.end()
    }
}

impl<'de> serde::Deserialize<'de> for Flags {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if !deserializer.is_human_readable() {
            return u16::deserialize(deserializer).map(Self);
        }
        let mut flags = Self::default();
        for name in <Vec<String> as serde::Deserialize>::deserialize(deserializer)? {
            let known = Self::ALL.iter().find(|(_, known, _)| *known == name);
            let (flag, ..) = known.ok_or_else(|| D::Error::custom(format!("flag {name:?}")))?;
            flags.set(*flag, true);
        }
        Ok(flags)
    }
}

/// What the parcel looks like.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// The edges of a cuboid were found where it says.
    Box,
    /// Anything else; the dimensions are of the smallest upright cuboid that holds it.
    Irregular,
}

/// Why a parcel has no dimensions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NotMeasured {
    /// Seen in too few frames or over too little travel.
    TooBrief = 1,
    /// Its image was never apart from another's.
    NeverAlone = 2,
    /// It vanished inside the zone before its edges could be measured.
    Lost = 3,
    /// The belt's motion was not known while it passed, as over a gap in the frames.
    BeltMotionUnknown = 4,
}

impl NotMeasured {
    /// Every reason: its name in records and its meaning. The code is the reason's number.
    pub const ALL: [(Self, &'static str, &'static str); 4] = [
        (Self::TooBrief, "too_brief", "seen in too few frames or over too little travel"),
        (Self::NeverAlone, "never_alone", "its image was never apart from another's"),
        (Self::Lost, "lost", "it vanished inside the zone before its edges could be measured"),
        (
            Self::BeltMotionUnknown,
            "belt_motion_unknown",
            "the belt's motion was not known while it passed, as over a gap in the frames",
        ),
    ];
}

impl fmt::Display for NotMeasured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::ALL.iter().find(|(reason, ..)| reason == self).map(|(_, name, _)| *name);
        f.write_str(name.unwrap_or_default())
    }
}

/// One parcel, as it is reported: once, when it leaves the zone, measured or not. Field order is
/// that of the JSON line.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ParcelRecord {
    /// From 1, never skips.
    pub seq: u32,
    /// Frame, from 0, at which `x_mm` and `y_mm` hold.
    pub frame: u64,
    /// Its time from the first frame.
    pub t_s: f64,
    /// Longer side of the footprint.
    pub length_mm: f64,
    /// Shorter side of the footprint.
    pub width_mm: f64,
    /// Height over the belt.
    pub height_mm: f64,
    /// Length axis against +X, in (-90, 90].
    pub yaw_deg: f64,
    /// Footprint centre along travel.
    pub x_mm: f64,
    /// Footprint centre across the belt, left positive.
    pub y_mm: f64,
    /// Standard deviation of the length.
    pub sigma_length_mm: f64,
    /// Standard deviation of the width.
    pub sigma_width_mm: f64,
    /// Standard deviation of the height.
    pub sigma_height_mm: f64,
    /// Mean belt speed over the pass.
    pub belt_speed_mm_per_s: f64,
    /// Cuboid or not.
    pub shape: Shape,
    /// Doubts.
    pub flags: Flags,
    /// Why it has no dimensions; they are 0 then, and the position is that of its image on the belt.
    pub not_measured: Option<NotMeasured>,
    /// The dimensions may be used: measured, without a doubt, and every standard deviation within
    /// `measure.sigma_max_mm`.
    pub may_be_used: bool,
    /// Belt travel since start at `frame`: where the parcel is later, follows from it.
    pub belt_travel_mm: f64,
    /// The belt's motion was told by the encoder when it left.
    pub by_encoder: bool,
}

impl ParcelRecord {
    /// Heads the lines that records print as.
    pub const TABLE_HEADER: &str = "  seq  frame    t s   length  width height mm   +-     +-     +-    yaw deg     x mm    y mm  shape";

    /// Values rounded to what they can mean: 0.01 mm and degrees, 0.1 ms.
    #[must_use]
    pub fn rounded(mut self) -> Self {
        let round = |value: &mut f64, steps: f64| *value = (*value * steps).round() / steps;
        round(&mut self.t_s, 1e4);
        for value in [
            &mut self.length_mm,
            &mut self.width_mm,
            &mut self.height_mm,
            &mut self.yaw_deg,
            &mut self.x_mm,
            &mut self.y_mm,
            &mut self.sigma_length_mm,
            &mut self.sigma_width_mm,
            &mut self.sigma_height_mm,
            &mut self.belt_speed_mm_per_s,
            &mut self.belt_travel_mm,
        ] {
            round(value, 100.0);
        }
        // Rounding may reach the open end of (-90, 90].
        if self.yaw_deg <= -90.0 {
            self.yaw_deg += 180.0;
        }
        self
    }
}

impl fmt::Display for ParcelRecord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:5} {:6} {:6.2}   {:6.1} {:6.1} {:6.1}    {:6.2} {:6.2} {:6.2}   {:7.2}   {:7.1} {:7.1}  {:?} {}",
            self.seq,
            self.frame,
            self.t_s,
            self.length_mm,
            self.width_mm,
            self.height_mm,
            self.sigma_length_mm,
            self.sigma_width_mm,
            self.sigma_height_mm,
            self.yaw_deg,
            self.x_mm,
            self.y_mm,
            self.shape,
            self.flags
        )?;
        match self.not_measured {
            Some(reason) => write!(f, " not measured: {reason}"),
            None => Ok(()),
        }
    }
}

/// Things that happened and must not pass unnoticed; all only grow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames processed.
    pub frames: u64,
    /// Parcels reported, measured or not.
    pub parcels: u64,
    /// Of these, parcels without dimensions.
    pub unmeasured: u64,
    /// Things that left and were too small to be a parcel: slivers of shadow or light.
    pub slivers: u64,
    /// Parcels that vanished inside the view.
    pub lost: u64,
    /// Frames with more runs or blobs than the tables hold.
    pub segment_overflows: u64,
    /// Blobs that found no free track.
    pub track_overflows: u64,
    /// Records that found the event queue full.
    pub event_overflows: u64,
}

impl fmt::Display for Counters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} frames, {} parcels reported ({} unmeasured, {} lost)",
            self.frames, self.parcels, self.unmeasured, self.lost
        )?;
        let overflows = self.segment_overflows + self.track_overflows + self.event_overflows;
        if overflows > 0 { write!(f, ", {overflows} table overflows") } else { Ok(()) }
    }
}
