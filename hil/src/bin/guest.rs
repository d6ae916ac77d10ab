//! What the tests run inside the emulated appliance, beside the product: a camera that plays a
//! recording, a thread that freezes, the formats of a driver.
#![allow(unsafe_code)] // ioctl has no other interface

use beltgauge::config::CameraTable;
use beltgauge::plan::Block;
use beltgauge::source::{Arrival, open_camera};
use hil::allocations;
use nix::sys::ptrace;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::time::{Duration, Instant};
use v4l::Device;
use v4l::v4l_sys::{
    v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT, v4l2_buffer, v4l2_field_V4L2_FIELD_NONE, v4l2_format,
    v4l2_memory_V4L2_MEMORY_MMAP, v4l2_requestbuffers,
};
use v4l::v4l2::vidioc;

#[global_allocator]
static ALLOCATOR: allocations::Counting = allocations::Counting;

const USAGE: &str = "guest feed DEVICE RECORDING FIRST | freeze PID THREAD | formats DEVICE";

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["feed", device, recording, first] => {
            feed(device, recording, first.parse().expect("a frame"));
        }
        ["freeze", pid, thread] => freeze(pid, thread),
        ["formats", device] => formats(device),
        _ => panic!("{USAGE}"),
    }
}

/// One ioctl with the type that belongs to it.
fn ioctl<T>(device: &Device, request: vidioc::_IOC_TYPE, argument: &mut T) {
    let argument = std::ptr::from_mut(argument).cast();
    // SAFETY: each call below gives the type that the kernel's header names for its request.
    unsafe { v4l::v4l2::ioctl(device.handle().fd(), request, argument) }
        .expect("the driver takes it");
}

fn zeroed<T>() -> T {
    // SAFETY: used for the kernel's structures of plain numbers only.
    unsafe { std::mem::zeroed() }
}

/// Monotonic time, as drivers stamp frames.
fn now_s() -> f64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC).expect("Linux");
    now.tv_sec() as f64 + now.tv_nsec() as f64 / 1e9
}

/// Play a Y4M recording into a loopback device, over and over, every frame stamped with the time at
/// which it was due; the first time from a frame on.
fn feed(device: &str, recording: &str, first: usize) {
    let mut file = BufReader::new(File::open(recording).expect("the recording is there"));
    let mut header = String::new();
    file.read_line(&mut header).expect("Y4M");
    let number = |key: char| {
        let word = header.split_whitespace().find(|word| word.starts_with(key)).expect("Y4M");
        word[1..].split(':').next().and_then(|n| n.parse::<usize>().ok()).expect("a number")
    };
    let (width, height, fps) = (number('W'), number('H'), number('F') as f64);
    let frames: usize = number('X');
    let device = Device::with_path(device).expect("the loopback is there");
    let kind = v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT;
    let mut format: v4l2_format = zeroed();
    format.type_ = kind;
    // SAFETY: the member that belongs to this type of buffer.
    let pix = unsafe { &mut format.fmt.pix };
    (pix.width, pix.height, pix.pixelformat) =
        (width as u32, height as u32, u32::from_le_bytes(*b"GREY"));
    (pix.field, pix.bytesperline) = (v4l2_field_V4L2_FIELD_NONE, width as u32);
    pix.sizeimage = (width * height) as u32;
    ioctl(&device, vidioc::VIDIOC_S_FMT, &mut format);
    let mut request: v4l2_requestbuffers = zeroed();
    (request.count, request.type_, request.memory) = (8, kind, v4l2_memory_V4L2_MEMORY_MMAP);
    ioctl(&device, vidioc::VIDIOC_REQBUFS, &mut request);
    let mut maps: Vec<_> = (0..request.count)
        .map(|index| {
            let mut buffer = output_buffer(index);
            ioctl(&device, vidioc::VIDIOC_QUERYBUF, &mut buffer);
            // SAFETY: the member of mapped buffers.
            let offset = u64::from(unsafe { buffer.m.offset });
            let mut map = memmap2::MmapOptions::new();
            map.offset(offset).len(buffer.length as usize);
            // SAFETY: nobody shortens the device's memory.
            unsafe { map.map_mut(device.handle().fd()) }.expect("mapped")
        })
        .collect();
    ioctl(&device, vidioc::VIDIOC_STREAMON, &mut (kind as i32));
    let (start_s, mut image) = (now_s(), vec![0; width * height]);
    let header_bytes = header.len() as u64;
    let frame_bytes = (width * height + "FRAME\n".len()) as u64;
    for n in 0.. {
        if n == 0 || (n + first).is_multiple_of(frames) {
            let at = header_bytes + ((n + first) % frames) as u64 * frame_bytes;
            std::io::Seek::seek(&mut file, std::io::SeekFrom::Start(at)).expect("a file");
        }
        let mut line = String::new();
        file.read_line(&mut line).expect("FRAME");
        file.read_exact(&mut image).expect("a whole frame");
        let due_s = start_s + n as f64 / fps;
        std::thread::sleep(Duration::from_secs_f64((due_s - now_s()).max(0.0)));
        let index = n % maps.len();
        maps[index][..image.len()].copy_from_slice(&image);
        let mut buffer = output_buffer(index as u32);
        buffer.bytesused = image.len() as u32;
        buffer.timestamp.tv_sec = due_s as i64;
        buffer.timestamp.tv_usec = (due_s.fract() * 1e6) as i64;
        ioctl(&device, vidioc::VIDIOC_QBUF, &mut buffer);
        ioctl(&device, vidioc::VIDIOC_DQBUF, &mut output_buffer(0));
    }
}

fn output_buffer(index: u32) -> v4l2_buffer {
    let mut buffer: v4l2_buffer = zeroed();
    (buffer.index, buffer.memory) = (index, v4l2_memory_V4L2_MEMORY_MMAP);
    buffer.type_ = v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_OUTPUT;
    buffer
}

/// Stop one thread of a process for good, as a bug would.
fn freeze(pid: &str, thread: &str) {
    let tasks = format!("/proc/{pid}/task");
    for task in std::fs::read_dir(&tasks).expect("the process runs") {
        let path = task.expect("readable").path();
        let name = std::fs::read_to_string(path.join("comm")).expect("readable");
        if name.trim() == thread {
            let tid =
                path.file_name().and_then(|name| name.to_str()?.parse().ok()).expect("a number");
            let tid = Pid::from_raw(tid);
            ptrace::seize(tid, ptrace::Options::empty()).expect("may be traced");
            ptrace::interrupt(tid).expect("may be stopped");
            println!("{thread} is frozen");
            // Until it is killed; without a wait it would stay as a zombie, and its process with it.
            while let Ok(status) = waitpid(tid, Some(WaitPidFlag::__WALL)) {
                if matches!(status, WaitStatus::Exited(..) | WaitStatus::Signaled(..)) {
                    break;
                }
            }
            return;
        }
    }
    panic!("no thread {thread} in {tasks}");
}

/// A grey ramp in every format that the product knows: all must show the same picture.
fn formats(device: &str) {
    const SIZE: [usize; 2] = [640, 360];
    let picture = |format: &str| -> Vec<f64> {
        let mut settings = CameraTable::new("camera.toml".into());
        (settings.device, settings.format) = (Some(device.to_owned()), Some(format.to_owned()));
        // "Gray Ramp", and no text in it.
        settings.controls.insert("test_pattern".into(), 20.into());
        settings.controls.insert("osd_text_mode".into(), 2.into());
        let mut driver = open_camera(&settings, SIZE).unwrap_or_else(|e| panic!("{format}: {e}"));
        let (mut buffer, start) = (Block::own(SIZE[0] * SIZE[1]).expect("small"), Instant::now());
        let (mut frames, mut last, mut allocated) = (0, None, 0);
        while frames < 10 {
            assert!(start.elapsed() < Duration::from_mins(1), "{format}: no frames");
            if let Arrival::Frame { sequence, stride, .. } = driver.next(&mut buffer).expect(format)
            {
                assert!(last.is_none_or(|last| sequence > last), "{format}: numbers rise");
                (last, frames) = (Some(sequence), frames + 1);
                if frames == 3 {
                    allocated = allocations::count();
                }
                if frames == 10 {
                    assert_eq!(allocations::count(), allocated, "{format}: allocations for frames");
                    return buffer
                        .chunks(stride)
                        .take(SIZE[1])
                        .flat_map(|row| &row[..SIZE[0]])
                        .map(|v| f64::from(*v))
                        .collect();
                }
            }
        }
        unreachable!("the tenth frame returns");
    };
    let reference = picture("GREY");
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let centred = |v: &[f64]| {
        let mean = mean(v);
        v.iter().map(|v| v - mean).collect::<Vec<_>>()
    };
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let grey = centred(&reference);
    assert!(product(&grey, &grey) / grey.len() as f64 > 400.0, "the ramp is there");
    for format in ["Y10", "Y12", "Y16", "YUYV", "UYVY", "NV12", "BA81", "GBRG", "GRBG", "RGGB"] {
        let other = centred(&picture(format));
        // Range and steps of grey differ between formats, the picture does not.
        let correlation =
            product(&grey, &other) / (product(&grey, &grey) * product(&other, &other)).sqrt();
        println!("{format} {correlation:.5}");
        assert!(correlation > 0.999, "{format}");
    }
    // What the driver does not do is named, not taken for something else.
    for (format, size, said) in
        [("GREY", [641, 361], "asked for were GREY of 641 x 361 px"), ("MJPG", SIZE, "its formats")]
    {
        let mut settings = CameraTable::new("camera.toml".into());
        (settings.device, settings.format) = (Some(device.to_owned()), Some(format.to_owned()));
        let error = open_camera(&settings, size).err().expect("refused").to_string();
        assert!(error.contains(said), "{error}");
    }
    println!("all formats");
}
