//! The matrix as Markdown, with intervals and the paper's numbers.

use super::{Cell, CellNumber, Matrix, Part, Quantity, Reference, RunState, paper_cell, paper_number};
use crate::RangeSection;
use std::fmt::{self, Write};

impl Matrix {
    /// Tables of all values over the full range, of AP by range section, and of the domain gap; then the warnings.
    pub fn to_markdown(&self) -> String {
        let mut out = String::new();
        for class in &self.options.classes {
            self.table_of_class(&mut out, class);
            if !self.options.sections.is_empty() {
                self.table_of_sections(&mut out, class);
            }
            self.table_of_gaps(&mut out, class);
            self.table_of_splits(&mut out, class);
        }
        let _ = writeln!(out, "{}", self.rules());
        if !self.warnings.is_empty() {
            out.push_str("\nWarnings:\n\n");
        }
        for warning in &self.warnings {
            let _ = writeln!(out, "- {warning}");
        }
        out
    }

    /// Describes how the values in the tables are computed.
    pub fn rules(&self) -> String {
        let o = &self.options;
        let range =
            o.max_range_m.map_or("at any range".into(), |m| format!("up to {m} m from the sensor on the ground"));
        let interval = match o.bootstrap.replicates {
            0 => "No intervals were drawn".into(),
            n => format!(
                "In square brackets the {:.0} % interval of the mean, {n} draws of seeds (n - 1 of n) and frames together (of \
                 frames alone where there is one run), frames in blocks of {}, seed {}",
                100.0 * o.bootstrap.level,
                o.bootstrap.block_frames,
                o.bootstrap.seed
            ),
        };
        format!(
            "Values are the mean over the runs in percent, in round brackets their standard deviation with divisor n. {interval}. \
             3D AP is KITTI's over 40 recalls, difficulty {}, {range}. Recall is OpenPCDet's: ground truths whose highest overlap with \
             any box is over the limit; of two-stage networks all refined regions count, before the score limit and the last \
             suppression, and the recall of the final boxes stands beside it. Ground truth outside a range is ignored, and so is a detection outside it that finds nothing; \
             one that finds an ignored ground truth is no false alarm.",
            o.difficulty
        )
    }

    fn table_of_class(&self, out: &mut String, class: &str) {
        let columns = self.columns();
        let paper = self.cells.iter().flat_map(|cell| &cell.numbers).any(|n| n.published.is_some());
        let _ = write!(out, "| {class} | trained on | tested on | runs |");
        for (quantity, overlap) in &columns {
            let _ = write!(out, " {quantity} ({overlap}) |");
            if paper {
                let _ = write!(out, " paper |");
            }
        }
        let n = columns.len() * if paper { 2 } else { 1 };
        let _ = writeln!(out, "\n|---|---|---|---|{}", "---|".repeat(n));
        for (cell, reference) in self.rows() {
            let _ = write!(out, "{}", self.head(cell, reference));
            for (quantity, overlap) in &columns {
                let number = cell.number_of(reference, class, None, *quantity, *overlap);
                let _ = write!(out, " {} |", number.map_or("-".into(), with_interval));
                if paper {
                    let published = number.and_then(|n| n.published);
                    let text = published.map_or(String::new(), |p| paper_cell(Some(p.mean), Some(p.deviation)));
                    let _ = write!(out, " {text} |");
                }
            }
            out.push('\n');
        }
        out.push('\n');
    }

    fn table_of_sections(&self, out: &mut String, class: &str) {
        let sections: Vec<RangeSection> = self.options.sections.clone();
        let _ = write!(out, "| {class}, 3D AP by distance | trained on | tested on | runs |");
        for (overlap, section) in self.options.overlaps.iter().flat_map(|o| sections.iter().map(move |s| (o, s))) {
            let _ = write!(out, " ({overlap}) {section} |");
        }
        let _ = writeln!(out, "\n|---|---|---|---|{}", "---|".repeat(sections.len() * self.options.overlaps.len()));
        for (cell, reference) in self.rows() {
            let _ = write!(out, "{}", self.head(cell, reference));
            for (overlap, section) in self.options.overlaps.iter().flat_map(|o| sections.iter().map(move |s| (o, s))) {
                let number = cell.number_of(reference, class, Some(*section), Quantity::Ap40, *overlap);
                let n_gt = number.and_then(|n| n.n_gt).map_or("unknown".into(), |n| n.to_string());
                let text = number.map_or("-".into(), |n| match n.ceiling {
                    Some(most) if most < 100.0 => format!("{}, n_gt {n_gt}, at most {most:.1}", with_interval(n)),
                    _ => format!("{}, n_gt {n_gt}", with_interval(n)),
                });
                let _ = write!(out, " {text} |");
            }
            out.push('\n');
        }
        out.push('\n');
    }

    fn table_of_gaps(&self, out: &mut String, class: &str) {
        let gaps: Vec<_> = self
            .gaps
            .iter()
            .filter(|g| g.class == class && g.section.is_none() && g.quantity == Quantity::Ap40)
            .filter(|g| g.compared_to == g.test_set)
            .collect();
        if gaps.is_empty() {
            return;
        }
        let _ = writeln!(out, "| {class}, lost 3D AP | tested on | trained on | overlap | points of percent |");
        let _ = writeln!(out, "|---|---|---|---|---|");
        for gap in gaps {
            let interval =
                gap.interval.map_or(String::new(), |i| format!(" [{}, {}]", paper_number(i.low), paper_number(i.high)));
            let _ = writeln!(
                out,
                "| {} | {} | {} in the place of {} | {} | {}{interval} |",
                self.title(&gap.network),
                self.test_title(&gap.test_set, gap.reference),
                self.title(&gap.train_set),
                self.title(&gap.test_set),
                gap.overlap,
                paper_number(gap.gap)
            );
        }
        out.push('\n');
    }

    fn table_of_splits(&self, out: &mut String, class: &str) {
        let mut splits = self.splits.iter().filter(|s| s.is_shown(class)).peekable();
        if splits.peek().is_none() {
            return;
        }
        let _ = writeln!(
            out,
            "| {class}, lost from its own data to other data | trained on | tested on | overlap | all | labels | sensor and scene | \
             sensor | scene |"
        );
        let _ = writeln!(out, "|---|---|---|---|---|---|---|---|---|");
        let text = |part: Option<Part>| {
            part.map_or("-".into(), |p| {
                let interval = p.interval.map(|i| format!(" [{}, {}]", paper_number(i.low), paper_number(i.high)));
                format!("{}{}", paper_number(p.points), interval.unwrap_or_default())
            })
        };
        for s in splits {
            let [network, train, test] = [&s.network, &s.train_set, &s.test_set].map(|name| self.title(name));
            let parts = [Some(s.total), s.label, Some(s.sensor_and_scene), s.sensor, s.scene].map(text);
            let _ = writeln!(out, "| {network} | {train} | {test} | {} | {} |", s.overlap, parts.join(" | "));
        }
        out.push('\n');
    }

    /// Rows of a table: every cell, and below it the same against the true boxes where they are known.
    pub fn rows(&self) -> impl Iterator<Item = (&Cell, Reference)> {
        self.cells.iter().flat_map(|cell| cell.references().map(move |reference| (cell, reference)))
    }

    fn head(&self, cell: &Cell, reference: Reference) -> String {
        let [network, train] = [&cell.network, &cell.train_set].map(|name| self.title(name));
        let test = self.test_title(&cell.test_set, reference);
        format!("| {network} | {train} | {test} | {} |", runs(cell))
    }
}

/// Number of available runs, and the state of the others.
pub(super) fn runs(cell: &Cell) -> String {
    let failed = cell.runs.iter().filter(|run| matches!(run.state, RunState::Failed(_))).count();
    let missing = cell.runs.iter().filter(|run| run.state == RunState::Missing).count();
    let mut text = format!("{} of {}", cell.n_done(), cell.runs.len());
    if failed > 0 {
        let _ = write!(text, ", {failed} failed");
    }
    if missing > 0 {
        let _ = write!(text, ", {missing} missing");
    }
    text
}

fn with_interval(n: &CellNumber) -> String {
    let text = paper_cell(n.mean, n.deviation);
    match (n.mean, n.interval) {
        (Some(_), Some(i)) => format!("{text} [{}, {}]", paper_number(i.low), paper_number(i.high)),
        _ => text,
    }
}

/// The tables in plain text.
impl fmt::Display for Matrix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.to_markdown())
    }
}
