//! Features of the networks of a study: t-SNE, CKA and Fréchet distances.

use crate::cache::cached;
use crate::config::StudyRun;
use crate::detections::{RunFeatures, read_features};
use crate::error::{Result, refused};
use crate::folder::Study;
use crate::numbers::network_title;
use eval::features::{CkaTable, Embedded, Embedding, Features, TSNE_SCHEMA, cka_table, frechet_distance, tsne};
use report::FrechetRow;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Version of [`FeatureResults`].
pub const FEATURES_SCHEMA: &str = "lidarshift/features/1";

/// Results of the feature comparisons of a study.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FeatureResults {
    /// [`FEATURES_SCHEMA`].
    pub schema: String,
    /// t-SNE of each network.
    pub embeddings: Vec<Embedding>,
    /// CKA between the layers of two runs on the same clouds, by name.
    pub cka: Vec<(String, CkaTable)>,
    /// Fréchet distances between runs.
    pub frechet: Vec<FrechetRow>,
    /// Comparisons that could not be made, with the reasons.
    pub warnings: Vec<String>,
}

/// A run with its features.
type Seen = (StudyRun, RunFeatures);

/// t-SNE, CKA and Fréchet distances of a study, cached in `features.json`.
///
/// # Errors
/// Damaged feature files.
pub fn features(study: &Study) -> Result<FeatureResults> {
    let mut seen: Vec<Seen> = Vec::new();
    for run in study.config.runs() {
        if let Some(features) = read_features(study, &run)? {
            seen.push((run, features));
        }
    }
    let options = &study.config.evaluation.tsne;
    let key: Vec<_> = seen.iter().map(|(run, features)| (run.to_string(), features)).collect();
    cached(&study.folder.join("features.json"), &(key, options, study.title(study.feature_set())), || {
        let mut out = FeatureResults { schema: FEATURES_SCHEMA.into(), ..FeatureResults::default() };
        for planned in study.config.plan().networks {
            let network = &planned.network.name;
            let of_network: Vec<&Seen> = seen.iter().filter(|(run, _)| run.id.network == *network).collect();
            if of_network.is_empty() {
                continue;
            }
            match embedding(study, &of_network) {
                Ok(picture) => out.embeddings.push(picture),
                Err(e) => out.warnings.push(format!("no t-SNE of {}: {e}", planned.network.title)),
            }
            let compared = similarities(study, &of_network, &mut out);
            if let Err(e) = compared {
                out.warnings.push(format!("no similarities of {}: {e}", planned.network.title));
            }
        }
        Ok(out)
    })
}

/// Features of the last layer, the input of the head.
fn last(features: &RunFeatures) -> Result<Features> {
    layer(features, features.layers.len() - 1)
}

fn layer(features: &RunFeatures, i: usize) -> Result<Features> {
    let values = &features.values[i];
    Ok(Features::new(values.len() / features.frames.len(), values.clone())?)
}

fn embedding(study: &Study, runs: &[&Seen]) -> Result<Embedding> {
    let options = &study.config.evaluation.tsne;
    let dim = last(&runs[0].1)?.dim();
    let mut values = Vec::new();
    let mut whose = Vec::new();
    for (run, features) in runs {
        for (row, frame) in last(features)?.rows().zip(&features.frames) {
            values.extend_from_slice(row);
            whose.push((study.title(&run.id.train_set).to_string(), run.id.seed, frame.clone()));
        }
    }
    let (places, kl_divergence) = tsne(&Features::new(dim, values)?, options)?;
    let point = |((train_set, seed, frame), at)| Embedded { train_set, seed, frame, at };
    let layer = runs[0].1.layers.last().ok_or_else(|| refused("features have layers"))?;
    Ok(Embedding {
        schema: TSNE_SCHEMA.into(),
        network: network_title(study, &runs[0].0.id.network),
        layer: format!("{layer}, mean over all places"),
        test_set: study.title(study.feature_set()).into(),
        options: options.clone(),
        kl_divergence,
        points: whose.into_iter().zip(places).map(point).collect(),
    })
}

/// CKA and Fréchet distances between the first run and runs with the same seed on other train sets. Runs with other
/// seeds on the same train set are compared as well; they differ by chance only.
fn similarities(study: &Study, runs: &[&Seen], out: &mut FeatureResults) -> Result<()> {
    let network = network_title(study, &runs[0].0.id.network);
    let (first, features) = runs[0];
    let layers = |features: &RunFeatures| -> Result<Vec<(String, Features)>> {
        let of = |(i, name): (usize, &String)| Ok((name.clone(), layer(features, i)?));
        features.layers.iter().enumerate().map(of).collect()
    };
    let a_layers = layers(features)?;
    let a_title = study.title(&first.id.train_set);
    let floor = frechet_floor(features)?;
    for (run, other) in &runs[1..] {
        let title = study.title(&run.id.train_set);
        let same_set = run.id.train_set == first.id.train_set;
        if run.id.seed != first.id.seed && !same_set {
            continue;
        }
        let name = match same_set {
            true => format!("{network}, {a_title}, seed {} against seed {}", first.id.seed, run.id.seed),
            false => format!("{network}, {a_title} against {title}, seed {}", run.id.seed),
        };
        if other.frames == features.frames {
            out.cka.push((name, cka_table(&a_layers, &layers(other)?)?));
        } else {
            out.warnings.push(format!("no CKA of {name}: they did not see the same clouds"));
        }
        let with_seed =
            |title: &str, seed: u64| if same_set { format!("{title}, seed {seed}") } else { title.to_string() };
        out.frechet.push(FrechetRow {
            network: network.clone(),
            a: with_seed(a_title, first.id.seed),
            b: with_seed(title, run.id.seed),
            distance: frechet_distance(&last(features)?, &last(other)?)?,
            floor,
        });
    }
    Ok(())
}

/// Fréchet distance between the even and the odd frames of the same run.
fn frechet_floor(features: &RunFeatures) -> Result<Option<f64>> {
    let all = last(features)?;
    if all.len() < 4 {
        return Ok(None);
    }
    let half = |parity: usize| {
        let rows = all.rows().enumerate().filter(|(i, _)| i % 2 == parity);
        Features::new(all.dim(), rows.flat_map(|(_, row)| row.iter().copied()).collect())
    };
    Ok(Some(frechet_distance(&half(0)?, &half(1)?)?))
}
