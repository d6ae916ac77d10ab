//! Command line only: arguments in, exit status out.

mod cli;

use beltgauge::camera::LensModel;
use beltgauge::camera::chessboard::Chessboard;
use beltgauge::config::{self, Site};
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
use beltgauge::{run, source};
use clap::{CommandFactory, Parser};
use cli::{Archive, Budget, Calibrate, Cli, Command, Model, STORE};
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;
use tracing::Level;

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
    // Writes what is left; when nobody reads it ends all the same.
    drop(log);
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::last_words(format!("error: {error}\n"));
            ExitCode::from(error.exit_status())
        }
    }
}

/// A line on standard output.
fn print(line: std::fmt::Arguments<'_>) -> Result<()> {
    match writeln!(std::io::stdout(), "{line}") {
        // Whoever read it has seen enough, as `head` has.
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        written => {
            written.map_err(|e| Error::failure(format!("cannot write to standard output: {e}")))
        }
    }
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
        Command::Demo { seconds, out, listen, page, config, record, board } => {
            let (config, record) = (config.as_deref(), record.as_deref());
            let options = demo::Options { seconds, out: &out, listen, page, config, record, board };
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
            let camera = site.config.camera.calibration.clone();
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
        Command::Run { config, status, watchdog, record } => live::run(&live::Options {
            config: config.path(),
            store: &config.store,
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
        Command::Import { dir, check, store, .. } => {
            let store = Store::new(&store);
            let report = match dir {
                Some(dir) if check => import::check(&dir, &store)?,
                Some(dir) => import::import(&dir, &store)?,
                None => import::roll_back(&store)?,
            };
            print(format_args!("{}", report.trim_end()))
        }
        Command::Code { store } => print(format_args!("{}", Store::new(&store).code()?)),
        Command::Manifest { dir, counter } => {
            print(format_args!("{}", manifest::make(&dir, counter)?))
        }
        Command::Update { dir, store, to } => {
            let report = update::update(&dir, &Store::new(&store), &to)?;
            print(format_args!("{}", report.trim_end()))
        }
        Command::Sandbox { task } => source::serve_sandboxed(&task),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "beltgauge", &mut script);
            print(format_args!("{}", String::from_utf8_lossy(&script).trim_end()))
        }
        Command::Manual { dir } => clap_mangen::generate_to(Cli::command(), &dir).map_err(|e| {
            Error::failure(format!("cannot write the manual pages: {e}")).in_file(&dir)
        }),
        Command::Check { schema: true, .. } => {
            print(format_args!("{}", config::json_schema().trim_end()))
        }
        Command::Check { config, .. } => {
            let site = match config.path() {
                Some(config) => Site::load(config),
                None => Store::new(&config.store).site(),
            }?;
            let plan = run::plan(&site);
            print(format_args!("{plan}"))?;
            plan.check_limit(site.config.limits.memory_mib_max)?;
            if let Err(e) = source::check_interface(site.config.camera.interface) {
                let _ = writeln!(std::io::stderr(), "warning: {e}");
            }
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
            let camera = site.config.camera.calibration.clone();
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
