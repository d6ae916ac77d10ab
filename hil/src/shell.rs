//! A running QEMU machine with a shell on a serial port: a line in, its output and "== STATUS" out.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

/// Emulation without acceleration boots in 8 to 40 s.
const PATIENCE: Duration = Duration::from_mins(3);

/// The machine; dropped, its power is cut.
pub struct Shell {
    child: Child,
    input: ChildStdin,
    lines: Receiver<String>,
}

impl Shell {
    /// Start a machine whose shell is on standard input and output.
    ///
    /// # Panics
    /// When QEMU is not installed.
    pub fn start(mut qemu: Command) -> Self {
        let mut child = qemu
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap_or_else(|e| panic!("{qemu:?}: {e}"));
        let input = child.stdin.take().expect("piped");
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
        Self { child, input, lines }
    }

    /// Output up to the line that ends an answer, and the status in that.
    ///
    /// # Panics
    /// When the machine does not answer.
    pub fn answer(&self) -> (String, String) {
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

    /// Wait until the shell says that it is there, as after a start.
    ///
    /// # Panics
    /// When it does not.
    pub fn ready(&self) {
        while self.answer().1 != "ready" {}
    }

    /// Run a line; returns what it printed and its exit status.
    ///
    /// # Panics
    /// When the machine does not answer.
    pub fn try_run(&mut self, line: &str) -> (String, String) {
        writeln!(self.input, "{line}").expect("the machine runs");
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

impl Drop for Shell {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
