//! The memory of a camera: where its description is, the archive or text, and the features in it. In
//! the appliance a child process does this.
#![no_main]

use beltgauge::fuzz::describe;
use libfuzzer_sys::fuzz_target;
use viva_genicam::Camera;
use viva_genicam::genapi::{GenApiError, RegisterIo};

/// Where the standard has the place of the description.
const URL_ADDRESS: u64 = 0x200;
/// What a child may ask for at once.
const ACCESS_BYTES_MAX: usize = 16 << 20;

/// Starts with the place of the description.
struct Memory<'a>(&'a [u8]);

impl Memory<'_> {
    /// What lies beyond is 0.
    fn read(&self, address: u64, length: usize) -> Result<Vec<u8>, String> {
        if length > ACCESS_BYTES_MAX {
            return Err("too long".to_owned());
        }
        let from = usize::try_from(address.wrapping_sub(URL_ADDRESS)).unwrap_or(usize::MAX);
        let there = self.0.get(from..).unwrap_or_default();
        let mut bytes = there[..there.len().min(length)].to_vec();
        bytes.resize(length, 0);
        Ok(bytes)
    }
}

impl RegisterIo for Memory<'_> {
    fn read(&self, address: u64, length: usize) -> Result<Vec<u8>, GenApiError> {
        self.read(address, length).map_err(GenApiError::io)
    }

    fn write(&self, _address: u64, _data: &[u8]) -> Result<(), GenApiError> {
        Ok(())
    }
}

fuzz_target!(|bytes: &[u8]| {
    let memory = Memory(bytes);
    let Ok(map) = describe(|address, length| memory.read(address, length)) else { return };
    let mut camera = Camera::new(memory, map);
    for (name, value) in [
        ("Width", "640"),
        ("PixelFormat", "Mono8"),
        ("ExposureTime", "1500.5"),
        ("AcquisitionFrameRateEnable", "true"),
    ] {
        // Refused or not, it must come back.
        let _ = camera.set(name, value);
    }
    let _ = camera.acquisition_start();
});
