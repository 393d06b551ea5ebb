//! `cargo xtask bench train [FILTER]`: training steps, inference and the most expensive layers, compared with the same
//! networks in PyTorch. Both sides run alternately.

use crate::program::{self, Program, output};
use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Environment variable with the path of a Python that has PyTorch.
pub(crate) const VARIABLE: &str = "LIDARSHIFT_PYTHON";

/// File in which the rows are kept.
const FILE: &str = "bench/train.json";

/// Number of alternating rounds.
const ROUNDS: usize = 3;

/// Timed steps per round.
const STEPS: usize = 3;

/// What is timed: id in row names, `bench-step --work` argument, and the references as (name, form).
type Work = (&'static str, &'static str, &'static [[&'static str; 2]]);

/// A kind of detector that is timed.
struct Network {
    /// Name in ids.
    name: &'static str,
    /// Size in ids, and the detector of that size.
    detectors: &'static [[&'static str; 2]],
    works: &'static [Work],
}

const NETWORKS: &[Network] = &[
    Network {
        name: "pointpillars",
        detectors: &[["published", "pointpillars"], ["small", "pointpillars_small"]],
        works: &[
            ("step", "step", &[["torch_as_openpcdet", "openpcdet"], ["torch_best", "best"]]),
            ("inference", "inference", &[["torch_as_openpcdet", "openpcdet"], ["torch_best", "best"]]),
            ("convolutions", "convolutions", &[["torch_nchw", "openpcdet"], ["torch_channels_last", "best"]]),
            ("pillar_net", "pillar-net", &[["torch_padded", "openpcdet"], ["torch_valid_points", "best"]]),
        ],
    },
    Network {
        name: "pointrcnn",
        detectors: &[["published", "pointrcnn"], ["small", "pointrcnn_small"]],
        works: &[("step", "step", &[["torch", "openpcdet"]])],
    },
    Network {
        name: "centerpoint",
        detectors: &[["published", "centerpoint"], ["small", "centerpoint_small"]],
        works: &[("step", "step", &[["torch_as_openpcdet", "openpcdet"]])],
    },
];

/// Timing compared with one reference.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Row {
    /// `network/size/work/batchB/threadsT/reference`.
    id: String,
    /// Median, ms.
    ours_ms: f64,
    /// Median, ms.
    reference_ms: f64,
    /// `ours_ms / reference_ms`.
    ratio: f64,
    /// Peak resident memory of the process, MiB; `None` if the system does not report it.
    ours_peak_mib: Option<u64>,
    /// Peak resident memory of the process including PyTorch's libraries, MiB.
    reference_peak_mib: Option<u64>,
}

#[derive(Serialize, Deserialize)]
struct Rows {
    schema: String,
    rows: Vec<Row>,
}

/// Output of one round.
#[derive(Clone, Debug, Deserialize)]
struct Turn {
    whole_ms: Vec<f64>,
    peak_mib: Option<u64>,
    /// Only reported by our side.
    #[serde(default)]
    median_ms: Vec<(String, f64)>,
}

/// One measurement: network, size, batch and number of threads, with its references.
struct Case {
    detector: &'static str,
    work: &'static str,
    batch: usize,
    threads: usize,
    /// Name and form.
    references: Vec<(String, &'static str)>,
}

/// Times the cases whose ids contain all of `filters`, and stores their rows in [`FILE`].
pub fn bench_train(root: &Path, filters: &[String]) -> Result<()> {
    let cases = cases(filters);
    ensure!(!cases.is_empty(), "no row id contains {}; an example of an id: {}", filters.join(" and "), example());
    let python = python()?;
    let program = program::build(root, Program::Checks, None)?;
    let mut measured = Vec::new();
    for case in cases {
        measured.extend(case.measure(root, &program, &python)?);
    }
    let file = root.join(FILE);
    let known = match fs_err::read(&file) {
        Ok(bytes) => serde_json::from_slice::<Rows>(&bytes).with_context(|| format!("{FILE} is damaged"))?.rows,
        Err(_) => Vec::new(),
    };
    print_table(&measured);
    write(&file, &Rows { schema: "lidarshift/bench-train/1".into(), rows: merged(known, measured) })
}

fn example() -> String {
    cases(&[])[0].references[0].0.clone()
}

fn cases(filters: &[String]) -> Vec<Case> {
    let mut cases = Vec::new();
    for Network { name: network, detectors, works } in NETWORKS {
        let pairs = detectors.iter().flat_map(|detector| works.iter().map(move |work| (detector, work)));
        for (&[size, detector], &(name, work, references)) in pairs {
            for (batch, threads) in [(1, 2), (1, 1), (4, 2), (4, 1)] {
                let id = |reference: &str| format!("{network}/{size}/{name}/batch{batch}/threads{threads}/{reference}");
                let all = references.iter().map(|&[reference, form]| (id(reference), form));
                let references: Vec<_> =
                    all.filter(|(id, _)| filters.iter().all(|filter| id.contains(filter))).collect();
                if !references.is_empty() {
                    cases.push(Case { detector, work, batch, threads, references });
                }
            }
        }
    }
    cases
}

impl Case {
    fn measure(&self, root: &Path, program: &Path, python: &Path) -> Result<Vec<Row>> {
        let Case { detector, work, batch, threads, references } = self;
        eprintln!("{detector}, {work}, batch {batch}, {threads} threads");
        let report = std::env::temp_dir().join(format!("lidarshift-bench-{}.json", std::process::id()));
        let (mut ours, mut theirs) = (Vec::new(), vec![Vec::new(); references.len()]);
        for _ in 0..ROUNDS {
            let mut step = Command::new(program);
            step.args(["bench-step", "--work", work, "--detector", detector, "--batch", &batch.to_string()]);
            step.args(["--steps", &STEPS.to_string(), "--json"]).arg(&report);
            step.env("RAYON_NUM_THREADS", threads.to_string()).current_dir(root);
            output(&mut step)?;
            ours.push(serde_json::from_slice::<Turn>(&fs_err::read(&report)?)?);
            for ((_, form), theirs) in references.iter().zip(&mut theirs) {
                let mut step = Command::new(python);
                step.arg(root.join("xtask/bench_train/step.py")).arg(&report);
                step.args(["--form", form, "--threads", &threads.to_string(), "--steps", &STEPS.to_string()]);
                step.env("OMP_NUM_THREADS", threads.to_string());
                theirs.push(serde_json::from_slice::<Turn>(&output(&mut step)?)?);
            }
        }
        fs_err::remove_file(&report)?;
        for (stage, ms) in ours.last().iter().flat_map(|turn| &turn.median_ms) {
            eprintln!("  {stage:<11} {ms:>9.1} ms");
        }
        let row = |((id, _), theirs): (&(String, &str), &Vec<Turn>)| Row::new(id, &ours, theirs);
        Ok(references.iter().zip(&theirs).map(row).collect())
    }
}

impl Row {
    fn new(id: &str, ours: &[Turn], theirs: &[Turn]) -> Self {
        let ms = |turns: &[Turn]| median(turns.iter().flat_map(|turn| turn.whole_ms.iter().copied()).collect());
        let peak = |turns: &[Turn]| turns.iter().filter_map(|turn| turn.peak_mib).max();
        let round = |value: f64, digits: f64| (value * digits).round() / digits;
        let (ours_ms, reference_ms) = (ms(ours), ms(theirs));
        Row {
            id: id.into(),
            ours_ms: round(ours_ms, 10.0),
            reference_ms: round(reference_ms, 10.0),
            ratio: round(ours_ms / reference_ms, 1000.0),
            ours_peak_mib: peak(ours),
            reference_peak_mib: peak(theirs),
        }
    }
}

pub(crate) fn median(values: Vec<f64>) -> f64 {
    statistics::median_upper(values).unwrap_or(f64::NAN)
}

/// Replaces rows with the same id by the new ones; sorted by id.
fn merged(known: Vec<Row>, measured: Vec<Row>) -> Vec<Row> {
    let kept = known.into_iter().filter(|row| measured.iter().all(|new| new.id != row.id));
    let mut rows: Vec<Row> = kept.chain(measured.iter().cloned()).collect();
    rows.sort_by(|a, b| a.id.cmp(&b.id));
    rows
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn print_table(rows: &[Row]) {
    println!(
        "| work | here, ms | reference, ms | ratio | memory here, MiB | reference, MiB |\n|---|---|---|---|---|---|"
    );
    for Row { id, ours_ms, reference_ms, ratio, ours_peak_mib, reference_peak_mib } in rows {
        let [ours, theirs] =
            [ours_peak_mib, reference_peak_mib].map(|peak| peak.map_or(String::new(), |p| p.to_string()));
        println!("| `{id}` | {ours_ms} | {reference_ms} | {ratio} | {ours} | {theirs} |");
    }
}

fn write(file: &Path, rows: &Rows) -> Result<()> {
    let folder = file.parent().context("a file in a folder")?;
    fs_err::create_dir_all(folder)?;
    let partial = file.with_extension("json.partial");
    fs_err::write(&partial, serde_json::to_string_pretty(rows)? + "\n")?;
    Ok(fs_err::rename(&partial, file)?)
}

/// The Python that has all requirements of the reference.
fn python() -> Result<PathBuf> {
    let python = PathBuf::from(std::env::var_os(VARIABLE).unwrap_or_else(|| "python3".into()));
    let imports = Command::new(&python).args(["-c", "import torch, numba, numpy"]).output();
    match imports {
        Ok(imports) if imports.status.success() => Ok(python),
        _ => bail!(
            "{} has no PyTorch to compare with: `python3 -m venv .venv && .venv/bin/pip install torch numba`, then \
             `{VARIABLE}=.venv/bin/python cargo xtask bench train` (on Linux `--index-url https://download.pytorch.org/whl/cpu` \
             in front of `torch` leaves CUDA out)",
            python.display()
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(id: &str, ours_ms: f64) -> Row {
        Row { id: id.into(), ours_ms, reference_ms: 2.0, ratio: 0.5, ours_peak_mib: Some(1), reference_peak_mib: None }
    }

    #[test]
    fn filters_choose_rows() {
        let ids = |filters: &[&str]| -> Vec<String> {
            let filters: Vec<String> = filters.iter().map(|&w| w.into()).collect();
            cases(&filters).into_iter().flat_map(|case| case.references).map(|(id, _)| id).collect()
        };
        assert_eq!(ids(&[]).len(), 80);
        assert_eq!(
            ids(&["pointrcnn/published", "batch1/threads2"]),
            ["pointrcnn/published/step/batch1/threads2/torch"]
        );
        assert_eq!(
            ids(&["pointpillars/published/step/batch1/threads2"]),
            ["torch_as_openpcdet", "torch_best"]
                .map(|name| format!("pointpillars/published/step/batch1/threads2/{name}"))
        );
        assert_eq!(ids(&["small/pillar_net", "batch4/threads1"]).len(), 2);
        assert!(ids(&["batch7"]).is_empty());
    }

    #[test]
    fn new_rows_replace_old_ones() {
        let rows = merged(vec![row("b", 1.0), row("c", 1.0)], vec![row("c", 3.0), row("a", 3.0)]);
        assert_eq!(rows, [row("a", 3.0), row("b", 1.0), row("c", 3.0)]);
    }

    #[test]
    fn medians_over_all_turns() {
        let turn = |whole_ms: &[f64], mib| Turn { whole_ms: whole_ms.to_vec(), peak_mib: Some(mib), median_ms: vec![] };
        let row = Row::new("x", &[turn(&[1.0, 9.0], 5), turn(&[2.0], 7)], &[turn(&[8.0], 100)]);
        assert_eq!((row.ours_ms, row.reference_ms, row.ratio), (2.0, 8.0, 0.25));
        assert_eq!((row.ours_peak_mib, row.reference_peak_mib), (Some(7), Some(100)));
    }
}
