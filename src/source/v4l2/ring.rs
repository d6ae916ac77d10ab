//! The ring of a driver's buffers: each is the driver's, filled and ours, or lent to the pipeline.
#![allow(unsafe_code)] // ioctl has no other interface

use super::ioctl::{ioctl, zeroed};
use crate::plan::Block;
use memmap2::MmapOptions;
use std::io;
use std::time::Duration;
use v4l::Device;
use v4l::v4l_sys::{
    V4L2_BUF_FLAG_ERROR, V4L2_BUF_FLAG_TIMESTAMP_MASK, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC,
    v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE as CAPTURE, v4l2_buffer,
    v4l2_memory_V4L2_MEMORY_MMAP as MMAP, v4l2_requestbuffers,
};
use v4l::v4l2::vidioc;

/// Buffers that are asked for: what a pipeline holds at once, and what the driver fills meanwhile.
pub const BUFFERS: u32 = 12;

/// A buffer that the driver has filled.
pub struct Filled {
    pub index: usize,
    pub bytes: usize,
    pub sequence: u32,
    pub stamp_s: f64,
    /// The stamp is of the machine's monotonic clock.
    pub monotonic: bool,
    /// The driver says so itself.
    pub damaged: bool,
    len: usize,
}

impl Filled {
    /// Bytes of the whole buffer.
    pub fn block_len(&self) -> usize {
        self.len
    }
}

struct Slot {
    /// Where its memory begins, also while it is lent.
    start: *const u8,
    len: usize,
    /// Missing while it is lent.
    block: Option<Block<u8>>,
}

/// The buffers of a streaming device.
pub struct Ring {
    device: Device,
    slots: Vec<Slot>,
    queued: usize,
}

// SAFETY: `start` is only compared, never followed.
unsafe impl Send for Ring {}

impl Ring {
    /// Map a device's buffers, give it all of them, and start.
    pub fn start(device: Device) -> io::Result<Self> {
        // SAFETY: plain numbers; and REQBUFS takes this type.
        let count = unsafe {
            let mut request: v4l2_requestbuffers = zeroed();
            (request.count, request.type_, request.memory) = (BUFFERS, CAPTURE, MMAP);
            ioctl(&device, vidioc::VIDIOC_REQBUFS, &mut request)?;
            request.count
        };
        let mut ring = Self { device, slots: Vec::new(), queued: 0 };
        for index in 0..count as usize {
            let mut buffer = buffer(index);
            // SAFETY: QUERYBUF takes this type; of the union the driver fills `offset` for MMAP.
            let offset = unsafe {
                ioctl(&ring.device, vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
                buffer.m.offset
            };
            let len = buffer.length as usize;
            let mapping = MmapOptions::new()
                .offset(u64::from(offset))
                .len(len)
                .map_raw(ring.device.handle().fd())?;
            let start = mapping.as_ptr();
            ring.slots.push(Slot { start, len, block: Some(Block::over(mapping, len)) });
            ring.requeue(index)?;
        }
        // SAFETY: STREAMON takes the type of buffers as an int.
        unsafe { ioctl(&ring.device, vidioc::VIDIOC_STREAMON, &mut (CAPTURE as i32))? };
        Ok(ring)
    }

    /// Buffers in all.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Buffers that the driver has to fill.
    pub fn queued(&self) -> usize {
        self.queued
    }

    /// Which of the driver's buffers a block is.
    pub fn index_of(&self, block: &Block<u8>) -> Option<usize> {
        self.slots.iter().position(|slot| std::ptr::eq(slot.start, block.as_ptr()))
    }

    /// Whether a buffer is not the driver's to fill.
    pub fn is_lent(&self, index: usize) -> bool {
        self.slots[index].block.is_none()
    }

    /// The contents of a filled buffer.
    pub fn bytes(&self, index: usize) -> &[u8] {
        self.slots[index].block.as_deref().unwrap_or(&[])
    }

    /// Take a filled buffer out of the ring.
    pub fn lend(&mut self, index: usize) -> Option<Block<u8>> {
        self.slots[index].block.take()
    }

    /// Give a lent buffer back to the driver.
    pub fn queue(&mut self, index: usize, block: Block<u8>) -> io::Result<()> {
        self.slots[index].block = Some(block);
        self.requeue(index)
    }

    /// Give a filled buffer back to the driver.
    pub fn requeue(&mut self, index: usize) -> io::Result<()> {
        // SAFETY: QBUF takes this type.
        unsafe { ioctl(&self.device, vidioc::VIDIOC_QBUF, &mut buffer(index))? };
        self.queued += 1;
        Ok(())
    }

    /// A filled buffer, if one comes in time.
    pub fn dequeue(&mut self, wait: Duration) -> io::Result<Option<Filled>> {
        // POLLIN is 1; an error of the device shows when the buffer is asked for.
        if self.device.handle().poll(1, wait.as_millis() as i32)? == 0 {
            return Ok(None);
        }
        let mut buffer = buffer(0);
        // SAFETY: DQBUF takes this type.
        match unsafe { ioctl(&self.device, vidioc::VIDIOC_DQBUF, &mut buffer) } {
            Ok(()) => {}
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(e) => return Err(e),
        }
        self.queued = self.queued.saturating_sub(1);
        let index = buffer.index as usize;
        let slot = self.slots.get(index).ok_or(io::ErrorKind::InvalidData)?;
        let clock = buffer.flags & V4L2_BUF_FLAG_TIMESTAMP_MASK;
        Ok(Some(Filled {
            index,
            bytes: buffer.bytesused as usize,
            sequence: buffer.sequence,
            stamp_s: buffer.timestamp.tv_sec as f64 + buffer.timestamp.tv_usec as f64 / 1e6,
            monotonic: clock == V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC,
            damaged: buffer.flags & V4L2_BUF_FLAG_ERROR != 0,
            len: slot.len,
        }))
    }
}

fn buffer(index: usize) -> v4l2_buffer {
    // SAFETY: plain numbers, and unions of them.
    let mut buffer: v4l2_buffer = unsafe { zeroed() };
    (buffer.index, buffer.type_, buffer.memory) = (index as u32, CAPTURE, MMAP);
    buffer
}
