//! Root's rights, given up but for what the appliance needs.

use crate::error::{Error, Result};
use rustix::thread::{
    CapabilitySet, CapabilitySets, set_capabilities, set_keep_capabilities, set_no_new_privs,
    set_thread_gid, set_thread_groups, set_thread_uid,
};
use rustix::thread::{Gid, Uid};

/// Modbus's port 502, bit rates of CAN, real-time priority, locked memory.
const KEPT: CapabilitySet = CapabilitySet::NET_BIND_SERVICE
    .union(CapabilitySet::NET_ADMIN)
    .union(CapabilitySet::SYS_NICE)
    .union(CapabilitySet::IPC_LOCK);

/// Become user and group `id`, for good. Called while the process has one thread: the kernel knows
/// users of threads only.
pub fn become_user(id: u32) -> Result<()> {
    let (uid, gid) = (Uid::from_raw(id), Gid::from_raw(id));
    let kept =
        CapabilitySets { effective: KEPT, permitted: KEPT, inheritable: CapabilitySet::empty() };
    set_keep_capabilities(true)
        .and_then(|()| set_thread_groups(&[]))
        .and_then(|()| set_thread_gid(gid))
        .and_then(|()| set_thread_uid(uid))
        .and_then(|()| set_capabilities(None, kept))
        .and_then(|()| set_no_new_privs(true))
        .map_err(|e| {
            Error::failure(format!("--user {id}: cannot become that user: {e}"))
                .remedy("start it as root, or leave --user out")
        })
}
