//! Sections with distances between data sets and with their targets.

use super::{csv_number, number, slug};
use crate::figure::{Bar, LocatedTargets, TargetCloud, aggregated_targets, bars, locations, target_views};
use crate::html::{Item, Section, TableCell, TableRow};
use eval::csv_text;
use eval::distance::{Distances, Measure, RegionRow};
use eval::targets::{Spread, Targets};

/// Chamfer, EMD and other distances with their noise floors, and the Chamfer sum by region.
pub(super) fn distance_section(all: &[Distances]) -> Section {
    let mut items: Vec<Item> = all.iter().map(table).collect();
    for d in all.iter().filter(|d| !d.regions.is_empty()) {
        items.extend([region_bars(d), region_table(d)]);
    }
    Section { id: "distances", title: "Distances between the clouds", text: Vec::new(), items }
}

fn region_bars(d: &Distances) -> Item {
    let bar = |r: &RegionRow| Bar {
        name: r.region.clone(),
        value: Some(100.0 * r.share),
        text: format!("{:.1} %", 100.0 * r.share),
        series: 0,
    };
    let caption = format!(
        "Which part of the Chamfer sum of {} and {} ({}) comes from which region: squared distances of the points of both in a region.",
        d.a, d.b, d.options.compared
    );
    let figure = bars(&d.regions.iter().map(bar).collect::<Vec<_>>(), "share of the Chamfer sum (%)");
    Item::figure(format!("regions-{}-{}", slug(&d.a), slug(&d.b)), caption, figure, (&[], &[]))
}

/// The data behind the bars, with the total.
fn region_table(d: &Distances) -> Item {
    let mut whole = RegionRow { region: "whole cloud".into(), ..RegionRow::default() };
    for r in &d.regions {
        whole.points_a += r.points_a;
        whole.points_b += r.points_b;
        whole.a_to_b_m2 += r.a_to_b_m2;
        whole.b_to_a_m2 += r.b_to_a_m2;
        whole.share += r.share;
    }
    let frames = d.frames.max(1) as f64;
    let row = |(i, r): (usize, &RegionRow)| {
        let points = [r.points_a, r.points_b].map(|n| number(Some(n as f64 / frames), 0));
        let sums = [r.a_to_b_m2, r.b_to_a_m2, r.a_to_b_m2 + r.b_to_a_m2].map(|v| number(Some(v / frames), 1));
        let share = format!("{:.1} %", 100.0 * r.share);
        let cells = std::iter::once(r.region.clone()).chain(points).chain(sums).chain([share]);
        TableRow::new(i == d.regions.len(), cells.map(TableCell::new))
    };
    let rows: Vec<TableRow> = d.regions.iter().chain([&whole]).enumerate().map(row).collect();
    let lines: Vec<Vec<String>> = d
        .regions
        .iter()
        .chain([&whole])
        .map(|r| {
            let counts = [r.points_a.to_string(), r.points_b.to_string()];
            let sums = [r.a_to_b_m2, r.b_to_a_m2, r.share].map(|v| v.to_string());
            std::iter::once(r.region.clone()).chain(counts).chain(sums).collect()
        })
        .collect();
    let caption = format!(
        "The Chamfer sum of A, {}, and B, {} ({}), by region, a frame: points of each, and the squared distances from them to the nearest \
         point of the other. The regions add up to the whole. The CSV has the sums over all {} frames.",
        d.a, d.b, d.options.compared, d.frames
    );
    let columns = ["region", "points of A", "points of B", "A to B (m²)", "B to A (m²)", "sum (m²)", "share"];
    let csv = csv_text(&["region", "points_a", "points_b", "a_to_b_m2", "b_to_a_m2", "share"], &lines);
    Item::table(format!("region-sums-{}-{}", slug(&d.a), slug(&d.b)), caption, (&columns, 1), rows, Some(csv))
}

fn digits(measure: Measure) -> usize {
    if measure == Measure::ChamferSumM2 { 0 } else { 3 }
}

fn table(d: &Distances) -> Item {
    let (mut rows, mut last) = (Vec::new(), None);
    for r in &d.rows {
        let begins = last.replace(r.part) != Some(r.part);
        let mean = TableCell::with_small(
            number(r.mean, digits(r.measure)),
            r.interval.map_or(String::new(), |i| {
                let n = digits(r.measure);
                format!("{:.n$} to {:.n$}", i.low, i.high)
            }),
        );
        let left_out = if r.left_out > 0 { format!("{} left out", r.left_out) } else { String::new() };
        rows.push(TableRow::new(
            begins,
            [
                TableCell::new(r.part.to_string()),
                TableCell::new(r.measure.to_string()),
                TableCell::with_small(r.frames.to_string(), left_out),
                mean,
                TableCell::new(number(r.deviation, digits(r.measure))),
                TableCell::new(number(r.floor, digits(r.measure))),
            ],
        ));
    }
    let o = &d.options;
    let caption = format!(
        "Distances of A, {}, and B, {}, frame by frame ({} pairs): {}, up to {} m. Mean over the pairs with the {:.0} % interval below it, \
         deviation (divisor n), and the floor: what two draws of A's own clouds give. EMD: exact, of {} points drawn from each cloud; \
         Sinkhorn: {} points, entropy {} m; sliced Wasserstein: {} directions. Seed {}.",
        d.a,
        d.b,
        d.frames,
        o.compared,
        o.max_range_m,
        100.0 * o.bootstrap.level,
        o.emd_points,
        o.sinkhorn_points,
        o.sinkhorn_epsilon_m,
        o.directions,
        o.seed
    );
    let columns = ["points", "distance", "pairs", "mean", "deviation", "floor"];
    Item::table(format!("distances-{}-{}", slug(&d.a), slug(&d.b)), caption, (&columns, 2), rows, None)
}

/// Statistics of the data sets, target positions and aggregated target points.
pub(super) fn target_section(all: &[Targets]) -> Section {
    let mut items = Vec::new();
    if !all.is_empty() {
        items.push(statistics(all));
        let of =
            |t: &Targets| LocatedTargets { name: t.dataset.clone(), at_m: t.targets.iter().map(|t| t.at_m).collect() };
        let range_m = all.iter().map(|t| t.options.max_range_m).fold(1.0, f64::max);
        let lines: Vec<Vec<String>> = all
            .iter()
            .flat_map(|t| t.targets.iter().map(move |target| (t, target)))
            .map(|(t, target)| {
                let at = target.at_m.map(|v| format!("{v:.3}"));
                let [x, y] = at;
                vec![
                    t.dataset.clone(),
                    target.frame.clone(),
                    x,
                    y,
                    format!("{:.4}", target.yaw_rad),
                    target.points.to_string(),
                ]
            })
            .collect();
        let columns = ["dataset", "frame", "x_m", "y_m", "yaw_rad", "points"];
        items.push(Item::figure(
            "target-locations",
            "Where the targets are relative to the sensor (at the origin, driving to the right), with the share of targets along either axis.",
            locations(&all.iter().map(of).collect::<Vec<_>>(), range_m),
            (&columns, &lines),
        ));
        items.push(aggregated(all));
        items.extend(all.iter().filter_map(views));
    }
    Section { id: "targets", title: "The targets", text: Vec::new(), items }
}

fn statistics(all: &[Targets]) -> Item {
    let of_spread = |name: &str, digits: usize, of: &dyn Fn(&Targets) -> Spread| -> Vec<TableRow> {
        type Part = (&'static str, fn(&Spread) -> Option<f64>);
        let parts: [Part; 3] = [("mean", |s| s.mean), ("least", |s| s.min), ("greatest", |s| s.max)];
        parts
            .into_iter()
            .enumerate()
            .map(|(i, (label, part))| {
                let digits = if i == 0 || digits == 1 { digits } else { 0 };
                let values = all.iter().map(|t| TableCell::new(number(part(&of(t)), digits)));
                TableRow::new(i == 0, [TableCell::new(name), TableCell::new(label)].into_iter().chain(values))
            })
            .collect()
    };
    let mut rows: Vec<TableRow> = Vec::new();
    for (k, name) in ["x of the points (m)", "y of the points (m)", "z of the points (m)"].into_iter().enumerate() {
        rows.extend(of_spread(name, 1, &|t: &Targets| t.coordinates_m[k]));
    }
    rows.extend(of_spread("points a cloud", 0, &|t: &Targets| t.points_per_cloud));
    rows.extend(of_spread("points a target", 0, &|t: &Targets| t.points_per_target));
    let count = |name: &str, of: &dyn Fn(&Targets) -> String| {
        TableRow::new(
            true,
            [TableCell::new(name), TableCell::new("number")]
                .into_iter()
                .chain(all.iter().map(|t| TableCell::new(of(t)))),
        )
    };
    rows.push(count("frames", &|t| t.frames.to_string()));
    rows.push(count("targets", &|t| t.targets.len().to_string()));
    for (k, section) in all[0].options.sections.iter().enumerate() {
        let of =
            |t: &Targets| t.sections.get(k).map_or("–".into(), |s| format!("{} ({} points)", s.targets, s.n_points));
        rows.push(count(&format!("targets in {section}"), &of));
    }
    let columns: Vec<&str> = ["attribute", ""].into_iter().chain(all.iter().map(|t| t.dataset.as_str())).collect();
    let caption =
        format!("The data sets in numbers, points and targets up to {} m on the ground.", all[0].options.max_range_m);
    Item::table("statistics", caption, (&columns, 2), rows, None)
}

fn aggregated(all: &[Targets]) -> Item {
    let columns = all.iter().map(|t| t.sections.len()).max().unwrap_or(1);
    let panels: Vec<TargetCloud> = all
        .iter()
        .flat_map(|t| {
            let panel = |s: &eval::targets::TargetSection| TargetCloud {
                title: format!("{}, {}: {} of {} points", t.dataset, s.section, s.points_m.len(), s.n_points),
                points_m: s.points_m.clone(),
            };
            t.sections.iter().map(panel).collect::<Vec<_>>()
        })
        .collect();
    let lines: Vec<Vec<String>> = all
        .iter()
        .flat_map(|t| {
            t.sections.iter().map(|s| {
                let ends = [s.section.from_m, s.section.to_m].map(|v| csv_number(Some(v)));
                let [from, to] = ends;
                vec![
                    t.dataset.clone(),
                    from,
                    to,
                    s.targets.to_string(),
                    s.n_points.to_string(),
                    s.points_m.len().to_string(),
                ]
            })
        })
        .collect();
    let caption = "Points of all targets of a section of distance, laid over each other in the frame of their box, seen from behind, left and \
                   above; nearer points are darker. The box is the mean box.";
    let figure = aggregated_targets(&panels, columns, all.iter().find_map(|t| t.mean_size_m));
    let names = ["dataset", "from_m", "to_m", "targets", "points", "drawn"];
    Item::figure("targets-aggregated", caption, figure, (&names, &lines))
}

fn views(t: &Targets) -> Option<Item> {
    // The first range section that has points: the nearest targets have the most.
    let section = t.sections.iter().find(|s| !s.points_m.is_empty())?;
    let cloud =
        TargetCloud { title: format!("{}, {}", t.dataset, section.section), points_m: section.points_m.clone() };
    let caption = format!(
        "{} points of {} targets of {} in {}, in the frame of their box: closer points are darker and cover those behind.",
        section.points_m.len(),
        section.targets,
        t.dataset,
        section.section
    );
    Some(Item::figure(
        format!("target-views-{}", slug(&t.dataset)),
        caption,
        target_views(&cloud, t.mean_size_m),
        (&[], &[]),
    ))
}
