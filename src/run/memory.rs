//! The whole appliance's memory: the pipeline's and the frames between its threads.

use crate::config::Site;
use crate::error::Result;
use crate::pipeline::Pipeline;
use crate::plan::{Block, Plan};
use crate::run::desk::shots::{self, Shot};
use crate::source::Recorder;

/// Every buffer of the capture and vision path, as `beltgauge check` prints it.
pub fn plan(site: &Site) -> Plan {
    let mut plan = Plan::default();
    let frame_bytes: usize = site.camera.image_size_px.iter().product();
    plan.add::<u8>(
        "capture.frames",
        site.config.limits.frames_queued_max * frame_bytes,
        "limits.frames_queued_max raw frames between capture and vision",
    );
    Pipeline::plan(site, &mut plan);
    shots::plan(site, &mut plan);
    plan
}

/// What the memory is carved into.
pub struct Carved {
    /// Raw frames.
    pub buffers: Vec<Block<u8>>,
    /// The pipeline.
    pub pipeline: Pipeline,
    /// Pictures for people.
    pub shots: Vec<Shot>,
}

/// Map, carve and seal the memory of the whole appliance.
pub fn carve(site: Site) -> Result<Carved> {
    let mut memory = plan(&site).reserve(site.config.limits.memory_mib_max)?;
    let buffers = memory.take_parts("capture.frames", site.config.limits.frames_queued_max, 0)?;
    let pipeline = Pipeline::new(site, &mut memory)?;
    let shots = shots::shots(pipeline.site(), &mut memory)?;
    memory.seal()?;
    Ok(Carved { buffers, pipeline, shots })
}

/// The same for a pipeline that nobody looks at: without pictures for people.
pub fn build(mut site: Site) -> Result<(Vec<Block<u8>>, Pipeline)> {
    site.config.web.enabled = false;
    site.config.archive.folder = None;
    let Carved { buffers, pipeline, .. } = carve(site)?;
    Ok((buffers, pipeline))
}

/// What a recorder beside all of it may take, MiB. The sum of both is refused as one plan.
pub fn room_for_recorder(site: &Site) -> Result<usize> {
    let mut plan = plan(site);
    let planned = plan.bytes();
    Recorder::plan(site.camera.image_size_px, &mut plan);
    plan.check_limit(site.config.limits.memory_mib_max)?;
    Ok((plan.bytes() - planned).div_ceil(1 << 20))
}
