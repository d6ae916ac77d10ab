//! The watchdog: every thread beats; one that stands still ends the program, and with it the feeding
//! of the hardware watchdog, which restarts the machine if nobody else restarts the program. systemd's
//! watchdog is fed beside it.

use crate::error::{Error, Result};
use sd_notify::NotifyState;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A thread that stands still for this long hangs: longer than any wait of its own.
const PATIENCE: Duration = Duration::from_secs(10);
/// The same for capture: opening a camera over a bad cable takes many requests of half a second.
const CAPTURE_PATIENCE: Duration = Duration::from_secs(40);
/// The hardware watchdog is fed this often; it bites after some 10 to 60 s, as its driver says.
const FEEDING: Duration = Duration::from_secs(1);
/// The process's exit status when a thread hangs.
const EXIT_HANGS: i32 = 3;
/// The process's exit status when a thread panics.
const EXIT_PANICS: i32 = 4;
/// The log's last lines are out within this, or nobody reads them.
const FAREWELL: Duration = Duration::from_millis(300);

/// A panic in any thread from now on ends the process with a status of its own: an invariant is broken,
/// and the other threads would go on as if all were well.
pub fn end_on_panic() {
    std::panic::set_hook(Box::new(|panic| {
        // Whatever the log does.
        let ending = std::thread::Builder::new().name("end".into()).spawn(move || {
            std::thread::sleep(FAREWELL);
            std::process::exit(EXIT_PANICS);
        });
        let thread = std::thread::current();
        let name = thread.name().unwrap_or("nameless");
        tracing::error!("the {name} thread: {panic}: giving up, to be started again");
        match ending {
            Ok(ending) => drop(ending.join()),
            Err(_) => std::process::exit(EXIT_PANICS),
        }
    }));
}

/// Rises while a thread lives.
#[derive(Debug, Default)]
pub struct Beat(AtomicU64);

impl Beat {
    /// Still here.
    pub fn beat(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// The threads that are watched.
#[derive(Debug, Default)]
pub struct Beats {
    /// Capture.
    pub capture: Beat,
    /// Vision.
    pub vision: Beat,
    /// PLC.
    pub plc: Beat,
}

/// Watches the threads and feeds the hardware's watchdog.
#[derive(Default)]
pub struct Watchdog {
    watches: bool,
    hardware: Option<File>,
    fed: Option<Instant>,
    /// What each beat was when it last rose, and when.
    seen: [Option<(u64, Instant)>; 3],
}

impl Watchdog {
    /// Watch from now on, and feed the watchdog of the hardware, for example `/dev/watchdog`.
    pub fn new(hardware: Option<&Path>) -> Result<Self> {
        let open = |path: &Path| {
            File::options().write(true).open(path).map_err(|e| {
                Error::failure(format!("cannot open the watchdog: {e}"))
                    .in_file(path)
                    .remedy("load the driver of the board's watchdog, or leave --watchdog out")
            })
        };
        Ok(Self { watches: true, hardware: hardware.map(open).transpose()?, ..Self::default() })
    }

    /// Look at the threads that are alive, in the order of [`Beats`]; does not return when one hangs.
    pub fn look(&mut self, beats: &Beats, alive: [bool; 3]) {
        if !self.watches {
            return;
        }
        let now = Instant::now();
        if let Some(name) = self.hanging(beats, alive, now) {
            tracing::error!("the {name} thread hangs: giving up, to be started again");
            std::thread::sleep(FAREWELL);
            // Joining it would hang too.
            std::process::exit(EXIT_HANGS);
        }
        if self.fed.is_none_or(|fed| now - fed >= FEEDING) {
            self.fed = Some(now);
            // Of systemd, if it started this program and waits for it.
            let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Watchdog]);
            if let Some(hardware) = &mut self.hardware {
                // It bites when this goes on failing: that is its purpose.
                let _ = hardware.write_all(b"\0");
            }
        }
    }

    /// The name of a thread that has not beaten for too long.
    fn hanging(&mut self, beats: &Beats, alive: [bool; 3], now: Instant) -> Option<&'static str> {
        let threads = [
            ("capture", &beats.capture, CAPTURE_PATIENCE),
            ("vision", &beats.vision, PATIENCE),
            ("PLC", &beats.plc, PATIENCE),
        ];
        let mut hanging = None;
        for (((name, beat, patience), seen), alive) in
            threads.into_iter().zip(&mut self.seen).zip(alive)
        {
            // One that has ended does not hang.
            if !alive {
                continue;
            }
            let count = beat.0.load(Ordering::Relaxed);
            match seen {
                Some((last, at)) if *last == count => {
                    if now.saturating_duration_since(*at) > patience {
                        hanging = Some(name);
                    }
                }
                _ => *seen = Some((count, now)),
            }
        }
        hanging
    }

    /// The program ends in order: the machine need not be restarted.
    pub fn disarm(&mut self) {
        if self.watches {
            let _ = sd_notify::notify(&[NotifyState::Stopping]);
        }
        if let Some(hardware) = &mut self.hardware {
            // The kernel's sign for it (Documentation/watchdog/watchdog-api.rst).
            let _ = hardware.write_all(b"V");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_stands_still_is_named_and_one_that_beats_is_not() {
        let (beats, start) = (Beats::default(), Instant::now());
        let mut watchdog = Watchdog::new(None).expect("no hardware");
        for s in 0..30 {
            beats.capture.beat();
            beats.plc.beat();
            if s < 12 {
                beats.vision.beat();
            }
            let hanging = watchdog.hanging(&beats, [true; 3], start + Duration::from_secs(s));
            // Its last beat was seen at 11 s.
            assert_eq!(hanging, (s > 21).then_some("vision"), "at {s} s");
            let ended =
                watchdog.hanging(&beats, [true, false, true], start + Duration::from_secs(s));
            assert_eq!(ended, None, "it has ended");
        }
    }

    #[test]
    fn the_hardware_is_fed_once_a_second_and_disarmed_at_the_end() {
        let path = std::env::temp_dir().join(format!("beltgauge-watchdog-{}", std::process::id()));
        std::fs::write(&path, "").expect("writable");
        let mut watchdog = Watchdog::new(Some(&path)).expect("there");
        let beats = Beats::default();
        (0..5).for_each(|_| watchdog.look(&beats, [true; 3]));
        watchdog.disarm();
        assert_eq!(std::fs::read(&path).expect("readable"), b"\0V");
        let _ = std::fs::remove_file(&path);
        let error = Watchdog::new(Some(&path)).err().expect("gone").to_string();
        assert!(error.contains("--watchdog"), "{error}");
    }
}
