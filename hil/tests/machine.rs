//! The static binary, and the appliance's CAN and Modbus against peers, in the emulated machine.

use hil::machine::Machine;
use hil::plc::{Client, Plc, map};
use std::time::{Duration, Instant};

/// Let a PLC on the host take parcels over Modbus until `done`.
fn poll(plc: &mut Plc, patience: Duration, mut done: impl FnMut(&Plc) -> bool) {
    let start = Instant::now();
    while !done(plc) {
        assert!(start.elapsed() < patience, "{} parcels taken", plc.taken.len());
        // A connection that the other side has ended fails once.
        if !plc.cycle().unwrap_or(false) {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

fn status(machine: &Machine, name: &str) -> u32 {
    let register = &map()[&format!("status.{name}")];
    let mut client = Client::connect(machine.modbus).expect("accepted");
    let words = client.read(register.address, 1 + u16::from(register.long)).expect("exists");
    words.iter().fold(0, |value, word| value << 16 | u32::from(*word))
}

/// Start the feeder on a bus, and the peer that takes `parcels` on another.
fn start(machine: &mut Machine, [from, to]: [&str; 2], parcels: u32, fd: &str) {
    // The peer's shell may be slower than the first look at what it says.
    machine.run("rm -f /tmp/state.json; : >/tmp/received");
    machine.run(&format!("can_bench receive {to} {parcels} >/tmp/received 2>&1 &"));
    hil::wait_for("the peer", || {
        machine.run("cat /tmp/received").contains("listening").then_some(())
    });
    feed(machine, from, parcels, fd);
}

fn feed(machine: &mut Machine, interface: &str, parcels: u32, fd: &str) {
    machine.run(&format!(
        "can_bench feed {interface} {parcels} 5 /tmp/state.json {fd} >/tmp/fed 2>&1 & echo $! >/tmp/pid"
    ));
}

/// Kill the appliance, and wait until its port is free.
fn kill(machine: &mut Machine) {
    machine.run(
        "kill -9 $(cat /tmp/pid); while kill -0 $(cat /tmp/pid) 2>/dev/null; do sleep 0.1; done",
    );
}

/// What the peer says at its end.
fn received(machine: &mut Machine) -> String {
    for _ in 0..60 {
        let (text, _) = machine.try_run("cat /tmp/received");
        if text.contains("whole") {
            kill(machine);
            let text = text.lines().filter(|line| line.starts_with("whole")).collect::<String>();
            eprintln!("over CAN: {text}");
            return text;
        }
        std::thread::sleep(Duration::from_secs(1));
    }
    panic!("the peer did not end: {:?}", machine.try_run("cat /tmp/fed; ps"));
}

/// A count of the peer's.
fn count(received: &str, name: &str) -> u32 {
    let mut words = received.split_whitespace().skip_while(|word| *word != name);
    words.nth(1).and_then(|count| count.parse().ok()).expect("the peer tells it")
}

fn all_arrived(plc: &Plc, received: &str, parcels: u32) {
    assert!(plc.complaints.is_empty(), "{:?}", plc.complaints);
    assert_eq!(plc.taken.len(), parcels as usize, "over Modbus");
    assert_eq!((count(received, "whole"), count(received, "wrong")), (parcels, 0), "{received}");
    assert!(received.contains("in order true"), "{received}");
}

#[test]
fn parcels_arrive_over_both_wires_whatever_happens_to_either_side() {
    let mut machine = Machine::boot();
    for interface in ["vcan0", "can0", "can1"] {
        let link = machine.run(&format!("/bin/ip link show {interface}"));
        assert!(link.contains("LOWER_UP"), "{link}");
    }
    restarts_of_either_side(&mut machine);
    a_pulled_cable(&mut machine);
    bus_off(&mut machine);
    the_product_itself(&mut machine);
}

/// A thousand parcels on the virtual bus, with CAN FD: the PLC is restarted in the middle of its
/// queue, the appliance is killed.
fn restarts_of_either_side(machine: &mut Machine) {
    const PARCELS: u32 = 1000;
    start(machine, ["vcan0", "vcan0"], PARCELS, "fd");
    let mut plc = Plc::new(machine.modbus);
    for part in 1..=10 {
        let enough = part * PARCELS as usize / 10;
        poll(&mut plc, Duration::from_mins(2), |plc| plc.taken.len() >= enough);
        plc.disconnect();
        if part % 3 == 0 {
            kill(machine);
            feed(machine, "vcan0", PARCELS, "fd");
        }
    }
    assert_eq!(status(machine, "boots"), 4);
    let received = received(machine);
    all_arrived(&plc, &received, PARCELS);
    assert!(count(&received, "repeated") >= 3, "{received}");
}

/// Wait until what Modbus shows has come over CAN too. While nobody takes parcels over Modbus no more
/// than a queue of them leaves the zone.
fn all_sent(machine: &mut Machine) {
    hil::wait_for("CAN to be level with Modbus", || {
        let shown = status(machine, "parcels");
        let come = machine.run("tail -n 1 /tmp/received");
        (come.trim() == format!("parcel {shown}")).then_some(())
    });
}

/// Two SJA1000 controllers, classical frames; the appliance's interface goes down and comes back.
fn a_pulled_cable(machine: &mut Machine) {
    const PARCELS: u32 = 120;
    start(machine, ["can0", "can1"], PARCELS, "");
    let mut plc = Plc::new(machine.modbus);
    for part in 1..=3 {
        let enough = part * PARCELS as usize / 3;
        poll(&mut plc, Duration::from_mins(2), |plc| plc.taken.len() >= enough);
        if part < 3 {
            all_sent(machine);
            // Parcels leave the zone meanwhile: fewer than wait without loss.
            machine.run("/bin/ip link set can0 down; sleep 1");
            let enough = plc.taken.len() + 20;
            poll(&mut plc, Duration::from_mins(2), |plc| plc.taken.len() >= enough);
            assert_eq!(status(machine, "can_state"), 4, "down");
            machine.run("/bin/ip link set can0 up; sleep 1");
            assert_eq!(status(machine, "can_state"), 1, "active again");
        }
    }
    assert_eq!(status(machine, "can_parcels_dropped"), 0);
    let received = received(machine);
    all_arrived(&plc, &received, PARCELS);
}

/// Error frames as a driver reports them: the emulated controllers never leave the bus.
fn bus_off(machine: &mut Machine) {
    const PARCELS: u32 = 60;
    start(machine, ["vcan0", "vcan0"], PARCELS, "");
    let mut plc = Plc::new(machine.modbus);
    poll(&mut plc, Duration::from_mins(2), |plc| plc.taken.len() >= 20);
    all_sent(machine);
    machine.run("cansend vcan0 20000040#0000000000000000; sleep 1");
    assert_eq!((status(machine, "can_state"), status(machine, "reason")), (3, 3));
    poll(&mut plc, Duration::from_mins(2), |plc| plc.taken.len() >= 40);
    machine.run("cansend vcan0 20000100#0000000000000000; sleep 1");
    assert_eq!(status(machine, "can_state"), 1);
    poll(&mut plc, Duration::from_mins(2), |plc| plc.taken.len() >= PARCELS as usize);
    let received = received(machine);
    all_arrived(&plc, &received, PARCELS);
    assert!(count(&received, "repeated") >= 2 && count(&received, "errors") == 2, "{received}");
}

/// The static binary with the demo's camera: heartbeat, command and outcome as can-utils see them; it
/// is killed, and goes on.
fn the_product_itself(machine: &mut Machine) {
    machine.run(
        "printf '[plc]\\nstate_file = \"state\"\\n[can]\\ninterface = \"vcan0\"\\n' >/tmp/plc.toml",
    );
    machine.run("candump -L vcan0 >/tmp/candump & echo $! >/tmp/candump.pid");
    let demo =
        "beltgauge demo --seconds 600 --listen 0.0.0.0:1502 --config /tmp/plc.toml --out /tmp/out";
    let frames = |machine: &mut Machine, frame: &str| -> usize {
        let (text, _) = machine.try_run(&format!("grep -c 'vcan0 {frame}' /tmp/candump"));
        text.trim().parse().expect("a count")
    };
    for boot in 1..=2 {
        machine.run(&format!("{demo} >/tmp/demo 2>&1 & echo $! >/tmp/pid"));
        hil::wait_for("heartbeats over CAN", || {
            (frames(machine, "500#") >= 20 * boot).then_some(())
        });
        assert_eq!(status(machine, "boots"), boot as u32);
        let ticket = 40 + boot;
        machine.run(&format!("cansend vcan0 508#00{ticket:02X}000500000005"));
        let outcome = format!("504#00{ticket:02X}0001");
        hil::wait_for("the outcome", || (frames(machine, &outcome) == 1).then_some(()));
        assert_eq!(status(machine, "scale_interval"), 5);
        kill(machine);
    }
    machine.run("kill $(cat /tmp/candump.pid)");
}
