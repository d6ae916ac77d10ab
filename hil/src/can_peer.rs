//! A PLC on the CAN bus: puts parcels together by the rule of the register map's CAN section.

use beltgauge::plc::frames::{Message, parcel_fd_places, parcel_places};
use std::collections::BTreeMap;

/// A parcel as it came: values by name, in stored units.
pub type Values = BTreeMap<&'static str, u32>;

/// What came.
#[derive(Debug, Default)]
pub struct Receiver {
    base_id: u16,
    /// Parcels in the order in which they were whole, each once.
    pub whole: Vec<Values>,
    /// Parcels that came again.
    pub repeated: u32,
    /// Parcels of which the next began before they were whole.
    pub broken: u32,
    /// Heartbeats.
    pub heartbeats: u32,
    parts: Values,
    head: u8,
    next: u8,
}

impl Receiver {
    /// Nothing yet.
    pub fn new(base_id: u16) -> Self {
        Self { base_id, ..Self::default() }
    }

    /// A frame has come.
    pub fn frame(&mut self, id: u16, data: &[u8]) {
        let message = id.wrapping_sub(self.base_id);
        if message == Message::Heartbeat as u16 {
            self.heartbeats += 1;
        } else if message == Message::Parcel as u16 && data.len() > 2 {
            self.segment(data);
        } else if message == Message::ParcelFd as u16 {
            let values = parcel_fd_places()
                .map(|place| (place.field.name, value(place.field.kind, place.byte, data)));
            let values = values.collect();
            self.finish(values);
        }
    }

    fn segment(&mut self, data: &[u8]) {
        let (head, segment) = (data[0], data[1]);
        if segment == 0 {
            self.broken += u32::from(self.next > 0);
            self.parts.clear();
            (self.head, self.next) = (head, 0);
        }
        if (head, segment) != (self.head, self.next) {
            self.broken += u32::from(self.next > 0);
            self.next = 0;
            return;
        }
        self.next += 1;
        for place in parcel_places().filter(|place| place.segment == segment) {
            self.parts.insert(place.field.name, value(place.field.kind, place.byte, data));
        }
        if parcel_places().all(|place| place.segment < self.next) {
            self.next = 0;
            let values = std::mem::take(&mut self.parts);
            self.finish(values);
        }
    }

    fn finish(&mut self, values: Values) {
        let known =
            self.whole.iter().rev().take(64).any(|old| old["sequence"] == values["sequence"]);
        if known {
            self.repeated += 1;
        } else {
            self.whole.push(values);
        }
    }
}

fn value(kind: beltgauge::plc::frames::Type, byte: usize, data: &[u8]) -> u32 {
    let bytes = &data[byte..byte + 2 * usize::from(kind.registers())];
    bytes.iter().fold(0, |value, byte| value << 8 | u32::from(*byte))
}
