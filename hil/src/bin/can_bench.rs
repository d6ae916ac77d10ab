//! Both ends of the CAN bus inside the emulated machine:
//! `can_bench feed INTERFACE PARCELS PERIOD_MS STATE [fd]`: the appliance's link, Modbus on port 1502;
//! `can_bench receive INTERFACE PARCELS`: a peer that ends when it has so many, or after silence.

use beltgauge::config::Can;
use hil::can_peer::Receiver;
use hil::server::{Server, record};
use socketcan::{CanAnyFrame, CanFdSocket, EmbeddedFrame, Frame, Socket, SocketOptions};
use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};

/// No parcel for this long: there are no more.
const SILENCE: Duration = Duration::from_secs(30);

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["feed", interface, parcels, period_ms, state, ref rest @ ..] => {
            let number = |text: &str| text.parse::<u32>().expect("a number");
            feed(interface, number(parcels), number(period_ms), Path::new(state), !rest.is_empty());
        }
        ["receive", interface, parcels] => receive(interface, parcels.parse().expect("a number")),
        _ => panic!(
            "can_bench feed INTERFACE PARCELS PERIOD_MS STATE [fd] | receive INTERFACE PARCELS"
        ),
    }
}

/// Publish parcels until the last one is out, then serve on.
fn feed(interface: &str, parcels: u32, period_ms: u32, state: &Path, fd: bool) {
    let can = Can { interface: Some(interface.to_owned()), fd, ..Can::default() };
    let listen = SocketAddr::from(([0, 0, 0, 0], 1502));
    let server = Server::start_with(listen, Some(state), can);
    std::thread::sleep(Duration::from_millis(200));
    loop {
        // After a restart, where the last run ended; and never faster than the PLC takes them.
        let next = server.published() + 1;
        if next <= parcels && server.queued() < 24 {
            server.parcel(next);
            while server.published() < next {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        std::thread::sleep(Duration::from_millis(u64::from(period_ms)));
    }
}

fn receive(interface: &str, parcels: usize) {
    let socket = CanFdSocket::open(interface).expect("the interface is there");
    socket.set_read_timeout(Duration::from_millis(100)).expect("a time-out");
    socket.set_error_filter_accept_all().expect("error frames");
    println!("listening");
    let mut receiver = Receiver::new(Can::default().base_id);
    let (mut last, mut whole, mut errors) = (Instant::now(), 0, 0);
    while receiver.whole.len() < parcels && last.elapsed() < SILENCE {
        match socket.read_frame() {
            Ok(CanAnyFrame::Normal(frame)) => {
                receiver.frame(frame.raw_id() as u16, frame.data());
            }
            Ok(CanAnyFrame::Fd(frame)) => {
                receiver.frame(frame.raw_id() as u16, frame.data());
            }
            Ok(CanAnyFrame::Error(_)) => errors += 1,
            _ => {}
        }
        if receiver.whole.len() > whole {
            println!("parcel {}", receiver.whole.last().expect("more than before")["sequence"]);
            (whole, last) = (receiver.whole.len(), Instant::now());
        }
    }
    let wrong = receiver.whole.iter().filter(|values| {
        let expected = record(values["sequence"]);
        values["length"] != (10.0 * expected.length_mm).round() as u32
            || values["width"] != (10.0 * expected.width_mm).round() as u32
    });
    let came = |number: &u32| receiver.whole.iter().any(|values| values["sequence"] == *number);
    let missing: Vec<u32> = (1..=parcels as u32).filter(|number| !came(number)).collect();
    let in_order = receiver.whole.is_sorted_by_key(|values| values["sequence"]);
    println!(
        "whole {} wrong {} repeated {} broken {} heartbeats {} errors {errors} in order {in_order} \
         missing {missing:?}",
        receiver.whole.len(),
        wrong.count(),
        receiver.repeated,
        receiver.broken,
        receiver.heartbeats
    );
}
