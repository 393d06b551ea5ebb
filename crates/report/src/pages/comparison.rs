//! The page of a comparison of several simulations.

use super::study::{number, slug};
use crate::ReportError;
use crate::figure::{IntervalRow, intervals};
use crate::html::{Item, PageText, Section, TableCell, TableRow, page};
use data::write_atomic;
use eval::comparison::{Comparison, Criterion, CriterionKind, CriterionRow};
use eval::{Interval, csv_text};
use std::path::Path;

/// Content of the page.
#[derive(Clone, Debug)]
pub struct ComparisonReport<'a> {
    /// The comparison.
    pub comparison: &'a Comparison,
    /// The command that made it.
    pub command: String,
    /// Name and value of each setting.
    pub facts: Vec<(String, String)>,
}

impl ComparisonReport<'_> {
    /// Renders the page. It is self-contained and needs no network.
    ///
    /// # Errors
    /// A page that cannot be rendered.
    pub fn html(&self) -> Result<String, ReportError> {
        let c = self.comparison;
        let mut sections = vec![self.order(), self.facts_section()];
        sections.push(gap_section(c));
        sections.push(distance_section(c));
        sections.push(finding_section(c));
        sections.retain(|section| !section.items.is_empty());
        let about = vec![format!(
            "{} compared with {}. Every number is over the same frames for all simulations, and a resample of the bootstrap draws the same \
             frames for all of them.",
            c.simulations.join(", "),
            c.measured
        )];
        let footer = format!("Made by: {}. One file: figures and numbers are inside; nothing is loaded.", self.command);
        let title = format!("lidarshift compare: {}", c.measured);
        page(
            &PageText { title: &title, about: &about, links: &[], warnings: &c.warnings, footer: &footer },
            &mut sections,
        )
    }

    /// Writes `comparison.html` into a folder.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ReportError> {
        Ok(write_atomic(&folder.join("comparison.html"), self.html()?.as_bytes())?)
    }

    /// The ranks by the leading criterion of each kind.
    fn order(&self) -> Section {
        let c = self.comparison;
        let mut rows = Vec::new();
        for criterion in leading(c) {
            rows.extend(rank_rows(criterion));
        }
        let items = match rows.is_empty() {
            true => Vec::new(),
            false => vec![Item::table(
                "order",
                "Simulations by the leading criterion of each kind, the nearest to the measured data first. Below the size its interval. \
                 \"First in\" is the share of resamples of the frames in which the simulation is the nearest. \"Behind the first\" is the \
                 difference to rank 1 over the same frames: the order is not certain where its interval contains 0.",
                (&RANK_COLUMNS, 3),
                rows,
                Some(csv(&c.criteria)),
            )],
        };
        Section { id: "order", title: "The order", text: Vec::new(), items }
    }

    fn facts_section(&self) -> Section {
        let row =
            |(name, value): &(String, String)| TableRow::new(false, [TableCell::new(name), TableCell::new(value)]);
        let rows: Vec<TableRow> = self.facts.iter().map(row).collect();
        let items = vec![Item::table("settings", "What was compared.", (&["what", "value"], 2), rows, None)];
        Section { id: "facts", title: "The comparison", text: Vec::new(), items }
    }
}

/// The first criterion of each kind.
fn leading(c: &Comparison) -> Vec<&Criterion> {
    let kinds = [CriterionKind::DetectorGap, CriterionKind::Distance, CriterionKind::Diagnosis];
    kinds.iter().filter_map(|kind| c.criteria.iter().find(|criterion| criterion.kind == *kind)).collect()
}

const RANK_COLUMNS: [&str; 7] = ["criterion", "rank", "simulation", "size", "first in", "behind the first", "verdict"];

fn between(interval: Option<Interval>, digits: usize) -> String {
    interval.map_or(String::new(), |i| format!("{:.digits$} to {:.digits$}", i.low, i.high))
}

/// Decimals for a criterion: four significant digits of its largest size.
fn digits(criterion: &Criterion) -> usize {
    let largest = criterion.rows.iter().filter_map(|row| row.size).fold(0.0f64, f64::max);
    if largest >= 1000.0 {
        0
    } else if largest >= 10.0 {
        2
    } else {
        4
    }
}

fn verdict(row: &CriterionRow) -> &'static str {
    match (row.rank, row.behind_interval) {
        (None, _) => "undefined",
        (Some(1), _) => "nearest",
        (_, Some(i)) if i.low > 0.0 => "farther",
        (_, Some(_)) => "not distinguishable from the first",
        (_, None) => "no interval",
    }
}

fn by_rank(criterion: &Criterion) -> Vec<&CriterionRow> {
    let mut rows: Vec<&CriterionRow> = criterion.rows.iter().collect();
    rows.sort_by_key(|row| row.rank.unwrap_or(usize::MAX));
    rows
}

fn rank_rows(criterion: &Criterion) -> Vec<TableRow> {
    let digits = digits(criterion);
    let unit = if criterion.unit.is_empty() { String::new() } else { format!(" ({})", criterion.unit) };
    let row = |(i, row): (usize, &CriterionRow)| {
        let name = if i == 0 { format!("{}{unit}", criterion.name) } else { String::new() };
        let floor = criterion.floor.filter(|_| i == 0).map_or(String::new(), |f| format!("floor {f:.digits$}"));
        let cells = [
            TableCell::with_small(name, floor),
            TableCell::new(row.rank.map_or("–".into(), |rank| rank.to_string())),
            TableCell::new(&row.simulation),
            TableCell::with_small(number(row.size, digits), between(row.interval, digits)),
            TableCell::new(row.first_share.map_or("–".into(), |share| format!("{:.0} %", 100.0 * share))),
            TableCell::with_small(number(row.behind_first, digits), between(row.behind_interval, digits)),
            TableCell::new(verdict(row)),
        ];
        TableRow::new(i == 0, cells)
    };
    by_rank(criterion).into_iter().enumerate().map(row).collect()
}

/// The differences of every detector as a figure, and as a table.
fn gap_section(c: &Comparison) -> Section {
    let gaps: Vec<&Criterion> =
        c.criteria.iter().filter(|c| c.kind == CriterionKind::DetectorGap && c.measured.is_some()).collect();
    let mut items = Vec::new();
    if !gaps.is_empty() {
        let mut rows = Vec::new();
        for criterion in &gaps {
            for (s, row) in criterion.rows.iter().enumerate() {
                rows.push(IntervalRow {
                    name: if s == 0 { criterion.name.clone() } else { String::new() },
                    value: row.difference,
                    interval: row.difference_interval.map(|i| [i.low, i.high]),
                    text: row.difference.map_or("–".into(), |v| format!("{v:+.1}")),
                    series: s,
                });
            }
        }
        let names: Vec<&str> = c.simulations.iter().map(String::as_str).collect();
        let caption = "Value of each detector on the measured frames minus that on the simulated frames, with its interval. Right of zero \
                       the detector is better on measured frames. A simulation is good where its difference is near zero.";
        items.push(Item::figure("gaps", caption, intervals(&rows, &names, "difference (points)"), (&[], &[])));
        let mut rows = Vec::new();
        for criterion in &gaps {
            for (i, row) in by_rank(criterion).into_iter().enumerate() {
                let name = if i == 0 { criterion.name.clone() } else { String::new() };
                let signed = row.difference.map_or("–".into(), |v| format!("{v:+.2}"));
                let cells = [
                    TableCell::new(name),
                    TableCell::new(&row.simulation),
                    TableCell::new(number(criterion.measured, 2)),
                    TableCell::new(number(row.value, 2)),
                    TableCell::with_small(signed, between(row.difference_interval, 2)),
                    TableCell::with_small(number(row.behind_first, 2), between(row.behind_interval, 2)),
                    TableCell::new(verdict(row)),
                ];
                rows.push(TableRow::new(i == 0, cells));
            }
        }
        let columns =
            ["detector and value", "simulation", "measured", "simulated", "difference", "behind the first", "verdict"];
        let caption = "The same numbers, in percent and points of percent, the nearest simulation first.";
        items.push(Item::table("gap-table", caption, (&columns, 2), rows, None));
    }
    Section { id: "gap", title: "Detector gap", text: Vec::new(), items }
}

fn distance_section(c: &Comparison) -> Section {
    let distances: Vec<&Criterion> = c.criteria.iter().filter(|c| c.kind == CriterionKind::Distance).collect();
    let rows: Vec<TableRow> = distances.iter().flat_map(|criterion| rank_rows(criterion)).collect();
    let items = match distances.first() {
        None => Vec::new(),
        Some(first) => {
            let caption = format!(
                "Distances between measured and simulated clouds, mean over up to {} frames. The floor is what two halves of the measured \
                 clouds give; smaller distances are not significant.",
                first.frames
            );
            vec![Item::table("distances", caption, (&RANK_COLUMNS, 3), rows, None)]
        }
    };
    Section { id: "distance", title: "Distances between the clouds", text: Vec::new(), items }
}

fn finding_section(c: &Comparison) -> Section {
    let mut rows = Vec::new();
    for of in &c.findings {
        let none = vec!["–".to_string()];
        let findings = if of.findings.is_empty() { &none } else { &of.findings };
        for (i, finding) in findings.iter().enumerate() {
            let head = if i == 0 { [of.simulation.as_str(), &of.verdict] } else { ["", ""] };
            rows.push(TableRow::new(i == 0, head.into_iter().chain([finding.as_str()]).map(TableCell::new)));
        }
    }
    let caption = "What the diagnosis finds in each simulation, compared with the measured data.";
    let items = match rows.is_empty() {
        true => Vec::new(),
        false => vec![Item::table("findings", caption, (&["simulation", "verdict", "finding"], 3), rows, None)],
    };
    Section { id: "diagnosis", title: "Findings", text: Vec::new(), items }
}

const CSV_COLUMNS: [&str; 16] = [
    "kind",
    "criterion",
    "unit",
    "frames",
    "simulation",
    "rank",
    "measured",
    "simulated",
    "difference",
    "difference_low",
    "difference_high",
    "size",
    "size_low",
    "size_high",
    "first_share",
    "behind_first",
];

/// Every criterion and simulation.
fn csv(criteria: &[Criterion]) -> String {
    let text = |v: Option<f64>| v.map_or(String::new(), |v| v.to_string());
    let (low, high) = (|i: Option<Interval>| text(i.map(|i| i.low)), |i: Option<Interval>| text(i.map(|i| i.high)));
    let lines: Vec<Vec<String>> = criteria
        .iter()
        .flat_map(|c| c.rows.iter().map(move |row| (c, row)))
        .map(|(c, row)| {
            vec![
                slug(&c.kind.to_string()),
                c.name.clone(),
                c.unit.clone(),
                c.frames.to_string(),
                row.simulation.clone(),
                row.rank.map_or(String::new(), |rank| rank.to_string()),
                text(c.measured),
                text(row.value),
                text(row.difference),
                low(row.difference_interval),
                high(row.difference_interval),
                text(row.size),
                low(row.interval),
                high(row.interval),
                text(row.first_share),
                text(row.behind_first),
            ]
        })
        .collect();
    csv_text(&CSV_COLUMNS, &lines)
}

#[cfg(test)]
mod tests {
    use super::*;
    use eval::comparison::SimulationFindings;

    #[test]
    fn the_page_shows_ranks_and_findings() {
        let simulations = vec!["sim <a>".to_string(), "sim-b".to_string()];
        let numbers = |name: &str, kind, values: [f64; 2]| {
            Criterion::of_numbers(kind, name, "", 12, &simulations, &values.map(Some))
        };
        let criteria = vec![
            numbers("Chamfer, whole cloud", CriterionKind::Distance, [0.5, 0.25]),
            numbers("difference of returns", CriterionKind::Diagnosis, [0.01, 0.02]),
        ];
        let mut comparison = Comparison::new("real", simulations.clone(), criteria);
        comparison.findings.push(SimulationFindings {
            simulation: "sim-b".into(),
            verdict: "explained".into(),
            findings: vec!["range noise: 0.02 m".into()],
        });
        let facts = vec![("measured".into(), "real".into())];
        let html = ComparisonReport { comparison: &comparison, command: "a test".into(), facts }.html().unwrap();
        for part in ["sim &#60;a&#62;", "Chamfer, whole cloud", "range noise: 0.02 m", "The order", "nearest"] {
            assert!(html.contains(part), "no {part:?}");
        }
        assert!(!html.contains("id=\"gap\""), "there is no section without a detector");
    }
}
