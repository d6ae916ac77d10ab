//! Hardware in the loop without hardware: the real binary, and peers that the project did not
//! write. Here is what its tests share; the tests are in `hil/tests`.

pub mod allocations;
pub mod appliance;
pub mod browser;
pub mod can_peer;
pub mod fleet;
pub mod machine;
#[cfg(feature = "opencv")]
pub mod opencv_chain;
pub mod plc;
pub mod scene;
pub mod server;
pub mod shell;

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Nothing a test waits for takes longer.
const PATIENCE: Duration = Duration::from_mins(1);

/// The project's folder.
pub fn project() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The triple that is tested: this machine's own.
const TARGET: &str = if cfg!(target_arch = "aarch64") {
    "aarch64-unknown-linux-gnu"
} else {
    "x86_64-unknown-linux-gnu"
};

/// Build the appliance, if need be, as `board/build` does for the image (optimised and static), and
/// return its path.
///
/// # Panics
/// When it does not build: then no test makes sense.
pub fn beltgauge() -> PathBuf {
    static_binary("beltgauge", &["--package", "beltgauge"])
}

/// Build a static program and return its path.
fn static_binary(name: &str, arguments: &[&str]) -> PathBuf {
    let folder = project().join("target");
    let mut cargo = Command::new(env!("CARGO"));
    // What this test is called is none of the build's business: build scripts would run again, and all after them.
    for (name, _) in std::env::vars_os() {
        if ["CARGO_PKG_", "CARGO_MANIFEST_"].iter().any(|of| name.to_string_lossy().starts_with(of))
        {
            cargo.env_remove(name);
        }
    }
    let status = cargo
        .args(["build", "--release", "--locked", "--target", TARGET, "--target-dir"])
        .arg(&folder)
        .args(arguments)
        .env("RUSTFLAGS", "-C target-feature=+crt-static")
        .current_dir(project())
        .status()
        .expect("cargo runs");
    assert!(status.success(), "{name} does not build");
    folder.join(TARGET).join("release").join(name)
}

/// A demo that runs until it is dropped or has ended.
pub struct Demo {
    child: Child,
    /// Where its Modbus server listens.
    pub address: SocketAddr,
    /// Where its page is served.
    pub page: SocketAddr,
    /// Its output folder.
    pub out: PathBuf,
}

impl Demo {
    /// Start a demo of `seconds` on a free port; `pin`: on the first processor alone.
    ///
    /// # Panics
    /// When it does not start or its server does not answer.
    pub fn start(name: &str, seconds: u32, pin: bool) -> Self {
        Self::start_with(name, seconds, pin, &[])
    }

    /// The same with more arguments.
    ///
    /// # Panics
    /// When it does not start or its server does not answer.
    pub fn start_with(name: &str, seconds: u32, pin: bool, more: &[&str]) -> Self {
        let binary = beltgauge();
        let free = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("a free port"));
        let [address, page] = free.each_ref().map(|socket| socket.local_addr().expect("bound"));
        drop(free);
        let out = project().join("target/hil-out").join(name);
        let _ = std::fs::remove_dir_all(&out);
        let mut command = if pin {
            let mut taskset = Command::new("taskset");
            taskset.args(["--cpu-list", "0"]).arg(binary);
            taskset
        } else {
            Command::new(binary)
        };
        let child = command
            .args([
                "demo",
                "--seconds",
                &seconds.to_string(),
                "--listen",
                &address.to_string(),
                "--page",
                &page.to_string(),
                "--out",
            ])
            .arg(&out)
            .args(more)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the demo starts");
        let mut demo = Self { child, address, page, out };
        wait_for("the Modbus server", || {
            assert!(demo.child.try_wait().expect("a child").is_none(), "the demo ended early");
            TcpStream::connect(address).ok()
        });
        demo
    }

    /// Peak resident memory so far, MiB; `None` when it has ended.
    pub fn peak_mib(&self) -> Option<f64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
        Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
    }

    /// Processor time used so far, in clock ticks of 10 ms; `None` when it has ended.
    pub fn processor_ticks(&self) -> Option<u64> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).ok()?;
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        Some(fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?)
    }

    /// Wait for its end; returns its records.
    ///
    /// # Panics
    /// When it fails.
    pub fn records(mut self) -> Vec<serde_json::Value> {
        assert!(self.child.wait().expect("a child").success(), "the demo failed");
        let text = std::fs::read_to_string(self.out.join("parcels.jsonl")).expect("written");
        text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Ask again and again until there is an answer.
///
/// # Panics
/// When there is none within a minute.
pub fn wait_for<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(start.elapsed() < PATIENCE, "waited a minute for {what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}
