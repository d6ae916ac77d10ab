//! The appliance's link, Modbus server and CAN without camera and vision, fed with parcels by a test.

use beltgauge::config::{Can, Modbus, Plc as Settings};
use beltgauge::event::{Flags, ParcelRecord, Shape};
use beltgauge::plc::can::CanLink;
use beltgauge::plc::clients::ClientList;
use beltgauge::plc::journal::Journal;
use beltgauge::plc::link::Link;
use beltgauge::plc::modbus;
use beltgauge::plc::registers::VisionStatus;
use socketcan::CanFdSocket;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Instant;

/// A running server; dropped, it ends at once, as a killed appliance does.
pub struct Server {
    /// Where it listens.
    pub address: SocketAddr,
    parcels: mpsc::Sender<ParcelRecord>,
    stop: Arc<AtomicBool>,
    published: Arc<AtomicU32>,
    queued: Arc<AtomicU32>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Start it, with a queue; `state` is its file over restarts.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start(listen: SocketAddr, state: Option<&Path>) -> Self {
        Self::start_with(listen, state, Can::default())
    }

    /// The same on a CAN bus too.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start_with(listen: SocketAddr, state: Option<&Path>, can: Can) -> Self {
        let everybody = std::net::Ipv4Addr::UNSPECIFIED.into();
        let settings = Modbus { listen, write_allow: vec![everybody], ..Modbus::default() };
        let listener = modbus::bind(&settings).expect("a free port");
        let address = listener.local_addr().expect("bound");
        let journal = state.map(|path| Journal::open(path).expect("writable")).unwrap_or_default();
        let (parcels, incoming) = mpsc::channel::<ParcelRecord>();
        let (published, queued) = (Arc::<AtomicU32>::default(), Arc::<AtomicU32>::default());
        let (shown, waiting) = (Arc::clone(&published), Arc::clone(&queued));
        let stop = Arc::<AtomicBool>::default();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let plc = Settings { queue: true, ..Settings::default() };
            let sends = can.interface.is_some();
            let link = Link::new(plc, settings.word_order, sends, journal, Instant::now());
            let mut can = CanLink::<CanFdSocket>::new(can, Instant::now());
            let mut vision = VisionStatus { ready: true, ..VisionStatus::default() };
            let clients = ClientList::new(settings.connections_max);
            let served = modbus::serve(listener, &settings, clients, link, |link| {
                vision.counters.frames += 1;
                while let Ok(record) = incoming.try_recv() {
                    link.record(record, 0.0);
                }
                link.update(&vision, &can.status(), None, Instant::now());
                can.step(link, Instant::now());
                while link.next_count().is_some() {}
                while link.next_request().is_some() {}
                waiting.store(u32::from(link.status().queued), Ordering::Relaxed);
                shown.store(link.status().sequence, Ordering::Release);
                !stopped.load(Ordering::Relaxed)
            });
            served.expect("serves");
        });
        Self { address, parcels, stop, published, queued, thread: Some(thread) }
    }

    /// A parcel leaves the zone; its size tells its number.
    ///
    /// # Panics
    /// When the server has ended.
    pub fn parcel(&self, number: u32) {
        self.parcels.send(record(number)).expect("the server runs");
    }

    /// Parcels that wait to be acknowledged.
    pub fn queued(&self) -> u32 {
        self.queued.load(Ordering::Relaxed)
    }

    /// Sequence number of the last parcel that registers show.
    pub fn published(&self) -> u32 {
        self.published.load(Ordering::Acquire)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let ended = thread.join();
            assert!(ended.is_ok() || std::thread::panicking(), "the server panicked");
        }
    }
}

/// A parcel whose length and width tell its number.
pub fn record(number: u32) -> ParcelRecord {
    ParcelRecord {
        seq: number,
        frame: u64::from(number),
        t_s: 0.0,
        length_mm: 100.0 + f64::from(number % 997),
        width_mm: 50.0 + f64::from(number / 997),
        height_mm: 80.0,
        yaw_deg: 0.0,
        x_mm: 0.0,
        y_mm: 0.0,
        sigma_length_mm: 0.3,
        sigma_width_mm: 0.3,
        sigma_height_mm: 0.5,
        belt_speed_mm_per_s: 500.0,
        shape: Shape::Box,
        flags: Flags::default(),
        not_measured: None,
        may_be_used: true,
        belt_travel_mm: 0.0,
        by_encoder: false,
    }
}
