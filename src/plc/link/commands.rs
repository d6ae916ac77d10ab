//! What a PLC writes: the command block's registers, acknowledgments, commands.

use super::{Commanded, Decided, Link, REQUESTS_MAX};
use crate::plc::command::{Outcome, Request, Sender};
use crate::plc::journal::{Override, is_after};
use crate::plc::registers::{COMMAND, COMMAND_COUNT, COMMAND_FIELDS, CommandBlock};
use crate::plc::table::join;
use std::time::Instant;

/// Largest scale interval that a command may set, tenths of a mm.
const SCALE_INTERVAL_MAX: u32 = 500;

/// Why a register write was refused; it then has changed nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Outside of the command block, or half of a value.
    Address,
    /// A value that cannot be.
    Value,
}

/// What a sender is told, when [`Link::is_kept`] says so of `noted`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Of what the disk must have before.
    pub noted: u64,
    /// Of the command.
    pub ticket: u16,
    /// See [`Outcome`].
    pub outcome: u16,
}

impl Link {
    /// Write registers, all or none of them. Returns a number: the sender may be answered when
    /// [`Link::is_kept`] says so of it.
    pub fn write(
        &mut self,
        address: u16,
        values: &[u16],
        sender: Sender,
        now: Instant,
    ) -> Result<u64, Refusal> {
        let first = address.checked_sub(COMMAND).ok_or(Refusal::Address)?;
        let end = usize::from(first) + values.len();
        if values.is_empty() || end > usize::from(COMMAND_COUNT) {
            return Err(Refusal::Address);
        }
        let mut registers = [0; COMMAND_COUNT as usize];
        for field in COMMAND_FIELDS {
            let (start, size) = (usize::from(field.offset), usize::from(field.kind.registers()));
            let written = (start..start + size).filter(|i| (usize::from(first)..end).contains(i));
            if ![0, size].contains(&written.count()) {
                return Err(Refusal::Address); // half of a value
            }
            field.write(&self.block, self.order, &mut registers);
        }
        registers[usize::from(first)..end].copy_from_slice(values);
        let written = |offset: u16| (usize::from(first)..end).contains(&usize::from(offset));
        let pair = |at: usize| join([registers[at], registers[at + 1]], self.order);
        let block = CommandBlock {
            heartbeat: registers[0],
            acknowledge: registers[1],
            encoder_count: pair(2),
            ticket: registers[4],
            command: registers[5],
            argument: pair(6),
        };
        // A PLC that writes the whole block all the time may hold a number from before a restart: its
        // heartbeat and its counts are welcome all the same.
        if values.len() == 1 && written(1) && self.acknowledged_by(block.acknowledge).is_none() {
            return Err(Refusal::Value);
        }
        if written(0) {
            self.heartbeat(block.heartbeat, now);
        }
        let mut noted = if written(1) { self.acknowledge(block.acknowledge) } else { 0 };
        if written(2) {
            self.count(block.encoder_count, now);
        }
        self.block = block;
        self.written = Some((sender, now));
        if written(4) {
            noted =
                noted.max(self.command(block.ticket, block.command, block.argument, sender).noted);
        }
        self.publish_kept();
        self.show();
        Ok(noted)
    }

    /// Whether what was written is as safe as it gets: on the disk, or the disk fails and is a fault.
    pub fn is_kept(&self, noted: u64) -> bool {
        self.journal.is_kept(noted)
    }

    /// The PLC is alive, if the value has changed.
    pub fn heartbeat(&mut self, value: u16, now: Instant) {
        if value != self.block.heartbeat {
            (self.block.heartbeat, self.plc_alive) = (value, now);
        }
    }

    /// A count of the encoder. One too many between two frames takes the place of the oldest.
    pub fn count(&mut self, count: u32, now: Instant) {
        if self.counts.is_full() {
            self.counts.pop_front();
        }
        let _ = self.counts.push_back((count, now)); // invariant: there is room
        (self.block.encoder_count, self.encoder_alive) = (count, Some(now));
    }

    /// Decide on a command, once for each ticket; the disk has it before it is carried out and told, so
    /// that a restart neither repeats nor forgets it. Ticket 0 is no command: the next one may have any
    /// ticket.
    pub fn command(&mut self, ticket: u16, command: u16, argument: u32, sender: Sender) -> Answer {
        let last = *self.journal.state();
        if ticket == last.ticket {
            let is_repetition = ticket == 0 || (command, argument) == (last.command, last.argument);
            let outcome = if is_repetition { last.outcome } else { Outcome::TicketUsed as u16 };
            if self.decided.is_empty() {
                self.status.outcome = outcome;
            }
            if !is_repetition {
                self.refuse(Commanded { sender, ticket, command, argument, outcome });
            }
            let noted = self.decided.back().map_or(0, |decided| decided.noted);
            return Answer { noted, ticket, outcome };
        }
        if self.decided.is_full() {
            // The disk hangs. `ticket_done` stays what it was, and nothing is noted: the same ticket may
            // come again.
            let outcome = Outcome::Busy as u16;
            if ticket != 0 {
                self.refuse(Commanded { sender, ticket, command, argument, outcome });
            }
            return Answer { noted: 0, ticket, outcome };
        }
        self.refused = None;
        let (outcome, request) =
            if ticket == 0 { (Outcome::None, None) } else { self.decide(command, argument) };
        if ticket != 0 {
            tracing::info!(%sender, ticket, command, argument, ?outcome, "command");
        }
        let noted = self.journal.change(|state| {
            (state.ticket, state.outcome) = (ticket, outcome as u16);
            (state.command, state.argument) = (command, argument);
        });
        let told = outcome as u16;
        let given = Commanded { sender, ticket, command, argument, outcome: told };
        let given = (ticket != 0).then_some(given);
        let decided = Decided { noted, ticket, outcome, request, given };
        let _ = self.decided.push_back(decided); // invariant: there is room
        self.journal.save();
        self.publish_kept();
        Answer { noted, ticket, outcome: outcome as u16 }
    }

    /// A command is refused before it is decided on: those who watch are told once, however often it is
    /// written.
    fn refuse(&mut self, given: Commanded) {
        if self.refused != Some(given) {
            let Commanded { sender, ticket, command, argument, outcome } = given;
            tracing::warn!(%sender, ticket, command, argument, outcome, "command refused");
            self.refused = Some(given);
            self.tell(given);
        }
    }

    /// What becomes of a command. What it changes for good is noted together with its ticket.
    fn decide(&mut self, command: u16, argument: u32) -> (Outcome, Option<Request>) {
        let asked = self.decided.iter().filter(|decided| decided.request.is_some()).count();
        let busy = self.requests.len() + asked >= REQUESTS_MAX;
        match command {
            1 => match self.acknowledged_by(argument as u16) {
                Some(_) => {
                    self.acknowledge(argument as u16);
                    (Outcome::Done, None)
                }
                None => (Outcome::Argument, None),
            },
            2..=4 | 6 if busy => (Outcome::Busy, None),
            2 => (Outcome::Done, Some(Request::Learn)),
            3 | 4 => {
                let reporting = command == 3;
                self.journal.change(|state| state.stopped = !reporting);
                (Outcome::Done, Some(Request::Report(reporting)))
            }
            5 if (1..=SCALE_INTERVAL_MAX).contains(&argument) => {
                let configured = self.configured_scale_interval_mm;
                let set = f64::from(argument) / 10.0;
                self.journal.change(|state| {
                    state.scale_interval_mm = Some(Override { configured, set });
                });
                (Outcome::Done, None)
            }
            5 => (Outcome::Argument, None),
            6 => match (self.configured_mm_per_count, self.status.mm_per_count_seen()) {
                // An encoder that slips or stands is not one whose scale is off.
                (Some(_), Some(_)) if !self.status.encoder_scale_is_plausible() => {
                    (Outcome::Argument, None)
                }
                (Some(configured), Some(set)) => {
                    self.journal.change(|state| {
                        state.mm_per_count = Some(Override { configured, set });
                    });
                    (Outcome::Done, Some(Request::MmPerCount(set)))
                }
                _ => (Outcome::NotKnown, None),
            },
            _ => (Outcome::Unknown, None),
        }
    }

    /// How many of the queue an acknowledgment takes; `None` when it is of a parcel that was
    /// never published.
    fn acknowledged_by(&self, low_word: u16) -> Option<usize> {
        // After the disk failed the queue holds numbers of two blocks, which share no low word.
        let waiting = self.queue.iter().position(|record| record.seq as u16 == low_word);
        let behind = (self.status.sequence as u16).wrapping_sub(low_word);
        let is_repetition = self.journal.state().acknowledged as u16 == low_word;
        match waiting {
            Some(at) => Some(at + 1),
            None if is_repetition || behind <= u16::MAX / 2 => Some(0),
            None => None,
        }
    }

    /// Returns a number for [`Link::is_kept`].
    fn acknowledge(&mut self, low_word: u16) -> u64 {
        self.block.acknowledge = low_word;
        let count = self.acknowledged_by(low_word).unwrap_or(0);
        let mut last = None;
        for _ in 0..count {
            last = self.queue.pop_front();
        }
        // A repetition of one that is on its way is answered when that is there.
        let Some(last) = last else { return self.acknowledgment };
        self.acknowledgment = self.journal.change(|state| {
            // What has turned up with the state file waits in front of newer ones.
            if is_after(last.seq, state.acknowledged) {
                state.acknowledged = last.seq;
            }
        });
        self.acknowledgment
    }
}
