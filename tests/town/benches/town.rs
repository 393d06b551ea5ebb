//! The set of the second generator: many pairs with or without hidden differences, diagnosed and scored. Each result is
//! written as soon as it is available, so an interrupted run can be resumed.

use lidarshift_town::{Kind, draw_case, draw_case_of_two_towns, write_case};
use rand::RngExt;
use score::{Outcome, markdown};
use trials::Trials;

const HELP: &str = "\
Draws pairs of a town with hidden differences, diagnoses them and scores the answers. A line per case as it finishes,
then tables.

cargo xtask bench town -- [OPTIONS]
  --kind KIND     null, single, off, swarm, swarmN (N effects), alike, alikeN (the same N effects on both sides), pose,
                  poseN (up to N cm), buildings, consecutive, few_rows, no_labels, crawl, parallel, or the name of a
                  cause; repeated: in turn. Without it kinds are drawn: null 20 %, single 40 %, off 10 %, swarm 15 %,
                  each of the others but alike 2 to 3 %
  --first SEED    first seed [default: 1]
  --cases N       number of cases [default: 100]
  --frames N      frames per side [default: 40]
  --shots N       shots per scan; twice as many with 128 rows [default: 25000]
  --out DIR       folder of the results [default: bench/town]
  --keep DIR      keep the pairs in a folder, and reuse those already there
  --unpaired      the simulated side shows another town, and nothing is paired
  --draw-only     draw pairs without diagnosing them
  --help          this text";

/// The kind of a seed: the wanted one, or drawn.
fn kind_of(seed: u64, wanted: Option<&str>) -> Kind {
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
    let name = wanted.unwrap_or(drawn);
    Kind::parse(name, rng).unwrap_or_else(|| panic!("no such kind or cause: {name}; see --help"))
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
    let Some(trials) = Trials::new(100, "bench/town").with_arguments() else {
        println!("{HELP}");
        return;
    };
    let draw = |seed: u64, folder: &std::path::Path| {
        let kind = kind_of(seed, trials.kind_of(seed));
        let case = match trials.unpaired {
            true => draw_case_of_two_towns(seed, kind, trials.size),
            false => draw_case(seed, kind, trials.size),
        };
        write_case(&case, folder).expect("a case can be written")
    };
    if let Some(summary) = trials.run(draw, line) {
        println!("\n{}", markdown(&summary));
    }
}
