//! `lidarshift man`: pages of the manual.

use crate::errln;
use anyhow::Result;
use clap::{Args, Command};
use std::path::{Path, PathBuf};

/// Write a page of the manual for each command.
///
/// Example:
///   lidarshift man --out ~/.local/share/man/man1
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ManArgs {
    /// Folder for the pages
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl ManArgs {
    /// Writes the pages.
    pub fn run(self) -> Result<()> {
        let mut command = crate::command();
        command.build();
        let written = write_pages(&command, &self.out)?;
        errln!("{written} pages written to {}", self.out.display());
        Ok(())
    }
}

/// Writes the pages of a command and of those below it; returns their number.
fn write_pages(command: &Command, out: &Path) -> Result<usize> {
    let name = command.get_display_name().unwrap_or(command.get_name()).to_owned();
    let mut page = Vec::new();
    clap_mangen::Man::new(command.clone()).render(&mut page)?;
    data::write_atomic(&out.join(format!("{name}.1")), &page)?;
    let mut written = 1;
    for below in command.get_subcommands().filter(|c| !c.is_hide_set() && c.get_name() != "help") {
        written += write_pages(below, out)?;
    }
    Ok(written)
}
