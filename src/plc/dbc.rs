//! The CAN messages as a DBC file, from the same tables as the frames.

use super::command::COMMANDS;
use super::frames::{self, Message, Place};
use super::registers::REASONS;
use super::table::{Field, Type};
use std::fmt::Write;

/// A signal's name and, where its frame has segments, the segment.
struct Signal<'a> {
    name: &'a str,
    segment: Option<u8>,
    byte: usize,
    kind: Type,
    scale: f64,
    unit: &'a str,
    to: &'a str,
}

impl Signal<'_> {
    /// DBC counts a big-endian signal from its highest bit.
    fn write(&self, text: &mut String) {
        let Self { name, segment, byte, kind, scale, unit, to } = self;
        let multiplex = segment.map_or_else(String::new, |segment| format!(" m{segment}"));
        let sign = if kind.is_signed() { '-' } else { '+' };
        let [low, high] = kind.range().map(|end| end / scale);
        let _ = writeln!(
            text,
            " SG_ {name}{multiplex} : {}|{}@0{sign} ({},0) [{low}|{high}] \"{unit}\" {to}",
            byte * 8 + 7,
            16 * kind.registers(),
            1.0 / scale
        );
    }
}

fn places<S: 'static>(
    text: &mut String,
    places: impl Iterator<Item = Place<'static, S>>,
    segmented: bool,
) {
    for Place { field, segment, byte } in places {
        let &Field { name, kind, scale, unit, .. } = field;
        let segment = segmented.then_some(segment);
        Signal { name, segment, byte, kind, scale, unit, to: "PLC" }.write(text);
    }
}

fn message(text: &mut String, base_id: u16, message: Message, bytes: usize, from: &str) {
    let _ = writeln!(text, "\nBO_ {} {message:?}: {bytes} {from}", base_id + message as u16);
}

/// The two bytes that head a segment.
fn head(text: &mut String, name: &str) {
    let _ = writeln!(text, " SG_ {name} : 7|8@0+ (1,0) [0|255] \"\" PLC");
    let _ = writeln!(text, " SG_ segment M : 15|8@0+ (1,0) [0|255] \"\" PLC");
}

/// The DBC file of a `can.base_id`.
pub fn document(base_id: u16) -> String {
    let mut text = String::from("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: Beltgauge PLC\n");
    message(&mut text, base_id, Message::Heartbeat, 8, "Beltgauge");
    places(&mut text, frames::heartbeat_places(), false);
    message(&mut text, base_id, Message::Status, 8, "Beltgauge");
    head(&mut text, "counter");
    places(&mut text, frames::status_places(), true);
    message(&mut text, base_id, Message::Parcel, 8, "Beltgauge");
    head(&mut text, "sequence_low");
    places(&mut text, frames::parcel_places(), true);
    message(&mut text, base_id, Message::ParcelFd, 64, "Beltgauge");
    places(&mut text, frames::parcel_fd_places(), false);
    message(&mut text, base_id, Message::Result, 4, "Beltgauge");
    places(&mut text, frames::result_places(), false);
    for (of, bytes, signals) in [
        (
            Message::Command,
            8,
            &[("ticket", 0, Type::U16), ("command", 2, Type::U16), ("argument", 4, Type::U32)][..],
        ),
        (Message::Encoder, 4, &[("encoder_count", 0, Type::U32)]),
        (Message::PlcHeartbeat, 2, &[("plc_heartbeat", 0, Type::U16)]),
    ] {
        message(&mut text, base_id, of, bytes, "PLC");
        for (name, byte, kind) in signals {
            let (byte, kind) = (*byte, *kind);
            Signal { name, segment: None, byte, kind, scale: 1.0, unit: "", to: "Beltgauge" }
                .write(&mut text);
        }
    }
    text.push('\n');
    let fd = base_id + Message::ParcelFd as u16;
    let _ = write!(
        text,
        "BA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\",\"reserved\",\"J1939PG\",\
         \"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\
         \"reserved\",\"reserved\",\"reserved\",\"StandardCAN_FD\",\"ExtendedCAN_FD\";\n\
         BA_DEF_DEF_ \"VFrameFormat\" \"StandardCAN\";\nBA_ \"VFrameFormat\" BO_ {fd} 14;\n"
    );
    let heartbeat = base_id + Message::Heartbeat as u16;
    values(&mut text, heartbeat, "reason", REASONS.iter().map(|(code, meaning)| (*code, *meaning)));
    let command = base_id + Message::Command as u16;
    values(&mut text, command, "command", COMMANDS.iter().map(|(code, meaning)| (*code, *meaning)));
    text
}

fn values<'a>(
    text: &mut String,
    id: u16,
    signal: &str,
    values: impl Iterator<Item = (u16, &'a str)>,
) {
    let _ = write!(text, "VAL_ {id} {signal}");
    for (code, meaning) in values {
        let _ = write!(text, " {code} \"{}\"", meaning.replace('`', ""));
    }
    text.push_str(" ;\n");
}
