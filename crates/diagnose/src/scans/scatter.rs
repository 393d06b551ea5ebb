//! Range noise: second differences along a ring on planes, in which offsets of lasers and slow errors of the planes
//! cancel.

use super::planes::Patch;
use crate::inference::simplex::minimise;
use rayon::prelude::*;
use sensor::directions::lasers::Beam;
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

/// Smallest standard deviation of a bin, m.
const LEAST_STD_M: f64 = 1e-4;

/// The values of each bin of all scans, sorted once for every choice of scans.
pub struct SortedBins<'a> {
    scans: &'a [ScatterSums],
    /// Absolute values, m, with the number of their scan.
    values: BTreeMap<(i32, i32), Vec<(f32, u32)>>,
}

impl<'a> SortedBins<'a> {
    /// Sorts the values of all scans.
    pub fn new(scans: &'a [ScatterSums]) -> Self {
        let keys: BTreeSet<(i32, i32)> = scans.iter().flat_map(|s| s.keys().copied()).collect();
        let sorted = |key: (i32, i32)| {
            let of_scan =
                |(s, sums): (u32, &'a ScatterSums)| Some(sums.get(&key)?.values.iter().map(move |v| (v.abs(), s)));
            let mut values: Vec<(f32, u32)> = (0..).zip(scans).filter_map(of_scan).flatten().collect();
            values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            (key, values)
        };
        SortedBins { scans, values: keys.into_par_iter().map(sorted).collect() }
    }

    /// The bins of the scans of these numbers, which may repeat.
    pub fn pooled(&self, which: &[usize]) -> Pooled {
        let mut times = vec![0usize; self.scans.len()];
        which.iter().for_each(|&s| times[s] += 1);
        let of_bin = |(key, values): (&(i32, i32), &Vec<(f32, u32)>)| {
            let chosen = || which.iter().filter_map(|&s| self.scans[s].get(key));
            // The upper median of the chosen values, each as often as its scan is chosen.
            let mut before = chosen().map(|bin| bin.values.len()).sum::<usize>() / 2;
            let usual = values.iter().find(|(_, s)| {
                let n = times[*s as usize];
                let here = before < n;
                before = before.saturating_sub(n);
                here
            });
            Some((*key, pooled_bin(chosen, usual.map(|v| v.0))?))
        };
        self.values.iter().filter_map(of_bin).collect()
    }

    /// The bins of all scans but one, for each.
    pub fn pooled_but_each(&self) -> Vec<Pooled> {
        let of_bin = |(key, values): (&(i32, i32), &Vec<(f32, u32)>)| (*key, self.bin_but_each(key, values));
        let bins: Vec<_> = self.values.par_iter().map(of_bin).collect();
        let of_scan = |s: usize| bins.iter().filter_map(|(key, but)| Some((*key, but[s]?))).collect();
        (0..self.scans.len()).map(of_scan).collect()
    }

    /// One bin of all scans but one, for each.
    fn bin_but_each(&self, key: &(i32, i32), values: &[(f32, u32)]) -> Vec<Option<[f64; 4]>> {
        let mut ranks: Vec<Vec<usize>> = vec![Vec::new(); self.scans.len()];
        values.iter().enumerate().for_each(|(rank, (_, s))| ranks[*s as usize].push(rank));
        let but = |s: usize| {
            let rest = || (0..self.scans.len()).filter(move |i| *i != s).filter_map(|i| self.scans[i].get(key));
            // The upper median of what is left when the values of the scan are skipped.
            let mut at = (values.len() - ranks[s].len()) / 2;
            for rank in &ranks[s] {
                at += usize::from(*rank <= at);
            }
            pooled_bin(rest, values.get(at).map(|v| v.0))
        };
        (0..self.scans.len()).map(but).collect()
    }
}

/// Mean range, mean lever, samples and robust standard deviation of the bins of several scans; `None` with too few
/// samples. `usual` is the median of the absolute values.
fn pooled_bin<'b, I: Iterator<Item = &'b Bin>>(bins: impl Fn() -> I, usual: Option<f32>) -> Option<[f64; 4]> {
    let n: f64 = bins().map(|bin| bin.n).sum();
    let mean = |k: usize| bins().map(|bin| bin.place[k]).sum::<f64>() / n;
    let std_m = usual.map_or(0.0, f64::from) / statistics::MEDIAN_OF_NORMAL;
    (n >= FEWEST).then(|| [mean(0), mean(1), n, std_m.max(LEAST_STD_M)])
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

    /// The bins of several scans, each median of its own.
    fn pooled(scans: &[&ScatterSums]) -> Pooled {
        let mut all = BTreeMap::<(i32, i32), Bin>::new();
        for (key, bin) in scans.iter().flat_map(|s| s.iter()) {
            let sum = all.entry(*key).or_default();
            sum.n += bin.n;
            (0..2).for_each(|k| sum.place[k] += bin.place[k]);
            sum.values.extend(&bin.values);
        }
        let usual = |b: &Bin| statistics::median_upper(b.values.iter().map(|v| v.abs()).collect());
        let enough = all.into_iter().filter(|(_, b)| b.n >= FEWEST);
        enough.map(|(key, b)| (key, pooled_bin(|| [&b].into_iter(), usual(&b)).unwrap())).collect()
    }

    #[test]
    fn bins_of_chosen_scans_have_their_medians() {
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
        let sorted = SortedBins::new(&scans);
        for which in [&[0, 1, 2, 3, 4][..], &[3, 3, 0, 2, 3], &[1], &[]] {
            assert_eq!(
                sorted.pooled(which),
                pooled(&which.iter().map(|&s| &scans[s]).collect::<Vec<_>>()),
                "{which:?}"
            );
        }
        for (s, got) in sorted.pooled_but_each().into_iter().enumerate() {
            let others: Vec<&ScatterSums> = (0..scans.len()).filter(|i| *i != s).map(|i| &scans[i]).collect();
            assert_eq!(got, pooled(&others), "{s}");
        }
    }
}
