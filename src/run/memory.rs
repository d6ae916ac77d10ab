//! The whole appliance's memory: the pipeline's and the frames between its threads.

use crate::config::Site;
use crate::error::Result;
use crate::pipeline::Pipeline;
use crate::plan::{Block, Plan};

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
