//! `lidarshift eval matrix`: train set x test set of a study.

use crate::study::StudyPlace;
use anyhow::Result;
use clap::Args;
use data::write_atomic;
use std::path::{Path, PathBuf};
use study::numbers::{Found, matrix};

/// Average precision and recall of every run of a study on every test set: means, deviations and intervals, in the layout of the paper's
/// table. A cell without a run stays in the table and says why. Only what has been detected counts; nothing is trained.
///
/// Examples:
///   lidarshift eval matrix quick
///   lidarshift eval matrix my-study.toml --out runs/mine --latex table.tex --csv numbers.csv
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalMatrixArgs {
    #[command(flatten)]
    place: StudyPlace,
    /// Write the matrix as JSON, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write every number of every run as CSV
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write the paper's table in LaTeX
    #[arg(long, value_name = "FILE")]
    latex: Option<PathBuf>,
}

impl EvalMatrixArgs {
    /// Prints the tables in Markdown.
    ///
    /// # Errors
    /// Data sets that are not there, labels that cannot be read.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let study = self.place.open()?;
        let matrix = matrix(&study, &Found::look(&study)?)?;
        let write = |path: &Option<PathBuf>, text: &dyn Fn() -> String| -> Result<()> {
            path.as_deref().map_or(Ok(()), |path: &Path| Ok(write_atomic(path, text().as_bytes())?))
        };
        write(&self.json, &|| matrix.to_json())?;
        write(&self.csv, &|| matrix.to_csv())?;
        write(&self.latex, &|| matrix.to_latex())?;
        print!("{}", matrix.to_markdown());
        Ok(())
    }
}
