//! `lidarshift report`: the page of a study.

use crate::study::{StudyPlace, listener};
use anyhow::Result;
use clap::Args;
use report::write_event_files;
use std::path::PathBuf;
use study::write_report;

/// Write the report of a study from what its folder holds: one HTML page that needs nothing else, its figures as SVG and PNG, its tables as
/// CSV. Nothing is trained; cells without a run say so.
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
    place: StudyPlace,
    /// Write the curves of training as event files for TensorBoard, too: one for each run. With it, the folder of a run that belongs to no
    /// study, or one of such folders, will do; then there is no page
    #[arg(long, value_name = "DIR")]
    tensorboard: Option<PathBuf>,
}

impl ReportArgs {
    /// Writes what was asked for and says where it is.
    ///
    /// # Errors
    /// Data sets that are not there, files that are damaged.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let alone = self.place.runs_alone().filter(|_| self.tensorboard.is_some());
        let runs = match alone {
            Some(runs) => runs.to_path_buf(),
            None => {
                let study = self.place.open()?;
                let (_, files) = write_report(&study, &listener())?;
                println!("report: {} ({:.1} MB)", files.page.display(), files.page_bytes as f64 / 1e6);
                study.folder
            }
        };
        if let Some(out) = &self.tensorboard {
            let n = write_event_files(&runs, out)?.len();
            println!("curves of {n} runs: tensorboard --logdir {}", out.display());
        }
        Ok(())
    }
}
