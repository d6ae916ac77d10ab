//! The log at a site's collector: rsyslog, which parses every message, and is away for a while.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::{fs, net::UdpSocket};

/// What rsyslog has understood, a line a message.
const LINE: &str =
    "%pri-text% %protocol-version% %app-name% %procid% %timestamp:::date-rfc3339% %msg%\\n";

struct Collector(Child);

impl Collector {
    fn start(folder: &Path, port: u16) -> Self {
        let (configuration, log) = (folder.join("rsyslog.conf"), folder.join("collected"));
        let text = format!(
            "global(workDirectory=\"{0}\")\nmodule(load=\"imudp\")\n\
             input(type=\"imudp\" address=\"127.0.0.1\" port=\"{port}\")\n\
             template(name=\"line\" type=\"string\" string=\"{LINE}\")\n\
             action(type=\"omfile\" file=\"{1}\" template=\"line\")\n",
            folder.display(),
            log.display()
        );
        fs::write(&configuration, text).expect("room");
        let child = Command::new("rsyslogd")
            .arg("-n")
            .arg("-f")
            .arg(&configuration)
            .arg("-i")
            .arg(folder.join("rsyslog.pid"))
            .stdout(Stdio::null())
            .spawn()
            .expect("apt-get install rsyslog");
        // Its port is its own now.
        hil::wait_for("rsyslog", || UdpSocket::bind(("127.0.0.1", port)).is_err().then_some(()));
        Self(child)
    }
}

impl Drop for Collector {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn collected(folder: &Path, words: &str) -> String {
    hil::wait_for(words, || {
        let text = fs::read_to_string(folder.join("collected")).unwrap_or_default();
        text.lines().find(|line| line.contains(words)).map(str::to_owned)
    })
}

#[test]
fn rsyslog_understands_every_line_and_may_go_away_and_come_back() {
    let folder = hil::fleet::folder("syslog");
    let free = UdpSocket::bind("127.0.0.1:0").expect("a free port");
    let port = free.local_addr().expect("bound").port();
    drop(free);
    let collector = Collector::start(&folder, port);
    for name in ["beltgauge.toml", "camera.toml"] {
        let example = hil::project().join("config/example").join(name);
        fs::copy(example, folder.join(name)).expect("committed");
    }
    let config = folder.join("beltgauge.toml");
    let text = fs::read_to_string(&config).expect("there");
    let more = format!(
        "\n[modbus]\nlisten = \"127.0.0.1:0\"\n[web]\nenabled = false\n[log]\nsyslog = \"127.0.0.1:{port}\"\n"
    );
    fs::write(&config, text + &more).expect("room");
    let mut appliance = Command::new(hil::beltgauge())
        .args(["run", "--config"])
        .arg(&config)
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let line = collected(&folder, "no camera");
    let process = appliance.id();
    assert!(line.starts_with(&format!("daemon.err 1 beltgauge {process} 20")), "{line}");
    drop(collector);
    let _collector = Collector::start(&folder, port);
    hil::fleet::signal(&appliance, rustix::process::Signal::TERM);
    assert!(appliance.wait().expect("a child").success());
    let line = collected(&folder, "stopped");
    assert!(line.starts_with(&format!("daemon.info 1 beltgauge {process} 20")), "{line}");
}
