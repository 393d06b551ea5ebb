//! How a command is added to the program, and how its result becomes an exit code.

use std::process::ExitCode;

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

impl From<End> for ExitCode {
    fn from(end: End) -> Self {
        match end {
            End::Done => ExitCode::SUCCESS,
            End::Failed => ExitCode::FAILURE,
            End::NotTheSameScenes => ExitCode::from(3),
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

/// The command as it was called.
pub fn called() -> String {
    std::iter::once("lidarshift".to_string())
        .chain(std::env::args_os().skip(1).map(|a| a.to_string_lossy().into_owned()))
        .collect::<Vec<_>>()
        .join(" ")
}
