//! The image that is flashed, in QEMU: booted by UEFI or, where only the system in it matters, directly;
//! with a camera that plays a rendered belt, USB sticks that are plugged in while it runs, and its
//! power cut. See `hil/image`.

use crate::plc::Plc;
use crate::shell::Shell;
use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener};
use std::ops::{Deref, DerefMut};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// Frames a second of the camera: an emulated processor needs 0.2 s for one.
const FPS: f64 = 4.0;
const SPEED_MM_PER_S: f64 = 80.0;
/// The belt is empty at first for so long: the appliance starts and learns it.
const EMPTY_MM: f64 = 1400.0;
/// Length, width, height of the parcels, which come again and again.
pub const PARCELS: [[f64; 3]; 3] =
    [[235.0, 125.0, 70.0], [300.0, 200.0, 150.0], [180.0, 140.0, 40.0]];
/// Frames of the recording: then all have left.
const FRAMES: u64 = 220;
/// The frame in which the first parcel is in the middle.
const PARCELS_IN_VIEW: u64 = 90;

/// Which processor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arch {
    /// Intel's and AMD's.
    X86,
    /// ARM64.
    Arm,
}

impl Arch {
    /// Its name, as `uname -m` has it.
    pub fn name(self) -> &'static str {
        match self {
            Self::X86 => "x86_64",
            Self::Arm => "aarch64",
        }
    }
}

/// How it is started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Boot {
    /// Firmware, boot loader, unified kernel image, from the disk.
    Uefi,
    /// The same kernel and initramfs without the firmware, which takes half of the time.
    Direct,
    /// The same on a belt with parcels already on it, so that the first leaves soon.
    DirectAmongParcels,
}

/// What the tests share: the image, the recording, and where they work.
pub struct Bench {
    arch: Arch,
    out: PathBuf,
}

impl Bench {
    /// Make the image and render the belt, if need be.
    ///
    /// # Panics
    /// When that fails: then no test makes sense.
    pub fn new(arch: Arch) -> Self {
        let out = crate::project().join("target/hil-out/image");
        std::fs::create_dir_all(&out).expect("room");
        let bench = Self { arch, out: out.canonicalize().expect("there") };
        let site = bench.site("site", SiteOptions::default());
        run(Command::new(crate::project().join("hil/image/make"))
            .arg(arch.name())
            .arg(&bench.out)
            .arg(site));
        bench.render();
        bench
    }

    fn scenario() -> Scenario {
        let mut text = format!(
            "seed = 5\nfps = {FPS}\nframes = {FRAMES}\nexposure_ms = 2.0\n[camera]\n{}\n[belt]\n\
             speed_mm_per_s = {SPEED_MM_PER_S}\nwidth_mm = 900\ngrey = 50\ntexture_grey = 1.3\n",
            CAMERA.replace("[lens]", "[camera.lens]").replace("[pose]", "[camera.pose]")
        );
        for (i, [length, width, height]) in PARCELS.into_iter().enumerate() {
            let (x, y) = (-1000.0 - EMPTY_MM + 500.0 - 560.0 * i as f64, 40.0 * i as f64 - 50.0);
            let _ = writeln!(
                text,
                "[[parcel]]\nx_mm = {x}\ny_mm = {y}\nyaw_deg = {}\nlength_mm = {length}\n\
                 width_mm = {width}\nheight_mm = {height}\nmaterial = \"kraft\"",
                8.0 * i as f64 - 5.0,
            );
        }
        Scenario::parse(&text).expect("a valid scenario")
    }

    /// The recording that the loopback camera plays, as a disk.
    fn render(&self) {
        let path = self.recording();
        let mut source = Synthetic::new(Self::scenario()).expect("renders");
        let [width, height] = source.size_px();
        let mut bytes =
            format!("YUV4MPEG2 W{width} H{height} F{FPS}:1 Cmono X{FRAMES}\n").into_bytes();
        let mut frame = vec![0; width * height];
        while source.next_into(&mut frame).expect("renders").is_some() {
            bytes.extend(b"FRAME\n");
            bytes.extend(&frame);
        }
        bytes.resize(bytes.len().next_multiple_of(512), 0);
        std::fs::write(path, bytes).expect("room");
    }

    fn recording(&self) -> PathBuf {
        self.out.join("belt.y4m")
    }

    /// A folder with a site, made anew.
    ///
    /// # Panics
    /// When there is no room.
    pub fn site(&self, name: &str, options: SiteOptions<'_>) -> PathBuf {
        let folder = self.out.join(name);
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).expect("room");
        let SiteOptions { scale_interval_mm, device, more } = options;
        let can = match self.arch {
            Arch::X86 => "[can]\ninterface = \"can0\"\nbitrate = 500000\n",
            Arch::Arm => "",
        };
        let text = format!(
            "[camera]\ncalibration = \"camera.toml\"\ndevice = \"{device}\"\n{more}\n[zone]\n\
             x_min_mm = -500\nx_max_mm = 500\ny_min_mm = -300\ny_max_mm = 300\n[belt]\n\
             speed_mm_per_s = 81.6\n{can}[plc]\nqueue = true\nscale_interval_mm = {scale_interval_mm}\n\
             [modbus]\nwrite_allow = [\"0.0.0.0\"]\n"
        );
        std::fs::write(folder.join("beltgauge.toml"), text).expect("room");
        std::fs::write(folder.join("camera.toml"), CAMERA).expect("room");
        folder
    }

    /// A stick's FAT image with a folder `beltgauge` of these files.
    ///
    /// # Panics
    /// When it cannot be made.
    pub fn stick(&self, name: &str, files: &[PathBuf]) -> PathBuf {
        let image = self.out.join(format!("{name}.stick"));
        let _ = std::fs::remove_file(&image);
        run(Command::new("truncate").args(["-s", "48M"]).arg(&image));
        run(Command::new("/sbin/mkfs.vfat").arg(&image));
        run(Command::new("mmd").arg("-i").arg(&image).arg("::beltgauge"));
        for file in files {
            run(Command::new("mcopy").arg("-i").arg(&image).arg(file).arg("::beltgauge"));
        }
        image
    }

    /// The unified kernel image.
    pub fn system(&self) -> PathBuf {
        self.out.join(format!("beltgauge-{}.efi", self.arch.name()))
    }

    /// A system whose program writes what a working one writes, and crashes every three seconds.
    ///
    /// # Panics
    /// When it cannot be made.
    pub fn crashing_system(&self) -> PathBuf {
        let script = r#"set -euo pipefail
            rm -rf crashing && cp -r "$1" crashing
            rm crashing/bin/beltgauge
            printf '#!/bin/sh\nfor s in 1 2 3; do\necho "{\"camera_absent\":false,\"frames\":$(date +%%s)}" >/run/beltgauge/status.json\nsleep 1\ndone\nexit 1\n' >crashing/bin/beltgauge
            chmod +x crashing/bin/beltgauge
            (cd crashing && find . | cpio --quiet -o -H newc -R 0:0) | xz --check=crc32 -1 >crashing.initrd
            objcopy --update-section .initrd=crashing.initrd "$2" crashing.efi"#;
        let root = self.out.join(self.arch.name()).join("root");
        run(Command::new("bash")
            .args(["-c", script, "bash"])
            .arg(root)
            .arg(self.system())
            .current_dir(&self.out));
        self.out.join("crashing.efi")
    }

    /// The binary inside.
    pub fn binary(&self) -> PathBuf {
        self.out.join(self.arch.name()).join("root/bin/beltgauge")
    }

    /// A fresh copy of the flashed disk; what is empty on it takes no room.
    ///
    /// # Panics
    /// When there is no room.
    pub fn disk(&self, name: &str) -> PathBuf {
        let disk = self.out.join(format!("{name}.disk"));
        let image = self.out.join(format!("test-{}.img", self.arch.name()));
        run(Command::new("cp").arg("--sparse=always").args([&image, &disk]));
        disk
    }

    /// Start a machine from a disk; returns when its shell is there.
    ///
    /// # Panics
    /// When it does not start.
    pub fn boot(&self, disk: &Path, boot: Boot) -> Appliance {
        self.boot_with(disk, boot, None)
    }

    /// The same with a stick in it at power-on.
    ///
    /// # Panics
    /// When it does not start.
    pub fn boot_with(&self, disk: &Path, boot: Boot, stick: Option<&Path>) -> Appliance {
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let modbus = free.local_addr().expect("bound");
        drop(free);
        let name = disk.file_stem().expect("a name").to_string_lossy().into_owned();
        let qmp = self.out.join(format!("{name}.qmp"));
        let mut qemu = self.qemu(disk, &name, boot, modbus, &qmp);
        if let Some(stick) = stick {
            let node = format!(
                "driver=raw,node-name=stick,file.driver=file,file.filename={}",
                stick.display()
            );
            qemu.arg("-blockdev").arg(node);
            qemu.args(["-device", "usb-storage,id=stick,drive=stick,removable=true"]);
        }
        let shell = Shell::start(qemu);
        shell.ready();
        let qmp = Qmp::connect(&qmp);
        Appliance { shell, qmp, modbus }
    }

    fn qemu(&self, disk: &Path, name: &str, boot: Boot, modbus: SocketAddr, qmp: &Path) -> Command {
        let mut qemu = Command::new(format!("qemu-system-{}", self.arch.name()));
        let out = self.out.join(self.arch.name());
        let console = self.out.join(format!("{name}.console"));
        match self.arch {
            Arch::X86 => {
                qemu.args(["-M", "q35", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2"]);
                qemu.arg("-serial").arg(format!("file:{}", console.display()));
                qemu.args(["-serial", "stdio"]);
                qemu.args(["-object", "can-bus,id=bus0"]);
                qemu.args([
                    "-device",
                    "kvaser_pci,canbus=bus0",
                    "-device",
                    "kvaser_pci,canbus=bus0",
                ]);
            }
            Arch::Arm => {
                qemu.args([
                    "-M",
                    "virt",
                    "-accel",
                    "tcg,thread=multi",
                    "-cpu",
                    "cortex-a72",
                    "-smp",
                    "2",
                ]);
                qemu.arg("-serial").arg(format!("file:{}", console.display()));
                qemu.args(["-chardev", "stdio,id=shell", "-device", "pci-serial,chardev=shell"]);
            }
        }
        qemu.args(["-m", "512", "-display", "none", "-monitor", "none"]);
        match (boot, self.arch) {
            (Boot::Direct | Boot::DirectAmongParcels, _) => {
                qemu.arg("-kernel")
                    .arg(out.join("vmlinuz"))
                    .arg("-initrd")
                    .arg(out.join("initramfs"));
                let first = if boot == Boot::Direct { 0 } else { PARCELS_IN_VIEW };
                let line = format!("console=ttyS0 console=ttyAMA0 quiet panic=5 hil.first={first}");
                qemu.arg("-append").arg(line);
            }
            (Boot::Uefi, Arch::X86) => {
                let code = "/usr/share/OVMF/OVMF_CODE_4M.fd";
                let variables = self.out.join(format!("{name}.vars"));
                std::fs::copy("/usr/share/OVMF/OVMF_VARS_4M.fd", &variables)
                    .expect("ovmf is installed");
                qemu.arg("-drive").arg(format!("if=pflash,format=raw,readonly=on,file={code}"));
                qemu.arg("-drive")
                    .arg(format!("if=pflash,format=raw,file={}", variables.display()));
            }
            (Boot::Uefi, Arch::Arm) => {
                qemu.args(["-bios", "/usr/share/qemu-efi-aarch64/QEMU_EFI.fd"]);
            }
        }
        // Completed writes are on the disk, as of one without a cache.
        for (index, (file, readonly)) in
            [(disk.to_owned(), "off"), (self.recording(), "on")].into_iter().enumerate()
        {
            let drive = format!(
                "if=none,id=drive{index},format=raw,cache=writethrough,readonly={readonly},file={}",
                file.display()
            );
            qemu.arg("-drive").arg(drive);
            qemu.arg("-device").arg(format!("virtio-blk-pci,drive=drive{index}"));
        }
        qemu.args(["-device", "i6300esb", "-watchdog-action", "reset", "-device", "qemu-xhci"]);
        qemu.arg("-nic").arg(format!("user,model=virtio-net-pci,hostfwd=tcp:{modbus}-:502"));
        qemu.arg("-qmp").arg(format!("unix:{},server=on,wait=off", qmp.display()));
        qemu
    }
}

/// What differs between sites.
#[derive(Clone, Copy, Debug)]
pub struct SiteOptions<'a> {
    /// Tells configurations apart, as the PLC sees it.
    pub scale_interval_mm: f64,
    /// The camera.
    pub device: &'a str,
    /// More lines of the table `[camera]`.
    pub more: &'a str,
}

impl Default for SiteOptions<'_> {
    fn default() -> Self {
        Self { scale_interval_mm: 0.1, device: "/dev/video0", more: "" }
    }
}

/// A metre above the belt, 2.9 mm a pixel.
const CAMERA: &str = "image_size_px = [640, 360]\n[lens]\nmodel = \"brown\"\nfx_px = 340.0\nfy_px = 340.0\n\
    cx_px = 319.5\ncy_px = 179.5\ndistortion = [-0.05, 0.01, 0.0, 0.0, 0.0]\n[pose]\n\
    rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\ntranslation_mm = [0, 0, 1000]\n";

fn run(command: &mut Command) {
    let status = command.status();
    assert!(
        status.as_ref().is_ok_and(std::process::ExitStatus::success),
        "{command:?}: {status:?}"
    );
}

/// A running appliance; dropped, its power is cut.
pub struct Appliance {
    shell: Shell,
    qmp: Qmp,
    /// Where its Modbus port is reached.
    pub modbus: SocketAddr,
}

impl Appliance {
    /// Plug a stick in.
    ///
    /// # Panics
    /// When QEMU refuses.
    pub fn plug(&mut self, image: &Path) {
        let file = image.display();
        self.qmp.ask(&format!(
            r#"{{"execute":"blockdev-add","arguments":{{"driver":"raw","node-name":"stick","file":{{"driver":"file","filename":"{file}"}}}}}}"#
        ));
        self.qmp.ask(
            r#"{"execute":"device_add","arguments":{"driver":"usb-storage","id":"stick","drive":"stick","removable":true}}"#,
        );
    }

    /// Pull it out.
    ///
    /// # Panics
    /// When QEMU refuses.
    pub fn pull(&mut self) {
        self.qmp.ask(r#"{"execute":"device_del","arguments":{"id":"stick"}}"#);
        let start = Instant::now();
        let delete = r#"{"execute":"blockdev-del","arguments":{"node-name":"stick"}}"#;
        while self.qmp.try_ask(delete).is_err() {
            assert!(start.elapsed() < Duration::from_secs(30), "the stick stays");
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    /// Wait for the stored number of a register of the status block.
    ///
    /// # Panics
    /// When it does not come to that.
    pub fn wait(&self, what: &str, name: &str, holds: impl Fn(u32) -> bool) -> u32 {
        let (plc, start) = (Plc::new(self.modbus), Instant::now());
        loop {
            let value = plc.status(name);
            if let Ok(value) = value
                && holds(value)
            {
                return value;
            }
            assert!(start.elapsed() < Duration::from_mins(3), "{what}: {name} is {value:?}");
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// A register of the status block, once it answers.
    pub fn status(&self, name: &str) -> u32 {
        self.wait("it answers", name, |_| true)
    }
}

impl Deref for Appliance {
    type Target = Shell;
    fn deref(&self) -> &Shell {
        &self.shell
    }
}

impl DerefMut for Appliance {
    fn deref_mut(&mut self) -> &mut Shell {
        &mut self.shell
    }
}

/// QEMU's own remote control.
struct Qmp(BufReader<UnixStream>);

impl Qmp {
    fn connect(path: &Path) -> Self {
        let mut qmp = Self(BufReader::new(UnixStream::connect(path).expect("QEMU listens")));
        qmp.0.read_line(&mut String::new()).expect("a greeting");
        qmp.ask(r#"{"execute":"qmp_capabilities"}"#);
        qmp
    }

    fn try_ask(&mut self, command: &str) -> Result<(), String> {
        writeln!(self.0.get_mut(), "{command}").expect("QEMU runs");
        loop {
            let mut line = String::new();
            self.0.read_line(&mut line).expect("QEMU runs");
            let answer: serde_json::Value = serde_json::from_str(&line).expect("JSON");
            if answer.get("return").is_some() {
                return Ok(());
            }
            if answer.get("error").is_some() {
                return Err(line);
            }
        }
    }

    fn ask(&mut self, command: &str) {
        self.try_ask(command).unwrap_or_else(|e| panic!("{command}: {e}"));
    }
}
