//! The PLC thread: records out over Modbus and CAN, counts and requests in, the desk told of both.

use super::{FAREWELL, Known, Progress, Shared};
use crate::config::Config;
use crate::error::Result;
use crate::event::ParcelRecord;
use crate::plc::can::CanLink;
use crate::plc::clients::ClientList;
use crate::plc::command::Request;
use crate::plc::journal::Journal;
use crate::plc::link::{Commanded, Link};
use crate::plc::modbus;
use crate::run::desk::{Insight, is_due};
use heapless::spsc::{Consumer, Producer};
use socketcan::CanFdSocket;
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// The PLC thread.
pub(super) struct PlcThread<'a> {
    pub(super) config: &'a Config,
    pub(super) listener: TcpListener,
    pub(super) clients: ClientList,
    pub(super) journal: Journal,
    /// From vision, each with the belt's travel.
    pub(super) records: Consumer<'a, (ParcelRecord, f64)>,
    /// To vision.
    pub(super) counts: Producer<'a, (u32, Instant)>,
    /// To vision.
    pub(super) requests: Producer<'a, Request>,
    /// To the desk: what was published.
    pub(super) published: Producer<'a, ParcelRecord>,
    /// To the desk: what was commanded.
    pub(super) commanded: Producer<'a, Commanded>,
    pub(super) insight: Arc<Insight>,
    pub(super) shared: &'a Shared,
}

impl PlcThread<'_> {
    pub(super) fn run(mut self) -> Result<()> {
        let (config, shared, start) = (self.config, self.shared, Instant::now());
        let encoder_timeout = config.encoder.mm_per_count.map(|_| config.encoder.timeout_s);
        let encoder_timeout = encoder_timeout.map(Duration::from_secs_f64);
        let mut can = CanLink::<CanFdSocket>::new(config.can.clone(), start);
        let sends = config.can.interface.is_some();
        let order = config.modbus.word_order;
        let link = Link::new(config.plc.clone(), order, sends, self.journal, start)
            .with_encoder(config.encoder.mm_per_count);
        let (mut ended_at, mut told, mut known) = (None, None, Known::default());
        let (clients, mut untold) = (self.clients.clone(), 0);
        modbus::serve(self.listener, &config.modbus, self.clients, link, |link| {
            shared.beats.plc.beat();
            // Asked before the ring is emptied: what came before the end is published.
            let ended = shared.vision_ended.load(Ordering::Acquire);
            while let Some((record, travel_mm)) = self.records.dequeue() {
                link.record(record, travel_mm);
            }
            let now = Instant::now();
            if ended {
                link.flush();
                ended_at.get_or_insert(now);
            }
            shared.renew(&mut known);
            let Progress { status: mut vision, frame_time_max } = shared.together(known);
            vision.archive_fails = self.insight.archive_fails();
            link.update(&vision, &can.status(), encoder_timeout, now);
            can.step(link, now);
            // Before the first parcel is told: whoever keeps it knows which start of the machine this is.
            if is_due(told, now) && self.insight.plc_tells(link, frame_time_max, &clients) {
                told = Some(now);
            }
            while let Some(record) = link.next_published() {
                let missed = self.published.enqueue(record).is_err();
                self.insight.parcels_missed.fetch_add(u64::from(missed), Ordering::Relaxed);
                shared.wake_desk();
            }
            let missed = &self.insight.commands_missed;
            while let Some(given) = link.next_commanded() {
                missed.fetch_add(
                    u64::from(self.commanded.enqueue(given).is_err()),
                    Ordering::Relaxed,
                );
            }
            missed.fetch_add(link.commands_untold() - untold, Ordering::Relaxed);
            untold = link.commands_untold();
            // A ring that is full has enough of them: vision has not looked for long.
            while let Some(count) = link.next_count() {
                let _ = self.counts.enqueue(count);
            }
            while self.requests.ready()
                && let Some(request) = link.next_request()
            {
                let _ = self.requests.enqueue(request);
            }
            let all_told = link.is_idle() && can.is_idle();
            ended_at.is_none_or(|at| !all_told && now - at < FAREWELL)
        })
    }
}
