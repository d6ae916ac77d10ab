//! After start-up the capture and vision threads allocate nothing.
#![allow(unsafe_code)] // a counting allocator cannot be written without

mod common;

use beltgauge::archive::Reader;
use beltgauge::config::{Config, Site};
use beltgauge::error::Result;
use beltgauge::image::FrameTime;
use beltgauge::run::{Appliance, demo, plan};
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::source::{FrameSource, Pace, Paced};
use std::alloc::{GlobalAlloc, Layout, System};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Allocations on the threads named capture and vision while armed.
static ARMED: AtomicBool = AtomicBool::new(false);
static CAPTURE: AtomicU64 = AtomicU64::new(0);
static VISION: AtomicU64 = AtomicU64::new(0);

struct Counting;

unsafe extern "C" {
    fn prctl(option: i32, name: *mut u8) -> i32;
}
const PR_GET_NAME: i32 = 16;

fn count() {
    if !ARMED.load(Ordering::Relaxed) {
        return;
    }
    // The kernel's thread name: asking std for it could allocate.
    let mut name = [0u8; 16];
    // SAFETY: PR_GET_NAME writes at most 16 bytes.
    unsafe { prctl(PR_GET_NAME, name.as_mut_ptr()) };
    if name.starts_with(b"capture\0") {
        CAPTURE.fetch_add(1, Ordering::Relaxed);
    } else if name.starts_with(b"vision") {
        VISION.fetch_add(1, Ordering::Relaxed);
    }
}

// SAFETY: everything is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Arms the counter from the tenth frame on: start-up is over by then.
struct Watched {
    belt: Synthetic,
    frames: u64,
    last: u64,
    leak: bool,
    /// Resident memory after a tenth of the frames, and after all of them.
    resident_kib: [u64; 2],
}

const FIRST: u64 = 10;

impl Watched {
    fn new(belt: Synthetic, last: u64) -> Self {
        Self { belt, frames: 0, last, leak: false, resident_kib: [0; 2] }
    }
}

impl FrameSource for Watched {
    fn size_px(&self) -> [usize; 2] {
        self.belt.size_px()
    }
    fn fps(&self) -> f64 {
        self.belt.fps()
    }
    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        self.frames += 1;
        ARMED.store(false, Ordering::Relaxed);
        let moments = [self.last / 10, self.last];
        if let Some(moment) = moments.iter().position(|moment| *moment == self.frames) {
            self.resident_kib[moment] = resident_kib();
        }
        ARMED.store((FIRST..self.last).contains(&self.frames), Ordering::Relaxed);
        if self.leak {
            drop(std::hint::black_box(vec![0u8; 100]));
        }
        if self.frames > self.last { Ok(None) } else { self.belt.next_into(frame) }
    }
}

/// This process's resident memory.
fn resident_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).expect("Linux");
    line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).expect("a number")
}

/// Live pictures that the viewers of [`run`] have got.
static PICTURES: AtomicU64 = AtomicU64::new(0);

/// Run the appliance over a source, so many looking at its page; returns parcels and allocations on both
/// threads.
fn run(source: &mut Watched, mut site: Site, workers: usize, viewers: usize) -> (u64, u64, u64) {
    for counter in [&CAPTURE, &VISION, &PICTURES] {
        counter.store(0, Ordering::Relaxed);
    }
    site.config.realtime.workers = workers;
    let anywhere = SocketAddr::from(([127, 0, 0, 1], 0));
    site.config.modbus.listen = anywhere;
    (site.config.web.address, site.config.web.port) = (anywhere.ip(), anywhere.port());
    let web = site.config.web.enabled;
    let appliance = Appliance::new(site).expect("port 0 is free");
    let page = appliance.page_address();
    assert_eq!(page.is_some(), web, "port 0 is free");
    let over = AtomicBool::new(false);
    let progress = std::thread::scope(|scope| {
        for (page, viewer) in page.into_iter().flat_map(|page| (0..viewers).map(move |i| (page, i)))
        {
            let view = ["belt", "raw"][viewer % 2];
            let over = &over;
            scope.spawn(move || look(page, view, over));
        }
        let progress = appliance.run(&mut Paced::new(source, Pace::Unhurried), |_, records| {
            records.for_each(drop);
            true
        });
        over.store(true, Ordering::Relaxed);
        progress
    });
    ARMED.store(false, Ordering::Relaxed);
    let parcels = progress.expect("runs to the end").status.counters.parcels;
    (parcels, CAPTURE.load(Ordering::Relaxed), VISION.load(Ordering::Relaxed))
}

/// Pull live pictures, one after the other.
fn look(page: SocketAddr, view: &str, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let Ok(mut stream) = TcpStream::connect(page) else { return };
        let request = format!(
            "GET /api/live/{view} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        );
        let mut answer = Vec::new();
        let asked = stream.write_all(request.as_bytes());
        if asked.and_then(|()| stream.read_to_end(&mut answer)).is_ok()
            && answer.starts_with(b"HTTP/1.1 200")
        {
            PICTURES.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The demo's belt and site.
fn demo_belt() -> (Synthetic, Site) {
    let scenario = demo::scenario().expect("valid");
    let site = demo::site(&scenario).expect("valid");
    (Synthetic::new(scenario).expect("renders"), site)
}

/// The reference camera scaled to `width` columns (it has 1920) over an endless belt; the whole
/// image is the zone.
fn long_belt(width: usize, frames: u64) -> (Synthetic, Site) {
    let scale = width as f64 / 1920.0;
    let text = format!(
        "seed = 3\nfps = 42\nframes = {frames}\nexposure_ms = 1.0\n\
         {}[belt]\nspeed_mm_per_s = 1000\nwidth_mm = 1300\ngrey = 45\ntexture_grey = 1.5\n\
         [random]\ncount = 400\nfirst_x_mm = -1800\ngap_mm = [250, 350]\ny_mm = [-200, 200]\n\
         length_mm = [150, 300]\nwidth_mm = [100, 200]\nheight_mm = [40, 150]\n",
        common::camera_above([width, (1200.0 * scale) as usize], 1020.0 * scale, 1500.0, [0.0; 5])
    );
    let scenario = Scenario::parse(&text).expect("valid");
    let config = "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 990\n\
         [zone]\nx_min_mm = -1400\nx_max_mm = 1400\ny_min_mm = -870\ny_max_mm = 870\n";
    let config = Config::parse(config).expect("valid");
    let site = Site::new(config, scenario.camera().expect("valid")).expect("in view");
    (Synthetic::new(scenario).expect("renders"), site)
}

/// One test: the counters are the process's.
#[test]
fn five_thousand_frames_with_parcels_allocate_nothing_and_memory_stays_as_it_was_planned() {
    let base_kib = resident_kib();
    let (mut belt, site) = long_belt(1920, 100);
    belt.render(0, &mut vec![0; 1920 * 1200]);
    let renderer_kib = resident_kib() - base_kib;
    let planned_kib = plan(&site).bytes() as u64 / 1024;
    let mut source = Watched::new(belt, 90);
    let (_, capture, vision) = run(&mut source, site, 1, 0);
    assert_eq!((capture, vision), (0, 0), "allocations at the full size");
    let appliance_kib = source.resident_kib[1] - renderer_kib;
    eprintln!(
        "resident at 1920x1200: {appliance_kib} KiB of {planned_kib} planned, renderer {renderer_kib}"
    );
    // What is not planned: program, stacks, servers, the page's last pictures.
    assert!(appliance_kib < planned_kib + 48 * 1024, "{appliance_kib} of {planned_kib} KiB");
    drop(source);

    let (belt, mut site) = long_belt(320, 5_100);
    // The page's list of the last parcels fills up to its limit: that is none of these threads' memory.
    site.config.web.enabled = false;
    let mut source = Watched::new(belt, 5_010);
    let (parcels, capture, vision) = run(&mut source, site, 1, 0);
    assert!(parcels >= 150, "only {parcels} parcels passed: the test proves nothing");
    assert_eq!((capture, vision), (0, 0), "allocations on the capture and vision threads");
    let [early_kib, late_kib] = source.resident_kib;
    eprintln!("resident after 500 frames {early_kib} KiB, after 5000 {late_kib} KiB");
    // A page or two of stack that was not touched before; 16 bytes a frame would be 70 KiB.
    assert!(late_kib <= early_kib + 64, "grew from {early_kib} to {late_kib} KiB");

    // Eight viewers of both pictures, and two workers: the threads are called "vision 0" and "vision 1".
    let (belt, mut site) = demo_belt();
    let archive = std::env::temp_dir().join(format!("beltgauge-no-alloc-{}", std::process::id()));
    site.config.archive.folder = Some(archive.clone());
    let (parcels, capture, vision) = run(&mut Watched::new(belt, 510), site, 2, 8);
    let kept = Reader::open(&archive).and_then(|reader| reader.verify()).expect("an archive");
    assert!(kept.entries >= parcels && kept.broken.is_empty(), "{kept:?}");
    let _ = std::fs::remove_dir_all(&archive);
    assert!(parcels >= 5, "only {parcels} parcels passed with two workers");
    assert_eq!((capture, vision), (0, 0), "allocations with two workers and eight viewers");
    let pictures = PICTURES.load(Ordering::Relaxed);
    assert!(pictures >= 16, "the viewers got only {pictures} pictures: the test proves nothing");
    // The counter counts: one allocation and one release a frame while armed.
    let (belt, site) = demo_belt();
    let mut leaking = Watched { leak: true, ..Watched::new(belt, 510) };
    let (_, capture, _) = run(&mut leaking, site, 1, 0);
    assert!(capture >= 500, "the counter saw only {capture} planted allocations");
}
