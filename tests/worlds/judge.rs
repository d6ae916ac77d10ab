//! Holds what was reported against what is true.

use beltgauge::event::ParcelRecord;
use beltgauge::source::synthetic::{Parcel, Scenario};

/// A record belongs to the parcel whose true centre is this near.
const MATCH_MM: f64 = 60.0;
/// A dimension that is off by more, and by more than 3 sigma, must not be usable.
const WRONG_MM: f64 = 3.0;
/// The same of what is no cuboid: its cuboid is found from what is seen of it.
const WRONG_IRREGULAR_MM: f64 = 12.0;

/// Counts over worlds.
#[derive(Clone, Debug, Default)]
pub struct Verdict {
    pub parcels: usize,
    pub once: usize,
    pub twice: usize,
    pub untold: usize,
    /// Records of nothing.
    pub false_records: usize,
    /// Of the parcels told once, those whose dimensions may be used.
    pub usable: usize,
    /// Records that may be used and must not be.
    pub silent: usize,
    /// Parcels told once, usable, and not silently wrong.
    pub right: usize,
    /// Parcels of which a silently wrong record was told.
    pub wrong: usize,
    /// Of the usable ones, every dimension's.
    pub errors_mm: Vec<f64>,
}

impl Verdict {
    pub fn add(&mut self, other: Self) {
        self.parcels += other.parcels;
        self.once += other.once;
        self.twice += other.twice;
        self.untold += other.untold;
        self.false_records += other.false_records;
        self.usable += other.usable;
        self.silent += other.silent;
        self.right += other.right;
        self.wrong += other.wrong;
        self.errors_mm.extend(other.errors_mm);
    }

    /// Told once, usable and not silently wrong, as a share of all parcels.
    pub fn right_share(&self) -> f64 {
        self.right as f64 / self.parcels.max(1) as f64
    }

    /// Shares of all parcels: right, told as doubtful, wrong without a word, not told.
    pub fn fates(&self) -> [f64; 4] {
        let told = self.parcels - self.untold;
        let counts = [self.right, told - self.right - self.wrong, self.wrong, self.untold];
        counts.map(|count| count as f64 / self.parcels.max(1) as f64)
    }

    pub const HEADER: &'static str =
        "class       parcels  once twice none false  usable  right silent   mean mm   99 % mm";

    pub fn line(&self, name: &str) -> String {
        let mut errors = self.errors_mm.clone();
        errors.sort_unstable_by(f64::total_cmp);
        let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
        let p99 = errors.get(errors.len() * 99 / 100).copied().unwrap_or_default();
        format!(
            "{name:11} {:7} {:5} {:5} {:4} {:5} {:5} % {:4} % {:6} {mean:9.2} {p99:9.2}",
            self.parcels,
            self.once,
            self.twice,
            self.untold,
            self.false_records,
            100 * self.usable / self.parcels.max(1),
            100 * self.right / self.parcels.max(1),
            self.silent
        )
    }
}

fn sigmas_mm(record: &ParcelRecord) -> [f64; 3] {
    [record.sigma_length_mm, record.sigma_width_mm, record.sigma_height_mm]
}

fn errors_mm(record: &ParcelRecord, truth: &Parcel) -> [f64; 3] {
    [
        record.length_mm - truth.length_mm,
        record.width_mm - truth.width_mm,
        record.height_mm - truth.height_mm,
    ]
}

/// Judge one world.
pub fn judge(scenario: &Scenario, records: &[ParcelRecord]) -> Verdict {
    let parcels = scenario.parcels();
    let mut verdict = Verdict { parcels: parcels.len(), ..Verdict::default() };
    let mut told: Vec<Vec<&ParcelRecord>> = vec![Vec::new(); parcels.len()];
    for record in records {
        let distance = |p: &Parcel| {
            let place = scenario.place_at_frame(p, record.frame);
            (place.x_mm - record.x_mm).hypot(place.y_mm - record.y_mm)
        };
        let nearest = (0..parcels.len())
            .min_by(|&a, &b| distance(&parcels[a]).total_cmp(&distance(&parcels[b])));
        if let Some(n) = nearest.filter(|&n| distance(&parcels[n]) < MATCH_MM) {
            told[n].push(record);
        } else {
            verdict.false_records += 1;
            verdict.silent += usize::from(record.may_be_used);
        }
    }
    for (truth, told) in parcels.iter().zip(&told) {
        match told.len() {
            0 => verdict.untold += 1,
            1 => verdict.once += 1,
            _ => verdict.twice += 1,
        }
        let most = if truth.shape.is_box() { WRONG_MM } else { WRONG_IRREGULAR_MM };
        let is_wrong = |record: &ParcelRecord| {
            let errors = errors_mm(record, truth);
            let mut pairs = errors.iter().zip(sigmas_mm(record));
            pairs.any(|(e, s)| e.abs() > most && e.abs() > 3.0 * s)
        };
        let usable: Vec<_> = told.iter().filter(|r| r.may_be_used).collect();
        let wrong = usable.iter().filter(|r| is_wrong(r)).count();
        verdict.silent += wrong;
        verdict.wrong += usize::from(wrong > 0);
        verdict.usable += usize::from(told.len() == 1 && usable.len() == 1);
        verdict.right += usize::from(told.len() == 1 && usable.len() == 1 && wrong == 0);
        for record in usable {
            verdict.errors_mm.extend(errors_mm(record, truth).map(f64::abs));
        }
    }
    verdict
}
