//! The emulated machine: QEMU with Debian's kernel, two Kvaser CAN cards on one bus, a virtual CAN
//! bus, and the static binaries. See `hil/machine`.

use crate::shell::Shell;
use std::net::{SocketAddr, TcpListener};
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A running machine; dropped, it is switched off.
pub struct Machine {
    shell: Shell,
    /// Where port 1502 of the machine is reached.
    pub modbus: SocketAddr,
}

/// The appliance and its peer on the CAN bus.
fn binaries() -> [PathBuf; 2] {
    let peer = ["--package", "hil", "--no-default-features", "--bin", "can_bench"];
    [crate::beltgauge(), crate::static_binary("can_bench", &peer)]
}

impl Machine {
    /// Build what is needed and boot.
    ///
    /// # Panics
    /// When it does not boot: then no test makes sense.
    pub fn boot() -> Self {
        let out = super::project().join("target/hil-out/machine");
        let made = Command::new(super::project().join("hil/machine/make"))
            .arg(&out)
            .args(binaries())
            .status()
            .expect("hil/machine/make is there");
        assert!(made.success(), "the initramfs cannot be made");
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let modbus = free.local_addr().expect("bound");
        drop(free);
        let shell = Shell::start(Self::command(&out, modbus));
        shell.ready();
        Self { shell, modbus }
    }

    fn command(out: &Path, modbus: SocketAddr) -> Command {
        let mut command = Command::new("qemu-system-x86_64");
        command
            .current_dir(out)
            // One processor: QEMU's CAN bus takes no time, and a receiver that another processor must
            // first wake for overruns its 64 bytes, which no bus of 500 kbit/s would do to it.
            .args(["-accel", "tcg", "-cpu", "max", "-smp", "1", "-m", "512"])
            .args(["-kernel", "vmlinuz", "-initrd", "initramfs.gz"])
            .args(["-append", "console=ttyS0 quiet panic=-1"])
            .args(["-display", "none", "-monitor", "none", "-no-reboot"])
            .args(["-serial", "file:console.log", "-serial", "stdio"])
            .args(["-object", "can-bus,id=bus0"])
            .args(["-device", "kvaser_pci,canbus=bus0", "-device", "kvaser_pci,canbus=bus0"])
            .args(["-nic", &format!("user,model=virtio-net-pci,hostfwd=tcp:{modbus}-:1502")]);
        command
    }
}

impl Deref for Machine {
    type Target = Shell;
    fn deref(&self) -> &Shell {
        &self.shell
    }
}

impl DerefMut for Machine {
    fn deref_mut(&mut self) -> &mut Shell {
        &mut self.shell
    }
}
