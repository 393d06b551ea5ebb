//! One step of forward selection: the hypothesis that explains frames on which it was not fitted, and its rivals.

use crate::catalogue::Cause;

/// A hypothesis with its gain on each frame, fitted on other blocks.
#[derive(Clone, Debug)]
pub struct Trial {
    /// Its place in the list of hypotheses.
    pub candidate: usize,
    /// Its cause. Several forms of a law share one.
    pub cause: Cause,
    /// Number of free parameters.
    pub parameters: usize,
    /// Gain of each frame over the model so far, nats.
    pub gains: Vec<f64>,
    /// What each frame is expected to gain if the hypothesis is right, nats; empty where that is not known.
    pub expected: Vec<f64>,
    /// Whether the effect fitted on all frames exceeds the smallest effect that is reported.
    pub above_floor: bool,
}

impl Trial {
    /// Sum of the gains, and their mean over its standard error.
    pub fn total_and_z(&self) -> (f64, f64) {
        total_and_z_about(&self.gains, &self.expected, FEWEST_EXPECTED).unwrap_or_else(|| total_and_z(&self.gains))
    }

    /// Whether it gains what is demanded.
    pub fn gains_enough(&self, demands: &Demands) -> bool {
        let (total, z) = self.total_and_z();
        let sure = z > demands.z || demands.of_few && significant(&self.gains, demands.z);
        total > demands.nats && sure
    }
}

/// What a hypothesis must bring to be chosen.
#[derive(Clone, Copy, Debug)]
pub struct Demands {
    /// Mean gain of a frame over its standard error.
    pub z: f64,
    /// Gain of all frames together, nats.
    pub nats: f64,
    /// Share of the best gain by which a simpler hypothesis may fall behind.
    pub slack: f64,
    /// Share of its gain by which a hypothesis with more parameters and another cause must exceed the simpler one,
    /// significantly, to be reported beside it.
    pub richer: f64,
    /// Whether few frames may have most of the gain, if they agree: objects are seen in few frames.
    pub of_few: bool,
}

/// The outcome of a step.
#[derive(Clone, Debug)]
pub struct Choice {
    /// The chosen trial.
    pub chosen: usize,
    /// Trials of other causes that explain as much as far as these frames tell, or nearly as much with fewer
    /// parameters.
    pub equals: Vec<usize>,
}

impl Choice {
    /// The choice of the only trial.
    pub fn of_one() -> Choice {
        Choice { chosen: 0, equals: vec![] }
    }
}

/// Sum of the gains, and their mean over its standard error. The relative standard deviation is taken to be at least
/// 1/30, which bounds z by 30 times the square root of the number of frames.
pub fn total_and_z(gains: &[f64]) -> (f64, f64) {
    let n = gains.len() as f64;
    let total: f64 = gains.iter().sum();
    if gains.len() < 2 {
        return (total, 0.0);
    }
    let mean = total / n;
    let variance = gains.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let error = (variance / n).sqrt().max(mean.abs() / (30.0 * n.sqrt())).max(1e-12);
    (total, mean / error)
}

/// Fewest frames, each counted by its share of what all are expected to gain, from which the scatter about it is known.
const FEWEST_EXPECTED: f64 = 6.0;

/// The same where frames are expected to gain more or less, as by how much of the effect they show: what scatters are
/// the gains about their share of the total. The shares `w` take `1 - sum w^2` of the variance up. Where few frames are
/// expected to gain anything, fewer than `fewest`, it is not known.
pub fn total_and_z_about(gains: &[f64], expected: &[f64], fewest: f64) -> Option<(f64, f64)> {
    let [total, all] = [gains, expected].map(|of| of.iter().sum::<f64>());
    let squares: f64 = expected.iter().map(|e| (e / all.max(1e-300)).powi(2)).sum();
    if expected.len() != gains.len() || all <= 0.0 || squares * fewest > 1.0 {
        return None;
    }
    let about: f64 = gains.iter().zip(expected).map(|(g, e)| (g - total * e / all).powi(2)).sum();
    let n = gains.len() as f64;
    let error = (about / (1.0 - squares)).sqrt().max(total.abs() / (30.0 * n.sqrt())).max(1e-12);
    Some((total, total / error))
}

/// Fewest directions, each counted by its share of what all are expected to gain, that are compared.
const FEWEST_DIRECTIONS: f64 = 2.5;

/// Mean gain of a direction over its standard error that is demanded: 4 % of errors of surfaces alone reach it (seven
/// degrees of freedom).
const Z_DIRECTIONS: f64 = 2.0;

/// Whether the gains of directions agree with what each is expected to gain; true where too few show the effect. A
/// surface that stands elsewhere, or is missing, does so in all frames that show it: other directions tell that from
/// an effect of the sensor.
pub fn directions_agree(gains: &[f64], expected: &[f64]) -> bool {
    total_and_z_about(gains, expected, FEWEST_DIRECTIONS).is_none_or(|(_, z)| z > Z_DIRECTIONS)
}

/// Whether gains are consistent although few frames have most of them. An effect that only some scenes show (a bend,
/// an object beside the road) gains much on at least three frames, and all losses together are below 15 % of all
/// gains.
fn consistent(gains: &[f64]) -> bool {
    let won: f64 = gains.iter().filter(|g| **g > 0.0).sum();
    let lost: f64 = -gains.iter().filter(|g| **g < 0.0).sum::<f64>();
    let plenty = gains.iter().filter(|g| **g > PLENTY).count();
    plenty >= 3 && lost < 0.15 * won
}

/// Gain of a single frame that does not occur by chance, nats.
const PLENTY: f64 = 8.0;

/// Whether gains are significant.
pub fn significant(gains: &[f64], z_least: f64) -> bool {
    let (_, z) = total_and_z(gains);
    z > z_least || z > 1.5 && consistent(gains)
}

/// Sign test: whether positive differences outnumber negative ones by more than `z_least` standard errors. Frames
/// without a difference do not count.
pub fn significant_by_signs(differences: &[f64], z_least: f64) -> bool {
    let more = differences.iter().filter(|d| **d > 0.0).count() as f64;
    let less = differences.iter().filter(|d| **d < 0.0).count() as f64;
    more - less > z_least * (more + less).sqrt()
}

/// Chooses the simplest of the trials that are nearly as good as the best; `None` where no trial meets the demands.
pub fn choose(trials: &[Trial], demands: &Demands) -> Option<Choice> {
    let eligible: Vec<usize> =
        (0..trials.len()).filter(|&i| trials[i].above_floor && trials[i].gains_enough(demands)).collect();
    let total = |i: usize| total_and_z(&trials[i].gains).0;
    let best = eligible.iter().copied().max_by(|a, b| total(*a).total_cmp(&total(*b)))?;
    // Difference of the gains, and its z.
    let ahead = |of: usize, rival: usize| {
        let differences: Vec<f64> = trials[of].gains.iter().zip(&trials[rival].gains).map(|(a, b)| a - b).collect();
        total_and_z(&differences)
    };
    let near = |i: usize, than: usize| {
        let (deficit, z) = ahead(than, i);
        deficit < demands.slack * total(than) || z < 2.0
    };
    let simpler = eligible.iter().copied().filter(|&i| near(i, best));
    let chosen = simpler
        .min_by(|a, b| trials[*a].parameters.cmp(&trials[*b].parameters).then(total(*b).total_cmp(&total(*a))))
        .unwrap_or(best);
    // A slightly wrong form of the right cause lets a richer law gain a little. Where it gains more, significantly,
    // both are reported.
    let worth_more = |&i: &usize| {
        let (more, z) = ahead(i, chosen);
        let richer = trials[i].parameters > trials[chosen].parameters;
        let other = trials[i].cause != trials[chosen].cause && trials[i].cause != Cause::Unexplained;
        richer && other && more > demands.richer * total(i) && z > 3.0
    };
    let richer = eligible.iter().copied().filter(worth_more).max_by(|&a, &b| total(a).total_cmp(&total(b)));
    let mut equals: Vec<usize> = eligible
        .iter()
        .copied()
        .filter(|&i| trials[i].cause != trials[chosen].cause && trials[i].parameters <= trials[chosen].parameters)
        .filter(|&i| {
            let (deficit, z) = ahead(chosen, i);
            z < 2.0 && deficit < 0.1 * total(chosen)
        })
        .collect();
    // A rival with more than twice the gain, though below the demands on significance, makes the choice ambiguous.
    let far_better = |t: &Trial| {
        let (gain, z) = total_and_z(&t.gains);
        t.above_floor && t.cause != trials[chosen].cause && gain > 2.0 * total(chosen) && z > 1.5
    };
    equals.extend((0..trials.len()).filter(|i| !eligible.contains(i) && far_better(&trials[*i])));
    match richer {
        Some(richer) => {
            equals.retain(|&i| trials[i].cause != trials[richer].cause);
            equals.insert(0, chosen);
            Some(Choice { chosen: richer, equals })
        }
        None => Some(Choice { chosen, equals }),
    }
}

/// Other causes, without more parameters, whose gain falls behind the chosen one's by less than a share, significant
/// or not.
pub fn as_good(trials: &[Trial], chosen: usize, but_for: f64) -> Vec<Cause> {
    let c = &trials[chosen];
    let least = (1.0 - but_for) * total_and_z(&c.gains).0;
    let others = trials.iter().filter(|t| t.above_floor && t.cause != c.cause && t.parameters <= c.parameters);
    others.filter(|t| total_and_z(&t.gains).0 > least).map(|t| t.cause).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trial(cause: Cause, parameters: usize, gains: &[f64]) -> Trial {
        Trial { candidate: 0, cause, parameters, gains: gains.to_vec(), expected: vec![], above_floor: true }
    }

    const DEMANDS: Demands = Demands { z: 3.0, nats: 8.0, slack: 0.02, richer: 0.02, of_few: false };

    #[test]
    fn the_simplest_of_equals_wins() {
        let simple = trial(Cause::RandomDropout, 1, &[10.0, 11.0, 9.0, 10.0]);
        let complex = trial(Cause::RangeDropout, 3, &[10.1, 11.2, 9.0, 10.2]);
        let choice = choose(&[complex.clone(), simple.clone()], &DEMANDS).unwrap();
        assert_eq!((choice.chosen, choice.equals.len()), (1, 0));
        let strict = Demands { richer: 0.005, ..DEMANDS };
        let richer = trial(Cause::RangeDropout, 3, &[10.1, 11.1, 9.2, 10.2]);
        let choice = choose(&[richer, simple.clone()], &strict).unwrap();
        assert_eq!((choice.chosen, choice.equals), (0, vec![1]), "significantly better, and by more than a wrong form");
        let better = trial(Cause::RangeDropout, 3, &[20.0, 21.0, 19.0, 20.0]);
        assert_eq!(choose(&[better, simple], &DEMANDS).unwrap().chosen, 0);
    }

    /// Ever less of the effect from the beginning to the end: the gains are what is expected, but for little.
    #[test]
    fn gains_scatter_about_what_is_expected_of_them() {
        let expected: Vec<f64> = (0..16).map(|f| f64::from(16 - f).powi(2) / 20.0).collect();
        let gains: Vec<f64> = expected.iter().enumerate().map(|(f, e)| e + [0.5, -0.4][f % 2]).collect();
        let (total, z) = total_and_z(&gains);
        let about = total_and_z_about(&gains, &expected, 6.0).unwrap();
        assert!(z < 5.0 && about.0 == total && about.1 > 20.0, "{z} {about:?}");
        // Alike everywhere: the same as without.
        let (_, alike) = total_and_z_about(&gains, &[2.0; 16], 6.0).unwrap();
        assert!((alike - z).abs() < 1e-9, "{alike} {z}");
        // One frame alone tells nothing of the scatter.
        let one: Vec<f64> = (0..16).map(|f| if f == 3 { 900.0 } else { 1e-3 }).collect();
        assert_eq!(total_and_z_about(&one, &one, 6.0), None);
    }

    #[test]
    fn what_only_some_frames_show_counts_and_what_hurts_others_does_not() {
        let some = [0.0, 900.0, -1.0, 20.0, 0.0, 1500.0, -2.0, 30.0];
        assert!(total_and_z(&some).1 < 3.0 && significant(&some, 3.0));
        assert!(!significant(&some.map(|g| if g < 1.0 { g - 100.0 } else { g }), 3.0));
        assert!(!significant(&[0.0, 900.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 3.0), "one frame is chance");
    }

    #[test]
    fn many_frames_that_point_the_same_way_are_no_chance() {
        let seldom = [28.0, 11.0, 9.0, 0.0, 18.0, 23.0, 313.0, 462.0, 15.0, 4.0, 1.0, 0.0];
        assert!(total_and_z(&seldom).1 < 2.0 && significant_by_signs(&seldom, 3.0));
        let half = |i: usize| if i.is_multiple_of(3) { -1.0 } else { 1.0 };
        assert!(!significant_by_signs(&(0..30).map(half).collect::<Vec<_>>(), 3.0));
        assert!(!significant_by_signs(&[9.0; 9], 3.0) && !significant_by_signs(&[], 3.0));
    }

    #[test]
    fn equals_are_reported_and_noise_is_not_chosen() {
        let a = trial(Cause::RandomDropout, 1, &[10.0, 11.0, 9.0, 10.0]);
        let b = trial(Cause::RangeDropout, 1, &[10.4, 10.5, 9.6, 9.3]);
        assert_eq!(choose(&[a.clone(), b], &DEMANDS).unwrap().equals.len(), 1);
        let scattered = trial(Cause::SignalDropout, 2, &[90.0, 5.0, -10.0, 80.0]);
        assert_eq!(
            choose(&[a.clone(), scattered], &DEMANDS).unwrap().equals,
            [1],
            "far more, though not significantly"
        );
        assert!(choose(&[trial(Cause::RangeNoise, 1, &[30.0, -20.0, 25.0, -10.0])], &DEMANDS).is_none());
        assert!(choose(&[Trial { above_floor: false, ..a.clone() }], &DEMANDS).is_none());
        let nearly = trial(Cause::RangeDropout, 1, &[9.9, 10.9, 8.9, 9.9]);
        let [richer, less] = [trial(Cause::SignalDropout, 2, &[10.0; 4]), trial(Cause::IncidenceDropout, 1, &[9.0; 4])];
        assert_eq!(as_good(&[a, nearly, richer, less], 0, 0.02), [Cause::RangeDropout]);
    }
}
