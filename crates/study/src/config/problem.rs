//! Validation of a study.

use super::{Source, StudyConfig};
use data::limits::check_name;
use eval::distance::Compared;
use std::collections::BTreeSet;

impl StudyConfig {
    /// The first problem of the study, with its key.
    pub(super) fn problem(&self) -> Option<String> {
        let names = [
            ("dataset", self.datasets.iter().map(|d| d.name.as_str()).collect::<Vec<_>>()),
            ("detector", self.detectors.iter().map(|d| d.name.as_str()).collect()),
            ("frozen", self.frozen.iter().map(|f| f.name.as_str()).collect()),
            ("variant", self.variants.iter().map(|v| v.name.as_str()).collect()),
        ];
        if !is_name(&self.name) {
            return Some(format!("name {:?} has to be a file name of letters, digits, '-', '_' and '.'", self.name));
        }
        for (what, names) in &names {
            if names.is_empty() && *what == "dataset" {
                return Some("there is no [[dataset]]".into());
            }
            if names.is_empty() && *what == "detector" && self.frozen.is_empty() && self.datasets.len() < 2 {
                return Some(
                    "there is neither a [[detector]] to train, nor a [[frozen]] detector, nor a second [[dataset]] to \
                     compare with"
                        .into(),
                );
            }
            if let Some(bad) = names.iter().find(|name| !is_name(name)) {
                return Some(format!("{what}.name {bad:?} has to be a file name of letters, digits, '-', '_' and '.'"));
            }
            let mut known = BTreeSet::new();
            if let Some(twice) = names.iter().find(|name| !known.insert(**name)) {
                return Some(format!("{what} {twice:?} exists twice"));
            }
        }
        let seeds =
            self.detectors.iter().filter_map(|d| Some((format!("detector {}: seeds", d.name), d.seeds.as_ref()?)));
        let common = self.trains().then(|| ("seeds".to_string(), &self.seeds));
        for (what, seeds) in common.into_iter().chain(seeds) {
            let distinct: BTreeSet<&u64> = seeds.iter().collect();
            if seeds.is_empty() || distinct.len() < seeds.len() {
                return Some(format!("{what} {seeds:?} have to be distinct and at least one"));
            }
        }
        let epochs = self.detectors.iter().filter_map(|d| d.epochs).chain(self.epochs);
        if epochs.min() == Some(0) {
            return Some("epochs have to be 1 or more".into());
        }
        let [datasets, detectors, _, _] = names.map(|(_, names)| names);
        let unknown = |what: String, name: &str, known: &[&str]| {
            (!known.contains(&name)).then(|| {
                format!("{what} contains {name:?}, which is not in the study; known names: {}", known.join(", "))
            })
        };
        let of_train = self.detectors.iter().flat_map(|d| d.train.iter().flatten().map(move |t| (d, t)));
        let of_train = of_train.filter_map(|(d, name)| unknown(format!("detector {}: train", d.name), name, &datasets));
        let of_variant = self.variants.iter().flat_map(|v| v.detectors.iter().flatten().map(move |d| (v, d)));
        let of_variant =
            of_variant.filter_map(|(v, name)| unknown(format!("variant {}: detectors", v.name), name, &detectors));
        let of_tsne = self.evaluation.tsne_dataset.iter();
        let of_tsne = of_tsne.filter_map(|name| unknown("evaluation.tsne_dataset".into(), name, &datasets));
        let of_between = self.datasets.iter().flat_map(|d| {
            let named = [("scene_of", &d.scene_of), ("sensor_of", &d.sensor_of)];
            named.into_iter().filter_map(move |(key, name)| Some((d, key, name.as_ref()?)))
        });
        let of_between =
            of_between.filter_map(|(d, key, name)| unknown(format!("dataset {}: {key}", d.name), name, &datasets));
        if let Some(problem) = of_train.chain(of_variant).chain(of_tsne).chain(of_between).next() {
            return Some(problem);
        }
        let networks: Vec<String> = self.networks().into_iter().map(|(name, ..)| name).collect();
        if let Some(problem) = self.frozen_problem(&datasets, &networks) {
            return Some(problem);
        }
        for (i, dataset) in self.datasets.iter().enumerate() {
            if dataset.scene_of.is_some() != dataset.sensor_of.is_some() {
                return Some(format!("dataset {}: scene_of and sensor_of are given together", dataset.name));
            }
            match &dataset.source {
                Source::Resim { of, .. } | Source::TrueLabels { of } if !datasets[..i].contains(&of.as_str()) => {
                    let key = if matches!(dataset.source, Source::Resim { .. }) { "resim" } else { "true_labels" };
                    return Some(format!(
                        "dataset {}: {key}.of is {of:?}, which is not the name of an earlier data set",
                        dataset.name
                    ));
                }
                Source::Simulate { frames: 0, .. } => return Some(format!("dataset {}: frames is 0", dataset.name)),
                _ => {}
            }
        }
        if !self.trains() && self.evaluation.distances.compared != Compared::Raw {
            return Some("evaluation.distances.compared needs a [[detector]], whose training loader is used".into());
        }
        if self.evaluation.matrix.overlaps.iter().any(|o| !(0.0..1.0).contains(o)) {
            return Some("evaluation.matrix.overlaps have to be in [0, 1)".into());
        }
        None
    }
}

fn is_name(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    check_name(name).is_ok() && name.chars().all(plain)
}
