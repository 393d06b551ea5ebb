//! Scores a diagnosis against the truth. Reads `diagnosis.json` only.

use crate::effect::Truth;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use statistics::median_upper;
use std::collections::BTreeMap;

/// Result of one case.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// The truth.
    pub truth: Truth,
    /// The overall verdict of the diagnosis.
    pub verdict: String,
    /// Causes named by the diagnosis.
    pub named: Vec<String>,
    /// Candidate causes of each ambiguous finding.
    pub ambiguous: Vec<Vec<String>>,
    /// Number of unexplained findings.
    pub unexplained: usize,
    /// Parameters of correctly named causes: true value, estimate, interval, bound.
    pub parameters: Vec<ParameterScore>,
    /// Fraction of the gap closed, as reported by the diagnosis.
    pub closed: Option<f64>,
    /// Run time of the diagnosis, s.
    pub seconds: f64,
}

/// An estimated parameter and its true value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterScore {
    /// `CAUSE.PARAMETER`.
    pub name: String,
    /// True value.
    pub truth: f64,
    /// Estimate.
    pub estimate: f64,
    /// 95 % confidence interval.
    pub ci95: [f64; 2],
    /// Cramér-Rao bound of the standard error, if known.
    pub bound: Option<f64>,
}

impl ParameterScore {
    /// Whether the interval contains the true value.
    pub fn inside(&self) -> bool {
        self.ci95[0] <= self.truth && self.truth <= self.ci95[1]
    }

    /// Whether the estimate meets the accuracy target: within 1.5 times the bound or 5 % of the true value (10 % for
    /// mixed pixels, jitter and signal parameters).
    pub fn close(&self) -> bool {
        let coarse = ["mixed_pixels", "angular_jitter", "signal_dropout"].iter().any(|c| self.name.starts_with(c));
        let share = if coarse { 0.1 } else { 0.05 };
        (self.estimate - self.truth).abs() <= (1.5 * self.bound.unwrap_or(0.0)).max(share * self.truth.abs())
    }
}

/// Scores a diagnosis.
pub fn score(truth: &Truth, diagnosis: &Value, seconds: f64) -> Outcome {
    let findings = diagnosis["findings"].as_array().cloned().unwrap_or_default();
    let with = |status: &str| findings.iter().filter(|f| f["status"] == status).cloned().collect::<Vec<_>>();
    let text = |v: &Value| v.as_str().unwrap_or_default().to_owned();
    let mut parameters = Vec::new();
    for finding in with("named") {
        let Some(hidden) = truth.hidden.iter().find(|h| finding["cause"] == h.cause.as_str()) else { continue };
        for (name, value) in &hidden.parameters {
            let reported = &finding["parameters"][name];
            if let (Some(estimate), Some(low), Some(high)) =
                (reported["estimate"].as_f64(), reported["ci95"][0].as_f64(), reported["ci95"][1].as_f64())
            {
                let name_of = format!("{}.{name}", hidden.cause);
                let bound = hidden.bound.get(name).copied();
                parameters.push(ParameterScore { name: name_of, truth: *value, estimate, ci95: [low, high], bound });
            }
        }
    }
    Outcome {
        truth: truth.clone(),
        verdict: text(&diagnosis["verdict"]),
        named: with("named").iter().map(|f| text(&f["cause"])).collect(),
        ambiguous: with("ambiguous")
            .iter()
            .map(|f| f["candidates"].as_array().into_iter().flatten().map(text).collect())
            .collect(),
        unexplained: with("unexplained").len(),
        parameters,
        closed: diagnosis["gain"]["closed"].as_f64(),
        seconds,
    }
}

impl Outcome {
    /// Grade of the result.
    pub fn grade(&self) -> &'static str {
        let hidden: Vec<&str> = self.truth.hidden.iter().filter(|h| h.in_catalogue).map(|h| h.cause.as_str()).collect();
        let nothing = self.named.is_empty() && self.ambiguous.is_empty() && self.unexplained == 0;
        let wrong = self.named.iter().any(|n| !hidden.contains(&n.as_str()));
        match self.truth.kind.as_str() {
            "shuffled" => {
                if self.verdict == "not_scenario_identical" {
                    "refused"
                } else {
                    "not refused"
                }
            }
            _ if self.verdict == "not_scenario_identical" => "refused wrongly",
            "null" => {
                if nothing {
                    "clean"
                } else {
                    "false alarm"
                }
            }
            "off_catalogue" => match (nothing, wrong) {
                (true, _) => "missed",
                (_, true) => "wrong name",
                _ => "unexplained",
            },
            _ if wrong => "wrong name",
            _ if nothing => "missed",
            _ if hidden.iter().all(|h| self.named.iter().any(|n| n == h)) => "right",
            _ if hidden.iter().all(|h| {
                self.named.iter().any(|n| n == h) || self.ambiguous.iter().any(|a| a.iter().any(|n| n == h))
            }) =>
            {
                "ambiguous"
            }
            _ if !self.named.is_empty() => "partly",
            _ => "unexplained",
        }
    }
}

/// Summary of a set of cases.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Number of cases by kind and grade.
    pub grades: BTreeMap<String, BTreeMap<String, usize>>,
    /// For single cases, by hidden cause and reported cause: `confusion[hidden][reported]`.
    pub confusion: BTreeMap<String, BTreeMap<String, usize>>,
    /// By parameter: number of cases, fraction inside the interval, median of |error| / |truth|, RMS of error / bound
    /// where known, fraction meeting the accuracy target.
    pub parameters: BTreeMap<String, [f64; 5]>,
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
        *summary.grades.entry(o.truth.kind.clone()).or_default().entry(o.grade().into()).or_default() += 1;
        if o.truth.kind == "single" || o.truth.kind == "off_catalogue" {
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
        let relative =
            median_upper(list.iter().map(|p| (p.estimate - p.truth).abs() / p.truth.abs().max(1e-9)).collect());
        let bounded: Vec<f64> = list.iter().filter_map(|p| Some(((p.estimate - p.truth) / p.bound?).powi(2))).collect();
        let rms =
            if bounded.is_empty() { f64::NAN } else { (bounded.iter().sum::<f64>() / bounded.len() as f64).sqrt() };
        summary.parameters.insert(name, [n, inside, relative.unwrap_or(f64::NAN), rms, close]);
    }
    summary.closed = median_upper(outcomes.iter().filter(|o| o.grade() == "right").filter_map(|o| o.closed).collect());
    let times: Vec<f64> = outcomes.iter().map(|o| o.seconds).collect();
    summary.seconds = [median_upper(times.clone()).unwrap_or(0.0), times.into_iter().fold(0.0, f64::max)];
    summary
}
