//! Several simulations of the same recordings, ranked by how far each is from the measured data: by the gap of a
//! detector, by distances of clouds, by what a diagnosis finds. All simulations are evaluated on the same frames, and a
//! bootstrap replicate draws the same frames for all of them.

use crate::bootstrap::{BootstrapOptions, Interval};
use crate::distance::FrameDistances;
use crate::matrix::{PairedValues, Quantity};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Schema version of [`Comparison`] as JSON.
pub const COMPARISON_SCHEMA: &str = "lidarshift/comparison/1";

/// What a criterion measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CriterionKind {
    /// Absolute difference of a detector's value between measured and simulated frames.
    DetectorGap,
    /// Distance between measured and simulated clouds.
    Distance,
    /// Difference that a diagnosis measures between measured and simulated returns.
    Diagnosis,
}

impl fmt::Display for CriterionKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            CriterionKind::DetectorGap => "detector gap",
            CriterionKind::Distance => "distance",
            CriterionKind::Diagnosis => "diagnosis",
        })
    }
}

/// A simulation by one criterion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CriterionRow {
    /// Name of the simulation.
    pub simulation: String,
    /// The detector's value on the simulated frames, percent; `None` for other criteria.
    pub value: Option<f64>,
    /// Measured value minus simulated value, percentage points; `None` for other criteria.
    pub difference: Option<f64>,
    /// Bootstrap interval of `difference`.
    pub difference_interval: Option<Interval>,
    /// How far the simulation is from the measured data: the size of `difference`, or the distance. Smaller is better.
    pub size: Option<f64>,
    /// Bootstrap interval of `size`.
    pub interval: Option<Interval>,
    /// Rank by `size`, from 1; `None` without a size.
    pub rank: Option<usize>,
    /// Share of bootstrap replicates in which this simulation has the smallest size; `None` without replicates.
    pub first_share: Option<f64>,
    /// `size` minus that of the simulation with rank 1; `None` for that one.
    pub behind_first: Option<f64>,
    /// Bootstrap interval of `behind_first`, over the same frames. The order is not certain if it contains 0.
    pub behind_interval: Option<Interval>,
}

/// All simulations by one criterion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Criterion {
    /// What is measured.
    pub kind: CriterionKind,
    /// Title.
    pub name: String,
    /// Unit of `size`.
    pub unit: String,
    /// Number of frames.
    pub frames: usize,
    /// The detector's value on the measured frames, percent; `None` for other criteria.
    pub measured: Option<f64>,
    /// What two halves of the measured clouds give; smaller sizes are not significant. `None` for other criteria.
    pub floor: Option<f64>,
    /// The simulations, in the order in which they were given.
    pub rows: Vec<CriterionRow>,
}

/// Findings of a diagnosis of one simulation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SimulationFindings {
    /// Name of the simulation.
    pub simulation: String,
    /// The verdict in words.
    pub verdict: String,
    /// Each finding in words.
    pub findings: Vec<String>,
}

/// The comparison of several simulations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Comparison {
    /// [`COMPARISON_SCHEMA`].
    pub schema: String,
    /// Name of the measured data set.
    pub measured: String,
    /// Names of the simulations, in the order in which they were given.
    pub simulations: Vec<String>,
    /// Names of the simulations by the first criterion, the best first.
    pub order: Vec<String>,
    /// The criteria, the first of which gives the order.
    pub criteria: Vec<Criterion>,
    /// Findings of the diagnosis of each simulation; empty if none was made.
    pub findings: Vec<SimulationFindings>,
    /// Notes to consider before using the numbers.
    pub warnings: Vec<String>,
}

/// Sizes of the simulations, and their values in every bootstrap replicate.
struct Sizes {
    whole: Vec<f64>,
    /// `[replicate][simulation]`
    draws: Vec<Vec<f64>>,
}

impl Comparison {
    /// From criteria; the order is that of the first criterion.
    pub fn new(measured: &str, simulations: Vec<String>, criteria: Vec<Criterion>) -> Comparison {
        let mut order: Vec<(usize, &String)> = simulations.iter().enumerate().collect();
        if let Some(first) = criteria.first() {
            order.sort_by_key(|(i, _)| first.rows[*i].rank.unwrap_or(usize::MAX));
        }
        let order = order.into_iter().map(|(_, name)| name.clone()).collect();
        Comparison {
            schema: COMPARISON_SCHEMA.into(),
            measured: measured.into(),
            simulations,
            order,
            criteria,
            findings: Vec::new(),
            warnings: Vec::new(),
        }
    }
}

impl Criterion {
    /// Gap of a detector: `values` of one class, section, metric and overlap, on the measured set and on each
    /// simulation, in this order.
    pub fn of_detector(
        detector: &str,
        simulations: &[String],
        frames: usize,
        values: &PairedValues,
        bootstrap: &BootstrapOptions,
    ) -> Criterion {
        let gaps = |of: &dyn Fn(usize) -> f64| -> Vec<f64> {
            (1..=simulations.len()).map(|s| (of(0) - of(s)).abs()).collect()
        };
        let replicates = values.draws.first().map_or(0, Vec::len);
        let sizes = Sizes {
            whole: gaps(&|s| values.values[s]),
            draws: (0..replicates).map(|r| gaps(&|s| values.draws[s][r])).collect(),
        };
        let mut rows = rank(simulations, &sizes, bootstrap);
        for (s, row) in rows.iter_mut().enumerate() {
            row.value = defined(values.values[s + 1]);
            (row.difference, row.difference_interval) = values.difference(0, s + 1, bootstrap);
        }
        let place = values.section.map_or(String::new(), |section| format!(", {section}"));
        Criterion {
            kind: CriterionKind::DetectorGap,
            name: format!("{detector}: {} ({}) of {}{place}", values.quantity, values.overlap, values.class),
            unit: "points".into(),
            frames,
            measured: defined(values.values[0]),
            floor: None,
            rows,
        }
    }

    /// Mean gap of several detectors: 3D AP at each overlap, over all distances. `None` with fewer than two values.
    pub fn mean_gap(
        simulations: &[String],
        frames: usize,
        values: &[&PairedValues],
        bootstrap: &BootstrapOptions,
    ) -> Option<Criterion> {
        let used: Vec<&&PairedValues> =
            values.iter().filter(|v| v.quantity == Quantity::Ap40 && v.section.is_none()).collect();
        let replicates = used.iter().map(|v| v.draws.first().map_or(0, Vec::len)).min()?;
        if used.len() < 2 {
            return None;
        }
        let gaps = |of: &dyn Fn(&PairedValues, usize) -> f64| -> Vec<f64> {
            let mean = |s: usize| used.iter().map(|v| (of(v, 0) - of(v, s)).abs()).sum::<f64>() / used.len() as f64;
            (1..=simulations.len()).map(mean).collect()
        };
        let sizes = Sizes {
            whole: gaps(&|v, s| v.values[s]),
            draws: (0..replicates).map(|r| gaps(&|v, s| v.draws[s][r])).collect(),
        };
        Some(Criterion {
            kind: CriterionKind::DetectorGap,
            name: format!("mean gap of 3D AP over {} values (detectors, classes, overlaps)", used.len()),
            unit: "points".into(),
            frames,
            measured: None,
            floor: None,
            rows: rank(simulations, &sizes, bootstrap),
        })
    }

    /// A distance: for each simulation, the value of every frame, in the same order of frames. Frames that one of the
    /// simulations lacks are left out.
    pub fn of_distance(
        simulations: &[String],
        values: &[&FrameDistances],
        bootstrap: &BootstrapOptions,
    ) -> Option<Criterion> {
        let first = values.first()?;
        let n = values.iter().map(|v| v.values.len()).min().unwrap_or(0);
        let kept: Vec<usize> = (0..n).filter(|i| values.iter().all(|v| v.values[*i].is_some())).collect();
        let mean = |weights: &dyn Fn(usize) -> u32| -> Vec<f64> {
            let total: u32 = (0..kept.len()).map(weights).sum();
            let of = |v: &&FrameDistances| {
                let sum: f64 =
                    kept.iter().enumerate().map(|(k, i)| f64::from(weights(k)) * v.values[*i].unwrap_or(0.0)).sum();
                sum / f64::from(total) // NaN without frames
            };
            values.iter().map(of).collect()
        };
        let replicates = if kept.len() < 2 { 0 } else { bootstrap.replicates };
        let draw = |r: usize| {
            let weights = bootstrap.frame_weights("comparison frames", r, kept.len());
            mean(&|k| weights[k])
        };
        let sizes = Sizes { whole: mean(&|_| 1), draws: (0..replicates).map(draw).collect() };
        Some(Criterion {
            kind: CriterionKind::Distance,
            name: format!("{}, {}", first.measure, first.part),
            unit: String::new(),
            frames: kept.len(),
            measured: None,
            floor: first.floor,
            rows: rank(simulations, &sizes, bootstrap),
        })
    }

    /// A single number for each simulation, without intervals.
    pub fn of_numbers(
        kind: CriterionKind,
        name: &str,
        unit: &str,
        frames: usize,
        simulations: &[String],
        numbers: &[Option<f64>],
    ) -> Criterion {
        let whole = numbers.iter().map(|v| v.unwrap_or(f64::NAN)).collect();
        let rows = rank(simulations, &Sizes { whole, draws: Vec::new() }, &BootstrapOptions::default());
        Criterion { kind, name: name.into(), unit: unit.into(), frames, measured: None, floor: None, rows }
    }

    /// The row with rank 1.
    pub fn first(&self) -> Option<&CriterionRow> {
        self.rows.iter().find(|row| row.rank == Some(1))
    }
}

fn defined(v: f64) -> Option<f64> {
    Some(v).filter(|v| v.is_finite())
}

/// Ranks by size. Equal sizes keep the order in which the simulations were given.
fn rank(simulations: &[String], sizes: &Sizes, bootstrap: &BootstrapOptions) -> Vec<CriterionRow> {
    let mut order: Vec<usize> = (0..simulations.len()).filter(|s| sizes.whole[*s].is_finite()).collect();
    order.sort_by(|a, b| sizes.whole[*a].total_cmp(&sizes.whole[*b]));
    let draws_of = |s: usize| sizes.draws.iter().map(move |draw| draw[s]);
    let smallest = |draw: &Vec<f64>| {
        let known = (0..draw.len()).filter(|s| draw[*s].is_finite());
        known.min_by(|a, b| draw[*a].total_cmp(&draw[*b]))
    };
    let firsts: Vec<usize> = sizes.draws.iter().filter_map(smallest).collect();
    let row = |(s, name): (usize, &String)| {
        let rank = order.iter().position(|o| *o == s).map(|rank| rank + 1);
        let behind = order.first().copied().filter(|first| *first != s && rank.is_some());
        CriterionRow {
            simulation: name.clone(),
            value: None,
            difference: None,
            difference_interval: None,
            size: defined(sizes.whole[s]),
            interval: rank.and_then(|_| bootstrap.interval(draws_of(s).collect())),
            rank,
            first_share: (!firsts.is_empty())
                .then(|| firsts.iter().filter(|f| **f == s).count() as f64 / firsts.len() as f64),
            behind_first: behind.map(|first| sizes.whole[s] - sizes.whole[first]),
            behind_interval: behind
                .and_then(|first| bootstrap.interval(draws_of(s).zip(draws_of(first)).map(|(a, b)| a - b).collect())),
        }
    };
    simulations.iter().enumerate().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distance::{Measure, Part};
    use data::stream;
    use rand::RngExt;

    fn names() -> Vec<String> {
        ["a", "b", "c"].map(String::from).into()
    }

    fn bootstrap() -> BootstrapOptions {
        BootstrapOptions { replicates: 200, ..BootstrapOptions::default() }
    }

    #[test]
    fn distances_are_paired_by_frame() {
        // The frames differ much, the simulations by a little in every frame.
        let of = |offset: f64, missing: Option<usize>| {
            let mut rng = stream(1, "comparison test", 0, 0);
            let values = (0..60).map(|i| {
                let scene: f64 = rng.random_range(0.0..10.0);
                (Some(i) != missing).then_some(scene + offset)
            });
            FrameDistances {
                part: Part::Whole,
                measure: Measure::ChamferMeanM,
                values: values.collect(),
                floor: Some(0.1),
            }
        };
        let all = [of(0.3, None), of(0.1, Some(7)), of(0.2, None)];
        let found = Criterion::of_distance(&names(), &all.each_ref(), &bootstrap()).unwrap();
        assert_eq!(found.frames, 59, "the frame that one of them lacks is left out");
        let ranks: Vec<_> = found.rows.iter().map(|row| row.rank.unwrap()).collect();
        assert_eq!(ranks, [3, 1, 2]);
        let last = &found.rows[0];
        assert!((last.behind_first.unwrap() - 0.2).abs() < 1e-9 && last.first_share == Some(0.0));
        let (wide, narrow) = (last.interval.unwrap(), last.behind_interval.unwrap());
        assert!(wide.high - wide.low > 0.5 && narrow.high - narrow.low < 1e-9, "{wide:?} {narrow:?}");
        assert_eq!(found.first().unwrap().simulation, "b");
        let none = Criterion::of_distance(&names(), &[], &bootstrap());
        assert!(none.is_none());
    }

    #[test]
    fn gaps_are_ranked_by_their_size_with_either_sign() {
        let draws = |v: f64| (0..200).map(|r| v + f64::from(r % 5) - 2.0).collect::<Vec<f64>>();
        let values = [60.0, 80.0, 55.0, f64::NAN];
        let paired = PairedValues {
            class: "Car".into(),
            section: None,
            quantity: Quantity::Ap40,
            overlap: 0.7,
            values: values.to_vec(),
            draws: values.map(draws).to_vec(),
        };
        let found = Criterion::of_detector("ours", &names(), 40, &paired, &bootstrap());
        assert_eq!(found.name, "ours: 3D AP (0.7) of Car");
        let rows: Vec<_> = found.rows.iter().map(|row| (row.difference, row.size, row.rank)).collect();
        assert_eq!(rows[0], (Some(-20.0), Some(20.0), Some(2)));
        assert_eq!(rows[1], (Some(5.0), Some(5.0), Some(1)));
        assert_eq!(rows[2], (None, None, None));
        assert_eq!(found.rows[0].behind_interval, Some(Interval { low: 15.0, high: 15.0 }), "common noise cancels");
        assert_eq!((found.rows[1].first_share, found.rows[0].first_share), (Some(1.0), Some(0.0)));
        let comparison = Comparison::new("real", names(), vec![found]);
        assert_eq!(comparison.order, ["b", "a", "c"]);
        assert!(Criterion::mean_gap(&names(), 40, &[&paired], &bootstrap()).is_none());
        let mean = Criterion::mean_gap(&names(), 40, &[&paired, &paired], &bootstrap()).unwrap();
        assert_eq!(mean.rows[1].size, Some(5.0));
    }

    #[test]
    fn numbers_have_ranks_without_intervals() {
        let numbers = [Some(0.4), None, Some(0.1)];
        let found = Criterion::of_numbers(CriterionKind::Diagnosis, "d", "nats", 10, &names(), &numbers);
        let ranks: Vec<_> = found.rows.iter().map(|row| row.rank).collect();
        assert_eq!(ranks, [Some(2), None, Some(1)]);
        assert!(found.rows.iter().all(|row| row.interval.is_none() && row.first_share.is_none()));
    }
}
