//! Command line only: arguments in, exit status out.

use beltgauge::config::Site;
use beltgauge::error::Result;
use beltgauge::run::offline::{self, Outputs};
use beltgauge::{pipeline, source};
use clap::{Parser, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;

/// Measures parcels on a conveyor with one fixed camera.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
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
    match dispatch(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(error.exit_status())
        }
    }
}

fn dispatch(command: Command) -> Result<()> {
    match command {
        Command::Measure { input, config, fps, jsonl, annotate } => {
            let site = Site::load(&config)?;
            let outputs = Outputs { jsonl: jsonl.as_deref(), annotate: annotate.as_deref() };
            let counters = offline::measure(source::open(&input, fps)?, site, outputs, &mut |r| {
                println!("{r:?}");
            })?;
            println!("{counters:?}");
            Ok(())
        }
        Command::Check { config } => {
            let site = Site::load(&config)?;
            println!("{}", pipeline::plan(&site));
            Ok(())
        }
    }
}
