//! Tables of a summary as Markdown.

use crate::summary::Summary;
use crate::swarm::{SwarmRow, SwarmTable};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// Grades by kind and level, confusion, parameters and sets of several effects.
pub fn markdown(summary: &Summary) -> String {
    let tables = [grades(summary), confusion(summary), parameters(summary), swarm(&summary.swarm)];
    tables.into_iter().filter(|t| !t.is_empty()).collect::<Vec<_>>().join("\n")
}

fn head(columns: &[&str]) -> String {
    format!("| {} |\n|{}\n", columns.join(" | "), "---|".repeat(columns.len()))
}

fn grades(summary: &Summary) -> String {
    let used: BTreeSet<&str> = summary.grades.values().flat_map(|g| g.keys()).map(String::as_str).collect();
    let mut columns = vec!["kind", "level", "cases"];
    columns.extend(&used);
    let mut text = head(&columns);
    for (kind, levels) in &summary.levels {
        for (level, grades) in levels {
            let cases: usize = grades.values().sum();
            let _ = write!(text, "| {kind} | {level} | {cases} |");
            for grade in &used {
                let _ = write!(text, " {} |", grades.get(*grade).map_or(String::new(), usize::to_string));
            }
            text.push('\n');
        }
    }
    text
}

fn confusion(summary: &Summary) -> String {
    if summary.confusion.is_empty() {
        return String::new();
    }
    let mut text = head(&["hidden", "reported (number of findings)"]);
    let list = |reported: &BTreeMap<String, usize>| {
        reported.iter().map(|(name, n)| format!("{name} {n}")).collect::<Vec<_>>().join(", ").replace('|', " or ")
    };
    for (hidden, reported) in &summary.confusion {
        let _ = writeln!(text, "| `{hidden}` | {} |", list(reported));
    }
    text
}

fn parameters(summary: &Summary) -> String {
    if summary.parameters.is_empty() {
        return String::new();
    }
    let mut text =
        head(&["parameter", "cases", "inside `ci95`", "median error", "error over bound (RMS)", "within the target"]);
    for (name, [n, inside, relative, rms, close]) in &summary.parameters {
        let known = |v: f64, unit: &str| if v.is_finite() { format!("{v:.1}{unit}") } else { String::new() };
        let _ = writeln!(
            text,
            "| `{name}` | {n:.0} | {} | {} | {} | {} |",
            of(inside * n, *n),
            known(100.0 * relative, " %"),
            known(*rms, ""),
            of(close * n, *n)
        );
    }
    let n: f64 = summary.parameters.values().map(|p| p[0]).sum();
    let inside: f64 = summary.parameters.values().map(|p| p[0] * p[1]).sum();
    let close: f64 = summary.parameters.values().map(|p| p[0] * p[4]).sum();
    let _ = writeln!(text, "| all | {n:.0} | {} | | | {} |", of(inside, n), of(close, n));
    text
}

fn of(some: f64, all: f64) -> String {
    format!("{:.0} of {all:.0}", some)
}

fn swarm(table: &SwarmTable) -> String {
    if table.rows.is_empty() {
        return String::new();
    }
    let mut text = head(&[
        "effects",
        "cases",
        "refused",
        "identifiable: named",
        "ambiguous",
        "weak: named",
        "names",
        "false names",
        "outside of the catalogue",
        "named",
        "unexplained",
        "inside `ci95`",
        "error over bound (RMS)",
        "closed as stated",
        "seconds",
    ]);
    for r in &table.rows {
        let _ = writeln!(text, "{}", swarm_row(r));
    }
    text
}

fn swarm_row(r: &SwarmRow) -> String {
    let some = |v: Option<f64>, digits: usize| v.map_or(String::new(), |v| format!("{v:.digits$}"));
    let percent = |part: usize, all: usize| match all {
        0 => "0 of 0".to_owned(),
        all => format!("{part} of {all} ({:.0} %)", 100.0 * part as f64 / all as f64),
    };
    let identifiable = r.nameable[1] + r.nameable[2];
    format!(
        "| {} to {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        r.effects[0],
        r.effects[1],
        r.cases,
        r.refused,
        percent(r.named[1] + r.named[2], identifiable),
        r.ambiguous[1] + r.ambiguous[2],
        percent(r.named[0], r.nameable[0]),
        r.names,
        percent(r.false_names, r.names),
        r.off_catalogue,
        r.off_named,
        r.off_unexplained,
        percent(r.inside, r.parameters),
        some(r.error_over_bound, 1),
        some(r.closed, 2),
        some(r.seconds, 1),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::Outcome;
    use crate::summary::summarise;
    use crate::truth::{Hidden, Truth};

    #[test]
    fn every_table_has_its_rows() {
        let outcome = |hidden: usize| {
            let one = Hidden { cause: "range_noise".into(), in_catalogue: true, ..Hidden::default() };
            let hidden = vec![one.with_strength(50.0); hidden];
            Outcome {
                truth: Truth { seed: 1, kind: "single".into(), setting: String::new(), hidden },
                verdict: "explained".into(),
                named: vec!["range_noise".into()],
                ambiguous: vec![],
                unexplained: 0,
                parameters: vec![],
                closed: None,
                seconds: 1.0,
            }
        };
        let text = markdown(&summarise(&[outcome(1), outcome(2)]));
        assert!(text.contains("| single | strong | 2 | 2 |"), "{text}");
        assert!(text.contains("| `range_noise` | range_noise 1 |"), "{text}");
        assert!(text.contains("| 2 to 3 | 1 | 0 | 2 of 2 (100 %) | 0 |"), "{text}");
    }
}
