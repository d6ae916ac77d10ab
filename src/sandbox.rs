//! Parsing what strangers bring, in a child process with little memory and time.
//!
//! A parser that is made to recurse or to allocate without end takes its process with it. Here that
//! is a child, the same program over again, and its end is an error that says how it ended. What
//! stays trusted: the kernel's limits, and that this process reads no more than it asked for.

use crate::error::{Error, Result};
use rustix::process::{Resource, Rlimit, setrlimit};
use std::ffi::OsStr;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// The hidden subcommand of the command line, with the task's name behind it.
pub const SUBCOMMAND: &str = "sandbox";
/// Longest line that a child writes.
pub const LINE_BYTES_MAX: usize = 64 << 10;
/// Processor time of a child: one that nobody waits for any more ends by itself.
const PROCESSOR_S: u64 = 60;
/// A child that has closed its end of the socket ends within this, or is ended.
const FAREWELL: Duration = Duration::from_secs(2);
/// What a child says as it dies is told up to this length.
const LAST_WORDS_MAX: usize = 300;
/// This very program, also when its file has been replaced by an update.
const THIS_PROGRAM: &str = "/proc/self/exe";

static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// Start children from this program file instead of the running one: for tests, which are none that
/// knows the subcommand. The first call counts.
pub fn use_program(path: PathBuf) {
    let _ = PROGRAM.set(path);
}

/// The file that children are started from.
pub fn program() -> &'static OsStr {
    PROGRAM.get().map_or(OsStr::new(THIS_PROGRAM), |path| path.as_os_str())
}

/// In the child, before anything is read: no more memory than this, no core file.
pub fn confine(memory_bytes: u64) -> Result<()> {
    let limits = [
        (Resource::As, memory_bytes),
        (Resource::Cpu, PROCESSOR_S),
        (Resource::Core, 0),
        (Resource::Fsize, 0),
    ];
    for (resource, limit) in limits {
        setrlimit(resource, Rlimit { current: Some(limit), maximum: Some(limit) })
            .map_err(|e| Error::failure(format!("cannot limit {resource:?}: {e}")))?;
    }
    Ok(())
}

/// A child at work; ended when dropped.
pub struct Sandbox {
    child: Child,
    stream: BufReader<UnixStream>,
    last_words: Option<ChildStderr>,
    task: &'static str,
}

impl Sandbox {
    /// Start a child that reads what this process writes to it.
    pub fn start(task: &'static str) -> Result<Self> {
        Self::spawn(task, None)
    }

    /// Start a child that reads a file.
    pub fn start_on(task: &'static str, file: File) -> Result<Self> {
        Self::spawn(task, Some(file))
    }

    fn spawn(task: &'static str, input: Option<File>) -> Result<Self> {
        let failed = |e: std::io::Error| {
            Error::failure(format!("cannot start the child process `{task}`: {e}"))
        };
        // Sockets, as they have timeouts and pipes have none.
        let (ours, theirs) = UnixStream::pair().map_err(failed)?;
        let theirs = OwnedFd::from(theirs);
        let input = match input {
            Some(file) => file.into(),
            None => theirs.try_clone().map_err(failed)?,
        };
        let mut child = Command::new(program())
            .args([SUBCOMMAND, task])
            .env_clear()
            .stdin(input)
            .stdout(theirs)
            .stderr(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let last_words = child.stderr.take();
        Ok(Self { child, stream: BufReader::new(ours), last_words, task })
    }

    /// Write a line to the child.
    pub fn write_line(&mut self, line: &str, until: Instant) -> Result<()> {
        let sent = remaining(until).and_then(|left| {
            let mut stream = self.stream.get_ref();
            stream.set_write_timeout(Some(left))?;
            stream.write_all(line.as_bytes()).and_then(|()| stream.write_all(b"\n"))
        });
        sent.map_err(|e| self.end(e.kind()))
    }

    /// The child's next line, without its end.
    pub fn read_line(&mut self, until: Instant) -> Result<String> {
        let mut line = Vec::new();
        loop {
            self.fill(until)?;
            let bytes = self.stream.buffer();
            let end = bytes.iter().position(|byte| *byte == b'\n');
            let taken = end.map_or(bytes.len(), |end| end + 1);
            line.extend_from_slice(&bytes[..end.unwrap_or(taken)]);
            self.stream.consume(taken);
            if line.len() > LINE_BYTES_MAX {
                return Err(self.end(ErrorKind::InvalidData));
            }
            if end.is_some() {
                return String::from_utf8(line).map_err(|_| self.end(ErrorKind::InvalidData));
            }
        }
    }

    /// Exactly so many bytes from the child.
    pub fn read_bytes(&mut self, count: usize, until: Instant) -> Result<Vec<u8>> {
        let mut read = Vec::new();
        while read.len() < count {
            self.fill(until)?;
            let bytes = self.stream.buffer();
            let taken = bytes.len().min(count - read.len());
            read.extend_from_slice(&bytes[..taken]);
            self.stream.consume(taken);
        }
        Ok(read)
    }

    /// Have something in the buffer.
    fn fill(&mut self, until: Instant) -> Result<()> {
        if !self.stream.buffer().is_empty() {
            return Ok(());
        }
        let filled = remaining(until)
            .and_then(|left| self.stream.get_ref().set_read_timeout(Some(left)))
            .and_then(|()| match self.stream.fill_buf()? {
                [] => Err(ErrorKind::UnexpectedEof.into()),
                _ => Ok(()),
            });
        filled.map_err(|e| self.end(e.kind()))
    }

    /// End the child; the error says how it ended.
    pub fn end(&mut self, why: ErrorKind) -> Error {
        let task = self.task;
        let late = matches!(why, ErrorKind::WouldBlock | ErrorKind::TimedOut);
        if late || why == ErrorKind::InvalidData {
            let _ = self.child.kill();
        }
        // One that has closed its end need not have ended.
        let begun = Instant::now();
        while matches!(self.child.try_wait(), Ok(None)) && begun.elapsed() < FAREWELL {
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = self.child.kill();
        let status = self.child.wait().map_or_else(|e| e.to_string(), |status| status.to_string());
        let mut said = Vec::new();
        if let Some(words) = self.last_words.take() {
            // It has ended: what it said is all there.
            let _ = words.take(4096).read_to_end(&mut said);
        }
        let said = printable(&String::from_utf8_lossy(&said));
        Error::failure(if late {
            format!("the child process `{task}` did not finish in time and was ended")
        } else if why == ErrorKind::InvalidData {
            format!("the child process `{task}` does not answer as it should")
        } else {
            format!("the child process `{task}` ended by itself, {status}: {said}")
        })
        .remedy("what it read is damaged or meant to harm: replace it")
    }
}

impl Drop for Sandbox {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn remaining(until: Instant) -> std::io::Result<Duration> {
    let left = until.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(ErrorKind::TimedOut.into()) } else { Ok(left) }
}

/// A stranger's words in one line of bounded length.
pub fn printable(text: &str) -> String {
    let clean: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let words = clean.split_whitespace().collect::<Vec<_>>().join(" ");
    words.chars().take(LAST_WORDS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strangers_words_fit_in_a_line_of_the_log() {
        assert_eq!(printable("a\n\x1b[31mb\t\0c  d"), "a [31mb c d");
        assert_eq!(printable(&"é".repeat(1000)).chars().count(), LAST_WORDS_MAX);
    }
}
