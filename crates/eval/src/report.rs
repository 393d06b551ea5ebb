//! Evaluation result: rows as JSON, and a plain-text table.

use crate::{Difficulty, Metric, PrecisionCurve, Recall, RecallDefinition};
use data::LabelFrame;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Schema version of [`EvalReport`] as JSON.
pub const SCHEMA: &str = "lidarshift/eval-ap/1";

/// Origin of an overlap limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OverlapSet {
    /// KITTI's own: 0.7 for Car, 0.5 for Pedestrian and Cyclist.
    Official,
    /// OpenPCDet's second set: 0.5 and 0.25 for BEV and 3D.
    Loose,
    /// Set by the user.
    Given,
}

/// Average precision of one class by one metric, overlap limit and difficulty.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Row {
    /// Class name.
    pub class: String,
    /// The metric.
    pub metric: Metric,
    /// IoU threshold.
    pub overlap: f64,
    /// Origin of the overlap limit; several if the sets agree.
    pub overlap_sets: Vec<OverlapSet>,
    /// The difficulty level.
    pub difficulty: Difficulty,
    /// Mean of 11 points of KITTI's curve, percent; `None` where undefined (0/0).
    pub ap11: Option<f64>,
    /// Mean of 40 points of KITTI's curve, percent; `None` where undefined (0/0).
    pub ap40: Option<f64>,
    /// Area under the curve with a point at every distinct score, percent; not capped with few ground truths.
    pub ap_area: Option<f64>,
    /// Number of counted ground truths.
    pub n_gt: i64,
    /// True positives, with all detections.
    pub n_tp: i64,
    /// False positives, with all detections.
    pub n_fp: i64,
    /// False negatives, with all detections. A ground truth matched by an ignored detection is neither a true positive
    /// nor a false negative.
    pub n_fn: i64,
    /// `n_tp / n_gt`, 0 to 1; `None` without ground truth.
    pub recall: Option<f64>,
    /// Upper bound of `ap40` with `n_gt` ground truths: (n - 1) / 40, percent.
    pub ceiling_ap40: Option<f64>,
    /// Why a value is missing or of little significance.
    pub note: Option<String>,
    /// The curve from which `ap11` and `ap40` are computed.
    #[serde(skip)]
    #[schemars(skip)]
    pub curve: PrecisionCurve,
}

/// Result of `evaluate`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EvalReport {
    /// [`SCHEMA`].
    pub schema: String,
    /// Number of frames.
    pub frames: usize,
    /// Coordinate frame of the boxes.
    pub label_frame: LabelFrame,
    /// Ground truth and detections farther away are ignored.
    pub max_range_m: Option<f64>,
    /// Notes to consider before using the rows.
    pub notes: Vec<String>,
    /// By class, metric, overlap and difficulty.
    pub rows: Vec<Row>,
    /// In both definitions.
    pub recall: Vec<Recall>,
}

impl EvalReport {
    /// The row for a class, metric, overlap limit and difficulty.
    pub fn row(&self, class: &str, metric: Metric, overlap: f64, difficulty: Difficulty) -> Option<&Row> {
        self.rows.iter().find(|row| {
            row.class == class && row.metric == metric && row.overlap == overlap && row.difficulty == difficulty
        })
    }

    /// Per class, metric and overlap: the rows for easy, moderate, hard and all.
    fn lines(&self) -> Vec<Vec<&Row>> {
        let mut lines: Vec<Vec<&Row>> = Vec::new();
        for row in &self.rows {
            let same = |line: &&mut Vec<&Row>| {
                (line[0].class.as_str(), line[0].metric, line[0].overlap) == (&row.class, row.metric, row.overlap)
            };
            match lines.iter_mut().find(same) {
                Some(line) => line.push(row),
                None => lines.push(vec![row]),
            }
        }
        lines
    }
}

fn percent(v: Option<f64>) -> String {
    v.map_or("undef.".into(), |v| format!("{v:.2}"))
}

fn four<'a>(line: &[&'a Row], cell: impl Fn(&'a Row) -> String) -> String {
    line.iter().map(|row| format!("{:>7}", cell(row))).collect()
}

/// The plain-text table.
impl fmt::Display for EvalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let frame = match self.label_frame {
            LabelFrame::Camera => "camera",
            LabelFrame::Lidar => "LiDAR",
        };
        write!(f, "{} frames, boxes upright in the {frame} frame", self.frames)?;
        self.max_range_m.map_or(Ok(()), |m| write!(f, ", up to {m} m"))?;
        writeln!(f, "; AP in percent, columns easy, moderate, hard, all")?;
        let mut class = "";
        for line in self.lines() {
            if line[0].class != class {
                class = &line[0].class;
                writeln!(
                    f,
                    "\n{class:<12}|{}",
                    four(&line, |row| row.difficulty.to_string().replace("moderate", "mod."))
                )?;
                writeln!(f, "  n_gt      |{}", four(&line, |row| row.n_gt.to_string()))?;
                writeln!(f, "  AP40 <=   |{}", four(&line, |row| percent(row.ceiling_ap40)))?;
                writeln!(f, "            | {:<28}| {:<28}| {:<28}|  TP / FP (all)", "AP40", "AP11", "exact area")?;
            }
            let all = line[line.len() - 1];
            let (ap40, ap11, area) = (
                four(&line, |row| percent(row.ap40)),
                four(&line, |row| percent(row.ap11)),
                four(&line, |row| percent(row.ap_area)),
            );
            let (metric, overlap) = (line[0].metric, line[0].overlap);
            writeln!(f, "  {metric:<4} {overlap:<4} |{ap40} |{ap11} |{area} |  {} / {}", all.n_tp, all.n_fp)?;
        }
        writeln!(f, "\nrecall, 3d, all difficulties")?;
        for r in &self.recall {
            let name = match (r.definition, &r.class) {
                (RecallDefinition::AnyBox, _) => "covered by any box (OpenPCDet)".into(),
                (RecallDefinition::Matched, class) => format!("{} hit / n_gt", class.as_deref().unwrap_or("")),
            };
            let share = percent(r.recall.map(|v| 100.0 * v));
            writeln!(f, "  {name:<31} > {:<4} {share:>7}  ({} of {})", r.overlap, r.hits, r.n_gt)?;
        }
        writeln!(f)?;
        for note in &self.notes {
            writeln!(f, "Note: {note}.")?;
        }
        for line in self.lines() {
            let mut printed: Vec<&str> = Vec::new();
            for note in line.iter().filter(|row| row.n_gt > 0).filter_map(|row| row.note.as_deref()) {
                if !printed.contains(&note) {
                    printed.push(note);
                    let same = line.iter().filter(|row| row.note.as_deref() == Some(note));
                    let difficulties: Vec<String> = same.map(|row| row.difficulty.to_string()).collect();
                    let (class, metric, overlap) = (&line[0].class, line[0].metric, line[0].overlap);
                    writeln!(f, "Note: {class} {metric} {overlap} ({}): {note}.", difficulties.join(", "))?;
                }
            }
        }
        if self.rows.iter().any(|row| row.n_gt == 0) {
            writeln!(f, "Note: where n_gt is 0 there is nothing to find, and AP is 0 by the reference's definition.")?;
        }
        if self.rows.iter().any(|row| row.ceiling_ap40.is_some_and(|most| most < 100.0)) {
            writeln!(
                f,
                "AP40 <= is what a perfect detector gets. KITTI's curve has at most one point a hit, and AP40 leaves out the\n\
                 first: with n < 41 ground truths it cannot exceed (n - 1) / 40, whatever the precision. The exact area can."
            )?;
        }
        writeln!(
            f,
            "all: every label of the class counts, with KITTI's matching but without its filters on image height, occlusion\n\
             and truncation, without neighbouring classes (Van, Person_sitting) and without DontCare."
        )
    }
}
