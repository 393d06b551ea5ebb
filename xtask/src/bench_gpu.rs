//! `cargo xtask bench gpu`: the networks on the GPU of this machine. Parity with the reference, then the training step
//! of each network by stage, at batch sizes that grow fourfold until the memory or the patience ends, with PyTorch
//! beside it where it is installed with CUDA. Writes `gpu.json` and a page, again after each detector.

use crate::bench_train::{VARIABLE, median};
use crate::program::{self, Program, output};
use anyhow::{Result, bail, ensure};
use clap::Parser;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Folders of reference numbers for the parity, in `tests/golden/synthetic`.
const PARITY: [&str; 3] = ["pointpillars_tiny", "centerpoint_tiny", "pointrcnn_tiny"];

/// Detectors that are timed.
const DETECTORS: [&str; 3] = ["pointpillars", "centerpoint", "pointrcnn"];

/// Batch sizes stop growing once a step takes longer, ms.
const PATIENCE_MS: f64 = 4000.0;

/// Time the networks on the GPU of this machine.
#[derive(Parser, Debug)]
#[command(name = "cargo xtask bench gpu --")]
struct GpuArgs {
    /// Cargo features that the program is built with, besides `wgpu`
    #[arg(long, value_delimiter = ',', default_value = "vulkan")]
    features: Vec<String>,
    /// A built `lidarshift-checks` that is used instead of building one
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// Detectors: names or TOML files
    #[arg(long, value_delimiter = ',')]
    detectors: Vec<String>,
    /// Largest batch size
    #[arg(long, default_value_t = 64)]
    most: usize,
    /// Timed steps of each case
    #[arg(long, default_value_t = 5)]
    steps: usize,
    /// Also on a rasteriser in software, to test this command; its times say nothing about GPUs
    #[arg(long)]
    software: bool,
    /// Folder for `gpu.json` and `gpu.md`
    #[arg(long, default_value = "bench")]
    out: PathBuf,
    /// Folder of the device files
    #[arg(long, default_value = "/dev", hide = true)]
    devices: PathBuf,
}

/// Precisions of this program that are timed: label and `--precision`.
const PRECISIONS: [[&str; 2]; 3] = [["lidarshift", "f32"], ["lidarshift, high", "high"], ["lidarshift, f16", "f16"]];

/// References: label, `--form` and `--precision` of `step.py`.
const REFERENCES: [[&str; 3]; 4] = [
    ["torch as OpenPCDet, TF32 convolutions", "openpcdet", "default"],
    ["torch as OpenPCDet, f32", "openpcdet", "f32"],
    ["torch at its best, TF32", "best", "tf32"],
    ["torch at its best, f16", "best", "f16"],
];

/// The files that are written.
const FILES: [&str; 2] = ["gpu.json", "gpu.md"];

/// Steps of the two runs whose kernels are counted. Autotuning is over before.
const COUNTED_STEPS: [usize; 2] = [1, 3];

/// What `lidarshift-checks adapters` prints.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Build {
    build: String,
    features: Vec<String>,
    adapters: Vec<Adapter>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Adapter {
    name: String,
    is_gpu: bool,
}

/// What `lidarshift-checks bench-step` and the PyTorch side report.
#[derive(Clone, Debug, Deserialize)]
struct Turn {
    whole_ms: Vec<f64>,
    #[serde(default)]
    in_memory_ms: Vec<f64>,
    #[serde(default)]
    median_ms: Vec<(String, f64)>,
    peak_mib: Option<u64>,
    device_mib: Option<u64>,
}

/// A network at one batch size.
#[derive(Clone, Debug, Serialize)]
struct Row {
    detector: String,
    batch: usize,
    /// This program or PyTorch, and the precision.
    by: String,
    /// Median of a step on a batch in memory, ms; `None` if it failed.
    step_ms: Option<f64>,
    /// Kernels that a step launches; of this program in f32 at batch 1.
    launches: Option<usize>,
    /// Median of each stage of a step that begins with clouds, ms; the device is waited for after each.
    stages_ms: Vec<(String, f64)>,
    /// Peak resident memory of the process, MiB.
    host_mib: Option<u64>,
    /// Memory reserved on the device, MiB.
    device_mib: Option<u64>,
    /// Why there are no times.
    failure: Option<String>,
}

#[derive(Serialize)]
struct Report {
    schema: &'static str,
    /// Seconds since 1970.
    measured_unix_s: u64,
    command: Vec<String>,
    system: String,
    build: Build,
    /// Folders of reference numbers that the device agrees with.
    parity: Vec<String>,
    rows: Vec<Row>,
    /// What was not measured and why.
    not_measured: Vec<String>,
}

/// Runs the command with its arguments.
///
/// # Errors
/// A machine without a GPU or a parity that fails: nothing is written. A network that fails at batch 1: what was
/// measured before is kept. Files that cannot be written.
pub fn bench_gpu(root: &Path, args: &[String]) -> Result<()> {
    let args = match GpuArgs::try_parse_from([&["gpu".to_string()], args].concat()) {
        Ok(args) => args,
        Err(error) => error.exit(),
    };
    if !args.software && !has_gpu(&args.devices) {
        bail!(
            "this machine has no GPU: there is neither nvidia*, kfd nor dri/renderD* in {}; nothing was measured and \
             nothing was written (--software tests this command on a rasteriser in software)",
            args.devices.display()
        );
    }
    let features = [vec!["wgpu".to_string()], args.features.clone()].concat().join(",");
    let program = match &args.program {
        Some(program) => fs_err::canonicalize(program)?,
        None => program::build(root, Program::Checks, Some(&features))?,
    };
    let build: Build = serde_json::from_slice(&output(Command::new(&program).arg("adapters"))?)?;
    let usable = build.adapters.iter().any(|adapter| adapter.is_gpu || args.software);
    ensure!(
        usable,
        "the device wgpu finds no GPU on this machine, but {:?}; nothing was measured and nothing was written",
        build.adapters.iter().map(|adapter| &adapter.name).collect::<Vec<_>>()
    );
    for network in PARITY {
        eprintln!("parity of {network}");
        let folder = root.join("tests/golden/synthetic").join(network);
        output(Command::new(&program).arg("parity").arg(folder).args(["--device", "wgpu"]))?;
    }
    let mut report = Report {
        schema: "lidarshift/bench-gpu/2",
        measured_unix_s: std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?.as_secs(),
        command: std::env::args().collect(),
        system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        build,
        parity: PARITY.map(String::from).to_vec(),
        rows: Vec::new(),
        not_measured: Vec::new(),
    };
    let python = python().map_err(|reason| report.not_measured.push(format!("PyTorch: {reason}"))).ok();
    let chosen = if args.detectors.is_empty() { DETECTORS.map(String::from).to_vec() } else { args.detectors.clone() };
    for detector in &chosen {
        measure(root, &program, python.as_deref(), detector, &args, |row| {
            report.rows.push(row);
            write(&root.join(&args.out), &report)
        })?;
    }
    for name in FILES {
        eprintln!("{}", root.join(&args.out).join(name).display());
    }
    Ok(())
}

/// Whether there is a device file of a GPU. On other systems than Linux there always is one.
fn has_gpu(devices: &Path) -> bool {
    let starts_with = |folder: &Path, start: &str| {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        entries.into_iter().any(|entry| entry.file_name().to_string_lossy().starts_with(start))
    };
    let found = ["nvidia", "kfd", "dxg"].into_iter().any(|start| starts_with(devices, start));
    !cfg!(target_os = "linux") || found || starts_with(&devices.join("dri"), "renderD")
}

/// Gives each row of one detector to `keep` when it is measured.
fn measure(
    root: &Path,
    program: &Path,
    python: Option<&Path>,
    detector: &str,
    args: &GpuArgs,
    mut keep: impl FnMut(Row) -> Result<()>,
) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("step.json");
    let steps = args.steps.to_string();
    let detector_file = fs_err::canonicalize(root.join(detector)).ok();
    for batch in std::iter::successors(Some(1), |batch| Some(4 * batch)).take_while(|&batch| batch <= args.most) {
        let of_program = |precision: &str, steps: &str| {
            let mut step = Command::new(program);
            step.args(["bench-step", "--device", "wgpu", "--precision", precision, "--steps", steps]);
            step.args(["--batch", &batch.to_string(), "--detector"]);
            step.arg(detector_file.as_deref().unwrap_or(Path::new(detector)));
            step.arg("--json").arg(&file).current_dir(folder.path());
            output(&mut step).and_then(|_| Ok(serde_json::from_slice::<Turn>(&fs_err::read(&file)?)?))
        };
        let mut is_end = false;
        let mut is_known = false;
        for [label, precision] in PRECISIONS {
            eprintln!("{detector}, batch {batch}, {label}");
            let turn = of_program(precision, &steps);
            let turn = if batch == 1 && precision == "f32" { Ok(turn?) } else { turn };
            is_known |= turn.is_ok();
            let mut row = Row::new(detector, batch, label, turn);
            is_end |= precision == "f32" && row.step_ms.is_none_or(|ms| ms > PATIENCE_MS);
            if batch == 1 && precision == "f32" {
                row.launches = Some(launches(folder.path(), |steps| of_program(precision, steps).map(drop))?);
            }
            keep(row)?;
        }
        let has_best = detector == "pointpillars";
        let references = REFERENCES.iter().filter(|[_, form, _]| has_best || *form == "openpcdet");
        for [label, form, precision] in references {
            // The report says how many points and pillars the reference gets.
            let Some(python) = python.filter(|_| is_known) else { continue };
            eprintln!("{detector}, batch {batch}, {label}");
            let mut step = Command::new(python);
            step.arg(root.join("xtask/bench_train/step.py")).arg(&file).args(["--form", form, "--steps", &steps]);
            let threads = std::thread::available_parallelism().map_or(1, usize::from);
            step.args(["--device", "cuda", "--precision", precision, "--threads", &threads.to_string()]);
            let turn = output(&mut step).and_then(|text| Ok(serde_json::from_slice::<Turn>(&text)?));
            keep(Row::new(detector, batch, label, turn))?;
        }
        if is_end {
            break;
        }
    }
    Ok(())
}

/// Kernels that a step launches: the difference of two runs, whose kernels burn's runtime lists in a file.
fn launches(folder: &Path, run: impl Fn(&str) -> Result<()>) -> Result<usize> {
    let (settings, log) = (folder.join("cubecl.toml"), folder.join("kernels.log"));
    let mut counts = [0; 2];
    for (count, steps) in counts.iter_mut().zip(COUNTED_STEPS) {
        fs_err::write(&settings, "[profiling.logger]\nlevel = \"minimal\"\nfile = \"kernels.log\"\n")?;
        let ran = run(&steps.to_string());
        fs_err::remove_file(&settings)?;
        ran?;
        *count = fs_err::read_to_string(&log)?.lines().count();
        fs_err::remove_file(&log)?;
    }
    // Each timed step is made twice, by stage and in memory.
    Ok(counts[1].saturating_sub(counts[0]) / (2 * (COUNTED_STEPS[1] - COUNTED_STEPS[0])))
}

impl Row {
    fn new(detector: &str, batch: usize, by: &str, turn: Result<Turn>) -> Self {
        let (turn, failure) = match turn {
            Ok(turn) => (Some(turn), None),
            Err(error) => (None, Some(format!("{error:#}").lines().last().unwrap_or_default().to_string())),
        };
        // Of PyTorch there are only steps in memory.
        let times =
            |turn: &Turn| if turn.in_memory_ms.is_empty() { &turn.whole_ms } else { &turn.in_memory_ms }.clone();
        Row {
            detector: detector.into(),
            batch,
            by: by.into(),
            step_ms: turn.as_ref().map(|turn| median(times(turn))),
            launches: None,
            host_mib: turn.as_ref().and_then(|turn| turn.peak_mib),
            device_mib: turn.as_ref().and_then(|turn| turn.device_mib),
            stages_ms: turn.map_or_else(Vec::new, |turn| turn.median_ms),
            failure,
        }
    }
}

/// The Python that has PyTorch with CUDA; the error says why there is none.
fn python() -> Result<PathBuf, String> {
    let python = PathBuf::from(std::env::var_os(VARIABLE).unwrap_or_else(|| "python3".into()));
    let test = "import torch; assert torch.cuda.is_available()";
    match Command::new(&python).args(["-c", test]).output() {
        Ok(output) if output.status.success() => Ok(python),
        _ => Err(format!("{} has none with CUDA ({VARIABLE} names another Python)", python.display())),
    }
}

fn write(folder: &Path, report: &Report) -> Result<()> {
    fs_err::create_dir_all(folder)?;
    for (name, text) in FILES.into_iter().zip([serde_json::to_string_pretty(report)? + "\n", page(report)]) {
        let partial = folder.join(format!("{name}.partial"));
        fs_err::write(&partial, text)?;
        fs_err::rename(&partial, folder.join(name))?;
    }
    Ok(())
}

/// The page.
fn page(report: &Report) -> String {
    let names: Vec<&str> = report.build.adapters.iter().map(|adapter| adapter.name.as_str()).collect();
    let mut page = format!(
        "# The networks on a GPU\n\n`{}`, {} ({}), build {} with {}. Parity holds for {}.\n",
        report.command.join(" "),
        names.join(", "),
        report.system,
        report.build.build,
        report.build.features.join(", "),
        report.parity.join(", ")
    );
    if report.build.adapters.iter().all(|adapter| !adapter.is_gpu) {
        page += "\nThere is no GPU: these are times of a rasteriser in software.\n";
    }
    page += "\nMedians of a training step on a batch in memory, ms. The stages are those of a step that begins with clouds; \
             the device is waited for after each. Memory in MiB.\n\n";
    page += "| detector | batch | by | step | samples/s | launches | on device | host | stages |\n";
    page += "|---|---|---|---|---|---|---|---|---|\n";
    for row in &report.rows {
        let number = |value: Option<f64>| value.map_or("not measured".into(), |value| format!("{value:.1}"));
        let mib = |value: Option<u64>| value.map_or(String::new(), |mib| mib.to_string());
        let stages = row.stages_ms.iter().filter(|(stage, _)| stage != "whole");
        let stages: Vec<String> = stages.map(|(stage, ms)| format!("{stage} {ms:.1}")).collect();
        page += &format!(
            "| `{}` | {} | {} | {} | {} | {} | {} | {} | {} |\n",
            row.detector,
            row.batch,
            row.by,
            number(row.step_ms),
            number(row.step_ms.map(|ms| 1e3 * row.batch as f64 / ms)),
            row.launches.map_or(String::new(), |launches| launches.to_string()),
            mib(row.device_mib),
            mib(row.host_mib),
            row.failure.clone().unwrap_or_else(|| stages.join(", "))
        );
    }
    for note in &report.not_measured {
        page += &format!("\nNot measured: {note}.\n");
    }
    page
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn device_files_of_gpus() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, "").unwrap();
            path
        };
        file("null");
        file("dri/card0");
        assert!(!has_gpu(folder.path()) && !has_gpu(&folder.path().join("absent")));
        for name in ["nvidia0", "kfd", "dri/renderD128"] {
            let path = file(name);
            assert!(has_gpu(folder.path()), "{name}");
            std::fs::remove_file(path).unwrap();
        }
    }

    #[test]
    fn failures_are_rows_without_times() {
        let turn = Turn {
            whole_ms: vec![30.0, 10.0, 20.0],
            in_memory_ms: vec![3.0, 1.0, 2.0],
            median_ms: vec![("backbone".into(), 1.25), ("whole".into(), 2.0)],
            peak_mib: Some(5),
            device_mib: Some(7),
        };
        let failed = Row::new("pointrcnn", 8, "lidarshift", Err(anyhow::anyhow!("a\nout of memory")));
        let build = Build { build: "0.1.0+x".into(), features: vec!["wgpu".into()], adapters: Vec::new() };
        let report = Report {
            schema: "",
            measured_unix_s: 0,
            command: vec!["bench".into()],
            system: "linux".into(),
            build,
            parity: vec!["pointpillars_tiny".into()],
            rows: vec![Row::new("pointpillars", 4, "lidarshift", Ok(turn)), failed],
            not_measured: vec!["PyTorch: none".into()],
        };
        let page = page(&report);
        for line in [
            "| `pointpillars` | 4 | lidarshift | 2.0 | 2000.0 |  | 7 | 5 | backbone 1.2 |",
            "| `pointrcnn` | 8 | lidarshift | not measured | not measured |  |  |  | out of memory |",
            "There is no GPU",
            "Not measured: PyTorch: none.",
        ] {
            assert!(page.contains(line), "{line}: {page}");
        }
    }
}
