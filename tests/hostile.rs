//! Cameras and images that mean harm: their end is an error message, not this process's end.

mod common;

use beltgauge::config::{CameraTable, Interface};
use beltgauge::sandbox;
use beltgauge::source::{Still, open_camera};
use common::scratch;
use std::fs;
use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Where the description is in the camera's memory.
const DESCRIPTION_AT: usize = 0x10_0000;

/// A camera that answers control packets, with the description and the URL that it is given.
struct Camera {
    address: Ipv4Addr,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Camera {
    fn start(last: u8, url: &str, description: Vec<u8>) -> Self {
        Self::pleading(last, url, description, |_| false)
    }

    /// One that answers requests of which `pleads` holds with nothing but pleas for more time.
    fn pleading(
        last: u8,
        url: &str,
        description: Vec<u8>,
        pleads: impl Fn(&[u8]) -> bool + Send + 'static,
    ) -> Self {
        let address = Ipv4Addr::new(127, 0, 9, last);
        let socket = UdpSocket::bind((address, 3956)).expect("this test's own address");
        socket.set_read_timeout(Some(Duration::from_millis(20))).expect("a socket");
        let stop = Arc::new(AtomicBool::new(false));
        let (stopped, url) = (Arc::clone(&stop), url.as_bytes().to_vec());
        let thread = std::thread::spawn(move || {
            let mut memory = vec![0; DESCRIPTION_AT + description.len() + 8192];
            memory[0x200..][..url.len()].copy_from_slice(&url);
            memory[DESCRIPTION_AT..][..description.len()].copy_from_slice(&description);
            let mut packet = [0; 2048];
            let mut waiting = None;
            while !stopped.load(Ordering::Relaxed) {
                if let Some((request, from)) = waiting {
                    let _ = socket.send_to(&plea(request), from);
                }
                let Ok((length, from)) = socket.recv_from(&mut packet) else { continue };
                if pleads(&packet[..length]) {
                    waiting = Some(([packet[6], packet[7]], from));
                    continue;
                }
                if let Some(answer) = answer(&mut memory, &packet[..length], address) {
                    socket.send_to(&answer, from).expect("sent");
                }
            }
        });
        Self { address, stop, thread: Some(thread) }
    }

    fn serving(last: u8, description: Vec<u8>) -> Self {
        let url = format!("Local:///a.xml;{DESCRIPTION_AT:x};{:x}", description.len());
        Self::start(last, &url, description)
    }

    /// What opening it comes to.
    fn open(&self) -> String {
        sandbox::use_program(PathBuf::from(env!("CARGO_BIN_EXE_beltgauge")));
        let mut settings = CameraTable::new("camera.toml".into());
        settings.interface = Interface::Gige;
        settings.device = Some(self.address.to_string());
        let start = Instant::now();
        let opened = open_camera(&settings, [512, 384]).err();
        assert!(start.elapsed() < Duration::from_secs(30), "below the watchdog's patience");
        opened.map_or_else(|| "opened".to_owned(), |e| e.to_string())
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().expect("the camera's thread");
        }
    }
}

/// PENDING_ACK: the answer will take ten seconds more.
fn plea([high, low]: [u8; 2]) -> [u8; 12] {
    let [most, least] = 10_000u16.to_be_bytes();
    [0, 0, 0, 0x89, 0, 4, high, low, 0, 0, most, least]
}

/// Discovery, READREG, WRITEREG, READMEM, WRITEMEM.
fn answer(memory: &mut [u8], packet: &[u8], address: Ipv4Addr) -> Option<Vec<u8>> {
    let word =
        |at: usize| packet.get(at..at + 4)?.try_into().ok().map(|b| u32::from_be_bytes(b) as usize);
    let command = u16::from_be_bytes([*packet.get(2)?, *packet.get(3)?]);
    let payload = match command {
        0x0002 => {
            let mut device = vec![0; 248];
            device[36..40].copy_from_slice(&address.octets());
            device
        }
        0x0080 => memory.get(word(8)?..word(8)? + 4)?.to_vec(),
        0x0082 => {
            memory.get_mut(word(8)?..word(8)? + 4)?.copy_from_slice(&packet[12..16]);
            vec![0, 0, 0, 1]
        }
        0x0084 => {
            let (at, count) = (word(8)?, word(12)? & 0xffff);
            [&packet[8..12], memory.get(at..at + count)?].concat()
        }
        0x0086 => vec![0, 0, 0, 1],
        _ => return None,
    };
    let mut bytes = vec![0, 0];
    bytes.extend((command + 1).to_be_bytes());
    bytes.extend((payload.len() as u16).to_be_bytes());
    bytes.extend(&packet[6..8]);
    bytes.extend(payload);
    Some(bytes)
}

fn described(nodes: &str) -> Vec<u8> {
    format!(
        r#"<?xml version="1.0"?><RegisterDescription ModelName="M" VendorName="V" SchemaMajorVersion="1"
SchemaMinorVersion="1" SchemaSubMinorVersion="0" xmlns="http://www.genicam.org/GenApi/Version_1_1">
{nodes}<Port Name="Device"/></RegisterDescription>"#
    )
    .into_bytes()
}

const WIDTH: &str = r#"<Integer Name="Width"><pValue>W</pValue></Integer>"#;

#[test]
fn a_well_meaning_description_is_understood_up_to_what_it_lacks() {
    let nodes = r#"<Integer Name="Width"><Value>512</Value></Integer>"#;
    let error = Camera::serving(1, described(nodes)).open();
    assert!(error.contains("does not take Height = 384"), "{error}");
}

/// Whether a request reads or writes this register, or memory from there on.
fn is_of(packet: &[u8], commands: [u16; 2], register: u32) -> bool {
    packet.get(2..4).is_some_and(|c| commands.map(u16::to_be_bytes).iter().any(|k| k == c))
        && packet.get(8..12) == Some(&register.to_be_bytes()[..])
}

#[test]
fn a_camera_that_pleads_for_more_time_for_ever_is_given_up_within_seconds() {
    let nodes = r#"<Integer Name="Width"><pValue>W</pValue></Integer>
<IntReg Name="W"><Address>0x5000</Address><Length>4</Length><AccessMode>RW</AccessMode>
<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"#;
    let cases: [(u8, u32, [u16; 2], &str); 3] = [
        (11, 0x0a00, [0x82, 0x86], "cannot control the camera: control"),
        (12, 0x0200, [0x80, 0x84], "the camera is lost: 512 bytes at register 0x200"),
        (13, 0x5000, [0x82, 0x86], "the camera is lost: writing 4 bytes at register 0x5000"),
    ];
    for (last, register, commands, expected) in cases {
        let description = described(nodes);
        let url = format!("Local:///a.xml;{DESCRIPTION_AT:x};{:x}", description.len());
        let camera =
            Camera::pleading(last, &url, description, move |p| is_of(p, commands, register));
        let began = Instant::now();
        let error = camera.open();
        assert!(error.contains(expected), "{error}");
        assert!(error.contains(&camera.address.to_string()), "which camera: {error}");
        // Discovery, one deadline of 3 s, a child process; then nothing more is asked.
        assert!(began.elapsed() < Duration::from_secs(8), "{:?}", began.elapsed());
    }
}

#[test]
fn a_description_of_128_terabytes_is_not_fetched() {
    let error = Camera::start(2, "Local:///a.xml;1000;7fffffffffff", Vec::new()).open();
    assert!(error.contains("140737488355327 bytes, at most"), "{error}");
}

#[test]
fn a_formula_of_200000_brackets_ends_the_child_alone() {
    let (open, close) = ("(".repeat(200_000), ")".repeat(200_000));
    let knife = format!(
        r#"{WIDTH}<IntSwissKnife Name="W"><Formula>{open}1{close}</Formula></IntSwissKnife>"#
    );
    let error = Camera::serving(3, described(&knife)).open();
    assert!(error.contains("child process") && error.contains("stack"), "{error}");
}

#[test]
fn a_chain_of_60000_values_ends_the_child_alone() {
    use std::fmt::Write;
    let mut nodes = WIDTH.replace(">W<", ">N0<");
    for i in 0..60_000 {
        let _ = write!(nodes, r#"<Integer Name="N{i}"><pValue>N{}</pValue></Integer>"#, i + 1);
    }
    let error = Camera::serving(4, described(&nodes)).open();
    // With Aravis its libraries have a part of the child's memory, and that ends first.
    let is_out_of_room = error.contains("stack") || error.contains("memory allocation");
    assert!(error.contains("child process") && is_out_of_room, "{error}");
}

#[test]
fn a_small_archive_of_a_huge_description_ends_the_child_alone() {
    let folder = scratch("archive");
    let node = r#"<Integer Name="N"><Value>1</Value></Integer>"#;
    let script = format!(
        "import zipfile; z = zipfile.ZipFile({:?}, 'w', zipfile.ZIP_DEFLATED); \
         z.writestr('a.xml', {:?} + {node:?} * 1400000 + '</RegisterDescription>')",
        folder.join("a.zip"),
        String::from_utf8_lossy(&described("")).split("<Port").next().unwrap_or_default(),
    );
    let made = Command::new("python3").args(["-c", &script]).status();
    assert!(made.is_ok_and(|made| made.success()), "python3 makes the archive");
    let archive = fs::read(folder.join("a.zip")).expect("made");
    assert!(archive.len() < 1 << 20);
    let error = Camera::serving(5, archive).open();
    assert!(error.contains("child process") && error.contains("memory"), "{error}");
}

#[test]
fn a_stills_child_gives_the_same_pixels_and_refuses_by_size() {
    sandbox::use_program(PathBuf::from(env!("CARGO_BIN_EXE_beltgauge")));
    let folder = scratch("stills");
    let good = folder.join("good.png");
    let pixels: Vec<u8> = (0..300 * 200u32).map(|i| (i * 7 % 251) as u8).collect();
    image::save_buffer(&good, &pixels, 300, 200, image::ExtendedColorType::L8).expect("writable");
    let still = Still::load_sandboxed(&good).expect("a good image");
    assert_eq!((still.size_px, &still.pixels), ([300, 200], &pixels));

    let huge = folder.join("huge.png");
    png_of(&huge, [16_384, 16_384]);
    for load in [Still::load, Still::load_sandboxed] {
        let start = Instant::now();
        let error = load(&huge).expect_err("too large").to_string();
        assert!(error.contains("16384 x 16384 px") && error.contains("megapixels"), "{error}");
        assert!(error.contains("huge.png") && error.contains("remedy"), "{error}");
        assert!(start.elapsed() < Duration::from_secs(5), "before it is decoded");
    }

    let rubbish = folder.join("rubbish.png");
    fs::write(&rubbish, "no image").expect("writable");
    let error = Still::load_sandboxed(&rubbish).expect_err("rubbish").to_string();
    assert!(error.contains("rubbish.png"), "{error}");
}

/// The head of a PNG file of a size; what follows need not be there to be refused.
fn png_of(path: &Path, [width, height]: [u32; 2]) {
    let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec();
    bytes.extend(width.to_be_bytes());
    bytes.extend(height.to_be_bytes());
    bytes.extend([8, 0, 0, 0, 0]);
    let crc = bytes[12..].iter().fold(!0u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 * (crc & 1)))
    });
    bytes.extend((!crc).to_be_bytes());
    bytes.extend(b"\0\0\0\0IDAT\x35\xaf\x06\x1e\0\0\0\0IEND\xae\x42\x60\x82");
    fs::write(path, bytes).expect("writable");
}
