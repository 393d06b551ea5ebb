//! Sections with the matrix and AP by distance.

use super::{csv_number, number, slug};
use crate::figure::{DotGroup, DotPanel, dots};
use crate::html::{Item, Section, TableCell, TableRow};
use eval::RangeSection;
use eval::matrix::{CellNumber, Matrix, Part, Quantity, Reference, RunState};

/// Mean and deviation in the paper's format, with the interval below.
fn cell(n: Option<&CellNumber>) -> TableCell {
    let Some(n) = n.filter(|n| n.mean.is_some()) else { return TableCell::new("–") };
    let text = match n.deviation {
        Some(deviation) => format!("{} ({})", number(n.mean, 2), number(Some(deviation), 2)),
        None => number(n.mean, 2),
    };
    TableCell::with_small(text, n.interval.map_or(String::new(), |i| format!("{:.1} to {:.1}", i.low, i.high)))
}

/// The paper's table, and the domain gap of each train set.
pub(super) fn matrix_section(m: &Matrix) -> Section {
    let mut items = Vec::new();
    for class in &m.options.classes {
        let paper = m.cells.iter().flat_map(|cell| &cell.numbers).any(|n| n.published.is_some());
        let quantities = m.columns();
        let mut columns: Vec<String> = ["network", "trained on", "tested on", "runs"].map(String::from).into();
        for (quantity, overlap) in &quantities {
            columns.push(format!("{quantity} ({overlap})"));
            if paper {
                columns.push("the paper".into());
            }
        }
        let (mut rows, mut last) = (Vec::new(), None);
        for (of, reference) in m.rows() {
            let begins = last.replace((&of.network, &of.train_set)) != Some((&of.network, &of.train_set));
            let test = m.test_title(&of.test_set, reference);
            let names = [m.title(&of.network), m.title(&of.train_set), &test].map(TableCell::new);
            let failed = of.runs.iter().filter(|run| matches!(run.state, RunState::Failed(_))).count();
            let missing = of.runs.iter().filter(|run| run.state == RunState::Missing).count();
            let absent = [(failed, "failed"), (missing, "missing")];
            let absent = absent.iter().filter(|(n, _)| *n > 0).map(|(n, state)| format!("{n} {state}"));
            let runs = format!("{} of {}", of.n_done(), of.runs.len());
            let mut cells: Vec<TableCell> = names.into();
            cells.push(TableCell::with_small(runs, absent.collect::<Vec<_>>().join(", ")));
            for (quantity, overlap) in &quantities {
                let found = of.number_of(reference, class, None, *quantity, *overlap);
                cells.push(cell(found));
                if paper {
                    let published = found.and_then(|n| n.published);
                    let text = published.map(|p| format!("{:.2} ({:.2})", p.mean, p.deviation));
                    cells.push(TableCell::new(text.unwrap_or_default()));
                }
            }
            rows.push(TableRow::new(begins, cells));
        }
        let names: Vec<&str> = columns.iter().map(String::as_str).collect();
        let caption = format!(
            "Average precision and recall of {class}, every network trained and tested on every data set. {} The CSV holds every number of \
             every run, by section of distance, too.",
            m.rules().replace("In square brackets", "Below,")
        );
        items.push(Item::table(format!("matrix-{}", slug(class)), caption, (&names, 4), rows, Some(m.to_csv())));
        items.extend(gaps(m, class));
        items.extend(splits(m, class));
    }
    Section { id: "matrix", title: "Trained here, tested there", text: Vec::new(), items }
}

fn gaps(m: &Matrix, class: &str) -> Option<Item> {
    let own = m.gaps.iter().filter(|g| g.compared_to == g.test_set);
    let of_class = own.filter(|g| g.class == class && g.section.is_none() && g.quantity == Quantity::Ap40);
    let (mut rows, mut last) = (Vec::new(), None);
    for g in of_class {
        let begins = last.replace((&g.network, &g.test_set)) != Some((&g.network, &g.test_set));
        let test = m.test_title(&g.test_set, g.reference);
        let names = [m.title(&g.network), &test, m.title(&g.train_set)].map(TableCell::new);
        let significant = match g.interval {
            Some(i) if i.low > 0.0 => "loses",
            Some(i) if i.high < 0.0 => "gains",
            Some(_) => "not distinguishable from 0",
            None => "no interval",
        };
        let interval = g.interval.map_or(String::new(), |i| format!("{:.2} to {:.2}", i.low, i.high));
        let could_see = m.power.iter().find(|p| {
            (&p.network, &p.test_set, &p.train_set, &p.compared_to)
                == (&g.network, &g.test_set, &g.train_set, &g.compared_to)
                && (&p.class, p.overlap) == (&g.class, g.overlap)
        });
        let could_see = number(could_see.filter(|_| g.reference == Reference::Labels).map(|p| p.detectable), 1);
        let numbers = [g.overlap.to_string(), number(Some(g.gap), 2), interval, significant.into(), could_see];
        let numbers = numbers.map(TableCell::new);
        rows.push(TableRow::new(begins, names.into_iter().chain(numbers)));
    }
    let columns = ["network", "tested on", "trained on", "overlap", "3D AP lost", "interval", "verdict", "could see"];
    let caption = format!(
        "The domain shift of {class}: 3D AP of the network that was trained on the test set's own data, less that of the one that was \
         trained on other data, in percentage points. The interval is of the difference: the same frames and seeds are drawn for both. Could see: the difference that this number of \
         seeds and frames sees in 80 of 100 repetitions."
    );
    (!rows.is_empty()).then(|| Item::table(format!("gaps-{}", slug(class)), caption, (&columns, 3), rows, None))
}

/// A part of a gap with its interval below.
pub(super) fn part_cell(part: Option<Part>) -> TableCell {
    match part {
        Some(p) => {
            let interval = p.interval.map_or(String::new(), |i| format!("{:.1} to {:.1}", i.low, i.high));
            TableCell::with_small(format!("{:.1}", p.points), interval)
        }
        None => TableCell::new("–"),
    }
}

/// What labels, sensor and scene take of the gap between a network's own data and other data.
fn splits(m: &Matrix, class: &str) -> Option<Item> {
    let of_class = m.splits.iter().filter(|s| s.is_shown(class));
    let (mut rows, mut last) = (Vec::new(), None);
    for s in of_class {
        let begins = last.replace((&s.network, &s.train_set)) != Some((&s.network, &s.train_set));
        let names = [&s.network, &s.train_set, &s.test_set].map(|name| TableCell::new(m.title(name)));
        let parts = [Some(s.total), s.label, Some(s.sensor_and_scene), s.sensor, s.scene].map(part_cell);
        let frames = if s.same_frames { "the same" } else { "others" };
        let cells = names.into_iter().chain([TableCell::new(s.overlap.to_string())]).chain(parts);
        rows.push(TableRow::new(begins, cells.chain([TableCell::new(frames)])));
    }
    let columns = [
        "network",
        "trained on",
        "tested on",
        "overlap",
        "3D AP lost",
        "by labels",
        "by sensor and scene",
        "by the sensor",
        "by the scene",
        "frames",
    ];
    let caption = format!(
        "What the networks lose between their own data and other data, {class}, in percentage points with the interval below. \
         By labels: AP against the true boxes less AP against the labels, where the labels were made automatically and the truth is \
         known. By sensor and scene: AP on its own data less AP against the true boxes (against the labels where no truth is known). \
         Sensor and scene are told from each other where a test set has the scenes of the one and the sensor of the other \
         (`scene_of`, `sensor_of`). Where the test sets have other frames, the difference of the frames is in the scene's part."
    );
    (!rows.is_empty()).then(|| Item::table(format!("splits-{}", slug(class)), caption, (&columns, 3), rows, None))
}

/// A dot per run, by range section.
pub(super) fn range_section(m: &Matrix) -> Section {
    let mut items = Vec::new();
    let mut series: Vec<&str> = Vec::new();
    for name in m.plan.networks.iter().flat_map(|n| &n.train_sets).map(|place| place.title.as_str()) {
        if !series.contains(&name) {
            series.push(name);
        }
    }
    let sections: Vec<Option<RangeSection>> =
        std::iter::once(None).chain(m.options.sections.iter().copied().map(Some)).collect();
    for class in &m.options.classes {
        for planned in &m.plan.networks {
            let network = &planned.network;
            let cells: Vec<_> = m.rows().filter(|(c, _)| c.network == network.name).collect();
            for overlap in &m.options.overlaps {
                let panel = |section: &Option<RangeSection>| {
                    let mut n_gt: Vec<i64> = Vec::new();
                    let groups = cells.iter().map(|(c, reference)| {
                        let n = c.number_of(*reference, class, *section, Quantity::Ap40, *overlap);
                        n_gt.extend(n.and_then(|n| n.n_gt));
                        let train = m.title(&c.train_set);
                        DotGroup {
                            label: format!("{train} → {}", m.test_title(&c.test_set, *reference)),
                            series: series.iter().position(|name| *name == train).unwrap_or(0),
                            values: n.map_or(Vec::new(), |n| n.of_runs.iter().filter_map(|run| run.value).collect()),
                            mean: n.and_then(|n| n.mean),
                            interval: n.and_then(|n| n.interval).map(|i| [i.low, i.high]),
                            ceiling: n.and_then(|n| n.ceiling),
                        }
                    });
                    let groups = groups.collect();
                    let place = section.map_or("all".into(), |s| s.to_string());
                    let (least, most) =
                        (n_gt.iter().min().copied().unwrap_or(0), n_gt.iter().max().copied().unwrap_or(0));
                    let count = if least == most { format!("n = {least}") } else { format!("n = {least} to {most}") };
                    DotPanel { title: format!("{place}, {count}"), groups }
                };
                let panels: Vec<DotPanel> = sections.iter().map(panel).collect();
                let caption = format!(
                    "3D AP ({overlap}) of {}, {class}, by distance of the target: a dot for each run, a line at the mean, a band for its \
                     interval, a dashed line where so few ground truths (n) cap AP40; a dash stands where there is no run. Ground truth outside \
                     a section is ignored, and so is a detection outside it that finds nothing.",
                    network.title
                );
                let id = format!("ranges-{}-{}-{}", slug(&network.name), slug(class), slug(&overlap.to_string()));
                let lines = range_lines(m, class, &network.name, *overlap, &sections);
                let figure = dots(&panels, &series, "3D AP (%)");
                items.push(Item::figure(id, caption, figure, (&RANGE_COLUMNS, &lines)));
            }
        }
    }
    Section { id: "ranges", title: "By distance", text: Vec::new(), items }
}

const RANGE_COLUMNS: [&str; 10] =
    ["train_set", "test_set", "reference", "from_m", "to_m", "n_gt", "ceiling_ap40", "mean_ap40", "seed", "ap40"];

fn range_lines(
    m: &Matrix,
    class: &str,
    network: &str,
    overlap: f64,
    sections: &[Option<RangeSection>],
) -> Vec<Vec<String>> {
    let mut lines = Vec::new();
    for (c, reference) in m.rows().filter(|(c, _)| c.network == network) {
        let of = |section: &Option<RangeSection>| c.number_of(reference, class, *section, Quantity::Ap40, overlap);
        for n in sections.iter().filter_map(of) {
            for run in &n.of_runs {
                lines.push(vec![
                    c.train_set.clone(),
                    c.test_set.clone(),
                    reference.key().into(),
                    csv_number(n.section.map(|s| s.from_m)),
                    csv_number(n.section.map(|s| s.to_m)),
                    n.n_gt.map_or(String::new(), |n| n.to_string()),
                    csv_number(n.ceiling),
                    csv_number(n.mean),
                    run.seed.to_string(),
                    csv_number(run.value),
                ]);
            }
        }
    }
    lines
}
