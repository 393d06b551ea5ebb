//! `lidarshift diagnose`: finds the differences between measured and simulated data, their causes and a correction.

mod detectors;
mod previous;
mod print;
mod simulator;

use crate::commands::{End, called};
use crate::errln;
use crate::json::JsonArgs;
use anyhow::{Context, Result, bail};
use clap::Args;
use data::write::{REPAIRED_ENDINGS, write_kitti_text};
use data::{DataError, Dataset, ErrorKind, FolderLock, LabelBox, write_atomic, write_json};
use detectors::{STUDY, gain_of_detectors};
use diagnose::{
    Cause, Diagnosis, OnClouds, Options, Outcome, Progress, Remake, Rig, Stage, Unidentifiable, Verdict, Verification,
    diagnose_scans, diagnose_unpaired, diagnose_with, verify,
};
use indicatif::{ProgressBar, ProgressStyle};
use print::{print_diagnosis, print_gain, print_gains};
use report::{DiagnosisReport, Link, write_finding_pictures};
use sensor::EffectList;
use simulate::race::RaceConfig;
use simulator::RaceSimulator;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use study::Study;
use twin::TwinReport;

/// Compare measured data with a scenario-identical simulation. Each finding has its cause, its parameters with 95 %
/// confidence intervals, and the gain of correcting it. With --scans, compare the scans of one spinning sensor with an
/// ideal sensor on surfaces whose shape is known: ground and walls.
///
/// Exit codes: 0 the diagnosis was made, whatever its verdict; 1 it could not be made; 2 wrong arguments; 3 the two
/// data sets do not show the same scenes (also the verdict in diagnosis.json).
///
/// Examples:
///   lidarshift diagnose --measured datasets/measured --simulated datasets/sim --sensor configs/sensors/av21.toml
///   lidarshift diagnose --measured real --simulated sim --sensor rig.toml --split test --out runs/diagnosis
///   lidarshift diagnose --unpaired --measured real --simulated town --sensor rig.toml --out runs/unpaired
///   lidarshift diagnose --scans datasets/kitti.toml --sensor configs/sensors/hdl64e.toml --out runs/scans
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct DiagnoseArgs {
    /// Measured data set: folder or TOML
    #[arg(long, value_name = "DATASET", required_unless_present = "scans", requires = "simulated")]
    measured: Option<PathBuf>,
    /// Simulated data set with the same frame ids (with --unpaired: with any): folder or TOML
    #[arg(long, value_name = "DATASET", requires = "measured")]
    simulated: Option<PathBuf>,
    /// The two data sets show different streets, seen by the same sensor or by its model: compare only what each side
    /// shows by itself, and list what cannot be identified
    #[arg(long, requires = "measured", conflicts_with_all = ["scans", "verify"])]
    unpaired: bool,
    /// Data set with raw scans of one spinning sensor, compared with an ideal sensor; needs no simulated data set
    #[arg(long, value_name = "DATASET", conflicts_with_all = ["measured", "simulated", "simulator"])]
    scans: Option<PathBuf>,
    /// TOML with the poses of the sensors [default: from the TOML of the simulated data set, else one sensor at the
    /// origin of the clouds]
    #[arg(long, value_name = "TOML")]
    sensor: Option<PathBuf>,
    /// Configuration of the simulation that made the simulated data: the poses of the sensors are read from it, and the
    /// gain is measured on frames that it simulates anew [default: the finished clouds are changed, as by `resim`]
    #[arg(long, value_name = "CONFIG", conflicts_with = "sensor")]
    simulator: Option<String>,
    /// Measure only what this list of effects gains, one that was edited by hand or made elsewhere: the frames that a
    /// diagnosis holds out are made anew with it. Writes verification.json
    #[arg(long, value_name = "TOML", requires = "measured", conflicts_with = "detectors")]
    verify: Option<PathBuf>,
    /// Use only the frames of this split [default: all frames that both data sets have]
    #[arg(long, value_name = "NAME")]
    split: Option<String>,
    /// Folder for report.html, diagnosis.json, extended.toml, a figure per finding and, if labels are wrong, corrected
    /// labels in label_2/
    #[arg(long, value_name = "DIR", default_value = "runs/diagnosis")]
    out: PathBuf,
    /// Also train the detectors of this study, with its seeds and epochs, on measured, simulated and extended data, and
    /// test them on measured frames; the study `gain` is made for this
    #[arg(long, value_name = "STUDY", requires = "measured")]
    detectors: Option<String>,
    #[command(flatten)]
    json: JsonArgs,
}

impl DiagnoseArgs {
    /// Makes the diagnosis, writes its files and prints verdict and findings.
    pub fn run(self) -> Result<End> {
        let rig = self.rig()?;
        if self.out.is_file() {
            let message = "is a file, but must be a folder; choose another --out";
            return Err(DataError::of_kind(ErrorKind::Refused, &self.out, message).into());
        }
        self.check_outputs()?;
        let _lock = FolderLock::acquire(&self.out)?;
        let bar = ProgressBar::new(1).with_style(
            ProgressStyle::with_template("{msg:<20} {bar:30} {pos}/{len}, {eta} left").context("a template")?,
        );
        let show_progress = |stage: Stage, done: usize, of: usize| {
            bar.set_message(match stage {
                Stage::Comparing => "comparing scenes",
                Stage::Pairing => "pairing frames",
                Stage::Weighing => "testing causes",
                Stage::Verifying => "measuring the gain",
            });
            bar.set_length(of as u64);
            bar.set_position(done as u64);
        };
        let options = self.options()?;
        if let (Some(list), Some(measured), Some(simulated)) = (&self.verify, &self.measured, &self.simulated) {
            let end = self.verify(list, measured, simulated, &rig, &options, &show_progress)?;
            bar.finish_and_clear();
            return Ok(end);
        }
        let (measured, outcome) = match (&self.scans, &self.measured, &self.simulated) {
            (Some(scans), ..) => {
                let scans = Dataset::open(scans)?;
                let outcome = diagnose_scans(&scans, &rig, &options, &show_progress)?;
                (scans, outcome)
            }
            (None, Some(measured), Some(simulated)) => {
                let (measured, simulated) = (Dataset::open(measured)?, Dataset::open(simulated)?);
                let remake = self.remake(&simulated, &rig);
                if self.unpaired {
                    let remake = remake.as_ref();
                    let outcome = diagnose_unpaired(&measured, &simulated, &rig, &options, remake, &show_progress)?;
                    return self.finish(outcome, &measured, &bar);
                }
                let twin = twin::pair::twin_of(&simulated)?;
                let baked_in = twin.iter().flat_map(|twin| &twin.baked_in).filter_map(known_cause).collect();
                let options = Options { baked_in, ..options.clone() };
                let mut outcome =
                    diagnose_with(&measured, &simulated, &rig, &options, remake.as_ref(), &show_progress)?;
                outcome.diagnosis.notes.extend(twin.as_ref().map(TwinReport::note_for_diagnosis));
                // Labels that both sides share cannot be corrected by the pair.
                if options.baked_in.iter().any(|b| b.cause == Cause::LabelOffset) {
                    outcome.corrected.clear();
                }
                (measured, outcome)
            }
            _ => bail!("give --measured and --simulated, or --scans"),
        };
        self.finish(outcome, &measured, &bar)
    }

    /// Writes and prints a diagnosis, and trains detectors where they were asked for.
    fn finish(&self, mut outcome: Outcome, measured: &Dataset, bar: &ProgressBar) -> Result<End> {
        bar.finish_and_clear();
        previous::remove(&self.out)?;
        let with_detectors = self.detectors.is_some() && !outcome.diagnosis.findings.is_empty();
        // Stdout gets the diagnosis once, with the detectors.
        self.write_json(&outcome.diagnosis, !(with_detectors && self.json.is_stdout()))?;
        write_atomic(&self.out.join("extended.toml"), outcome.extended.as_bytes())?;
        write_finding_pictures(&outcome.diagnosis, &self.out)?;
        self.write_page(&outcome, vec![])?;
        for (id, boxes) in &outcome.corrected {
            for (ending, boxes) in REPAIRED_ENDINGS.iter().zip(boxes) {
                write_labels(&self.out.join(format!("{}{ending}", previous::LABELS)), measured, id, boxes)?;
            }
        }
        print_diagnosis(&outcome.diagnosis, &self.out, outcome.corrected.len());
        if let (Some(study), Some(measured), Some(simulated)) = (&self.detectors, &self.measured, &self.simulated)
            && with_detectors
        {
            let extended = self.out.join("extended.toml");
            let (gains, left_out) =
                gain_of_detectors(study, measured, simulated, (&extended, self.sensor.as_deref()), &self.out)?;
            print_gains(&gains, &left_out);
            outcome.diagnosis.detectors = gains;
            outcome.diagnosis.notes.extend(left_out);
            self.write_json(&outcome.diagnosis, true)?;
            let of_study =
                Link::to_file(&self.out, &self.out.join(STUDY).join("report.html"), "The study of the detectors");
            self.write_page(&outcome, of_study.into_iter().collect())?;
        }
        Ok(end_of(&outcome.diagnosis))
    }

    /// Refuses outputs that would overwrite a data set, and those that cannot be written, before the work begins.
    fn check_outputs(&self) -> Result<()> {
        for path in [&self.measured, &self.simulated, &self.scans].into_iter().flatten() {
            Dataset::open(path)?.refuse_own_folder(&self.out)?;
        }
        if Dataset::open(&self.out).is_ok() {
            let message = "is a data set, whose labels would be overwritten; choose another --out";
            return Err(DataError::of_kind(ErrorKind::Refused, &self.out, message).into());
        }
        let inputs = [&self.verify, &self.sensor].into_iter().flatten().map(PathBuf::as_path);
        Ok(self.json.check(inputs)?)
    }

    /// What the diagnosis leaves out: the frames on which detectors are tested.
    fn options(&self) -> Result<Options> {
        let mut options = Options { split: self.split.clone(), ..Options::default() };
        let (Some(study), Some(measured)) = (&self.detectors, &self.measured) else { return Ok(options) };
        let test = Study::open(study, None)?.config.splits.test;
        let dataset = Dataset::open(measured)?;
        let tested: BTreeSet<String> = dataset
            .ids(&test)
            .with_context(|| format!("--detectors tests on the split {test:?} of the measured data"))?
            .into_iter()
            .collect();
        if let Some(split) = &self.split {
            let used = dataset.ids(split)?;
            if let Some(id) = used.iter().find(|id| tested.contains(*id)) {
                bail!(
                    "--split {split}: its frame {id} is also in the split {test:?}, on which --detectors tests: leave \
                     --split out, and the diagnosis uses all other frames"
                );
            }
        }
        options.leave_out = tested;
        Ok(options)
    }

    /// How frames of the simulation are made anew.
    fn remake<'s>(&self, simulated: &'s Dataset, rig: &'s Rig) -> Box<dyn Remake + 's> {
        let Some(config) = &self.simulator else { return Box::new(OnClouds { simulated, rig }) };
        match RaceSimulator::open(config, simulated) {
            Ok(simulator) => Box::new(simulator),
            Err(error) => {
                errln!("note: the gain is measured on changed clouds, not by the simulator: {error:#}");
                Box::new(OnClouds { simulated, rig })
            }
        }
    }

    /// Measures the gain of a list of effects, writes verification.json and prints it.
    fn verify(
        &self,
        list: &Path,
        measured: &Path,
        simulated: &Path,
        rig: &Rig,
        options: &Options,
        progress: Progress,
    ) -> Result<End> {
        let effects = EffectList::read(list)?;
        if effects.effects.is_empty() {
            return Err(DataError::file(list, "has no effect, and so no gain").into());
        }
        let (measured, simulated) = (Dataset::open(measured)?, Dataset::open(simulated)?);
        if let Some(made) = &effects.made_from {
            let own: Vec<&str> = rig.sensors.iter().map(|s| s.name.as_str()).collect();
            if own != made.sensors {
                let [made, own] = [made.sensors.join(", "), own.join(", ")];
                let message =
                    format!("was made for the sensors {made}, but the rig has {own}: give that rig (--sensor)");
                return Err(DataError::file(list, message).into());
            }
        }
        let remake = self.remake(&simulated, rig);
        match verify(&measured, &simulated, rig, options, &effects, remake.as_ref(), progress)? {
            Ok(gain) => {
                let verification = Verification::new(gain);
                write_json(&self.out.join("verification.json"), &verification)?;
                self.json.write(&verification)?;
                print_gain(&verification.gain, &list.display().to_string());
                Ok(End::Done)
            }
            Err(diagnosis) => {
                self.json.write(&diagnosis)?;
                print_diagnosis(&diagnosis, &self.out, 0);
                Ok(end_of(&diagnosis))
            }
        }
    }

    /// Writes diagnosis.json, and what `--json` asks for if it is `also` wanted.
    fn write_json(&self, diagnosis: &Diagnosis, also: bool) -> Result<()> {
        write_json(&self.out.join("diagnosis.json"), diagnosis)?;
        if also {
            self.json.write(diagnosis)?;
        }
        Ok(())
    }

    fn write_page(&self, outcome: &Outcome, links: Vec<Link>) -> Result<()> {
        let sets = [&self.measured, &self.simulated, &self.scans].into_iter().flatten();
        let names: Vec<String> = sets.map(|path| path.display().to_string()).collect();
        let Outcome { diagnosis, view, .. } = outcome;
        let title = names.join(" against ");
        let report = DiagnosisReport { diagnosis, view: view.as_ref(), links, title, command: called() };
        Ok(report.write(&self.out)?)
    }

    fn rig(&self) -> Result<Rig> {
        match (&self.sensor, &self.simulator) {
            (Some(path), _) => Ok(Rig::read(path)?),
            (None, Some(config)) => {
                let (race, files) = RaceConfig::find(config).with_context(|| format!("--simulator {config}"))?;
                let (text, path) = files.text(&race.rig)?;
                Ok(Rig::parse(&text, &path)?)
            }
            (None, None) => match self.simulated.as_deref().map(Dataset::open).transpose()?.map(|set| set.config.rig) {
                Some(Some(path)) => Ok(Rig::read(&path)?),
                _ => Ok(Rig::single()),
            },
        }
    }
}

/// What a twin cannot tell, where the catalogue has it.
fn known_cause(of_twin: &twin::BakedIn) -> Option<Unidentifiable> {
    let cause = Cause::ALL.iter().copied().find(|cause| cause.name() == of_twin.cause)?;
    Some(Unidentifiable { cause, why: of_twin.why.clone(), tell_by: of_twin.tell_by.clone() })
}

fn end_of(diagnosis: &Diagnosis) -> End {
    match diagnosis.verdict {
        Verdict::NotScenarioIdentical => End::NotTheSameScenes,
        _ => End::Done,
    }
}

/// Writes the corrected labels of a frame into a folder, in the frame of the clouds, with the first class of the data
/// set.
fn write_labels(folder: &Path, measured: &Dataset, id: &str, boxes: &[geometry::Box3]) -> Result<()> {
    let class = measured.config.classes.first().map_or("Car", String::as_str);
    let lines: Vec<LabelBox> = boxes.iter().map(|b| LabelBox::from_box(class, b, None)).collect();
    Ok(write_kitti_text(&folder.join(format!("{id}.txt")), &lines)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_a_twin_cannot_tell_is_in_the_catalogue() {
        let of_twin = twin::baked_in();
        assert!(of_twin.len() > 10 && of_twin.iter().all(|b| known_cause(b).is_some()), "{of_twin:?}");
    }
}
