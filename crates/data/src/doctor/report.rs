//! The report: numbers, findings and a verdict.

use super::interpretation::Interpretation;
use super::survey::FrameFacts;
use crate::{Dataset, LabelFrame, PointColumns};
use schemars::JsonSchema;
use serde::Serialize;
use statistics::median_upper_of_sorted;
use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Training or evaluation with this data would fail or give wrong results.
    Problem,
    /// Information that does not make the data unusable.
    Note,
}

/// A result of a check.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Finding {
    /// Severity.
    pub severity: Severity,
    /// Name of the check.
    pub check: String,
    /// What was found.
    pub message: String,
    /// Ids of the frames concerned, at most 100.
    pub frames: Vec<String>,
}

/// Collects findings in the order of the checks.
#[derive(Default)]
pub(super) struct Findings(Vec<Finding>);

impl Findings {
    pub(super) fn problem(&mut self, check: &str, message: String, frames: impl IntoIterator<Item = String>) {
        self.add(Severity::Problem, check, message, frames);
    }

    pub(super) fn note(&mut self, check: &str, message: String, frames: impl IntoIterator<Item = String>) {
        self.add(Severity::Note, check, message, frames);
    }

    pub(super) fn add(
        &mut self,
        severity: Severity,
        check: &str,
        message: String,
        frames: impl IntoIterator<Item = String>,
    ) {
        let frames = frames.into_iter().take(100).collect();
        self.0.push(Finding { severity, check: check.into(), message, frames });
    }

    /// Adds a problem if more than 5 % of `of` are bad, a note if fewer are, nothing if none is.
    pub(super) fn by_share(&mut self, check: &str, message: String, bad: &[String], of: usize) {
        if !bad.is_empty() {
            let severity = if bad.len() * 20 > of { Severity::Problem } else { Severity::Note };
            self.add(severity, check, message, bad.iter().cloned());
        }
    }
}

/// Smallest, median and largest of a set of values; all 0 if it is empty.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Spread {
    /// Smallest.
    pub min: f64,
    /// Median.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    pub(super) fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_by(f64::total_cmp);
        match values[..] {
            [] => Spread::default(),
            [min, ..] => {
                let median = median_upper_of_sorted(&values).unwrap_or(min);
                Spread { min, median, max: values[values.len() - 1] }
            }
        }
    }
}

/// Statistics of the clouds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct PointFacts {
    /// Points per frame.
    pub per_frame: Spread,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]` over all frames, m.
    pub range_m: [f64; 6],
    /// Smallest and largest intensity; `None` without intensity.
    pub intensity: Option<[f64; 2]>,
}

/// Statistics of the labels of one class.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct ClassFacts {
    /// The class.
    pub class: String,
    /// Whether the class is in the data set's list of classes.
    pub listed: bool,
    /// Number of boxes.
    pub boxes: usize,
    /// Length, m.
    pub length_m: Spread,
    /// Width, m.
    pub width_m: Spread,
    /// Height, m.
    pub height_m: Spread,
    /// z of the bottom face, m, LiDAR frame.
    pub bottom_m: Spread,
    /// Horizontal distance of the centre from the origin of the LiDAR frame, m.
    pub range_m: Spread,
    /// Points inside a box.
    pub points: Spread,
    /// Number of boxes without a point inside.
    pub without_points: usize,
}

/// Version of the JSON of a [`DoctorReport`].
pub const DOCTOR_SCHEMA: &str = "lidarshift/doctor/1";

/// Report of the checks of a data set.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct DoctorReport {
    /// Name and version of this JSON format.
    pub schema: &'static str,
    /// Name of the data set.
    pub dataset: String,
    /// Root folder of the data set.
    pub root: PathBuf,
    /// The label frame that the data set declares.
    pub label_frame: LabelFrame,
    /// Columns of the points.
    pub points: PointColumns,
    /// Whether there is no problem; notes are allowed.
    pub sound: bool,
    /// Summary in one sentence.
    pub verdict: String,
    /// All findings, problems first.
    pub findings: Vec<Finding>,
    /// Number of frames in the folder.
    pub frames: usize,
    /// Number of frames of each split that could be read.
    pub splits: BTreeMap<String, usize>,
    /// Number of labelled boxes.
    pub boxes: usize,
    /// Statistics of the clouds.
    pub clouds: PointFacts,
    /// Statistics of the labels, by class.
    pub classes: Vec<ClassFacts>,
    /// Interpretations of the labels, the one with most points inside the boxes first.
    pub readings: Vec<Interpretation>,
}

impl DoctorReport {
    #[expect(clippy::too_many_arguments, reason = "called once, with the result of each check")]
    pub(super) fn new(
        dataset: &Dataset,
        ids: &[String],
        frames: &[FrameFacts],
        splits: BTreeMap<String, Vec<String>>,
        clouds: PointFacts,
        classes: Vec<ClassFacts>,
        readings: Vec<Interpretation>,
        findings: Findings,
    ) -> Self {
        let mut findings = findings.0;
        findings.sort_by_key(|f| f.severity == Severity::Note);
        let problems = findings.iter().filter(|f| f.severity == Severity::Problem).count();
        let boxes = frames.iter().map(|f| f.objects.len()).sum();
        let name = &dataset.config.name;
        let verdict = match problems {
            0 => format!("Nothing is wrong with {name}: {} frames, {boxes} boxes.", ids.len()),
            1 => format!("One thing is wrong with {name}: {}.", findings[0].message),
            _ => format!("{problems} things are wrong with {name}, the first: {}.", findings[0].message),
        };
        DoctorReport {
            schema: DOCTOR_SCHEMA,
            dataset: name.clone(),
            root: dataset.config.root.clone(),
            label_frame: dataset.config.label_frame,
            points: dataset.config.points,
            sound: problems == 0,
            verdict,
            findings,
            frames: ids.len(),
            splits: splits.into_iter().map(|(name, ids)| (name, ids.len())).collect(),
            boxes,
            clouds,
            classes,
            readings,
        }
    }
}

/// The report as text for the console.
impl fmt::Display for DoctorReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} ({}): {} frames, {} boxes", self.dataset, self.root.display(), self.frames, self.boxes)?;
        let splits: Vec<_> = self.splits.iter().map(|(name, frames)| format!("{name} {frames}")).collect();
        writeln!(f, "  splits: {}", if splits.is_empty() { "none".into() } else { splits.join(", ") })?;
        let (per_frame, r) = (self.clouds.per_frame, self.clouds.range_m);
        writeln!(f, "  points per frame: {} to {}, median {}", per_frame.min, per_frame.max, per_frame.median)?;
        writeln!(
            f,
            "  points span x {:.1}..{:.1}, y {:.1}..{:.1}, z {:.1}..{:.1} m",
            r[0], r[3], r[1], r[4], r[2], r[5]
        )?;
        if let Some([low, high]) = self.clouds.intensity {
            writeln!(f, "  intensity {low:.3}..{high:.3}")?;
        }
        if !self.classes.is_empty() {
            writeln!(
                f,
                "  class            boxes  length  width  height  bottom   range m       points  (medians; range and points from..to)"
            )?;
        }
        for c in &self.classes {
            writeln!(
                f,
                "  {:<16}{:>6} {:>7.2}{:>7.2}{:>8.2}{:>8.2}   {:.0}..{:.0}   {}..{}{}",
                c.class,
                c.boxes,
                c.length_m.median,
                c.width_m.median,
                c.height_m.median,
                c.bottom_m.median,
                c.range_m.min,
                c.range_m.max,
                c.points.min,
                c.points.max,
                if c.listed { "" } else { "   not in the list of classes" }
            )?;
        }
        for finding in &self.findings {
            let severity = if finding.severity == Severity::Problem { "PROBLEM" } else { "note" };
            writeln!(f, "{severity}: {}: {}", finding.check, finding.message)?;
        }
        write!(f, "{}", self.verdict)
    }
}

/// Joins the first `shown` texts by `between` and adds the number of further texts.
pub(super) fn at_most(shown: usize, texts: &[String], between: &str) -> String {
    let mut out = texts[..texts.len().min(shown)].join(between);
    if texts.len() > shown {
        out += &format!("{between}and {} more", texts.len() - shown);
    }
    out
}
