//! Events: what began, ended or happened, told once.

use super::insight::PlcSide;
use crate::plc::link::Commanded;
use crate::web::Event;
use std::time::{Duration, Instant};

/// What comes and goes more often than this is told as one.
const SETTLE: Duration = Duration::from_secs(2);
/// A machine that starts has no frames yet: that is no news.
const STARTING: Duration = Duration::from_secs(3);
/// The codes of "no frames arrive" and "the belt is being learned".
const OF_STARTING: [u16; 2] = [2, 8];

/// Finds what is new.
pub struct News {
    started: Instant,
    /// What is the case, and when it last was.
    holding: Vec<(u16, Instant)>,
    camera_losses: u64,
    imports: Option<u16>,
}

/// A command of the PLC.
pub fn command(utc_ms: u64, given: &Commanded) -> Event {
    let detail = format!(
        "{}: ticket {}, argument {}, result {}",
        given.sender, given.ticket, given.argument, given.outcome
    );
    event(utc_ms, "command", u32::from(given.command), detail)
}

/// An event that has no number yet.
pub fn event(utc_ms: u64, kind: &'static str, code: u32, detail: String) -> Event {
    Event { n: 0, utc_ms, kind, code, detail }
}

impl News {
    /// Nothing has happened.
    pub fn new(now: Instant) -> Self {
        Self { started: now, holding: Vec::new(), camera_losses: 0, imports: None }
    }

    /// What is new since it last looked.
    pub fn look(&mut self, plc: &PlcSide, utc_ms: u64, now: Instant) -> Vec<Event> {
        let mut news = Vec::new();
        if !plc.is_known() {
            return news;
        }
        let mut tell = |kind, code, detail| news.push(event(utc_ms, kind, code, detail));
        let status = &plc.status;
        let starting = now - self.started < STARTING;
        for code in status.reasons().filter(|code| !(starting && OF_STARTING.contains(code))) {
            if let Some((_, last)) = self.holding.iter_mut().find(|(known, _)| *known == code) {
                *last = now;
            } else {
                self.holding.push((code, now));
                tell("began", u32::from(code), String::new());
            }
        }
        self.holding.retain(|(code, last)| {
            let holds = now - *last < SETTLE;
            if !holds {
                tell("ended", u32::from(*code), String::new());
            }
            holds
        });
        if status.vision.camera_losses > self.camera_losses {
            tell("camera_lost", status.vision.camera_losses as u32, String::new());
        }
        self.camera_losses = status.vision.camera_losses;
        let import = status.vision.import;
        if self.imports.is_some_and(|known| known != import.count) {
            tell("import", u32::from(import.result), String::new());
        }
        self.imports = Some(import.count);
        news
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::command::Sender;
    use crate::run::desk::insight::tests::insight;

    fn plc() -> PlcSide {
        let mut plc = insight().plc_side();
        plc.told_utc_ms = 1;
        plc.status.running = true;
        plc.status.vision.ready = true;
        plc
    }

    #[test]
    fn what_flickers_is_told_once_and_what_ends_is_told_when_it_has_settled() {
        let start = Instant::now();
        let (mut news, mut plc) = (News::new(start), plc());
        let mut told = Vec::new();
        for tick in 0..100u32 {
            plc.status.plc_silent = tick < 50 && tick % 3 == 0;
            let now = start + tick * Duration::from_millis(100);
            told.extend(news.look(&plc, 0, now).iter().map(|e| (e.kind, e.code, tick)));
        }
        assert_eq!(told, [("began", 7, 0), ("ended", 7, 68)]);
    }

    #[test]
    fn a_command_is_told_with_its_sender() {
        let given =
            Commanded { sender: Sender::Can, ticket: 10, command: 5, argument: 50, outcome: 1 };
        let told = command(7, &given);
        assert_eq!((told.kind, told.code, told.utc_ms), ("command", 5, 7));
        assert_eq!(told.detail, "CAN: ticket 10, argument 50, result 1");
    }

    #[test]
    fn what_was_before_the_start_is_no_news() {
        let start = Instant::now();
        let (mut news, mut side) = (News::new(start), insight().plc_side());
        assert!(news.look(&side, 0, start).is_empty(), "nothing is known yet");
        (side.told_utc_ms, side.status.running, side.status.vision.ready) = (1, true, true);
        side.status.vision.import.count = 3;
        assert!(news.look(&side, 0, start).is_empty(), "imported before");
        side.status.vision.import.count = 4;
        assert_eq!(news.look(&side, 0, start).len(), 1);
    }
}
