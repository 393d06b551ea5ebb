//! Range noise: second differences along a ring on planes, in which offsets of lasers and slow errors of the planes
//! cancel.

use super::planes::Patch;
use super::rings::Beam;
use crate::inference::simplex::minimise;
use std::collections::BTreeMap;

/// Bins of range and incidence with the sums of one scan.
pub type ScatterSums = BTreeMap<(i32, i32), Bin>;

/// Sums of one bin.
#[derive(Clone, Debug, Default)]
pub struct Bin {
    /// Samples.
    pub n: f64,
    /// Sum of ranges, m, and of R tan(incidence), m.
    pub place: [f64; 2],
    /// The samples, m: residuals, scaled to the noise of one range.
    pub values: Vec<f32>,
}

/// Largest sample that counts, in standard deviations.
const CAP: f64 = 4.0;

/// Largest difference in azimuth of neighbours, rad: 0.37 degrees.
const NEIGHBOUR_RAD: f64 = 0.0065;

/// Fewest samples of a bin.
const FEWEST: f64 = 30.0;

/// Largest weight of a bin, samples: the texture of surfaces is not noise.
const MOST: f64 = 300.0;

/// Adds the samples of a plane.
pub fn add(sums: &mut ScatterSums, patch: &Patch, beams: &[Beam]) {
    // Shots of a ring lie together, in the order of the ring.
    for three in patch.shots.windows(3) {
        let [a, b, c] = [&three[0], &three[1], &three[2]];
        if a.beam != c.beam || a.at + 1 != b.at || b.at + 1 != c.at {
            continue;
        }
        let azimuth = [a, b, c].map(|s| s.shot.azimuth_rad);
        let (before, after) = (azimuth[1] - azimuth[0], azimuth[2] - azimuth[1]);
        if !(before > 1e-4 && before < NEIGHBOUR_RAD && after > 1e-4 && after < NEIGHBOUR_RAD) {
            continue;
        }
        let met = [a, b, c].map(|s| patch.plane.meets(&beams[s.beam], s.shot.azimuth_rad));
        let [Some(first), Some(middle), Some(last)] = met else { continue };
        let y = [a.shot.range_m - first[0], b.shot.range_m - middle[0], c.shot.range_m - last[0]];
        let w = after / (before + after);
        let off = (y[1] - w * y[0] - (1.0 - w) * y[2]) / (1.0 + w * w + (1.0 - w).powi(2)).sqrt();
        let [range, cos] = middle;
        let lever = range * (1.0 / (cos * cos) - 1.0).max(0.0).sqrt();
        let key = ((range.ln() / 0.3).floor() as i32, (-cos.ln() / 0.35).floor() as i32);
        let bin = sums.entry(key).or_default();
        bin.n += 1.0;
        bin.place = [bin.place[0] + range, bin.place[1] + lever];
        bin.values.push(off as f32);
    }
}

/// A law of noise: `(std_m + per_m R)^2 + (angle_rad R tan(incidence))^2`, m2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseFit {
    /// m.
    pub std_m: f64,
    /// m/m.
    pub per_m: f64,
    /// rad.
    pub angle_rad: f64,
}

/// Which parameters of a law are free.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Free {
    /// Whether it grows with range.
    pub range: bool,
    /// Whether it grows with the incidence.
    pub incidence: bool,
}

impl NoiseFit {
    /// Variance at a range and a lever R tan(incidence), m2.
    pub fn variance(&self, range_m: f64, lever_m: f64) -> f64 {
        (self.std_m + self.per_m * range_m).powi(2) + (self.angle_rad * lever_m).powi(2)
    }
}

/// A bin over several scans: mean range, mean lever, samples, robust standard deviation, m.
pub fn pooled(scans: &[&ScatterSums]) -> BTreeMap<(i32, i32), [f64; 4]> {
    let mut all = BTreeMap::<(i32, i32), Bin>::new();
    for (key, bin) in scans.iter().flat_map(|s| s.iter()) {
        let sum = all.entry(*key).or_default();
        sum.n += bin.n;
        (0..2).for_each(|k| sum.place[k] += bin.place[k]);
        sum.values.extend(&bin.values);
    }
    let usual = |values: &[f32]| {
        let median = statistics::median_upper(values.iter().map(|v| v.abs()).collect());
        f64::from(median.unwrap_or(0.0)) / 0.6745
    };
    all.into_iter()
        .filter(|(_, b)| b.n >= FEWEST)
        .map(|(key, b)| (key, [b.place[0] / b.n, b.place[1] / b.n, b.n, usual(&b.values).max(1e-4)]))
        .collect()
}

/// Fits a law to bins.
pub fn fit(bins: &BTreeMap<(i32, i32), [f64; 4]>, free: Free) -> NoiseFit {
    let law = |p: &[f64]| {
        let mut p = p.iter().map(|v| v.exp());
        let std_m = p.next().unwrap_or(0.01);
        let per_m = if free.range { p.next().unwrap_or(0.0) } else { 0.0 };
        let angle_rad = if free.incidence { p.next().unwrap_or(0.0) } else { 0.0 };
        NoiseFit { std_m, per_m, angle_rad }
    };
    let value = |p: &[f64]| {
        let law = law(p);
        bins.values()
            .map(|[r, l, n, sd]| {
                let v = law.variance(*r, *l);
                n.min(MOST) * 0.5 * (v.ln() + sd * sd / v)
            })
            .sum::<f64>()
    };
    let mut start = vec![0.01f64.ln()];
    start.extend(free.range.then_some(2e-4f64.ln()));
    start.extend(free.incidence.then_some(2e-4f64.ln()));
    law(&minimise(&start, &vec![0.7; start.len()], value).0)
}

/// Logarithm of the likelihood of a scan under a law, nats, and the samples that count.
pub fn likelihood(scan: &ScatterSums, law: &NoiseFit) -> [f64; 2] {
    let mut sum = [0.0; 2];
    for bin in scan.values() {
        let v = law.variance(bin.place[0] / bin.n, bin.place[1] / bin.n);
        let squares: f64 = bin.values.iter().map(|x| f64::from(*x).powi(2).min(CAP * CAP * v)).sum();
        let n = bin.n.min(MOST);
        // Neighbouring second differences share ranges: two count as one.
        sum[0] -= 0.25 * n * (v.ln() + squares / bin.n / v);
        sum[1] += n;
    }
    sum
}
