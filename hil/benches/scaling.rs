//! What a frame costs against its size, with one worker and with two:
//! `cargo bench --package hil --bench scaling`.
//!
//! The reference camera scaled from 0.3 to 5 megapixels over the same belt; the pipelines with one
//! and two workers take turns, 20 frames each, and with them two separate pipelines of one worker
//! each: what the machine's second processor gives at best, to work that shares nothing. The plot goes
//! to `target/scaling.svg`.

use beltgauge::image::{FrameTime, Plane};
use beltgauge::pipeline::Pipeline;
use hil::scene::{FPS, Scene};
use std::fmt::Write as _;
use std::time::Instant;

/// Frames that are timed, after the background is learned.
const FRAMES: u64 = 160;
/// Frames on end that one of them works on.
const TURN: usize = 20;
/// Image columns: 0.3, 0.6, 1.3, 2.3, 3.5 and 5 megapixels.
const WIDTHS: [usize; 6] = [704, 1008, 1440, 1920, 2368, 2816];

/// Cost of one size.
struct Row {
    megapixels: f64,
    /// Median of a frame, ms, with one worker and with two.
    ms: [f64; 2],
    /// Of two frames in two pipelines side by side.
    two_frames_ms: f64,
}

fn main() {
    let rows: Vec<Row> = WIDTHS.into_iter().map(measure).collect();
    let heads = ["Mpx", "ms", "ns a pixel", "ms, two", "gain", "at best"];
    println!("{}", heads.map(|head| format!("{head:>11}")).concat());
    for Row { megapixels, ms: [one, two], two_frames_ms } in &rows {
        let gains = [one / two, 2.0 * one / two_frames_ms];
        let row = [*megapixels, *one, one / megapixels, *two, gains[0], gains[1]];
        println!("{}", row.map(|value| format!("{value:11.2}")).concat());
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/scaling.svg");
    std::fs::write(path, plot(&rows)).expect("writable");
    println!("wrote {path}");
}

fn measure(width: usize) -> Row {
    let scene = Scene::reference(width, FRAMES);
    let [width, height] = scene.site.camera.image_size_px;
    let pools = [1, 2].map(|workers| {
        rayon::ThreadPoolBuilder::new().num_threads(workers).build().expect("threads")
    });
    let mut pipelines = [1, 2, 1, 1].map(|workers| {
        let mut site = scene.site.clone();
        site.config.realtime.workers = workers;
        site.config.limits.memory_mib_max = 512;
        beltgauge::run::build(site).expect("fits").1
    });
    let [one, two, left, right] = &mut pipelines;
    let mut times = [const { Vec::new() }; 3];
    let step = |pipeline: &mut Pipeline, n: usize| {
        let raw = Plane::packed(&scene.frames[n], width, height).expect("this size");
        let time = FrameTime { index: n as u64, t_s: n as f64 / FPS };
        pipeline.step(raw, time, &mut |_| {}).expect("this size");
    };
    // Inside its pool, as the appliance's vision thread is.
    for turn in (0..scene.frames.len()).step_by(TURN) {
        let frames = turn..(turn + TURN).min(scene.frames.len());
        let timed = |work: &mut (dyn FnMut(usize) + Send), times: &mut Vec<f64>| {
            for n in frames.clone() {
                let start = Instant::now();
                work(n);
                if n >= 40 {
                    times.push(1e3 * start.elapsed().as_secs_f64());
                }
            }
        };
        pools[0].install(|| timed(&mut |n| step(one, n), &mut times[0]));
        pools[1].install(|| timed(&mut |n| step(two, n), &mut times[1]));
        let mut both = |n| {
            rayon::join(|| step(left, n), || step(right, n));
        };
        pools[1].install(|| timed(&mut both, &mut times[2]));
    }
    let [one, two, two_frames_ms] = times.map(|mut times| {
        times.sort_unstable_by(f64::total_cmp);
        times[times.len() / 2]
    });
    let [columns, rows] = scene.site.view.size_px;
    Row { megapixels: (columns * rows) as f64 * 1e-6, ms: [one, two], two_frames_ms }
}

/// Cost over size, and the straight line through the origin with the least squared error.
fn plot(rows: &[Row]) -> String {
    let (x_max, y_max) = rows.iter().fold((0.0f64, 0.0f64), |(x, y), row| {
        (x.max(1.1 * row.megapixels), y.max(1.15 * row.ms[0]))
    });
    let at = |x: f64, y: f64| (70.0 + 500.0 * x / x_max, 330.0 - 300.0 * y / y_max);
    let mut svg = String::from(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 600 380\" \
         font-family=\"sans-serif\" font-size=\"13\"><rect width=\"600\" height=\"380\" \
         fill=\"#fff\"/><path d=\"M70 30V330H570\" fill=\"none\" stroke=\"#444\"/>\
         <text x=\"320\" y=\"372\" text-anchor=\"middle\">belt view, megapixels</text>\
         <text x=\"18\" y=\"20\">ms a frame</text>\n",
    );
    for (worker, colour, label) in [(0, "#0a6", "one worker"), (1, "#06c", "two workers")] {
        let sums = rows.iter().fold([0.0; 2], |[xx, xy], row| {
            [xx + row.megapixels.powi(2), xy + row.megapixels * row.ms[worker]]
        });
        let slope = sums[1] / sums[0];
        let (x, y) = at(x_max, slope * x_max);
        let _ = writeln!(
            svg,
            "<path d=\"M70 330L{x:.1} {y:.1}\" stroke=\"{colour}\" stroke-dasharray=\"4 4\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\" text-anchor=\"end\">{label}: \
             {slope:.2} ns a pixel</text>",
            if worker == 0 { x - 90.0 } else { x },
            if worker == 0 { y + 20.0 } else { y + 110.0 },
        );
        for row in rows {
            let (x, y) = at(row.megapixels, row.ms[worker]);
            let _ =
                writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\"/>");
        }
    }
    for row in rows {
        let (x, _) = at(row.megapixels, 0.0);
        let _ = writeln!(
            svg,
            "<text x=\"{x:.1}\" y=\"350\" text-anchor=\"middle\">{:.1}</text>",
            row.megapixels
        );
    }
    for tick in (0..).map(|i| 2.0 * f64::from(i)).take_while(|tick| *tick < y_max) {
        let (_, y) = at(0.0, tick);
        let _ =
            writeln!(svg, "<text x=\"62\" y=\"{:.1}\" text-anchor=\"end\">{tick}</text>", y + 4.0);
    }
    svg + "</svg>\n"
}
