//! How records reach the PLC: the register map and the Modbus TCP server.

mod guard;
pub mod modbus;
pub mod registers;
