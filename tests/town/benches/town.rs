//! The set of the second generator: many pairs with or without hidden differences, diagnosed and scored. Each result is
//! written as soon as it is available, so an interrupted run can be resumed.

use data::Dataset;
use diagnose::{Options, Rig, diagnose};
use lidarshift_town::{CaseSize, Kind, draw_case, write_case};
use rand::RngExt;
use score::{Outcome, Truth, markdown, score, summarise};
use std::path::{Path, PathBuf};
use std::time::Instant;

const HELP: &str = "\
Draws pairs of a town with hidden differences, diagnoses them and scores the answers. A line per case as it finishes,
then tables.

cargo xtask bench town -- [OPTIONS]
  --kind KIND     null, single, off, swarm, swarmN (N effects), pose, poseN (up to N cm), buildings, consecutive,
                  few_rows, no_labels, crawl, parallel, or the name of a cause; repeated: in turn. Without it kinds are
                  drawn: null 20 %, single 40 %, off 10 %, swarm 15 %, each of the others 2 to 3 %
  --first SEED    first seed [default: 1]
  --cases N       number of cases [default: 100]
  --frames N      frames per side [default: 40]
  --shots N       shots per scan; twice as many with 128 rows [default: 25000]
  --out DIR       folder of the results [default: bench/town]
  --keep DIR      keep the pairs in a folder, and reuse those already there
  --draw-only     draw pairs without diagnosing them
  --help          this text";

struct Arguments {
    kinds: Vec<String>,
    first: u64,
    cases: u64,
    size: CaseSize,
    out: PathBuf,
    keep: Option<PathBuf>,
    draw_only: bool,
}

/// The options; `None` if help is wanted.
fn arguments() -> Option<Arguments> {
    let mut out = Arguments {
        kinds: vec![],
        first: 1,
        cases: 100,
        size: CaseSize::USUAL,
        out: PathBuf::from("bench/town"),
        keep: None,
        draw_only: false,
    };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().unwrap_or_else(|| panic!("{arg} needs a value"));
        match arg.as_str() {
            "--kind" => out.kinds.push(value()),
            "--first" => out.first = value().parse().expect("a seed"),
            "--cases" => out.cases = value().parse().expect("a number of cases"),
            "--frames" => out.size.frames = value().parse().expect("a number of frames"),
            "--shots" => out.size.shots = value().parse().expect("a number of shots"),
            "--out" => out.out = value().into(),
            "--keep" => out.keep = Some(value().into()),
            "--draw-only" => out.draw_only = true,
            "--bench" => {}
            "--help" | "-h" => return None,
            other => panic!("unknown argument {other}"),
        }
    }
    Some(out)
}

/// The kind of a seed: drawn, or `kinds` in turn.
fn kind_of(seed: u64, kinds: &[String]) -> Kind {
    let rng = &mut data::stream(seed, "town kind", 0, 0);
    let drawn = match rng.random_range(0..100u32) {
        0..20 => "null",
        20..60 => "single",
        60..70 => "off",
        70..85 => "swarm",
        85..88 => "pose",
        88..90 => "buildings",
        90..92 => "consecutive",
        92..94 => "few_rows",
        94..96 => "no_labels",
        96..98 => "crawl",
        _ => "parallel",
    };
    let name = if kinds.is_empty() { drawn } else { kinds[(seed % kinds.len() as u64) as usize].as_str() };
    Kind::parse(name, rng).unwrap_or_else(|| panic!("no such kind or cause: {name}; see --help"))
}

/// Draws the pair of a seed in `folder`, unless it is there. The truth file is next to the folder, not in it.
fn draw(seed: u64, arguments: &Arguments, folder: &Path) -> Truth {
    let truth_file = folder.with_extension("truth.json");
    let drawn = std::fs::read(&truth_file).ok().and_then(|bytes| serde_json::from_slice::<Truth>(&bytes).ok());
    drawn.unwrap_or_else(|| {
        let case = draw_case(seed, kind_of(seed, &arguments.kinds), arguments.size);
        let truth = write_case(&case, folder).expect("a case can be written");
        data::write_json(&truth_file, &truth).expect("the truth can be written");
        truth
    })
}

fn run(truth: &Truth, folder: &Path) -> (Outcome, serde_json::Value) {
    let begin = Instant::now();
    let open = |side: &str| Dataset::open(&folder.join(side)).expect("a data set");
    let rig = Rig::read(&folder.join("sensor.toml")).expect("a rig");
    let found = diagnose(&open("measured"), &open("simulated"), &rig, &Options::default(), &|_, _, _| ());
    let value = match found {
        Ok(outcome) => serde_json::to_value(&outcome.diagnosis).expect("JSON"),
        Err(e) => serde_json::json!({ "verdict": format!("error: {e}") }),
    };
    (score(truth, &value, begin.elapsed().as_secs_f64()), value)
}

/// A line about a case.
fn line(outcome: &Outcome) -> String {
    let truth = &outcome.truth;
    let hidden: Vec<String> = truth
        .hidden
        .iter()
        .map(|h| {
            let strength = h.strength.map_or(String::new(), |s| format!(" {s:.0} SE"));
            match truth.hidden.len() {
                1 => format!("{}{strength} {:?}", h.cause, h.parameters),
                _ => format!("{}{strength}", h.cause),
            }
        })
        .collect();
    format!(
        "{}: {} [{}] ({}) -> {} ({}) named {:?} ambiguous {:?} unexplained {} closed {:?} {:.1} s",
        truth.seed,
        truth.kind,
        hidden.join("; "),
        truth.setting,
        outcome.grade(),
        outcome.verdict,
        outcome.named,
        outcome.ambiguous,
        outcome.unexplained,
        outcome.closed.map(|c| (c * 100.0).round() / 100.0),
        outcome.seconds
    )
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn main() {
    let Some(arguments) = arguments() else {
        println!("{HELP}");
        return;
    };
    let mut outcomes = Vec::new();
    for seed in arguments.first..arguments.first + arguments.cases {
        let path = arguments.out.join(format!("case-{seed}.json"));
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = arguments.keep.as_deref().unwrap_or(temporary.path()).join(seed.to_string());
        if arguments.draw_only {
            let begin = Instant::now();
            let truth = draw(seed, &arguments, &folder);
            println!("{seed}: {} ({}) {:.1} s", truth.kind, truth.setting, begin.elapsed().as_secs_f64());
            continue;
        }
        let done = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Outcome>(&bytes).ok());
        let outcome = done.unwrap_or_else(|| {
            let truth = draw(seed, &arguments, &folder);
            let (outcome, value) = run(&truth, &folder);
            let diagnosis_file = arguments.out.join(format!("diagnosis-{seed}.json"));
            data::write_json(&diagnosis_file, &value).expect("a diagnosis can be written");
            data::write_json(&path, &outcome).expect("a result can be written");
            outcome
        });
        println!("{}", line(&outcome));
        outcomes.push(outcome);
    }
    if arguments.draw_only {
        return;
    }
    let summary = summarise(&outcomes);
    data::write_json(&arguments.out.join("summary.json"), &summary).expect("a summary can be written");
    println!("\n{}", markdown(&summary));
}
