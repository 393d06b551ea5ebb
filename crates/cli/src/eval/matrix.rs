//! `lidarshift eval matrix`: AP and recall of a study by train set and test set.

use crate::json::JsonArgs;
use crate::out;
use crate::study::StudySelection;
use anyhow::Result;
use clap::Args;
use data::write_atomic;
use std::path::{Path, PathBuf};
use study::numbers::{StudyState, matrix};

/// Average precision and recall of every run of a study on every test set: mean, standard deviation and confidence
/// interval, in the layout of the paper's table. A cell without a run gives the reason. Only existing detections are
/// evaluated; nothing is trained.
///
/// Examples:
///   lidarshift eval matrix quick
///   lidarshift eval matrix my-study.toml --out runs/mine --latex table.tex --csv numbers.csv
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalMatrixArgs {
    #[command(flatten)]
    study: StudySelection,
    #[command(flatten)]
    json: JsonArgs,
    /// Also write all metrics of all runs as CSV
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Also write the paper's table as LaTeX
    #[arg(long, value_name = "FILE")]
    latex: Option<PathBuf>,
}

impl EvalMatrixArgs {
    /// Prints the tables in Markdown.
    ///
    /// # Errors
    /// Missing data sets, labels that cannot be read.
    pub fn run(self) -> Result<()> {
        let study = self.study.open()?;
        self.json.check([])?;
        let matrix = matrix(&study, &StudyState::read(&study)?)?;
        let write = |path: &Option<PathBuf>, text: &dyn Fn() -> String| -> Result<()> {
            path.as_deref().map_or(Ok(()), |path: &Path| Ok(write_atomic(path, text().as_bytes())?))
        };
        self.json.write(&matrix)?;
        write(&self.csv, &|| matrix.to_csv())?;
        write(&self.latex, &|| matrix.to_latex())?;
        out!("{}", matrix.to_markdown());
        Ok(())
    }
}
