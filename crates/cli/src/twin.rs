//! `lidarshift twin`: makes a simulated partner of a recording.

use crate::json::JsonArgs;
use crate::{errln, outln};
use anyhow::{Context, Result, bail};
use clap::Args;
use data::Dataset;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;
use twin::map::FusionConfig;
use twin::{AgreementNumbers, Leave, PoseOptions, PoseSource, Recording, TwinConfig, TwinReport, pair};

/// Make a simulated partner of a recording that has no simulation: a map of all scans, the labelled objects, and the
/// same shots again from the recorded poses. No frame is shot with a map that it is part of.
///
/// DIR/measured and DIR/sim have the same ids and labels: diagnose, study and compare take them as a pair.
/// DIR/twin.json says how well both agree, and which effects of the sensor are in the map and cannot be found.
///
/// Examples:
///   lidarshift twin /data/drive_0001 --out twins/drive_0001
///   lidarshift diagnose --measured twins/drive_0001/measured --simulated twins/drive_0001/sim --out results
///   lidarshift twin /data/drive_0001 --odometry --leave 1.0 --out twins/by_odometry
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct TwinArgs {
    /// Recording: its folder or its TOML; see docs/src/reference/formats.md
    #[arg(value_name = "RECORDING")]
    recording: PathBuf,
    /// Folder for the twin: new, empty, or of an interrupted run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The sequence (scene, drive) of a data set that has several
    #[arg(long, value_name = "NAME")]
    sequence: Option<String>,
    /// Use only the first N frames
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Find the poses by aligning the scans, even if the recording has poses
    #[arg(long)]
    odometry: bool,
    /// Use the poses as they are [default: they are refined against the planes that all scans show]
    #[arg(long)]
    keep_poses: bool,
    /// Leave frames that are nearer in time than this out of the map that a frame is shot with, s [default: the map is
    /// made of every second frame]
    #[arg(long, value_name = "S")]
    leave: Option<f64>,
    /// Memory that a map may take, MiB [default: half of what is available]
    #[arg(long, value_name = "MIB")]
    memory: Option<u64>,
    /// Write the static maps as PLY files
    #[arg(long)]
    maps: bool,
    #[command(flatten)]
    json: JsonArgs,
}

/// Memory that a map may take where the system does not say what is available, MiB.
const WITHOUT_LIMIT_MIB: u64 = 8192;

impl TwinArgs {
    /// Makes the twin and prints how well it agrees with the recording.
    pub fn run(self) -> Result<()> {
        let leave = match self.leave {
            None => Leave::Alternate,
            Some(seconds) if seconds > 0.0 && seconds < 1e6 => Leave::Seconds(seconds),
            Some(seconds) => bail!("--leave {seconds}: give seconds above 0"),
        };
        let dataset = Dataset::open(&self.recording)?;
        dataset.refuse_own_folder(&self.out)?;
        self.json.check([])?;
        errln!("reading the scans and their poses");
        let options = PoseOptions { odometry: self.odometry, refine: !self.keep_poses };
        let recording = Recording::open(dataset, self.sequence.as_deref(), self.frames, options)
            .with_context(|| format!("a twin of {}", self.recording.display()))?;
        let progress = ProgressBar::new(0)
            .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?);
        let most_mib = self.memory.or_else(|| Some(study::free_mib()? / 2)).unwrap_or(WITHOUT_LIMIT_MIB);
        let config = TwinConfig {
            leave,
            fusion: FusionConfig::default(),
            most_bytes: most_mib.saturating_mul(1 << 20),
            write_maps: self.maps,
        };
        let report = pair::make(&recording, &config, &self.out, &|done, total| {
            progress.set_length(total as u64);
            progress.set_position(done as u64);
        })
        .with_context(|| format!("a twin of {}", self.recording.display()))?;
        progress.finish_and_clear();
        self.json.write(&report)?;
        print(&report);
        let [measured, sim] = ["measured", "sim"].map(|side| self.out.join(side));
        errln!("twin written to {}", self.out.display());
        errln!(
            "next: lidarshift diagnose --measured {} --simulated {} --out RESULTS",
            measured.display(),
            sim.display()
        );
        Ok(())
    }
}

fn print(report: &TwinReport) {
    let poses = match report.poses {
        PoseSource::Recording => "of the recording",
        PoseSource::Odometry => "by aligning the scans",
    };
    outln!("{} frames; poses {poses}", report.frames);
    if let (Some([before, after]), Some(moved)) = (report.wall_thickness_m, report.farthest_moved_m) {
        let [before, after, moved] = [before, after, moved].map(|m| 100.0 * m);
        outln!("refined poses: walls {before:.2} cm thick before, {after:.2} cm after; moved by up to {moved:.1} cm");
    }
    let [recorded, measured, sim] = report.returns_per_frame;
    outln!(
        "returns a frame: {recorded:.0} recorded, {measured:.0} where the twin knows the world, {sim:.0} in the twin"
    );
    line("static world", &report.static_world);
    if report.objects.measured_returns > 0 {
        line("objects", &report.objects);
    }
    let names: Vec<&str> = report.baked_in.iter().map(|b| b.cause.as_str()).collect();
    outln!("in both sides, so that a diagnosis cannot tell them: {}", names.join(", "));
    for note in &report.notes {
        outln!("note: {note}");
    }
}

fn line(name: &str, a: &AgreementNumbers) {
    let [met, twin_met] = [a.met_share, a.twin_met_share].map(|v| 100.0 * v);
    let ranges = match (a.median_abs_m, a.within_10_cm) {
        (Some(median), Some(within)) => {
            format!("{:.1} cm apart in the median, {:.0} % within 10 cm", 100.0 * median, 100.0 * within)
        }
        _ => "no shot returns on both sides".into(),
    };
    outln!("{name}: {ranges}; {met:.1} % of the recorded returns are met, {twin_met:.1} % of the twin's");
}
