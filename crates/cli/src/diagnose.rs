//! `lidarshift diagnose`: what does the simulation get wrong, why, and what is gained by mending it.

mod detectors;

use crate::commands::End;
use anyhow::{Context, Result, bail};
use clap::Args;
use data::write::write_kitti_text;
use data::{Dataset, LabelBox, write_atomic, write_json};
use detectors::gain_of_detectors;
use diagnose::{
    DetectorGain, Diagnosis, Options, ParameterId, Rig, Stage, Verdict, diagnose, diagnose_scans, extended_toml,
};
use indicatif::{ProgressBar, ProgressStyle};
use report::{finding_name, write_finding_pictures};
use simulate::race::RaceConfig;
use std::path::{Path, PathBuf};

/// Compare measured data with their scenario-identical simulation: name what differs, with parameters and intervals, and measure what is
/// gained by mending it. Or, with --scans, compare the scans of one spinning sensor with an ideal one where their scene is known: ground and walls.
///
/// Exit codes: 0 when the diagnosis could be made, whatever it says; 3 when the two do not show the same scenes (diagnosis.json says so); 1 when
/// it could not be made; 2 when the words could not be understood.
///
/// Examples:
///   lidarshift diagnose --measured datasets/measured --simulated datasets/sim --sensor configs/sensors/av21.toml
///   lidarshift diagnose --measured real --simulated sim --sensor rig.toml --split test --out runs/diagnosis
///   lidarshift diagnose --scans datasets/kitti.toml --sensor configs/sensors/hdl64e.toml --out runs/scans
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct DiagnoseArgs {
    /// Measured data set: its folder or its TOML
    #[arg(long, value_name = "DATASET", required_unless_present = "scans", requires = "simulated")]
    measured: Option<PathBuf>,
    /// Simulated data set with the same frame ids
    #[arg(long, value_name = "DATASET", requires = "measured")]
    simulated: Option<PathBuf>,
    /// Scans of one spinning sensor, as its files have them, to be diagnosed against an ideal sensor without a simulation of the scenes
    #[arg(long, value_name = "DATASET", conflicts_with_all = ["measured", "simulated", "simulator"])]
    scans: Option<PathBuf>,
    /// Places and directions of the sensors; without it one sensor at the origin of the clouds is assumed
    #[arg(long, value_name = "TOML")]
    sensor: Option<PathBuf>,
    /// Configuration of the simulation, for the places of its sensors where --sensor is not given
    #[arg(long, value_name = "CONFIG", conflicts_with = "sensor")]
    simulator: Option<String>,
    /// Only the frames of this split; without it all frames that both have
    #[arg(long, value_name = "NAME")]
    split: Option<String>,
    /// Folder for diagnosis.json, extended.toml, a picture of each finding and, where labels are at fault, label_2/
    #[arg(long, value_name = "DIR", default_value = "runs/diagnosis")]
    out: PathBuf,
    /// Train the detectors of this study, with its seeds and epochs, on measured, simulated and extended data, and test them on measured
    /// frames; `gain` is one for it
    #[arg(long, value_name = "STUDY", requires = "measured")]
    detectors: Option<String>,
    /// Write diagnosis.json here as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

impl DiagnoseArgs {
    /// Diagnoses, writes the files and says what was found.
    pub fn run(self) -> Result<End> {
        let rig = self.rig()?;
        if self.out.is_file() {
            bail!("--out {}: is a file; a folder is wanted", self.out.display());
        }
        let bar = ProgressBar::new(1).with_style(
            ProgressStyle::with_template("{msg:<20} {bar:30} {pos}/{len}, {eta} left").context("a template")?,
        );
        let told = |stage: Stage, done: usize, of: usize| {
            bar.set_message(match stage {
                Stage::Comparing => "comparing scenes",
                Stage::Pairing => "pairing frames",
                Stage::Weighing => "weighing causes",
            });
            bar.set_length(of as u64);
            bar.set_position(done as u64);
        };
        let options = Options { split: self.split.clone() };
        let (measured, mut outcome) = match (&self.scans, &self.measured, &self.simulated) {
            (Some(scans), ..) => {
                let scans = Dataset::open(scans)?;
                let outcome = diagnose_scans(&scans, &rig, &options, &told)?;
                (scans, outcome)
            }
            (None, Some(measured), Some(simulated)) => {
                let (measured, simulated) = (Dataset::open(measured)?, Dataset::open(simulated)?);
                let outcome = diagnose(&measured, &simulated, &rig, &options, &told)?;
                (measured, outcome)
            }
            _ => bail!("--measured and --simulated, or --scans, are wanted"),
        };
        bar.finish_and_clear();
        self.write_json(&outcome.diagnosis)?;
        write_atomic(&self.out.join("extended.toml"), extended_toml(&outcome.diagnosis).as_bytes())?;
        write_finding_pictures(&outcome.diagnosis, &self.out)?;
        for (id, boxes) in &outcome.corrected {
            write_labels(&self.out, &measured, id, boxes)?;
        }
        say(&outcome.diagnosis, &self.out, outcome.corrected.len());
        if let (Some(study), Some(measured), Some(simulated)) = (&self.detectors, &self.measured, &self.simulated)
            && !outcome.diagnosis.findings.is_empty()
        {
            let extended = self.out.join("extended.toml");
            let (gains, left_out) = gain_of_detectors(study, measured, simulated, &extended, &self.out)?;
            say_gains(&gains, &left_out);
            outcome.diagnosis.detectors = gains;
            outcome.diagnosis.notes.extend(left_out);
            self.write_json(&outcome.diagnosis)?;
        }
        Ok(match outcome.diagnosis.verdict {
            Verdict::NotScenarioIdentical => End::NotTheSameScenes,
            _ => End::Done,
        })
    }

    fn write_json(&self, diagnosis: &Diagnosis) -> Result<()> {
        write_json(&self.out.join("diagnosis.json"), diagnosis)?;
        if let Some(path) = &self.json {
            write_json(path, diagnosis)?;
        }
        Ok(())
    }

    fn rig(&self) -> Result<Rig> {
        match (&self.sensor, &self.simulator) {
            (Some(path), _) => Ok(Rig::read(path)?),
            (None, Some(config)) => {
                let (race, files) = RaceConfig::find(config).with_context(|| format!("--simulator {config}"))?;
                let (text, path) = files.text(&race.rig)?;
                Ok(Rig::parse(&text, &path)?)
            }
            (None, None) => Ok(Rig::single()),
        }
    }
}

/// Corrected labels, in the clouds' frame and of the data set's first class.
fn write_labels(out: &Path, measured: &Dataset, id: &str, boxes: &[geometry::Box3]) -> Result<()> {
    let class = measured.config.classes.first().map_or("Car", String::as_str);
    let lines: Vec<LabelBox> = boxes.iter().map(|b| LabelBox::from_box(class, b, None)).collect();
    Ok(write_kitti_text(&out.join(format!("label_2/{id}.txt")), &lines)?)
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn say(diagnosis: &Diagnosis, out: &Path, corrected: usize) {
    for note in &diagnosis.notes {
        eprintln!("note: {note}");
    }
    match diagnosis.verdict {
        Verdict::NotScenarioIdentical => println!("not scenario-identical: nothing else can be said"),
        Verdict::NothingFound => {
            println!("nothing found. The smallest effects that would have been seen:");
            for (cause, m) in &diagnosis.minimum_detectable {
                println!("  {cause}: {} {:.4} {}", m.parameter, m.value, m.unit);
            }
        }
        _ => {}
    }
    for f in &diagnosis.findings {
        let name = finding_name(f);
        println!("{name}: {}", f.says);
        for (parameter, p) in f.parameters.iter().filter(|(id, _)| matches!(id, ParameterId::Of(_))) {
            println!("  {parameter} = {:.4} {} ({:.4} to {:.4})", p.estimate, p.unit, p.ci95[0], p.ci95[1]);
        }
        if let Some(how) = &f.separate_by {
            println!("  to tell them apart: {how}");
        }
    }
    if let Some(closed) = diagnosis.gain.closed {
        println!(
            "of what the simulation was off on frames held out, {:.0} % are gone with the extended model",
            100.0 * closed
        );
    }
    if corrected > 0 {
        println!("corrected labels of {corrected} frames in {}", out.join("label_2").display());
    }
    eprintln!("diagnosis.json and extended.toml in {}", out.display());
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn say_gains(gains: &[DetectorGain], left_out: &[String]) {
    left_out.iter().for_each(|note| println!("note: {note}"));
    for g in gains {
        let interval = g.ci95.map_or(String::new(), |[low, high]| format!(" ({low:.1} to {high:.1})"));
        println!(
            "{}, {} at {}: AP on measured frames {:.1} when trained on the simulation, {:.1} on the extended one, {:.1} on measured data; \
             gain {:+.1}{interval} over {} runs each",
            g.detector, g.class, g.overlap, g.before, g.after, g.ceiling, g.gain, g.runs
        );
    }
}
