//! Frames that never come are told as such, not as "all is well".

mod common;

use beltgauge::config::{Config, Site};
use beltgauge::run::Appliance;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{FaultInjector, Faults, Pace, Paced};

/// Run a camera of 100 frames, of which this share is lost; the last status.
fn ran(drop: f64) -> beltgauge::plc::registers::VisionStatus {
    let text = format!(
        "seed = 3\nfps = 50\nframes = 100\nexposure_ms = 1\n{}[belt]\n\
         speed_mm_per_s = 300\nwidth_mm = 800\ngrey = 45\ntexture_grey = 2\n",
        common::camera_above([320, 200], 225.0, 1200.0, [0.0; 5])
    );
    let config = "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 300\n\
         [zone]\nx_min_mm = -500\nx_max_mm = 500\ny_min_mm = -300\ny_max_mm = 300\n\
         [modbus]\nlisten = \"127.0.0.1:0\"\n";
    let scenario = Scenario::parse(&text).expect("valid");
    let camera = scenario.camera().expect("valid");
    let site = Site::new(Config::parse(config).expect("valid"), camera).expect("in view");
    let belt = Box::new(Synthetic::new(scenario).expect("renders"));
    let faults = Faults::parse(&format!("drop={drop}")).expect("valid");
    let mut source = FaultInjector::new(belt, faults);
    // No frame is let go for want of time, however busy the machine.
    let mut feed = Paced::new(&mut source, Pace::Unhurried);
    let appliance = Appliance::new(site).expect("a free port");
    appliance.run(&mut feed, |_, _| true).expect("runs to the end").status
}

#[test]
fn frames_that_never_come_are_told() {
    let status = ran(0.3);
    assert!(status.frames_lost > 10 && status.frames_missing, "{status:?}");
    let status = ran(0.0);
    assert!(status.frames_lost == 0 && !status.frames_missing, "{status:?}");
}
