//! `lidarshift completions`: what a shell completes.

use anyhow::Result;
use clap::Args;
use clap_complete::Shell;

/// Print the completions of a shell. Where they are installed depends on the shell.
///
/// Examples:
///   lidarshift completions bash > ~/.local/share/bash-completion/completions/lidarshift
///   lidarshift completions fish > ~/.config/fish/completions/lidarshift.fish
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

impl CompletionsArgs {
    /// Prints the completions.
    pub fn run(self) -> Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut crate::command(), "lidarshift", &mut script);
        crate::out!("{}", String::from_utf8(script)?);
        Ok(())
    }
}
