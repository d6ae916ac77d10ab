//! The memory plan: every buffer of the capture and vision path, named, counted and reasoned.
//!
//! In: the stages' demands, from the configuration's limits. Out: one anonymous mapping,
//! carved into [`Block`]s exactly as planned. Limits: `limits.memory_mib_max`. After
//! [`Memory::seal`] nothing is left to carve: a buffer that was planned and not taken, or
//! taken and not planned, is an error at start-up, never later.
#![allow(unsafe_code)] // typed views into the one mapping; each with its proof

use crate::error::{Error, Result};
use std::fmt;
use std::ops::{Deref, DerefMut};
use std::sync::Arc;

/// Blocks start on a cache line, so that two of them never share one.
const ALIGN: usize = 64;

/// One planned buffer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// `stage.buffer`.
    pub name: &'static str,
    /// Elements.
    pub count: usize,
    /// Bytes of one element.
    pub element_bytes: usize,
    /// Why it has this size.
    pub reason: &'static str,
}

impl Entry {
    /// Bytes, without the alignment gap.
    pub fn bytes(&self) -> usize {
        self.count * self.element_bytes
    }
}

/// The list of planned buffers.
#[derive(Clone, Debug, Default)]
pub struct Plan {
    entries: Vec<Entry>,
}

impl Plan {
    /// Demand `count` elements of `T`. A name is used once.
    pub fn add<T: Copy>(&mut self, name: &'static str, count: usize, reason: &'static str) {
        debug_assert!(self.entries.iter().all(|e| e.name != name), "{name} is planned twice");
        self.entries.push(Entry { name, count, element_bytes: size_of::<T>(), reason });
    }

    /// The buffers in order of demand.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Size of the mapping, alignment gaps included.
    pub fn bytes(&self) -> usize {
        self.entries.iter().map(|e| e.bytes().next_multiple_of(ALIGN)).sum()
    }

    /// Refuse a plan beyond `mib_max`.
    pub fn check_limit(&self, mib_max: usize) -> Result<()> {
        if self.bytes() <= mib_max << 20 {
            return Ok(());
        }
        let largest = self.entries.iter().max_by_key(|e| e.bytes());
        Err(Error::configuration(format!(
            "the memory plan needs {:.1} MiB, limits.memory_mib_max = {mib_max}",
            mib(self.bytes())
        ))
        .allowed(format!("limits.memory_mib_max of at least {}", mib(self.bytes()).ceil()))
        .remedy(format!(
            "raise it, or choose a coarser view.mm_per_px, a smaller zone or a lower \
             view.height_max_mm; the largest buffer is {}",
            largest.map_or("none", |e| e.name)
        )))
    }

    /// Map the memory; refuses a plan beyond `mib_max`.
    pub fn reserve(self, mib_max: usize) -> Result<Memory> {
        self.check_limit(mib_max)?;
        let mapping = memmap2::MmapMut::map_anon(self.bytes().max(1))
            .map_err(|e| Error::failure(format!("cannot map {} bytes: {e}", self.bytes())))?;
        Ok(Memory { plan: self, mapping: Arc::new(Mapping(mapping.into())), next: 0, offset: 0 })
    }
}

fn not_planned(name: &str) -> Error {
    Error::failure(format!("memory plan: {name} was not planned here"))
}

fn mib(bytes: usize) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:24} {:>10} {:>6} {:>12}  reason", "buffer", "count", "size", "bytes")?;
        for e in &self.entries {
            writeln!(
                f,
                "{:24} {:>10} {:>6} {:>12}  {}",
                e.name,
                e.count,
                e.element_bytes,
                e.bytes(),
                e.reason
            )?;
        }
        write!(
            f,
            "{:24} {:>10} {:>6} {:>12}  {:.1} MiB",
            "total",
            "",
            "",
            self.bytes(),
            mib(self.bytes())
        )
    }
}

struct Mapping(memmap2::MmapRaw);

/// The mapping while stages take their blocks, in the order of the plan.
pub struct Memory {
    plan: Plan,
    mapping: Arc<Mapping>,
    next: usize,
    offset: usize,
}

impl Memory {
    /// Take the next planned buffer, filled with `value`. Filling touches every page now.
    pub fn take<T: Copy + Send + 'static>(
        &mut self,
        name: &'static str,
        value: T,
    ) -> Result<Block<T>> {
        let mut parts = self.take_parts(name, 1, value)?;
        parts.pop().ok_or_else(|| not_planned(name))
    }

    /// [`Memory::take`], as `parts` blocks of equal size with owners of their own.
    pub fn take_parts<T: Copy + Send + 'static>(
        &mut self,
        name: &'static str,
        parts: usize,
        value: T,
    ) -> Result<Vec<Block<T>>> {
        let planned = self.plan.entries.get(self.next).filter(|e| {
            e.name == name
                && e.element_bytes == size_of::<T>()
                && align_of::<T>() <= ALIGN
                && e.count % parts == 0
        });
        let Some(entry) = planned else { return Err(not_planned(name)) };
        let (count, bytes) = (entry.count, entry.bytes());
        // SAFETY: plan order and next_multiple_of(ALIGN) give every entry its own range, inside
        // the mapping, which holds the sum of them all; page-aligned base and 64-byte
        // offsets satisfy T's alignment (checked above). The Arc keeps the mapping alive.
        let start = unsafe { self.mapping.0.as_mut_ptr().add(self.offset).cast::<T>() };
        for i in 0..count {
            // SAFETY: i < count elements of T lie inside this entry's range.
            unsafe { start.add(i).write(value) };
        }
        self.next += 1;
        self.offset += bytes.next_multiple_of(ALIGN);
        let part = count / parts;
        let block = |i: usize| Block {
            // SAFETY: parts * part = count, so every part lies inside the entry's range.
            start: unsafe { start.add(i * part) },
            count: part,
            foreign: false,
            _mapping: Arc::clone(&self.mapping),
        };
        Ok((0..parts).map(block).collect())
    }

    /// No more buffers: everything planned must have been taken.
    pub fn seal(self) -> Result<()> {
        match self.plan.entries.get(self.next) {
            Some(e) => Err(Error::failure(format!("memory plan: {} was never taken", e.name))),
            None => Ok(()),
        }
    }
}

/// A buffer inside the one mapping.
pub struct Block<T> {
    start: *mut T,
    count: usize,
    foreign: bool,
    _mapping: Arc<Mapping>,
}

// SAFETY: a block is the only owner of its range; sending it sends that ownership.
unsafe impl<T: Send> Send for Block<T> {}
// SAFETY: `&Block` gives `&[T]` only.
unsafe impl<T: Sync> Sync for Block<T> {}

impl Block<u8> {
    /// A mapping of its own, filled with zeros: a device's buffers come and go with the device.
    pub fn own(bytes: usize) -> Result<Self> {
        let mapping = memmap2::MmapMut::map_anon(bytes.max(1))
            .map_err(|e| Error::failure(format!("cannot map {bytes} bytes: {e}")))?;
        Ok(Self { foreign: false, ..Self::over(mapping.into(), bytes) })
    }

    /// The first `bytes` of a mapping, at most all of it; a driver's frame buffer, for one. Whoever
    /// gives the driver the buffer back must give up this block's contents first.
    pub fn over(mapping: memmap2::MmapRaw, bytes: usize) -> Self {
        Self {
            start: mapping.as_mut_ptr(),
            count: bytes.min(mapping.len()),
            foreign: true,
            _mapping: Arc::new(Mapping(mapping)),
        }
    }

    /// Whether it is memory of a driver's.
    pub fn is_foreign(&self) -> bool {
        self.foreign
    }
}

impl<T> Deref for Block<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        // SAFETY: `take` wrote all `count` elements, or they are bytes of a mapping; T is Copy, so
        // they stay valid.
        unsafe { std::slice::from_raw_parts(self.start, self.count) }
    }
}

impl<T> DerefMut for Block<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as above, and no other block overlaps the range.
        unsafe { std::slice::from_raw_parts_mut(self.start, self.count) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan() -> Plan {
        let mut plan = Plan::default();
        plan.add::<u8>("a", 3, "odd size");
        plan.add::<u64>("b", 5, "needs alignment");
        plan
    }

    #[test]
    fn blocks_are_filled_aligned_and_apart() {
        let mut memory = plan().reserve(1).expect("small");
        let mut a = memory.take::<u8>("a", 0xa5).expect("planned");
        let b = memory.take::<u64>("b", 7).expect("planned");
        memory.seal().expect("all taken");
        a.fill(1);
        assert_eq!((&a[..], &b[..]), (&[1u8; 3][..], &[7u64; 5][..]));
        assert_eq!(b.as_ptr() as usize % ALIGN, 0);
    }

    #[test]
    fn parts_of_a_buffer_do_not_overlap() {
        let mut memory = plan().reserve(1).expect("small");
        let mut parts = memory.take_parts::<u8>("a", 3, 0).expect("planned");
        for (i, part) in parts.iter_mut().enumerate() {
            part[0] = i as u8 + 1;
        }
        assert_eq!(parts.iter().map(|p| p[0]).collect::<Vec<_>>(), [1, 2, 3]);
        assert!(memory.take_parts::<u64>("b", 2, 0).is_err(), "5 elements in 2 parts");
    }

    #[test]
    fn a_buffer_not_planned_or_of_another_type_is_refused() {
        let mut memory = plan().reserve(1).expect("small");
        assert!(memory.take::<u8>("b", 0).is_err());
        assert!(memory.take::<u64>("a", 0).is_err());
    }

    #[test]
    fn a_buffer_never_taken_is_found_by_seal() {
        let mut memory = plan().reserve(1).expect("small");
        memory.take::<u8>("a", 0).expect("planned");
        assert!(memory.seal().is_err());
    }

    #[test]
    fn a_plan_beyond_the_limit_names_the_largest_buffer() {
        let mut plan = plan();
        plan.add::<u8>("huge", 3 << 20, "test");
        let error = plan.reserve(2).err().expect("refused").to_string();
        assert!(error.contains("huge") && error.contains("memory_mib_max"), "{error}");
    }
}
