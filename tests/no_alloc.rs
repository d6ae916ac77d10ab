//! After start-up the capture and vision threads allocate nothing.
#![allow(unsafe_code)] // a counting allocator cannot be written without

use beltgauge::error::Result;
use beltgauge::image::FrameTime;
use beltgauge::run::{Appliance, Pace, demo};
use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::Synthetic;
use std::alloc::{GlobalAlloc, Layout, System};
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

/// Arms the counter from the tenth frame to the last: start-up is over by then.
struct Watched {
    belt: Synthetic,
    frames: u64,
    leak: bool,
}

const FIRST: u64 = 10;
const LAST: u64 = FIRST + 500;

impl FrameSource for Watched {
    fn size_px(&self) -> [usize; 2] {
        self.belt.size_px()
    }
    fn fps(&self) -> f64 {
        self.belt.fps()
    }
    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        self.frames += 1;
        ARMED.store((FIRST..LAST).contains(&self.frames), Ordering::Relaxed);
        if self.leak {
            drop(std::hint::black_box(vec![0u8; 100]));
        }
        if self.frames > LAST { Ok(None) } else { self.belt.next_into(frame) }
    }
}

/// Run the appliance over 510 frames; returns parcels and allocations on both threads.
fn run(leak: bool, workers: usize) -> (u64, u64, u64) {
    CAPTURE.store(0, Ordering::Relaxed);
    VISION.store(0, Ordering::Relaxed);
    let scenario = demo::scenario().expect("valid");
    let mut site = demo::site(&scenario).expect("valid");
    site.config.realtime.workers = workers;
    site.config.modbus.listen = ([127, 0, 0, 1], 0).into();
    let belt = Synthetic::new(scenario).expect("renders");
    let mut source = Watched { belt, frames: 0, leak };
    let appliance = Appliance::new(site, Pace::Source).expect("port 0 is free");
    let progress = appliance.run(&mut source, |_, records| {
        records.for_each(drop);
        true
    });
    ARMED.store(false, Ordering::Relaxed);
    let parcels = progress.expect("runs to the end").status.counters.parcels;
    (parcels, CAPTURE.load(Ordering::Relaxed), VISION.load(Ordering::Relaxed))
}

#[test]
fn five_hundred_frames_with_parcels_allocate_nothing() {
    let (parcels, capture, vision) = run(false, 1);
    assert!(parcels >= 5, "only {parcels} parcels passed: the test proves nothing");
    assert_eq!((capture, vision), (0, 0), "allocations on the capture and vision threads");
    // Two workers: the threads are called "vision 0" and "vision 1".
    let (more_parcels, capture, vision) = run(false, 2);
    assert!(more_parcels >= 5, "only {more_parcels} parcels passed with two workers");
    assert_eq!((capture, vision), (0, 0), "allocations with two workers");
    // The counter counts: one allocation and one release a frame while armed.
    let (_, capture, _) = run(true, 1);
    assert!(capture >= 500, "the counter saw only {capture} planted allocations");
}
