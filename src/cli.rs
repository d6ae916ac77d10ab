//! The command line: every command and option, for the parser, the manual pages and the completions.

use beltgauge::run::log;
use beltgauge::sandbox;
use clap::{Parser, Subcommand};
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Headings in the help, in this order.
const INPUT: &str = "Input";
const BELT: &str = "Demo";
const BOARD: &str = "Board";
const LENS: &str = "Lens";
const GEOMETRY: &str = "Geometry";
const RESULTS: &str = "Results";
const MACHINE: &str = "Machine";
const GLOBAL: &str = "Of every command";

/// Measures parcels on a conveyor with one fixed camera.
#[derive(Parser)]
#[command(version)]
pub struct Cli {
    /// How the log on standard error looks; `RUST_LOG` says how much is in it.
    #[arg(long, global = true, value_enum, default_value_t = log::Format::Text, help_heading = GLOBAL)]
    pub log: log::Format,
    /// Become this user, given by number, and keep only the capabilities that are needed.
    #[arg(long, global = true, value_name = "NUMBER", help_heading = GLOBAL)]
    pub user: Option<u32>,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Run the appliance on a live camera, until SIGTERM.
    #[command(
        after_help = "Example: beltgauge run site/beltgauge.toml --status /run/beltgauge/status.json"
    )]
    Run {
        #[command(flatten)]
        config: ConfigFile,
        /// Write the state to this file, every second, as JSON.
        #[arg(long, value_name = "FILE", help_heading = RESULTS)]
        status: Option<PathBuf>,
        /// Record the camera's frames to this new Y4M file, their times to FILE.times beside it.
        #[arg(long, value_name = "FILE", help_heading = RESULTS)]
        record: Option<PathBuf>,
        /// Feed the hardware's watchdog, for example /dev/watchdog.
        #[arg(long, value_name = "DEVICE", help_heading = MACHINE)]
        watchdog: Option<PathBuf>,
    },
    /// Run the appliance on a synthetic belt: no camera, no PLC needed.
    #[command(
        after_help = "The belt stops on purpose. At the end measured and true sizes are printed."
    )]
    Demo {
        /// How long to run; 0: until Ctrl-C.
        #[arg(long, default_value_t = 30.0, help_heading = BELT)]
        seconds: f64,
        /// File with tables of a configuration that replace the demo's own, for example [can].
        #[arg(long, value_name = "FILE", help_heading = BELT)]
        config: Option<PathBuf>,
        /// Address and port of the Modbus server [default: 0.0.0.0:1502].
        #[arg(long, value_name = "ADDRESS:PORT", help_heading = BELT)]
        listen: Option<SocketAddr>,
        /// Address and port of the page [default: 127.0.0.1:8080, for this computer alone].
        #[arg(long, value_name = "ADDRESS:PORT", help_heading = BELT)]
        page: Option<SocketAddr>,
        /// Show a chessboard instead of parcels, to try the page's "Set up".
        #[arg(long, help_heading = BELT)]
        board: bool,
        /// Folder for the table, the records and the annotated pictures.
        #[arg(long, value_name = "DIR", default_value = "demo-out", help_heading = RESULTS)]
        out: PathBuf,
        /// New folder for a recording, its site, and stills to calibrate its camera with.
        #[arg(long, value_name = "DIR", help_heading = RESULTS)]
        record: Option<PathBuf>,
    },
    /// Measure a recording, as fast as it goes.
    #[command(after_help = "Any video, through ffmpeg:\n  \
        ffmpeg -v error -i pass.mkv -pix_fmt gray -f yuv4mpegpipe -strict -1 - |\n    \
        beltgauge measure - --config site/beltgauge.toml")]
    Measure {
        /// Y4M file, `-` for Y4M on standard input, or a directory of image files.
        input: PathBuf,
        /// Configuration file.
        #[arg(long, value_name = "FILE", help_heading = INPUT)]
        config: PathBuf,
        /// Frames a second, when the input does not say.
        #[arg(long, help_heading = INPUT)]
        fps: Option<f64>,
        /// Spoil the input: drop=SHARE,double=SHARE,swap=SHARE,late=MS,noise=GREY,codec=GREY,seed=N,
        /// any of them.
        #[arg(long, value_name = "FAULTS", help_heading = INPUT)]
        inject: Option<String>,
        /// Write one JSON line a parcel to this file.
        #[arg(long, value_name = "FILE", help_heading = RESULTS)]
        jsonl: Option<PathBuf>,
        /// Write annotated pictures to this folder.
        #[arg(long, value_name = "DIR", help_heading = RESULTS)]
        annotate: Option<PathBuf>,
        /// Write to this folder why each parcel was told as it was, and a picture of the belt's heights.
        #[arg(long, value_name = "DIR", help_heading = RESULTS)]
        explain: Option<PathBuf>,
    },
    /// Calibrate the camera: first its lens, then its place over the belt.
    #[command(subcommand)]
    Calibrate(Calibrate),
    /// Draw a chessboard to print, in true size.
    Board {
        /// Squares along both sides; 10x7 squares have 9x6 inner corners.
        #[arg(long, value_parser = squares)]
        squares: [usize; 2],
        /// Side of a square.
        #[arg(long, value_parser = positive)]
        square_mm: f64,
        /// File to write, .svg or .pdf.
        #[arg(long)]
        out: PathBuf,
    },
    /// What a geometry can measure: expected standard deviations, before anything is bought.
    Budget(Budget),
    /// Validate a configuration and print the memory plan.
    Check {
        #[command(flatten)]
        config: ConfigFile,
        /// Print the JSON Schema of configuration files instead, for editors.
        #[arg(long, conflicts_with_all = ["file", "config", "store"])]
        schema: bool,
    },
    /// What was seen: parcels with their pictures, and events.
    Archive {
        #[command(subcommand)]
        what: Archive,
        /// The archive's folder [default: that of an appliance].
        #[arg(long, global = true, value_name = "DIR", help_heading = INPUT)]
        folder: Option<PathBuf>,
    },
    /// Do what inserting a USB stick does: put its configuration in force.
    Import {
        /// The stick: a folder with a folder `beltgauge` in it.
        #[arg(required_unless_present = "roll_back")]
        dir: Option<PathBuf>,
        /// Go back to the configuration before the one in force.
        #[arg(long, conflicts_with = "dir")]
        roll_back: bool,
        /// Say what would be put in force, and change nothing.
        #[arg(long, conflicts_with = "roll_back")]
        check: bool,
        /// Folder to put configurations into.
        #[arg(long, default_value = STORE)]
        store: PathBuf,
    },
    /// Print the code that is good for signing in to the page once, to change things there.
    Code {
        /// Folder that `import` puts configurations into.
        #[arg(long, default_value = STORE)]
        store: PathBuf,
    },
    /// List the files of a stick with their digests, to be signed as one set.
    Manifest {
        /// The stick: a folder with a folder `beltgauge` in it.
        dir: PathBuf,
        /// Higher than that of every set before, for example the date and a number: 2026112601.
        #[arg(long)]
        counter: u64,
    },
    /// Put the new system on a stick into the boot partition, to be tried at the next start.
    Update {
        /// The stick: a folder with `beltgauge/beltgauge.efi` in it.
        dir: PathBuf,
        /// Folder that `import` puts configurations into: its key is asked for.
        #[arg(long, default_value = STORE)]
        store: PathBuf,
        /// Folder of the boot partition.
        #[arg(long, default_value = "/boot/EFI/Linux")]
        to: PathBuf,
    },
    /// Print the completions of a shell.
    #[command(
        after_help = "Example: beltgauge completions bash > /etc/bash_completion.d/beltgauge"
    )]
    Completions {
        /// Which shell.
        shell: clap_complete::Shell,
    },
    /// Write the manual pages into a folder.
    Manual {
        /// The folder; it must be there.
        dir: PathBuf,
    },
    /// What this program starts as its own child, to parse what strangers bring.
    #[command(name = sandbox::SUBCOMMAND, hide = true)]
    Sandbox { task: String },
}

/// Where an appliance keeps its configurations.
pub const STORE: &str = "/var/lib/beltgauge";

/// Which configuration.
#[derive(clap::Args)]
pub struct ConfigFile {
    /// Configuration file [default: the one in force in the store].
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    /// The same.
    #[arg(long, value_name = "FILE", conflicts_with = "file", help_heading = INPUT)]
    config: Option<PathBuf>,
    /// Folder that `import` puts configurations into.
    #[arg(long, value_name = "DIR", default_value = STORE, help_heading = INPUT)]
    pub store: PathBuf,
}

impl ConfigFile {
    /// The file, if one was given.
    pub fn path(&self) -> Option<&Path> {
        self.file.as_deref().or(self.config.as_deref())
    }
}

#[derive(Subcommand)]
pub enum Archive {
    /// Print the last entries, newest first.
    List {
        /// How many.
        #[arg(long, default_value_t = 20, help_heading = INPUT)]
        last: usize,
    },
    /// Write all entries for other programs.
    Export {
        /// Parcels, a line each.
        #[arg(long, value_name = "FILE", help_heading = RESULTS)]
        csv: Option<PathBuf>,
        /// All entries, a line of JSON each.
        #[arg(long, value_name = "FILE", help_heading = RESULTS)]
        jsonl: Option<PathBuf>,
        /// Folder for the pictures, named by the numbers of their entries.
        #[arg(long, value_name = "DIR", help_heading = RESULTS)]
        pictures: Option<PathBuf>,
    },
    /// Say whether it is as it was written.
    Verify,
}

#[derive(clap::Args)]
pub struct Budget {
    /// Configuration file, instead of the options for a camera that looks straight down.
    #[arg(long, conflicts_with_all = ["camera_height_mm", "focal_px", "image", "zone_mm", "speed_mm_per_s"])]
    pub config: Option<PathBuf>,
    /// Lens over the belt.
    #[arg(long, value_parser = positive, required_unless_present = "config", help_heading = GEOMETRY)]
    pub camera_height_mm: Option<f64>,
    /// Focal length in pixels: that in mm over the size of a pixel.
    #[arg(long, value_parser = positive, required_unless_present = "config", help_heading = GEOMETRY)]
    pub focal_px: Option<f64>,
    /// Columns and rows, as 1920x1200.
    #[arg(long, value_parser = sides, required_unless_present = "config", help_heading = GEOMETRY)]
    pub image: Option<[usize; 2]>,
    /// Measuring zone along and across the belt, as 1200x760.
    #[arg(long, value_parser = sides, required_unless_present = "config", help_heading = GEOMETRY)]
    pub zone_mm: Option<[usize; 2]>,
    /// Belt speed.
    #[arg(long, value_parser = positive, required_unless_present = "config", help_heading = GEOMETRY)]
    pub speed_mm_per_s: Option<f64>,
    /// Frames a second.
    #[arg(long, value_parser = positive, help_heading = GEOMETRY)]
    pub fps: f64,
    /// Write table and plot to this HTML file.
    #[arg(long, help_heading = RESULTS)]
    pub out: Option<PathBuf>,
}

#[derive(Subcommand)]
pub enum Calibrate {
    /// The lens, from 10 to 20 images of a chessboard held at all places and tilts.
    Lens {
        /// Images (PNG, PGM, JPEG, BMP, TIFF), or folders of them.
        #[arg(required = true)]
        images: Vec<PathBuf>,
        /// Inner corners along both sides, as 9x6.
        #[arg(long, value_parser = board_size, help_heading = BOARD)]
        board: [usize; 2],
        /// Side of a square.
        #[arg(long, value_parser = positive, help_heading = BOARD)]
        square_mm: f64,
        /// Camera file to write; its report goes beside it as .html.
        #[arg(long, help_heading = RESULTS)]
        out: PathBuf,
        /// Lens model; fisheye for more than about 120 degrees of view.
        #[arg(long, value_enum, default_value_t = Model::Brown, help_heading = LENS)]
        model: Model,
        /// Focal length on the data sheet, as a start for the search.
        #[arg(long, requires = "sensor_width_mm", value_parser = positive, help_heading = LENS)]
        focal_mm: Option<f64>,
        /// Width of the sensor's image area on the data sheet.
        #[arg(long, requires = "focal_mm", value_parser = positive, help_heading = LENS)]
        sensor_width_mm: Option<f64>,
    },
    /// The place over the belt, from stills of the board lying on the belt and carried by it.
    Belt {
        /// Stills in order of time, or a folder of them. One gives the plane alone.
        #[arg(required_unless_present = "points")]
        images: Vec<PathBuf>,
        /// Further stills, of the board laid flat elsewhere on the belt: they make the plane surer.
        #[arg(long, num_args = 1.., conflicts_with = "points", help_heading = INPUT)]
        elsewhere: Vec<PathBuf>,
        /// Inner corners along both sides, as 9x6.
        #[arg(long, value_parser = board_size, required_unless_present = "points", help_heading = BOARD)]
        board: Option<[usize; 2]>,
        /// Side of a square.
        #[arg(long, value_parser = positive, required_unless_present = "points", help_heading = BOARD)]
        square_mm: Option<f64>,
        /// How far the board's printed face lies above the belt.
        #[arg(long, default_value_t = 0.0, value_parser = thickness, help_heading = BOARD)]
        board_thickness_mm: f64,
        /// Instead of stills: surveyed points, a line each: X,Y,Z in mm, u,v in px.
        #[arg(long, value_name = "FILE", help_heading = INPUT, conflicts_with_all = ["images", "board", "square_mm", "board_thickness_mm"])]
        points: Option<PathBuf>,
        /// What `calibrate lens` wrote.
        #[arg(long, help_heading = INPUT)]
        lens: PathBuf,
        /// Camera file to write; its report goes beside it as .html.
        #[arg(long, help_heading = RESULTS)]
        out: PathBuf,
    },
}

/// Lens models by name.
#[derive(Clone, Copy, clap::ValueEnum)]
pub enum Model {
    Brown,
    Fisheye,
}

/// Inner corners that make a board: fewer do not give a pose, more are a typing error.
const BOARD_CORNERS: RangeInclusive<usize> = 3..=60;

fn board_size(text: &str) -> std::result::Result<[usize; 2], String> {
    let sides = text.split_once(['x', 'X']).map(|(a, b)| [a.trim().parse(), b.trim().parse()]);
    match sides {
        Some([Ok(a), Ok(b)]) if BOARD_CORNERS.contains(&a) && BOARD_CORNERS.contains(&b) => {
            Ok([a, b])
        }
        _ => Err(format!(
            "give the inner corners along both sides, {} to {}, as 9x6 for 10 by 7 squares",
            BOARD_CORNERS.start(),
            BOARD_CORNERS.end()
        )),
    }
}

fn sides(text: &str) -> std::result::Result<[usize; 2], String> {
    let sides = text.split_once(['x', 'X']).map(|(a, b)| [a.trim().parse(), b.trim().parse()]);
    match sides {
        Some([Ok(a), Ok(b)]) if (16..=20_000).contains(&a) && (16..=20_000).contains(&b) => {
            Ok([a, b])
        }
        _ => Err("give both sides, 16 to 20000, as 1920x1200".to_owned()),
    }
}

fn squares(text: &str) -> std::result::Result<[usize; 2], String> {
    let sides = text.split_once(['x', 'X']).map(|(a, b)| [a.trim().parse(), b.trim().parse()]);
    match sides {
        Some([Ok(a), Ok(b)]) => Ok([a, b]),
        _ => Err("give the squares along both sides, as 10x7".to_owned()),
    }
}

fn positive(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 10_000.0 => Ok(value),
        _ => Err("give a number above 0, at most 10000".to_owned()),
    }
}

fn thickness(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=200.0).contains(&value) => Ok(value),
        _ => Err("give a number of mm, 0 to 200".to_owned()),
    }
}
