//! A source whose frames are lost, doubled, swapped, late, noisy or squeezed on purpose, the same ones in
//! every run.

use super::FrameSource;
use super::codec::Codec;
use super::synthetic::Random;
use crate::error::{Error, Result};
use crate::image::FrameTime;

/// What goes wrong, and how often.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Faults {
    /// Share of frames that are lost; their numbers are missing.
    pub drop: f64,
    /// Share of frames that come a second time, as the next one.
    pub double: f64,
    /// Share of frames that come after the one that follows them.
    pub swap: f64,
    /// Standard deviation of the error of a frame's time, ms.
    pub late_ms: f64,
    /// Standard deviation of noise that is added, grey levels.
    pub noise_grey: f64,
    /// Step of a video codec's quantiser, grey levels: about 0.6 for the finest, 10 for good, 40 for poor
    /// video; 0: none.
    pub codec_grey: f64,
    /// Seed of all of it.
    pub seed: u64,
}

impl Faults {
    /// From text: `drop=0.2,double=0.1,swap=0.05,late=3,noise=2,codec=20,seed=1`, any of them.
    pub fn parse(text: &str) -> Result<Self> {
        let mut faults = Self::default();
        for part in text.split(',').filter(|part| !part.is_empty()) {
            let wrong = || {
                Error::configuration(format!("--inject: {part}")).allowed(
                    "drop and double: shares 0 to 0.9; swap: 0 to 0.5; late: 0 to 1000 ms; noise: 0 to 50 grey levels; \
                     codec: 0 to 100 grey levels; seed: a whole number",
                ).remedy("for example --inject drop=0.2,double=0.1,swap=0.05,late=3,noise=2,codec=20,seed=1")
            };
            let (name, value) = part.split_once('=').ok_or_else(wrong)?;
            if name == "seed" {
                faults.seed = value.parse().map_err(|_| wrong())?;
                continue;
            }
            let (place, most) = match name {
                "drop" => (&mut faults.drop, 0.9),
                "double" => (&mut faults.double, 0.9),
                "swap" => (&mut faults.swap, 0.5),
                "codec" => (&mut faults.codec_grey, 100.0),
                "late" => (&mut faults.late_ms, 1000.0),
                "noise" => (&mut faults.noise_grey, 50.0),
                _ => return Err(wrong()),
            };
            let number = value.parse().ok().filter(|n| (0.0..=most).contains(n));
            *place = number.ok_or_else(wrong)?;
        }
        Ok(faults)
    }
}

/// Any source with faults.
pub struct FaultInjector {
    source: Box<dyn FrameSource>,
    faults: Faults,
    random: Random,
    /// The last frame that was no double: what is doubled.
    before: Vec<u8>,
    has_before: bool,
    /// Time is told to go forward, however late a frame is.
    told_s: f64,
    codec: Option<Codec>,
    /// A frame that was overtaken, and comes next.
    overtaken: Vec<u8>,
    overtaken_time: Option<FrameTime>,
}

impl FaultInjector {
    /// Frames of `source` with faults.
    pub fn new(source: Box<dyn FrameSource>, faults: Faults) -> Self {
        let [width, height] = source.size_px();
        Self {
            before: vec![0; width * height],
            has_before: false,
            told_s: 0.0,
            codec: (faults.codec_grey > 0.0)
                .then(|| Codec::new(faults.codec_grey, [width, height])),
            overtaken: vec![0; if faults.swap > 0.0 { width * height } else { 0 }],
            overtaken_time: None,
            random: Random(faults.seed ^ 0x6661_756c_7473),
            source,
            faults,
        }
    }

    /// The next frame with all faults but its place in the order.
    fn spoiled(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        let Some(mut time) = self.source.next_into(frame)? else { return Ok(None) };
        while self.random.unit() < self.faults.drop {
            match self.source.next_into(frame)? {
                Some(next) => time = next,
                None => return Ok(None),
            }
        }
        if self.has_before && self.random.unit() < self.faults.double {
            frame.copy_from_slice(&self.before);
        } else {
            self.before.copy_from_slice(frame);
            self.has_before = true;
        }
        if self.faults.noise_grey > 0.0 {
            for grey in frame.iter_mut() {
                let noisy = f64::from(*grey) + self.faults.noise_grey * self.random.normal();
                *grey = noisy.round().clamp(0.0, 255.0) as u8;
            }
        }
        if let Some(codec) = &mut self.codec {
            codec.pass(frame);
        }
        let late_s = 1e-3 * self.faults.late_ms * self.random.normal();
        if time.index > 0 {
            time.t_s = (time.t_s + late_s).max(self.told_s + 1e-6);
        }
        self.told_s = time.t_s;
        Ok(Some(time))
    }
}

impl FrameSource for FaultInjector {
    fn size_px(&self) -> [usize; 2] {
        self.source.size_px()
    }

    fn fps(&self) -> f64 {
        self.source.fps()
    }

    fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
        if let Some(time) = self.overtaken_time.take() {
            frame.copy_from_slice(&self.overtaken);
            return Ok(Some(time));
        }
        let Some(time) = self.spoiled(frame)? else { return Ok(None) };
        // No number is drawn without need: a seed gives the same faults with and without this one.
        if self.faults.swap > 0.0 && self.random.unit() < self.faults.swap {
            self.overtaken.copy_from_slice(frame);
            if let Some(next) = self.spoiled(frame)? {
                self.overtaken_time = Some(time);
                return Ok(Some(next));
            }
        }
        Ok(Some(time))
    }

    fn skip(&mut self, count: u64) {
        self.source.skip(count);
    }

    fn doubt(&self) -> Option<String> {
        self.source.doubt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames that hold their own index.
    struct Counting(u64);

    impl FrameSource for Counting {
        fn size_px(&self) -> [usize; 2] {
            [16, 16]
        }
        fn fps(&self) -> f64 {
            50.0
        }
        fn next_into(&mut self, frame: &mut [u8]) -> Result<Option<FrameTime>> {
            let index = self.0;
            self.0 += 1;
            frame.fill(index as u8);
            Ok((index < 200).then_some(FrameTime { index, t_s: index as f64 / 50.0 }))
        }
    }

    /// Index, time and first pixel of every frame.
    fn frames(faults: &str) -> Vec<(u64, f64, u8)> {
        let faults = Faults::parse(faults).expect("valid");
        let mut source = FaultInjector::new(Box::new(Counting(0)), faults);
        let mut frame = vec![0; 256];
        let mut seen = Vec::new();
        while let Some(time) = source.next_into(&mut frame).expect("no error") {
            seen.push((time.index, time.t_s, frame[0]));
        }
        seen
    }

    #[test]
    fn without_faults_nothing_changes() {
        let seen = frames("");
        assert_eq!(seen.len(), 200);
        let same = |&(i, t_s, grey): &(u64, f64, u8)| {
            grey == i as u8 && (t_s - i as f64 / 50.0).abs() < 1e-9
        };
        assert!(seen.iter().all(same));
    }

    #[test]
    fn dropped_frames_leave_gaps_in_the_numbers_and_doubled_ones_show_the_frame_before() {
        let seen = frames("drop=0.2,seed=4");
        assert!((140..180).contains(&seen.len()), "{} of 200", seen.len());
        assert!(seen.iter().all(|&(i, _, grey)| grey == i as u8));
        let seen = frames("double=0.3,seed=4");
        assert_eq!(seen.len(), 200);
        let doubled = seen.windows(2).filter(|w| w[0].2 == w[1].2).count();
        assert!((30..90).contains(&doubled), "{doubled} of 200");
    }

    #[test]
    fn late_frames_keep_their_order_and_every_run_is_the_same() {
        let seen = frames("late=30,noise=2,seed=9");
        assert!(seen.windows(2).all(|w| w[0].1 < w[1].1));
        assert_eq!(seen, frames("late=30,noise=2,seed=9"));
        assert_ne!(seen, frames("late=30,noise=2,seed=8"));
    }

    #[test]
    fn swapped_frames_come_after_the_one_that_follows_with_their_own_number_and_time() {
        let seen = frames("swap=0.2,seed=4");
        assert_eq!(seen.len(), 200);
        let same = |&(i, t_s, grey): &(u64, f64, u8)| {
            grey == i as u8 && (t_s - i as f64 / 50.0).abs() < 1e-9
        };
        assert!(seen.iter().all(same));
        let back = seen.windows(2).filter(|w| w[1].0 < w[0].0).count();
        assert!((15..60).contains(&back), "{back} of 200");
        assert!(seen.windows(2).all(|w| w[1].0 < w[0].0 + 4));
    }

    #[test]
    fn faults_that_make_no_sense_are_refused_by_name() {
        for text in ["drop=1.5", "drop", "dorp=0.1", "noise=nan", "seed=-1"] {
            let error = Faults::parse(text).expect_err("must be refused").to_string();
            assert!(error.contains(text) && error.contains("drop and double"), "{error}");
        }
    }
}
