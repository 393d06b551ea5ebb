//! Builds cells, gaps and warnings from the scores of runs.

use super::power::power;
use super::scores::{Curves, RunScores};
use super::split::splits;
use super::{
    Cell, CellNumber, CellRun, Gap, MATRIX_SCHEMA, Matrix, MatrixOptions, MatrixPlan, Place, PlannedNetwork, Quantity,
    Reference, RunId, RunNumber, RunState, published,
};
use crate::{BootstrapOptions, RangeSection, ceiling_ap40};
use rayon::prelude::*;
use statistics::{deviation, mean};
use std::collections::BTreeMap;

/// The scores of a run on a test set, or the reason why there are none.
pub type RunResult = Result<RunScores, String>;

/// A network is reported as undertrained if its AP at overlap 0.5 on its own train domain is below this, percent.
const UNDERTRAINED_AP: f64 = 60.0;

/// A cell with the bootstrap replicates behind its intervals.
pub(super) struct Drawn {
    pub cell: Cell,
    /// By reference and per value of the cell, in its order: the mean over seeds and frames of each bootstrap
    /// replicate.
    draws: [Vec<Vec<f64>>; 3],
    /// Hash of the frame ids.
    pub frames_key: String,
}

impl Drawn {
    /// The replicates of the values against a reference.
    pub fn draws_of(&self, reference: Reference) -> &[Vec<f64>] {
        &self.draws[reference as usize]
    }
}

/// Builds the matrix. `results` is keyed by run and [`Place::name`] of the test set. Planned runs without a result are
/// marked missing; unplanned runs are ignored. The result does not depend on the number of threads.
pub fn build(plan: &MatrixPlan, results: &BTreeMap<(RunId, String), RunResult>, options: &MatrixOptions) -> Matrix {
    let mut keys = Vec::new();
    for network in &plan.networks {
        for train_set in &network.train_sets {
            keys.extend(plan.test_sets.iter().map(|test_set| (network, train_set, test_set)));
        }
    }
    let drawn: Vec<Drawn> = keys.into_par_iter().map(|key| draw(key, results, options)).collect();
    let gaps = gaps(plan, &drawn, options);
    let splits = splits(plan, &drawn, options);
    let mut warnings = plan_warnings(plan);
    warnings.extend(drawn.iter().flat_map(|d| cell_warnings(&d.cell, results)));
    warnings.extend(plan.test_sets.iter().flat_map(|test_set| ceiling_warnings(test_set, &drawn)));
    let mut matrix = Matrix {
        schema: MATRIX_SCHEMA.into(),
        plan: plan.clone(),
        options: options.clone(),
        cells: drawn.into_iter().map(|d| d.cell).collect(),
        gaps,
        splits,
        power: Vec::new(),
        warnings,
    };
    matrix.power = power(&matrix);
    matrix
}

fn draw(
    (network, train_set, test_set): (&PlannedNetwork, &Place, &Place),
    results: &BTreeMap<(RunId, String), RunResult>,
    options: &MatrixOptions,
) -> Drawn {
    let (mut runs, mut done) = (Vec::new(), Vec::new());
    for &seed in &network.seeds {
        let id = RunId { network: network.network.name.clone(), train_set: train_set.name.clone(), seed };
        let state = match results.get(&(id, test_set.name.clone())) {
            Some(Ok(scores)) => {
                done.push((seed, scores));
                RunState::Done
            }
            Some(Err(reason)) => RunState::Failed(reason.clone()),
            None => RunState::Missing,
        };
        runs.push(CellRun { seed, state });
    }
    // A run on other frames cannot be resampled together with the rest.
    if let Some(first) = done.first().map(|(_, scores)| scores.frames) {
        for run in &mut runs {
            if let Some((_, scores)) = done.iter().find(|(seed, s)| *seed == run.seed && s.frames != first) {
                let reason = format!("has {} test frames, the first run of this cell {first}", scores.frames);
                run.state = RunState::Failed(reason);
            }
        }
        done.retain(|(_, scores)| scores.frames == first);
    }
    let first = done.first().map(|(_, scores)| *scores);
    let frames_key = first.map_or(String::new(), |scores| scores.frames_key.clone());
    let places = [&network.network, train_set, test_set];
    let resamples =
        Resamples::new(&network.network.name, &frames_key, first.map_or(0, |s| s.frames), done.len(), options);
    let of_runs =
        Reference::ALL.map(|reference| done.iter().map(|(_, scores)| scores.curves_of(reference)).collect::<Vec<_>>());
    let replicates = resamples.values(&of_runs, &options.bootstrap);
    let [(numbers, of_labels), (of_repaired_labels, of_repaired), (of_true_boxes, of_truth)] =
        Reference::ALL.map(|reference| {
            let drawn: Vec<&[Values]> = replicates.iter().map(|drawn| &drawn[reference as usize][..]).collect();
            numbers_of(&of_runs[reference as usize], &drawn, &done, places, options)
        });
    let cell = Cell {
        network: network.network.name.clone(),
        train_set: train_set.name.clone(),
        test_set: test_set.name.clone(),
        frames: first.map(|scores| scores.frames),
        runs,
        numbers,
        of_repaired_labels,
        of_true_boxes,
    };
    Drawn { cell, draws: [of_labels, of_repaired, of_truth], frames_key }
}

/// The quantities of a curve.
type Values = [f64; Quantity::ALL.len()];

/// Which frames, seeds and version of the boxes are drawn, by replicate.
struct Resamples {
    /// Purpose of the random stream of the frames. How often each of them is drawn is computed when its replicate is:
    /// for a million frames that of all replicates would be gigabytes.
    of_frames: String,
    frames: usize,
    seeds: Vec<Vec<usize>>,
    versions: Vec<usize>,
}

impl Resamples {
    /// Equal for all cells of a network with the same frames and the same number of seeds, so that differences of
    /// cells are paired.
    fn new(network: &str, frames_key: &str, frames: usize, seeds: usize, options: &MatrixOptions) -> Self {
        let replicates = 0..options.bootstrap.replicates;
        let of_seeds = format!("matrix seeds {network}");
        Resamples {
            of_frames: format!("matrix frames {frames_key}"),
            frames,
            seeds: replicates.clone().map(|r| options.bootstrap.seed_draws(&of_seeds, r, seeds)).collect(),
            versions: replicates.map(|r| options.bootstrap.version_draw(r)).collect(),
        }
    }

    /// By replicate and reference the values of each curve: their means over the drawn seeds. `of_runs` are the curves
    /// of all runs by reference.
    fn values(&self, of_runs: &[Vec<Curves>; 3], bootstrap: &BootstrapOptions) -> Vec<[Vec<Values>; 3]> {
        let of_replicate = |replicate: usize| {
            let weights = bootstrap.frame_weights(&self.of_frames, replicate, self.frames);
            let (seeds, version) = (&self.seeds[replicate], self.versions[replicate]);
            let of_reference = |of_runs: &Vec<Curves>| {
                let of_curve = |k: usize| {
                    let mut known: Vec<Option<Values>> = vec![None; of_runs.len()];
                    let mut sum = [0.0; Quantity::ALL.len()];
                    for &i in seeds {
                        let numbers =
                            known[i].get_or_insert_with(|| of_runs[i].version(version)[k].numbers(Some(&weights)).0);
                        sum.iter_mut().zip(numbers).for_each(|(sum, v)| *sum += *v);
                    }
                    sum.map(|sum| sum / seeds.len() as f64)
                };
                (0..curves_of_all(of_runs)).map(of_curve).collect()
            };
            [0, 1, 2].map(|reference: usize| of_reference(&of_runs[reference]))
        };
        (0..self.seeds.len()).into_par_iter().map(of_replicate).collect()
    }
}

/// Number of curves that all runs have.
fn curves_of_all(of_runs: &[Curves]) -> usize {
    of_runs.iter().map(|curves| curves.estimate.len()).min().unwrap_or(0)
}

/// The values of a cell against a reference, with their bootstrap replicates.
fn numbers_of(
    of_runs: &[Curves],
    drawn: &[&[Values]],
    done: &[(u64, &RunScores)],
    places: [&Place; 3],
    options: &MatrixOptions,
) -> (Vec<CellNumber>, Vec<Vec<f64>>) {
    let (mut numbers, mut all_draws) = (Vec::new(), Vec::new());
    for k in 0..curves_of_all(of_runs) {
        let whole: Vec<_> = of_runs.iter().map(|curves| curves.estimate[k].numbers(None)).collect();
        for (q, quantity) in Quantity::ALL.into_iter().enumerate() {
            let values = done.iter().zip(&whole).map(|((seed, _), (numbers, _))| (*seed, numbers[q])).collect();
            let draws: Vec<f64> = drawn.iter().map(|of_curves| of_curves[k][q]).collect();
            let curve = &of_runs[0].estimate[k];
            let key =
                NumberKey { class: curve.class.clone(), section: curve.section, quantity, overlap: curve.overlap };
            let mut number = CellNumber::of_runs(key, values, places);
            number.n_gt = Some(whole[0].1);
            number.ceiling = (quantity == Quantity::Ap40).then(|| ceiling_ap40(whole[0].1)).flatten();
            number.interval = options.bootstrap.interval(draws.clone());
            numbers.push(number);
            all_draws.push(draws);
        }
    }
    (numbers, all_draws)
}

/// Identifies a value of a cell.
pub(super) struct NumberKey {
    pub class: String,
    pub section: Option<RangeSection>,
    pub quantity: Quantity,
    pub overlap: f64,
}

impl CellNumber {
    /// Mean and deviation over runs, given seed and value (NaN if undefined) of each; without an interval. `places`
    /// are the network, the train set and the test set.
    pub(super) fn of_runs(key: NumberKey, runs: Vec<(u64, f64)>, places: [&Place; 3]) -> Self {
        let NumberKey { class, section, quantity, overlap } = key;
        let values: Vec<f64> = runs.iter().map(|(_, value)| *value).collect();
        let defined = |v: f64| Some(v).filter(|v| !v.is_nan());
        let published = match places.map(|place| place.paper.as_deref()) {
            [Some(network), Some(train), Some(test)] if section.is_none() => {
                published(network, train, test, quantity, overlap)
            }
            _ => None,
        };
        CellNumber {
            class,
            section,
            quantity,
            overlap,
            n_gt: None,
            ceiling: None,
            mean: defined(mean(&values)),
            deviation: (values.len() > 1).then(|| defined(deviation(&values))).flatten(),
            interval: None,
            of_runs: runs.iter().map(|(seed, value)| RunNumber { seed: *seed, value: defined(*value) }).collect(),
            published,
        }
    }
}

fn gaps(plan: &MatrixPlan, drawn: &[Drawn], options: &MatrixOptions) -> Vec<Gap> {
    let mut gaps = Vec::new();
    let find = |network: &str, train: &str, test: &str| {
        drawn.iter().find(|d| (&*d.cell.network, &*d.cell.train_set, &*d.cell.test_set) == (network, train, test))
    };
    for planned in &plan.networks {
        let network = &planned.network.name;
        let names: Vec<&str> = planned.train_sets.iter().map(|train| train.name.as_str()).collect();
        for test_set in plan.test_sets.iter().map(|test| test.name.as_str()) {
            let own = names.iter().filter(|train| **train != test_set).map(|train| (test_set, *train));
            let others: Vec<&str> = names.iter().copied().filter(|train| *train != test_set).collect();
            let later = (0..others.len()).flat_map(|i| others[i + 1..].iter().map(move |later| (*later, i)));
            let later = later.map(|(later, i)| (later, others[i]));
            for (compared_to, train_set) in own.chain(later) {
                let (Some(one), Some(other)) =
                    (find(network, compared_to, test_set), find(network, train_set, test_set))
                else {
                    continue;
                };
                for reference in one.cell.references() {
                    let [own, others] = [one, other].map(|d| (d.cell.numbers_of(reference), d.draws_of(reference)));
                    for (i, (a, b)) in own.0.iter().zip(others.0).enumerate() {
                        let (Some(one_mean), Some(other_mean)) = (a.mean, b.mean) else { continue };
                        let draws = own.1[i].iter().zip(&others.1[i]).map(|(a, b)| a - b).collect();
                        gaps.push(Gap {
                            network: network.clone(),
                            test_set: test_set.into(),
                            train_set: train_set.into(),
                            compared_to: compared_to.into(),
                            reference,
                            class: a.class.clone(),
                            section: a.section,
                            quantity: a.quantity,
                            overlap: a.overlap,
                            gap: one_mean - other_mean,
                            interval: options.bootstrap.interval(draws),
                        });
                    }
                }
            }
        }
    }
    gaps
}

pub(super) fn plan_warnings(plan: &MatrixPlan) -> Vec<String> {
    let mut warnings = Vec::new();
    for planned in &plan.networks {
        let mut seeds = planned.seeds.clone();
        seeds.sort_unstable();
        if let Some(pair) = seeds.windows(2).find(|pair| pair[0] == pair[1]) {
            warnings.push(format!(
                "{}: seed {} is there twice: its runs are one run, not two",
                planned.network.title, pair[0]
            ));
        }
    }
    warnings
}

pub(super) fn cell_warnings(cell: &Cell, results: &BTreeMap<(RunId, String), RunResult>) -> Vec<String> {
    let mut warnings = Vec::new();
    let name = format!("{}, {} to {}", cell.network, cell.train_set, cell.test_set);
    for run in &cell.runs {
        match &run.state {
            RunState::Failed(reason) => warnings.push(format!("{name}: seed {} failed: {reason}", run.seed)),
            RunState::Missing => warnings.push(format!("{name}: seed {} is missing", run.seed)),
            RunState::Done => {}
        }
    }
    let of_seed = |seed: u64| {
        let id = RunId { network: cell.network.clone(), train_set: cell.train_set.clone(), seed };
        results.get(&(id, cell.test_set.clone())).and_then(|result| result.as_ref().ok())
    };
    let done: Vec<u64> = cell.runs.iter().filter(|run| run.state == RunState::Done).map(|run| run.seed).collect();
    for (i, &a) in done.iter().enumerate() {
        for &b in &done[i + 1..] {
            if let (Some(x), Some(y)) = (of_seed(a), of_seed(b))
                && x.is_same_as(y)
            {
                warnings.push(format!(
                    "{name}: seeds {a} and {b} do the same on every frame: the seed was not used, or one folder was copied"
                ));
            }
        }
    }
    let zero: Vec<String> = cell
        .numbers
        .iter()
        // Recalls are counts: two runs may agree by chance.
        .filter(|n| n.section.is_none() && n.deviation == Some(0.0))
        .filter(|n| matches!(n.quantity, Quantity::Ap40 | Quantity::ApArea) || n.of_runs.len() > 2)
        .map(|n| format!("{} ({})", n.quantity, n.overlap))
        .collect();
    if !zero.is_empty() {
        warnings.push(format!(
            "{name}: the deviation of {} is exactly 0 over {} runs: unless they find everything or nothing, independent \
             runs do not agree so; check that the seeds are used",
            zero.join(", "),
            done.len()
        ));
    }
    if cell.train_set == cell.test_set {
        let low = cell.numbers.iter().find(|n| {
            n.section.is_none()
                && n.quantity == Quantity::Ap40
                && n.overlap == 0.5
                && n.mean.is_some_and(|mean| mean < UNDERTRAINED_AP.min(n.ceiling.unwrap_or(100.0)))
        });
        if let Some(low) = low {
            warnings.push(format!(
                "{name}: undertrained: AP {:.1} at overlap 0.5 on the set that it was trained on, below {UNDERTRAINED_AP}; \
                 what it loses on other sets says little",
                low.mean.unwrap_or(f64::NAN)
            ));
        }
    }
    warnings
}

/// Warns about test sets whose few ground truths cap AP40, and test sets without ground truth.
fn ceiling_warnings(test_set: &Place, drawn: &[Drawn]) -> Vec<String> {
    let Some(known) = drawn.iter().find(|d| d.cell.test_set == test_set.name && !d.cell.numbers.is_empty()) else {
        return Vec::new();
    };
    let (mut warnings, mut reported) = (Vec::new(), Vec::new());
    for n in known.cell.numbers.iter().filter(|n| n.quantity == Quantity::Ap40) {
        if reported.contains(&(&n.class, n.section)) {
            continue;
        }
        reported.push((&n.class, n.section));
        let place = n.section.map_or(String::new(), |section| format!(", {section}"));
        let place = format!("test set {}, {}{place}", test_set.title, n.class);
        match (n.n_gt, n.ceiling) {
            (Some(0), _) => warnings.push(format!("{place}: no ground truth, hence no number")),
            (Some(n_gt), Some(most)) if most < 100.0 => warnings.push(format!(
                "{place}: {n_gt} ground truths, so that AP40 cannot exceed {most:.1}; see the exact area"
            )),
            _ => {}
        }
    }
    warnings
}
