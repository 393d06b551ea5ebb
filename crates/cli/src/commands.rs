//! How a command is added to the program, and how its result becomes an exit code.

use std::ffi::OsString;
use std::sync::OnceLock;

/// The arguments of the program, its name included.
static CALLED: OnceLock<Vec<String>> = OnceLock::new();

/// Result of a command that ran without an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Success.
    Done,
    /// The command ran, but its check failed.
    Failed,
    /// The measured and the simulated data set of a diagnosis do not show the same scenes.
    NotTheSameScenes,
}

impl From<()> for End {
    fn from((): ()) -> Self {
        End::Done
    }
}

impl From<bool> for End {
    fn from(worked: bool) -> Self {
        if worked { End::Done } else { End::Failed }
    }
}

impl From<End> for u8 {
    fn from(end: End) -> Self {
        match end {
            End::Done => 0,
            End::Failed => crate::FAILURE,
            End::NotTheSameScenes => 3,
        }
    }
}

/// Declares an enum of commands and the module of each: `Name(module::Arguments) "one line of help";`. The arguments
/// have a method `run` that returns `()`, `bool` or [`End`].
macro_rules! commands {
    ($(#[$of_table:meta])* $table:ident: $($(#[$of:meta])* $name:ident($file:ident::$arguments:ident) $help:tt;)*) => {
        $(pub mod $file;)*

        $(#[$of_table])*
        #[derive(clap::Subcommand, Debug)]
        pub(crate) enum $table {
            $(
                #[doc = $help]
                $(#[$of])*
                $name($file::$arguments),
            )*
        }

        impl $table {
            /// Runs the command.
            pub(crate) fn run(self) -> anyhow::Result<$crate::commands::End> {
                match self {
                    $($table::$name(arguments) => Ok(arguments.run()?.into()),)*
                }
            }
        }
    };
}

/// Remembers the command as it is called, without `--errors`, which changes no result.
pub(crate) fn set_called(arguments: &[OsString]) {
    CALLED.get_or_init(|| {
        let mut words: Vec<String> = arguments.iter().map(|a| a.to_string_lossy().into_owned()).collect();
        let end = words.iter().position(|word| word == "--").unwrap_or(words.len());
        let own = words.split_off(end);
        if let Some(at) = words.iter().position(|word| word == "--errors") {
            words.drain(at..(at + 2).min(words.len()));
        }
        words.retain(|word| !word.starts_with("--errors="));
        words.into_iter().chain(own).collect()
    });
}

/// The command as it was called.
pub fn called() -> String {
    let arguments = CALLED.get().map_or(&[][..], Vec::as_slice);
    let words = arguments.iter().skip(1).map(String::as_str);
    std::iter::once("lidarshift").chain(words).collect::<Vec<_>>().join(" ")
}
