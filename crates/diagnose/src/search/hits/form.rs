//! The correction of a law's form: no sensor has exactly the form of a law.

use super::Search;
use crate::channels::cells::{cell, place_of};
use crate::channels::hits::TOGETHER;
use crate::inference::law::FittedLaw;
use crate::inference::losses::{FORM_BIN, LossTable};

/// Number of points of the correction of a law's form.
const FORM_BINS: f64 = 24.0;

/// Fewest returns, weighted by what they tell, of a point of the correction.
const FEWEST_OF_FORM: f64 = 40.0;

/// Expected returns that count as the prior of a factor of 1.
const FORM_PRIOR: f64 = 20.0;

impl Search<'_> {
    /// Ratio of the measured share to that of the laws along the covariate of law `k`, return by return on all frames
    /// that are not held out: the correction of its form. Ratios are drawn towards 1 as far as chance alone makes them
    /// differ.
    pub(super) fn form(&self, k: usize, laws: &[FittedLaw], table: &LossTable) -> Vec<[f64; 2]> {
        let unmatched = table.unmatched(&[]);
        let rays = self.select.iter().chain(&self.estimate).flat_map(|&i| &self.context.frames[i].simulated);
        // Covariate, expected share and whether there is a counterpart.
        let mut seen: Vec<[f64; 3]> = rays
            .filter(|ray| !self.mask.hides(ray))
            .filter_map(|ray| {
                let (range_m, cos, zone) = place_of(ray)?;
                let kept: f64 = laws.iter().map(|law| law.at(range_m, cos, zone).1).product();
                let expected = (kept * (1.0 - unmatched[cell(ray)?][1])).clamp(0.0, 1.0);
                Some([laws[k].at(range_m, cos, zone).0, expected, f64::from(u8::from(ray.matched))])
            })
            .collect();
        seen.sort_by(|a, b| a[0].total_cmp(&b[0]));
        // As many bins as the counts determine to a few per cent, where the law changes.
        let worth = |[_, expected, _]: &[f64; 3]| expected * (1.0 - expected) + 0.02 * expected;
        let per = (seen.iter().map(worth).sum::<f64>() / FORM_BINS).max(FEWEST_OF_FORM);
        // Covariate, factor and the variance of the factor by chance.
        let (mut points, mut bin) = (Vec::<[f64; 3]>::new(), [0.0f64; 5]);
        let mut from = seen.first().map_or(0.0, |first| first[0]);
        for (i, ray) in seen.iter().enumerate() {
            let [x, expected, matched] = *ray;
            for (sum, v) in
                bin.iter_mut().zip([expected * x, expected, matched, worth(ray), expected * (1.0 - expected)])
            {
                *sum += v;
            }
            // Where a law keeps nearly all, few returns tell much, and one factor for all hides what it is at the end.
            let ends = x - from > FORM_BIN || i + 1 == seen.len();
            if bin[3] >= per || ends && bin[3] >= FEWEST_OF_FORM {
                from = x;
                let factor = (bin[2] + FORM_PRIOR) / (bin[1] + FORM_PRIOR);
                let x = bin[0] / bin[1];
                if points.last().is_none_or(|last| x > last[0] + 1e-6) {
                    points.push([x, factor, TOGETHER * (bin[4] + 1.0) / bin[1].powi(2)]);
                }
                bin = [0.0; 5];
            }
        }
        let weight = shrinkage(&points);
        points.iter().map(|p| [p[0], 1.0 + (p[1] - 1.0) * weight(p[2])]).collect()
    }
}

/// Weight of a factor with some variance beside the prior that all are 1 but for a variance of their own, which is that
/// of the factors without what chance makes (the estimate of moments, DerSimonian and Laird 1986).
fn shrinkage(points: &[[f64; 3]]) -> impl Fn(f64) -> f64 {
    let sum = |of: &dyn Fn(f64, f64) -> f64| points.iter().map(|p| of(p[1] - 1.0, 1.0 / p[2])).sum::<f64>();
    let [all, squares] = [sum(&|_, w| w), sum(&|_, w| w * w)];
    let beyond = sum(&|d, w| w * d * d) - points.len() as f64;
    let own = (beyond / (all - squares / all.max(1e-12)).max(1e-12)).max(0.0);
    move |by_chance| own / (own + by_chance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_that_chance_explains_become_1_and_others_stay() {
        let off = |d: f64| (0..24).map(|k| [f64::from(k), 1.0 + d * f64::from(k % 3 - 1), 1e-4]).collect::<Vec<_>>();
        assert!(shrinkage(&off(0.01))(1e-4) < 0.1);
        assert!(shrinkage(&off(0.1))(1e-4) > 0.95);
        assert_eq!(shrinkage(&[])(1e-4), 0.0);
    }
}
