//! `lidarshift eval tsne`: features of the networks of a study.

use crate::json::JsonArgs;
use crate::outln;
use crate::study::StudySelection;
use anyhow::{Result, bail};
use clap::Args;
use report::StudyReport;
use std::path::PathBuf;
use study::features::features;

/// Compare the features of the runs of a study on the same test clouds: t-SNE for each network, linear CKA for each
/// layer, and the Fréchet distance between train sets. --figures also writes figures.
///
/// Examples:
///   lidarshift eval tsne quick
///   lidarshift eval tsne my-study.toml --out runs/mine --figures features --json features.json
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalTsneArgs {
    #[command(flatten)]
    study: StudySelection,
    /// Folder for report.html, figures and tables
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    #[command(flatten)]
    json: JsonArgs,
}

impl EvalTsneArgs {
    /// Prints the numbers.
    ///
    /// # Errors
    /// A study without a tested run.
    pub fn run(self) -> Result<()> {
        let study = self.study.open()?;
        self.json.check([])?;
        let found = features(&study)?;
        if found.embeddings.is_empty() && found.frechet.is_empty() && found.warnings.is_empty() {
            bail!("no run of the study has been tested yet; run `lidarshift study {}`", study.named);
        }
        self.json.write(&found)?;
        let mut page = None;
        if let Some(out) = &self.figures {
            let title = format!("Features of the study {}", study.config.name);
            let shown = found.clone();
            let (embeddings, cka, frechet, warnings) = (shown.embeddings, shown.cka, shown.frechet, shown.warnings);
            let report = StudyReport { title, embeddings, cka, frechet, warnings, ..StudyReport::default() };
            page = Some(report.write(out)?.page);
        }
        for e in &found.embeddings {
            let (n, kl) = (e.points.len(), e.kl_divergence);
            outln!("{}: {n} points on {}, {}; Kullback-Leibler divergence {kl:.3}", e.network, e.test_set, e.layer);
        }
        for (name, table) in &found.cka {
            let same: Vec<String> = (0..table.layers_a.len())
                .map(|i| {
                    let value = table.values[i].get(i).copied().flatten();
                    format!("{} {}", table.layers_a[i], value.map_or("-".into(), |v| format!("{v:.3}")))
                })
                .collect();
            outln!("{name}: CKA of corresponding layers: {}", same.join(", "));
        }
        for row in &found.frechet {
            let floor = row.floor.map_or("-".into(), |f| format!("{f:.3}"));
            outln!(
                "{}, {} and {}: Fréchet distance {:.3} (between halves of one run: {floor})",
                row.network,
                row.a,
                row.b,
                row.distance
            );
        }
        found.warnings.iter().for_each(|warning| outln!("{warning}"));
        if let Some(page) = page {
            outln!("figures: {}", page.display());
        }
        Ok(())
    }
}
