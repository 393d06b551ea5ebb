//! `lidarshift diagnose --detectors STUDY`: measures whether detectors trained on the extended simulation are better on
//! measured data.

use crate::device::DeviceArgs;
use crate::json::JsonArgs;
use crate::study::run_study;
use anyhow::{Context, Result, bail};
use data::{Dataset, write_atomic};
use diagnose::DetectorGain;
use eval::matrix::{Matrix, Quantity};
use sensor::finished::Refusal;
use sensor::{EffectList, Rig};
use simulate::resim::Resim;
use std::path::{Path, PathBuf};
use study::numbers::{StudyState, matrix};
use study::{RunOptions, Source, Study, StudyConfig, StudyDataset};

/// Folder of the study in that of the diagnosis.
pub(super) const STUDY: &str = "detectors";

const MEASURED: &str = "measured";
const BEFORE: &str = "simulated";
const AFTER: &str = "extended";

/// Trains the detectors of the study `named`, with its seeds and epochs, on measured, simulated and extended data, and
/// tests all of them on measured frames. The study is written to `out`; an interrupted one is resumed. Also returns a
/// note for each effect of `extended` that is left out because it cannot be applied to existing point clouds.
///
/// # Errors
/// An invalid study, a simulated data set to which effects cannot be applied, failed runs.
pub(super) fn gain_of_detectors(
    named: &str,
    measured: &Path,
    simulated: &Path,
    (extended, sensor): (&Path, Option<&Path>),
    out: &Path,
) -> Result<(Vec<DetectorGain>, Vec<String>)> {
    let template = Study::open(named, None)?.config;
    let (effects, left_out) = applicable(simulated, extended, sensor, out)?;
    let path = out.join("detectors.toml");
    let text = toml::to_string(&study_of(template, measured, simulated, (&effects, sensor))?)?;
    write_atomic(&path, text.as_bytes())?;
    let Some(path) = path.to_str() else {
        bail!("--out {}: with --detectors the path has to be UTF-8", out.display());
    };
    let study = Study::open(path, Some(&out.join(STUDY)))?;
    run_study(&study, &RunOptions::here(DeviceArgs::default().arguments()), &JsonArgs::default())?;
    Ok((gains(&matrix(&study, &StudyState::read(&study)?)?)?, left_out))
}

/// The file of the effects that can be applied to the simulated data set, and a note for each effect that is left out.
/// It is `extended` itself if none is left out.
fn applicable(simulated: &Path, extended: &Path, sensor: Option<&Path>, out: &Path) -> Result<(PathBuf, Vec<String>)> {
    let rig = sensor.map(Rig::read).transpose()?;
    let (dataset, effects) = (Dataset::open(simulated)?, EffectList::read(extended)?);
    let refused = Resim { dataset: &dataset, effects: &effects, rig, seed: 0 }.refused()?;
    if refused.is_empty() {
        return Ok((extended.to_path_buf(), vec![]));
    }
    let effects = effects.without(&refused);
    let path = out.join("extended_detectors.toml");
    write_atomic(&path, toml::to_string(&effects)?.as_bytes())?;
    let note =
        |r: Refusal| format!("the detectors are trained without an effect of extended.toml: {} {}", r.kind, r.why);
    Ok((path, refused.into_iter().map(note).collect()))
}

/// The template with its data sets replaced by those of a diagnosis.
fn study_of(
    template: StudyConfig,
    measured: &Path,
    simulated: &Path,
    (extended, sensor): (&Path, Option<&Path>),
) -> Result<StudyConfig> {
    let absolute = |path: &Path| data::absolute(path).map(Source::Path);
    let set = |name: &str, title: &str, source| StudyDataset {
        name: name.into(),
        title: title.into(),
        paper: None,
        scene_of: None,
        sensor_of: None,
        source,
    };
    let made_anew = Source::Resim {
        of: BEFORE.into(),
        effects: std::path::absolute(extended)?,
        sensor: sensor.map(std::path::absolute).transpose()?,
    };
    let mut study = template;
    study.name = "detectors".into();
    study.datasets = vec![
        set(MEASURED, "Measured", absolute(measured)?),
        set(BEFORE, "Simulated", absolute(simulated)?),
        set(AFTER, "Extended", made_anew),
    ];
    study.evaluation.tsne_dataset = None;
    for detector in &mut study.detectors {
        (detector.train, detector.paper) = (None, None);
        if let Some(config) = &detector.config {
            bail!(
                "--detectors: {} uses the file {}; only the detectors of configs/detectors are supported",
                detector.name,
                config.display()
            );
        }
    }
    Ok(study)
}

/// AP (area under the curve) on measured frames with and without the extension, for every detector, class and overlap.
fn gains(matrix: &Matrix) -> Result<Vec<DetectorGain>> {
    let found = matrix.gaps.iter().filter(|gap| {
        (&*gap.test_set, &*gap.compared_to, &*gap.train_set) == (MEASURED, AFTER, BEFORE)
            && gap.section.is_none()
            && gap.quantity == Quantity::ApArea
    });
    let gains = found.map(|gap| {
        let mean = |train_set: &str| {
            let cell = matrix
                .cells
                .iter()
                .find(|cell| (&cell.network, &*cell.train_set, &*cell.test_set) == (&gap.network, train_set, MEASURED));
            let number = cell.and_then(|cell| cell.number(&gap.class, None, Quantity::ApArea, gap.overlap));
            let (cell, number) = cell.zip(number).with_context(|| format!("no run trained on {train_set}"))?;
            Ok::<_, anyhow::Error>((cell.frames.unwrap_or(0), cell.n_done(), number.mean.unwrap_or(f64::NAN)))
        };
        let ((_, _, before), (frames, runs, after), (_, _, ceiling)) = (mean(BEFORE)?, mean(AFTER)?, mean(MEASURED)?);
        Ok(DetectorGain {
            detector: gap.network.clone(),
            class: gap.class.clone(),
            overlap: gap.overlap,
            frames,
            runs,
            before,
            after,
            ceiling,
            gain: gap.gap,
            ci95: gap.interval.map(|interval| [interval.low, interval.high]),
        })
    });
    gains.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_template_gets_the_data_sets_of_the_diagnosis() {
        let template = Study::open("gain", None).unwrap().config;
        assert_eq!(template.seeds.len(), 5);
        let study =
            study_of(template, Path::new("/a/real"), Path::new("/a/sim"), (Path::new("/a/extended.toml"), None))
                .unwrap();
        let text = toml::to_string(&study).unwrap();
        let again = StudyConfig::parse(&text, Path::new("detectors.toml")).unwrap();
        assert_eq!(again, study);
        assert_eq!(again.datasets[0].source, Source::Path("/a/real".into()));
        let of_the_simulation = Source::Resim { of: BEFORE.into(), effects: "/a/extended.toml".into(), sensor: None };
        assert_eq!(again.datasets[2].source, of_the_simulation);
    }
}
