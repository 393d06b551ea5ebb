//! The large blind set: many cases with or without a hidden difference. Each result is written as soon as it is
//! available, so an interrupted run can be resumed.

use lidarshift_blind::{CAUSES, Kind, OFF_CATALOGUE, draw_case, write_case};
use rand::RngExt;
use score::{GROUPS, Outcome, markdown};
use trials::Trials;

const HELP: &str = "\
Draws pairs of a race track with hidden differences, diagnoses them and scores the answers. A line per case as it
finishes, then the summary and tables.

cargo xtask bench blind -- [OPTIONS]
  --kind KIND     null, single, pair, off, shuffled, swarm, or the name of a cause; repeated: in turn. Without it kinds
                  are drawn: null 25 %, single 47 %, pair 15 %, off 10 %, shuffled 3 %
  --first SEED    first seed [default: 1]
  --cases N       number of cases [default: 200]
  --frames N      frames per side [default: 40]
  --shots N       shots per scan [default: 25000]
  --out DIR       folder of the results [default: bench/blind]
  --keep DIR      keep the pairs in a folder, and reuse those already there
  --draw-only     draw pairs without diagnosing them
  --help          this text";

/// The kind of the case of a seed: drawn at random (25 % null, 47 % single, 15 % pair, 10 % off-catalogue, 3 %
/// shuffled), or the wanted one.
fn kind_of(seed: u64, wanted: Option<&str>) -> Kind {
    let mut rng = data::stream(seed, "blind kind", 0, 0);
    let cause = |name: &str| CAUSES.iter().position(|c| *c == name);
    let drawn = rng.random_range(0..100u32);
    let name = wanted.unwrap_or(match drawn {
        ..25 => "null",
        25..72 => "single",
        72..87 => "pair",
        87..97 => "off",
        _ => "shuffled",
    });
    match name {
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

/// A line about a case.
fn line(outcome: &Outcome) -> String {
    let hidden: Vec<String> = outcome.truth.hidden.iter().map(|h| format!("{} {:?}", h.cause, h.parameters)).collect();
    format!(
        "{}: {} [{}] -> {} named {:?} ambiguous {:?} unexplained {} closed {:?} {:.1} s",
        outcome.truth.seed,
        outcome.truth.kind,
        hidden.join("; "),
        outcome.grade(),
        outcome.named,
        outcome.ambiguous,
        outcome.unexplained,
        outcome.closed.map(|c| (c * 100.0).round() / 100.0),
        outcome.seconds
    )
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn main() {
    let Some(trials) = Trials::new(200, "bench/blind").with_arguments() else {
        println!("{HELP}");
        return;
    };
    let draw = |seed: u64, folder: &std::path::Path| {
        let case = draw_case(seed, kind_of(seed, trials.kind_of(seed)), trials.size);
        write_case(&case, folder).expect("a case can be written")
    };
    if let Some(summary) = trials.run(draw, line) {
        println!("{}\n{}", serde_json::to_string_pretty(&summary).expect("JSON"), markdown(&summary));
    }
}
