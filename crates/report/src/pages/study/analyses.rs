//! Section with the analyses of single runs.

use super::{csv_number, number, slug};
use crate::figure::{Bar, Figure, bars};
use crate::html::{Item, Section, TableCell, TableRow};
use crate::{CurveOptions, Series};
use eval::analysis::{Component, RunAnalysis, Stratum};

type Named = (String, RunAnalysis);

/// Box errors, calibration, AP by strata, and oracle repairs of the runs, side by side.
pub(super) fn section(analyses: &[Named]) -> Section {
    let mut items = Vec::new();
    if !analyses.is_empty() {
        items.push(errors(analyses));
        items.extend(analyses.iter().enumerate().map(|(k, named)| repairs(k, named)));
        let middle = |s: &Stratum| (s.from + s.to) / 2.0;
        let overlap = analyses[0].1.options.overlap;
        let at = format!("3D AP ({overlap})");
        items.extend([
            strata("ap-distance", "distance on the ground (m)", format!("{at} against the distance of the target."), analyses, |a| &a.by_distance, middle),
            strata(
                "ap-heading",
                "heading against the ray from the sensor (degrees)",
                format!("{at} against the heading of the target: 0 degrees is seen from its front or its back, 90 from its side."),
                analyses,
                |a| &a.by_heading,
                middle,
            ),
            strata(
                "ap-overlap",
                "overlap that is asked for",
                "3D AP against the overlap that a hit has to exceed.".into(),
                analyses,
                |a| &a.by_overlap,
                |s| s.from,
            ),
        ]);
        if analyses.iter().any(|(_, a)| !a.by_points.is_empty()) {
            items.push(by_points(analyses));
        }
        items.push(calibration(analyses));
    }
    let text = vec![
        "Errors are those of detections that are paired with a ground truth by the distance of their centres, so that no limit on the \
         overlap cuts them off; everything else uses the matching of the average precision."
            .into(),
    ];
    Section { id: "boxes", title: "What is behind the average precision", text, items }
}

fn errors(analyses: &[Named]) -> Item {
    let mut rows = Vec::new();
    for (name, a) in analyses {
        for (i, of) in a.errors.sections.iter().enumerate() {
            let place = of.section.map_or("all".into(), |s| s.to_string());
            let turned = if of.n > 0 { format!("{:.1} %", 100.0 * of.turned) } else { "–".into() };
            let head = [name.clone(), place, of.n.to_string(), turned].map(TableCell::new);
            let components = of.components.iter().map(|c| {
                let small = format!("median {:.2}, nine in ten {:.2}", c.median_abs, c.p90_abs);
                TableCell::with_small(format!("{:+.2} ± {:.2}", c.mean, c.deviation), small)
            });
            let mut cells: Vec<TableCell> = head.into_iter().chain(components).collect();
            cells.resize_with(11, || TableCell::new("–"));
            rows.push(TableRow::new(i == 0, cells));
        }
    }
    let columns = [
        "run",
        "distance",
        "pairs",
        "turned round",
        "along (m)",
        "across (m)",
        "up (m)",
        "yaw (°)",
        "length (m)",
        "width (m)",
        "height (m)",
    ];
    let caption = "Errors of the boxes, found less true, in the frame of the true box (forward, left, up): mean ± standard deviation (divisor n), \
                   and below the sizes of the error that half and nine in ten of the boxes stay within. Yaw is taken modulo a half turn; \
                   \"turned round\" is the share that faces the other way.";
    Item::table("box-errors", caption, (&columns, 2), rows, None)
}

fn repairs(k: usize, (name, a): &Named) -> Item {
    let component_name = |component| match component {
        Component::None => "as it is",
        Component::Along => "centre along the heading",
        Component::Across => "centre across the heading",
        Component::Up => "height of the centre",
        Component::Yaw => "yaw",
        Component::Size => "size",
        Component::Center => "whole centre",
        Component::All => "all of it",
    };
    let bar = |repair: &eval::analysis::Repair| {
        let gained = repair.gained.filter(|_| repair.component != Component::None);
        let gained = gained.map_or(String::new(), |g| format!("  ({g:+.1})"));
        Bar {
            name: component_name(repair.component).into(),
            value: repair.then.ap40,
            text: format!("{}{gained}", number(repair.then.ap40, 1)),
            series: usize::from(repair.component != Component::None),
        }
    };
    let caption = format!(
        "{name}: 3D AP ({}) when one component of every detection is set to that of its ground truth. What \"all of it\" leaves to 100 is \
         missed ground truth and false alarms.",
        a.options.overlap
    );
    let lines: Vec<Vec<String>> = a
        .oracle
        .iter()
        .map(|r| {
            vec![
                component_name(r.component).into(),
                csv_number(r.then.ap40),
                csv_number(r.then.ap_area),
                csv_number(r.gained),
            ]
        })
        .collect();
    let figure = bars(&a.oracle.iter().map(bar).collect::<Vec<_>>(), "3D AP (%)");
    Item::figure(
        format!("repairs-{}-{}", k + 1, slug(name)),
        caption,
        figure,
        (&["component", "ap40", "ap_area", "gained"], &lines),
    )
}

fn strata(
    id: &str,
    x_label: &str,
    caption: String,
    analyses: &[Named],
    of: impl Fn(&RunAnalysis) -> &Vec<Stratum>,
    x: impl Fn(&Stratum) -> f64,
) -> Item {
    let series: Vec<Series> = analyses
        .iter()
        .map(|(name, a)| Series {
            name: name.clone(),
            points: of(a).iter().map(|s| [x(s), s.ap40.unwrap_or(f64::NAN)]).collect(),
        })
        .collect();
    let options = CurveOptions { x_label: x_label.into(), y_label: "3D AP (%)".into(), ..CurveOptions::default() };
    let caption =
        format!("{caption} A gap stands where there is no ground truth; the numbers of ground truths are in the CSV.");
    Item::figure(id, caption, Figure::curves(&series, &options), (&STRATUM_COLUMNS, &lines(analyses, of)))
}

const STRATUM_COLUMNS: [&str; 8] = ["run", "from", "to", "n_gt", "ap40", "ceiling_ap40", "ap_area", "recall"];

fn lines(analyses: &[Named], of: impl Fn(&RunAnalysis) -> &Vec<Stratum>) -> Vec<Vec<String>> {
    let line = |name: &String, s: &Stratum| {
        let numbers = [s.ap40, s.ceiling_ap40, s.ap_area, s.recall].map(csv_number);
        [name.clone(), s.from.to_string(), s.to.to_string(), s.n_gt.to_string()].into_iter().chain(numbers).collect()
    };
    analyses.iter().flat_map(|(name, a)| of(a).iter().map(|s| line(name, s)).collect::<Vec<_>>()).collect()
}

fn by_points(analyses: &[Named]) -> Item {
    let mut rows = Vec::new();
    for (name, a) in analyses {
        for (i, s) in a.by_points.iter().enumerate() {
            let points =
                if s.to.is_finite() { format!("{} to {}", s.from, s.to - 1.0) } else { format!("{} or more", s.from) };
            let numbers = [number(s.ap40, 1), number(s.ceiling_ap40, 1), number(s.ap_area, 1), number(s.recall, 1)];
            let cells = [name.clone(), points, s.n_gt.to_string()].into_iter().chain(numbers).map(TableCell::new);
            rows.push(TableRow::new(i == 0, cells));
        }
    }
    let columns = ["run", "points in the box", "ground truths", "3D AP", "AP40 at most", "exact area", "recall"];
    let caption = "3D AP (percent) against the number of points in the box.";
    Item::table("ap-points", caption, (&columns, 2), rows, None)
}

fn calibration(analyses: &[Named]) -> Item {
    let mut series: Vec<Series> = analyses
        .iter()
        .map(|(name, a)| {
            let error = number(a.calibration.expected_error, 3);
            let points = a.calibration.bins.iter();
            let points = points.map(|b| [b.mean_score.unwrap_or(f64::NAN), b.precision.unwrap_or(f64::NAN)]);
            Series { name: format!("{name}, error {error}"), points: points.filter(|p| !p[0].is_nan()).collect() }
        })
        .collect();
    series.push(Series { name: "a score that is a probability".into(), points: vec![[0.0, 0.0], [1.0, 1.0]] });
    let options =
        CurveOptions { x_label: "mean score".into(), y_label: "share of hits".into(), ..CurveOptions::default() };
    let lines: Vec<Vec<String>> = analyses
        .iter()
        .flat_map(|(name, a)| {
            a.calibration.bins.iter().map(move |b| {
                let numbers = [csv_number(b.mean_score), csv_number(b.precision)];
                [name.clone(), b.from.to_string(), b.to.to_string(), b.n.to_string()]
                    .into_iter()
                    .chain(numbers)
                    .collect()
            })
        })
        .collect();
    let caption = format!(
        "What scores mean: the share of detections that exceed the overlap {} with a ground truth, against their score, in ten steps. The \
         error is the expected calibration error.",
        analyses[0].1.options.overlap
    );
    let columns = ["run", "from", "to", "detections", "mean_score", "precision"];
    Item::figure("calibration", caption, Figure::curves(&series, &options), (&columns, &lines))
}
