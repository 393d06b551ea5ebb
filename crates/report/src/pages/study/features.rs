//! Section with the network features.

use super::{StudyReport, slug};
use crate::figure::{ScatterGroup, heat_map, scatter};
use crate::html::{Item, Section, TableCell, TableRow};
use eval::features::Embedding;

/// t-SNE, CKA and Fréchet distances.
pub(super) fn section(report: &StudyReport) -> Section {
    let mut items: Vec<Item> = report.embeddings.iter().map(embedding).collect();
    for (name, table) in &report.cka {
        let lines: Vec<Vec<String>> = table
            .layers_a
            .iter()
            .zip(&table.values)
            .flat_map(|(a, row)| {
                let cell = |(b, v): (&String, &Option<f64>)| vec![a.clone(), b.clone(), super::csv_number(*v)];
                table.layers_b.iter().zip(row).map(cell).collect::<Vec<_>>()
            })
            .collect();
        let caption = format!(
            "{name}: linear CKA (Kornblith et al. 2019) of every layer of the first network (rows) with every layer of the second (columns) on \
             the same clouds. 1: the same up to rotation and scale; 0: nothing in common."
        );
        let figure = heat_map(&table.layers_a, &table.layers_b, &table.values);
        items.push(Item::figure(
            format!("cka-{}", slug(name)),
            caption,
            figure,
            (&["layer_a", "layer_b", "cka"], &lines),
        ));
    }
    if !report.frechet.is_empty() {
        let row = |r: &super::FrechetRow| {
            let floor = r.floor.map_or("–".into(), |f| format!("{f:.3}"));
            let cells = [r.network.clone(), r.a.clone(), r.b.clone(), format!("{:.3}", r.distance), floor];
            TableRow::new(false, cells.map(TableCell::new))
        };
        let columns = ["network", "trained on", "and on", "Fréchet distance", "floor"];
        let caption = "Fréchet distance of the features, in squared units of theirs. The floor is that of two halves of the first network's own \
                       features: nearer is no difference.";
        items.push(Item::table("frechet", caption, (&columns, 3), report.frechet.iter().map(row).collect(), None));
    }
    let text = vec![
        "t-SNE keeps neighbourhoods and nothing else: distances between clusters and their sizes say nothing. Linear CKA and the Fréchet \
         distance keep what it loses."
            .into(),
    ];
    Section { id: "features", title: "What the networks see", text, items }
}

fn embedding(e: &Embedding) -> Item {
    let mut groups: Vec<ScatterGroup> = Vec::new();
    for p in &e.points {
        let k = groups.iter().position(|g| g.name == p.train_set).unwrap_or_else(|| {
            groups.push(ScatterGroup { name: p.train_set.clone(), points: Vec::new() });
            groups.len() - 1
        });
        groups[k].points.push(p.at);
    }
    let mut runs: Vec<(&str, u64)> = e.points.iter().map(|p| (p.train_set.as_str(), p.seed)).collect();
    runs.sort_unstable();
    runs.dedup();
    for group in &mut groups {
        group.name = format!("trained on {}", group.name);
    }
    let caption = format!(
        "t-SNE of the features of {} ({}) on {}: one point for each cloud and run, {} points of {} runs. Perplexity {}, {} steps from the first \
         two principal components, seed {}; Kullback-Leibler divergence {:.3}.",
        e.network,
        e.layer,
        e.test_set,
        e.points.len(),
        runs.len(),
        e.options.perplexity,
        e.options.steps,
        e.options.seed,
        e.kl_divergence
    );
    let line = |p: &eval::features::Embedded| {
        vec![
            p.train_set.clone(),
            p.seed.to_string(),
            p.frame.clone(),
            format!("{:.4}", p.at[0]),
            format!("{:.4}", p.at[1]),
        ]
    };
    let lines: Vec<Vec<String>> = e.points.iter().map(line).collect();
    Item::figure(
        format!("tsne-{}", slug(&e.network)),
        caption,
        scatter(&groups),
        (&["train_set", "seed", "frame", "u", "v"], &lines),
    )
}
