//! The correction of a law's form: no sensor has exactly the form of a law.

use super::Search;
use crate::channels::cells::{cell, place_of};
use crate::inference::law::FittedLaw;
use crate::inference::losses::LossTable;

/// Number of points of the correction of a law's form.
const FORM_BINS: f64 = 24.0;

/// Fewest returns, weighted by what they tell, of a point of the correction.
const FEWEST_OF_FORM: f64 = 40.0;

/// Expected returns that count as the prior of a factor of 1.
const FORM_PRIOR: f64 = 20.0;

impl Search<'_> {
    /// Ratio of the measured share to that of the laws along the covariate of law `k`, on the estimating frames, return
    /// by return: the correction of its form.
    pub(super) fn form(&self, k: usize, laws: &[FittedLaw], table: &LossTable) -> Vec<[f64; 2]> {
        let unmatched = table.unmatched(&[]);
        let rays = self.estimate.iter().flat_map(|&i| &self.context.frames[i].simulated);
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
        let (mut points, mut bin) = (Vec::<[f64; 2]>::new(), [0.0f64; 4]);
        for ray in &seen {
            let [x, expected, matched] = *ray;
            for (sum, v) in bin.iter_mut().zip([expected * x, expected, matched, worth(ray)]) {
                *sum += v;
            }
            if bin[3] >= per {
                let factor = (bin[2] + FORM_PRIOR) / (bin[1] + FORM_PRIOR);
                let x = bin[0] / bin[1];
                if points.last().is_none_or(|last| x > last[0] + 1e-6) {
                    points.push([x, factor]);
                }
                bin = [0.0; 4];
            }
        }
        points
    }
}
