//! What is told, as JSON: version 1 of the schema. Fields may be added; none is renamed or taken away
//! within a version.

use super::topics::Topics;
use super::{Entry, Kind};
use crate::event::clock::{utc, utc_ms};
use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Version of the schema.
const SCHEMA: u8 = 1;

/// Whose it is.
#[derive(Clone, Debug)]
pub struct Identity {
    site: String,
    lane: String,
    serial: String,
    boots: u16,
    /// Events of the fleet's own, since start.
    told: Arc<AtomicU64>,
}

/// How well the machine's clock is known to agree with the world's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// Nothing is known about it.
    Unknown,
    /// It follows a time server.
    Synchronised,
    /// It follows none.
    Free,
}

/// A parcel, on the topic `beltgauge/SITE/LANE/parcel`: once for every parcel, and again with the same id
/// after a reconnect, a restart or on request.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(title = "beltgauge/SITE/LANE/parcel, schema 1")]
pub struct Parcel {
    /// Version of this schema.
    #[schemars(range(min = 1, max = 1))]
    pub schema: u8,
    /// SERIAL/BOOTS/SEQ, the same however often it is told: the key to insert or replace by.
    pub id: String,
    /// The site, as configured.
    pub site: String,
    /// The lane, as configured.
    pub lane: String,
    /// Whose numbers these are: it is made once, beside the archive.
    pub serial: String,
    /// Starts of the machine, up to the one that measured this.
    pub boots: u16,
    /// Number of the parcel: it only rises, also over restarts, and never skips.
    pub seq: u32,
    /// When it was told to the PLC: RFC 3339, UTC, by the machine's clock.
    pub utc: String,
    /// How good that clock is.
    pub clock: Clock,
    /// The dimensions may be used: measured, without a doubt, every standard deviation within its limit.
    pub may_be_used: bool,
    /// Longer side of the footprint; 0 when it was not measured.
    pub length_mm: f64,
    /// Shorter side of the footprint; 0 when it was not measured.
    pub width_mm: f64,
    /// Height over the belt; 0 when it was not measured.
    pub height_mm: f64,
    /// Standard deviation of the length.
    pub sigma_length_mm: f64,
    /// Standard deviation of the width.
    pub sigma_width_mm: f64,
    /// Standard deviation of the height.
    pub sigma_height_mm: f64,
    /// Length axis against the travel, in (-90, 90].
    pub yaw_deg: f64,
    /// Footprint centre along the travel.
    pub x_mm: f64,
    /// Footprint centre across the belt, left positive.
    pub y_mm: f64,
    /// `box` or `irregular`.
    pub shape: String,
    /// Doubts, by name; none: no doubt.
    pub flags: Vec<String>,
    /// Why it has no dimensions, by name.
    pub not_measured: Option<String>,
    /// Mean belt speed over the pass.
    pub belt_speed_mm_per_s: f64,
    /// Belt travel since start at `frame`.
    pub belt_travel_mm: f64,
    /// The belt's motion was told by the encoder.
    pub by_encoder: bool,
    /// Frame, since start, at which the position holds.
    pub frame: u64,
    /// Its time from the first frame.
    pub t_s: f64,
    /// Version of the program that measured it.
    pub version: String,
    /// It is told again because somebody asked; left out: not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replay: bool,
}

/// A parcel as the archive has it; what else it keeps is not told.
#[derive(Deserialize)]
struct ArchivedParcel {
    seq: u32,
    boots: u16,
    may_be_used: bool,
    length_mm: f64,
    width_mm: f64,
    height_mm: f64,
    sigma_length_mm: f64,
    sigma_width_mm: f64,
    sigma_height_mm: f64,
    yaw_deg: f64,
    x_mm: f64,
    y_mm: f64,
    shape: String,
    flags: Vec<String>,
    not_measured: Option<String>,
    belt_speed_mm_per_s: f64,
    belt_travel_mm: f64,
    by_encoder: bool,
    frame: u64,
    t_s: f64,
    version: String,
}

/// An event as the archive has it.
#[derive(Deserialize)]
struct ArchivedEvent {
    boots: u16,
    kind: String,
    code: u32,
    #[serde(default)]
    detail: String,
}

/// Entries that the disk did not take, or that are damaged, as the archive tells of them.
#[derive(Deserialize)]
struct ArchivedGap {
    lost: u64,
    damaged: Option<String>,
}

#[derive(Serialize)]
struct Event<'a> {
    schema: u8,
    id: String,
    site: &'a str,
    lane: &'a str,
    serial: &'a str,
    boots: u16,
    utc: String,
    clock: Clock,
    kind: &'a str,
    code: u32,
    detail: &'a str,
}

#[derive(Serialize)]
struct State<'a> {
    schema: u8,
    state: &'static str,
    site: &'a str,
    lane: &'a str,
    serial: &'a str,
    boots: u16,
    version: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    since: Option<String>,
}

/// The machine's condition, in figures; counts are since start.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[allow(clippy::struct_excessive_bools)] // each is a lamp or a sign
pub struct Figures {
    /// When this was so, ms since 1970.
    #[serde(skip)]
    pub utc_ms: u64,
    /// Since start.
    pub uptime_s: f64,
    /// The lamps.
    pub running: bool,
    /// Results are uncertain.
    pub uncertain: bool,
    /// Somebody should look after it.
    pub maintenance: bool,
    /// It does not measure.
    pub failure: bool,
    /// Codes of all that is wrong or worth knowing, what matters most first.
    pub reasons: Vec<u16>,
    /// Parcels are not reported, by command.
    pub stopped: bool,
    /// The camera is there.
    pub camera_present: bool,
    /// Times that it was lost.
    pub camera_losses: u64,
    /// Frames processed.
    pub frames: u64,
    /// Frames that came too late.
    pub frames_dropped: u64,
    /// Frames that never came.
    pub frames_lost: u64,
    /// Frames with parts missing.
    pub frames_torn: u64,
    /// The slowest frame.
    pub frame_time_max_ms: f64,
    /// Belt speed.
    pub belt_speed_mm_per_s: f64,
    /// It is measured, not assumed.
    pub belt_measured: bool,
    /// Parcels reported, measured or not.
    pub parcels: u64,
    /// Of these, parcels without dimensions.
    pub parcels_unmeasured: u64,
    /// Of these, parcels whose dimensions may be used.
    pub parcels_usable: u64,
    /// Parcels that vanished in view.
    pub parcels_lost: u64,
    /// Parcels never acknowledged by the PLC.
    pub queue_overflows: u64,
    /// Entries that the archive did not take: the fleet is never told of them.
    pub archive_entries_lost: u64,
    /// The archive is written.
    pub archive_writable: bool,
}

#[derive(Serialize)]
struct Health<'a> {
    schema: u8,
    site: &'a str,
    lane: &'a str,
    serial: &'a str,
    boots: u16,
    version: &'static str,
    utc: String,
    clock: Clock,
    #[serde(flatten)]
    figures: &'a Figures,
    fleet_connects: u64,
    fleet_acknowledged: u64,
}

/// What is known of the clock.
const CLOCK: Clock = Clock::Unknown;

fn json(what: &impl Serialize) -> String {
    // Strings, numbers and lists always print.
    serde_json::to_string(what).unwrap_or_default()
}

impl Identity {
    /// The one with this serial number, in this start of it.
    pub fn new(site: &str, lane: &str, serial: String, boots: u16) -> Self {
        let (site, lane) = (site.to_owned(), lane.to_owned());
        Self { site, lane, serial, boots, told: Arc::default() }
    }

    /// A message for an entry of the archive: topic, payload, and the parcel's number if it is one's.
    ///
    /// # Errors
    /// What is wrong with the entry.
    pub fn message(
        &self,
        topics: &Topics,
        entry: &Entry,
        replay: bool,
    ) -> Result<(String, String, Option<u32>), String> {
        let broken = |e: serde_json::Error| format!("entry {} of the archive: {e}", entry.number);
        match entry.kind {
            Kind::Parcel => {
                let parcel = serde_json::from_str(&entry.text).map_err(broken)?;
                let parcel = self.parcel(parcel, entry.utc_ms, replay);
                Ok((topics.parcel(), json(&parcel), Some(parcel.seq)))
            }
            Kind::Event => {
                let event: ArchivedEvent = serde_json::from_str(&entry.text).map_err(broken)?;
                let id = format!("{}/{}/entry-{}", self.serial, event.boots, entry.number);
                let what = (event.kind.as_str(), event.code, event.detail.as_str());
                let event = self.event(id, event.boots, entry.utc_ms, what);
                Ok((topics.event(), json(&event), None))
            }
            Kind::Gap => {
                let gap: ArchivedGap = serde_json::from_str(&entry.text).map_err(broken)?;
                let detail = format!("{} entries were not archived", gap.lost);
                let detail = match gap.damaged {
                    None => detail,
                    Some(segment) => format!("{detail}; {segment} is damaged"),
                };
                let id = format!("{}/{}/entry-{}", self.serial, self.boots, entry.number);
                let what = ("archive_gap", u32::try_from(gap.lost).unwrap_or(u32::MAX), &*detail);
                Ok((topics.event(), json(&self.event(id, self.boots, entry.utc_ms, what)), None))
            }
        }
    }

    /// What the fleet finds about an entry of the archive.
    pub fn entry_event(&self, entry: &Entry, what: (&str, u32, &str)) -> String {
        let id = format!("{}/{}/{}-{}", self.serial, self.boots, what.0, entry.number);
        json(&self.event(id, self.boots, entry.utc_ms, what))
    }

    /// Something of the fleet's own that happens now.
    pub fn own_event(&self, what: (&str, u32, &str)) -> String {
        let number = self.told.fetch_add(1, Ordering::Relaxed) + 1;
        let id = format!("{}/{}/fleet-{number}", self.serial, self.boots);
        json(&self.event(id, self.boots, utc_ms(), what))
    }

    fn event<'a>(
        &'a self,
        id: String,
        boots: u16,
        utc_ms: u64,
        (kind, code, detail): (&'a str, u32, &'a str),
    ) -> Event<'a> {
        Event {
            schema: SCHEMA,
            id,
            site: &self.site,
            lane: &self.lane,
            serial: &self.serial,
            boots,
            utc: utc(utc_ms),
            clock: CLOCK,
            kind,
            code,
            detail,
        }
    }

    fn parcel(&self, parcel: ArchivedParcel, utc_ms: u64, replay: bool) -> Parcel {
        let p = parcel;
        Parcel {
            schema: SCHEMA,
            id: format!("{}/{}/{}", self.serial, p.boots, p.seq),
            site: self.site.clone(),
            lane: self.lane.clone(),
            serial: self.serial.clone(),
            boots: p.boots,
            seq: p.seq,
            utc: utc(utc_ms),
            clock: CLOCK,
            may_be_used: p.may_be_used,
            length_mm: p.length_mm,
            width_mm: p.width_mm,
            height_mm: p.height_mm,
            sigma_length_mm: p.sigma_length_mm,
            sigma_width_mm: p.sigma_width_mm,
            sigma_height_mm: p.sigma_height_mm,
            yaw_deg: p.yaw_deg,
            x_mm: p.x_mm,
            y_mm: p.y_mm,
            shape: p.shape,
            flags: p.flags,
            not_measured: p.not_measured,
            belt_speed_mm_per_s: p.belt_speed_mm_per_s,
            belt_travel_mm: p.belt_travel_mm,
            by_encoder: p.by_encoder,
            frame: p.frame,
            t_s: p.t_s,
            version: p.version,
            replay,
        }
    }

    /// Whether the machine is there. `since`: none where it is not known when, as in a will.
    pub fn state(&self, state: &'static str, since: Option<u64>) -> String {
        json(&State {
            schema: SCHEMA,
            state,
            site: &self.site,
            lane: &self.lane,
            serial: &self.serial,
            boots: self.boots,
            version: env!("CARGO_PKG_VERSION"),
            since: since.map(utc),
        })
    }

    /// The machine's condition. `connects`, `acknowledged`: the fleet's own, since start.
    pub fn health(&self, figures: &Figures, connects: u64, acknowledged: u64) -> String {
        json(&Health {
            schema: SCHEMA,
            site: &self.site,
            lane: &self.lane,
            serial: &self.serial,
            boots: self.boots,
            version: env!("CARGO_PKG_VERSION"),
            utc: utc(figures.utc_ms),
            clock: CLOCK,
            figures,
            fleet_connects: connects,
            fleet_acknowledged: acknowledged,
        })
    }
}

/// The JSON Schema of a parcel, as the file `config/fleet/parcel.schema.json`.
pub fn parcel_schema() -> String {
    let settings = SchemaSettings::draft07().with(|settings| settings.inline_subschemas = true);
    let schema = settings.into_generator().into_root_schema_for::<Parcel>();
    // A map of strings and numbers always prints.
    serde_json::to_string_pretty(&schema).unwrap_or_default() + "\n"
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::event::{Flags, NotMeasured, ParcelRecord, Shape};
    use serde_json::{Value, json};

    pub fn identity() -> Identity {
        Identity::new("hall-1", "lane-3", "0123456789abcdef".to_owned(), 9)
    }

    fn record(seq: u32) -> ParcelRecord {
        let mut flags = Flags::default();
        flags.set(Flags::MERGED, true);
        flags.set(Flags::CLIPPED, true);
        ParcelRecord {
            seq,
            frame: 137,
            t_s: 3.425,
            length_mm: 235.1,
            width_mm: 124.8,
            height_mm: 70.2,
            yaw_deg: 12.4,
            x_mm: 61.0,
            y_mm: -40.3,
            sigma_length_mm: 0.3,
            sigma_width_mm: 0.31,
            sigma_height_mm: 0.5,
            belt_speed_mm_per_s: 500.3,
            shape: Shape::Irregular,
            flags,
            not_measured: Some(NotMeasured::TooBrief),
            may_be_used: false,
            belt_travel_mm: 1712.5,
            by_encoder: true,
        }
    }

    /// As the desk archives it.
    pub fn archived(seq: u32, boots: u16) -> String {
        let mut what = serde_json::to_value(record(seq)).expect("JSON");
        what["n"] = json!(4);
        what["utc_ms"] = json!(1_795_000_000_123_u64);
        what["picture"] = Value::Null;
        what["no_picture"] = json!("too_many");
        what["boots"] = json!(boots);
        what["version"] = json!("0.1.0");
        what.to_string()
    }

    pub fn entry(number: u64, kind: Kind, text: String) -> Entry {
        Entry { number, utc_ms: 1_795_000_000_123, kind, text }
    }

    fn told(entry: &Entry, replay: bool) -> (String, Value) {
        let topics = Topics::new("hall-1", "lane-3");
        let (topic, payload, _) = identity().message(&topics, entry, replay).expect("whole");
        (topic, serde_json::from_str(&payload).expect("JSON"))
    }

    #[test]
    fn a_parcel_is_told_as_it_was_archived_and_its_id_is_that_of_its_own_start() {
        let (topic, told) = told(&entry(77, Kind::Parcel, archived(41, 7)), false);
        assert_eq!(topic, "beltgauge/hall-1/lane-3/parcel");
        assert_eq!(told["id"], "0123456789abcdef/7/41");
        assert_eq!(told["utc"], "2026-11-18T11:06:40.123Z");
        assert_eq!(told["flags"], json!(["merged", "clipped"]));
        assert!(told.get("replay").is_none());
        // Every value of the record is in it, under its name.
        let record = serde_json::to_value(record(41)).expect("JSON");
        for (name, value) in record.as_object().expect("fields") {
            assert_eq!(&told[name], value, "{name}");
        }
    }

    #[test]
    fn the_schema_knows_every_field_and_what_may_be_left_out() {
        let schema: Value = serde_json::from_str(&parcel_schema()).expect("JSON");
        let (_, told) = told(&entry(77, Kind::Parcel, archived(41, 7)), true);
        assert_eq!(told["replay"], json!(true));
        let told = told.as_object().expect("fields");
        let known = schema["properties"].as_object().expect("properties");
        assert!(told.keys().eq(known.keys()), "{told:?}");
        let required = schema["required"].as_array().expect("a list");
        let optional = told.keys().filter(|name| !required.contains(&json!(name)));
        assert_eq!(optional.collect::<Vec<_>>(), ["not_measured", "replay"]);
    }

    #[test]
    fn events_and_gaps_are_events_with_an_id_of_their_entry() {
        let text = r#"{"n":3,"utc_ms":1,"kind":"began","code":12,"detail":"\"<b>\"","boots":7,"version":"1"}"#;
        let (topic, event) = told(&entry(78, Kind::Event, text.to_owned()), false);
        assert_eq!(topic, "beltgauge/hall-1/lane-3/event");
        assert_eq!(
            (&event["id"], &event["code"]),
            (&json!("0123456789abcdef/7/entry-78"), &json!(12))
        );
        assert_eq!((&event["kind"], &event["detail"]), (&json!("began"), &json!("\"<b>\"")));
        let text = r#"{"lost":5,"damaged":"00000000000000000001.bga"}"#;
        let (_, gap) = told(&entry(79, Kind::Gap, text.to_owned()), false);
        assert_eq!((&gap["kind"], &gap["code"]), (&json!("archive_gap"), &json!(5)));
        assert!(
            gap["detail"].as_str().is_some_and(|d| d.contains("00001.bga is damaged")),
            "{gap}"
        );
    }

    #[test]
    fn what_is_no_parcel_is_an_error_that_names_its_entry() {
        let topics = Topics::new("hall-1", "lane-3");
        for text in ["", "null", "{\"seq\":1}", &archived(41, 7).replace("41", "-1")] {
            let broken = entry(80, Kind::Parcel, text.to_owned());
            let error = identity().message(&topics, &broken, false).expect_err("broken");
            assert!(error.contains("entry 80"), "{error}");
        }
    }

    #[test]
    fn state_and_health_say_whose_they_are() {
        let value = |text: String| serde_json::from_str::<Value>(&text).expect("JSON");
        let will = value(identity().state("offline", None));
        assert_eq!((&will["state"], will.get("since")), (&json!("offline"), None));
        let birth = value(identity().state("online", Some(0)));
        assert_eq!(
            (&birth["boots"], &birth["since"]),
            (&json!(9), &json!("1970-01-01T00:00:00.000Z"))
        );
        let figures = Figures { reasons: vec![12, 2], parcels: 5, ..Figures::default() };
        let health = value(identity().health(&figures, 3, 17));
        assert_eq!((&health["lane"], &health["parcels"]), (&json!("lane-3"), &json!(5)));
        assert_eq!((&health["reasons"], &health["schema"]), (&json!([12, 2]), &json!(1)));
        assert!(health.get("utc_ms").is_none() && health["fleet_acknowledged"] == json!(17));
    }
}
