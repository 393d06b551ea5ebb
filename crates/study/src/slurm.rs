//! Submits the runs of a study to Slurm: one job array for training, one for detection, and one job for the report.

use crate::config::StudyRun;
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::steps::{RunOptions, Step};
use crate::{Event, Listener};
use data::output::create_folder;
use data::write_atomic;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Submits the missing runs. Task K of the training array executes run K of a list. Task K of the detection array
/// starts after task K of the training array has succeeded. The report starts after all tasks have ended, with or
/// without an error, and shows the failed ones.
///
/// # Errors
/// No Slurm on this machine, or a rejected submission.
pub fn submit(study: &Study, missing: &[StudyRun], options: &RunOptions, listener: Listener<'_>) -> Result<()> {
    let RunOptions { steps, device, sbatch, .. } = options;
    let result = |text: String| listener(Event::Result(&text));
    let queued = queued(study)?;
    let runs: Vec<&StudyRun> = missing.iter().filter(|run| !queued.contains(&run.to_string())).collect();
    if runs.len() < missing.len() {
        result(format!("{} runs are already in the queue of Slurm", missing.len() - runs.len()));
    }
    let submission = Submission::new(study, device, sbatch)?;
    let mut last = None;
    if !runs.is_empty() {
        let names: Vec<String> = runs.iter().map(ToString::to_string).collect();
        let list = submission.folder.join("runs.txt");
        write_atomic(&list, (names.join("\n") + "\n").as_bytes())?;
        let array = format!("--array=0-{}", names.len() - 1);
        let task = |parts: &str| {
            format!(
                "run=$(sed -n \"$((SLURM_ARRAY_TASK_ID + 1))p\" {})\nexec {} study-run {} --run \"$run\" --parts {parts} {}",
                quoted(&list.display().to_string()),
                submission.program,
                quoted(&study.folder.display().to_string()),
                submission.device
            )
        };
        for (step, part) in [(Step::Train, "train"), (Step::Detect, "detect")] {
            if !steps.contains(&step) {
                continue;
            }
            let mut sbatch_options = vec![array.clone()];
            sbatch_options.extend(last.as_ref().map(|id| format!("--dependency=aftercorr:{id}")));
            let id = submission.submit(part, &task(part), &sbatch_options)?;
            result(format!("{part}: job {id}, {} tasks", names.len()));
            last = Some(id);
        }
        record(study, last.as_deref().unwrap_or_default(), &list)?;
    }
    if steps.contains(&Step::Report) {
        let text = format!("exec {} report {}", submission.program, quoted(&study.folder.display().to_string()));
        let ids = jobs(study)?;
        let sbatch_options: Vec<String> = match ids.is_empty() {
            true => Vec::new(),
            false => vec![format!("--dependency=afterany:{}", ids.join(":"))],
        };
        let id = submission.submit("report", &text, &sbatch_options)?;
        result(format!("report: job {id}"));
    }
    result(format!(
        "`lidarshift study status {}` shows the state of the runs; logs are in {}",
        study.named,
        submission.folder.display()
    ));
    Ok(())
}

/// Scripts, logs and common options of a submission.
struct Submission<'a> {
    folder: PathBuf,
    program: String,
    device: String,
    name: &'a str,
    sbatch: &'a [String],
}

impl<'a> Submission<'a> {
    fn new(study: &'a Study, device: &[String], sbatch: &'a [String]) -> Result<Self> {
        let all = study.folder.join("slurm");
        let number = (1..).find(|n| !all.join(n.to_string()).exists()).unwrap_or(1);
        let folder = all.join(number.to_string());
        create_folder(&folder)?;
        let program = quoted(&crate::local::program_path()?.display().to_string());
        let device: Vec<String> = device.iter().map(|argument| quoted(argument)).collect();
        Ok(Submission { folder, program, device: device.join(" "), name: &study.config.name, sbatch })
    }

    /// Writes the script and submits it; returns the job id.
    fn submit(&self, name: &str, text: &str, options: &[String]) -> Result<String> {
        let script = self.folder.join(format!("{name}.sh"));
        let log = self.folder.join(if options.iter().any(|o| o.starts_with("--array")) {
            format!("{name}-%A_%a.log")
        } else {
            format!("{name}-%j.log")
        });
        // One thread per core that Slurm assigns.
        let threads = "export RAYON_NUM_THREADS=\"${SLURM_CPUS_PER_TASK:-$(nproc)}\"";
        write_atomic(&script, format!("#!/bin/sh\n{threads}\n{text}\n").as_bytes())?;
        let mut command = Command::new("sbatch");
        command.arg("--parsable").arg(format!("--job-name={}-{name}", self.name));
        // Otherwise a job whose dependency has failed would wait forever.
        command.arg("--kill-on-invalid-dep=yes").arg("--output").arg(&log);
        // A task that Slurm pre-empts is repeated, and its log continued.
        command.args(["--requeue", "--open-mode=append"]).args(options).args(self.sbatch).arg(&script);
        let output = run_command(&mut command)?;
        // "123" or "123;cluster".
        Ok(output.trim().split(';').next().unwrap_or_default().to_string())
    }
}

/// Runs a Slurm command and returns its stdout.
fn run_command(command: &mut Command) -> Result<String> {
    let name = command.get_program().to_string_lossy().into_owned();
    let output = match command.output() {
        Ok(output) => output,
        Err(e) if e.kind() == ErrorKind::NotFound => {
            return Err(refused(format!(
                "there is no {name} on this machine; --launcher slurm needs Slurm's client programs, --launcher local does not"
            )));
        }
        Err(e) => return Err(e).in_part(|| format!("{name} could not be started")),
    };
    if !output.status.success() {
        return Err(refused(format!("{name}: {}", String::from_utf8_lossy(&output.stderr).trim())));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// File with the submitted jobs of a study: job id and list of runs, one job per line.
fn jobs_file(study: &Study) -> PathBuf {
    study.folder.join("slurm/jobs.txt")
}

fn record(study: &Study, job: &str, list: &Path) -> Result<()> {
    let mut text = fs_err::read_to_string(jobs_file(study)).unwrap_or_default();
    text += &format!("{job} {}\n", list.display());
    Ok(write_atomic(&jobs_file(study), text.as_bytes())?)
}

/// Pending and running tasks of the jobs of a study: job id, task number and list of runs.
fn tasks(study: &Study) -> Result<Vec<(String, usize, PathBuf)>> {
    let text = fs_err::read_to_string(jobs_file(study)).unwrap_or_default();
    // This also fails if there is no Slurm.
    let queue = run_command(Command::new("squeue").args(["--noheader", "--array", "--format=%F %K"]))?;
    let mut tasks = Vec::new();
    for (job, list) in text.lines().filter_map(|line| line.split_once(' ')) {
        for line in queue.lines() {
            let mut fields = line.split_whitespace();
            if fields.next() == Some(job)
                && let Some(task) = fields.next().and_then(|field| field.parse().ok())
            {
                tasks.push((job.to_string(), task, PathBuf::from(list)));
            }
        }
    }
    Ok(tasks)
}

/// Names of the pending and running runs.
fn queued(study: &Study) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for (_, task, list) in tasks(study)? {
        names.extend(fs_err::read_to_string(&list)?.lines().nth(task).map(String::from));
    }
    Ok(names)
}

/// Job ids with a pending or running task.
fn jobs(study: &Study) -> Result<Vec<String>> {
    let mut jobs: Vec<String> = tasks(study)?.into_iter().map(|(job, ..)| job).collect();
    jobs.dedup();
    Ok(jobs)
}

/// An argument quoted for the shell.
fn quoted(argument: &str) -> String {
    format!("'{}'", argument.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quoted_arguments_pass_the_shell_unchanged() {
        let argument = "a b'c$d";
        let output = Command::new("sh").arg("-c").arg(format!("printf %s {}", quoted(argument))).output().unwrap();
        assert_eq!(String::from_utf8(output.stdout).unwrap(), argument);
    }

    #[test]
    fn a_missing_program_is_named() {
        let error = run_command(&mut Command::new("no-such-sbatch")).unwrap_err().to_string();
        assert!(error.contains("no-such-sbatch") && error.contains("--launcher local"), "{error}");
    }
}
