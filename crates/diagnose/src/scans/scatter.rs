//! Range noise: second differences along a ring on planes, in which offsets of lasers and slow errors of the planes
//! cancel.

use super::planes::Patch;
use super::rings::Beam;
use crate::inference::simplex::minimise;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

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

/// Bins of range and incidence over several scans: mean range, mean lever, samples, robust standard deviation, m.
pub type Pooled = BTreeMap<(i32, i32), [f64; 4]>;

/// Median of the absolute values of normal noise, in standard deviations.
const MEDIAN_OF_NORMAL: f64 = 0.6745;

/// Smallest standard deviation of a bin, m.
const LEAST_STD_M: f64 = 1e-4;

/// The bins of several scans together.
pub fn pooled(scans: &[&ScatterSums]) -> Pooled {
    let mut all = BTreeMap::<(i32, i32), Bin>::new();
    for (key, bin) in scans.iter().flat_map(|s| s.iter()) {
        let sum = all.entry(*key).or_default();
        sum.n += bin.n;
        (0..2).for_each(|k| sum.place[k] += bin.place[k]);
        sum.values.extend(&bin.values);
    }
    let usual = |values: &[f32]| {
        let median = statistics::median_upper(values.iter().map(|v| v.abs()).collect());
        f64::from(median.unwrap_or(0.0)) / MEDIAN_OF_NORMAL
    };
    all.into_iter()
        .filter(|(_, b)| b.n >= FEWEST)
        .map(|(key, b)| (key, [b.place[0] / b.n, b.place[1] / b.n, b.n, usual(&b.values).max(LEAST_STD_M)]))
        .collect()
}

/// [`pooled`] of all scans but one, for each. The values of a bin are sorted once for all.
pub fn pooled_but_each(scans: &[ScatterSums]) -> Vec<Pooled> {
    let keys: BTreeSet<(i32, i32)> = scans.iter().flat_map(|s| s.keys().copied()).collect();
    let bins: Vec<((i32, i32), Vec<Option<[f64; 4]>>)> =
        keys.into_par_iter().map(|key| (key, bin_but_each(scans, key))).collect();
    let of_scan = |s: usize| bins.iter().filter_map(|(key, but)| Some((*key, but[s]?))).collect();
    (0..scans.len()).map(of_scan).collect()
}

/// One bin of all scans but one, for each.
fn bin_but_each(scans: &[ScatterSums], key: (i32, i32)) -> Vec<Option<[f64; 4]>> {
    let bins: Vec<(usize, &Bin)> =
        scans.iter().enumerate().filter_map(|(s, sums)| Some((s, sums.get(&key)?))).collect();
    let mut values: Vec<(f32, usize)> =
        bins.iter().flat_map(|(s, bin)| bin.values.iter().map(|v| (v.abs(), *s))).collect();
    values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let mut ranks: Vec<Vec<usize>> = vec![Vec::new(); scans.len()];
    values.iter().enumerate().for_each(|(rank, (_, s))| ranks[*s].push(rank));
    let but = |s: usize| {
        let rest = || bins.iter().filter(|(of, _)| *of != s).map(|(_, bin)| bin);
        let n: f64 = rest().map(|bin| bin.n).sum();
        let mean = |k: usize| rest().map(|bin| bin.place[k]).sum::<f64>() / n;
        // The upper median of what is left when the values of the scan are skipped.
        let mut at = (values.len() - ranks[s].len()) / 2;
        for rank in &ranks[s] {
            at += usize::from(*rank <= at);
        }
        let usual = values.get(at).map_or(0.0, |v| f64::from(v.0)) / MEDIAN_OF_NORMAL;
        (n >= FEWEST).then(|| [mean(0), mean(1), n, usual.max(LEAST_STD_M)])
    };
    (0..scans.len()).map(but).collect()
}

/// Fits a law to bins.
pub fn fit(bins: &Pooled, free: Free) -> NoiseFit {
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

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn bins_of_all_scans_but_one_are_those_of_the_others() {
        let mut rng = data::stream(1, "scatter test", 0, 0);
        let mut scan = |samples: usize| -> ScatterSums {
            let mut sums = ScatterSums::new();
            for _ in 0..samples {
                let bin = sums.entry((rng.random_range(0..3), rng.random_range(0..2))).or_default();
                bin.n += 1.0;
                bin.place = bin.place.map(|p| p + rng.random_range(1.0..9.0));
                // Few distinct values, so that many are equal.
                bin.values.push(rng.random_range(-4i8..=4).into());
            }
            sums
        };
        let scans: Vec<ScatterSums> = [200, 0, 90, 301, 7].into_iter().map(&mut scan).collect();
        for (s, got) in pooled_but_each(&scans).into_iter().enumerate() {
            let others: Vec<&ScatterSums> = (0..scans.len()).filter(|i| *i != s).map(|i| &scans[i]).collect();
            assert_eq!(got, pooled(&others), "{s}");
        }
    }
}
