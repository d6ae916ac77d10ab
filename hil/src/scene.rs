//! The synthetic belt at the reference camera's full size, kept in memory for benchmarks.

use beltgauge::config::{Config, Site};
use beltgauge::source::FrameSource;
use beltgauge::source::synthetic::{Scenario, Synthetic};
use beltgauge::units::RawPx;

/// Frames a second of the reference camera.
pub const FPS: f64 = 42.0;

/// A sequence and the site that measures it.
pub struct Scene {
    /// The whole image is the zone.
    pub site: Site,
    /// Raw frames.
    pub frames: Vec<Vec<u8>>,
    /// Where they come from.
    pub source: Synthetic,
}

impl Scene {
    /// The reference camera scaled to `width` columns (it has 1920), over a belt with a parcel every
    /// 40 cm: `frames` frames from the moment the first one comes into view.
    ///
    /// # Panics
    /// When the scenario cannot be rendered: then nothing can be measured.
    pub fn reference(width: usize, frames: u64) -> Self {
        let parcels = "[random]\ncount = 40\nfirst_x_mm = -1500\ngap_mm = [160, 260]\n\
             y_mm = [-400, 400]\nlength_mm = [80, 400]\nwidth_mm = [60, 300]\nheight_mm = [20, 250]\n";
        Self::reference_with(width, frames, parcels)
    }

    /// The same with other parcels: the scenario's `[[parcel]]` tables.
    ///
    /// # Panics
    /// When the scenario cannot be rendered.
    pub fn reference_with(width: usize, frames: u64, parcels: &str) -> Self {
        let camera = camera_file(width).replace("[lens]", "[camera.lens]");
        let text = format!(
            "seed = 11\nfps = {FPS}\nframes = {}\nexposure_ms = 1.0\n\
             [camera]\n{}\n[belt]\nspeed_mm_per_s = 500\nwidth_mm = 1400\ngrey = 45\ntexture_grey = 1.3\n\
             [light]\ndrift = 0.05\ndrift_period_s = 3.0\nshadow = 0.35\n{parcels}",
            frames + WARM_UP,
            camera.replace("[pose]", "[camera.pose]"),
        );
        Self::render(Scenario::parse(&text).expect("a valid scenario"))
    }

    /// All frames of a scenario; the whole image is the zone.
    ///
    /// # Panics
    /// When it cannot be rendered.
    pub fn render(scenario: Scenario) -> Self {
        let site = whole_image(&scenario);
        let frames = scenario.frames;
        let mut source = Synthetic::new(scenario).expect("renders");
        let [width, height] = source.size_px();
        let mut rendered = Vec::new();
        for n in 0..frames {
            if n % 20 == 0 {
                eprint!("\rrendering frame {n} of {frames}");
            }
            let mut frame = vec![0; width * height];
            source.next_into(&mut frame).expect("renders");
            rendered.push(frame);
        }
        eprintln!("\r{:60}\r", "");
        Self { site, frames: rendered, source }
    }
}

/// The calibration file of the reference camera scaled to `width` columns.
pub fn camera_file(width: usize) -> String {
    let scale = width as f64 / 1920.0;
    format!(
        "image_size_px = [{width}, {}]\n[lens]\nmodel = \"brown\"\n\
         fx_px = {}\nfy_px = {}\ncx_px = {}\ncy_px = {}\n\
         distortion = [-0.181, 0.080, 0.0005, -0.0004, -0.008]\n[pose]\n\
         rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\ntranslation_mm = [0, 0, 1500]\n",
        (1200.0 * scale).round(),
        1019.3 * scale,
        1019.9 * scale,
        940.2 * scale,
        599.1 * scale
    )
}

/// Frames of the empty belt before the first parcel: 1.1 m of it are out of view at first.
const WARM_UP: u64 = 40;

/// The largest zone around the middle of the image that the camera sees all of.
fn whole_image(scenario: &Scenario) -> Site {
    let camera = scenario.camera().expect("a valid camera");
    let [width, height] = camera.image_size_px.map(|n| n as f64);
    let belt = |x: f64, y: f64| camera.belt_point(RawPx { x, y }).expect("looks at the belt");
    let (left, right) = (belt(1.0, height / 2.0).x, belt(width - 2.0, height / 2.0).x);
    let (top, bottom) = (belt(width / 2.0, 1.0).y, belt(width / 2.0, height - 2.0).y);
    let site = |shrink: f64| {
        let config = format!(
            "[camera]\ncalibration = \"the scenario's\"\n[belt]\nspeed_mm_per_s = 490\n\
             [zone]\nx_min_mm = {}\nx_max_mm = {}\ny_min_mm = {}\ny_max_mm = {}\n",
            left * shrink,
            right * shrink,
            bottom * shrink,
            top * shrink
        );
        Site::new(Config::parse(&config).expect("valid"), camera.clone()).ok()
    };
    (0..20).find_map(|i| site(1.0 - 0.005 * f64::from(i))).expect("a zone in view")
}
