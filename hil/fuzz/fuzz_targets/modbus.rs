//! A client of the Modbus server that sends anything: guard, library and registers, over a real
//! connection.
#![no_main]

use beltgauge::config::{Modbus, Plc, WordOrder};
use beltgauge::plc::clients::ClientList;
use beltgauge::plc::journal::Journal;
use beltgauge::plc::link::Link;
use beltgauge::plc::modbus;
use beltgauge::plc::registers::{CanStatus, VisionStatus};
use libfuzzer_sys::fuzz_target;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::sync::LazyLock;
use std::time::Instant;

static SERVER: LazyLock<SocketAddr> = LazyLock::new(|| {
    let settings = Modbus {
        listen: (Ipv4Addr::LOCALHOST, 0).into(),
        write_allow: vec![Ipv4Addr::LOCALHOST.into()],
        ..Modbus::default()
    };
    let listener = modbus::bind(&settings).expect("a free port");
    let address = listener.local_addr().expect("bound");
    std::thread::spawn(move || {
        let plc = Plc { queue: true, ..Plc::default() };
        let now = Instant::now();
        let link = Link::new(plc, WordOrder::HighFirst, false, Journal::default(), now);
        let served = modbus::serve(
            listener,
            &settings,
            ClientList::new(settings.connections_max),
            link,
            |link| {
                let (vision, can) = (VisionStatus::default(), CanStatus::default());
                link.update(&vision, &can, None, Instant::now());
                while link.next_request().is_some() {}
                while link.next_count().is_some() {}
                true
            },
        );
        served.expect("serves for ever");
    });
    address
});

fuzz_target!(|bytes: &[u8]| {
    let mut client = TcpStream::connect(*SERVER).expect("accepted");
    // The server hangs up on what is not Modbus, and need not read or answer it.
    let _ = client.write_all(bytes);
    let _ = client.shutdown(Shutdown::Write);
    let mut answers = Vec::new();
    let _ = client.read_to_end(&mut answers);
    assert!(answers.len() <= 40 * bytes.len(), "answers to what was not asked");
});
