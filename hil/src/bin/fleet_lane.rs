//! A lane of the fleet as a process of its own, to be killed: `fleet_lane BROKER FOLDER PERIOD_MS TOTAL`.
//! A parcel leaves every so many ms until there are TOTAL, over all its starts. SIGTERM ends it in order.

use hil::fleet::{Lane, settings};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let broker = arguments[1].parse().expect("an address");
    let period = Duration::from_millis(arguments[3].parse().expect("a number"));
    let total: u32 = arguments[4].parse().expect("a number");
    let over = Arc::<AtomicBool>::default();
    signal_hook::flag::register(signal_hook::consts::SIGTERM, Arc::clone(&over)).expect("a signal");
    let mut lane = Lane::start(Path::new(&arguments[2]), settings(broker, "lane-1"));
    while !over.load(Ordering::Relaxed) {
        if lane.seq() < total {
            lane.parcel();
        }
        std::thread::sleep(period);
    }
    lane.finish();
}
