//! Belt counts over Modbus reach the measurement: a belt without texture, at a speed that is not the
//! nominal one.

use beltgauge::config::{Config, Site};
use beltgauge::event::{Flags, ParcelRecord};
use beltgauge::run::Appliance;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{Pace, Paced};
use hil::plc::{Client, map};
use std::net::TcpListener;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const SPEED_MM_PER_S: f64 = 480.0;
const MM_PER_COUNT: f64 = 0.05;
/// The counter has 16 bits: it wraps around every 3.3 m.
const BITS: u32 = 16;
const SIZE_MM: [f64; 3] = [240.0, 160.0, 120.0];

/// Two equal parcels on a belt as smooth as glass; `counting`: the PLC tells the encoder's counts.
fn measure(counting: bool) -> Vec<ParcelRecord> {
    let [length, width, height] = SIZE_MM;
    let parcel = |x: i32| {
        format!(
            "[[parcel]]\nlength_mm = {length}\nwidth_mm = {width}\nheight_mm = {height}\n\
             yaw_deg = 20\nx_mm = {x}\ny_mm = 30\nmaterial = \"kraft\"\n"
        )
    };
    let text = format!(
        "seed = 3\nfps = 30\nframes = 190\nexposure_ms = 1.0\n[camera]\nimage_size_px = [640, 400]\n\
         [camera.lens]\nmodel = \"brown\"\nfx_px = 450\nfy_px = 450\ncx_px = 320\ncy_px = 200\n\
         distortion = [0, 0, 0, 0, 0]\n[camera.pose]\n\
         rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\ntranslation_mm = [0, 0, 1200]\n\
         [belt]\nspeed_mm_per_s = {SPEED_MM_PER_S}\nwidth_mm = 800\ngrey = 45\ntexture_grey = 0\n{}{}",
        parcel(-1050),
        parcel(-1800)
    );
    let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = free.local_addr().expect("bound");
    drop(free);
    let config = format!(
        "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 500\n\
         [zone]\nx_min_mm = -600\nx_max_mm = 600\ny_min_mm = -300\ny_max_mm = 300\n\
         [modbus]\nlisten = \"{address}\"\nwrite_allow = [\"127.0.0.1\"]\n\
         [encoder]\nmm_per_count = {MM_PER_COUNT}\nbits = {BITS}\n"
    );
    let scenario = Scenario::parse(&text).expect("valid");
    let camera = scenario.camera().expect("valid");
    let site = Site::new(Config::parse(&config).expect("valid"), camera).expect("in view");
    let mut source = Synthetic::new(scenario).expect("renders");
    let appliance = Appliance::new(site).expect("the port is free");
    let (done, mut records) = (AtomicBool::new(false), Vec::new());
    std::thread::scope(|scope| {
        if counting {
            scope.spawn(|| {
                let register = map()["command.encoder_count"].address;
                let mut client = Client::connect(address).expect("accepted");
                let start = Instant::now();
                while !done.load(Ordering::Relaxed) {
                    let mm = SPEED_MM_PER_S * start.elapsed().as_secs_f64();
                    let count = (60_000 + (mm / MM_PER_COUNT) as u32) % (1 << BITS);
                    // At the end the server is gone.
                    let _ = client.write(register, &[0, count as u16]);
                    std::thread::sleep(Duration::from_millis(5));
                }
            });
        }
        let ran = appliance.run(&mut Paced::new(&mut source, Pace::RealTime), |_, new| {
            records.extend(new);
            true
        });
        done.store(true, Ordering::Relaxed);
        ran.expect("runs to the end");
    });
    records
}

#[test]
fn counts_over_modbus_measure_what_the_belt_s_texture_cannot() {
    let counted = measure(true);
    assert_eq!(counted.len(), 2, "{counted:?}");
    for record in &counted {
        eprintln!("{record}");
        assert!(record.by_encoder && !record.flags.has(Flags::SPEED_ASSUMED), "{record}");
        let measured = [record.length_mm, record.width_mm, record.height_mm];
        for (measured, truth) in measured.into_iter().zip(SIZE_MM) {
            // A pixel is 2.7 mm; counts that arrive a ms late are half a mm.
            assert!((measured - truth).abs() < 3.0, "{record}");
        }
    }
    // The same belt without counts: its motion is assumed, and every record says so.
    let assumed = measure(false);
    assert_eq!(assumed.len(), 2);
    for record in &assumed {
        assert!(!record.by_encoder && record.flags.has(Flags::SPEED_ASSUMED), "{record}");
    }
}
