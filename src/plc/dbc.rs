//! The CAN messages as a DBC file, from the same tables as the frames.

use super::codes::REASONS;
use super::command::COMMANDS;
use super::frames::{self, Message, Place};
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
    comments(&mut text, base_id);
    attributes(&mut text, base_id);
    let heartbeat = base_id + Message::Heartbeat as u16;
    values(
        &mut text,
        heartbeat,
        "reason",
        REASONS.iter().map(|(code, _, meaning)| (*code, *meaning)),
    );
    let command = base_id + Message::Command as u16;
    values(
        &mut text,
        command,
        "command",
        COMMANDS.iter().map(|(code, _, meaning)| (*code, *meaning)),
    );
    text
}

/// What nodes, messages and signals mean.
fn comments(text: &mut String, base_id: u16) {
    let _ =
        writeln!(text, "\nCM_ \"Parcels measured on a conveyor, and what their sorter may ask.\";");
    let _ = writeln!(text, "CM_ BU_ Beltgauge \"the measuring appliance\";");
    let _ = writeln!(text, "CM_ BU_ PLC \"the sorter's controller\";");
    for message in Message::ALL {
        let (id, meaning) = (base_id + message as u16, message.meaning());
        let _ = writeln!(text, "CM_ BO_ {id} \"{meaning}\";");
    }
    comment(text, base_id, Message::Heartbeat, frames::heartbeat_places());
    comment(text, base_id, Message::Status, frames::status_places());
    comment(text, base_id, Message::Parcel, frames::parcel_places());
    comment(text, base_id, Message::ParcelFd, frames::parcel_fd_places());
    comment(text, base_id, Message::Result, frames::result_places());
}

fn comment<S: 'static>(
    text: &mut String,
    base_id: u16,
    message: Message,
    places: impl Iterator<Item = Place<'static, S>>,
) {
    for Place { field, .. } in places {
        let (id, meaning) = (base_id + message as u16, plain(field.meaning));
        let _ = writeln!(text, "CM_ SG_ {id} {} \"{meaning}\";", field.name);
    }
}

/// The attributes that database tools look for: kind of bus, kind of frame, cycle time.
fn attributes(text: &mut String, base_id: u16) {
    let fd = base_id + Message::ParcelFd as u16;
    let _ = write!(
        text,
        "\nBA_DEF_ \"BusType\" STRING ;\n\
         BA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 65535;\n\
         BA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\",\"reserved\",\"J1939PG\",\
         \"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\"reserved\",\
         \"reserved\",\"reserved\",\"reserved\",\"StandardCAN_FD\",\"ExtendedCAN_FD\";\n\
         BA_DEF_DEF_ \"BusType\" \"CAN\";\n\
         BA_DEF_DEF_ \"GenMsgCycleTime\" 0;\n\
         BA_DEF_DEF_ \"VFrameFormat\" \"StandardCAN\";\n\
         BA_ \"BusType\" \"CAN FD\";\n"
    );
    for message in Message::ALL {
        if let Some(period) = message.period() {
            let (id, ms) = (base_id + message as u16, period.as_millis());
            let _ = writeln!(text, "BA_ \"GenMsgCycleTime\" BO_ {id} {ms};");
        }
    }
    let _ = writeln!(text, "BA_ \"VFrameFormat\" BO_ {fd} 14;");
}

/// A text without what has a meaning of its own in the printed documents or in this one.
fn plain(meaning: &str) -> String {
    meaning.replace('`', "").replace('"', "'")
}

fn values<'a>(
    text: &mut String,
    id: u16,
    signal: &str,
    values: impl Iterator<Item = (u16, &'a str)>,
) {
    let _ = write!(text, "VAL_ {id} {signal}");
    for (code, meaning) in values {
        let _ = write!(text, " {code} \"{}\"", plain(meaning));
    }
    text.push_str(" ;\n");
}
