//! The matrix as LaTeX, in the layout of the paper's table of all results.

use super::{Matrix, paper_cell};
use std::fmt::Write;

impl Matrix {
    /// A `tabular` for `booktabs` and `multirow`: network, train set, test set, then AP and recall at each overlap as
    /// `mean (deviation)`, for the full range. A cell without a run is a dash. Each class has its own table.
    pub fn to_latex(&self) -> String {
        self.options.classes.iter().map(|class| self.latex_of_class(class)).collect::<Vec<_>>().join("\n")
    }

    fn latex_of_class(&self, class: &str) -> String {
        let columns = self.paper_columns();
        let mut out = String::new();
        let _ = write!(out, "\\begin{{tabular}}{{@{{}}{}@{{}}}}\n\\toprule\n", "l".repeat(3 + columns.len()));
        let names = columns.iter().map(|(quantity, overlap)| format!(" & {quantity} ({overlap})"));
        let _ = writeln!(out, "Network & Train dataset & Test dataset{} \\\\ \\midrule", names.collect::<String>());
        let n_tests = self.plan.test_sets.len();
        for (i, planned) in self.plan.networks.iter().enumerate() {
            for (j, train_set) in planned.train_sets.iter().enumerate() {
                for (k, test_set) in self.plan.test_sets.iter().enumerate() {
                    let n_rows = planned.train_sets.len() * n_tests;
                    let network = match (j, k) {
                        (0, 0) => format!("\\multirow{{{n_rows}}}{{*}}{{{}}} ", escaped(&planned.network.title)),
                        _ => String::new(),
                    };
                    let train = match k {
                        0 => format!("\\multirow{{{n_tests}}}{{*}}{{{}}} ", escaped(&train_set.title)),
                        _ => String::new(),
                    };
                    let _ = write!(out, "{network}& {train}& {}", escaped(&test_set.title));
                    let cell = self.cell(&planned.network.name, &train_set.name, &test_set.name);
                    for (quantity, overlap) in &columns {
                        let number = cell.and_then(|cell| cell.number(class, None, *quantity, *overlap));
                        let text = number.map_or("-".into(), |n| paper_cell(n.mean, n.deviation));
                        let _ = write!(out, " & {text}");
                    }
                    let last_test = k + 1 == n_tests;
                    let last_train = j + 1 == planned.train_sets.len();
                    let rule = match (last_test, last_train, i + 1 == self.plan.networks.len()) {
                        (true, true, true) => " \\bottomrule",
                        (true, true, false) => " \\midrule",
                        (true, false, _) => &format!(" \\cmidrule(l){{2-{}}}", 3 + columns.len()),
                        (false, ..) => "",
                    };
                    let _ = writeln!(out, " \\\\{rule}");
                }
            }
        }
        out.push_str("\\end{tabular}\n");
        out
    }
}

fn escaped(text: &str) -> String {
    let mut out = String::new();
    for c in text.chars() {
        match c {
            '\\' => out.push_str("\\textbackslash{}"),
            '~' => out.push_str("\\textasciitilde{}"),
            '^' => out.push_str("\\textasciicircum{}"),
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => out.extend(['\\', c]),
            _ => out.push(c),
        }
    }
    out
}
