//! Scores a diagnosis against the truth. Reads `diagnosis.json` only.

use crate::truth::{Hidden, Level, Truth};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeSet;

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
    /// Whether a cause is named.
    pub fn names(&self, cause: &str) -> bool {
        self.named.iter().any(|n| n == cause)
    }

    /// Whether a cause is a candidate of an ambiguous finding.
    pub fn mentions(&self, cause: &str) -> bool {
        self.ambiguous.iter().any(|candidates| candidates.iter().any(|n| n == cause))
    }

    /// Named causes, each once, that are not hidden.
    pub fn false_names(&self) -> BTreeSet<&str> {
        let is_hidden = |n: &str| self.truth.hidden.iter().any(|h| h.in_catalogue && h.cause == n);
        self.named.iter().map(String::as_str).filter(|n| !is_hidden(n)).collect()
    }

    /// Kind of the case in tables: effects that the diagnosis cannot name are apart from those that it can.
    pub fn kind(&self) -> String {
        let hidden = &self.truth.hidden;
        let nameless = !hidden.is_empty() && !hidden.iter().any(|h| h.in_catalogue);
        match self.truth.kind.as_str() {
            kind if nameless && kind != "off_catalogue" => format!("{kind}, no name"),
            kind => kind.to_owned(),
        }
    }

    /// The highest level of a hidden effect; `-` where nothing is hidden or strengths are not known.
    pub fn level(&self) -> &'static str {
        self.truth.hidden.iter().filter_map(|h: &Hidden| h.level).max().map_or("-", Level::name)
    }

    /// Grade of the result.
    pub fn grade(&self) -> &'static str {
        let nameable = self.truth.hidden.iter().filter(|h| h.in_catalogue);
        let hidden: Vec<&str> = nameable.map(|h| h.cause.as_str()).collect();
        let nothing = self.named.is_empty() && self.ambiguous.is_empty() && self.unexplained == 0;
        let wrong = !self.false_names().is_empty();
        match self.truth.kind.as_str() {
            "shuffled" => {
                if self.verdict == "not_scenario_identical" {
                    "refused"
                } else {
                    "not refused"
                }
            }
            _ if self.verdict == "not_scenario_identical" => "refused wrongly",
            _ if self.truth.hidden.is_empty() => {
                if nothing {
                    "clean"
                } else {
                    "false alarm"
                }
            }
            _ if hidden.is_empty() => match (nothing, wrong) {
                (true, _) => "missed",
                (_, true) => "wrong name",
                _ => "unexplained",
            },
            _ if wrong => "wrong name",
            _ if nothing => "missed",
            _ if hidden.iter().all(|h| self.names(h)) => "right",
            _ if hidden.iter().all(|h| self.names(h) || self.mentions(h)) => "ambiguous",
            _ if !self.named.is_empty() => "partly",
            _ => "unexplained",
        }
    }
}
