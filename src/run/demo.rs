//! `beltgauge demo`: the appliance in real time on the synthetic belt, and the truth beside it.

use super::annotate::draw;
use super::demo_results::Results;
use super::{Appliance, Progress, demo_kit, log, memory};
use crate::config::{Config, Site};
use crate::error::{Error, Result};
use crate::event::ParcelRecord;
use crate::source::synthetic::{Scenario, Synthetic};
use crate::source::{Feed, FrameSource, Pace, Paced, Recorder};
use signal_hook::consts::{SIGINT, SIGTERM};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const SCENARIO: &str = include_str!("../../config/demo/scenario.toml");
const CONFIG: &str = include_str!("../../config/demo/beltgauge.toml");
/// The recording in the folder of `--record`.
const RECORDING: &str = "recording.y4m";
/// Folder of the archive in that of the results, and what it may take of the disk.
const ARCHIVE: &str = "archive";
const ARCHIVE_MIB_MAX: usize = 256;
/// The longest time that makes sense.
const SECONDS_MAX: f64 = 1e6;
/// The console line is renewed this often.
const CONSOLE_PERIOD: Duration = Duration::from_millis(200);

/// Instead of the table, when there were no parcels.
const BOARD_SHOWN: &str = "A chessboard was shown, and no parcels.\n";

/// What to run.
#[derive(Clone, Copy, Debug)]
pub struct Options<'a> {
    /// How long; 0: until it is told to end.
    pub seconds: f64,
    /// Folder for table, records and pictures; created.
    pub out: &'a Path,
    /// Where the Modbus server listens; default: the demo configuration's port 1502.
    pub listen: Option<SocketAddr>,
    /// Where the page is served; default: the demo configuration's 127.0.0.1:8080.
    pub page: Option<SocketAddr>,
    /// File with other tables of a configuration, for example `[can]`.
    pub config: Option<&'a Path>,
    /// Folder for a recording, and all that measuring it again and calibrating its camera needs.
    pub record: Option<&'a Path>,
    /// Show a chessboard instead of parcels, to try the page's set-up.
    pub board: bool,
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
    // Who wants others to look says so.
    if let Some(toml::Value::Table(web)) = tables.get_mut("web") {
        web.entry("address").or_insert_with(|| "127.0.0.1".into());
    }
    let config = Config::parse(&tables.to_string()).map_err(|e| e.in_file(path))?;
    let mut site = Site::new(config, scenario.camera()?).map_err(|e| e.in_file(path))?;
    site.beside(path);
    Ok(site)
}

/// Set by SIGTERM or Ctrl-C. A second one ends the program at once.
fn until_told() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        signal_hook::flag::register_conditional_default(signal, Arc::clone(&stop))
            .and_then(|_| signal_hook::flag::register(signal, Arc::clone(&stop)))
            .map_err(|e| Error::failure(format!("cannot wait for signals: {e}")))?;
    }
    Ok(stop)
}

/// What will happen, for whoever has just started it.
fn introduction(
    scenario: &Scenario,
    seconds: f64,
    page: &str,
    modbus: SocketAddr,
    out: &Path,
) -> String {
    let how_long = if seconds == 0.0 {
        "until Ctrl-C".to_owned()
    } else {
        format!("for {seconds:.0} s (Ctrl-C ends it earlier, with --seconds 0 it runs on)")
    };
    let stop = scenario.belt.stops.first().filter(|stop| seconds == 0.0 || stop.at_s < seconds);
    let stop = stop.map_or_else(String::new, |stop| {
        let again = stop.every_s.filter(|s| seconds == 0.0 || stop.at_s + s < seconds);
        let again = again.map_or_else(String::new, |s| format!(" and then every {s:.0} s"));
        format!(
            "The belt stops on purpose, after {:.0} s{again}, for {:.1} s. Sizes must not suffer.\n",
            stop.at_s, stop.for_s
        )
    });
    format!(
        "{page}\n\
         Demo: the whole appliance on a synthetic belt, {how_long}. No camera and no PLC are needed.\n\
         Parcels come after 2 s. Their true sizes are known, but not to the appliance.\n{stop}\
         At the end there is a table of true and measured sizes, here and in {}.\n\
         A PLC, or any Modbus client, can read the parcels on {modbus}: see config/REGISTERS.md.\n",
        out.display()
    )
}

/// Run the demo; returns the table of measured against true sizes.
pub fn run(options: Options<'_>) -> Result<String> {
    let endless = options.seconds == 0.0;
    if !(endless || (1.0..=SECONDS_MAX).contains(&options.seconds)) {
        return Err(Error::configuration(format!("--seconds {}", options.seconds))
            .allowed(format!("1 to {SECONDS_MAX:.0}, or 0: until Ctrl-C")));
    }
    if options.board && options.record.is_some() {
        return Err(Error::configuration("--board and --record")
            .remedy("leave one out: --record writes stills of the board too"));
    }
    if endless && options.record.is_some() {
        return Err(Error::configuration("--record without an end: 30 MB a second fill any disk")
            .remedy("say how long, for example --seconds 60"));
    }
    let stop = until_told()?;
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
    let web = &site.config.web;
    let web = web.enabled.then(|| SocketAddr::new(web.address, web.port));
    let camera = site.camera.clone();
    let failed = |e: std::io::Error| {
        Error::failure(format!("cannot write the results: {e}")).in_file(options.out)
    };
    std::fs::create_dir_all(options.out).map_err(failed)?;
    // Created now, not at the end: then a folder that cannot be written to costs no time.
    let mut results = Results::create(&options.out.join("parcels.jsonl"))?;
    let mut source = Synthetic::new(scenario.clone())?;
    let recorder_mib = match options.record {
        None => 0,
        Some(_) => memory::room_for_recorder(&site)?,
    };
    let appliance = Appliance::new(site)?;
    let page = page_words(appliance.page_address(), web);
    let mut board =
        options.board.then(|| demo_kit::BoardShow::new(&scenario, &camera)).transpose()?;
    let shown: &mut dyn FrameSource = match &mut board {
        Some(board) => board,
        None => &mut source,
    };
    let mut paced = Paced::new(shown, Pace::RealTime);
    let mut recorder = None;
    let feed: &mut dyn Feed = match options.record {
        None => &mut paced,
        Some(folder) => {
            std::fs::create_dir_all(folder).map_err(failed)?;
            // First: it refuses the folder of an earlier recording.
            let path = folder.join(RECORDING);
            let recorder = recorder.insert(Recorder::create(&mut paced, &path, recorder_mib)?);
            demo_kit::write(folder, &scenario, &camera, CONFIG)?;
            recorder
        }
    };
    let text = if options.board {
        format!(
            "{page}\nUnder \"Set up\" a chessboard is shown, held and on the belt, instead of parcels.\n"
        )
    } else {
        introduction(&scenario, options.seconds, &page, listen, options.out)
    };
    log::say(format_args!("{text}"));
    let (start, mut shown) = (Instant::now(), Instant::now());
    let progress = appliance.run(feed, |progress, new| {
        new.for_each(|record| results.add(&scenario, record));
        if shown.elapsed() >= CONSOLE_PERIOD {
            shown = Instant::now();
            console(progress, start.elapsed(), results.last());
        }
        let over = !endless && start.elapsed().as_secs_f64() >= options.seconds;
        !over && !stop.load(Ordering::Relaxed)
    })?;
    log::say(format_args!("\n"));
    if let Some(recorder) = recorder {
        log::say(format_args!("{}\n", recorder.finish()?));
    }
    results.finish()?;
    if options.board {
        return Ok(BOARD_SHOWN.to_owned());
    }
    let [width, height] = source.size_px();
    let mut frame = vec![0; width * height];
    for record in results.kept() {
        // The belt is deterministic: the frame where a record holds is rendered once more.
        source.render(record.frame, &mut frame);
        draw(&frame, [width, height], record, &camera, options.out)?;
    }
    let table = results.table(&scenario, &progress);
    std::fs::write(options.out.join("table.txt"), &table).map_err(failed)?;
    Ok(table)
}

/// Where to see it, first of all. `wanted`: where it should be; none: nowhere.
fn page_words(served: Option<SocketAddr>, wanted: Option<SocketAddr>) -> String {
    match (served, wanted) {
        (Some(page), _) => format!("See it in a browser: {}", page_url(page)),
        (None, Some(wanted)) => format!(
            "There is no page in the browser: {wanted} is taken, or is no address of this computer. \
             It is tried again; or choose another one, for example --page 127.0.0.1:8090"
        ),
        (None, None) => "There is no page in the browser: web.enabled = false.".to_owned(),
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_told_first_and_shown_to_this_computer_alone() {
        let scenario = scenario().expect("committed");
        let web = site(&scenario).expect("valid").config.web;
        assert!(web.enabled && web.address.is_loopback());
        let page = SocketAddr::new(web.address, web.port);
        let words = page_words(Some(page), Some(page));
        let text = introduction(&scenario, 30.0, &words, page, Path::new("out"));
        assert!(text.starts_with("See it in a browser: http://127.0.0.1:8080/\n"), "{text}");
        let taken = page_words(None, Some(page));
        assert!(taken.contains("127.0.0.1:8080 is taken") && taken.contains("--page"), "{taken}");
        for (served, shown) in [
            ("0.0.0.0:81", "http://127.0.0.1:81/"),
            ("[::]:81", "http://[::1]:81/"),
            ("10.0.0.7:81", "http://10.0.0.7:81/"),
        ] {
            assert_eq!(page_url(served.parse().expect("an address")), shown);
        }
    }

    #[test]
    fn tables_of_a_file_do_not_show_the_page_to_others_by_omission() {
        let file = std::env::temp_dir().join(format!("beltgauge-demo-{}.toml", std::process::id()));
        let address = |text: &str| {
            std::fs::write(&file, text).expect("room");
            site_with(&scenario().expect("committed"), &file).expect("valid").config.web.address
        };
        assert!(address("[web]\nport = 8090\n").is_loopback());
        assert!(address("[web]\naddress = \"0.0.0.0\"\n").is_unspecified());
        std::fs::remove_file(&file).expect("it is there");
    }
}
