//! Where frames come from: files, a directory, the synthetic belt, or a live camera.

#[cfg(feature = "aravis")]
mod aravis;
mod codec;
mod directory;
mod fault_injector;
mod feed;
pub(crate) mod gige;
pub(crate) mod pixels;
mod recorder;
mod repeats;
pub(crate) mod still;
pub mod synthetic;
mod times;
#[cfg(feature = "v4l2")]
mod v4l2;
mod y4m;

pub use directory::Directory;
pub use fault_injector::{FaultInjector, Faults};
pub use feed::{Arrival, Driver, Feed, FeedStatus, Live, Next, Pace, Paced, Taken};
pub use recorder::{Recorded, Recorder};
pub use still::{Still, stills_in};
pub use times::times_beside;
pub use y4m::Y4m;

use crate::config::{CameraTable, Interface};
use crate::error::{Error, Result};
use crate::image::FrameTime;
use repeats::WithoutRepeats;
use std::path::Path;
use times::Timed;

/// Frame rates that make sense: slower, a parcel is hardly seen twice.
const FPS: std::ops::RangeInclusive<f64> = 0.5..=10_000.0;

/// A stream of mono frames of one size.
pub trait FrameSource: Send {
    /// Width and height of every frame.
    fn size_px(&self) -> [usize; 2];

    /// Frames a second, nominal.
    fn fps(&self) -> f64;

    /// Fill `frame` (width x height bytes) with the next one; `None` at the end.
    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>>;

    /// The next `count` frames were not taken in time: leave them out. A camera does so by
    /// itself.
    fn skip(&mut self, _count: u64) {}

    /// What makes a recording's frames doubtful, in plain words, once they have been read.
    fn doubt(&self) -> Option<String> {
        None
    }
}

/// In a child process of [`crate::sandbox`]: carry out its task.
pub fn serve_sandboxed(task: &str) -> Result<()> {
    match task {
        gige::features::TASK => gige::features::serve(),
        still::TASK => still::serve(),
        _ => Err(Error::configuration(format!("no task {task:?}"))),
    }
}

/// Open the camera of a configuration for frames of a size.
pub fn open_camera(settings: &CameraTable, size_px: [usize; 2]) -> Result<Box<dyn Driver>> {
    match settings.interface {
        #[cfg(feature = "v4l2")]
        Interface::V4l2 => Ok(Box::new(v4l2::V4l2::open(settings, size_px)?)),
        Interface::Gige => Ok(Box::new(gige::Gige::open(settings, size_px)?)),
        #[cfg(feature = "aravis")]
        Interface::Aravis => Ok(Box::new(aravis::Aravis::open(settings, size_px)?)),
        #[allow(unreachable_patterns)] // with every feature there is none left
        missing => Err(not_built_in(missing)),
    }
}

/// The interfaces to cameras, their names, and whether this program has them.
const INTERFACES: [(Interface, &str, bool); 3] = [
    (Interface::V4l2, "v4l2", cfg!(feature = "v4l2")),
    (Interface::Gige, "gige", true),
    (Interface::Aravis, "aravis", cfg!(feature = "aravis")),
];

/// Refuse an interface that this program was built without: waiting for such a camera is in vain.
pub fn check_interface(interface: Interface) -> Result<()> {
    let is_built_in = INTERFACES.iter().any(|&(known, _, there)| there && known == interface);
    if is_built_in { Ok(()) } else { Err(not_built_in(interface)) }
}

fn not_built_in(interface: Interface) -> Error {
    let name = INTERFACES.iter().find(|i| i.0 == interface).map_or("", |i| i.1);
    let there: Vec<&str> = INTERFACES.iter().filter(|i| i.2).map(|i| i.1).collect();
    Error::configuration(format!(
        "camera.interface = \"{name}\": this program was built without the feature {name}"
    ))
    .allowed(there.join(", "))
    .remedy(format!("choose one of these, or `cargo build --release --features {name}`"))
}

/// Open a replay: a Y4M file, `-` for Y4M on standard input, or a directory of images.
pub fn open(input: &Path, fps: Option<f64>) -> Result<Box<dyn FrameSource>> {
    if let Some(fps) = fps
        && !FPS.contains(&fps)
    {
        return Err(Error::configuration(format!("--fps {fps}")).allowed(format!(
            "{} to {} frames a second",
            FPS.start(),
            FPS.end()
        )));
    }
    if input == Path::new("-") {
        let y4m = Y4m::new(Box::new(std::io::stdin()), y4m::STDIN, fps)?;
        return Ok(Box::new(WithoutRepeats::new(y4m)));
    }
    let metadata = std::fs::metadata(input).map_err(|e| {
        Error::configuration(format!("cannot open the input: {e}"))
            .in_file(input)
            .remedy("give a Y4M file, `-` for standard input, or a directory of images")
    })?;
    if metadata.is_dir() {
        return Ok(Box::new(WithoutRepeats::new(Directory::open(input, fps)?)));
    }
    let file = std::fs::File::open(input)
        .map_err(|e| Error::failure(format!("cannot open the input: {e}")).in_file(input))?;
    let y4m = Y4m::new(Box::new(file), &input.display().to_string(), fps)?;
    let times = times_beside(input);
    // A rate that is given overrules them. With its true times no picture was put into a gap.
    if fps.is_none() && times.exists() {
        return Ok(Box::new(Timed::new(y4m, times)?));
    }
    Ok(Box::new(WithoutRepeats::new(y4m)))
}
