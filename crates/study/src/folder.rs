//! A study with its folder: resolves its TOML to data sets, runs and files.

use crate::config::{Source, StudyConfig, StudyDataset, StudyRun};
use crate::error::{InPart, Result, refused};
use data::Presence as _;
use data::toml_text::parse_toml;
use data::{write_atomic, write_json};
use models::detector_text;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use toml::{Table, Value};
use train::{RunConfig, set_key};

/// Copy of the study's TOML in its folder, from the last time the study was run.
const COPY: &str = "study.toml";
/// Path of the study's TOML and base of its relative paths.
const ORIGIN: &str = "origin.json";

#[derive(Serialize, Deserialize, JsonSchema)]
pub(crate) struct Origin {
    /// [`ORIGIN_SCHEMA`].
    #[serde(default)]
    schema: String,
    /// Name or path of the study on the command line.
    named: String,
    /// Folder of its TOML.
    base: PathBuf,
}

/// Version of [`Origin`].
pub(crate) const ORIGIN_SCHEMA: &str = "lidarshift/study-origin/1";

/// A study with its folder.
#[derive(Clone, Debug)]
pub struct Study {
    /// Its configuration.
    pub config: StudyConfig,
    /// Its name or path on the command line.
    pub named: String,
    /// The text of its TOML.
    pub text: String,
    /// The folder of its TOML; paths in the TOML are relative to it.
    base: PathBuf,
    /// The folder of its results, absolute.
    pub folder: PathBuf,
}

impl Study {
    /// Folder of the databases of ground-truth sampling, which its runs share.
    pub fn cache_folder(&self) -> PathBuf {
        self.folder.join("cache")
    }

    /// Opens a study by the path of its TOML, by its name in configs/studies, by the name of a built-in study, or by
    /// its folder. Its folder is `out`, or `runs/NAME`.
    ///
    /// # Errors
    /// Neither a file nor a known name, or an invalid file.
    pub fn open(named: &str, out: Option<&Path>) -> Result<Study> {
        if Self::is_folder(Path::new(named)) {
            return Self::of_folder(Path::new(named));
        }
        let below = PathBuf::from(format!("configs/studies/{named}.toml"));
        let path = [PathBuf::from(named), below.clone()].into_iter().find(|path| path.may_be_file());
        let built_in = configs::text(&format!("studies/{named}.toml"));
        let (text, path) = match (path, built_in) {
            (Some(path), _) => (fs_err::read_to_string(&path)?, path),
            (None, Some(text)) => (text.to_string(), below),
            (None, None) => {
                let names: Vec<&str> = configs::names("studies").collect();
                return Err(refused(format!("no study {named:?}: neither a file nor one of {}", names.join(", "))));
            }
        };
        let config = StudyConfig::parse(&text, &path)?;
        let base = located(std::path::absolute(&path)?.parent().unwrap_or(Path::new("/")))?;
        let folder = out.map_or_else(|| Path::new("runs").join(&config.name), Path::to_path_buf);
        Ok(Study { config, named: named.into(), text, base, folder: utf8(located(&folder)?)? })
    }

    /// A study that a command makes instead of a TOML. Paths in `config` are relative to `base`; its folder is `out`.
    ///
    /// # Errors
    /// An invalid configuration.
    pub fn from_config(config: &StudyConfig, base: &Path, out: &Path) -> Result<Study> {
        let text = toml::to_string(config).map_err(|e| refused(format!("the study cannot be written: {e}")))?;
        let config = StudyConfig::parse(&text, &out.join(COPY))?;
        let (base, folder) = (located(base)?, utf8(located(out)?)?);
        Ok(Study { config, named: out.display().to_string(), text, base, folder })
    }

    /// Whether a folder is the folder of a study.
    pub fn is_folder(folder: &Path) -> bool {
        folder.join(COPY).may_be_file()
    }

    /// Opens the study of a folder from the copy of its TOML.
    fn of_folder(folder: &Path) -> Result<Study> {
        let path = folder.join(COPY);
        let text = fs_err::read_to_string(&path)?;
        let config = StudyConfig::parse(&text, &path)?;
        let origin: Origin = serde_json::from_slice(&fs_err::read(folder.join(ORIGIN))?)
            .in_part(|| format!("{} is damaged", folder.join(ORIGIN).display()))?;
        Ok(Study { config, named: origin.named, text, base: origin.base, folder: located(folder)? })
    }

    /// Resolves a path of the study's TOML.
    pub fn path(&self, relative: &Path) -> PathBuf {
        if data::is_url(relative) { relative.into() } else { resolved(&self.base, relative) }
    }

    /// Whether `found`, the path of a data set in a run folder, is that of a data set of the study, which may have been
    /// moved since, or be reached by another path.
    pub fn is_path_of(&self, dataset: &StudyDataset, found: &Path) -> bool {
        let now = self.dataset_path(dataset);
        let same =
            |a: &Path, b: &Path| a == b || matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b);
        if same(found, &now) {
            return true;
        }
        match (&dataset.source, now.strip_prefix(&self.folder)) {
            // Made in the folder of the study, at its place in it.
            (Source::Simulate { .. } | Source::Resim { .. } | Source::TrueLabels { .. }, Ok(inside)) => {
                found.ends_with(inside)
            }
            // At its place relative to where the TOML was when the study was last run.
            (Source::Path(path), _) => self
                .origin()
                .is_some_and(|origin| origin.base != self.base && same(found, &resolved(&origin.base, path))),
            _ => false,
        }
    }

    fn origin(&self) -> Option<Origin> {
        serde_json::from_slice(&fs_err::read(self.folder.join(ORIGIN)).ok()?).ok()
    }

    /// A data set by its name.
    ///
    /// # Errors
    /// An unknown name.
    pub fn dataset(&self, name: &str) -> Result<&StudyDataset> {
        self.config
            .datasets
            .iter()
            .find(|d| d.name == name)
            .ok_or_else(|| refused(format!("the study has no data set {name:?}")))
    }

    /// The title of a data set.
    pub fn title<'a>(&'a self, dataset: &'a str) -> &'a str {
        self.config.datasets.iter().find(|d| d.name == dataset).map_or(dataset, |d| &d.title)
    }

    /// Path of a data set, which may not exist yet: a folder or a TOML.
    pub fn dataset_path(&self, dataset: &StudyDataset) -> PathBuf {
        match &dataset.source {
            Source::Path(path) => self.path(path),
            Source::Simulate { config, dataset, frames, seed } => {
                let scenes = self.scenes_folder(config, *frames, *seed);
                dataset.as_ref().map_or(scenes.clone(), |name| scenes.join(name))
            }
            Source::Resim { .. } | Source::TrueLabels { .. } => self.folder.join("data").join(&dataset.name),
        }
    }

    /// Folder of all data sets of one simulation, which share their scenes.
    pub fn scenes_folder(&self, config: &Path, frames: usize, seed: u64) -> PathBuf {
        let stem = config.file_stem().unwrap_or_default().to_string_lossy();
        self.folder.join("data").join(format!("{stem}-{frames}-seed-{seed}"))
    }

    /// Value of `simulate --config`: a file relative to the study's TOML, or a name.
    pub fn scenes_config(&self, config: &Path) -> String {
        let path = self.path(config);
        if path.may_be_file() { path.display().to_string() } else { config.display().to_string() }
    }

    /// The configuration of a run.
    ///
    /// # Errors
    /// An unknown detector, or invalid settings.
    pub fn run_config(&self, run: &StudyRun) -> Result<RunConfig> {
        let named = run.config.as_ref().map_or(run.detector.clone(), |file| self.path(file).display().to_string());
        let mut table = Table::new();
        let detector: Table = parse_toml(&detector_text(&named)?, Path::new(&named), |_| Ok(()))?;
        table.insert("detector".into(), Value::Table(detector));
        table.insert(
            "seed".into(),
            Value::Integer(i64::try_from(run.id.seed).map_err(|_| refused("a seed is too large"))?),
        );
        let dataset = self.dataset_path(self.dataset(&run.id.train_set)?);
        let Some(dataset) = dataset.to_str() else {
            return Err(refused(format!("{}: the path is not UTF-8", dataset.display())));
        };
        table.insert("dataset".into(), Value::String(dataset.into()));
        let splits = &self.config.splits;
        let mut set = vec![format!("run.train_split={:?}", splits.train), format!("run.val_split={:?}", splits.val)];
        set.extend(run.epochs.map(|epochs| format!("optimization.epochs={epochs}")));
        for assignment in set.iter().chain(&run.set) {
            set_key(&mut table, assignment)?;
        }
        RunConfig::from_table(table).in_part(|| format!("run {run}"))
    }

    /// A run by its name, the path of its folder relative to the folder of the study.
    ///
    /// # Errors
    /// An unknown name.
    pub fn run(&self, name: &str) -> Result<StudyRun> {
        let runs = self.config.runs();
        let found = runs.into_iter().find(|run| run.to_string() == name);
        found.ok_or_else(|| refused(format!("the study has no run {name:?}; `lidarshift study status` lists them")))
    }

    /// The data set whose test clouds are used for features.
    pub fn feature_set(&self) -> &str {
        self.config.evaluation.tsne_dataset.as_ref().unwrap_or(&self.config.datasets[0].name)
    }

    /// Describes the changes of the study's TOML since the study was last run.
    ///
    /// # Errors
    /// A copy that cannot be read.
    pub fn changes(&self) -> Result<Vec<String>> {
        let copy = self.folder.join(COPY);
        let mut texts = Vec::new();
        if copy.may_be_file() {
            let changes = self.config.changes_since(&StudyConfig::read(&copy)?);
            texts.extend(changes.invalid.iter().map(|(id, reasons)| {
                format!("{}/{}/seed-{} is no longer valid: {}", id.network, id.train_set, id.seed, reasons.join("; "))
            }));
            texts.extend(
                changes
                    .tests
                    .iter()
                    .map(|set| format!("the detections on {set} are no longer valid, since it has changed")),
            );
            texts.extend(
                changes.added.iter().map(|id| format!("{}/{}/seed-{} is new", id.network, id.train_set, id.seed)),
            );
            let removed = |id: &eval::matrix::RunId| {
                format!(
                    "{}/{}/seed-{} is no longer part of the study; its folder is kept",
                    id.network, id.train_set, id.seed
                )
            };
            texts.extend(changes.removed.iter().map(removed));
        }
        Ok(texts)
    }

    /// Whether the folder has a copy of the study's TOML as it is now.
    pub fn is_copied(&self) -> bool {
        fs_err::read_to_string(self.folder.join(COPY)).is_ok_and(|copy| copy == self.text)
    }

    /// Replaces the copy of the study's TOML in the folder.
    ///
    /// # Errors
    /// A copy that cannot be written.
    pub fn update_copy(&self) -> Result<()> {
        let copy = self.folder.join(COPY);
        let origin = Origin { schema: ORIGIN_SCHEMA.into(), named: self.named.clone(), base: self.base.clone() };
        write_json(&self.folder.join(ORIGIN), &origin)?;
        Ok(write_atomic(&copy, self.text.as_bytes())?)
    }
}

/// The folder of a study, whose path is written into the files and passed to the processes of its runs.
fn utf8(folder: PathBuf) -> Result<PathBuf> {
    if folder.to_str().is_none() {
        let message = format!("{}: the path of a study has to be UTF-8; choose another --out", folder.display());
        return Err(refused(message));
    }
    Ok(folder)
}

/// The absolute path of a folder without links and `..`, as far as it exists.
fn located(folder: &Path) -> Result<PathBuf> {
    let absolute = std::path::absolute(folder)?;
    for existing in absolute.ancestors() {
        if let (Ok(found), Ok(rest)) = (existing.canonicalize(), absolute.strip_prefix(existing)) {
            return Ok(resolved(&found, rest));
        }
    }
    Ok(absolute)
}

/// A path relative to a folder. `..` is resolved, so that the same file always has the same path.
fn resolved(base: &Path, relative: &Path) -> PathBuf {
    let mut path = base.to_path_buf();
    for part in relative.components() {
        match part {
            std::path::Component::ParentDir => drop(path.pop()),
            std::path::Component::CurDir => {}
            part => path.push(part),
        }
    }
    path
}
