//! `lidarshift report`: the page of a study.

use crate::study::StudyPlace;
use crate::study::present::write_report;
use anyhow::Result;
use clap::Args;

/// Write the report of a study from what its folder holds: one HTML page that needs nothing else, its figures as SVG and PNG, its tables as
/// CSV. Nothing is trained; cells without a run say so.
///
/// Examples:
///   lidarshift report quick
///   lidarshift report my-study.toml --out runs/mine
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ReportArgs {
    #[command(flatten)]
    place: StudyPlace,
}

impl ReportArgs {
    /// Writes the page and says where it is.
    ///
    /// # Errors
    /// Data sets that are not there, files that are damaged.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let (_, files) = write_report(&self.place.open()?)?;
        println!("report: {} ({:.1} MB)", files.page.display(), files.page_bytes as f64 / 1e6);
        Ok(())
    }
}
