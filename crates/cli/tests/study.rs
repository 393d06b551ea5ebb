//! A study through the program: killed and resumed, with a failing run, with a changed TOML, with data sets of
//! different frames.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{
    TWO_SETS_STUDY as STUDY, data_set, kill_repeatedly, must, output_text, program, run, slurm, study_steps,
    training_job, two_sets_study as study, waits_for,
};
use std::fs;
use std::path::Path;

fn page(folder: &Path) -> String {
    fs::read_to_string(folder.join("runs/tiny/report.html")).unwrap()
}

/// Compares two pages; a failure shows the first difference.
fn assert_same_page(page: &str, other: &str) {
    let at = page.bytes().zip(other.bytes()).position(|(a, b)| a != b).unwrap_or(page.len().min(other.len()));
    let around = |text: &str| {
        String::from_utf8_lossy(&text.as_bytes()[at.saturating_sub(300)..text.len().min(at + 200)]).into_owned()
    };
    assert!(page == other, "the pages differ from byte {at} on:\n{}\n---\n{}", around(page), around(other));
}

#[test]
fn a_killed_study_is_resumed_with_the_same_report() {
    let whole = tempfile::tempdir().unwrap();
    study(whole.path());
    let output = must(whole.path(), "study tiny-study.toml");
    let text = output_text(&output);
    assert!(text.contains("4 runs") && text.contains("steps of") && text.contains("| Car | trained on"), "{text}");
    let html = page(whole.path());
    for part in
        ["Plain", "Noisy", "4 of", "t-SNE", "linear CKA", "Chamfer", "seeds 1, 2", "lidarshift study tiny-study.toml"]
    {
        assert!(html.contains(part) || part == "4 of", "{part} is not in the report");
    }
    for file in [
        "matrix.json",
        "analyses.json",
        "features.json",
        "distances/plain--noisy.json",
        "targets/noisy.json",
        "tables/matrix.tex",
    ] {
        assert!(whole.path().join("runs/tiny").join(file).is_file(), "{file}");
    }
    let status = output_text(&must(whole.path(), "study status tiny-study.toml"));
    assert!(status.contains("4 runs, each tested on 2 data sets: 4 done"), "{status}");

    // The same study in another folder, killed several times, gives the same report.
    let killed = tempfile::tempdir().unwrap();
    study(killed.path());
    let command = || program(killed.path(), "study tiny-study.toml");
    kill_repeatedly(command, || study_steps(killed.path()), &[5, 40, 120, 250, 60]);
    must(killed.path(), "study tiny-study.toml");
    assert_same_page(&page(killed.path()), &html);

    // A second call finds all results; other commands show parts of them.
    let again = output_text(&must(whole.path(), "study tiny-study.toml"));
    assert!(again.contains("no run is missing"), "{again}");
    assert!(page(whole.path()) == html, "a second call changes the report");
    let table = output_text(&must(whole.path(), "eval matrix tiny-study.toml --latex t.tex"));
    assert!(table.contains("| Car | trained on"), "{table}");
    must(whole.path(), "eval tsne runs/tiny --figures features");
    must(whole.path(), "eval targets . runs/tiny/data/noisy --out targets");
    let distances = output_text(&must(whole.path(), "eval distances . runs/tiny/data/noisy --frames 2"));
    assert!(distances.contains("Chamfer, sum") && distances.contains("of the Chamfer sum: targets"), "{distances}");
    let said = output_text(&must(whole.path(), "report runs/tiny"));
    assert!(said.contains("report.html") && page(whole.path()) == html, "{said}");
}

#[test]
fn regions_of_two_stages_and_tensorboard_files_are_written() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let two_stage = STUDY.replace("seeds = [1, 2]", "seeds = [1]").replace(
        "[[detector]]\nname = \"tiny\"\nconfig = \"tiny.toml\"",
        "[[detector]]\nname = \"tiny\"\nconfig = \"tiny_pointrcnn.toml\"\ntrain = [\"plain\"]",
    );
    fs::write(dir.path().join("tiny-study.toml"), two_stage).unwrap();
    must(dir.path(), "study tiny-study.toml");
    let run = dir.path().join("runs/tiny/tiny/plain/seed-1");
    let boxes = |folder: &str| {
        let file = run.join(folder).join("noisy/detections.parquet");
        data::read_detections_file(&file, &["000005"]).unwrap().frames[0].clone().unwrap().len()
    };
    assert!(boxes("regions") >= boxes("detections").max(1));
    let matrix = fs::read_to_string(dir.path().join("runs/tiny/matrix.json")).unwrap();
    assert!(matrix.contains("recall_final_boxes"), "{matrix}");

    let text = output_text(&must(dir.path(), "report tiny-study.toml --tensorboard curves"));
    assert!(text.contains("training curves of 1 runs: tensorboard --logdir curves"), "{text}");
    let events = fs::read(dir.path().join("curves/tiny/plain/seed-1/events.out.tfevents.0.lidarshift")).unwrap();
    assert!(events.windows(10).any(|w| w == b"train/loss"));
    let text = output_text(&must(dir.path(), "report runs/tiny/tiny/plain/seed-1 --tensorboard alone"));
    assert!(!text.contains("report.html") && dir.path().join("alone/events.out.tfevents.0.lidarshift").is_file());
    let output = program(dir.path(), "report runs/tiny/data --tensorboard none").output().unwrap();
    assert!(
        !output.status.success() && output_text(&output).contains("no metrics.jsonl below it"),
        "{}",
        output_text(&output)
    );
}

#[test]
fn a_failed_run_and_a_changed_study_are_reported() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let one = STUDY.replace("seeds = [1, 2]", "seeds = [1]");
    // With this learning rate the loss of every run becomes infinite or NaN.
    let wild = one.replace("config = \"tiny.toml\"", "config = \"tiny.toml\"\nset = { optimization.lr_max = 1e30 }");
    fs::write(dir.path().join("tiny-study.toml"), wild).unwrap();
    let output = run(dir.path(), "study tiny-study.toml");
    let text = output_text(&output);
    assert!(!output.status.success() && text.contains("tiny/plain/seed-1") && text.contains("not finite"), "{text}");
    assert!(page(dir.path()).contains("not finite"), "the report does not show the failure");
    let status = output_text(&must(dir.path(), "study status tiny-study.toml"));
    assert!(status.contains("2 failed"), "{status}");

    // With another learning rate the runs no longer belong to the study.
    fs::write(dir.path().join("tiny-study.toml"), &one).unwrap();
    let output = run(dir.path(), "study tiny-study.toml --only train");
    let text = output_text(&output);
    assert!(!output.status.success(), "{text}");
    assert!(text.contains("tiny/plain/seed-1 is no longer valid: set was"), "{text}");
    assert!(text.contains("lr_max") && text.contains("repeat it with --replace"), "{text}");
    let text = output_text(&must(dir.path(), "train --study tiny-study.toml --replace"));
    assert!(text.contains("removed") && text.contains("finished ("), "{text}");
    let status = output_text(&must(dir.path(), "study status tiny-study.toml"));
    assert!(status.contains("2 trained") && status.contains("not tested on plain, noisy"), "{status}");

    // Deleted or shortened detections are written again.
    must(dir.path(), "study tiny-study.toml --only detect");
    let cell = dir.path().join("runs/tiny/tiny/plain/seed-1/detections/noisy");
    let file = cell.join("detections.parquet");
    let whole = fs::read(&file).unwrap();
    for left in [None, Some(&whole[..whole.len() / 2])] {
        left.map_or_else(|| fs::remove_file(&file), |left| fs::write(&file, left)).unwrap();
        let status = output_text(&must(dir.path(), "study status tiny-study.toml"));
        assert!(status.contains("1 done, 1 trained") && status.contains("not tested on noisy"), "{status}");
        must(dir.path(), "study tiny-study.toml --only detect");
        assert!(fs::read(&file).unwrap() == whole);
    }
    // Changed ones are not evaluated.
    let mut changed = whole.clone();
    changed[whole.len() / 2] ^= 1;
    fs::write(&file, changed).unwrap();
    let output = run(dir.path(), "report tiny-study.toml");
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("detections.parquet: was changed after it was written; remove"), "{text}");
    fs::remove_file(cell.join("cell.json")).unwrap();
    must(dir.path(), "study tiny-study.toml --only detect");
    assert!(fs::read(&file).unwrap() == whole);

    // Weights of another configuration in a run folder.
    let state = dir.path().join("runs/tiny/tiny/plain/seed-1/checkpoint/state.json");
    let other = dir.path().join("runs/tiny/tiny/noisy/seed-1/checkpoint/state.json");
    fs::copy(other, state).unwrap();
    let text = output_text(&must(dir.path(), "report tiny-study.toml"));
    assert!(text.contains("report.html"), "{text}");
    assert!(page(dir.path()).contains("belongs to another configuration"));
}

/// What an earlier version of the program wrote in the place of a file of detections.
fn as_text(folder: &Path) {
    let ids = ["000005", "000006"];
    let found = data::read_detections_file(&folder.join("detections.parquet"), &ids).unwrap();
    for (id, boxes) in ids.iter().zip(found.frames) {
        fs::write(folder.join(format!("{id}.txt")), data::to_kitti_text(&boxes.unwrap())).unwrap();
    }
    fs::remove_file(folder.join("detections.parquet")).unwrap();
    let mut cell: serde_json::Value = serde_json::from_slice(&fs::read(folder.join("cell.json")).unwrap()).unwrap();
    cell.as_object_mut().unwrap().remove("files").unwrap();
    cell["schema"] = "lidarshift/detection-cell/2".into();
    fs::write(folder.join("cell.json"), cell.to_string()).unwrap();
}

#[test]
fn a_cell_is_one_file_and_those_of_text_are_read() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    fs::write(dir.path().join("tiny-study.toml"), STUDY.replace("seeds = [1, 2]", "seeds = [1]")).unwrap();
    must(dir.path(), "study tiny-study.toml");
    let (html, cell) = (page(dir.path()), dir.path().join("runs/tiny/tiny/plain/seed-1/detections/noisy"));
    let mut names: Vec<_> = fs::read_dir(&cell).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort_unstable();
    assert_eq!(names, ["cell.json", "detections.parquet"]);
    let eval = |path: &str| {
        let arguments =
            format!("eval ap --dataset runs/tiny/data/noisy --split val --detections {path} --json ap.json");
        must(dir.path(), &arguments);
        fs::read_to_string(dir.path().join("ap.json")).unwrap()
    };
    let folder = "runs/tiny/tiny/plain/seed-1/detections/noisy";
    let of_file = eval(&format!("{folder}/detections.parquet"));
    assert_eq!(eval(folder), of_file);

    as_text(&cell);
    assert_eq!(eval(folder), of_file);
    for cache in ["matrix.json", "analyses.json"] {
        fs::remove_file(dir.path().join("runs/tiny").join(cache)).unwrap();
    }
    let status = output_text(&must(dir.path(), "study status tiny-study.toml"));
    assert!(status.contains("2 done"), "{status}");
    must(dir.path(), "study tiny-study.toml");
    assert_same_page(&page(dir.path()), &html);
    assert!(cell.join("000005.txt").is_file() && !cell.join("detections.parquet").exists());
    // What has to be detected again is one file.
    fs::remove_file(cell.join("000006.txt")).unwrap();
    must(dir.path(), "study tiny-study.toml");
    assert!(cell.join("detections.parquet").is_file() && !cell.join("000005.txt").exists());
    assert_same_page(&page(dir.path()), &html);
}

#[test]
fn invalid_studies_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    for (from, to, arguments, want) in [
        ("", "", "study none", "no study \"none\": neither a file nor one of cpu, gain, paper, quick"),
        ("", "", "study", "the study is missing"),
        (
            "",
            "",
            "report tiny-study.toml",
            "does not exist; generate it with `lidarshift study tiny-study.toml --only data`",
        ),
        ("config = \"tiny.toml\"", "config = \"no.toml\"", "study tiny-study.toml", "no.toml"),
        ("seeds = [1, 2]", "seeds = [1, 1]", "study tiny-study.toml", "have to be distinct"),
        ("path = \".\"", "path = \"nowhere\"", "study tiny-study.toml", "data set plain"),
    ] {
        fs::write(dir.path().join("tiny-study.toml"), STUDY.replacen(from, to, usize::from(!from.is_empty()))).unwrap();
        let output = run(dir.path(), arguments);
        let text = output_text(&output);
        assert!(!output.status.success() && text.contains(want), "{arguments}: {text}");
    }
    fs::write(dir.path().join("tiny-study.toml"), STUDY).unwrap();
    // Without Slurm on the path.
    let output =
        program(dir.path(), "study tiny-study.toml --launcher slurm").env("PATH", dir.path()).output().unwrap();
    let text = output_text(&output);
    assert!(!output.status.success() && text.contains("there is no squeue on this machine"), "{text}");
    // A test frame that is missing.
    let val = dir.path().join("ImageSets/val.txt");
    let ids = fs::read_to_string(&val).unwrap();
    fs::write(&val, format!("{ids}000099\n")).unwrap();
    let output = run(dir.path(), "study tiny-study.toml");
    let text = output_text(&output);
    assert!(!output.status.success() && text.contains("000099"), "{text}");
    fs::write(&val, ids).unwrap();
    // Frames that the other data set does not have.
    let other = dir.path().join("other");
    fs::create_dir(&other).unwrap();
    data_set(&other);
    fs::rename(other.join("velodyne/000000.bin"), other.join("velodyne/000099.bin")).unwrap();
    fs::rename(other.join("label_2/000000.txt"), other.join("label_2/000099.txt")).unwrap();
    let ids = fs::read_to_string(other.join("ImageSets/train.txt")).unwrap().replace("000000", "000099");
    fs::write(other.join("ImageSets/train.txt"), ids).unwrap();
    let output = run(dir.path(), "eval distances . other");
    let text = output_text(&output);
    assert!(!output.status.success() && text.contains("do not pair") && text.contains("000000"), "{text}");
}

/// A node that takes no new task; it goes on with those that run, and takes new ones again when this is dropped.
struct Drained(String);

impl Drained {
    fn drain(node: &str) -> Option<Drained> {
        let name = format!("nodename={node}");
        slurm(&["scontrol", "update", &name, "state=drain", "reason=test"])?;
        Some(Drained(name))
    }
}

impl Drop for Drained {
    fn drop(&mut self) {
        slurm(&["scontrol", "update", &self.0, "state=resume"]);
    }
}

#[test]
fn on_slurm_the_numbers_are_the_same() {
    let Some(nodes) = slurm(&["sinfo", "--noheader", "--format=%n"]) else {
        eprintln!("skipped: there is no Slurm");
        return;
    };
    let local = tempfile::tempdir().unwrap();
    study(local.path());
    must(local.path(), "study tiny-study.toml");
    let matrix = |folder: &Path| fs::read_to_string(folder.join("runs/tiny/matrix.json")).unwrap();
    let status = |folder: &Path| output_text(&must(folder, "study status tiny-study.toml"));

    // One task is killed; what depends on it is dropped, and the report shows the gap.
    let killed = tempfile::tempdir().unwrap();
    study(killed.path());
    let text = output_text(&must(killed.path(), "study tiny-study.toml --launcher slurm"));
    assert!(text.contains("train: job") && text.contains("4 tasks") && text.contains("report: job"), "{text}");
    slurm(&["scancel", &format!("{}_3", training_job(&text))]).unwrap();
    assert!(waits_for(|| killed.path().join("runs/tiny/report.html").is_file()), "no report");
    assert!(status(killed.path()).contains("3 done"), "{}", status(killed.path()));
    // A second submission fills the gap alone.
    let text = output_text(&must(killed.path(), "study tiny-study.toml --launcher slurm"));
    assert!(text.contains("1 tasks"), "{text}");
    assert!(waits_for(|| matrix(killed.path()) == matrix(local.path())), "the numbers differ");
    assert!(waits_for(|| page(killed.path()) == page(local.path())), "the report differs");

    // The whole array is killed: nothing is lost but time.
    let array = tempfile::tempdir().unwrap();
    study(array.path());
    let text = output_text(&must(array.path(), "study tiny-study.toml --launcher slurm --only data,train"));
    slurm(&["scancel", &training_job(&text)]).unwrap();
    assert!(waits_for(
        || slurm(&["squeue", "--noheader", "--jobs", &training_job(&text)]).is_none_or(|q| q.trim().is_empty())
    ));
    let text = output_text(&must(array.path(), "study tiny-study.toml --launcher slurm"));
    assert!(!text.contains("already in the queue"), "{text}");
    assert!(waits_for(|| array.path().join("runs/tiny/report.html").is_file()), "no report");
    assert!(matrix(array.path()) == matrix(local.path()), "the numbers differ");

    // The node is drained when the first task is at work, and comes back: what waits is not submitted twice.
    let node = nodes.lines().next().unwrap_or_default();
    let drained = tempfile::tempdir().unwrap();
    study(drained.path());
    must(drained.path(), "study tiny-study.toml --launcher slurm");
    assert!(waits_for(|| study_steps(drained.path()) > 0), "no task begins");
    let Some(guard) = Drained::drain(node) else {
        eprintln!("skipped: only Slurm's administrator may drain a node");
        return;
    };
    // Tasks that are at work go on to their end.
    let is_idle =
        || slurm(&["squeue", "--noheader", "--states=running", "--nodelist", node]).unwrap().trim().is_empty();
    assert!(waits_for(is_idle), "tasks go on for ever");
    assert!(!status(drained.path()).contains("4 done"), "{}", status(drained.path()));
    let text = output_text(&must(drained.path(), "study tiny-study.toml --launcher slurm"));
    assert!(text.contains("already in the queue"), "{text}");
    drop(guard);
    assert!(waits_for(|| drained.path().join("runs/tiny/report.html").is_file()), "no report");
    assert!(waits_for(|| matrix(drained.path()) == matrix(local.path())), "the numbers differ");
    assert!(waits_for(|| page(drained.path()) == page(local.path())), "the report differs");
}
