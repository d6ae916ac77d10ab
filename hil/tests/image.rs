//! The image that is flashed, booted in QEMU: cameras, sticks, updates, power cuts.

use hil::appliance::{Appliance, Arch, Bench, Boot, PARCELS};
use hil::plc::{Parcel, Plc};
use std::time::{Duration, Instant};

/// Take parcels as a PLC does until there are so many.
fn take(appliance: &Appliance, plc: &mut Plc, count: usize) {
    let start = Instant::now();
    while plc.taken.len() < count {
        let took = plc.cycle();
        assert!(start.elapsed() < Duration::from_mins(5), "{} of {count}", plc.taken.len());
        if !took.is_ok_and(|took| took) {
            std::thread::sleep(Duration::from_millis(100));
        }
    }
    assert!(plc.complaints.is_empty(), "{:?}", plc.complaints);
    let _ = appliance;
}

/// The largest error of a parcel, against whichever of the belt's parcels is nearest.
fn error_mm(parcel: &Parcel) -> f64 {
    let distance = |truth: &[f64; 3]| {
        truth.iter().zip(parcel.size_mm).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    PARCELS.iter().map(distance).fold(f64::INFINITY, f64::min)
}

#[test]
fn parcels_measured_by_the_image_arrive_with_their_true_sizes() {
    let bench = Bench::new(Arch::X86);
    let appliance = bench.boot(&bench.disk("measure"), Boot::Uefi);
    let mut plc = Plc::new(appliance.modbus);
    take(&appliance, &mut plc, 6);
    for (parcel, _) in &plc.taken {
        println!("{parcel:?} error {:.1} mm", error_mm(parcel));
    }
    println!(
        "frames {} dropped {} lost {} torn {}",
        appliance.status("frames"),
        appliance.status("frames_dropped"),
        appliance.status("frames_lost"),
        appliance.status("frames_torn")
    );
}
