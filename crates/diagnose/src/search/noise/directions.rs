//! Noise that depends on row or azimuth.

use super::{Search, Term};
use crate::catalogue::sizes::{DIRECTIONS_NOISE, ROWS_NOISE};
use crate::catalogue::{Channel, Quantity};
use crate::channels::cells::cell;
use crate::channels::groups::{Grouping, PartedFrame, total as group_total};
use crate::channels::mean::usual_noise_m;
use crate::channels::roughness::rough_groups;
use crate::inference::choice::Trial;
use crate::inference::grouped::GroupFit;
use crate::inference::noise::{NOISE_LAWS, NoiseTable};
use crate::pairing::Ray;
use crate::search::unexplained::{Unexplained, direction_trials, mean_by_group};
use crate::search::{Found, parameter};

/// Fit of the added variance of groups of directions, in units of the expected one: prior standard deviation of three.
pub(super) const GROUPED: GroupFit = GroupFit { column: 0, precision: 0.1, centred: false, trust: 0.5 };

/// Smallest spread of the added variance that is reported, by grouping. Rows have ranges and angles of their own,
/// where laws may have another form; azimuths do not.
const GROUP_FLOORS: [f64; 2] = [ROWS_NOISE, DIRECTIONS_NOISE];

impl Search<'_> {
    /// Trials of tables by row and by azimuth on top of some laws.
    pub(super) fn direction_trials(&self, terms: &[Term], how: GroupFit) -> Vec<Trial> {
        let groups = |grouping| self.rough_groups(grouping, &self.table, terms);
        direction_trials(&self.select, &self.blocks, NOISE_LAWS.len(), how, GROUP_FLOORS, groups)
    }

    fn rough_groups(&self, grouping: Grouping, table: &NoiseTable, terms: &[Term]) -> Vec<PartedFrame> {
        let expected = |c: usize, ray: &Ray| expected(table, c, ray, terms);
        let variances = |c| table.variances(c);
        rough_groups(self.context.frames, self.context.rig, &self.scales, grouping, &variances, &expected)
    }

    /// The finding of noise that depends on row or azimuth.
    pub(super) fn unexplained(&self, grouping: Grouping, confidence: f64, table: &NoiseTable, terms: &[Term]) -> Found {
        let groups = self.rough_groups(grouping, table, terms);
        let share = |ray: &Ray| Some(expected(table, cell(ray)?, ray, terms));
        let rays = self.estimate.iter().flat_map(|&i| &self.context.frames[i].measured);
        let shares = mean_by_group(rays, grouping, share);
        let all = group_total(self.estimate.iter().flat_map(|&i| &groups[i]));
        let usual_m = usual_noise_m(self.context.frames);
        let unexplained = Unexplained {
            channel: Channel::Roughness,
            grouping,
            confidence,
            parameters: vec![parameter(Quantity::SimulatedStdM, usual_m, 0.05 * usual_m)],
            says: format!(
                "measured ranges scatter more in some directions than in others: it depends on the {}, and no cause of the catalogue does that",
                grouping.name()
            ),
            y: "standard deviation in units of the simulated one",
        };
        unexplained.found(&all, GROUPED, self.hold_out.iter().map(|&i| &groups[i]), |group, added, std| {
            let share = shares.get(&group).copied().unwrap_or(1.0).sqrt();
            let measured = (1.0 + added).max(0.0).sqrt();
            [share * measured, share * 0.5 * std / measured.max(0.1)]
        })
    }
}

/// Measured variance of a ray that laws expect, in units of the simulated variance.
fn expected(table: &NoiseTable, cell: usize, ray: &Ray, terms: &[Term]) -> f64 {
    let Some([_, vb]) = table.variances(cell) else { return 1.0 };
    let (range, cos) = (f64::from(ray.range_m), f64::from(ray.cos_incidence));
    1.0 + terms.iter().map(|(l, t)| t * l.variance(range, cos)).sum::<f64>() / vb
}
