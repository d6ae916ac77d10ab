//! How the vision threads get their processors: `[realtime]` of the configuration.

use crate::config::Realtime;
use crate::error::{Error, Result};
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_setaffinity};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Lock all memory, now and later, if so configured.
pub fn lock_memory(settings: &Realtime) -> Result<()> {
    if !settings.lock_memory {
        return Ok(());
    }
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).map_err(|e| {
        not_permitted("realtime.lock_memory = true", e)
            .remedy("give the process CAP_IPC_LOCK or raise its memlock limit, or set it to false")
    })
}

/// Priority and processor of the calling thread, the `worker`th of the vision threads.
pub fn enter(settings: &Realtime, worker: usize) -> Result<()> {
    if let Some(first) = settings.first_processor {
        let processor = first + worker;
        let mut set = CpuSet::new();
        if processor < CpuSet::MAX_CPU {
            set.set(processor);
        }
        sched_setaffinity(None, &set).map_err(|e| {
            not_permitted(&format!("realtime.first_processor = {first}, processor {processor}"), e)
                .allowed("a processor of this machine for each of realtime.workers")
                .remedy("choose a lower one, or fewer workers")
        })?;
    }
    if settings.priority > 0 {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let value = settings.priority.try_into().map(ThreadPriority::Crossplatform);
        let set = value.and_then(|priority| {
            set_thread_priority_and_policy(thread_native_id(), priority, policy)
                .map_err(|e| format!("{e:?}"))
        });
        set.map_err(|e| {
            not_permitted(&format!("realtime.priority = {}", settings.priority), e)
                .remedy("give the process CAP_SYS_NICE or an rtprio limit, or set it to 0")
        })?;
    }
    Ok(())
}

fn not_permitted(what: &str, why: impl std::fmt::Display) -> Error {
    Error::failure(format!("{what} cannot be had: {why}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_asked_for_is_always_permitted() {
        assert!(lock_memory(&Realtime::default()).is_ok());
        assert!(enter(&Realtime::default(), 0).is_ok());
    }

    #[test]
    fn a_processor_that_is_not_there_is_refused_and_named() {
        let settings = Realtime { first_processor: Some(1000), ..Realtime::default() };
        let error = std::thread::spawn(move || enter(&settings, 1)).join().expect("no panic");
        let text = error.expect_err("no machine has as many").to_string();
        assert!(text.contains("realtime.first_processor = 1000, processor 1001"), "{text}");
    }
}
