//! One figure per finding: measured and simulated values over the covariate, with and without the finding; and the page
//! of a diagnosis.

mod page;
mod view;

pub use page::DiagnosisReport;

use crate::{CurveOptions, Figure, ReportError, Series};
use data::write_atomic;
use diagnose::{Diagnosis, Finding, Status};
use std::path::Path;

/// PNG pixels per SVG pixel.
const SCALE: f32 = 2.0;

/// Writes `finding-N-NAME.svg` and `.png` for every finding of a diagnosis into `out`.
///
/// # Errors
/// A file that cannot be written; the message names it.
pub fn write_finding_pictures(diagnosis: &Diagnosis, out: &Path) -> Result<(), ReportError> {
    for (i, finding) in diagnosis.findings.iter().enumerate().filter(|(_, f)| !f.curve.points.is_empty()) {
        let figure = figure(finding);
        let name = format!("finding-{}-{}", i + 1, finding_name(finding).replace(' ', "-"));
        write_atomic(&out.join(format!("{name}.svg")), figure.svg().as_bytes())?;
        write_atomic(&out.join(format!("{name}.png")), &figure.png(SCALE)?)?;
    }
    Ok(())
}

/// Name of a finding: its cause, its candidates, or "unexplained".
pub fn finding_name(finding: &Finding) -> String {
    match finding.status {
        Status::Named => finding.cause.map_or_else(String::new, |c| c.to_string()),
        Status::Ambiguous | Status::NotIdentifiable => {
            let names = finding.candidates.iter().flatten().map(|c| c.name());
            names.collect::<Vec<_>>().join(" or ")
        }
        Status::Unexplained => "unexplained".into(),
    }
}

fn figure(finding: &Finding) -> Figure {
    let curve = &finding.curve;
    let last = curve.points.iter().map(|p| p.sensor).max().unwrap_or(0);
    let mut series = Vec::new();
    for k in 0..=last {
        let own: Vec<_> = curve.points.iter().filter(|p| p.sensor == k).collect();
        let word = |what: &str| if last > 0 { format!("{what}, sensor {k}") } else { what.to_owned() };
        let mut push = |what: &str, value: &dyn Fn(&diagnose::CurvePoint) -> f64| {
            let points = own.iter().map(|p| [p.x, value(p)]).collect();
            series.push(Series { name: word(what), points });
        };
        push("measured", &|p| p.measured);
        if k == 0 {
            push("simulated", &|p| p.before);
        }
        if own.iter().any(|p| p.after != p.measured) {
            push("simulated with the finding", &|p| p.after);
        }
    }
    let options =
        CurveOptions { title: finding_name(finding), x_label: curve.x.clone(), y_label: curve.y.clone(), log_y: false };
    Figure::curves(&series, &options)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diagnose::{Channel, Covariate, Curve, CurvePoint, Family, FindingGain};

    /// An unexplained loss by row, of two sensors.
    pub(super) fn loss_by_row() -> Finding {
        let point =
            |sensor: usize, x: f64| CurvePoint { sensor, x, measured: 0.8, before: 1.0, after: 0.79, error: 0.01 };
        Finding {
            status: Status::Unexplained,
            cause: None,
            candidates: None,
            family: Family::Unknown,
            parameters: Default::default(),
            confidence: 1.0,
            channel: Channel::Hits,
            covariate: Covariate::Row,
            gain: FindingGain::default(),
            predicted: None,
            reached: None,
            says: String::new(),
            separate_by: None,
            curve: Curve {
                x: "row".into(),
                y: "share".into(),
                by_sensor: true,
                points: vec![point(0, 0.0), point(0, 5.0), point(1, 0.0), point(1, 5.0)],
            },
            effects: vec![],
        }
    }

    #[test]
    fn a_picture_shows_before_and_after_by_sensor() {
        let svg = figure(&loss_by_row()).svg();
        for words in [
            "measured, sensor 0",
            "measured, sensor 1",
            "simulated, sensor 0",
            "simulated with the finding, sensor 1",
            ">row<",
        ] {
            assert!(svg.contains(words), "{words}");
        }
    }
}
