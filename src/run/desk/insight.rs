//! What the page asks of the machine, from what its threads have told last.

use super::bundle::{self, Papers};
use super::lamps::lamps;
use crate::archive::{Condition, Page, Reader, Stored};
use crate::config::{Config, WordOrder};
use crate::event::clock::utc_ms;
use crate::plc::clients::{Client, ClientList};
use crate::plc::command::Sender;
use crate::plc::link::Link;
use crate::plc::registers::{
    COMMAND, COMMAND_FIELDS, COUNT, LATEST, MAP_VERSION, PARCEL_FIELDS, STATUS_FIELDS, Status,
};
use crate::plc::table::{Field, Type, join};
use crate::run::log;
use crate::web;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The PLC thread tells this often.
const PERIOD: Duration = Duration::from_millis(100);

/// What the PLC thread has told last.
#[derive(Clone, Copy)]
pub struct PlcSide {
    /// What the status block shows.
    pub status: Status,
    registers: [u16; COUNT as usize],
    written: Option<(Sender, Instant)>,
    /// The slowest frame so far.
    frame_time_max: Duration,
    /// When that was, ms since 1970; 0: not yet.
    pub(super) told_utc_ms: u64,
}

/// What is known, for whoever asks.
pub struct Insight {
    config: Config,
    papers: Papers,
    image_size_px: [usize; 2],
    started: Instant,
    plc: Mutex<PlcSide>,
    clients: Mutex<Vec<Client>>,
    archive: Mutex<Condition>,
    archive_fails: AtomicBool,
    /// Parcels whose dimensions may be used.
    pub usable: AtomicU64,
    /// Parcels without a picture, because too many came at once.
    pub pictures_missed: AtomicU64,
    /// Parcels that the desk was not told of.
    pub parcels_missed: AtomicU64,
    /// Commands that the desk was not told of.
    pub commands_missed: AtomicU64,
}

impl PlcSide {
    /// Whether the PLC thread has told anything yet.
    pub fn is_known(&self) -> bool {
        self.told_utc_ms > 0
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Insight {
    /// Nothing is known yet.
    pub fn new(
        config: Config,
        papers: Papers,
        image_size_px: [usize; 2],
        clients_max: usize,
    ) -> Self {
        let status = Status::default();
        Self {
            config,
            papers,
            image_size_px,
            started: Instant::now(),
            plc: Mutex::new(PlcSide {
                status,
                registers: [0; COUNT as usize],
                written: None,
                frame_time_max: Duration::ZERO,
                told_utc_ms: 0,
            }),
            clients: Mutex::new(Vec::with_capacity(clients_max)),
            archive: Mutex::default(),
            archive_fails: AtomicBool::new(false),
            usable: AtomicU64::new(0),
            pictures_missed: AtomicU64::new(0),
            parcels_missed: AtomicU64::new(0),
            commands_missed: AtomicU64::new(0),
        }
    }

    /// The PLC thread tells what it knows; it never waits for a reader. Whether it could.
    pub fn plc_tells(&self, link: &Link, frame_time_max: Duration, clients: &ClientList) -> bool {
        let (Ok(mut plc), Ok(mut list)) = (self.plc.try_lock(), self.clients.try_lock()) else {
            return false;
        };
        plc.status = *link.status();
        (plc.written, plc.frame_time_max) = (link.written(), frame_time_max);
        if let Some(registers) = link.read(0, COUNT) {
            plc.registers.copy_from_slice(registers);
        }
        plc.told_utc_ms = utc_ms();
        clients.copy_to(&mut list);
        true
    }

    /// What the PLC thread has told last.
    pub fn plc_side(&self) -> PlcSide {
        *lock(&self.plc)
    }

    /// The desk tells what it knows.
    pub fn desk_tells(&self, archive: Option<Condition>) {
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
pub fn is_due(told: Option<Instant>, now: Instant) -> bool {
    told.is_none_or(|at| now - at >= PERIOD)
}

impl web::Machine for Insight {
    fn state(&self) -> web::State {
        let PlcSide { status, frame_time_max, told_utc_ms, .. } = self.plc_side();
        let (vision, counters) = (&status.vision, &status.vision.counters);
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        web::State {
            version: env!("CARGO_PKG_VERSION"),
            utc_ms: told_utc_ms,
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
                frame_time_max_ms: frame_time_max.as_secs_f64() * 1e3,
                watch: vision.health.camera_watch,
                moved_px: vision.health.camera_moved_px,
                moved_error_mm: vision.health.camera_error_mm,
                blur_px: vision.health.blur_px,
                light_region: vision.health.light_region,
                light_change: vision.health.light_change,
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
                commands_missed: count(&self.commands_missed),
                log_lines_dropped: log::lines_dropped(),
            },
            archive: self.archive_state(),
        }
    }

    fn plc(&self) -> web::Plc {
        let (plc, clients) = (self.plc_side(), lock(&self.clients).clone());
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
            clients: clients.into_iter().map(client).collect(),
            can_interface: config.can.interface.clone(),
        }
    }

    fn archived(&self, before: Option<u64>, limit: usize) -> Result<web::Archived, String> {
        let reader = Reader::open(self.archive_folder()?).map_err(|e| e.to_string())?;
        let Page { entries, unread } = reader.before(before, limit).map_err(|e| e.to_string())?;
        let last = entries.last().map(|stored| stored.number);
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
            before: last.filter(|_| entries.len() == limit),
            entries: entries.into_iter().map(entry).collect(),
            unread,
        })
    }

    fn archived_picture(&self, entry: u64) -> Option<Vec<u8>> {
        let reader = Reader::open(self.archive_folder().ok()?).ok()?;
        let picture = reader.entry(entry).ok()??.entry.picture;
        (!picture.is_empty()).then_some(picture)
    }

    fn bundle(&self) -> web::BundleFiles {
        bundle::files(&self.config, &self.papers)
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
pub mod tests {
    use super::*;
    use crate::plc::journal::Journal;
    use crate::plc::registers::RegisterImage;
    use crate::web::Machine;

    /// A plain configuration.
    pub fn config() -> Config {
        let config = "[camera]\ncalibration = \"c\"\n[belt]\nspeed_mm_per_s = 500\n\
            [zone]\nx_min_mm = -600\nx_max_mm = 600\ny_min_mm = -380\ny_max_mm = 380\n";
        Config::parse(config).expect("valid")
    }

    /// Of a plain configuration.
    pub fn insight() -> Insight {
        Insight::new(config(), Papers::default(), [0; 2], 4)
    }

    #[test]
    fn the_plc_thread_waits_for_no_reader_and_the_time_is_that_of_its_last_word() {
        let insight = insight();
        let clients = ClientList::new(1);
        let settings = insight.config.plc.clone();
        let now = Instant::now();
        let link = Link::new(settings, WordOrder::HighFirst, false, Journal::default(), now);
        let tells = || insight.plc_tells(&link, Duration::from_millis(7), &clients);
        assert_eq!(insight.state().utc_ms, 0, "nothing is known");
        for reader in [&insight.clients as &dyn Locked, &insight.plc] {
            // It would wait for ever.
            reader.while_read(&mut || assert!(!tells()));
        }
        assert!(!insight.plc_side().is_known());
        assert!(tells() && insight.plc_side().is_known());
        let told = insight.state();
        assert!(told.utc_ms > 0 && (told.camera.frame_time_max_ms - 7.0).abs() < 1e-9);
        let start = Instant::now();
        while utc_ms() == told.utc_ms {
            assert!(start.elapsed() < Duration::from_secs(9), "the clock stands still");
        }
        assert_eq!(insight.state().utc_ms, told.utc_ms, "it was not told again");
    }

    #[test]
    fn an_archive_that_needs_attention_is_a_reason_and_a_fault_bit_of_the_plc() {
        let insight = insight();
        let reasons = |condition: Condition| {
            insight.desk_tells(Some(condition));
            let mut status = Status { running: true, ..Status::default() };
            status.vision.ready = true;
            status.vision.archive_fails = insight.archive_fails();
            (status.reasons().collect::<Vec<_>>(), status.fault_bits() >> 11)
        };
        let some = || Some("a word".to_owned());
        for bad in [
            Condition { lost: 1, ..Condition::default() },
            Condition { fault: some(), ..Condition::default() },
            Condition { damaged: some(), ..Condition::default() },
        ] {
            assert_eq!(reasons(bad), (vec![20], 1));
        }
        assert_eq!(reasons(Condition { written: 9, ..Condition::default() }), (vec![], 0));
    }

    /// A lock of any content.
    trait Locked {
        fn while_read(&self, what: &mut dyn FnMut());
    }

    impl<T> Locked for Mutex<T> {
        fn while_read(&self, what: &mut dyn FnMut()) {
            let _held = lock(self);
            what();
        }
    }

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
