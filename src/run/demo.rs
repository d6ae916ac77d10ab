//! `beltgauge demo`: the appliance in real time on the synthetic belt, and the truth beside it.

use super::annotate::draw;
use super::{Appliance, Progress, demo_kit, log};
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::source::synthetic::{Parcel, Scenario, Synthetic};
use crate::source::{Feed, FrameSource, Pace, Paced, Recorder};
use std::fmt::Write as _;
use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};

const SCENARIO: &str = include_str!("../../config/demo/scenario.toml");
const CONFIG: &str = include_str!("../../config/demo/beltgauge.toml");
/// The recording in the folder of `--record`.
const RECORDING: &str = "recording.y4m";
/// A record belongs to the parcel whose true centre is this near.
const MATCH_MM: f64 = 60.0;
/// Folder of the archive in that of the results, and what it may take of the disk.
const ARCHIVE: &str = "archive";
const ARCHIVE_MIB_MAX: usize = 256;
/// The console line is renewed this often.
const CONSOLE_PERIOD: Duration = Duration::from_millis(200);

/// What to run.
#[derive(Clone, Copy, Debug)]
pub struct Options<'a> {
    /// How long.
    pub seconds: f64,
    /// Folder for table, records and pictures; created.
    pub out: &'a Path,
    /// Where the Modbus server listens; default: the demo configuration's port 1502.
    pub listen: Option<SocketAddr>,
    /// Where the page is served; default: the demo configuration's port 8080.
    pub page: Option<SocketAddr>,
    /// File with other tables of a configuration, for example `[can]`.
    pub config: Option<&'a Path>,
    /// Folder for a recording, and all that measuring it again and calibrating its camera needs.
    pub record: Option<&'a Path>,
}

/// The demo's scenario.
pub fn scenario() -> Result<Scenario> {
    Scenario::parse(SCENARIO)
}

/// The demo's site: its configuration with the scenario's camera.
pub fn site(scenario: &Scenario) -> Result<Site> {
    Site::new(Config::parse(CONFIG)?, scenario.camera()?)
}

/// The same with the tables of a file in place of the demo's own.
fn site_with(scenario: &Scenario, path: &Path) -> Result<Site> {
    let unreadable = |e: &dyn std::fmt::Display| {
        Error::configuration(format!("cannot read the tables: {e}"))
            .in_file(path)
            .remedy("give a file with tables of config/reference.toml")
    };
    let table = |text: &str| text.parse::<toml::Table>().map_err(|e| unreadable(&e));
    let mut tables = table(CONFIG)?;
    tables.extend(table(&std::fs::read_to_string(path).map_err(|e| unreadable(&e))?)?);
    // Nothing hangs on the demo's belt: whoever wants to try may write.
    if let Some(toml::Value::Table(modbus)) = tables.get_mut("modbus") {
        modbus.entry("write_allow").or_insert_with(|| toml::Value::Array(vec!["0.0.0.0".into()]));
    }
    let config = Config::parse(&tables.to_string()).map_err(|e| e.in_file(path))?;
    let mut site = Site::new(config, scenario.camera()?).map_err(|e| e.in_file(path))?;
    site.beside(path);
    Ok(site)
}

/// Run the demo; returns the table of measured against true sizes.
pub fn run(options: Options<'_>) -> Result<String> {
    if !(1.0..=3000.0).contains(&options.seconds) {
        return Err(
            Error::configuration(format!("--seconds {}", options.seconds)).allowed("1 to 3000")
        );
    }
    let scenario = scenario()?;
    let mut site = match options.config {
        Some(path) => site_with(&scenario, path)?,
        None => site(&scenario)?,
    };
    if let Some(listen) = options.listen {
        site.config.modbus.listen = listen;
    }
    if let Some(page) = options.page {
        (site.config.web.address, site.config.web.port) = (page.ip(), page.port());
    }
    let archive = &mut site.config.archive;
    if archive.folder.is_none() {
        (archive.folder, archive.mib_max) = (Some(options.out.join(ARCHIVE)), ARCHIVE_MIB_MAX);
    }
    let listen = site.config.modbus.listen;
    let camera = site.camera.clone();
    let failed = |e: std::io::Error| {
        Error::failure(format!("cannot write the results: {e}")).in_file(options.out)
    };
    std::fs::create_dir_all(options.out).map_err(failed)?;
    let records_path = options.out.join("parcels.jsonl");
    std::fs::write(&records_path, "").map_err(failed)?; // found out now, not at the end
    log::say(format_args!(
        "rendering the belt; Modbus TCP on {listen}, registers as in config/REGISTERS.md\n"
    ));
    let mut source = Synthetic::new(scenario.clone())?;
    let appliance = Appliance::new(site)?;
    if let Some(page) = appliance.page_address() {
        log::say(format_args!("the page: {}\n", page_url(page)));
    }
    let mut paced = Paced::new(&mut source, Pace::RealTime);
    let mut recorder = None;
    let feed: &mut dyn Feed = match options.record {
        None => &mut paced,
        Some(folder) => {
            std::fs::create_dir_all(folder).map_err(failed)?;
            // First: it refuses the folder of an earlier recording.
            let recorder = recorder.insert(Recorder::create(&mut paced, &folder.join(RECORDING))?);
            demo_kit::write(folder, &scenario, &camera, CONFIG)?;
            recorder
        }
    };
    let mut records: Vec<ParcelRecord> = Vec::new();
    let (start, mut shown) = (Instant::now(), Instant::now());
    let progress = appliance.run(feed, |progress, new| {
        records.extend(new);
        if shown.elapsed() >= CONSOLE_PERIOD {
            shown = Instant::now();
            console(progress, start.elapsed(), records.last());
        }
        start.elapsed().as_secs_f64() < options.seconds
    })?;
    log::say(format_args!("\n"));
    if let Some(recorder) = recorder {
        log::say(format_args!("{}\n", recorder.finish()?));
    }
    let mut lines = Vec::new();
    for record in &records {
        serde_json::to_writer(&mut lines, record).map_err(|e| failed(e.into()))?;
        lines.push(b'\n');
    }
    std::fs::write(&records_path, lines).map_err(failed)?;
    let [width, height] = source.size_px();
    let mut frame = vec![0; width * height];
    for record in &records {
        // The belt is deterministic: the frame where a record holds is rendered once more.
        source.render(record.frame, &mut frame);
        draw(&frame, [width, height], record, &camera, options.out)?;
    }
    let table = table(source.scenario(), &records, &progress);
    std::fs::write(options.out.join("table.txt"), &table).map_err(failed)?;
    Ok(table)
}

/// What to type into a browser on this machine.
fn page_url(page: SocketAddr) -> String {
    let [v4, v6] = ["127.0.0.1", "[::1]"];
    match page {
        SocketAddr::V4(at) if at.ip().is_unspecified() => format!("http://{v4}:{}/", at.port()),
        SocketAddr::V6(at) if at.ip().is_unspecified() => format!("http://{v6}:{}/", at.port()),
        at => format!("http://{at}/"),
    }
}

fn console(progress: &Progress, elapsed: Duration, last: Option<&ParcelRecord>) {
    let status = &progress.status;
    let latest = last.map_or_else(String::new, |r| {
        format!(
            "  latest #{} {:.1} x {:.1} x {:.1} mm",
            r.seq, r.length_mm, r.width_mm, r.height_mm
        )
    });
    let line = format!(
        "{:5.1} s  frame {}  dropped {}  belt {:.1} mm/s{}  parcels {}{latest}",
        elapsed.as_secs_f64(),
        status.counters.frames,
        status.frames_dropped,
        status.belt_speed_mm_per_s,
        if status.belt_measured { "" } else { " (assumed)" },
        status.counters.parcels,
    );
    log::say(format_args!("\r{line:100}"));
}

/// The parcel of the scenario that a record is of.
fn truth(scenario: &Scenario, record: &ParcelRecord) -> Option<Parcel> {
    let travel_mm = scenario.travel_at_frame_mm(record.frame);
    let distance = |p: &Parcel| (p.x_mm + travel_mm - record.x_mm).hypot(p.y_mm - record.y_mm);
    let nearest = scenario.parcels().iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    (distance(nearest) < MATCH_MM).then_some(*nearest)
}

fn table(scenario: &Scenario, records: &[ParcelRecord], progress: &Progress) -> String {
    let mut text = String::from(
        "  #      true L x W x H mm     measured L x W x H mm           error mm        2 sigma mm  flags\n",
    );
    let (mut sum, mut count, mut worst) = (0.0, 0u32, 0.0f64);
    for r in records {
        let measured = [r.length_mm, r.width_mm, r.height_mm];
        let sigma = [r.sigma_length_mm, r.sigma_width_mm, r.sigma_height_mm];
        let triple = |v: [f64; 3]| format!("{:6.1} {:6.1} {:6.1}", v[0], v[1], v[2]);
        let flags = r.flags;
        let Some(parcel) = truth(scenario, r) else {
            let _ = writeln!(
                text,
                "{:3}  {:>22}    {}   belongs to no parcel  {flags}",
                r.seq,
                "-",
                triple(measured)
            );
            continue;
        };
        let true_size = [parcel.length_mm, parcel.width_mm, parcel.height_mm];
        if let Some(reason) = r.not_measured {
            let _ =
                writeln!(text, "{:3}   {}      not measured: {reason}", r.seq, triple(true_size));
            continue;
        }
        let error = [0, 1, 2].map(|i| measured[i] - true_size[i]);
        for e in error.map(f64::abs) {
            sum += e;
            count += 1;
            worst = worst.max(e);
        }
        let _ = writeln!(
            text,
            "{:3}   {}      {}    {:+6.2} {:+6.2} {:+6.2}   {:4.1} {:4.1} {:4.1}  {flags}",
            r.seq,
            triple(true_size),
            triple(measured),
            error[0],
            error[1],
            error[2],
            2.0 * sigma[0],
            2.0 * sigma[1],
            2.0 * sigma[2],
        );
    }
    let _ = writeln!(
        text,
        "{} parcels, mean absolute error {:.2} mm, largest {worst:.2} mm; {} frames, {} dropped, \
         slowest frame {:.1} ms in the pipeline",
        records.len(),
        sum / f64::from(count.max(1)),
        progress.status.counters.frames,
        progress.status.frames_dropped,
        progress.frame_time_max.as_secs_f64() * 1e3,
    );
    text
}
