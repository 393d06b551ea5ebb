//! `--json FILE`: the result of a command as JSON, in a file or alone on stdout.

use crate::console;
use clap::{ArgMatches, Args};
use data::output::check_writable;
use data::{DataError, refuse_input_file};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Where the result goes as JSON.
#[derive(Args, Clone, Debug, Default)]
pub struct JsonArgs {
    /// Also write the result as JSON to this file; -: to stdout, and all text to stderr
    #[arg(long, value_name = "FILE|-")]
    json: Option<PathBuf>,
}

impl JsonArgs {
    /// To this file.
    pub fn file(path: impl Into<PathBuf>) -> Self {
        JsonArgs { json: Some(path.into()) }
    }

    /// Whether the result is wanted as JSON.
    pub fn is_given(&self) -> bool {
        self.json.is_some()
    }

    /// Whether it goes to stdout, where it may be written once.
    pub fn is_stdout(&self) -> bool {
        self.json.as_deref().is_some_and(is_stdout)
    }

    /// Refuses a file that cannot be written, or that is one of the files which are read, before the work begins.
    ///
    /// # Errors
    /// Such a file.
    pub fn check<'a>(&self, inputs: impl IntoIterator<Item = &'a Path>) -> Result<(), DataError> {
        let Some(path) = self.json.as_deref().filter(|path| !is_stdout(path)) else { return Ok(()) };
        refuse_input_file(Some(path), inputs)?;
        check_writable(path)
    }

    /// Writes the result, if it is wanted.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, result: &impl Serialize) -> Result<(), DataError> {
        match self.json.as_deref() {
            None => Ok(()),
            Some(path) if is_stdout(path) => {
                let failed = |e| DataError::file(path, format!("cannot be written as JSON: {e}"));
                console::print_json(&serde_json::to_string_pretty(result).map_err(failed)?);
                Ok(())
            }
            Some(path) => data::write_json(path, result),
        }
    }
}

fn is_stdout(path: &Path) -> bool {
    path == Path::new("-")
}

/// Whether these arguments, or those of a command below, want JSON on stdout.
pub(crate) fn is_on_stdout(arguments: &ArgMatches) -> bool {
    let own = arguments.try_get_one::<PathBuf>("json").ok().flatten().is_some_and(|path| is_stdout(path));
    own || arguments.subcommand().is_some_and(|(_, below)| is_on_stdout(below))
}
