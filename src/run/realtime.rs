//! How the vision threads get their processors: `[realtime]` of the configuration.

use crate::config::Realtime;
use crate::error::{Error, Result};
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::setpriority_process;
use rustix::thread::{CpuSet, gettid, sched_setaffinity};
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

/// The niceness of threads that nobody waits for.
const NICE: i32 = 10;

/// The calling thread leaves the processor to those that measure.
pub fn stand_back() {
    // Where it may not, the threads share as equals.
    let _ = setpriority_process(Some(gettid()), NICE);
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
    use rustix::mm::munlockall;
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    use rustix::thread::{CapabilitySet, capabilities, set_capabilities};

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

    /// Call on a thread of its own that lacks these capabilities.
    fn without<T: Send>(lost: CapabilitySet, call: impl FnOnce() -> T + Send) -> T {
        let call = || {
            let mut sets = capabilities(None).expect("Linux");
            sets.effective -= lost;
            set_capabilities(None, sets).expect("fewer are always permitted");
            call()
        };
        std::thread::scope(|scope| scope.spawn(call).join().expect("no panic"))
    }

    fn may(capability: CapabilitySet) -> bool {
        capabilities(None).expect("Linux").effective.contains(capability)
    }

    #[test]
    fn a_priority_is_had_with_the_permission_and_refused_without() {
        let settings = Realtime { priority: 10, ..Realtime::default() };
        let refused = without(CapabilitySet::SYS_NICE, || {
            setrlimit(Resource::Rtprio, Rlimit { current: Some(0), maximum: Some(0) })
                .expect("less is always permitted");
            enter(&settings, 0)
        });
        let text = refused.expect_err("not permitted").to_string();
        assert!(text.contains("realtime.priority = 10"), "{text}");
        assert!(text.contains("CAP_SYS_NICE"), "{text}");
        if may(CapabilitySet::SYS_NICE) {
            let policy = std::thread::scope(|scope| {
                let entered = scope.spawn(|| {
                    enter(&settings, 0).expect("permitted");
                    thread_priority::thread_schedule_policy().expect("known")
                });
                entered.join().expect("no panic")
            });
            let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
            assert_eq!(policy, fifo);
        }
    }

    #[test]
    fn memory_is_locked_with_the_permission_and_refused_without() {
        let settings = Realtime { lock_memory: true, ..Realtime::default() };
        let before = getrlimit(Resource::Memlock);
        setrlimit(Resource::Memlock, Rlimit { current: Some(0), ..before }).expect("less");
        let refused = without(CapabilitySet::IPC_LOCK, || lock_memory(&settings));
        setrlimit(Resource::Memlock, before).expect("as before");
        let text = refused.expect_err("not permitted").to_string();
        assert!(text.contains("realtime.lock_memory") && text.contains("CAP_IPC_LOCK"), "{text}");
        if may(CapabilitySet::IPC_LOCK) {
            lock_memory(&settings).expect("permitted");
            let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
            let locked = status.lines().find(|line| line.starts_with("VmLck:")).expect("Linux");
            munlockall().expect("unlocks");
            assert!(!locked.ends_with(" 0 kB"), "{locked}");
        }
    }
}
