//! `lidarshift report`: writes the report of a study.

use crate::outln;
use crate::study::{StudySelection, listener};
use anyhow::Result;
use clap::Args;
use report::write_event_files;
use std::path::PathBuf;
use study::write_report;

/// Write the report of a study from the results in its folder: one self-contained HTML page, its figures as SVG and
/// PNG, and its tables as CSV. Nothing is trained; cells without a run are marked as missing.
///
/// Examples:
///   lidarshift report quick
///   lidarshift report my-study.toml --out runs/mine
///   lidarshift report quick --tensorboard curves
///   lidarshift report runs/my-run --tensorboard curves
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ReportArgs {
    #[command(flatten)]
    study: StudySelection,
    /// Also write the training curves as TensorBoard event files, one for each run. With this option, STUDY may also be
    /// a run folder, or a folder that contains run folders; then no report is written
    #[arg(long, value_name = "DIR")]
    tensorboard: Option<PathBuf>,
}

impl ReportArgs {
    /// Writes the report and the event files and prints their paths.
    ///
    /// # Errors
    /// Missing data sets, damaged files.
    pub fn run(self) -> Result<()> {
        let without_study = self.study.folder_of_runs().filter(|_| self.tensorboard.is_some());
        let runs = match without_study {
            Some(runs) => runs.to_path_buf(),
            None => {
                let study = self.study.open()?;
                let (_, files) = write_report(&study, &listener())?;
                outln!("report: {} ({:.1} MB)", files.page.display(), files.page_bytes as f64 / 1e6);
                study.folder
            }
        };
        if let Some(out) = &self.tensorboard {
            let n = write_event_files(&runs, out)?.len();
            outln!("training curves of {n} runs: tensorboard --logdir {}", out.display());
        }
        Ok(())
    }
}
