//! `--errors json`: an error as one JSON object on the last line of stderr.

use crate::commands::End;
use crate::console;
use clap::ValueEnum;
use clap::error::{ContextKind, ContextValue, ErrorKind as Kind};
use data::{ErrorKind, Located, Place};
use schemars::JsonSchema;
use serde::Serialize;
use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};

/// Name and version of the object.
pub const SCHEMA: &str = "lidarshift/error/1";

/// How errors are written to stderr.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ErrorFormat {
    /// One line for people: `error: ...`
    #[default]
    Text,
    /// A JSON object, the last line of stderr
    Json,
}

impl ErrorFormat {
    /// What the arguments choose, even if they cannot be parsed.
    pub fn of(arguments: &[OsString]) -> Self {
        let words = || arguments.iter().take_while(|word| *word != "--");
        let pairs = words().zip(words().skip(1));
        let is_json = words().any(|word| word == "--errors=json")
            || pairs.into_iter().any(|(option, value)| option == "--errors" && value == "json");
        if is_json { ErrorFormat::Json } else { ErrorFormat::Text }
    }
}

/// What is reported of an error to a program.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct ErrorReport {
    /// `lidarshift/error/1`.
    pub schema: &'static str,
    /// Exit code of the program.
    pub code: u8,
    /// Kind of the error.
    pub kind: ErrorKind,
    /// The file or folder.
    pub file: Option<String>,
    /// The line of the file, counted from 1.
    pub line: Option<usize>,
    /// What to do.
    pub hint: Option<String>,
    /// The whole message, as it is printed without `--errors json`.
    pub message: String,
}

impl ErrorReport {
    /// Of a message and its place.
    pub fn new(code: u8, place: Place, message: String) -> Self {
        ErrorReport {
            schema: SCHEMA,
            code,
            kind: place.kind,
            file: place.file.map(|path| path.display().to_string()),
            line: place.line,
            hint: data::hint(&message).map(str::to_owned),
            message,
        }
    }

    /// Of a command that failed.
    pub fn of_error(error: &anyhow::Error) -> Self {
        ErrorReport::new(crate::FAILURE, place_of(error), format!("{error:#}"))
    }

    /// Of a command that ran; `None` if nothing is wrong.
    pub fn of_end(end: End) -> Option<Self> {
        let (kind, message) = match end {
            End::Done => return None,
            End::Failed => (ErrorKind::CheckFailed, "the command found something wrong; see its result"),
            End::NotTheSameScenes => {
                (ErrorKind::OtherScenes, "the measured and the simulated data set do not show the same scenes")
            }
        };
        Some(ErrorReport::new(end.into(), Place::of_kind(kind), message.into()))
    }

    /// Of arguments that cannot be parsed; `None` if they ask for a help text or the version.
    pub fn of_usage(error: &clap::Error) -> Option<Self> {
        if !error.use_stderr() {
            return None;
        }
        let text = error.to_string();
        let first = text.split("\n\n").next().unwrap_or_default();
        let message = match error.kind() {
            // Its text is the whole help.
            Kind::DisplayHelpOnMissingArgumentOrSubcommand | Kind::MissingSubcommand => "the command is missing",
            _ => first.strip_prefix("error: ").unwrap_or(first).trim(),
        };
        let message = message.to_owned();
        let suggested = [ContextKind::SuggestedSubcommand, ContextKind::SuggestedArg, ContextKind::SuggestedValue]
            .into_iter()
            .find_map(|kind| match error.get(kind)? {
                ContextValue::String(name) => Some(name.clone()),
                ContextValue::Strings(names) => names.first().cloned(),
                _ => None,
            });
        let hint = match suggested {
            Some(name) => format!("did you mean `{name}`?"),
            None => "see --help of the command".into(),
        };
        let code = u8::try_from(error.exit_code()).unwrap_or(2);
        Some(ErrorReport { hint: Some(hint), ..ErrorReport::new(code, Place::of_kind(ErrorKind::Usage), message) })
    }

    /// Writes the object to stderr, as one line.
    pub fn print(&self) {
        let text = serde_json::to_string(self).expect("a report is plain data");
        console::print_error(format_args!("{}\n", console::escaped_json(&text)));
    }
}

/// A context that names the file of an error whose own type does not know it.
#[derive(Debug)]
pub(crate) struct InFile {
    file: PathBuf,
    what: String,
}

impl InFile {
    /// The context of `file`, with text behind its name.
    pub fn new(file: &Path, what: &str) -> Self {
        InFile { file: file.into(), what: what.into() }
    }
}

impl fmt::Display for InFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.file.display(), self.what)
    }
}

/// Kind and place of an error: of the first cause that has a place.
fn place_of(error: &anyhow::Error) -> Place {
    fn of<E: std::error::Error + Located + 'static>(cause: &(dyn std::error::Error + 'static)) -> Option<Place> {
        cause.downcast_ref::<E>().map(Located::place)
    }
    let mut place = error
        .chain()
        .find_map(|cause| {
            None.or_else(|| of::<data::DataError>(cause))
                .or_else(|| of::<study::StudyError>(cause))
                .or_else(|| of::<train::TrainError>(cause))
                .or_else(|| of::<models::ModelError>(cause))
                .or_else(|| of::<simulate::SimulateError>(cause))
                .or_else(|| of::<twin::TwinError>(cause))
                .or_else(|| of::<diagnose::DiagnoseError>(cause))
                .or_else(|| of::<report::ReportError>(cause))
                .or_else(|| of::<data::KeyError>(cause))
                .or_else(|| of::<std::io::Error>(cause))
        })
        .unwrap_or_default();
    if place.file.is_none()
        && let Some(context) = error.downcast_ref::<InFile>()
    {
        let kind = if place.kind == ErrorKind::Refused { ErrorKind::Invalid } else { place.kind };
        place = Place { kind, file: Some(context.file.clone()), ..place };
    }
    place
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context as _;

    #[test]
    fn the_place_is_found_below_contexts() {
        let line = || data::DataError::line(Path::new("a.toml"), 3, "unknown field `x`: did you mean `y`?");
        let below = study::StudyError::Part { part: "run".into(), error: Box::new(line().into()) };
        for error in [
            anyhow::Error::from(line()).context("converting b"),
            anyhow::Error::from(below),
            anyhow::Error::from(simulate::SimulateError::Data(line())).context("one").context("two"),
        ] {
            let report = ErrorReport::of_error(&error);
            assert_eq!((report.code, report.kind, report.line), (1, ErrorKind::Invalid, Some(3)));
            assert_eq!(report.file.as_deref(), Some("a.toml"));
            assert_eq!(report.hint.as_deref(), Some("did you mean `y`?"));
            assert_eq!(report.message, format!("{error:#}"));
        }
        let weights = Err::<(), _>(models::ModelError::Weights("no tensor".into()));
        let report =
            ErrorReport::of_error(&weights.context(InFile::new(Path::new("w.pth"), " does not fit")).unwrap_err());
        assert_eq!((report.file.as_deref(), report.kind), (Some("w.pth"), ErrorKind::Invalid));
        assert_eq!(report.message, "w.pth does not fit: no tensor");
        let plain = ErrorReport::of_error(&anyhow::anyhow!("--overlaps 2: has to be in [0, 1)"));
        assert_eq!((plain.kind, plain.file, plain.hint), (ErrorKind::Refused, None, None));
    }

    #[test]
    fn the_format_is_found_in_any_arguments() {
        let of = |text: &str| ErrorFormat::of(&text.split(' ').map(OsString::from).collect::<Vec<_>>());
        assert_eq!(of("lidarshift doctor x --errors json"), ErrorFormat::Json);
        assert_eq!(of("lidarshift --errors=json nothing"), ErrorFormat::Json);
        assert_eq!(of("lidarshift study quick -- --errors json"), ErrorFormat::Text);
        assert_eq!(of("lidarshift --errors text doctor json"), ErrorFormat::Text);
    }
}
