//! Four lamps from the codes of what is the case, after NAMUR NE 107: what it means for the results.

use crate::plc::registers::Status;
use crate::web::Lamp;

/// Which lamp a code lights: `None` lets `running` go out without any other.
pub const LAMPS: [(u16, Option<&str>); 25] = [
    (1, Some(FAILURE)),
    (2, Some(FAILURE)),
    (3, Some(FAILURE)),
    (4, Some(FAILURE)),
    (12, Some(FAILURE)),
    (7, Some(FAILURE)),
    (22, Some(FAILURE)),
    (24, Some(FAILURE)),
    (10, Some(MAINTENANCE)),
    (11, Some(MAINTENANCE)),
    (13, Some(MAINTENANCE)),
    (14, Some(MAINTENANCE)),
    (5, Some(MAINTENANCE)),
    (6, Some(MAINTENANCE)),
    (15, Some(MAINTENANCE)),
    (20, Some(MAINTENANCE)),
    (21, Some(MAINTENANCE)),
    (23, Some(MAINTENANCE)),
    (25, Some(MAINTENANCE)),
    (16, Some(UNCERTAIN)),
    (17, Some(UNCERTAIN)),
    (18, Some(UNCERTAIN)),
    (19, Some(UNCERTAIN)),
    (8, None),
    (9, None),
];

const RUNNING: &str = "running";
const UNCERTAIN: &str = "uncertain";
const MAINTENANCE: &str = "maintenance";
const FAILURE: &str = "failure";
/// Frames do not come, so nothing runs.
const STANDS: [u16; 3] = [1, 2, 12];

/// The lamps, each with the reasons why it is lit; `running` with those why it is not.
pub fn lamps(status: &Status) -> Vec<Lamp> {
    let reasons: Vec<u16> = status.reasons().collect();
    let lamp_of = |code: u16| LAMPS.iter().find(|(known, _)| *known == code).and_then(|(_, l)| *l);
    let is_idle = |code: u16| STANDS.contains(&code) || lamp_of(code).is_none();
    let idle: Vec<u16> = reasons.iter().copied().filter(|code| is_idle(*code)).collect();
    let mut lamps = vec![Lamp { name: RUNNING, on: idle.is_empty(), reasons: idle }];
    for name in [UNCERTAIN, MAINTENANCE, FAILURE] {
        let reasons: Vec<u16> =
            reasons.iter().copied().filter(|code| lamp_of(*code) == Some(name)).collect();
        lamps.push(Lamp { name, on: !reasons.is_empty(), reasons });
    }
    lamps
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plc::codes::REASONS;

    #[test]
    fn every_reason_lights_a_lamp_or_puts_one_out() {
        for (code, _, meaning) in REASONS.iter().skip(1) {
            let known = LAMPS.iter().filter(|(known, _)| known == code).count();
            assert_eq!(known, 1, "{code}: {meaning}");
        }
    }

    #[test]
    fn lamps_say_why() {
        let mut status = Status { running: true, ..Status::default() };
        let lit = |status: &Status| {
            let lamps = lamps(status);
            lamps.iter().filter(|l| l.on).map(|l| l.name).collect::<Vec<_>>()
        };
        assert!(lit(&status).is_empty(), "the belt is being learned");
        status.vision.ready = true;
        assert_eq!(lit(&status), [RUNNING]);
        status.vision.belt.ambiguous = true;
        status.encoder_silent = true;
        assert_eq!(lit(&status), [RUNNING, UNCERTAIN, MAINTENANCE]);
        status.vision.camera_absent = true;
        assert_eq!(lit(&status), [UNCERTAIN, MAINTENANCE, FAILURE]);
        assert_eq!(lamps(&status)[0].reasons, [12]);
    }
}
