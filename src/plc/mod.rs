//! What the PLC gets and how: the tables, the link's state, Modbus TCP and CAN.

pub mod bus;
pub mod can;
pub mod clients;
pub mod codes;
pub mod command;
pub mod dbc;
pub mod document;
pub mod frames;
mod guard;
pub mod health;
pub mod iec;
pub mod interface;
pub mod journal;
pub mod kits;
pub mod link;
mod log_limit;
pub mod modbus;
mod present;
pub mod registers;
pub mod structured_text;
pub mod table;

/// A record for tests.
#[cfg(test)]
pub(crate) fn record(seq: u32) -> crate::event::ParcelRecord {
    crate::event::ParcelRecord {
        seq,
        frame: 137,
        t_s: 3.425,
        length_mm: 235.14,
        width_mm: 124.8,
        height_mm: 70.2,
        yaw_deg: -12.4,
        x_mm: 61.0,
        y_mm: -40.3,
        sigma_length_mm: 0.3,
        sigma_width_mm: 0.25,
        sigma_height_mm: 7.5,
        belt_speed_mm_per_s: 500.3,
        shape: crate::event::Shape::Box,
        flags: crate::event::Flags::default(),
        not_measured: None,
        may_be_used: true,
        belt_travel_mm: 1712.5,
        by_encoder: false,
    }
}
