//! The runs of a study on a Slurm cluster: a job array to train, one to detect, and the report behind both.

use crate::config::StudyRun;
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::steps::{RunOptions, Step};
use crate::{Event, Listener};
use data::write_atomic;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Submits what is missing. Task K of the training works on run K of a list; task K of the detection begins when task K of the training has
/// ended well; the report begins when all tasks have ended, however they did, and shows those that failed.
///
/// # Errors
/// No Slurm on this machine, or a submission that it refuses.
pub fn submit(study: &Study, missing: &[StudyRun], options: &RunOptions, listener: Listener<'_>) -> Result<()> {
    let RunOptions { steps, device, sbatch, .. } = options;
    let result = |text: String| listener(Event::Result(&text));
    let waiting = queued(study)?;
    let runs: Vec<&StudyRun> = missing.iter().filter(|run| !waiting.contains(&run.to_string())).collect();
    if runs.len() < missing.len() {
        result(format!("{} runs are in Slurm's queue already", missing.len() - runs.len()));
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
        for (step, word) in [(Step::Train, "train"), (Step::Detect, "detect")] {
            if !steps.contains(&step) {
                continue;
            }
            let mut words = vec![array.clone()];
            words.extend(last.as_ref().map(|id| format!("--dependency=aftercorr:{id}")));
            let id = submission.submit(word, &task(word), &words)?;
            result(format!("{word}: job {id}, {} tasks", names.len()));
            last = Some(id);
        }
        record(study, last.as_deref().unwrap_or_default(), &list)?;
    }
    if steps.contains(&Step::Report) {
        let text = format!("exec {} report {}", submission.program, quoted(&study.folder.display().to_string()));
        let ids = jobs(study)?;
        let words: Vec<String> = match ids.is_empty() {
            true => Vec::new(),
            false => vec![format!("--dependency=afterany:{}", ids.join(":"))],
        };
        let id = submission.submit("report", &text, &words)?;
        result(format!("report: job {id}"));
    }
    result(format!(
        "`lidarshift study status {}` says where they stand; logs lie in {}",
        study.named,
        submission.folder.display()
    ));
    Ok(())
}

/// A folder of scripts and logs.
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
        fs_err::create_dir_all(&folder)?;
        let program = quoted(&std::env::current_exe()?.display().to_string());
        let device: Vec<String> = device.iter().map(|word| quoted(word)).collect();
        Ok(Submission { folder, program, device: device.join(" "), name: &study.config.name, sbatch })
    }

    /// Writes the script and gives it to Slurm; the number of the job.
    fn submit(&self, word: &str, text: &str, words: &[String]) -> Result<String> {
        let script = self.folder.join(format!("{word}.sh"));
        let log = self.folder.join(if words.iter().any(|w| w.starts_with("--array")) {
            format!("{word}-%A_%a.log")
        } else {
            format!("{word}-%j.log")
        });
        // As many threads as Slurm gives cores.
        let threads = "export RAYON_NUM_THREADS=\"${SLURM_CPUS_PER_TASK:-$(nproc)}\"";
        write_atomic(&script, format!("#!/bin/sh\n{threads}\n{text}\n").as_bytes())?;
        let mut command = Command::new("sbatch");
        command.arg("--parsable").arg(format!("--job-name={}-{word}", self.name));
        // A job whose dependency can no longer come true would wait for ever.
        command.arg("--kill-on-invalid-dep=yes").arg("--output").arg(&log).args(words).args(self.sbatch).arg(&script);
        let said = answer(&mut command)?;
        // "123" or "123;cluster".
        Ok(said.trim().split(';').next().unwrap_or_default().to_string())
    }
}

/// What a command of Slurm says.
fn answer(command: &mut Command) -> Result<String> {
    let name = command.get_program().to_string_lossy().into_owned();
    let output = match command.output() {
        Ok(output) => output,
        Err(e) if e.kind() == ErrorKind::NotFound => {
            return Err(refused(format!(
                "there is no {name} on this machine: --launcher slurm needs Slurm's client programs; --launcher local works without"
            )));
        }
        Err(e) => return Err(e).in_part(|| format!("{name} could not be started")),
    };
    if !output.status.success() {
        return Err(refused(format!("{name}: {}", String::from_utf8_lossy(&output.stderr).trim())));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Jobs that were submitted for a study: number and list of runs, a line each.
fn book(study: &Study) -> PathBuf {
    study.folder.join("slurm/jobs.txt")
}

fn record(study: &Study, job: &str, list: &Path) -> Result<()> {
    let mut text = fs_err::read_to_string(book(study)).unwrap_or_default();
    text += &format!("{job} {}\n", list.display());
    Ok(write_atomic(&book(study), text.as_bytes())?)
}

/// Tasks of our jobs that wait or run: job and number of the task.
fn tasks(study: &Study) -> Result<Vec<(String, usize, PathBuf)>> {
    let text = fs_err::read_to_string(book(study)).unwrap_or_default();
    // Also the question whether there is a Slurm at all.
    let queue = answer(Command::new("squeue").args(["--noheader", "--array", "--format=%F %K"]))?;
    let mut tasks = Vec::new();
    for (job, list) in text.lines().filter_map(|line| line.split_once(' ')) {
        for line in queue.lines() {
            let mut words = line.split_whitespace();
            if words.next() == Some(job)
                && let Some(task) = words.next().and_then(|word| word.parse().ok())
            {
                tasks.push((job.to_string(), task, PathBuf::from(list)));
            }
        }
    }
    Ok(tasks)
}

/// Names of the runs that wait or run in Slurm's queue.
fn queued(study: &Study) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for (_, task, list) in tasks(study)? {
        names.extend(fs_err::read_to_string(&list)?.lines().nth(task).map(String::from));
    }
    Ok(names)
}

/// Our jobs of which a task waits or runs.
fn jobs(study: &Study) -> Result<Vec<String>> {
    let mut jobs: Vec<String> = tasks(study)?.into_iter().map(|(job, ..)| job).collect();
    jobs.dedup();
    Ok(jobs)
}

/// A word as the shell reads it.
fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_survive_the_shell() {
        let word = "a b'c$d";
        let output = Command::new("sh").arg("-c").arg(format!("printf %s {}", quoted(word))).output().unwrap();
        assert_eq!(String::from_utf8(output.stdout).unwrap(), word);
    }

    #[test]
    fn a_missing_program_is_named() {
        let error = answer(&mut Command::new("no-such-sbatch")).unwrap_err().to_string();
        assert!(error.contains("no-such-sbatch") && error.contains("--launcher local"), "{error}");
    }
}
