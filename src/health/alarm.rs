//! From a measured figure to a level that does not flap.

/// A level falls back only below this share of its limit.
const CLEARED: f64 = 0.7;

/// How bad a figure is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// As it should be.
    #[default]
    Good,
    /// Somebody should look after it.
    Warning,
    /// What is measured is wrong.
    Fault,
}

/// A level with its memory: it changes when two figures in a row say so.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Alarm {
    level: Level,
    wanted: Option<Level>,
}

impl Alarm {
    /// The next figure, and from where on it is a warning and a fault.
    pub(super) fn judge(&mut self, figure: f64, [warning, fault]: [f64; 2]) {
        let limit = |level: Level, limit: f64| {
            if self.level >= level { CLEARED * limit } else { limit }
        };
        let wanted = if figure >= limit(Level::Fault, fault) {
            Level::Fault
        } else if figure >= limit(Level::Warning, warning) {
            Level::Warning
        } else {
            Level::Good
        };
        // A fault that was seen after a warning confirms that warning.
        let confirmed = self.wanted.map_or(self.level, |before| {
            if wanted > self.level {
                before.min(wanted).max(self.level)
            } else {
                before.max(wanted)
            }
        });
        self.level = if wanted == self.level { self.level } else { confirmed };
        self.wanted = Some(wanted);
    }

    pub(super) fn level(self) -> Level {
        self.level
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn levels(figures: &[f64]) -> Vec<Level> {
        let mut alarm = Alarm::default();
        let mut judged = |figure: &f64| {
            alarm.judge(*figure, [1.0, 5.0]);
            alarm.level()
        };
        figures.iter().map(&mut judged).collect()
    }

    #[test]
    fn one_figure_alone_changes_nothing() {
        use Level::{Fault, Good, Warning};
        assert_eq!(levels(&[0.1, 9.0, 0.1, 9.0, 0.2]), [Good; 5]);
        assert_eq!(levels(&[0.1, 9.0, 9.0, 0.1, 9.0]), [Good, Good, Fault, Fault, Fault]);
        assert_eq!(levels(&[2.0, 9.0, 9.0]), [Good, Warning, Fault]);
        assert_eq!(levels(&[9.0, 9.0, 2.0, 0.1, 0.1]), [Good, Fault, Fault, Warning, Good]);
    }

    #[test]
    fn a_figure_about_a_limit_does_not_flap() {
        let told = levels(&[0.9, 1.1, 1.1, 0.9, 0.9, 1.1, 0.8, 0.75]);
        assert_eq!(told[2..], [Level::Warning; 6]);
        assert_eq!(levels(&[1.1, 1.1, 0.6, 0.6])[3], Level::Good);
    }
}
