//! Frames from stream packets: in any order, two at a time, with requests for what is missing.
//!
//! A block (frame) is a leader (packet 0), payload packets 1 to n and a trailer (n + 1), of GigE
//! cameras' stream protocol. Two blocks may be under way, as the packets that were asked for again
//! come after those of the next block.
//!
//! Where the stream is, whole images say: a packet alone may be a stranger's, and its block's number
//! any. It costs a slot until it is given up, no more.

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
/// Blocks that are whole or given up, of which late packets are ignored.
const ENDED: usize = 8;
/// A camera whose block numbers jump by more began to count anew.
const BLOCKS_LOST_MAX: i64 = 100_000;
/// So many leaders of another size in turn are no strangers': the camera was set up otherwise.
const OTHER_SIZE_MAX: u32 = 3;
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
    fn new(BlockId { id: block_id, extended }: BlockId, [first, last]: [u32; 2]) -> Self {
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

/// A block's number, and whether it has 64 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct BlockId {
    id: u64,
    extended: bool,
}

impl BlockId {
    fn of(header: &GvspHeader) -> Self {
        Self { id: header.block_id, extended: header.extended_ids }
    }

    /// How many blocks after `other` this is; numbers of 16 bits go from 65535 to 1. `None` when
    /// they were not counted together.
    fn ahead(self, other: Self) -> Option<i64> {
        if self.extended != other.extended {
            return None;
        }
        let ahead = if self.extended {
            self.id.wrapping_sub(other.id) as i64
        } else {
            let ahead = (self.id as i64 - other.id as i64).rem_euclid(65_535);
            if ahead > 32_767 { ahead - 65_535 } else { ahead }
        };
        (-(SLOTS as i64)..=BLOCKS_LOST_MAX).contains(&ahead).then_some(ahead)
    }
}

struct Slot {
    image: Block<u8>,
    /// Leader and payload packets that came.
    came: PacketBitmap,
    /// The block that is under way here.
    block: Option<BlockId>,
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
    /// The newest whole block, and the number of its frame.
    newest: Option<(BlockId, u64)>,
    /// The last blocks that ended, whole or not.
    ended: heapless::HistoryBuf<BlockId, ENDED>,
    /// Leaders of another size in turn.
    other_size: u32,
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
            ended: heapless::HistoryBuf::new(),
            other_size: 0,
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
            let block = Some(BlockId::of(&header));
            let index = self.slots.iter().position(|slot| slot.block == block);
            return Ok(index.map_or(Step::More, |index| {
                self.end(index);
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
                    self.other_size += 1;
                    if self.other_size < OTHER_SIZE_MAX {
                        self.end(index);
                        return Ok(Step::Torn);
                    }
                    let [width, height] = image.unwrap_or_default();
                    let [w, h] = self.size_px;
                    return Err(Error::configuration(format!(
                        "the camera sends {width} x {height} px, asked for were {w} x {h} px"
                    ))
                    .remedy("check the camera's region of interest and binning"));
                }
                self.other_size = 0;
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
            let (stamp, began) = (slot.stamp, slot.began);
            let sequence = self.sequence_of(BlockId::of(&header));
            self.end(index);
            return Ok(Step::Whole(Image { slot: index, sequence, stamp, began }));
        }
        Ok(if torn { Step::Torn } else { Step::More })
    }

    /// The slot of a packet's block, and whether another block had to go for it.
    fn slot_of(&mut self, header: &GvspHeader, now: Instant) -> Option<(usize, bool)> {
        let block = BlockId::of(header);
        if let Some(index) = self.slots.iter().position(|slot| slot.block == Some(block)) {
            return Some((index, false));
        }
        if self.ended.contains(&block) {
            // Too late: it is whole or given up.
            return None;
        }
        let free = self.slots.iter().position(|slot| slot.block.is_none());
        let index = free.unwrap_or_else(|| usize::from(self.slots[1].began < self.slots[0].began));
        self.end(index);
        let slot = &mut self.slots[index];
        slot.payload = self.datagram_bytes.saturating_sub(header.header_len).max(1);
        slot.packets = 1 + self.image_bytes.div_ceil(slot.payload);
        slot.came.reset(slot.packets);
        (slot.block, slot.rounds) = (Some(block), 0);
        (slot.began, slot.touched) = (now, now);
        Some((index, free.is_none()))
    }

    /// The block in a slot is whole or given up.
    fn end(&mut self, index: usize) {
        if let Some(block) = self.slots[index].block.take() {
            self.ended.write(block);
        }
    }

    /// The number of a whole block's frame. After a jump that cannot be, counting goes on from
    /// where it was.
    fn sequence_of(&mut self, block: BlockId) -> u64 {
        let Some((newest, number)) = self.newest else {
            self.newest = Some((block, 0));
            return 0;
        };
        let ahead = block.ahead(newest).unwrap_or(1);
        let sequence = number.saturating_add_signed(ahead);
        if ahead > 0 {
            self.newest = Some((block, sequence));
        }
        sequence
    }

    /// Nothing has come just now: ask again for what is missing, or give it up.
    pub fn idle(&mut self, now: Instant, resends: &mut heapless::Vec<Resend, RANGES>) -> Step {
        for index in 0..SLOTS {
            let slot = &mut self.slots[index];
            let Some(block) = slot.block else { continue };
            let quiet = now.saturating_duration_since(slot.touched);
            if quiet < PATIENCE {
                continue;
            }
            if slot.rounds >= ROUNDS {
                if quiet >= GIVE_UP / 2 {
                    self.end(index);
                    return Step::Torn;
                }
                continue;
            }
            slot.rounds += 1;
            slot.touched = now;
            let mut from = 0;
            while let Some([first, last]) = missing(&slot.came, slot.packets, from) {
                from = last as usize + 1;
                if resends.push(Resend::new(block, [first, last])).is_err() {
                    break;
                }
                self.resends += u64::from(last - first + 1);
            }
        }
        Step::More
    }
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
                bytes.extend(1000u64.wrapping_mul(block).to_be_bytes());
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
    fn a_stray_packet_of_any_block_costs_three_blocks_at_most() {
        // Numbers of the stream's first block; 16 bits wrap around within it, 64 bits as well.
        let streams = [(1, false), (65_530, false), (500, true), (u64::MAX - 5, true)];
        let strays = [1, 2, 3, 100, 20_000, 32_767, 32_768, 40_000, 65_000, 1 << 40, 1 << 63];
        for ((first, extended), stray) in streams.into_iter().flat_map(|s| strays.map(|t| (s, t))) {
            for stray_extended in [extended, !extended] {
                let (mut assembly, mut now) = (assembly(), Instant::now());
                let last = if extended { EXTENDED_PACKETS } else { PACKETS };
                let (mut block, mut whole) = (first, Vec::new());
                for frame in 0..12 {
                    if frame == 4 {
                        let block = first.wrapping_add(stray);
                        let stray = packet(block, 7, stray_extended);
                        let _ = assembly.packet(&stray, now).expect("ignored");
                    }
                    let packets: Vec<_> =
                        (0..=last).map(|id| packet(block, id, extended)).collect();
                    let steps = feed(&mut assembly, &packets, now);
                    whole.extend(steps.iter().filter_map(|step| match step {
                        Step::Whole(image) => Some((frame, image.sequence)),
                        _ => None,
                    }));
                    // What is missing is not asked for: the line is busy.
                    now += Duration::from_millis(25);
                    block = if extended { block.wrapping_add(1) } else { block % 65_535 + 1 };
                }
                let what = format!("from {first}, stray {stray}, {stray_extended}: {whole:?}");
                assert!(whole.is_sorted_by(|a, b| a.1 < b.1), "{what}");
                let after = whole.iter().filter(|(frame, _)| *frame >= 7).count();
                assert_eq!(after, 5, "{what}");
                assert!(whole.len() >= 11, "{what}");
            }
        }
    }

    #[test]
    fn a_camera_that_counts_anew_is_followed() {
        let (mut assembly, now) = (assembly(), Instant::now());
        let mut numbers = Vec::new();
        for block in [30_000, 30_001, 1, 2, 3, 60_000, 60_001] {
            let packets: Vec<_> = (0..=PACKETS).map(|id| packet(block, id, false)).collect();
            match feed(&mut assembly, &packets, now)[..] {
                [Step::Whole(whole)] => numbers.push(whole.sequence),
                ref steps => panic!("{steps:?}"),
            }
        }
        assert_eq!(numbers, [0, 1, 2, 3, 4, 5, 6]);
    }

    #[test]
    fn another_size_is_an_error_and_rubbish_is_ignored() {
        let (mut assembly, now) =
            (Assembly::new(3000, DATAGRAM, [50, 60]).expect("small"), Instant::now());
        for block in 1..OTHER_SIZE_MAX {
            let step = assembly.packet(&packet(u64::from(block), 0, false), now);
            assert_eq!(step.expect("may be a stranger's"), Step::Torn);
        }
        let block = u64::from(OTHER_SIZE_MAX);
        let error = assembly.packet(&packet(block, 0, false), now).expect_err("100 x 30");
        let error = error.to_string();
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
