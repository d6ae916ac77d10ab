//! What the page asks of the machine, from what its threads have told last.

use super::lamps::lamps;
use crate::archive::{Condition, Reader, Stored};
use crate::config::{Config, WordOrder};
use crate::plc::clients::{Client, ClientList};
use crate::plc::command::Sender;
use crate::plc::link::{Commanded, Link};
use crate::plc::registers::{
    COMMAND, COMMAND_FIELDS, COUNT, LATEST, MAP_VERSION, PARCEL_FIELDS, STATUS_FIELDS, Status,
};
use crate::plc::table::{Field, Type, join};
use crate::run::log;
use crate::web;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// The PLC thread tells this often.
const PERIOD: Duration = Duration::from_millis(100);

/// What the PLC thread has told last.
#[derive(Clone, Copy)]
pub struct PlcSide {
    /// What the status block shows.
    pub status: Status,
    registers: [u16; COUNT as usize],
    written: Option<(Sender, Instant)>,
    /// The last command.
    pub commanded: Option<Commanded>,
}

/// What is known, for whoever asks.
pub struct Insight {
    config: Config,
    image_size_px: [usize; 2],
    started: Instant,
    plc: Mutex<PlcSide>,
    clients: ClientList,
    frame_time_max: Mutex<Duration>,
    archive: Mutex<Condition>,
    archive_fails: AtomicBool,
    /// Parcels whose dimensions may be used.
    pub usable: AtomicU64,
    /// Parcels without a picture.
    pub pictures_missed: AtomicU64,
    /// Parcels that the desk was not told of.
    pub parcels_missed: AtomicU64,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The machine's clock, ms since 1970.
pub fn utc_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

impl Insight {
    /// Nothing is known yet.
    pub fn new(config: Config, image_size_px: [usize; 2], clients: ClientList) -> Self {
        let status = Status::default();
        Self {
            config,
            image_size_px,
            started: Instant::now(),
            plc: Mutex::new(PlcSide {
                status,
                registers: [0; COUNT as usize],
                written: None,
                commanded: None,
            }),
            clients,
            frame_time_max: Mutex::default(),
            archive: Mutex::default(),
            archive_fails: AtomicBool::new(false),
            usable: AtomicU64::new(0),
            pictures_missed: AtomicU64::new(0),
            parcels_missed: AtomicU64::new(0),
        }
    }

    /// The PLC thread tells what it knows; it never waits for a reader.
    pub fn plc_tells(&self, link: &Link) {
        if let Ok(mut plc) = self.plc.try_lock() {
            plc.status = *link.status();
            (plc.written, plc.commanded) = (link.written(), link.commanded());
            if let Some(registers) = link.read(0, COUNT) {
                plc.registers.copy_from_slice(registers);
            }
        }
    }

    /// What the PLC thread has told last.
    pub fn plc_side(&self) -> PlcSide {
        *lock(&self.plc)
    }

    /// The desk tells what it knows.
    pub fn desk_tells(&self, frame_time_max: Duration, archive: Option<Condition>) {
        *lock(&self.frame_time_max) = frame_time_max;
        if let Some(condition) = archive {
            self.archive_fails.store(condition.is_bad(), Ordering::Relaxed);
            *lock(&self.archive) = condition;
        }
    }

    /// Whether somebody should look after the archive; never waits.
    pub fn archive_fails(&self) -> bool {
        self.archive_fails.load(Ordering::Relaxed)
    }

    fn archive_folder(&self) -> Result<&PathBuf, String> {
        let none = "there is no archive: archive.folder is not set";
        self.config.archive.folder.as_ref().ok_or_else(|| none.to_owned())
    }

    fn archive_state(&self) -> web::ArchiveState {
        let condition = lock(&self.archive).clone();
        web::ArchiveState {
            enabled: self.config.archive.folder.is_some(),
            entries_written: condition.written,
            entries_lost: condition.lost,
            bytes: condition.bytes,
            bytes_max: condition.bytes_max,
            fault: condition.fault,
            damaged: condition.damaged,
        }
    }
}

/// Whether the PLC thread is to tell again.
pub fn is_due(told: &mut Option<Instant>, now: Instant) -> bool {
    let due = told.is_none_or(|at| now - at >= PERIOD);
    if due {
        *told = Some(now);
    }
    due
}

impl web::Machine for Insight {
    fn state(&self) -> web::State {
        let status = self.plc_side().status;
        let (vision, counters) = (&status.vision, &status.vision.counters);
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        web::State {
            version: env!("CARGO_PKG_VERSION"),
            utc_ms: utc_ms(),
            uptime_s: self.started.elapsed().as_secs_f64(),
            boots: status.boots,
            lamps: lamps(&status),
            reasons: status.reasons().collect(),
            ready: vision.ready,
            stopped: status.stopped,
            camera: web::CameraState {
                present: !vision.camera_absent && !vision.source_ended,
                losses: vision.camera_losses,
                size_px: self.image_size_px,
                frames: counters.frames,
                frames_dropped: vision.frames_dropped,
                frames_lost: vision.frames_lost,
                frames_torn: vision.frames_torn,
                frame_time_max_ms: lock(&self.frame_time_max).as_secs_f64() * 1e3,
            },
            belt: web::BeltState {
                speed_mm_per_s: vision.belt_speed_mm_per_s,
                nominal_mm_per_s: self.config.belt.speed_mm_per_s,
                measured: vision.belt_measured,
                by_encoder: vision.by_encoder,
                travel_mm: vision.belt_travel_mm,
                seen_mm_per_s: vision.belt.seen_mm_per_s,
                encoder_ratio: vision.belt.encoder_ratio,
            },
            counts: web::Counts {
                parcels: counters.parcels,
                parcels_unmeasured: counters.unmeasured,
                parcels_usable: count(&self.usable),
                parcels_lost: counters.lost,
                queue_overflows: status.queue_overflows,
                table_overflows: [
                    counters.segment_overflows,
                    counters.track_overflows,
                    counters.event_overflows,
                ],
                pictures_missed: count(&self.pictures_missed),
                parcels_missed: count(&self.parcels_missed),
                log_lines_dropped: log::lines_dropped(),
            },
            archive: self.archive_state(),
        }
    }

    fn plc(&self) -> web::Plc {
        let plc = self.plc_side();
        let (config, order) = (&self.config, self.config.modbus.word_order);
        let client = |client: Client| web::Client {
            address: client.address.to_string(),
            requests: client.requests,
            silent_s: client.silent_s,
            may_write: client.may_write,
        };
        web::Plc {
            map_version: format!("{}.{}", MAP_VERSION >> 8, MAP_VERSION & 0xff),
            base_address: config.modbus.base_address,
            status: values(STATUS_FIELDS, 0, &plc.registers, order),
            command: values(COMMAND_FIELDS, COMMAND, &plc.registers, order),
            latest: values(PARCEL_FIELDS, LATEST, &plc.registers, order),
            written: plc.written.map(|(sender, at)| web::Written {
                sender: sender.to_string(),
                seconds_ago: at.elapsed().as_secs_f64(),
            }),
            clients: self.clients.connected().into_iter().map(client).collect(),
            can_interface: config.can.interface.clone(),
        }
    }

    fn archived(&self, before: Option<u64>, limit: usize) -> Result<web::Archived, String> {
        let reader = Reader::open(self.archive_folder()?).map_err(|e| e.to_string())?;
        let stored = reader.before(before, limit).map_err(|e| e.to_string())?;
        let last = stored.last().map(|stored| stored.number);
        let entry = |stored: Stored| {
            let what: serde_json::Value =
                serde_json::from_str(&stored.entry.text).unwrap_or_default();
            serde_json::json!({
                "entry": stored.number,
                "utc_ms": stored.entry.utc_ms,
                "kind": stored.entry.kind.name(),
                "what": what,
            })
        };
        Ok(web::Archived {
            before: last.filter(|_| stored.len() == limit),
            entries: stored.into_iter().map(entry).collect(),
        })
    }

    fn archived_picture(&self, entry: u64) -> Option<Vec<u8>> {
        let reader = Reader::open(self.archive_folder().ok()?).ok()?;
        let picture = reader.entry(entry).ok()??.entry.picture;
        (!picture.is_empty()).then_some(picture)
    }
}

/// The values of a block, read back from the registers: what the PLC sees, and nothing else.
fn values<S>(
    fields: &[Field<S>],
    start: u16,
    registers: &[u16],
    order: WordOrder,
) -> Vec<web::Field> {
    let value = |field: &Field<S>| {
        let address = start + field.offset;
        let at = usize::from(address);
        let own = &registers[at..at + usize::from(field.kind.registers())];
        let stored = match (field.kind, own) {
            (Type::U16, [word]) => f64::from(*word),
            (Type::I16, [word]) => f64::from(*word as i16),
            (Type::U32, [first, second]) => f64::from(join([*first, *second], order)),
            (Type::I32, [first, second]) => f64::from(join([*first, *second], order) as i32),
            _ => f64::NAN,
        };
        web::Field {
            address,
            name: field.name,
            value: stored / field.scale,
            registers: own.to_vec(),
            unit: field.unit,
            digits: field.scale.log10().round() as u8,
            meaning: field.meaning,
        }
    };
    fields.iter().map(value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::registers::RegisterImage;

    #[test]
    fn the_page_shows_what_the_registers_hold_in_both_word_orders() {
        for order in [WordOrder::HighFirst, WordOrder::LowFirst] {
            let image = RegisterImage::new(order);
            let registers = image.read(0, COUNT).expect("all of them");
            let values = values(STATUS_FIELDS, 0, registers, order);
            assert_eq!(values.len(), STATUS_FIELDS.len());
            let of = |name: &str| values.iter().find(|f| f.name == name).expect("in the map");
            assert!((of("test_u32").value - f64::from(0x1234_5678)).abs() < 0.5);
            assert!((of("test_i16").value + 12345.0).abs() < 0.5);
        }
    }
}
