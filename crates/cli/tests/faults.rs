//! Each operation on files fails once: creating, writing, renaming, syncing, removing, opening, reading. The program
//! then ends with an error that names the file, or with all its results. The same command afterwards completes, and its
//! files are the same bytes.
//!
//! Signals at random moments end the program as well, and so do limits of its memory. The same command afterwards gives
//! the same bytes.
//!
//! A library between the program and the C library counts the operations and makes one fail (`faults/interpose.rs`).
//! `cargo test` tries a sample of them. `LIDARSHIFT_FAULTS=all` tries all, a number that many of each command.
//! `LIDARSHIFT_KILLS` is the number of signals for each command, `LIDARSHIFT_MEMORY` that of limits of the memory.
#![cfg(target_os = "linux")]

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;
#[path = "../../twin/tests/room/mod.rs"]
#[allow(dead_code, reason = "each test file uses a part of it")]
mod room;

use data::stream;
use program::{data_set, output_text, program, small_study};
use rand::RngExt;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::Instant;

/// The classes of operations, as in `faults/interpose.rs`.
const CLASSES: [&str; 13] = [
    "create", "write", "rename", "sync", "mkdir", "remove", "truncate", "lock", "open", "read", "stat", "list",
    "change",
];
/// Size of the file with the counts, and where the path of the failed operation is in it.
const COUNTS: (usize, usize) = (8192, 4096);

const EINTR: i32 = 4;
const EIO: i32 = 5;
const ENOSPC: i32 = 28;
const ESTALE: i32 = 116;

/// What happens to an operation.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Action {
    /// It fails with this error number.
    Error(i32),
    /// It fails with this error number, and so do all of its class after it.
    ErrorFromHere(i32),
    /// It reads or writes one byte.
    Short,
    /// The process is killed before it.
    Kill,
}

/// What is tried for each class of operations.
const TRIALS: &[(&str, Action)] = &[
    ("create", Action::Error(EIO)),
    ("create", Action::ErrorFromHere(ENOSPC)),
    ("create", Action::Error(EINTR)),
    ("write", Action::Error(EIO)),
    ("write", Action::ErrorFromHere(ENOSPC)),
    ("write", Action::Error(EINTR)),
    ("write", Action::Short),
    ("rename", Action::Error(EIO)),
    ("rename", Action::ErrorFromHere(ENOSPC)),
    ("sync", Action::Error(EIO)),
    ("sync", Action::Error(EINTR)),
    ("mkdir", Action::Error(EIO)),
    ("remove", Action::Error(EIO)),
    ("truncate", Action::Error(EIO)),
    ("lock", Action::Error(EIO)),
    ("open", Action::Error(ESTALE)),
    ("open", Action::Error(EINTR)),
    ("read", Action::Error(ESTALE)),
    ("read", Action::Error(EINTR)),
    ("read", Action::Short),
    ("stat", Action::Error(ESTALE)),
    ("list", Action::Error(ESTALE)),
    ("change", Action::Kill),
];

/// A command whose operations fail.
struct Case {
    name: &'static str,
    /// Writes what the command reads.
    prepare: fn(&Path),
    command: &'static str,
    /// The command after a failure.
    again: &'static str,
    /// Files that differ from run to run: times, paths of temporary files.
    varying: &'static [&'static str],
}

/// The library, compiled once.
fn library() -> &'static Path {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(|| {
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/faults/interpose.rs");
        let built = Path::new(env!("CARGO_TARGET_TMPDIR")).join("libinterpose.so");
        // Other processes of tests may do the same now.
        let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let partial = folder.path().join("libinterpose.so");
        let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
        let mut command = Command::new(rustc);
        command.args(["--edition", "2024", "-O", "--crate-type", "cdylib", "-o"]).arg(&partial).arg(source);
        assert!(command.status().expect("rustc starts").success(), "the library does not compile");
        fs::rename(partial, &built).unwrap();
        built
    })
}

/// A run of the program with the library: its output, the number of operations by class, and the path of the one that
/// failed.
struct Trial {
    output: Output,
    counts: BTreeMap<&'static str, u64>,
    failed: String,
}

fn trial(root: &Path, arguments: &str, fault: Option<(&str, u64, Action)>) -> Trial {
    let counts = tempfile::NamedTempFile::new().unwrap();
    fs::write(counts.path(), vec![0; COUNTS.0]).unwrap();
    let mut command = program(root, arguments);
    command.env("LD_PRELOAD", library()).env("FAULT_ROOT", root).env("FAULT_COUNTS", counts.path());
    command.env("RAYON_NUM_THREADS", "1");
    if let Some((class, number, action)) = fault {
        let fault = match action {
            Action::Error(errno) => format!("{class}:{number}:{errno}"),
            Action::ErrorFromHere(errno) => format!("{class}:{number}+:{errno}"),
            Action::Short => format!("{class}:{number}:short"),
            Action::Kill => format!("{class}:{number}:kill"),
        };
        command.env("FAULT", fault);
    }
    let output = command.output().expect("the program starts");
    let bytes = fs::read(counts.path()).unwrap();
    let number = |i: usize| u64::from_le_bytes(bytes[8 * i..8 * i + 8].try_into().unwrap());
    let path = &bytes[COUNTS.1..];
    let end = path.iter().position(|b| *b == 0).unwrap_or(path.len());
    Trial {
        output,
        counts: CLASSES.iter().enumerate().map(|(i, class)| (*class, number(i))).collect(),
        failed: String::from_utf8_lossy(&path[..end]).into_owned(),
    }
}

/// All files below a folder by their path.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    fn walk(root: &Path, folder: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(root, &path, found);
            } else {
                found.insert(path.strip_prefix(root).unwrap().to_str().unwrap().into(), fs::read(&path).unwrap());
            }
        }
    }
    let mut found = BTreeMap::new();
    walk(root, root, &mut found);
    found
}

/// Writes these files and no other ones.
fn restore(root: &Path, files: &BTreeMap<String, Vec<u8>>) {
    fs::remove_dir_all(root).ok();
    fs::create_dir_all(root).unwrap();
    for (name, bytes) in files {
        let path = root.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
}

impl Case {
    fn varies(&self, name: &str) -> bool {
        self.varying.iter().any(|ending| name.ends_with(ending))
    }

    /// The files that are compared. Names in a cache depend on the times of files. A temporary file that could not be
    /// removed stays beside an output file whose folder is not the program's own. The checkpoint before the last one is
    /// that of a signal, if there was one. A network whose costs cannot be measured is left out of `costs.json`.
    fn files(&self, root: &Path) -> BTreeMap<String, Vec<u8>> {
        let (mut before_last, mut kept) = (0, BTreeMap::new());
        for (name, bytes) in files(root) {
            if name.contains("/step-") && !name.contains("/step-6.") || name.ends_with("state.previous.json") {
                before_last += 1;
            } else if !name.contains("cache/") && !name.starts_with(".writing-") && !name.ends_with("/costs.json") {
                kept.insert(name, bytes);
            }
        }
        // Two checkpoints are kept of a run with more.
        if kept.keys().any(|name| name.contains("/step-6.")) {
            kept.insert("files before the last checkpoint".into(), format!("{before_last}").into_bytes());
        }
        kept
    }

    /// How the files of a finished command differ from those that it should have.
    fn difference(&self, found: &BTreeMap<String, Vec<u8>>, wanted: &BTreeMap<String, Vec<u8>>) -> Option<String> {
        let names: std::collections::BTreeSet<&String> = found.keys().chain(wanted.keys()).collect();
        let differs = |name: &&&String| match (found.get(**name), wanted.get(**name)) {
            (Some(a), Some(b)) => a != b && !self.varies(name),
            _ => true,
        };
        let what = |name: &&String| match (found.get(*name), wanted.get(*name)) {
            (Some(_), None) => format!("{name} should not exist"),
            (None, _) => format!("{name} is missing"),
            _ => format!("{name} has other bytes"),
        };
        let all: Vec<String> = names.iter().filter(differs).map(what).collect();
        (!all.is_empty()).then(|| all.join(", "))
    }

    /// Files that hold neither what they held before nor what they have to hold.
    fn torn(
        &self,
        found: &BTreeMap<String, Vec<u8>>,
        before: &BTreeMap<String, Vec<u8>>,
        wanted: &BTreeMap<String, Vec<u8>>,
    ) -> Option<String> {
        // These are appended to, or have states between. A study with a failed run has tables and a page with a gap.
        let grows = |name: &str, bytes: &[u8]| {
            let whole_json = name.ends_with(".json") && serde_json::from_slice::<serde_json::Value>(bytes).is_ok();
            let ends = [".jsonl", "log.txt", ".safetensors", ".html", ".md", ".tex", ".csv", ".svg", ".png", ".key"];
            let is_count = name.starts_with("files before");
            whole_json || is_count || ends.iter().any(|end| name.ends_with(end))
        };
        let is_torn = |(name, bytes): &(&String, &Vec<u8>)| {
            let states = [before.get(*name), wanted.get(*name)];
            wanted.contains_key(*name) && !states.contains(&Some(*bytes)) && !self.varies(name) && !grows(name, bytes)
        };
        found.iter().find(is_torn).map(|(name, _)| format!("{name} is neither old nor new"))
    }

    /// Whether a temporary file failed, or a folder, where the error names the file that was to be written.
    fn failed_beside(&self, path: &Path) -> bool {
        path.is_dir() || path == Path::new(".") || path.to_string_lossy().contains(".writing-")
    }

    /// What is wrong after a fault; `None` if all is well.
    fn wrong(
        &self,
        root: &Path,
        fault: (&str, u64, Action),
        before: &BTreeMap<String, Vec<u8>>,
        wanted: &BTreeMap<String, Vec<u8>>,
    ) -> Option<String> {
        restore(root, before);
        let tried = trial(root, self.command, Some(fault));
        let text = output_text(&tried.output);
        let say = |what: String| Some(format!("{}: {fault:?} at {}: {what}\n{text}", self.name, tried.failed));
        if tried.failed.is_empty() {
            return None; // the operation was not reached
        }
        let found = self.files(root);
        if text.contains("panicked") {
            return say("panic".into());
        }
        if let Some(torn) = self.torn(&found, before, wanted) {
            return say(torn);
        }
        let harmless = matches!(fault.2, Action::Error(EINTR) | Action::Short);
        match tried.output.status.code() {
            Some(0) => {
                // A file that could not be removed may stay until the next run.
                let mut found = found;
                found.retain(|name, _| !name.ends_with(".lock"));
                if let Some(difference) = self.difference(&found, wanted) {
                    return say(format!("success, but {difference}"));
                }
            }
            Some(1) if harmless => return say("an interrupted operation has to be repeated".into()),
            Some(1) => {
                let path = Path::new(&tried.failed);
                let mut known: Vec<&str> = path.iter().rev().take(2).filter_map(|part| part.to_str()).collect();
                if self.failed_beside(path) {
                    known.extend(wanted.keys().map(String::as_str));
                    known.extend(wanted.keys().filter_map(|name| name.split('/').next()));
                    known.extend(root.to_str());
                }
                if !text.contains("error: ") || !known.iter().any(|part| text.contains(part)) {
                    return say("no error that names the file".into());
                }
            }
            // A process of a study may be killed without the study.
            None if fault.2 == Action::Kill => {}
            other => return say(format!("exit code {other:?}")),
        }
        let again = program(root, self.again).output().unwrap();
        if !again.status.success() {
            return say(format!("the command fails afterwards: {}", output_text(&again)));
        }
        self.difference(&self.files(root), wanted).and_then(|difference| say(format!("afterwards {difference}")))
    }

    /// A folder with what the command reads, and the files before.
    fn prepared(&self) -> (tempfile::TempDir, PathBuf, BTreeMap<String, Vec<u8>>) {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().canonicalize().unwrap().join("root");
        fs::create_dir(&root).unwrap();
        (self.prepare)(&root);
        let before = files(&root);
        (dir, root, before)
    }

    /// Makes operations of all classes fail, `sample` of them unless the environment asks for others; then sends
    /// signals at random moments.
    fn test(&self, sample: usize, signals: usize) {
        self.fail_operations(sample);
        self.send_signals(signals);
    }

    fn send_signals(&self, count: usize) {
        let count = asked("LIDARSHIFT_KILLS").unwrap_or(count);
        let (_dir, root, before) = self.prepared();
        let start = Instant::now();
        must(&root, self.command);
        let took = start.elapsed();
        let wanted = self.files(&root);
        let (mut wrong, mut in_time) = (Vec::new(), 0);
        for i in 0..count {
            restore(&root, &before);
            let signal = ["KILL", "TERM", "INT"][i % 3];
            let patience = took.mul_f64(stream(7, self.name, 0, i as u64).random_range(0.0..1.0));
            let mut command = program(&root, self.command);
            let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
            std::thread::sleep(patience);
            let is_early = child.try_wait().unwrap().is_none();
            Command::new("kill").args(["-s", signal, &child.id().to_string()]).stderr(Stdio::null()).status().unwrap();
            let status = child.wait().unwrap();
            in_time += usize::from(is_early && !status.success());
            let torn = self.torn(&self.files(&root), &before, &wanted);
            let again = program(&root, self.again).output().unwrap();
            let found = match again.status.success() {
                true => torn.or_else(|| self.difference(&self.files(&root), &wanted)),
                false => Some(format!("the command fails afterwards: {}", output_text(&again))),
            };
            if let Some(what) = found {
                let what = format!("{}: SIG{signal} after {patience:?} of {took:?} ({status}): {what}", self.name);
                eprintln!("{what}");
                wrong.push(what);
            }
            if (i + 1) % 10 == 0 || i + 1 == count {
                eprintln!("{}: {} signals, {in_time} before the end, {} wrong", self.name, i + 1, wrong.len());
            }
        }
        assert!(wrong.is_empty(), "{} of {count} are wrong:\n{}", wrong.len(), wrong.join("\n---\n"));
    }

    /// Runs the command with `count` limits of its address space. They approach the least with which it ends well, so
    /// that an allocation fails at one moment or another.
    fn limit_memory(&self, count: usize) {
        let count = asked("LIDARSHIFT_MEMORY").unwrap_or(count);
        let (_dir, root, before) = self.prepared();
        must(&root, self.command);
        let wanted = self.files(&root);
        let (mut wrong, mut ends, mut range_kib) = (Vec::new(), BTreeMap::new(), [32u32 << 10, 4 << 20]);
        for _ in 0..count {
            restore(&root, &before);
            let kib = range_kib.map(f64::from).iter().product::<f64>().sqrt() as u32;
            let mut command = Command::new("bash");
            command.args(["-c", "ulimit -v $0; exec \"$@\"", &kib.to_string()]);
            command.arg(env!("CARGO_BIN_EXE_lidarshift")).args(self.command.split_whitespace());
            let output = command.current_dir(&root).env("RAYON_NUM_THREADS", "1").output().unwrap();
            *ends.entry(output.status.to_string()).or_insert(0) += 1;
            range_kib[usize::from(output.status.success())] = kib;
            let found = self.files(&root);
            let first = match output.status.code() {
                Some(0) => self.difference(&found, &wanted),
                _ => self.torn(&found, &before, &wanted),
            };
            let again = program(&root, self.again).output().unwrap();
            let what = first.or_else(|| match again.status.success() {
                true => self.difference(&self.files(&root), &wanted),
                false => Some(format!("the command fails afterwards: {}", output_text(&again))),
            });
            wrong.extend(what.map(|what| format!("{}: {kib} KiB: {what}\n{}", self.name, output_text(&output))));
        }
        eprintln!("{}: {count} limits of memory, {} wrong; {ends:?}", self.name, wrong.len());
        assert!(wrong.is_empty(), "{} of {count} are wrong:\n{}", wrong.len(), wrong.join("\n---\n"));
    }

    fn fail_operations(&self, sample: usize) {
        let (_dir, root, before) = self.prepared();
        let first = trial(&root, self.command, None);
        assert!(first.output.status.success(), "{}: {}", self.name, output_text(&first.output));
        let wanted = self.files(&root);
        eprintln!("{}: operations {:?}", self.name, first.counts);
        let all: Vec<(&str, u64, Action)> = TRIALS
            .iter()
            .flat_map(|&(class, action)| (1..=first.counts[class]).map(move |number| (class, number, action)))
            .collect();
        let most = asked("LIDARSHIFT_FAULTS").unwrap_or(sample);
        let tried = most.min(all.len());
        let mut wrong = Vec::new();
        for i in 0..tried {
            let found = self.wrong(&root, all[(2 * i + 1) * all.len() / (2 * tried)], &before, &wanted);
            found.iter().for_each(|what| eprintln!("{what}"));
            wrong.extend(found);
        }
        eprintln!("{}: {tried} of {} faults tried, {} wrong", self.name, all.len(), wrong.len());
        assert!(wrong.is_empty(), "{} of {tried} are wrong:\n{}", wrong.len(), wrong.join("\n---\n"));
    }
}

/// A number, or `all`, of the environment.
fn asked(variable: &str) -> Option<usize> {
    match std::env::var(variable).ok()?.as_str() {
        "all" => Some(usize::MAX),
        number => Some(number.parse().unwrap_or_else(|_| panic!("{variable} is a number or all"))),
    }
}

#[test]
fn too_little_memory() {
    let command = "simulate --config street.toml --out street";
    Case { name: "simulate", prepare: street, command, again: command, varying: &[] }.limit_memory(8);
    let command = "train --dataset . --detector tiny.toml --epochs 2 --set run.checkpoint_every_steps=2 --out run \
                   --workers 1 --resume";
    Case { name: "train", prepare: data_set, command, again: command, varying: &["provenance.json", "metrics.jsonl"] }
        .limit_memory(8);
}

#[test]
fn files_and_folders_are_synced() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().canonicalize().unwrap();
    street(&root);
    let counts = trial(&root, "simulate --config street.toml --out street", None).counts;
    assert!(counts["rename"] > 10, "{counts:?}");
    // Of each file: its bytes, and the folder after it has its name. Of each folder: the folder above it.
    assert_eq!(counts["sync"], 2 * counts["rename"] + counts["mkdir"], "{counts:?}");
}

const NOISE: &str = "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n";

fn street(root: &Path) {
    fs::write(root.join("street.toml"), "[frames]\ntrain = 1\nval = 1\ntest = 1\n").unwrap();
    fs::write(root.join("noise.toml"), NOISE).unwrap();
}

/// Runs the program, which must succeed.
fn must(root: &Path, arguments: &str) {
    program::must(root, arguments);
}

#[test]
fn simulate() {
    let command = "simulate --config street.toml --out street";
    Case { name: "simulate", prepare: street, command, again: command, varying: &[] }.test(12, 3);
}

#[test]
fn resim() {
    let command = "resim --effects noise.toml street --out noisy";
    let prepare = |root: &Path| {
        street(root);
        must(root, "simulate --config street.toml --out street");
    };
    Case { name: "resim", prepare, command, again: command, varying: &[] }.test(12, 3);
}

#[test]
fn diagnose() {
    // Over the results of another diagnosis.
    let command = "diagnose --measured noisy --simulated street --out diagnosis --json diagnosis.json";
    let prepare = |root: &Path| {
        street(root);
        must(root, "simulate --config street.toml --out street");
        must(root, "resim --effects noise.toml street --out noisy");
        must(root, "diagnose --measured street --simulated street --out diagnosis");
    };
    Case { name: "diagnose", prepare, command, again: command, varying: &[] }.test(4, 2);
}

#[test]
fn twin() {
    let command = "twin drive --out twin --keep-poses";
    let prepare = |root: &Path| room::write_recording(&root.join("drive"), 6, 1.0, 0.05);
    Case { name: "twin", prepare, command, again: command, varying: &[] }.test(4, 2);
}

#[test]
fn convert() {
    let command = "convert . --to shards --shard-frames 3 --out made";
    Case { name: "convert to shards", prepare: data_set, command, again: command, varying: &[] }.test(12, 3);
    let command = "convert . --to mcap --out made";
    Case { name: "convert to mcap", prepare: data_set, command, again: command, varying: &[] }.test(12, 3);
}

#[test]
fn train() {
    let command = "train --dataset . --detector tiny.toml --epochs 2 --set run.checkpoint_every_steps=2 --out run \
                   --workers 1 --resume";
    Case { name: "train", prepare: data_set, command, again: command, varying: &["provenance.json", "metrics.jsonl"] }
        .test(8, 3);
}

#[test]
fn study() {
    let command = "study study.toml --out runs/small";
    let prepare = |root: &Path| {
        data_set(root);
        small_study(root, NOISE);
    };
    let varying = &["provenance.json", "metrics.jsonl"];
    Case { name: "study", prepare, command, again: command, varying }.test(1, 1);
}
