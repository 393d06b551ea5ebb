//! Findings of labels and objects: parameters, sentences and plots.

use super::Side;
use super::hypotheses::{Hypothesis, TARGETS_CLOCK};
use super::rows::{ALL, COLUMNS, Column, Row};
use crate::catalogue::{Covariate, Quantity};
use crate::curve::{Curve, CurvePoint};
use crate::inference::linear::LinearFit;
use crate::search::{Found, NamedParameter, Selected, parameter};
use std::ops::Range;

/// What a finding of labels or objects is described by.
pub(super) struct Description<'a> {
    pub(super) hypothesis: &'a Hypothesis,
    /// Fit of all chosen hypotheses on the estimating frames.
    pub(super) fitted: &'a LinearFit,
    /// Standard errors of its coefficients: over blocks of frames, or over vehicles, whichever are larger.
    pub(super) errors: &'a [f64],
    /// Places of the hypothesis' own columns in the fit.
    pub(super) own: Range<usize>,
    /// Slope of the shift over the relative velocity among objects of the same frame, and its standard error, s.
    pub(super) line: [f64; 2],
    pub(super) side: Side,
    pub(super) rows: &'a [Row],
    /// Whether each column is used.
    pub(super) usable: &'a [bool; ALL],
}

impl Description<'_> {
    /// The finding.
    pub(super) fn found(&self, selected: Selected, held_out_gains: Vec<f64>) -> Found {
        let Hypothesis { cause, columns } = *self.hypothesis;
        let parameters = self.parameters();
        let (covariate, x_column) = match columns {
            [3] => (Covariate::SeenVelocity, 3),
            [4] => (Covariate::Velocity, 4),
            TARGETS_CLOCK => (Covariate::Velocity, 3),
            [7] => (Covariate::ScanPhaseVelocity, 7),
            [5, ..] | [6] => (Covariate::SideSeen, columns[0]),
            _ => (Covariate::None, if self.usable[4] { 4 } else { 3 }),
        };
        let axis = match columns {
            [1] | [6] => 1,
            [2] => 2,
            _ => 0,
        };
        let separate_by = (!selected.rivals.is_empty()).then(|| {
            let frames = if self.usable[3] { "" } else { "frames that follow one another, so that speeds are known, and " };
            format!("{frames}targets at very different speeds: a constant offset does not change with speed, a late clock's does")
        });
        Found {
            effects: Vec::new(),
            status: selected.status(),
            confidence: selected.confidence,
            causes: selected.causes(cause),
            says: self.says(&parameters),
            parameters,
            channel: self.side.channel(),
            covariate,
            held_out_gains,
            separate_by,
            curve: curve(self.rows, x_column, axis, self.fitted),
        }
    }

    /// One parameter for each column; the constant of a late clock is none. Labels ahead of the returns equal returns
    /// behind the labels, hence the sign.
    fn parameters(&self) -> Vec<NamedParameter> {
        let Hypothesis { columns, .. } = *self.hypothesis;
        let sign = if self.side == Side::Labels { 1.0 } else { -1.0 };
        let mut parameters = Vec::new();
        for (i, &c) in self.own.clone().zip(columns) {
            let (mut theta, mut error) = (self.fitted.theta[i], self.errors[i]);
            if columns == TARGETS_CLOCK && c == 3 {
                // The ego speed varies between frames, but not among the objects of a frame.
                [theta, error] = self.line;
            }
            let (quantity, estimate, error) = match COLUMNS[c] {
                Column::Ahead => continue,
                Column::Forward => (Quantity::ForwardM, sign * theta, error),
                Column::Left => (Quantity::LeftM, sign * theta, error),
                Column::Up => (Quantity::UpM, sign * theta, error),
                Column::SeenVelocity | Column::Velocity => {
                    (Quantity::OffsetS, -sign * theta, error.hypot(0.02 * theta))
                }
                Column::Longer => (Quantity::LongerM, theta, error),
                Column::Wider => (Quantity::WiderM, theta, error),
                Column::Higher => (Quantity::HigherM, theta, error),
                // By the form of the scan as well.
                Column::Swept => (Quantity::ScanS, -theta, error.hypot(0.1 * theta)),
            };
            parameters.push(parameter(quantity, estimate, error));
        }
        parameters
    }

    /// The finding in a sentence.
    fn says(&self, parameters: &[NamedParameter]) -> String {
        let what = if self.side == Side::Labels {
            "measured labels stand beside the simulated ones, the returns do not"
        } else {
            "measured objects stand beside the simulated ones"
        };
        let clock = match self.hypothesis.columns {
            [3] => "; they move with the velocity that the sensor sees: all positions against the cloud",
            [4] | TARGETS_CLOCK => "; they move with the targets' velocity over the ground: the targets' clock",
            _ => "",
        };
        let list: Vec<String> =
            parameters.iter().map(|(id, p)| format!("{id} {:+.3} {}", p.estimate, p.unit)).collect();
        format!("{what}: {}{clock}", list.join(", "))
    }
}

/// Shift along an axis over a covariate, a column of the fit.
fn curve(rows: &[Row], column: usize, axis: usize, fitted: &LinearFit) -> Curve {
    let mut points: Vec<(f64, f64, f64)> = rows
        .iter()
        .map(|r| {
            let expected = r.expected(axis, &fitted.columns, fitted.theta.iter());
            let x = if column == 4 {
                r.speed.unwrap_or(0.0)
            } else {
                r.x[axis.min(if column == 6 { 1 } else { 0 })][column]
            };
            (x, r.shift[axis], expected)
        })
        .collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let per = (points.len() / 12).max(1);
    let points = points.chunks(per).map(|chunk| {
        let n = chunk.len() as f64;
        let mean = |f: fn(&(f64, f64, f64)) -> f64| chunk.iter().map(f).sum::<f64>() / n;
        let measured = mean(|p| p.1);
        let sd = (chunk.iter().map(|p| (p.1 - measured).powi(2)).sum::<f64>() / n).sqrt();
        CurvePoint { sensor: 0, x: mean(|p| p.0), measured, before: 0.0, after: mean(|p| p.2), error: sd / n.sqrt() }
    });
    let x = match column {
        3 => "velocity that the sensor sees, forward, m/s",
        4 => "velocity over the ground, m/s",
        7 => "velocity times phase of the scan, m/s",
        _ => "side seen (0.5: front or left, -0.5: rear or right)",
    };
    Curve {
        x: x.into(),
        y: format!("shift {}, m", ["forward", "left", "up"][axis]),
        by_sensor: false,
        points: points.collect(),
    }
}
