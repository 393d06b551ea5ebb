//! The large blind set: many cases with or without a hidden difference. Each result is written as soon as it is
//! available, so an interrupted run can be resumed.
//!
//! `cargo xtask bench blind -- [--kind null|single|pair|off|shuffled|swarm|CAUSE]... [--cases N] [--first SEED]
//! [--frames N] [--shots N] [--out DIR] [--keep DIR] [--draw-only]`
//!
//! `--keep` stores the generated pairs in a folder and reuses those already there; `--draw-only` generates pairs
//! without diagnosing them.

use data::Dataset;
use diagnose::{Options, Rig, diagnose};
use lidarshift_blind::{CAUSES, CaseSize, Kind, OFF_CATALOGUE, draw_case, write_case};
use rand::RngExt;
use score::{GROUPS, Outcome, Truth, markdown, score, summarise};
use std::path::{Path, PathBuf};
use std::time::Instant;

struct Arguments {
    kinds: Vec<String>,
    cases: u64,
    first: u64,
    size: CaseSize,
    out: PathBuf,
    keep: Option<PathBuf>,
    draw_only: bool,
}

fn arguments() -> Arguments {
    let mut out = Arguments {
        kinds: vec![],
        cases: 200,
        first: 1,
        size: CaseSize::USUAL,
        out: PathBuf::from("bench/blind"),
        keep: None,
        draw_only: false,
    };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().unwrap_or_else(|| panic!("{arg} needs a value"));
        match arg.as_str() {
            "--kind" => out.kinds.push(value()),
            "--cases" => out.cases = value().parse().expect("a number of cases"),
            "--first" => out.first = value().parse().expect("a seed"),
            "--frames" => out.size.frames = value().parse().expect("a number of frames"),
            "--shots" => out.size.shots = value().parse().expect("a number of shots"),
            "--out" => out.out = value().into(),
            "--keep" => out.keep = Some(value().into()),
            "--draw-only" => out.draw_only = true,
            "--bench" => {}
            other => panic!("unknown argument {other}"),
        }
    }
    out
}

/// The kind of the case of a seed: drawn at random (25 % null, 47 % single, 15 % pair, 10 % off-catalogue, 3 %
/// shuffled), or `kinds` in turn.
fn kind_of(seed: u64, kinds: &[String]) -> Kind {
    let mut rng = data::stream(seed, "blind kind", 0, 0);
    let cause = |name: &str| CAUSES.iter().position(|c| *c == name);
    let drawn = rng.random_range(0..100u32);
    let name = match kinds {
        [] if drawn < 25 => "null".to_owned(),
        [] if drawn < 72 => "single".into(),
        [] if drawn < 87 => "pair".into(),
        [] if drawn < 97 => "off".into(),
        [] => "shuffled".into(),
        kinds => kinds[(seed % kinds.len() as u64) as usize].clone(),
    };
    match name.as_str() {
        "null" => Kind::Null,
        "single" => Kind::Single(rng.random_range(0..CAUSES.len())),
        "pair" => {
            let i = rng.random_range(0..CAUSES.len());
            Kind::Pair(i, (i + rng.random_range(1..CAUSES.len())) % CAUSES.len())
        }
        "off" => Kind::OffCatalogue(rng.random_range(0..OFF_CATALOGUE)),
        "shuffled" => Kind::Shuffled,
        "swarm" => {
            let [first, last] = GROUPS[rng.random_range(0..GROUPS.len())];
            Kind::Swarm(rng.random_range(first..=last))
        }
        other => Kind::Single(cause(other).unwrap_or_else(|| panic!("no such kind or cause: {other}"))),
    }
}

/// Generates the pair of a seed in `folder`, unless it exists. The truth file is written next to the folder, not into
/// it.
fn draw(seed: u64, arguments: &Arguments, folder: &Path) -> Truth {
    let truth_file = folder.with_extension("truth.json");
    let drawn = std::fs::read(&truth_file).ok().and_then(|bytes| serde_json::from_slice::<Truth>(&bytes).ok());
    drawn.unwrap_or_else(|| {
        let case = draw_case(seed, kind_of(seed, &arguments.kinds), arguments.size);
        let truth = write_case(&case, folder).expect("a case can be written");
        data::write_atomic(&truth_file, &serde_json::to_vec_pretty(&truth).expect("JSON")).expect("the truth");
        truth
    })
}

fn run(truth: &Truth, folder: &Path) -> (Outcome, serde_json::Value) {
    let begin = Instant::now();
    let open = |side: &str| Dataset::open(&folder.join(side)).expect("a data set");
    let rig = Rig::read(&folder.join("sensor.toml")).expect("a rig");
    let found = diagnose(&open("measured"), &open("simulated"), &rig, &Options::default(), &|_, _, _| ());
    let value = match found {
        Ok(o) => serde_json::to_value(&o.diagnosis).expect("JSON"),
        Err(e) => serde_json::json!({ "verdict": format!("error: {e}") }),
    };
    (score(truth, &value, begin.elapsed().as_secs_f64()), value)
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn main() {
    let arguments = arguments();
    std::fs::create_dir_all(&arguments.out).expect("a folder for results");
    let mut outcomes = Vec::new();
    for seed in arguments.first..arguments.first + arguments.cases {
        let path = arguments.out.join(format!("case-{seed}.json"));
        let done = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Outcome>(&bytes).ok());
        let folder = tempfile::tempdir().expect("a temporary folder");
        let place = arguments.keep.as_deref().unwrap_or(folder.path()).join(seed.to_string());
        if arguments.draw_only {
            draw(seed, &arguments, &place);
            continue;
        }
        let outcome = done.unwrap_or_else(|| {
            let truth = draw(seed, &arguments, &place);
            let (outcome, value) = run(&truth, &place);
            let diagnosis_file = arguments.out.join(format!("diagnosis-{seed}.json"));
            data::write_atomic(&diagnosis_file, &serde_json::to_vec_pretty(&value).expect("JSON"))
                .expect("a diagnosis");
            data::write_atomic(&path, &serde_json::to_vec_pretty(&outcome).expect("JSON")).expect("a result");
            outcome
        });
        let hidden: Vec<String> =
            outcome.truth.hidden.iter().map(|h| format!("{} {:?}", h.cause, h.parameters)).collect();
        println!(
            "{seed}: {} [{}] -> {} named {:?} ambiguous {:?} unexplained {} closed {:?} {:.1} s",
            outcome.truth.kind,
            hidden.join("; "),
            outcome.grade(),
            outcome.named,
            outcome.ambiguous,
            outcome.unexplained,
            outcome.closed.map(|c| (c * 100.0).round() / 100.0),
            outcome.seconds
        );
        outcomes.push(outcome);
    }
    if arguments.draw_only {
        return;
    }
    let summary = summarise(&outcomes);
    let text = serde_json::to_vec_pretty(&summary).expect("JSON");
    data::write_atomic(&arguments.out.join("summary.json"), &text).expect("a summary");
    println!("{}\n{}", String::from_utf8_lossy(&text), markdown(&summary));
}
