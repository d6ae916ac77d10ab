//! Command line only: arguments in, exit status out.

use beltgauge::camera::LensModel;
use beltgauge::camera::chessboard::Chessboard;
use beltgauge::config::Site;
use beltgauge::error::{Error, Result};
use beltgauge::event::ParcelRecord;
use beltgauge::run::archive::{self, Export};
use beltgauge::run::board;
use beltgauge::run::budget::{self, StraightDown};
use beltgauge::run::calibrate::{self, DataSheet};
use beltgauge::run::offline::{self, Observer, Outputs};
use beltgauge::run::outputs::refuse_inputs;
use beltgauge::run::{demo, import, live, log, privileges, update};
use beltgauge::source::{FaultInjector, Faults};
use beltgauge::store::{Store, manifest};
use beltgauge::{run, sandbox, source};
use clap::{Parser, Subcommand};
use std::io::{IsTerminal, Write};
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use tracing::Level;

/// Measures parcels on a conveyor with one fixed camera.
#[derive(Parser)]
#[command(version)]
struct Cli {
    /// How the log on standard error looks; `RUST_LOG` says how much is in it.
    #[arg(long, global = true, value_enum, default_value_t = log::Format::Text)]
    log: log::Format,
    /// Become this user, given by number, and keep only the capabilities that are needed.
    #[arg(long, global = true)]
    user: Option<u32>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run the appliance on a live camera, until SIGTERM.
    Run {
        /// Configuration file [default: the one in force in the store].
        #[arg(long)]
        config: Option<PathBuf>,
        /// Folder that `import` puts configurations into.
        #[arg(long, default_value = STORE)]
        store: PathBuf,
        /// Write the state to this file, every second, as JSON.
        #[arg(long)]
        status: Option<PathBuf>,
        /// Feed the hardware's watchdog, for example /dev/watchdog.
        #[arg(long)]
        watchdog: Option<PathBuf>,
        /// Record the camera's frames to this new Y4M file, their times to FILE.times beside it.
        #[arg(long)]
        record: Option<PathBuf>,
    },
    /// Run the appliance on a synthetic belt: no camera, no PLC needed.
    Demo {
        /// How long to run.
        #[arg(long, default_value_t = 30.0)]
        seconds: f64,
        /// Folder for the table, the records and the annotated pictures.
        #[arg(long, default_value = "demo-out")]
        out: PathBuf,
        /// Address and port of the Modbus server [default: 0.0.0.0:1502].
        #[arg(long)]
        listen: Option<SocketAddr>,
        /// Address and port of the page [default: 0.0.0.0:8080].
        #[arg(long)]
        page: Option<SocketAddr>,
        /// File with tables of a configuration that replace the demo's own, for example [can].
        #[arg(long)]
        config: Option<PathBuf>,
        /// Folder for a recording, its site, and stills to calibrate its camera with.
        #[arg(long)]
        record: Option<PathBuf>,
    },
    /// Measure a recording, as fast as it goes.
    Measure {
        /// Y4M file, `-` for Y4M on standard input, or a directory of image files.
        input: PathBuf,
        /// Configuration file.
        #[arg(long)]
        config: PathBuf,
        /// Frames a second, when the input does not say.
        #[arg(long)]
        fps: Option<f64>,
        /// Write one JSON line a parcel to this file.
        #[arg(long)]
        jsonl: Option<PathBuf>,
        /// Write annotated pictures to this folder.
        #[arg(long)]
        annotate: Option<PathBuf>,
        /// Write a second opinion to this folder: heights by known motion over the whole pass, as
        /// records and as a picture.
        #[arg(long, value_name = "DIR")]
        explain: Option<PathBuf>,
        /// Spoil the input: drop=SHARE,double=SHARE,late=MS,noise=GREY,seed=N, any of them.
        #[arg(long)]
        inject: Option<String>,
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
        /// Configuration file [default: the one in force in the store].
        #[arg(long)]
        config: Option<PathBuf>,
        /// Folder that `import` puts configurations into.
        #[arg(long, default_value = STORE)]
        store: PathBuf,
    },
    /// What was seen: parcels with their pictures, and events.
    Archive {
        #[command(subcommand)]
        what: Archive,
        /// The archive's folder [default: that of an appliance].
        #[arg(long, global = true)]
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
        /// Folder to put configurations into.
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
    /// What this program starts as its own child, to parse what strangers bring.
    #[command(name = sandbox::SUBCOMMAND, hide = true)]
    Sandbox { task: String },
}

/// Where an appliance keeps its configurations.
const STORE: &str = "/var/lib/beltgauge";

#[derive(Subcommand)]
enum Archive {
    /// Print the last entries, newest first.
    List {
        /// How many.
        #[arg(long, default_value_t = 20)]
        last: usize,
    },
    /// Write all entries for other programs.
    Export {
        /// Parcels, a line each.
        #[arg(long)]
        csv: Option<PathBuf>,
        /// All entries, a line of JSON each.
        #[arg(long)]
        jsonl: Option<PathBuf>,
        /// Folder for the pictures, named by the numbers of their entries.
        #[arg(long)]
        pictures: Option<PathBuf>,
    },
    /// Say whether it is as it was written.
    Verify,
}

#[derive(clap::Args)]
struct Budget {
    /// Configuration file, instead of the options for a camera that looks straight down.
    #[arg(long, conflicts_with_all = ["camera_height_mm", "focal_px", "image", "zone_mm", "speed_mm_per_s"])]
    config: Option<PathBuf>,
    /// Lens over the belt.
    #[arg(long, value_parser = positive, required_unless_present = "config")]
    camera_height_mm: Option<f64>,
    /// Focal length in pixels: that in mm over the size of a pixel.
    #[arg(long, value_parser = positive, required_unless_present = "config")]
    focal_px: Option<f64>,
    /// Columns and rows, as 1920x1200.
    #[arg(long, value_parser = sides, required_unless_present = "config")]
    image: Option<[usize; 2]>,
    /// Measuring zone along and across the belt, as 1200x760.
    #[arg(long, value_parser = sides, required_unless_present = "config")]
    zone_mm: Option<[usize; 2]>,
    /// Belt speed.
    #[arg(long, value_parser = positive, required_unless_present = "config")]
    speed_mm_per_s: Option<f64>,
    /// Frames a second.
    #[arg(long, value_parser = positive)]
    fps: f64,
    /// Write table and plot to this HTML file.
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(Subcommand)]
enum Calibrate {
    /// The lens, from 10 to 20 images of a chessboard held at all places and tilts.
    Lens {
        /// Images (PNG, PGM, JPEG, BMP, TIFF), or folders of them.
        #[arg(required = true)]
        images: Vec<PathBuf>,
        /// Inner corners along both sides, as 9x6.
        #[arg(long, value_parser = board_size)]
        board: [usize; 2],
        /// Side of a square.
        #[arg(long, value_parser = positive)]
        square_mm: f64,
        /// Camera file to write; its report goes beside it as .html.
        #[arg(long)]
        out: PathBuf,
        /// Lens model; fisheye for more than about 120 degrees of view.
        #[arg(long, value_enum, default_value_t = Model::Brown)]
        model: Model,
        /// Focal length on the data sheet, as a start for the search.
        #[arg(long, requires = "sensor_width_mm", value_parser = positive)]
        focal_mm: Option<f64>,
        /// Width of the sensor's image area on the data sheet.
        #[arg(long, requires = "focal_mm", value_parser = positive)]
        sensor_width_mm: Option<f64>,
    },
    /// The place over the belt, from stills of the board lying on the belt and carried by it.
    Belt {
        /// Stills in order of time, or a folder of them. One gives the plane alone.
        #[arg(required_unless_present = "points")]
        images: Vec<PathBuf>,
        /// Further stills, of the board laid flat elsewhere on the belt: they make the plane surer.
        #[arg(long, num_args = 1.., conflicts_with = "points")]
        elsewhere: Vec<PathBuf>,
        /// Inner corners along both sides, as 9x6.
        #[arg(long, value_parser = board_size, required_unless_present = "points")]
        board: Option<[usize; 2]>,
        /// Side of a square.
        #[arg(long, value_parser = positive, required_unless_present = "points")]
        square_mm: Option<f64>,
        /// How far the board's printed face lies above the belt.
        #[arg(long, default_value_t = 0.0, value_parser = thickness)]
        board_thickness_mm: f64,
        /// Instead of stills: surveyed points, a line each: X,Y,Z in mm, u,v in px.
        #[arg(long, conflicts_with_all = ["images", "board", "square_mm", "board_thickness_mm"])]
        points: Option<PathBuf>,
        /// What `calibrate lens` wrote.
        #[arg(long)]
        lens: PathBuf,
        /// Camera file to write; its report goes beside it as .html.
        #[arg(long)]
        out: PathBuf,
    },
}

/// Lens models by name.
#[derive(Clone, Copy, clap::ValueEnum)]
enum Model {
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

fn main() -> ExitCode {
    let cli = Cli::parse();
    let is_appliance = matches!(cli.command, Command::Run { .. } | Command::Demo { .. });
    // An appliance's log is all that it leaves; a tool's results speak for themselves.
    let level = if matches!(cli.command, Command::Run { .. }) { Level::INFO } else { Level::WARN };
    // A sandbox's standard error says how it ended.
    let is_sandbox = matches!(cli.command, Command::Sandbox { .. });
    // Before any thread is started: the kernel knows users of threads only.
    if let Err(error) = cli.user.map_or(Ok(()), privileges::become_user) {
        let _ = writeln!(std::io::stderr(), "error: {error}");
        return ExitCode::from(error.exit_status());
    }
    let log = (!is_sandbox).then(|| log::start(level, cli.log));
    if is_appliance {
        run::end_on_panic();
    }
    let ended = dispatch(cli.command);
    let status = match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::say(format_args!("error: {error}\n"));
            ExitCode::from(error.exit_status())
        }
    };
    // Writes what is left; when nobody reads it ends all the same.
    drop(log);
    status
}

/// A line on standard output.
fn print(line: std::fmt::Arguments<'_>) -> Result<()> {
    writeln!(std::io::stdout(), "{line}")
        .map_err(|e| Error::failure(format!("cannot write to standard output: {e}")))
}

/// Records on standard output, progress on a terminal's standard error.
struct Console;

impl Observer for Console {
    fn frame(&mut self, index: u64) {
        if index.is_multiple_of(20) && std::io::stderr().is_terminal() {
            let _ = write!(std::io::stderr(), "\rframe {index} ");
        }
    }

    fn record(&mut self, record: &ParcelRecord) {
        if std::io::stderr().is_terminal() {
            let _ = write!(std::io::stderr(), "\r");
        }
        // The record file goes on when nobody reads the table any more.
        let _ = writeln!(std::io::stdout(), "{record}");
    }

    fn doubt(&mut self, doubt: &str) {
        let _ = writeln!(std::io::stderr(), "warning: {doubt}");
    }
}

fn dispatch(command: Command) -> Result<()> {
    match command {
        Command::Demo { seconds, out, listen, page, config, record } => {
            let (config, record) = (config.as_deref(), record.as_deref());
            let options = demo::Options { seconds, out: &out, listen, page, config, record };
            let table = demo::run(options)?;
            print(format_args!("{table}\npictures and records are in {}", out.display()))
        }
        Command::Measure { input, config, fps, jsonl, annotate, explain, inject } => {
            let site = Site::load(&config)?;
            let outputs = Outputs {
                jsonl: jsonl.as_deref(),
                annotate: annotate.as_deref(),
                explain: explain.as_deref(),
            };
            let camera = config.with_file_name(&site.config.camera.calibration);
            outputs.refuse_inputs(&[&input, &config, &camera])?;
            let faults = inject.as_deref().map(Faults::parse).transpose()?;
            let source = source::open(&input, fps)?;
            let source: Box<dyn source::FrameSource> = match faults {
                Some(faults) => Box::new(FaultInjector::new(source, faults)),
                None => source,
            };
            print(format_args!("{}", ParcelRecord::TABLE_HEADER))?;
            let counters = offline::measure(source, site, outputs, &mut Console)?;
            print(format_args!("{counters}"))
        }
        Command::Calibrate(what) => calibrate(what),
        Command::Board { squares, square_mm, out } => print_board(squares, square_mm, &out),
        Command::Budget(what) => print_budget(&what),
        Command::Run { config, store, status, watchdog, record } => live::run(&live::Options {
            config: config.as_deref(),
            store: &store,
            status: status.as_deref(),
            watchdog: watchdog.as_deref(),
            record: record.as_deref(),
        }),
        Command::Archive { what, folder } => {
            let folder = folder.unwrap_or_else(|| Store::new(Path::new(STORE)).archive());
            let report = match what {
                Archive::List { last } => archive::list(&folder, last)?,
                Archive::Export { csv, jsonl, pictures } => {
                    let (csv, jsonl) = (csv.as_deref(), jsonl.as_deref());
                    let pictures = pictures.as_deref();
                    archive::export(&folder, Export { csv, jsonl, pictures })?
                }
                Archive::Verify => archive::verify(&folder)?,
            };
            print(format_args!("{}", report.trim_end()))
        }
        Command::Import { dir, store, .. } => {
            let store = Store::new(&store);
            let report = match dir {
                Some(dir) => import::import(&dir, &store)?,
                None => import::roll_back(&store)?,
            };
            print(format_args!("{}", report.trim_end()))
        }
        Command::Manifest { dir, counter } => {
            print(format_args!("{}", manifest::make(&dir, counter)?))
        }
        Command::Update { dir, store, to } => {
            let report = update::update(&dir, &Store::new(&store), &to)?;
            print(format_args!("{}", report.trim_end()))
        }
        Command::Sandbox { task } => source::serve_sandboxed(&task),
        Command::Check { config, store } => {
            let site = match config {
                Some(config) => Site::load(&config),
                None => Store::new(&store).site(),
            }?;
            let plan = run::plan(&site);
            print(format_args!("{plan}"))?;
            plan.check_limit(site.config.limits.memory_mib_max)?;
            print(format_args!("the configuration is valid"))
        }
    }
}

fn print_board(squares: [usize; 2], square_mm: f64, out: &Path) -> Result<()> {
    let sheet = board::sheet(squares, square_mm)?;
    sheet.save(out)?;
    if Chessboard::new(squares.map(|n| n - 1), square_mm).is_symmetric() {
        let _ = writeln!(
            std::io::stderr(),
            "warning: this board looks the same after half a turn; an even count along one side and an \
             odd one along the other tell its ends apart"
        );
    }
    let [squares, page] = &sheet.text;
    print(format_args!("wrote {}: {squares}\n{page}", out.display()))
}

fn print_budget(what: &Budget) -> Result<()> {
    let site = match what {
        Budget { config: Some(config), .. } => {
            let site = Site::load(config)?;
            let camera = config.with_file_name(&site.config.camera.calibration);
            if let Some(out) = &what.out {
                refuse_inputs("--out", out, &[config, &camera])?;
            }
            site
        }
        Budget {
            camera_height_mm: Some(camera_height_mm),
            focal_px: Some(focal_px),
            image: Some(image_size_px),
            zone_mm: Some(zone_mm),
            speed_mm_per_s: Some(speed_mm_per_s),
            ..
        } => StraightDown {
            camera_height_mm: *camera_height_mm,
            focal_px: *focal_px,
            image_size_px: *image_size_px,
            zone_mm: zone_mm.map(|n| n as f64),
            speed_mm_per_s: *speed_mm_per_s,
        }
        .site()?,
        _ => return Err(Error::configuration("give --config or all options of the geometry")),
    };
    print(format_args!("{}", budget::run(&site, what.fps, what.out.as_deref())?))
}

fn calibrate(what: Calibrate) -> Result<()> {
    let mut say = |line: &str| print(format_args!("{line}"));
    let (warnings, out) = match what {
        Calibrate::Lens { images, board, square_mm, out, model, focal_mm, sensor_width_mm } => {
            let board = Chessboard::new(board, square_mm);
            let model = match model {
                Model::Brown => LensModel::Brown,
                Model::Fisheye => LensModel::Fisheye,
            };
            let data_sheet = focal_mm
                .zip(sensor_width_mm)
                .map(|(focal_mm, sensor_width_mm)| DataSheet { focal_mm, sensor_width_mm });
            (calibrate::lens(&images, &board, model, data_sheet, &out, &mut say)?, out)
        }
        Calibrate::Belt { points: Some(csv), lens, out, .. } => {
            (calibrate::points(&csv, &lens, &out, &mut say)?, out)
        }
        Calibrate::Belt {
            images,
            elsewhere,
            board,
            square_mm,
            board_thickness_mm: thickness_mm,
            lens,
            out,
            ..
        } => {
            let (Some(board), Some(square_mm)) = (board, square_mm) else {
                return Err(Error::configuration("--board and --square-mm are missing"));
            };
            let board = Chessboard::new(board, square_mm);
            let (images, elsewhere) = (&images[..], &elsewhere[..]);
            let warnings =
                calibrate::belt(images, elsewhere, &board, thickness_mm, &lens, &out, &mut say)?;
            (warnings, out)
        }
    };
    for warning in &warnings {
        let _ = writeln!(std::io::stderr(), "warning: {warning}");
    }
    print(format_args!("wrote {} and {}", out.display(), out.with_extension("html").display()))
}
