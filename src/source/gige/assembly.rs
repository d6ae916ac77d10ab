//! Frames from stream packets: in any order, two at a time, with requests for what is missing.
//!
//! A block (frame) is a leader (packet 0), payload packets 1 to n and a trailer (n + 1), of GigE
//! cameras' stream protocol. Two blocks may be under way, as the packets that were asked for again
//! come after those of the next block.

use crate::error::{Error, Result};
use crate::plan::Block;
use std::time::{Duration, Instant};
use viva_genicam::gige::{
    GVSP_EXTENDED_HEADER_SIZE, GvspContent, GvspHeader, PacketBitmap, parse_header,
    parse_packet_ref,
};

/// A packet that is missing is asked for when so long nothing has come.
pub const PATIENCE: Duration = Duration::from_millis(4);
/// So often.
const ROUNDS: u32 = 3;
/// Ranges of packets asked for in one round.
pub const RANGES: usize = 16;
/// A block of which nothing has come for this long is given up.
const GIVE_UP: Duration = Duration::from_millis(100);
/// Blocks under way.
const SLOTS: usize = 2;
/// The status of a packet that cannot be sent again has this bit.
const STATUS_ERROR: u16 = 0x8000;

/// A whole image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Image {
    /// Where it is.
    pub slot: usize,
    /// Number of the frame, which wraps around nowhere.
    pub sequence: u64,
    /// The camera's clock.
    pub stamp: u64,
    /// When its first packet came.
    pub began: Instant,
}

/// What has come of a packet, or of time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    /// Nothing yet.
    More,
    /// An image is whole.
    Whole(Image),
    /// A frame was given up.
    Torn,
}

/// A request for packets, ready to send to the camera's control port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Resend {
    bytes: [u8; 28],
    len: usize,
}

impl Resend {
    /// `PACKETRESEND_CMD`: key, flags, command, length, request id; channel, block, first, last.
    fn new(block_id: u64, [first, last]: [u32; 2], extended: bool) -> Self {
        let mut request = Self { bytes: [0; 28], len: 0 };
        let (flags, length) = if extended { (0x10, 20u16) } else { (0, 12) };
        request.put(&[0x42, flags, 0x00, 0x40]);
        request.put(&length.to_be_bytes());
        // No answer is asked for but the packets: the id is not looked at.
        request.put(&[0xff, 0xff, 0, 0]);
        request.put(&if extended { 0 } else { block_id as u16 }.to_be_bytes());
        let mask = if extended { u32::MAX } else { 0x00ff_ffff };
        request.put(&(first & mask).to_be_bytes());
        request.put(&(last & mask).to_be_bytes());
        if extended {
            request.put(&block_id.to_be_bytes());
        }
        request
    }

    fn put(&mut self, bytes: &[u8]) {
        self.bytes[self.len..][..bytes.len()].copy_from_slice(bytes);
        self.len += bytes.len();
    }

    /// The datagram.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

struct Slot {
    image: Block<u8>,
    /// Leader and payload packets that came.
    came: PacketBitmap,
    /// The block that is under way here.
    block: Option<u64>,
    extended: bool,
    /// Bytes of the image in a packet, which are fewer behind a header with long numbers.
    payload: usize,
    /// Leader and payload packets of the block.
    packets: usize,
    stamp: u64,
    began: Instant,
    /// When something of it came or was asked for.
    touched: Instant,
    rounds: u32,
}

/// Frames under way.
pub struct Assembly {
    slots: [Slot; SLOTS],
    image_bytes: usize,
    datagram_bytes: usize,
    size_px: [usize; 2],
    /// The newest block begun, its number, and whether blocks have 64 bits.
    newest: Option<(u64, u64)>,
    resends: u64,
}

impl Assembly {
    /// For images of so many bytes in datagrams of so many, stream header included.
    pub fn new(image_bytes: usize, datagram_bytes: usize, size_px: [usize; 2]) -> Result<Self> {
        let packets_max = 1 + image_bytes
            .div_ceil(datagram_bytes.saturating_sub(GVSP_EXTENDED_HEADER_SIZE).max(1));
        let slot = || -> Result<Slot> {
            let now = Instant::now();
            Ok(Slot {
                image: Block::own(image_bytes)?,
                came: PacketBitmap::new(packets_max),
                block: None,
                extended: false,
                payload: 1,
                packets: 0,
                stamp: 0,
                began: now,
                touched: now,
                rounds: 0,
            })
        };
        Ok(Self {
            slots: [slot()?, slot()?],
            image_bytes,
            datagram_bytes,
            size_px,
            newest: None,
            resends: 0,
        })
    }

    /// The image of a slot, until the next packet.
    pub fn image(&mut self, slot: usize) -> &mut Block<u8> {
        &mut self.slots[slot].image
    }

    /// Packets asked for again.
    pub fn resends(&self) -> u64 {
        self.resends
    }

    /// Take a packet; what cannot be understood is ignored, as from a stranger.
    pub fn packet(&mut self, datagram: &[u8], now: Instant) -> Result<Step> {
        let Ok(header) = parse_header(datagram) else { return Ok(Step::More) };
        if header.status & STATUS_ERROR != 0 {
            // It cannot be had any more.
            let slot = self.slots.iter_mut().find(|slot| slot.block == Some(header.block_id));
            return Ok(slot.map_or(Step::More, |slot| {
                slot.block = None;
                Step::Torn
            }));
        }
        let Ok(packet) = parse_packet_ref(datagram) else { return Ok(Step::More) };
        let Some((index, torn)) = self.slot_of(&header, now) else { return Ok(Step::More) };
        let slot = &mut self.slots[index];
        slot.touched = now;
        match packet.content {
            GvspContent::Leader(leader) => {
                let image = leader.image.map(|image| [image.width as usize, image.height as usize]);
                if image != Some(self.size_px) {
                    let [width, height] = image.unwrap_or_default();
                    let [w, h] = self.size_px;
                    return Err(Error::configuration(format!(
                        "the camera sends {width} x {height} px, asked for were {w} x {h} px"
                    ))
                    .remedy("check the camera's region of interest and binning"));
                }
                slot.stamp = leader.timestamp;
                slot.came.set(0);
            }
            GvspContent::Payload(bytes) => {
                let at = (header.packet_id as usize).wrapping_sub(1).saturating_mul(slot.payload);
                let room = slot.image.len().saturating_sub(at).min(slot.payload);
                // A packet shorter than its place is none of this stream.
                if room > 0 && bytes.len() >= room && slot.came.set(header.packet_id as usize) {
                    slot.image[at..at + room].copy_from_slice(&bytes[..room]);
                }
            }
            GvspContent::Trailer(_) | GvspContent::Unsupported { .. } | _ => {}
        }
        if slot.came.received() == slot.packets {
            let sequence = self.sequence_of(header.block_id, header.extended_ids);
            let slot = &mut self.slots[index];
            slot.block = None;
            let (stamp, began) = (slot.stamp, slot.began);
            return Ok(Step::Whole(Image { slot: index, sequence, stamp, began }));
        }
        Ok(if torn { Step::Torn } else { Step::More })
    }

    /// The slot of a packet's block, and whether another block had to go for it.
    fn slot_of(&mut self, header: &GvspHeader, now: Instant) -> Option<(usize, bool)> {
        let id = header.block_id;
        if let Some(index) = self.slots.iter().position(|slot| slot.block == Some(id)) {
            return Some((index, false));
        }
        let ahead = self.newest.map_or(1, |(newest, _)| ahead(id, newest, header.extended_ids));
        if ahead <= 0 {
            // Too late: it is whole or given up.
            return None;
        }
        let sequence = self.newest.map_or(0, |(_, number)| number.saturating_add(ahead as u64));
        self.newest = Some((id, sequence));
        let free = self.slots.iter().position(|slot| slot.block.is_none());
        let index = free.unwrap_or_else(|| usize::from(self.slots[1].began < self.slots[0].began));
        let slot = &mut self.slots[index];
        slot.payload = self.datagram_bytes.saturating_sub(header.header_len).max(1);
        slot.packets = 1 + self.image_bytes.div_ceil(slot.payload);
        slot.came.reset(slot.packets);
        (slot.block, slot.extended, slot.rounds) = (Some(id), header.extended_ids, 0);
        (slot.began, slot.touched) = (now, now);
        Some((index, free.is_none()))
    }

    fn sequence_of(&self, id: u64, extended: bool) -> u64 {
        let (newest, number) = self.newest.unwrap_or((id, 0));
        number.saturating_add_signed(ahead(id, newest, extended))
    }

    /// Nothing has come just now: ask again for what is missing, or give it up.
    pub fn idle(&mut self, now: Instant, resends: &mut heapless::Vec<Resend, RANGES>) -> Step {
        for slot in &mut self.slots {
            let Some(block) = slot.block else { continue };
            let quiet = now.saturating_duration_since(slot.touched);
            if quiet < PATIENCE {
                continue;
            }
            if slot.rounds >= ROUNDS {
                if quiet >= GIVE_UP / 2 {
                    slot.block = None;
                    return Step::Torn;
                }
                continue;
            }
            slot.rounds += 1;
            slot.touched = now;
            let mut from = 0;
            while let Some([first, last]) = missing(&slot.came, slot.packets, from) {
                from = last as usize + 1;
                if resends.push(Resend::new(block, [first, last], slot.extended)).is_err() {
                    break;
                }
                self.resends += u64::from(last - first + 1);
            }
        }
        Step::More
    }
}

/// How many blocks after `newest` a block is; numbers of 16 bits go from 65535 to 1.
fn ahead(id: u64, newest: u64, extended: bool) -> i64 {
    if extended {
        return id.wrapping_sub(newest) as i64;
    }
    let ahead = (id as i64 - newest as i64).rem_euclid(65_535);
    if ahead > 32_767 { ahead - 65_535 } else { ahead }
}

/// The first run of missing packets from `from` on.
fn missing(came: &PacketBitmap, packets: usize, from: usize) -> Option<[u32; 2]> {
    let first = (from..packets).find(|packet| !came.contains(*packet))?;
    let end = (first..packets).find(|packet| came.contains(*packet)).unwrap_or(packets);
    Some([first as u32, end as u32 - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [100, 30];
    const DATAGRAM: usize = 72;
    /// 3000 bytes in packets of 64, and the leader.
    const PACKETS: u32 = 1 + 47;
    /// The same in packets of 52, behind longer headers.
    const EXTENDED_PACKETS: u32 = 1 + 58;

    fn image(block: u64) -> Vec<u8> {
        (0..3000u32).map(|i| (i as u8).wrapping_mul(7).wrapping_add(block as u8)).collect()
    }

    /// The packets of a block as a camera sends them: leader, payload, trailer.
    fn packet(block: u64, id: u32, extended: bool) -> Vec<u8> {
        let (payload, packets) = if extended { (52, EXTENDED_PACKETS) } else { (64, PACKETS) };
        let format = match id {
            0 => 1,
            id if id < packets => 3,
            _ => 2,
        };
        let mut bytes = vec![0, 0];
        if extended {
            bytes.extend([0, 0, 0x80 | format, 0, 0, 0]);
            bytes.extend(block.to_be_bytes());
            bytes.extend(id.to_be_bytes());
        } else {
            bytes.extend((block as u16).to_be_bytes());
            bytes.push(format);
            bytes.extend(&id.to_be_bytes()[1..]);
        }
        match format {
            1 => {
                bytes.extend([0, 0, 0, 1]);
                bytes.extend((1000 * block).to_be_bytes());
                bytes.extend(0x0108_0001u32.to_be_bytes());
                bytes.extend((SIZE[0] as u32).to_be_bytes());
                bytes.extend((SIZE[1] as u32).to_be_bytes());
                bytes.extend([0; 12]);
            }
            3 => {
                let from = (id as usize - 1) * payload;
                bytes.extend(&image(block)[from..3000.min(from + payload)]);
            }
            _ => {
                bytes.extend([0, 0, 0, 1]);
                bytes.extend((SIZE[1] as u32).to_be_bytes());
            }
        }
        bytes
    }

    fn assembly() -> Assembly {
        Assembly::new(3000, DATAGRAM, SIZE).expect("small")
    }

    /// Feed packets; returns what came of them but [`Step::More`].
    fn feed(assembly: &mut Assembly, packets: &[Vec<u8>], now: Instant) -> Vec<Step> {
        let steps = packets.iter().map(|packet| assembly.packet(packet, now).expect("same size"));
        steps.filter(|step| *step != Step::More).collect()
    }

    #[test]
    fn packets_in_any_order_and_twice_make_the_image() {
        let (mut assembly, now) = (assembly(), Instant::now());
        for (block, extended) in [(1, false), (2, false), (70_000, true), (70_001, true)] {
            let last = if extended { EXTENDED_PACKETS } else { PACKETS };
            let mut packets: Vec<_> = (0..=last).map(|id| packet(block, id, extended)).collect();
            packets.reverse();
            packets.swap(3, 40);
            packets.insert(9, packets[5].clone());
            let steps = feed(&mut assembly, &packets, now);
            let [Step::Whole(whole)] = steps[..] else { panic!("{steps:?}") };
            assert_eq!(whole.stamp, 1000 * block);
            assert_eq!(assembly.image(whole.slot)[..], image(block));
        }
    }

    #[test]
    fn numbers_go_on_over_the_end_of_16_bits_and_lost_blocks() {
        let (mut assembly, now) = (assembly(), Instant::now());
        let mut numbers = Vec::new();
        for block in [65_530, 65_534, 65_535, 1, 2, 5] {
            let packets: Vec<_> = (0..=PACKETS).map(|id| packet(block, id, false)).collect();
            match feed(&mut assembly, &packets, now)[..] {
                [Step::Whole(whole)] => numbers.push(whole.sequence),
                ref steps => panic!("{steps:?}"),
            }
        }
        assert_eq!(numbers, [0, 4, 5, 6, 7, 10]);
    }

    #[test]
    fn what_is_missing_is_asked_for_and_completes_the_image_beside_the_next_one() {
        let (mut assembly, start) = (assembly(), Instant::now());
        let lost = [0, 5, 6, 7, PACKETS - 1];
        let packets: Vec<_> =
            (0..=PACKETS).filter(|id| !lost.contains(id)).map(|id| packet(9, id, false)).collect();
        assert!(feed(&mut assembly, &packets, start).is_empty());
        let mut resends = heapless::Vec::new();
        assert_eq!(assembly.idle(start + PATIENCE / 2, &mut resends), Step::More);
        assert!(resends.is_empty(), "it may still come");
        assert_eq!(assembly.idle(start + PATIENCE, &mut resends), Step::More);
        let asked: Vec<&[u8]> = resends.iter().map(Resend::bytes).collect();
        let request = |first: u8, last: u8| {
            [0x42, 0, 0, 0x40, 0, 12, 0xff, 0xff, 0, 0, 0, 9, 0, 0, 0, first, 0, 0, 0, last]
        };
        let last = PACKETS as u8 - 1;
        assert_eq!(asked, [&request(0, 0)[..], &request(5, 7), &request(last, last)]);
        assert_eq!(assembly.resends(), 5);
        // The next block is under way before the answer comes.
        feed(&mut assembly, &[packet(10, 0, false), packet(10, 1, false)], start + PATIENCE);
        let answer: Vec<_> = lost.iter().map(|id| packet(9, *id, false)).collect();
        let steps = feed(&mut assembly, &answer, start + PATIENCE);
        let [Step::Whole(whole)] = steps[..] else { panic!("{steps:?}") };
        assert_eq!(assembly.image(whole.slot)[..], image(9));
        let rest: Vec<_> = (2..=PACKETS).map(|id| packet(10, id, false)).collect();
        let steps = feed(&mut assembly, &rest, start + PATIENCE);
        let [Step::Whole(next)] = steps[..] else { panic!("{steps:?}") };
        assert_eq!(next.sequence, whole.sequence + 1);
    }

    #[test]
    fn a_block_that_cannot_be_had_is_given_up_and_late_packets_of_it_are_ignored() {
        let (mut assembly, start) = (assembly(), Instant::now());
        feed(&mut assembly, &[packet(1, 0, false), packet(1, 2, false)], start);
        let (mut torn_ms, mut asked) = (None, 0);
        for ms in 0..500 {
            let mut resends = heapless::Vec::new();
            let step = assembly.idle(start + Duration::from_millis(ms), &mut resends);
            asked += resends.len();
            if step == Step::Torn {
                assert_eq!(torn_ms.replace(ms), None, "once");
            }
        }
        assert!(torn_ms.is_some_and(|ms| ms < 100), "{torn_ms:?}");
        assert_eq!(asked, 2 * ROUNDS as usize);
        let late: Vec<_> = (0..=PACKETS).map(|id| packet(1, id, false)).collect();
        assert!(feed(&mut assembly, &late, start).is_empty());
        // "Not available", status 0x800c, ends it at once.
        feed(&mut assembly, &[packet(2, 0, false)], start);
        let refusal = [0x80, 0x0c, 0, 2, 3, 0, 0, 1].to_vec();
        assert_eq!(feed(&mut assembly, &[refusal], start), [Step::Torn]);
    }

    #[test]
    fn three_blocks_at_once_cost_the_oldest() {
        let (mut assembly, now) = (assembly(), Instant::now());
        let leaders: Vec<_> = (1..=3).map(|block| packet(block, 0, false)).collect();
        assert_eq!(feed(&mut assembly, &leaders, now), [Step::Torn]);
    }

    #[test]
    fn another_size_is_an_error_and_rubbish_is_ignored() {
        let (mut assembly, now) =
            (Assembly::new(3000, DATAGRAM, [50, 60]).expect("small"), Instant::now());
        let error = assembly.packet(&packet(1, 0, false), now).expect_err("100 x 30").to_string();
        assert!(error.contains("100 x 30 px, asked for were 50 x 60 px"), "{error}");
        let mut bytes: Vec<u8> = Vec::new();
        for i in 0..20_000u32 {
            bytes.clear();
            let seed = i.wrapping_mul(2_654_435_761);
            bytes.extend((0..seed % 90).map(|j| (seed >> (j % 25)) as u8 ^ (j * j) as u8));
            let _ = assembly.packet(&bytes, now);
            let mut whole = packet(u64::from(i), i % 60, i % 2 == 0);
            whole.truncate((seed % 120) as usize);
            let _ = assembly.packet(&whole, now);
        }
    }
}
