//! Many lanes against one broker: `fleet_load FOLDER [LANES] [SECONDS] [PERIOD_MS]`. Every lane has an
//! archive in FOLDER and a fleet thread of its own; a parcel leaves each of them in every period, and
//! all of them must arrive at one subscriber.

use hil::fleet::{Broker, Lane, Subscriber, now_ms, settings, used};
use std::collections::HashMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number =
        |at: usize, or: u64| arguments.get(at).map_or(or, |n| n.parse().expect("a number"));
    let folder = PathBuf::from(arguments.first().expect("a folder"));
    let (lanes, seconds, period_ms) = (number(1, 200), number(2, 60), number(3, 500));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("room");
    let broker = Broker::start(&folder);
    let subscriber = Subscriber::start(broker.address, "database", &[]);
    let name = |lane: u64| format!("lane-{lane}");
    let mut all: Vec<Lane> = (0..lanes)
        .map(|lane| Lane::start(&folder.join(name(lane)), settings(broker.address, &name(lane))))
        .collect();
    hil::wait_for("every lane", || {
        let online = subscriber.received().iter().filter(|m| m.what == "state").count();
        (online as u64 >= lanes).then_some(())
    });
    // Lanes take their turns, so that the broker's load is even.
    let mut left = HashMap::new();
    let (begun, before, ours) = (Instant::now(), broker.used(), used(std::process::id()));
    let each = seconds * 1000 / period_ms;
    for turn in 0..each * lanes {
        let due = Duration::from_micros(turn * period_ms * 1000 / lanes);
        std::thread::sleep(due.saturating_sub(begun.elapsed()));
        let lane = turn % lanes;
        all[lane as usize].parcel();
        left.insert((name(lane), turn / lanes + 1), now_ms());
    }
    let made = begun.elapsed().as_secs_f64();
    let arrived =
        |what: &str| subscriber.received().iter().filter(|m| m.what == what).count() as u64;
    hil::wait_for("the last parcel", || (arrived("parcel") >= each * lanes).then_some(()));
    let after = (broker.used(), used(std::process::id()));
    let received = subscriber.received().clone();
    let mut late: Vec<u64> = Vec::new();
    let (mut twice, mut bytes) = (0, 0);
    for message in received.iter().filter(|m| m.what == "parcel") {
        let seq = message.payload["seq"].as_u64().expect("a number");
        bytes += message.bytes;
        match left.remove(&(message.lane.clone(), seq)) {
            Some(at) => late.push(message.at_ms.saturating_sub(at)),
            None => twice += 1,
        }
    }
    late.sort_unstable();
    let share = |share: f64| late[((late.len() - 1) as f64 * share) as usize];
    let parcels = late.len() as f64;
    println!(
        "{lanes} lanes, {} parcels in {made:.0} s ({:.0} a second), {} missing, {twice} twice, {} health messages\n\
         late: median {} ms, 95 % below {} ms, slowest {} ms; a parcel is {:.0} bytes, topic included\n\
         mosquitto: {:.1} % of a processor, {:.1} MiB; all lanes: {:.1} % of a processor ({:.2} % each), {:.1} MiB each",
        late.len(),
        parcels / made,
        left.len(),
        arrived("health"),
        share(0.5),
        share(0.95),
        share(1.0),
        bytes as f64 / parcels,
        100.0 * (after.0.0 - before.0) / made,
        after.0.1,
        100.0 * (after.1.0 - ours.0) / made,
        100.0 * (after.1.0 - ours.0) / made / lanes as f64,
        after.1.1 / lanes as f64,
    );
    all.iter().for_each(Lane::end);
    all.into_iter().for_each(Lane::finish);
}
