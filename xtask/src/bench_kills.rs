//! `cargo xtask bench kills`: ends commands by signals at random moments, repeats them and compares their files.

use crate::cargo;
use anyhow::{Context, Result, bail};
use std::path::Path;

/// The commands, which are tests of `crates/cli/tests/faults.rs`.
const COMMANDS: &[&str] = &["train", "simulate", "resim", "study", "diagnose", "twin", "convert"];

/// Number of signals for each command without a number.
const SIGNALS: &str = "200";

/// What the arguments ask for: the number of signals, and commands; without commands all.
fn parse(args: &[String]) -> Result<(&str, Vec<&str>)> {
    let (numbers, named): (Vec<&str>, Vec<&str>) =
        args.iter().map(String::as_str).partition(|arg| arg.parse::<u32>().is_ok());
    if let Some(unknown) = named.iter().find(|name| !COMMANDS.contains(name)) {
        bail!("{unknown} is no command of this benchmark; there are {}", COMMANDS.join(", "));
    }
    let number = match numbers[..] {
        [] => SIGNALS,
        [number] => number,
        _ => bail!("give one number of signals, not {}", numbers.join(" and ")),
    };
    Ok((number, if named.is_empty() { COMMANDS.to_vec() } else { named }))
}

/// Sends signals to each command (SIGKILL, SIGTERM and SIGINT in turn), at moments that are spread over its time.
/// `args`: the number of signals, and commands.
pub fn bench_kills(root: &Path, args: &[String]) -> Result<()> {
    let (number, commands) = parse(args)?;
    let mut failed = Vec::new();
    for command in commands {
        let mut tests = cargo(root);
        tests.args(["test", "--quiet", "--package", "lidarshift", "--test", "faults", "--", "--exact", command]);
        tests.args(["--nocapture"]).env("LIDARSHIFT_KILLS", number).env("LIDARSHIFT_FAULTS", "0");
        if !tests.status().context("could not start cargo")?.success() {
            failed.push(command);
        }
    }
    if !failed.is_empty() {
        bail!("files differ, or a command fails, after signals to {}", failed.join(", "));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_commands() {
        let parsed = |line: &str| {
            let args: Vec<String> = line.split_whitespace().map(String::from).collect();
            parse(&args).map(|(number, commands)| format!("{number} {}", commands.join(" "))).map_err(|e| e.to_string())
        };
        assert_eq!(parsed("").unwrap(), format!("200 {}", COMMANDS.join(" ")));
        assert_eq!(parsed("20 twin convert").unwrap(), "20 twin convert");
        assert_eq!(parsed("train").unwrap(), "200 train");
        assert!(parsed("3 4").is_err() && parsed("tran").unwrap_err().contains("tran is no command"));
    }
}
