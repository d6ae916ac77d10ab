//! The appliance's link and Modbus server as a process of its own, to be killed: `link_server ADDRESS
//! STATE FIRST`. A parcel leaves every 5 ms; its size tells which it is, from FIRST on.

use hil::server::Server;
use std::path::Path;
use std::time::{Duration, Instant};

/// Longer than any disk takes for a write.
const PATIENCE: Duration = Duration::from_secs(2);

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let address = arguments[1].parse().expect("an address");
    let first: u32 = arguments[3].parse().expect("a number");
    // A file that may not grow is an error of the disk, as it is in the appliance's service.
    let ignored = std::sync::Arc::default();
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, ignored).expect("a signal");
    let server = Server::start(address, Some(Path::new(&arguments[2])));
    for number in first.. {
        // No more than the queue holds: what it drops is counted, and no subject here.
        while server.queued() > 20 {
            std::thread::sleep(Duration::from_millis(1));
        }
        let (published, sent) = (server.published(), Instant::now());
        server.parcel(number);
        std::thread::sleep(Duration::from_millis(5));
        // A busy disk holds it up: those under way are not in the queue yet, and would overfill it.
        while server.published() == published && sent.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
