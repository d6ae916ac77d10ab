//! The names of what is told, and of what is listened to.

/// What all names begin with.
const ROOT: &str = "beltgauge";

/// The topics of a lane.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    lane: String,
}

impl Topics {
    /// Of a lane of a site.
    pub fn new(site: &str, lane: &str) -> Self {
        Self { lane: format!("{ROOT}/{site}/{lane}") }
    }

    fn of(&self, what: &str) -> String {
        format!("{}/{what}", self.lane)
    }

    /// Whether it is there, retained.
    pub fn state(&self) -> String {
        self.of("state")
    }

    /// Parcels.
    pub fn parcel(&self) -> String {
        self.of("parcel")
    }

    /// Its condition, every few seconds.
    pub fn health(&self) -> String {
        self.of("health")
    }

    /// What happened.
    pub fn event(&self) -> String {
        self.of("event")
    }

    /// The only one that it listens to.
    pub fn replay(&self) -> String {
        self.of("cmd/replay")
    }
}
