//! The loop: an effect is hidden, diagnosed, applied to the simulated clouds by the file `extended.toml`, and the pair
//! is diagnosed again. A right diagnosis with right effects leaves nothing to find.
//!
//! `cargo xtask bench loop -- --help` lists the options. [`loop_cell`] says which case a seed stands for.

use data::Dataset;
use diagnose::{Diagnosis, Outcome, Rig};
use lidarshift_blind::{CAUSES, FIRST_NULL_SEED, FIRST_SEED, Kind, Variant, draw_strong_case, loop_cell, write_case};
use score::{CaseSize, Outcome as Scored, Truth, score};
use sensor::EffectList;
use serde_json::{Value, json};
use simulate::resim::Resim;
use statistics::median_upper;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;
use trials::diagnosed;

const HELP: &str = "\
Hides an effect in a generated pair, diagnoses it, applies extended.toml to the simulated side and diagnoses again.
A line per case as it finishes, then a Markdown table per kind.

cargo xtask bench loop -- [OPTIONS]
  --first SEED    first seed [default: 50001]; a seed always stands for the same case: kind (SEED - 50001) mod 22,
                  and one of 4 combinations of sensors, intensity column and rig file. Seeds from 59001 hide nothing
  --cases N       cases to run from there, those of other kinds than --kinds not counted [default: 88: 4 of each kind]
  --kinds A,B     only these causes
  --null N        also N pairs with nothing hidden, from seed 59001 [default: 0]
  --frames N      frames per side [default: 40]
  --shots N       shots per scan [default: 25000]
  --json FILE     everything, one JSON object per case
  --keep DIR      keep the data: DIR/SEED/measured, simulated, extended, sensor.toml, extended.toml, applied.toml,
                  diagnosis.json, second.json
  --help          this text

Columns: predicted is gain.predicted.closed and closed gain.closed of the first diagnosis; reached is the share of the
gap (before - floor of the first diagnosis) that is gone in the second one. `-`: not known.";

/// A channel is printed where it has at least this share of the whole gap.
const SHOWN_SHARE: f64 = 0.05;

struct Arguments {
    first: u64,
    cases: usize,
    kinds: Vec<String>,
    null: usize,
    size: CaseSize,
    json: Option<PathBuf>,
    keep: Option<PathBuf>,
}

/// The options; `None` if help is wanted.
fn arguments() -> Option<Arguments> {
    let mut out = Arguments {
        first: FIRST_SEED,
        cases: 4 * CAUSES.len(),
        kinds: vec![],
        null: 0,
        size: CaseSize::USUAL,
        json: None,
        keep: None,
    };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().unwrap_or_else(|| panic!("{arg} needs a value"));
        match arg.as_str() {
            "--first" => out.first = value().parse().expect("a seed"),
            "--cases" => out.cases = value().parse().expect("a number of cases"),
            "--kinds" => out.kinds = value().split(',').map(str::to_owned).collect(),
            "--null" => out.null = value().parse().expect("a number of pairs"),
            "--frames" => out.size.frames = value().parse().expect("a number of frames"),
            "--shots" => out.size.shots = value().parse().expect("a number of shots"),
            "--json" => out.json = Some(value().into()),
            "--keep" => out.keep = Some(value().into()),
            "--bench" => {}
            "--help" | "-h" => return None,
            other => panic!("unknown argument {other}"),
        }
    }
    assert!(out.first >= FIRST_SEED, "seeds of the loop begin at {FIRST_SEED}");
    for kind in &out.kinds {
        assert!(CAUSES.contains(&kind.as_str()), "no such cause: {kind}; there are {}", CAUSES.join(", "));
    }
    Some(out)
}

/// Name of a kind in tables.
fn name(kind: Kind) -> &'static str {
    match kind {
        Kind::Single(i) => CAUSES[i],
        _ => "null",
    }
}

/// The seeds to run.
fn seeds(arguments: &Arguments) -> Vec<u64> {
    let wanted =
        |seed: &u64| arguments.kinds.is_empty() || arguments.kinds.iter().any(|k| k == name(loop_cell(*seed).0));
    let end = if arguments.first < FIRST_NULL_SEED { FIRST_NULL_SEED } else { u64::MAX };
    let mut out: Vec<u64> = (arguments.first..end).filter(wanted).take(arguments.cases).collect();
    out.extend(FIRST_NULL_SEED..FIRST_NULL_SEED + arguments.null as u64);
    out
}

/// What became of one case.
struct Run {
    kind: Kind,
    variant: Variant,
    outcome: Scored,
    first: Value,
    /// The second diagnosis, or why there is none.
    second: Result<Value, String>,
    /// Effects that were not applied, with the reason, and findings without an effect.
    left_out: Vec<String>,
    applied: Vec<String>,
    /// Drawing, first diagnosis, applying, second diagnosis.
    seconds: [f64; 4],
}

fn run(seed: u64, size: CaseSize, folder: &Path) -> Run {
    let (kind, variant) = loop_cell(seed);
    let mut clock = Instant::now();
    let mut lap = || std::mem::replace(&mut clock, Instant::now()).elapsed().as_secs_f64();
    let truth: Truth = write_case(&draw_strong_case(seed, kind, size, variant), folder).expect("a case can be written");
    let rig = Rig::read(&folder.join("sensor.toml")).expect("a rig");
    let drawn = lap();
    let found = diagnosed(folder, "simulated").map_err(|e| e.to_string());
    let first = found.as_ref().map_or_else(|e| json!({ "verdict": format!("error: {e}") }), |o| json_of(&o.diagnosis));
    let diagnosing = lap();
    write_json(&folder.join("truth.json"), &serde_json::to_value(&truth).expect("JSON"));
    write_json(&folder.join("diagnosis.json"), &first);
    let (applied, left_out, made) = match &found {
        Ok(outcome) => apply(outcome, &rig, folder),
        Err(e) => (vec![], vec![], Err(e.clone())),
    };
    let extended = lap();
    // Without an effect the extended clouds are the simulated ones.
    let second = match made {
        Ok(()) if applied.is_empty() => Ok(first.clone()),
        Ok(()) => diagnosed(folder, "extended").map(|o| json_of(&o.diagnosis)).map_err(|e| e.to_string()),
        Err(e) => Err(e),
    };
    if let Ok(value) = &second {
        write_json(&folder.join("second.json"), value);
    }
    let outcome = score(&truth, &first, diagnosing);
    Run { kind, variant, outcome, first, second, left_out, applied, seconds: [drawn, diagnosing, extended, lap()] }
}

fn json_of(diagnosis: &Diagnosis) -> Value {
    serde_json::to_value(diagnosis).expect("JSON")
}

fn write_json(path: &Path, value: &Value) {
    data::write_json(path, value).expect("a file can be written");
}

/// Applies the file of a diagnosis to the simulated clouds: kinds of the applied effects, what was left out, and
/// whether it could be done.
fn apply(outcome: &Outcome, rig: &Rig, folder: &Path) -> (Vec<String>, Vec<String>, Result<(), String>) {
    let path = folder.join("extended.toml");
    data::write_atomic(&path, outcome.extended.as_bytes()).expect("a file can be written");
    let without = outcome.diagnosis.findings.iter().filter(|f| f.effects.is_empty());
    let mut left_out: Vec<String> =
        without.map(|f| format!("{} (no effect)", f.cause.map_or("unexplained", |c| c.name()))).collect();
    let mut effects = match EffectList::parse(&outcome.extended, &path) {
        Ok(effects) => effects,
        Err(e) => return (vec![], left_out, Err(e.to_string())),
    };
    let dataset = Dataset::open(&folder.join("simulated")).expect("a data set");
    let refused = match (Resim { dataset: &dataset, effects: &effects, rig: Some(rig.clone()), seed: 1 }).refused() {
        Ok(refused) => refused,
        Err(e) => return (vec![], left_out, Err(e.to_string())),
    };
    effects = effects.without(&refused);
    left_out.extend(refused.into_iter().map(|r| format!("{} {}", r.kind, r.why)));
    let applied: Vec<String> = effects.effects.iter().map(|e| e.kind().to_owned()).collect();
    if applied.is_empty() {
        return (applied, left_out, Ok(()));
    }
    let resim = Resim { dataset: &dataset, effects: &effects, rig: Some(rig.clone()), seed: 1 };
    let made = resim.make(&folder.join("extended"), &|_, _| ());
    (applied, left_out, made.map(|_| ()).map_err(|e| e.to_string()))
}

/// Names of the findings: causes, candidates of ambiguous ones, channel and covariate of unexplained ones.
fn findings(diagnosis: &Value) -> Vec<String> {
    let text = |v: &Value| v.as_str().unwrap_or_default().to_owned();
    let name = |f: &Value| match f["status"].as_str() {
        Some("named") => text(&f["cause"]),
        Some("ambiguous") => {
            let candidates: Vec<String> = f["candidates"].as_array().into_iter().flatten().map(text).collect();
            format!("({})", candidates.join("|"))
        }
        _ => format!("unexplained {} by {}", text(&f["channel"]), text(&f["covariate"])),
    };
    diagnosis["findings"].as_array().into_iter().flatten().map(name).collect()
}

impl Run {
    fn predicted(&self) -> Option<f64> {
        self.first["gain"]["predicted"]["closed"].as_f64()
    }

    fn closed(&self) -> Option<f64> {
        self.first["gain"]["closed"].as_f64()
    }

    /// Share of the gap that the second diagnosis finds closed, in the channels of the first one's totals.
    fn reached(&self) -> Option<f64> {
        let (first, second) = (&self.first["gain"]["channels"], &self.second.as_ref().ok()?["gain"]["channels"]);
        let counted: Vec<&str> = self.first["gain"]["counted"].as_array()?.iter().filter_map(Value::as_str).collect();
        let sum = |gain: &Value, k: usize| counted.iter().filter_map(|c| gain[*c][k].as_f64()).sum::<f64>();
        share(sum(first, 0), sum(second, 0), sum(first, 2))
    }

    /// By channel: its share of the whole gap, before and floor of the first diagnosis, before of the second, and the
    /// share that was reached.
    fn channels(&self) -> Vec<(String, [f64; 4], Option<f64>)> {
        let first = &self.first["gain"];
        let Ok(second) = &self.second else { return vec![] };
        let whole = first["before"].as_f64().unwrap_or(0.0) - first["floor"].as_f64().unwrap_or(0.0);
        let Some(channels) = first["channels"].as_object() else { return vec![] };
        let of = |(name, values): (&String, &Value)| {
            let [before, floor] = [values[0].as_f64()?, values[2].as_f64()?];
            let again = second["gain"]["channels"][name][0].as_f64()?;
            let of_whole = if whole > 0.0 { (before - floor) / whole } else { 0.0 };
            Some((name.clone(), [of_whole, before, floor, again], share(before, again, floor)))
        };
        channels.iter().filter_map(of).collect()
    }

    /// Names of the findings of the second diagnosis.
    fn again(&self) -> Vec<String> {
        self.second.as_ref().map(findings).unwrap_or_default()
    }

    fn is_silent(&self) -> bool {
        self.second.is_ok() && self.again().is_empty()
    }

    fn line(&self) -> String {
        let hidden: Vec<String> =
            self.outcome.truth.hidden.iter().map(|h| format!("{:?} touched {}", h.parameters, h.touched)).collect();
        let shown = self.channels().into_iter().filter(|(_, values, _)| values[0] >= SHOWN_SHARE);
        let channels: Vec<String> = shown.map(|(name, _, reached)| format!("{name} {}", percent(reached))).collect();
        let again = match &self.second {
            Ok(_) => self.again().join(", "),
            Err(e) => format!("error: {e}"),
        };
        let left_out: Vec<&str> = self.left_out.iter().map(|l| l.split("; ").next().unwrap_or(l)).collect();
        format!(
            "{} {} [{}] {} -> {}: {{{}}} predicted {} closed {} reached {} ({}) applied [{}] left out [{}] then {} \
             {{{again}}} {:.0} s",
            self.outcome.truth.seed,
            name(self.kind),
            hidden.join("; "),
            variant_text(self.variant),
            self.outcome.grade(),
            findings(&self.first).join(", "),
            percent(self.predicted()),
            percent(self.closed()),
            percent(self.reached()),
            channels.join(", "),
            self.applied.join(", "),
            left_out.join("; "),
            self.again().len(),
            self.seconds.iter().sum::<f64>(),
        )
    }

    fn json(&self) -> Value {
        let channels: serde_json::Map<String, Value> = self
            .channels()
            .into_iter()
            .map(|(name, [of_whole, before, floor, again], reached)| {
                let values = json!({
                    "share_of_gap": of_whole, "before": before, "floor": floor, "second_before": again,
                    "reached": reached,
                });
                (name, values)
            })
            .collect();
        json!({
            "seed": self.outcome.truth.seed,
            "kind": name(self.kind),
            "variant": self.variant,
            "grade": self.outcome.grade(),
            "found": findings(&self.first),
            "predicted": self.predicted(),
            "closed": self.closed(),
            "reached": self.reached(),
            "channels": channels,
            "applied": self.applied,
            "left_out": self.left_out,
            "second_found": self.again(),
            "second_error": self.second.as_ref().err(),
            "gain": self.first["gain"],
            "second_gain": self.second.as_ref().map_or(Value::Null, |s| s["gain"].clone()),
            "outcome": self.outcome,
            "seconds": { "draw": self.seconds[0], "diagnose": self.seconds[1], "apply": self.seconds[2],
                         "diagnose_again": self.seconds[3] },
        })
    }
}

/// (before - again) / (before - floor); `None` where there is no gap.
fn share(before: f64, again: f64, floor: f64) -> Option<f64> {
    (before > floor).then(|| (before - again) / (before - floor))
}

fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "-".into(), |v| format!("{:.0} %", 100.0 * v))
}

fn variant_text(v: Variant) -> String {
    let rows = if v.rig_has_pattern { "rows known" } else { "rows not known" };
    format!("{} sensors, {}, {rows}", v.sensors.unwrap_or(0), v.intensity.name())
}

/// The Markdown table: a row per kind, in the order of the causes.
fn table(runs: &[Run]) -> String {
    let mut text = String::from(
        "| kind | cases | right | predicted | closed | reached: median | minimum | second diagnosis silent |\n\
         |---|---|---|---|---|---|---|---|\n",
    );
    for kind in CAUSES.into_iter().chain(["null"]) {
        let of: Vec<&Run> = runs.iter().filter(|r| name(r.kind) == kind).collect();
        if of.is_empty() {
            continue;
        }
        let middle = |of_run: fn(&Run) -> Option<f64>| median_upper(of.iter().filter_map(|r| of_run(r)).collect());
        let least = of.iter().filter_map(|r| r.reached()).reduce(f64::min);
        let right = of.iter().filter(|r| ["right", "clean"].contains(&r.outcome.grade())).count();
        let silent = of.iter().filter(|r| r.is_silent()).count();
        text += &format!(
            "| {kind} | {} | {right} | {} | {} | {} | {} | {silent} of {} |\n",
            of.len(),
            percent(middle(Run::predicted)),
            percent(middle(Run::closed)),
            percent(middle(Run::reached)),
            percent(least),
            of.len()
        );
    }
    text
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn main() {
    let Some(arguments) = arguments() else {
        println!("{HELP}");
        return;
    };
    let mut json = arguments.json.as_ref().map(|path| fs_err::File::create(path).expect("a file for results"));
    let mut runs = Vec::new();
    for seed in seeds(&arguments) {
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = arguments.keep.as_deref().unwrap_or(temporary.path()).join(seed.to_string());
        let run = run(seed, arguments.size, &folder);
        println!("{}", run.line());
        if let Some(file) = &mut json {
            writeln!(file, "{}", run.json()).expect("a result can be written");
        }
        runs.push(run);
    }
    println!("\n{}", table(&runs));
}
