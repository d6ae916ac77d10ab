//! The emulated machine: QEMU with Debian's kernel, two Kvaser CAN cards on one bus, a virtual CAN
//! bus, and the static binaries. See `hil/machine`.

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

/// The triple that the static binaries are built for.
const TARGET: &str = "x86_64-unknown-linux-gnu";
/// Emulation without acceleration boots in 8 to 25 s.
const PATIENCE: Duration = Duration::from_mins(3);

/// A running machine; dropped, it is switched off.
pub struct Machine {
    child: Child,
    shell: ChildStdin,
    lines: Receiver<String>,
    /// Where port 1502 of the machine is reached.
    pub modbus: SocketAddr,
}

/// Build the appliance and the programs of this package statically; returns their paths.
fn static_binaries() -> [PathBuf; 2] {
    let build = |arguments: &[&str]| {
        let status = Command::new(env!("CARGO"))
            .args(["build", "--release", "--target", TARGET])
            .args(arguments)
            .env("RUSTFLAGS", "-C target-feature=+crt-static")
            .current_dir(super::project())
            .status()
            .expect("cargo runs");
        assert!(status.success(), "the static binaries do not build");
    };
    build(&["--package", "beltgauge"]);
    build(&["--package", "hil", "--no-default-features", "--bin", "can_bench"]);
    let folder = super::project().join("target").join(TARGET).join("release");
    ["beltgauge", "can_bench"].map(|name| folder.join(name))
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
            .args(static_binaries())
            .status()
            .expect("hil/machine/make is there");
        assert!(made.success(), "the initramfs cannot be made");
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let modbus = free.local_addr().expect("bound");
        drop(free);
        let mut child = Self::command(&out, modbus)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("qemu-system-x86_64 is installed");
        let shell = child.stdin.take().expect("piped");
        let output = BufReader::new(child.stdout.take().expect("piped"));
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            // Lines until the machine is switched off.
            for line in output.split(b'\n').map_while(Result::ok) {
                let line = String::from_utf8_lossy(&line).trim_end().to_owned();
                if sender.send(line).is_err() {
                    break;
                }
            }
        });
        let machine = Self { child, shell, lines, modbus };
        machine.answer();
        machine
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

    /// Lines up to the status that ends an answer.
    fn answer(&self) -> (String, String) {
        let mut text = String::new();
        loop {
            match self.lines.recv_timeout(PATIENCE) {
                Ok(line) => match line.strip_prefix("== ") {
                    Some(status) => return (text, status.to_owned()),
                    None => text.extend([line.as_str(), "\n"]),
                },
                Err(RecvTimeoutError::Timeout) => panic!("the machine does not answer: {text}"),
                Err(RecvTimeoutError::Disconnected) => panic!("the machine has stopped: {text}"),
            }
        }
    }

    /// Run a line in the machine's shell; returns what it printed and its exit status.
    ///
    /// # Panics
    /// When the machine does not answer.
    pub fn try_run(&mut self, line: &str) -> (String, String) {
        writeln!(self.shell, "{line}").expect("the machine runs");
        self.answer()
    }

    /// The same for a line that must succeed.
    ///
    /// # Panics
    /// When it fails.
    pub fn run(&mut self, line: &str) -> String {
        let (text, status) = self.try_run(line);
        assert_eq!(status, "0", "{line}: {text}");
        text
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
