//! Command line only: arguments in, exit status out.

use beltgauge::config::Site;
use beltgauge::error::{Error, Result};
use beltgauge::event::ParcelRecord;
use beltgauge::run::demo;
use beltgauge::run::offline::{self, Observer, Outputs};
use beltgauge::{run, source};
use clap::{Parser, Subcommand};
use std::io::{IsTerminal, Write};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use tracing::Level;
use tracing_subscriber::EnvFilter;

/// Measures parcels on a conveyor with one fixed camera.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
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
    },
    /// Measure a recording, as fast as it goes.
    Measure {
        /// Y4M file, `-` for Y4M on standard input, or a directory of PNG, PGM or JPEG frames.
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
    },
    /// Validate a configuration and print the memory plan.
    Check {
        /// Configuration file.
        #[arg(long, default_value = "/etc/beltgauge/beltgauge.toml")]
        config: PathBuf,
    },
}

fn main() -> ExitCode {
    // Logs go beside the results, on standard error: RUST_LOG=beltgauge=debug shows more.
    let filter = EnvFilter::builder().with_default_directive(Level::WARN.into()).from_env_lossy();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    match dispatch(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "error: {error}");
            ExitCode::from(error.exit_status())
        }
    }
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
}

fn dispatch(command: Command) -> Result<()> {
    match command {
        Command::Demo { seconds, out, listen } => {
            let table = demo::run(demo::Options { seconds, out: &out, listen })?;
            print(format_args!("{table}\npictures and records are in {}", out.display()))
        }
        Command::Measure { input, config, fps, jsonl, annotate } => {
            let site = Site::load(&config)?;
            let outputs = Outputs { jsonl: jsonl.as_deref(), annotate: annotate.as_deref() };
            let source = source::open(&input, fps)?;
            print(format_args!("{}", ParcelRecord::TABLE_HEADER))?;
            let counters = offline::measure(source, site, outputs, &mut Console)?;
            print(format_args!("{counters}"))
        }
        Command::Check { config } => {
            let site = Site::load(&config)?;
            let plan = run::plan(&site);
            print(format_args!("{plan}"))?;
            plan.check_limit(site.config.limits.memory_mib_max)?;
            print(format_args!("the configuration is valid"))
        }
    }
}
