//! Scores of cases with several hidden effects, by the number of effects.

use crate::outcome::Outcome;
use crate::truth::{Hidden, Level};
use serde::{Deserialize, Serialize};
use statistics::median_upper;

/// Groups of cases by the number of hidden effects: first and last number.
pub const GROUPS: [[usize; 2]; 4] = [[2, 3], [4, 7], [8, 12], [13, 20]];

/// Scores of the cases of one group.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SwarmRow {
    /// First and last number of hidden effects.
    pub effects: [usize; 2],
    /// Cases.
    pub cases: usize,
    /// Cases in which the diagnosis said that the scenes differ, or returned an error.
    pub refused: usize,
    /// Hidden effects in the catalogue, of weak, medium and strong level.
    pub nameable: [usize; 3],
    /// Of these, named.
    pub named: [usize; 3],
    /// Of these, not named but a candidate of an ambiguous finding.
    pub ambiguous: [usize; 3],
    /// Names that the diagnosis gave, each counted once a case.
    pub names: usize,
    /// Of these, names of causes that are not hidden.
    pub false_names: usize,
    /// Hidden effects outside of the catalogue of at least medium level.
    pub off_catalogue: usize,
    /// Of these, named: the false names of a case, at most as many as it has such effects.
    pub off_named: usize,
    /// Of these, reported without a name: the unexplained findings of a case, at most as many as remain.
    pub off_unexplained: usize,
    /// Parameters of rightly named causes.
    pub parameters: usize,
    /// Of these, with the true value inside the 95 % interval.
    pub inside: usize,
    /// Root mean square of error over bound, for parameters with a bound.
    pub error_over_bound: Option<f64>,
    /// Median of the fraction of the gap that the diagnosis says is closed.
    pub closed: Option<f64>,
    /// Median run time of the diagnosis, s.
    pub seconds: Option<f64>,
}

/// Scores of all cases with at least two hidden effects.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SwarmTable {
    /// A row for each group of [`GROUPS`] that has cases.
    pub rows: Vec<SwarmRow>,
}

impl SwarmTable {
    /// Counts.
    pub fn of(outcomes: &[Outcome]) -> SwarmTable {
        let in_group = |o: &Outcome, [first, last]: [usize; 2]| (first..=last).contains(&o.truth.hidden.len());
        let row = |group: [usize; 2]| row(group, outcomes.iter().filter(|o| in_group(o, group)));
        SwarmTable { rows: GROUPS.into_iter().map(row).filter(|r| r.cases > 0).collect() }
    }
}

fn row<'a>(effects: [usize; 2], outcomes: impl Iterator<Item = &'a Outcome>) -> SwarmRow {
    let mut row = SwarmRow { effects, ..SwarmRow::default() };
    let (mut closed, mut seconds, mut squares) = (Vec::new(), Vec::new(), Vec::new());
    for o in outcomes {
        row.cases += 1;
        row.refused += usize::from(o.verdict == "not_scenario_identical" || o.verdict.starts_with("error"));
        for hidden in o.truth.hidden.iter().filter(|h| h.in_catalogue) {
            let level = hidden.level.unwrap_or(Level::Weak) as usize;
            row.nameable[level] += 1;
            if o.names(&hidden.cause) {
                row.named[level] += 1;
            } else if o.mentions(&hidden.cause) {
                row.ambiguous[level] += 1;
            }
        }
        let false_names = o.false_names().len();
        row.names += o.named.iter().collect::<std::collections::BTreeSet<_>>().len();
        row.false_names += false_names;
        let matters = |h: &&Hidden| !h.in_catalogue && h.level.is_none_or(|l| l >= Level::Medium);
        let off = o.truth.hidden.iter().filter(matters).count();
        let off_named = false_names.min(off);
        row.off_catalogue += off;
        row.off_named += off_named;
        row.off_unexplained += o.unexplained.min(off - off_named);
        row.parameters += o.parameters.len();
        row.inside += o.parameters.iter().filter(|p| p.inside()).count();
        squares.extend(o.parameters.iter().filter_map(|p| Some(((p.estimate - p.truth) / p.bound?).powi(2))));
        closed.extend(o.closed);
        seconds.push(o.seconds);
    }
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    row.error_over_bound = mean.is_finite().then(|| mean.sqrt());
    row.closed = median_upper(closed);
    row.seconds = median_upper(seconds);
    row
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::truth::Truth;

    #[test]
    fn names_are_counted_by_level_and_false_ones_apart() {
        let hidden = |cause: &str, in_catalogue: bool, strength: f64| {
            Hidden { cause: cause.into(), in_catalogue, ..Hidden::default() }.with_strength(strength)
        };
        let hidden = vec![
            hidden("range_noise", true, 100.0),
            hidden("range_bias", true, 20.0),
            hidden("random_dropout", true, 2.0),
            hidden("fog", false, 50.0),
            hidden("ghosts", false, 50.0),
        ];
        let truth = Truth { seed: 1, kind: "swarm".into(), setting: String::new(), hidden };
        let outcome = Outcome {
            truth,
            verdict: "explained".into(),
            named: ["range_noise", "range_noise", "outliers"].map(String::from).to_vec(),
            ambiguous: vec![vec!["range_bias".into(), "time_offset".into()]],
            unexplained: 3,
            parameters: vec![],
            closed: Some(0.5),
            seconds: 2.0,
        };
        let table = SwarmTable::of(&[outcome]);
        let [row] = &table.rows[..] else { panic!("{table:?}") };
        assert_eq!((row.effects, row.nameable, row.named), ([4, 7], [1, 1, 1], [0, 0, 1]));
        assert_eq!((row.ambiguous, row.names, row.false_names), ([0, 1, 0], 2, 1));
        assert_eq!((row.off_catalogue, row.off_named, row.off_unexplained), (2, 1, 1));
        assert_eq!((row.closed, row.error_over_bound), (Some(0.5), None));
    }
}
