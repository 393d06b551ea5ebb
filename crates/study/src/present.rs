//! Writes the report of a study from the results in its folder.

use crate::clouds::{all_distances, all_targets};
use crate::config::{FrozenDetector, Source, StudyDataset, StudyRun};
use crate::data_sets::open;
use crate::error::Result;
use crate::features::features;
use crate::folder::Study;
use crate::numbers::{StudyState, analyses, matrix, network_title, some_test_frames};
use crate::{Event, Listener};
use data::LabelBox;
use data::Presence as _;
use eval::detections_of;
use eval::matrix::{Matrix, PairedDifference, Quantity, TestSet, shared_ids};
use geometry::Box3;
use report::{Layer, LayerContent, Link, ReportFiles, Scene, StudyReport, TrainingRun, read_training_run};
use std::path::PathBuf;

/// Number of test frames in the 3D view.
const SCENES: usize = 3;
/// Number of data sets whose clouds are shown in it.
const SCENE_SETS: usize = 2;
/// Colours of the layers of clouds, labels and detections. There are as many for detections as the paper has pairs of
/// network and train set.
const CLOUDS: [&str; SCENE_SETS] = ["#0072b2", "#d55e00"];
const LABELS: &str = "#009e73";
const DETECTIONS: [&str; 8] = ["#cc79a7", "#e69f00", "#56b4e9", "#f0e442", "#882255", "#44aa99", "#999933", "#8c6bb1"];

/// Evaluates the existing results, writes `report.html` with its figures and tables into the folder of the study, and
/// returns the matrix.
///
/// # Errors
/// Missing data sets, damaged files.
pub fn write_report(study: &Study, listener: Listener<'_>) -> Result<(Matrix, ReportFiles)> {
    let state = StudyState::read(study)?;
    listener(Event::Note("computing the matrix"));
    let matrix = matrix(study, &state)?;
    listener(Event::Note("analysing errors"));
    let analyses = analyses(study, &state)?;
    listener(Event::Note("comparing features"));
    let features = features(study)?;
    let (paired, paired_warnings) = state.frozen.paired(study, &state.key(study)?)?;
    let (distances, mut warnings) = all_distances(study, listener)?;
    listener(Event::Note("computing target statistics"));
    let targets = all_targets(study)?;
    warnings.extend(features.warnings);
    warnings.extend(paired_warnings);
    warnings.extend(frames_of_between(study)?);
    for warning in &warnings {
        listener(Event::Note(&format!("warning: {warning}")));
    }
    note_differences(study, &paired, listener);
    let report = StudyReport {
        title: format!("lidarshift study: {}", study.config.name),
        about: study.config.about.clone(),
        links: diagnoses(study),
        command: format!("lidarshift study {}", study.named),
        facts: facts(study)?,
        warnings,
        matrix: Some(matrix.clone()),
        paired,
        analyses,
        embeddings: features.embeddings,
        cka: features.cka,
        frechet: features.frechet,
        distances,
        targets,
        training: training(study)?,
        scenes: scenes(study, &state)?,
    };
    Ok((matrix, report.write(&study.folder)?))
}

/// Warnings for data sets that are to tell sensor from scene, but have other test frames than the two they stand
/// between.
fn frames_of_between(study: &Study) -> Result<Vec<String>> {
    let ids = |name: &str| -> Result<Vec<String>> { Ok(open(study, name)?.ids(&study.config.splits.test)?) };
    let mut warnings = Vec::new();
    for between in study.config.plan().between {
        let own = ids(&between.test_set)?;
        for name in [&between.scene_of, &between.sensor_of] {
            let others = ids(name)?;
            if own != others {
                warnings.push(format!(
                    "{} has other test frames than {} ({} of {} are shared): the parts of the sensor and of the scene hold \
                     the difference of the frames",
                    study.title(&between.test_set),
                    study.title(name),
                    shared_ids(&[&own, &others]).len(),
                    own.len()
                ));
            }
        }
    }
    Ok(warnings)
}

/// Passes the differences of average precision over all distances as results.
fn note_differences(study: &Study, paired: &[PairedDifference], listener: Listener<'_>) {
    for d in paired.iter().filter(|d| d.section.is_none() && d.quantity == Quantity::Ap40) {
        let number = |v: Option<f64>| v.map_or("undefined".to_string(), |v| format!("{v:.2}"));
        let difference = d.difference.map_or("undefined".to_string(), |v| format!("{v:+.2}"));
        let interval = d.interval.map_or(String::new(), |i| format!(" [{:+.2}, {:+.2}]", i.low, i.high));
        listener(Event::Result(&format!(
            "{}, {} 3D AP ({}): {} {} minus {} {} = {difference}{interval} over {} frames",
            network_title(study, &d.network),
            d.class,
            d.overlap,
            study.title(&d.test_set),
            number(d.value),
            study.title(&d.compared_to),
            number(d.other),
            d.frames
        )));
    }
}

/// Settings of the study as names and values. They must not differ between an uninterrupted and a resumed study.
fn facts(study: &Study) -> Result<Vec<(String, String)>> {
    let mut facts = Vec::new();
    let mut fact = |name: &str, value: String| facts.push((name.to_string(), value));
    fact("program", format!("lidarshift {}", data::build_id()));
    for dataset in &study.config.datasets {
        let set = open(study, &dataset.name)?;
        let splits = &study.config.splits;
        let counts = [&splits.train, &splits.val, &splits.test]
            .map(|split| set.ids(split).map_or("no frames".to_string(), |ids| format!("{} frames", ids.len())));
        let [train, val, test] = counts;
        fact(
            &format!("data set {}", dataset.title),
            format!("{train} to train on, {val} to watch, {test} to test on; {}", source(study, dataset)),
        );
    }
    for planned in study.config.plan().networks {
        if let Some(frozen) = study.config.frozen_detector(&planned.network.name) {
            fact(&format!("detector {}", frozen.title), frozen_text(frozen));
            continue;
        }
        let of_network: Vec<StudyRun> =
            study.config.runs().into_iter().filter(|run| run.id.network == planned.network.name).collect();
        let seeds: Vec<String> = planned.seeds.iter().map(u64::to_string).collect();
        let config = study.run_config(&of_network[0])?;
        let optimization = &config.detector.optimization;
        let mut text = format!(
            "{}: {} epochs, batches of {}, highest learning rate {}; seeds {}",
            of_network[0].detector,
            optimization.epochs,
            optimization.batch_size,
            optimization.lr_max,
            seeds.join(", ")
        );
        if !of_network[0].set.is_empty() {
            text += &format!("; set: {}", of_network[0].set.join(", "));
        }
        fact(&format!("network {}", planned.network.title), text);
    }
    let recall = "OpenPCDet's: of all refined regions of a two-stage network, of the final boxes otherwise";
    fact("recall", recall.into());
    Ok(facts)
}

/// Where the detections of a frozen detector come from.
fn frozen_text(frozen: &FrozenDetector) -> String {
    let mut text = match (&frozen.checkpoint, &frozen.detector) {
        (Some(checkpoint), Some(detector)) => {
            format!("trained elsewhere: checkpoint {} of {}", checkpoint.display(), detector.display())
        }
        _ => {
            let of_set = |(set, path): (&String, &PathBuf)| format!("{} on {set}", path.display());
            let sets: Vec<String> = frozen.detections.iter().map(of_set).collect();
            format!("trained elsewhere: detections {}", sets.join(", "))
        }
    };
    for (from, to) in &frozen.classes {
        text += &format!("; class {from} is {to}");
    }
    if !frozen.ignored_classes.is_empty() {
        text += &format!("; without class {}", frozen.ignored_classes.join(", "));
    }
    text
}

fn source(study: &Study, dataset: &StudyDataset) -> String {
    match &dataset.source {
        Source::Path(path) => path.display().to_string(),
        Source::Simulate { config, dataset, frames, seed } => {
            let set = dataset.as_ref().map_or(String::new(), |name| format!(" {name} of"));
            format!("simulated:{set} {}, {frames} frames, seed {seed}", config.display())
        }
        Source::TrueLabels { of } => format!("the clouds of {} with the true boxes as labels", study.title(of)),
        Source::Resim { of, effects, .. } => format!("{} with the effects of {}", study.title(of), effects.display()),
    }
}

/// Links to the pages of the diagnoses that made the effects of data sets: those that stand beside these.
fn diagnoses(study: &Study) -> Vec<Link> {
    let of_set = |set: &StudyDataset| {
        let Source::Resim { effects, .. } = &set.source else { return None };
        let [page, numbers] = ["report.html", "diagnosis.json"].map(|name| study.path(effects).with_file_name(name));
        // Studies have a `report.html` as well.
        let is_diagnosis = page.may_be_file() && numbers.may_be_file();
        let text = format!("The diagnosis that made the effects of {}", set.title);
        is_diagnosis.then(|| Link::to_file(&study.folder, &page, &text)).flatten()
    };
    study.config.datasets.iter().filter_map(of_set).collect()
}

/// Training curves of all runs that have started.
fn training(study: &Study) -> Result<Vec<TrainingRun>> {
    let mut out = Vec::new();
    for run in study.config.runs() {
        let path = run.folder(&study.folder).join("metrics.jsonl");
        if path.may_be_file() {
            let network = network_title(study, &run.id.network);
            let name = format!("{network}, {}, seed {}", study.title(&run.id.train_set), run.id.seed);
            out.push(read_training_run(&name, &path)?);
        }
    }
    Ok(out)
}

/// Some test frames of the first data sets with labels, and the detections on the first data set by the first run of
/// each network and train set.
fn scenes(study: &Study, state: &StudyState) -> Result<Vec<Scene>> {
    let names: Vec<&str> = study.config.datasets.iter().map(|d| d.name.as_str()).take(SCENE_SETS).collect();
    let first = open(study, names[0])?;
    let mut frozen = Vec::new();
    if first.config.label_frame == data::LabelFrame::Lidar && !study.config.frozen.is_empty() {
        let labels = TestSet::read(&first, &study.config.splits.test)?;
        for detector in &study.config.frozen {
            let frames = state.frozen.frames(study, detector, names[0], &labels)?;
            frozen.extend(frames.map(|frames| (detector, frames)));
        }
    }
    let ids = some_test_frames(study, &first, SCENES)?;
    let mut runs: Vec<(&StudyRun, Vec<Vec<LabelBox>>)> = Vec::new();
    for (run, _) in state.run_states.iter().filter(|(_, run_state)| StudyState::has(run_state, names[0])) {
        let is_known = runs
            .iter()
            .any(|(known, _)| (&known.id.network, &known.id.train_set) == (&run.id.network, &run.id.train_set));
        if !is_known && first.config.label_frame == data::LabelFrame::Lidar {
            runs.push((run, detections_of(&run.detections(&study.folder, names[0]), &ids)?));
        }
    }
    let mut scenes = Vec::new();
    for (k, id) in ids.iter().enumerate() {
        let mut layers = Vec::new();
        let mut focus_m = None;
        for (name, color) in names.iter().zip(CLOUDS) {
            let set = open(study, name)?;
            // A data set with other scenes does not have this frame.
            let Ok(frame) = set.load(id) else { continue };
            if *name == names[0] {
                focus_m = frame.objects.first().map(|object| object.bbox.center);
                let boxes: Vec<Box3> = frame.objects.iter().map(|object| object.bbox).collect();
                layers.push(layer("labels", LABELS, LayerContent::Boxes(boxes)));
            }
            layers.push(layer(study.title(name), color, LayerContent::Cloud(frame.cloud.with_channels(3))));
        }
        for (color, (run, found)) in DETECTIONS.iter().cycle().zip(&runs) {
            let boxes = found[k].iter().map(|line| line.lidar_box()).collect();
            let name =
                format!("{} trained on {}", network_title(study, &run.id.network), study.title(&run.id.train_set));
            layers.push(layer(&name, color, LayerContent::Boxes(boxes)));
        }
        for (frozen, frames) in &frozen {
            let color = DETECTIONS[(runs.len() + layers.len()) % DETECTIONS.len()];
            if let Some(frame) = frames.iter().find(|frame| frame.id == *id) {
                let boxes = frame.detections.iter().map(|line| line.lidar_box()).collect();
                let name = format!("{}, trained elsewhere", frozen.title);
                layers.push(layer(&name, color, LayerContent::Boxes(boxes)));
            }
        }
        scenes.push(Scene { name: format!("{}, frame {id}", study.title(names[0])), layers, focus_m, on: None });
    }
    Ok(scenes)
}

fn layer(name: &str, color: &str, content: LayerContent) -> Layer {
    Layer { name: name.into(), color: color.into(), content }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_study_links_the_diagnosis_beside_its_effects() {
        let folder = tempfile::tempdir().unwrap();
        let text = "name = \"s\"\nabout = []\nseeds = [1]\nepochs = 1\n\
                    [[dataset]]\nname = \"real\"\ntitle = \"Real\"\nsource = { path = \"real\" }\n\
                    [[dataset]]\nname = \"sim\"\ntitle = \"Sim\"\nsource = { path = \"sim\" }\n\
                    [[dataset]]\nname = \"more\"\ntitle = \"Sim & more\"\n\
                    source = { resim = { of = \"sim\", effects = \"found/extended.toml\" } }\n\
                    [[detector]]\nname = \"pointpillars_small\"\ntitle = \"PointPillars\"\n";
        let [path, found] = ["s.toml", "found"].map(|name| folder.path().join(name));
        fs_err::write(&path, text).unwrap();
        fs_err::create_dir(&found).unwrap();
        let study = Study::open(path.to_str().unwrap(), Some(&folder.path().join("runs/s"))).unwrap();
        fs_err::write(found.join("report.html"), "").unwrap();
        assert!(diagnoses(&study).is_empty(), "the page of something else");
        fs_err::write(found.join("diagnosis.json"), "{}").unwrap();
        let links = diagnoses(&study);
        let hrefs: Vec<&str> = links.iter().map(|link| link.href.as_str()).collect();
        assert_eq!(hrefs, ["../../found/report.html"]);
        let page = StudyReport { links, ..StudyReport::default() }.html().unwrap();
        let link = "<a href=\"../../found/report.html\">The diagnosis that made the effects of Sim &#38; more</a>";
        assert!(page.contains(link), "the page has no {link}");
    }
}
