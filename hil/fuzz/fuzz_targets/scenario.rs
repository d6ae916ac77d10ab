//! A scenario of the synthetic belt.
#![no_main]

use beltgauge::source::synthetic::Scenario;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    let Ok(scenario) = Scenario::parse(text) else { return };
    let _ = scenario.camera();
    let _ = scenario.travel_at_frame_mm(1000);
});
