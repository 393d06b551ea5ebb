//! Executes the runs of a study on this machine, one process per run, as many in parallel as cores and memory allow.

use crate::config::StudyRun;
use crate::cost::{Costs, duration, remaining};
use crate::error::{InPart, Result};
use crate::folder::Study;
use crate::run_state::{RunLock, read_failure, write_failure};
use crate::work::RunPart;
use crate::{Event, Listener};
use data::output::create_folder;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};
use train::read_run_state;

/// How parallel runs share this machine.
#[derive(Clone, Debug)]
pub struct LocalJobs {
    /// Number of parallel processes.
    pub at_once: usize,
    /// Number of threads of each process.
    pub threads: usize,
    /// Command line arguments of the device for each process.
    pub device: Vec<String>,
    /// Names of the GPUs among which the processes are divided; empty: each process chooses.
    pub gpus: Vec<String>,
}

/// Environment variable that chooses the GPU of a process.
pub const GPU_VARIABLE: &str = "CUBECL_WGPU_DEFAULT_DEVICE";

/// Memory that is left free, MiB.
const SPARE_MIB: u64 = 512;

impl LocalJobs {
    /// Limits the number of parallel runs to the number of GPUs or, on the CPU, of cores, and divides the cores among
    /// them.
    pub fn by_cores(runs: usize, at_once: Option<usize>, device: &[String], gpus: &[String]) -> LocalJobs {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        // A GPU is used by one run at a time.
        let is_gpu = device.iter().any(|word| word == "wgpu" || word == "cuda");
        let most = if is_gpu { gpus.len().max(1) } else { cores };
        let at_once = at_once.unwrap_or(most.min(runs)).max(1);
        LocalJobs { at_once, threads: (cores / at_once).max(1), device: device.to_vec(), gpus: gpus.to_vec() }
    }

    /// The GPU with the fewest of the running processes, the first of equal ones.
    fn free_gpu(&self, running: impl Iterator<Item = Option<usize>> + Clone) -> Option<usize> {
        (0..self.gpus.len()).min_by_key(|&gpu| running.clone().filter(|used| *used == Some(gpu)).count())
    }

    /// Limits the number of parallel runs to what fits into the available memory.
    pub fn within_memory(mut self, costs: &Costs) -> LocalJobs {
        let largest = costs.values().map(|cost| cost.peak_mib).max().unwrap_or(0);
        if let (Some(free), true) = (free_mib(), largest > 0) {
            let fit = (free.saturating_sub(SPARE_MIB) / largest).max(1) as usize;
            self.at_once = self.at_once.min(fit);
        }
        self
    }
}

/// Available memory in MiB (Linux only).
pub fn free_mib() -> Option<u64> {
    let text = fs_err::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib / 1024)
}

/// A run and its process.
struct Job<'a> {
    run: &'a StudyRun,
    child: Child,
    /// Index of its GPU in [`LocalJobs::gpus`].
    gpu: Option<usize>,
}

/// Executes all runs; returns the failed ones with the reasons. The processes exit when this process ends.
///
/// # Errors
/// A process that cannot be started.
pub fn run_all(
    study: &Study,
    runs: &[StudyRun],
    parts: &[RunPart],
    jobs: &LocalJobs,
    costs: &Costs,
    listener: Listener<'_>,
) -> Result<Vec<(String, String)>> {
    let note = |text: String| listener(Event::Note(&text));
    let mut waiting: Vec<&StudyRun> = runs.iter().rev().collect();
    let (mut running, mut failed, mut done) = (Vec::<Job>::new(), Vec::new(), 0);
    let mut progress = Progress::new(study, runs, costs, jobs.at_once)?;
    while !(waiting.is_empty() && running.is_empty()) {
        while running.len() < jobs.at_once {
            // A run that is in use by another process waits.
            let free = waiting.iter().rposition(|run| !RunLock::is_held(&run.folder(&study.folder)));
            let Some(free) = free else { break };
            let run = waiting.remove(free);
            let gpu = jobs.free_gpu(running.iter().map(|job| job.gpu));
            let name = gpu.map(|gpu| jobs.gpus[gpu].as_str());
            note(format!("{run} started{}", name.map_or(String::new(), |name| format!(" on {name}"))));
            running.push(Job { run, child: start(study, run, parts, jobs, name)?, gpu });
        }
        std::thread::sleep(Duration::from_millis(100));
        let mut unfinished = Vec::new();
        for mut job in running {
            let Some(status) = job.child.try_wait()? else {
                unfinished.push(job);
                continue;
            };
            done += 1;
            match failure(study, job.run, status)? {
                Some(reason) => {
                    note(format!("{} failed: {reason}", job.run));
                    failed.push((job.run.to_string(), reason));
                }
                None => note(format!("{} finished ({done} of {})", job.run, runs.len())),
            }
        }
        running = unfinished;
        let running: Vec<&StudyRun> = running.iter().map(|job| job.run).collect();
        progress.line(study, &running, &waiting, costs)?.into_iter().for_each(&note);
    }
    Ok(failed)
}

fn start(study: &Study, run: &StudyRun, parts: &[RunPart], jobs: &LocalJobs, gpu: Option<&str>) -> Result<Child> {
    let folder = run.folder(&study.folder);
    create_folder(&folder)?;
    let log = || fs_err::OpenOptions::new().create(true).append(true).open(folder.join("log.txt"));
    let mut command = Command::new(current_program()?);
    command.arg("study-run").arg(&study.folder).args(["--attached", "--run", &run.to_string()]);
    command.args(["--parts", &parts_argument(parts)]).args(&jobs.device);
    command.env("RAYON_NUM_THREADS", jobs.threads.to_string());
    command.envs(gpu.map(|gpu| (GPU_VARIABLE, gpu)));
    command.stdin(Stdio::piped()).stdout(log()?.into_file()).stderr(log()?.into_file());
    command.spawn().in_part(|| format!("{run} could not be started"))
}

/// The program that is started for runs, if it is not the running one.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// Sets the program that is started for runs. For processes that contain the program instead of being it.
pub fn set_program(path: PathBuf) {
    PROGRAM.get_or_init(|| path);
}

/// Path of the running program. It stays valid if the file is replaced by a new build while a study runs (Linux).
pub fn current_program() -> std::io::Result<PathBuf> {
    if let Some(path) = PROGRAM.get() {
        return Ok(path.clone());
    }
    let path = std::env::current_exe()?;
    let running = Path::new("/proc/self/exe");
    Ok(if !path.is_file() && running.exists() { running.to_path_buf() } else { path })
}

/// Path of the program on the disk, for processes that start later.
pub(crate) fn program_path() -> std::io::Result<PathBuf> {
    PROGRAM.get().map_or_else(std::env::current_exe, |path| Ok(path.clone()))
}

/// The value of the command line option `--parts`.
pub fn parts_argument(parts: &[RunPart]) -> String {
    parts.iter().map(|part| part.argument()).collect::<Vec<_>>().join(",")
}

/// The error of a failed run. If its process has not written one, its exit status and the end of its log are used.
fn failure(study: &Study, run: &StudyRun, status: ExitStatus) -> Result<Option<String>> {
    if status.success() {
        return Ok(None);
    }
    let folder = run.folder(&study.folder);
    if let Some(reason) = read_failure(&folder) {
        return Ok(Some(reason));
    }
    let reason = match last_line(&folder.join("log.txt")) {
        Some(line) => format!("its process ended with {status}; the last line of its log.txt: {line}"),
        None => format!("its process ended with {status}"),
    };
    write_failure(&folder, &reason)?;
    Ok(Some(reason))
}

fn last_line(path: &Path) -> Option<String> {
    let bytes = fs_err::read(path).ok()?;
    String::from_utf8_lossy(&bytes).lines().rev().find(|line| !line.trim().is_empty()).map(String::from)
}

/// Reports the progress of all runs every 30 s.
struct Progress {
    began: Instant,
    last: Instant,
    every: Duration,
    at_once: usize,
    whole_s: f64,
}

impl Progress {
    fn new(study: &Study, runs: &[StudyRun], costs: &Costs, at_once: usize) -> Result<Self> {
        let now = Instant::now();
        let whole_s =
            runs.iter().map(|run| Ok(remaining(study, run, costs)?.seconds.unwrap_or(0.0))).sum::<Result<f64>>()?;
        Ok(Progress { began: now, last: now, every: Duration::from_secs(30), at_once, whole_s })
    }

    fn line(
        &mut self,
        study: &Study,
        running: &[&StudyRun],
        waiting: &[&StudyRun],
        costs: &Costs,
    ) -> Result<Option<String>> {
        if self.last.elapsed() < self.every || running.is_empty() {
            return Ok(None);
        }
        self.last = Instant::now();
        let mut remaining_s = 0.0;
        for run in running.iter().chain(waiting) {
            remaining_s += remaining(study, run, costs)?.seconds.unwrap_or(0.0);
        }
        // The step time measured in advance is corrected by the progress so far.
        let done_s = self.whole_s - remaining_s;
        let pace = if done_s > 0.05 * self.whole_s {
            self.began.elapsed().as_secs_f64() / done_s
        } else {
            1.0 / self.at_once as f64
        };
        let positions: Vec<String> = running
            .iter()
            .map(|run| {
                let state = read_run_state(&run.folder(&study.folder)).ok().flatten();
                state.map_or(format!("{run} starting"), |s| format!("{run} step {} of {}", s.step, s.total_steps))
            })
            .collect();
        let left = duration(remaining_s * pace);
        Ok(Some(format!("{}; {} waiting; about {left} remaining", positions.join(", "), waiting.len())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cost::NetworkCost;

    #[test]
    fn memory_limits_the_number_of_parallel_runs() {
        let jobs = LocalJobs { at_once: 4, threads: 1, device: Vec::new(), gpus: Vec::new() };
        let cost = |peak_mib| {
            let cost = NetworkCost { step_s: 1.0, detection_s: 1.0, peak_mib, threads: 1, device: "flex".into() };
            Costs::from([("a".to_string(), cost)])
        };
        assert_eq!(jobs.clone().within_memory(&cost(1 << 40)).at_once, 1);
        assert_eq!(jobs.clone().within_memory(&cost(0)).at_once, 4);
        assert_eq!(LocalJobs::by_cores(8, Some(3), &[], &[]).at_once, 3);
    }

    #[test]
    fn a_gpu_has_one_run() {
        let (device, gpus) = (["--device", "wgpu"].map(String::from), ["a", "b", "c"].map(String::from));
        let at_once = |runs, jobs, gpus: &[String]| LocalJobs::by_cores(runs, jobs, &device, gpus).at_once;
        assert_eq!([at_once(8, None, &gpus), at_once(2, None, &gpus), at_once(8, None, &[])], [3, 2, 1]);
        assert_eq!(at_once(8, Some(5), &gpus), 5, "as the user says");
        let jobs = LocalJobs::by_cores(8, None, &device, &gpus);
        let free = |running: &[usize]| jobs.free_gpu(running.iter().map(|&gpu| Some(gpu)));
        assert_eq!([free(&[]), free(&[0, 2]), free(&[0, 1, 2])], [Some(0), Some(1), Some(0)]);
        assert_eq!(LocalJobs { gpus: Vec::new(), ..jobs }.free_gpu([None].into_iter()), None);
    }

    #[test]
    fn parts_become_a_command_line_argument() {
        assert_eq!(parts_argument(&[RunPart::Train, RunPart::Detect]), "train,detect");
    }
}
