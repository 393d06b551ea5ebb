//! Section with the differences of detectors that were trained elsewhere between data sets of the same frames.

use super::matrix::part_cell;
use super::{csv_number, number, slug};
use crate::figure::{IntervalRow, intervals};
use crate::html::{Item, Section, TableCell, TableRow};
use eval::csv_text;
use eval::matrix::{Matrix, PairedDifference, Part, Quantity};

/// For each class: a figure of the AP differences by range, and a table of all differences over the full range.
pub(super) fn section(paired: &[PairedDifference], matrix: Option<&Matrix>) -> Section {
    let mut classes: Vec<&str> = Vec::new();
    for difference in paired {
        if !classes.contains(&difference.class.as_str()) {
            classes.push(&difference.class);
        }
    }
    let title = |name: &str| matrix.map_or(name.to_string(), |m| m.title(name).to_string());
    let items = classes.iter().flat_map(|class| {
        let shown = [figure(paired, class, &title), table(paired, class, &title)];
        shown.into_iter().chain(parts_table(paired, class, &title))
    });
    let items = items.collect();
    let text = vec![
        "Each detector is scored as it is on data sets that hold the same moments. Both values of a difference are over the frames that \
         both data sets have, and a resample of the bootstrap draws the same frames for both."
            .into(),
    ];
    Section { id: "frozen", title: "Measured minus simulated", text, items }
}

fn figure(paired: &[PairedDifference], class: &str, title: &dyn Fn(&str) -> String) -> Item {
    let of_class = paired.iter().filter(|d| d.class == class && d.quantity == Quantity::Ap40);
    let mut overlaps: Vec<f64> = Vec::new();
    let mut rows = Vec::new();
    for d in of_class {
        let series = overlaps.iter().position(|o| *o == d.overlap).unwrap_or_else(|| {
            overlaps.push(d.overlap);
            overlaps.len() - 1
        });
        let range = d.section.map_or("all".to_string(), |s| s.to_string());
        rows.push(IntervalRow {
            name: format!("{}, {} − {}, {range}", title(&d.network), title(&d.test_set), title(&d.compared_to)),
            value: d.difference,
            interval: d.interval.map(|i| [i.low, i.high]),
            text: d.difference.map_or("–".into(), |v| format!("{v:+.1}")),
            series,
        });
    }
    let names: Vec<String> = overlaps.iter().map(|o| format!("3D AP ({o})")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let caption = format!(
        "3D AP of {class} on the first data set minus that on the other, by distance of the target, with the interval over the frames. \
         Right of zero the detector is better on the first data set."
    );
    let figure = intervals(&rows, &names, "difference of 3D AP (points)");
    Item::figure(format!("paired-{}", slug(class)), caption, figure, (&[], &[]))
}

fn table(paired: &[PairedDifference], class: &str, title: &dyn Fn(&str) -> String) -> Item {
    let mut rows = Vec::new();
    let mut last = None;
    for d in paired.iter().filter(|d| d.class == class && d.section.is_none()) {
        let begins = last.replace((&d.network, &d.compared_to)) != Some((&d.network, &d.compared_to));
        let verdict = match d.interval {
            Some(i) if i.low > 0.0 => "higher on the first",
            Some(i) if i.high < 0.0 => "lower on the first",
            Some(_) => "not distinguishable from 0",
            None => "no interval",
        };
        let difference = TableCell::with_small(
            d.difference.map_or("–".into(), |v| format!("{v:+.2}")),
            d.interval.map_or(String::new(), |i| format!("{:+.2} to {:+.2}", i.low, i.high)),
        );
        let names = [title(&d.network), title(&d.test_set), title(&d.compared_to)];
        let cells = names.into_iter().map(TableCell::new).chain([
            TableCell::new(format!("{} ({})", d.quantity, d.overlap)),
            TableCell::new(d.frames.to_string()),
            TableCell::new(number(d.value, 2)),
            TableCell::new(number(d.other, 2)),
            difference,
            TableCell::new(verdict),
        ]);
        rows.push(TableRow::new(begins, cells));
    }
    let columns =
        ["detector", "first", "other", "value", "frames", "on the first", "on the other", "difference", "verdict"];
    let caption = format!(
        "{class}, all distances: values on the same frames in percent, their difference in points of percent, and below it the interval. \
         The CSV has every range section."
    );
    let lines: Vec<Vec<String>> = paired.iter().filter(|d| d.class == class).map(line).collect();
    let csv = csv_text(&CSV_COLUMNS, &lines);
    Item::table(format!("paired-table-{}", slug(class)), caption, (&columns, 4), rows, Some(csv))
}

/// What labels, sensor and scene make of the differences of AP; none where nothing tells them from each other.
fn parts_table(paired: &[PairedDifference], class: &str, title: &dyn Fn(&str) -> String) -> Option<Item> {
    let (mut rows, mut last) = (Vec::new(), None);
    let shown = |d: &&PairedDifference| {
        d.class == class && d.section.is_none() && matches!(d.quantity, Quantity::Ap40 | Quantity::BevAp40)
    };
    for d in paired.iter().filter(shown) {
        let Some(parts) = d.parts else { continue };
        let begins = last.replace((&d.network, &d.compared_to)) != Some((&d.network, &d.compared_to));
        let all = d.difference.map(|points| Part { points, interval: d.interval });
        let names = [title(&d.network), title(&d.test_set), title(&d.compared_to)];
        let quantity = TableCell::new(format!("{} ({})", d.quantity, d.overlap));
        let cells = [all, parts.label, Some(parts.sensor_and_scene), parts.sensor, parts.scene].map(part_cell);
        rows.push(TableRow::new(begins, names.into_iter().map(TableCell::new).chain([quantity]).chain(cells)));
    }
    let columns = [
        "detector",
        "first",
        "other",
        "value",
        "difference",
        "by labels",
        "by sensor and scene",
        "by the sensor",
        "by the scene",
    ];
    let caption = format!(
        "What makes the differences, {class}, in percentage points with the interval below. By labels: AP against the labels less AP against          the true boxes, on the first data set less on the other, where the labels were made automatically and the truth is known. By          sensor and scene: what remains against the true boxes. Sensor and scene are told from each other where a data set has the scenes          of the one and the sensor of the other (`scene_of`, `sensor_of`)."
    );
    (!rows.is_empty()).then(|| Item::table(format!("paired-parts-{}", slug(class)), caption, (&columns, 4), rows, None))
}

const CSV_COLUMNS: [&str; 17] = [
    "detector",
    "first",
    "other",
    "quantity",
    "overlap",
    "from_m",
    "to_m",
    "frames",
    "value",
    "other_value",
    "difference",
    "low",
    "high",
    "by_labels",
    "by_sensor_and_scene",
    "by_sensor",
    "by_scene",
];

fn line(d: &PairedDifference) -> Vec<String> {
    vec![
        d.network.clone(),
        d.test_set.clone(),
        d.compared_to.clone(),
        d.quantity.key().into(),
        d.overlap.to_string(),
        csv_number(d.section.map(|s| s.from_m)),
        csv_number(d.section.map(|s| s.to_m)),
        d.frames.to_string(),
        csv_number(d.value),
        csv_number(d.other),
        csv_number(d.difference),
        csv_number(d.interval.map(|i| i.low)),
        csv_number(d.interval.map(|i| i.high)),
        csv_number(d.parts.and_then(|p| p.label).map(|p| p.points)),
        csv_number(d.parts.map(|p| p.sensor_and_scene.points)),
        csv_number(d.parts.and_then(|p| p.sensor).map(|p| p.points)),
        csv_number(d.parts.and_then(|p| p.scene).map(|p| p.points)),
    ]
}
