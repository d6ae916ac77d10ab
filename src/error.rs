//! The one error type: what, where, the allowed range and the remedy.

use std::fmt;
use std::path::Path;

/// Result with the crate's error.
pub type Result<T> = std::result::Result<T, Error>;

/// Whose turn it is to act, and so the exit status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ErrorKind {
    /// The command line, a configuration or a calibration is wrong: exit status 2.
    Configuration,
    /// Input, device or system failed while working: exit status 1.
    Failure,
}

/// An error as its reader needs it. Built once, where the facts are known.
#[derive(Clone, Debug)]
pub struct Error(Box<Parts>);

#[derive(Clone, Debug)]
struct Parts {
    kind: ErrorKind,
    what: String,
    place: String,
    allowed: String,
    remedy: String,
}

impl Error {
    /// A wrong setting: `what` names the key and the value found.
    pub fn configuration(what: impl Into<String>) -> Self {
        Self::new(ErrorKind::Configuration, what.into())
    }

    /// Something that failed at run time.
    pub fn failure(what: impl Into<String>) -> Self {
        Self::new(ErrorKind::Failure, what.into())
    }

    fn new(kind: ErrorKind, what: String) -> Self {
        let (place, allowed, remedy) = Default::default();
        Self(Box::new(Parts { kind, what, place, allowed, remedy }))
    }

    /// The file, frame, line or address concerned. The innermost caller that knows it wins.
    #[must_use]
    pub fn at(mut self, place: impl fmt::Display) -> Self {
        if self.0.place.is_empty() {
            self.0.place = place.to_string();
        }
        self
    }

    /// [`Error::at`] for a file.
    #[must_use]
    pub fn in_file(self, path: &Path) -> Self {
        self.at(path.display())
    }

    /// What would have been accepted.
    #[must_use]
    pub fn allowed(mut self, allowed: impl Into<String>) -> Self {
        self.0.allowed = allowed.into();
        self
    }

    /// What the reader should do.
    #[must_use]
    pub fn remedy(mut self, remedy: impl Into<String>) -> Self {
        self.0.remedy = remedy.into();
        self
    }

    /// The process exit status that the command line promises.
    pub fn exit_status(&self) -> u8 {
        match self.0.kind {
            ErrorKind::Configuration => 2,
            ErrorKind::Failure => 1,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0.what)?;
        let lines =
            [("where", &self.0.place), ("allowed", &self.0.allowed), ("remedy", &self.0.remedy)];
        for (label, text) in lines.into_iter().filter(|(_, text)| !text.is_empty()) {
            write!(f, "\n  {label:8}{text}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Error {}
