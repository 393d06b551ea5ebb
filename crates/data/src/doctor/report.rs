//! The report: numbers, findings, and a verdict in words.

use super::reading::Reading;
use super::survey::FrameFacts;
use crate::{Dataset, LabelFrame, PointColumns};
use serde::Serialize;
use statistics::median_upper_of_sorted;
use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

/// How much a finding matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// A training or a test with this data would be wrong, or not run.
    Problem,
    /// Good to know.
    Note,
}

/// One thing that was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// Which check it comes from.
    pub check: String,
    /// What is the matter, in words.
    pub message: String,
    /// The frames it is about, at most a hundred.
    pub frames: Vec<String>,
}

/// Findings as they come in.
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

    /// A problem where it concerns more than one in twenty, else a note; nothing where there is none.
    pub(super) fn by_share(&mut self, check: &str, message: String, bad: &[String], of: usize) {
        if !bad.is_empty() {
            let severity = if bad.len() * 20 > of { Severity::Problem } else { Severity::Note };
            self.add(severity, check, message, bad.iter().cloned());
        }
    }
}

/// Smallest, median and largest of some numbers; all 0 where there are none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
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

/// What the clouds hold.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PointFacts {
    /// Points in a frame.
    pub per_frame: Spread,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]` over all frames, m.
    pub range_m: [f64; 6],
    /// Smallest and largest intensity, where there is one.
    pub intensity: Option<[f64; 2]>,
}

/// What the labels of one class say.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ClassFacts {
    /// The class.
    pub class: String,
    /// The data set lists it.
    pub listed: bool,
    /// Boxes.
    pub boxes: usize,
    /// Length, m.
    pub length_m: Spread,
    /// Width, m.
    pub width_m: Spread,
    /// Height, m.
    pub height_m: Spread,
    /// Height of the underside, m, LiDAR frame.
    pub bottom_m: Spread,
    /// Distance of the centre from the sensor, seen from above, m.
    pub range_m: Spread,
    /// Points inside.
    pub points: Spread,
    /// Boxes without a point.
    pub without_points: usize,
}

/// What the doctor found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DoctorReport {
    /// Form of this report.
    pub schema: &'static str,
    /// Name of the data set.
    pub dataset: String,
    /// Its folder.
    pub root: PathBuf,
    /// The frame in which its labels are declared.
    pub label_frame: LabelFrame,
    /// The values of its points.
    pub points: PointColumns,
    /// No problem was found; notes do not count.
    pub sound: bool,
    /// The outcome in a sentence.
    pub verdict: String,
    /// What was found, problems first.
    pub findings: Vec<Finding>,
    /// Frames in the folder.
    pub frames: usize,
    /// Frames of each split that could be read.
    pub splits: BTreeMap<String, usize>,
    /// Labelled boxes.
    pub boxes: usize,
    /// What the clouds hold.
    pub clouds: PointFacts,
    /// What the labels say, by class.
    pub classes: Vec<ClassFacts>,
    /// Ways to read the labels, the one that puts most points into the boxes first.
    pub readings: Vec<Reading>,
}

impl DoctorReport {
    #[expect(clippy::too_many_arguments, reason = "the one place where the parts come together")]
    pub(super) fn new(
        dataset: &Dataset,
        ids: &[String],
        frames: &[FrameFacts],
        splits: BTreeMap<String, Vec<String>>,
        clouds: PointFacts,
        classes: Vec<ClassFacts>,
        readings: Vec<Reading>,
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
            schema: "lidarshift/doctor/1",
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

/// The report for people.
impl fmt::Display for DoctorReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} ({}): {} frames, {} boxes", self.dataset, self.root.display(), self.frames, self.boxes)?;
        let splits: Vec<_> = self.splits.iter().map(|(name, frames)| format!("{name} {frames}")).collect();
        writeln!(f, "  splits: {}", if splits.is_empty() { "none".into() } else { splits.join(", ") })?;
        let (per_frame, r) = (self.clouds.per_frame, self.clouds.range_m);
        writeln!(f, "  points a frame: {} to {}, median {}", per_frame.min, per_frame.max, per_frame.median)?;
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
            let word = if finding.severity == Severity::Problem { "PROBLEM" } else { "note" };
            writeln!(f, "{word}: {}: {}", finding.check, finding.message)?;
        }
        write!(f, "{}", self.verdict)
    }
}

/// The first of some texts, and how many more there are.
pub(super) fn at_most(shown: usize, texts: &[String], between: &str) -> String {
    let mut out = texts[..texts.len().min(shown)].join(between);
    if texts.len() > shown {
        out += &format!("{between}and {} more", texts.len() - shown);
    }
    out
}
