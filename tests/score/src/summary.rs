//! Counts over many cases.

use crate::outcome::{Outcome, ParameterScore};
use crate::swarm::SwarmTable;
use serde::{Deserialize, Serialize};
use statistics::median_upper;
use std::collections::BTreeMap;

/// Summary of a set of cases.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Number of cases by kind and grade.
    pub grades: BTreeMap<String, BTreeMap<String, usize>>,
    /// Number of cases by kind, level of the strongest hidden effect, and grade.
    #[serde(default)]
    pub levels: BTreeMap<String, BTreeMap<String, BTreeMap<String, usize>>>,
    /// For cases with one hidden effect, by hidden cause and reported cause: `confusion[hidden][reported]`.
    pub confusion: BTreeMap<String, BTreeMap<String, usize>>,
    /// By parameter: number of cases, fraction inside the interval, median of |error| / |truth| over true values other
    /// than zero, RMS of error / bound where known, fraction meeting the accuracy target.
    pub parameters: BTreeMap<String, [f64; 5]>,
    /// Sets of several effects, by their number.
    #[serde(default)]
    pub swarm: SwarmTable,
    /// Median fraction of the gap closed over the cases graded "right".
    pub closed: Option<f64>,
    /// Median and maximum run time of the diagnosis, s.
    pub seconds: [f64; 2],
}

/// Summarises results.
pub fn summarise(outcomes: &[Outcome]) -> Summary {
    let mut summary = Summary::default();
    let mut judged: BTreeMap<String, Vec<ParameterScore>> = BTreeMap::new();
    for o in outcomes {
        *summary.grades.entry(o.kind()).or_default().entry(o.grade().into()).or_default() += 1;
        let of_kind = summary.levels.entry(o.kind()).or_default();
        *of_kind.entry(o.level().into()).or_default().entry(o.grade().into()).or_default() += 1;
        if o.truth.hidden.len() == 1 {
            let hidden = o.truth.hidden[0].cause.split(' ').next().unwrap_or_default().to_owned();
            let mut reported: Vec<String> = o.named.clone();
            reported.extend(o.ambiguous.iter().map(|a| format!("ambiguous({})", a.join("|"))));
            reported.extend((0..o.unexplained).map(|_| "unexplained".to_owned()));
            if reported.is_empty() {
                reported.push("nothing".into());
            }
            for s in reported {
                *summary.confusion.entry(hidden.clone()).or_default().entry(s).or_default() += 1;
            }
        }
        for p in &o.parameters {
            judged.entry(p.name.clone()).or_default().push(p.clone());
        }
    }
    for (name, list) in judged {
        let n = list.len() as f64;
        let inside = list.iter().filter(|p| p.inside()).count() as f64 / n;
        let close = list.iter().filter(|p| p.close()).count() as f64 / n;
        // A parameter whose true value is zero has no relative error.
        let differs = list.iter().filter(|p| p.truth.abs() > 1e-9);
        let relative = median_upper(differs.map(|p| (p.estimate / p.truth - 1.0).abs()).collect());
        let bounded: Vec<f64> = list.iter().filter_map(|p| Some(((p.estimate - p.truth) / p.bound?).powi(2))).collect();
        let rms =
            if bounded.is_empty() { f64::NAN } else { (bounded.iter().sum::<f64>() / bounded.len() as f64).sqrt() };
        summary.parameters.insert(name, [n, inside, relative.unwrap_or(f64::NAN), rms, close]);
    }
    summary.swarm = SwarmTable::of(outcomes);
    summary.closed = median_upper(outcomes.iter().filter(|o| o.grade() == "right").filter_map(|o| o.closed).collect());
    let times: Vec<f64> = outcomes.iter().map(|o| o.seconds).collect();
    summary.seconds = [median_upper(times.clone()).unwrap_or(0.0), times.into_iter().fold(0.0, f64::max)];
    summary
}
