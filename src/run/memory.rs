//! The whole appliance's memory: the pipeline's and the frames between its threads.

use crate::config::Site;
use crate::error::Result;
use crate::pipeline::Pipeline;
use crate::plan::{Block, Plan};
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
    plan
}

/// Map, carve and seal the memory: the frames and the pipeline.
pub fn build(site: Site) -> Result<(Vec<Block<u8>>, Pipeline)> {
    let mut memory = plan(&site).reserve(site.config.limits.memory_mib_max)?;
    let frames = memory.take_parts("capture.frames", site.config.limits.frames_queued_max, 0)?;
    let pipeline = Pipeline::new(site, &mut memory)?;
    memory.seal()?;
    Ok((frames, pipeline))
}

/// What a recorder beside all of it may take, MiB. The sum of both is refused as one plan.
pub fn room_for_recorder(site: &Site) -> Result<usize> {
    let mut plan = plan(site);
    let planned = plan.bytes();
    Recorder::plan(site.camera.image_size_px, &mut plan);
    plan.check_limit(site.config.limits.memory_mib_max)?;
    Ok((plan.bytes() - planned).div_ceil(1 << 20))
}
