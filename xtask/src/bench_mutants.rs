//! `cargo xtask bench mutants [FILTER]`: mutation test of the diagnosis. Each mutant of `tests/blind/mutants.toml`
//! changes one place in a copy of the sources; the same blind cases are diagnosed with and without the change.

use crate::cargo;
use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The list of mutants.
const FILE: &str = "tests/blind/mutants.toml";

/// Frames per case.
const FRAMES: &str = "40";
const SHOTS: &str = "12000";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    /// Kinds of the cases, one case each.
    kinds: Vec<String>,
    /// Seed of the first case.
    first_seed: u64,
    mutant: Vec<Mutant>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Mutant {
    /// Description of the defect.
    breaks: String,
    /// The changed file.
    file: PathBuf,
    /// The original code, which must occur exactly once.
    from: String,
    to: String,
}

impl Mutant {
    /// Applies the mutant to the text of its file.
    fn broken(&self, text: &str) -> Result<String> {
        let found = text.matches(&self.from).count();
        ensure!(found == 1, "{FILE}: `{}` occurs {found} times in {}, not once", self.from, self.file.display());
        Ok(text.replace(&self.from, &self.to))
    }
}

fn list(root: &Path) -> Result<List> {
    let text = fs_err::read_to_string(root.join(FILE))?;
    toml::from_str(&text).with_context(|| FILE.to_owned())
}

/// Score of a set of cases.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Score {
    /// Number of cases answered correctly.
    right: usize,
    /// Number of parameters whose interval contains the true value.
    inside: usize,
}

/// Summary written by the blind bench.
#[derive(Deserialize)]
struct Summary {
    grades: BTreeMap<String, BTreeMap<String, usize>>,
    /// By parameter: number of cases, fraction inside the interval, and more.
    parameters: BTreeMap<String, Vec<Option<f64>>>,
}

impl Summary {
    fn score(&self) -> Score {
        let good = |kind: &str, grade: &str| {
            matches!(grade, "right" | "clean" | "refused") || kind == "off_catalogue" && grade == "unexplained"
        };
        let grades =
            self.grades.iter().flat_map(|(kind, grades)| grades.iter().map(move |(grade, n)| (kind, grade, n)));
        let inside = |p: &Vec<Option<f64>>| (p[0].unwrap_or(0.0) * p[1].unwrap_or(0.0)).round() as usize;
        Score {
            right: grades.filter(|(kind, grade, _)| good(kind, grade)).map(|(.., n)| n).sum(),
            inside: self.parameters.values().map(inside).sum(),
        }
    }
}

/// Runs all mutants whose description contains one of the filters, and prints the scores.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub fn bench_mutants(root: &Path, filters: &[String]) -> Result<()> {
    let list = list(root)?;
    let wanted = |m: &&Mutant| filters.is_empty() || filters.iter().any(|f| m.breaks.contains(f.as_str()));
    let mutants: Vec<&Mutant> = list.mutant.iter().filter(wanted).collect();
    ensure!(!mutants.is_empty(), "no mutant matches; available: {}", descriptions(&list));
    let folder = root.join("target/mutants");
    let tree = folder.join("tree");
    copy_sources(root, &tree)?;
    // Generated anew: the generator may have changed.
    let pairs = folder.join("pairs");
    if pairs.exists() {
        fs_err::remove_dir_all(&pairs)?;
    }
    let whole = run(&tree, &folder, &list)?;
    println!("unchanged diagnosis: {} cases right, {} parameters inside their interval", whole.right, whole.inside);
    let mut unnoticed = Vec::new();
    for mutant in mutants {
        let path = tree.join(&mutant.file);
        let text = fs_err::read_to_string(&path)?;
        fs_err::write(&path, mutant.broken(&text)?)?;
        let score = run(&tree, &folder, &list);
        fs_err::write(&path, text)?;
        let score = score.with_context(|| mutant.breaks.clone())?;
        let fell = score.right + score.inside < whole.right + whole.inside;
        let result = if fell { "noticed" } else { "NOT NOTICED" };
        println!("{result}: {}: {} right, {} inside", mutant.breaks, score.right, score.inside);
        if !fell {
            unnoticed.push(mutant.breaks.as_str());
        }
    }
    if !unnoticed.is_empty() {
        bail!("not noticed by the blind cases: {}", unnoticed.join("; "));
    }
    Ok(())
}

fn descriptions(list: &List) -> String {
    list.mutant.iter().map(|m| m.breaks.as_str()).collect::<Vec<_>>().join("; ")
}

/// Copies the files that are tracked or would be added by git; unchanged files are kept, to limit recompilation.
fn copy_sources(root: &Path, tree: &Path) -> Result<()> {
    let mut git = Command::new("git");
    git.current_dir(root).args(["ls-files", "-z", "--cached", "--others", "--exclude-standard"]);
    let listed = git.output().context("could not run git ls-files")?;
    ensure!(listed.status.success(), "git ls-files: {}", String::from_utf8_lossy(&listed.stderr));
    for name in String::from_utf8(listed.stdout)?.split('\0').filter(|n| !n.is_empty()) {
        // Listed by git, but deleted since the last commit.
        let Ok(content) = std::fs::read(root.join(name)) else { continue };
        let to = tree.join(name);
        if std::fs::read(&to).is_ok_and(|old| old == content) {
            continue;
        }
        fs_err::create_dir_all(to.parent().context("a folder")?)?;
        fs_err::write(&to, content)?;
    }
    Ok(())
}

/// Builds the sources in `tree` and diagnoses the cases.
fn run(tree: &Path, folder: &Path, list: &List) -> Result<Score> {
    let out = folder.join("out");
    if out.exists() {
        fs_err::remove_dir_all(&out)?;
    }
    let mut command = cargo(tree);
    command.env("CARGO_TARGET_DIR", folder.join("target")).env("CARGO_PROFILE_BENCH_INCREMENTAL", "true");
    command.args(["bench", "--quiet", "--package", "lidarshift-blind", "--bench", "blind", "--"]);
    for kind in &list.kinds {
        command.args(["--kind", kind]);
    }
    let n = list.kinds.len() as u64;
    // The kind of a case is given by its seed modulo the number of kinds.
    let first = list.first_seed.next_multiple_of(n).to_string();
    command
        .args(["--first", &first, "--cases", &n.to_string(), "--frames", FRAMES, "--shots", SHOTS, "--out"])
        .arg(&out);
    command.arg("--keep").arg(folder.join("pairs")).stdout(std::process::Stdio::null());
    ensure!(command.status()?.success(), "the blind bench failed");
    let summary: Summary = serde_json::from_slice(&fs_err::read(out.join("summary.json"))?)?;
    Ok(summary.score())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mutant_changes_one_place_of_the_sources() {
        let root = crate::root();
        let list = list(&root).unwrap();
        for mutant in &list.mutant {
            let text = fs_err::read_to_string(root.join(&mutant.file)).unwrap();
            assert_ne!(mutant.broken(&text).unwrap(), text);
        }
        let gone = Mutant { from: "no such line".into(), ..list.mutant.into_iter().next().unwrap() };
        assert!(gone.broken("").unwrap_err().to_string().contains("occurs 0 times"));
    }

    #[test]
    fn scores_count_right_answers_and_intervals_that_hold() {
        let text = r#"{"grades": {"null": {"clean": 2, "false alarm": 1}, "single": {"right": 3, "wrong name": 1, "unexplained": 1},
            "off_catalogue": {"unexplained": 1}},
            "parameters": {"a": [4.0, 0.75, null], "b": [1.0, 0.0]}, "closed": 0.9}"#;
        let summary: Summary = serde_json::from_str(text).unwrap();
        assert_eq!(summary.score(), Score { right: 6, inside: 3 });
    }
}
