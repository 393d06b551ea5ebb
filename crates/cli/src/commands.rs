//! The table of commands: how a command gets into the program.

use std::process::ExitCode;

/// How a command ended that could be carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// All of it worked.
    Done,
    /// It did not find what it should have found.
    Failed,
    /// A diagnosis whose two sides do not show the same scenes.
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

/// Declares an enum of commands and the file of each: `Name(file::Arguments) "one line of help";`. The arguments have a method `run`,
/// whose result says how the command ended: nothing, `bool` or [`End`].
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
            /// Carries the command out.
            pub(crate) fn run(self) -> anyhow::Result<$crate::commands::End> {
                match self {
                    $($table::$name(arguments) => Ok(arguments.run()?.into()),)*
                }
            }
        }
    };
}
