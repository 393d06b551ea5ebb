//! The training loop: [`train`].

use crate::clock::{Clock, Step};
use crate::error::without_panic;
use crate::provenance::record_session;
use crate::validation::{loss_names, loss_tensor};
use crate::{
    Adam, Best, Checkpoint, DatasetProvenance, EpochMetrics, GradientNorm, OneCycle, RunConfig, RunFolder, RunState,
    SessionProvenance, StepMetrics, TrainError, TrainingFrames, ValidationMetrics, evaluate_detector,
    metrics::MetricsFile, samples, verify_weights,
};
use burn::optim::GradientsParams;
use burn::tensor::Device;
use data::Presence as _;
use data::{Dataset, write_atomic};
use models::checkpoint::read_checkpoint;
use models::layers::Precision;
use models::suggest::{Assignment, FORCED_SHARE, LabelledBoxes};
use models::{Detector, ModelError, Sample, reference_name};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Settings of a process that trains a run. They do not change the weights, except for the rounding of another device.
#[derive(Clone, Debug)]
pub struct Session {
    /// Compute device, without autodiff.
    pub device: Device,
    /// Its name, for the provenance.
    pub device_name: String,
    /// Threads that load and augment frames.
    pub workers: usize,
    /// Resume an existing run. Without it a folder with a run is refused.
    pub resume: bool,
    /// Resume a run although the labels or clouds of its data set have changed since its last checkpoint.
    pub allow_changed_data: bool,
    /// Folder for the database of ground-truth sampling, which runs on the same frames may share; `None`: `cache` in
    /// the run folder.
    pub cache: Option<PathBuf>,
    /// Once this is set, a checkpoint is saved after the current step or evaluation, and the training ends with
    /// [`TrainError::Stopped`].
    pub stop: Option<&'static AtomicBool>,
}

impl Session {
    fn is_stopped(&self) -> bool {
        self.stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
    }
}

/// Progress of a run.
#[derive(Clone, Debug)]
pub enum Event<'a> {
    /// Sent before the first step.
    Begin {
        /// The state of the run.
        state: &'a RunState,
        /// Epochs of the whole run.
        epochs: u64,
        /// Number of training frames.
        frames: usize,
        /// Number of validation frames; 0 without a validation split.
        validation_frames: usize,
    },
    /// Something about the data or the configuration that the user should know; sent before the first step.
    Warning(&'a str),
    /// Sent after each step.
    Step {
        /// Metrics since the last line of `metrics.jsonl`.
        metrics: &'a StepMetrics,
        /// Whether they were written to `metrics.jsonl`.
        logged: bool,
    },
    /// Sent after each epoch.
    Epoch(&'a EpochMetrics),
}

/// A finished run.
#[derive(Debug)]
pub struct Trained {
    /// The detector with the weights of the last step.
    pub detector: Detector,
    /// The state of the run.
    pub state: RunState,
    /// The last evaluation by this process.
    pub validation: Option<ValidationMetrics>,
}

/// Trains a detector in the run folder `out` to the end, from the beginning or from the last checkpoint.
///
/// # Errors
/// A folder in use by another process, an existing run without `resume` or with another configuration, a data set that
/// is wrong, files that cannot be written, a loss or gradient that is not finite, and a training that was stopped.
pub fn train(
    config: &RunConfig,
    out: &Path,
    session: &Session,
    report: &mut dyn FnMut(Event),
) -> Result<Trained, TrainError> {
    let folder = RunFolder::open(out)?;
    let (mut run, frames, warnings) = Run::begin(config, &folder, session)?;
    let (batch_size, epochs) = (config.detector.optimization.batch_size, config.detector.optimization.epochs as u64);
    let depth = 2 * batch_size + session.workers;
    let mut samples = samples(&frames, (run.state.epoch, run.state.position), epochs, session.workers, depth);
    let mut log = MetricsFile::open(&folder.metrics_path(), run.state.step)?;
    let (state, validation_frames) = (&run.state, run.validation_ids.len());
    report(Event::Begin { state, epochs, frames: frames.ids().len(), validation_frames });
    warnings.iter().for_each(|warning| report(Event::Warning(warning)));
    if let Some(warning) = anchor_warning(config, &run.dataset, frames.ids())? {
        report(Event::Warning(&warning));
    }

    let mut validation = None;
    let mut saved_step = run.state.step;
    while run.state.epoch < epochs {
        let mut clock = Clock::default();
        while run.state.position < frames.ids().len() {
            if session.is_stopped() {
                if run.state.step > saved_step {
                    run.checkpoint(&folder, &mut clock)?;
                }
                return Err(TrainError::Stopped { step: run.state.step, total_steps: run.state.total_steps });
            }
            let wanted = batch_size.min(frames.ids().len() - run.state.position);
            let batch = clock.wait(|| samples.by_ref().take(wanted).collect::<Result<Vec<Sample>, _>>())?;
            let step = without_panic(run.state.step, || run.learn(&batch, &mut clock))?;

            run.state.step += 1;
            run.state.position += batch.len();
            let epoch_ends = run.state.position >= frames.ids().len();
            let metrics = clock.metrics(&run.state, step, batch.len());
            let logged = epoch_ends || run.state.step.is_multiple_of(config.run.log_every_steps);
            if logged {
                log.step(&metrics)?;
                clock.begin_line();
            }
            report(Event::Step { metrics: &metrics, logged });
            if !epoch_ends && run.state.step.is_multiple_of(config.run.checkpoint_every_steps) {
                run.checkpoint(&folder, &mut clock)?;
                saved_step = run.state.step;
            }
        }
        let turn = run.is_evaluation_due(epochs).then(|| run.validate(session.workers)).transpose()?;
        run.state.epoch += 1;
        run.state.position = 0;
        let metrics = clock.epoch_metrics(&run.state, turn);
        log.epoch(&metrics)?;
        run.checkpoint(&folder, &mut clock)?;
        saved_step = run.state.step;
        report(Event::Epoch(&metrics));
        validation = metrics.validation.or(validation);
    }
    Ok(Trained { detector: run.detector, state: run.state, validation })
}

/// Training frames whose boxes are looked at for [`anchor_warning`], at most.
const LOOKED_AT: usize = 1000;

/// Says if more than 5 % of the training boxes have nothing but a forced match: anchors that are too far apart, or of
/// another size. Anchors are assigned from above, so no cloud is read for the height of the ground.
fn anchor_warning(config: &RunConfig, dataset: &Dataset, ids: &[String]) -> Result<Option<String>, TrainError> {
    if config.detector.network.anchors().is_empty() {
        return Ok(None);
    }
    let boxes = LabelledBoxes::read(dataset, ids, LOOKED_AT, None)?;
    let share = Assignment::of(&config.detector, &boxes).map(|a| a.forced).filter(|share| *share > FORCED_SHARE);
    Ok(share.map(|share| {
        format!(
            "{:.0} % of the training boxes are matched by force: no anchor of {} reaches the overlap `matched` with them, so that \
             they are learnt from one poor anchor each; `lidarshift doctor DATASET --detector {} --suggest FILE` fits the anchors",
            100.0 * share,
            config.detector.name,
            config.detector.name
        )
    }))
}

/// The mutable state of a run.
struct Run<'a> {
    config: &'a RunConfig,
    dataset: Dataset,
    validation_ids: Vec<String>,
    schedule: OneCycle,
    adam: Adam,
    detector: Detector,
    state: RunState,
}

impl<'a> Run<'a> {
    /// Opens data set and network, and restores the last checkpoint if there is one. Also returns warnings.
    fn begin(
        config: &'a RunConfig,
        folder: &RunFolder,
        session: &Session,
    ) -> Result<(Self, Arc<TrainingFrames>, Vec<String>), TrainError> {
        refuse_other_run(config, folder, session.resume)?;
        let dataset = Dataset::open(&config.dataset)?;
        let cache = session.cache.clone().unwrap_or_else(|| folder.path().join("cache"));
        let frames = Arc::new(TrainingFrames::new(config, &dataset, &cache)?);
        let optimization = &config.detector.optimization;
        let validation_ids = match () {
            () if config.run.evaluate_every_epochs == 0 => Vec::new(),
            () if config.overfit => frames.ids().to_vec(),
            () if dataset.config.splits.contains_key(&config.run.val_split) => dataset.ids(&config.run.val_split)?,
            () => Vec::new(),
        };
        let steps_per_epoch = frames.ids().len().div_ceil(optimization.batch_size) as u64;
        let mut state = RunState {
            step: 0,
            total_steps: steps_per_epoch * optimization.epochs as u64,
            epoch: 0,
            position: 0,
            seed: config.seed,
            config_sha256: config.sha256(),
            frames_sha256: frames.sha256(),
            data_sha256: Some(dataset.content_sha256(&[frames.ids(), &validation_ids].concat())?),
            best: None,
        };
        let mut warnings = Vec::new();
        let device = session.device.clone().autodiff();
        let mut detector = Detector::new(&config.detector, config.seed, &device);
        let mut adam = Adam::new(optimization.weight_decay, reference_name);
        if let Some(Checkpoint { state: mut saved, weights, moments, warning }) = folder.load()? {
            warnings.extend(warning);
            if !config.has_sha256(&saved.config_sha256) || saved.frames_sha256 != state.frames_sha256 {
                let message = "its checkpoint belongs to another configuration or to other training frames (has the data set changed?); \
                               begin a new run with another --out";
                return Err(TrainError::folder(folder.path(), message));
            }
            if saved.data_sha256.is_some() && saved.data_sha256 != state.data_sha256 {
                let message = format!(
                    "the labels or clouds of {} have changed since the last checkpoint",
                    dataset.config.root.display()
                );
                if !session.allow_changed_data {
                    let advice =
                        "begin a new run with another --out, or continue on the changed data with --allow-changed-data";
                    return Err(TrainError::folder(folder.path(), format!("{message}; {advice}")));
                }
                warnings.push(message);
            }
            // A killed run may not have removed them.
            folder.remove_old(&saved, config.run.keep_checkpoints)?;
            saved.data_sha256 = state.data_sha256;
            detector = detector.load_named(&weights)?;
            adam.load_named(&moments, saved.step, &device).map_err(|m| TrainError::folder(folder.path(), m))?;
            state = saved;
        } else if let Some(init) = &config.init {
            verify_weights(init)?;
            detector = detector.load_named(&read_checkpoint(init)?).map_err(|e| match e {
                ModelError::Weights(message) => TrainError::folder(init, message),
                other => other.into(),
            })?;
        }
        write_atomic(&folder.config_path(), config.to_toml().as_bytes())?;
        let learned_from = DatasetProvenance {
            name: dataset.config.name.clone(),
            root: dataset.config.root.display().to_string(),
            frames: frames.ids().len(),
            frames_sha256: frames.sha256(),
        };
        let this = SessionProvenance::now(state.step, &session.device_name, session.workers);
        record_session(&folder.provenance_path(), config, learned_from, this)?;
        let schedule = OneCycle::new(optimization, state.total_steps);
        Ok((Run { config, dataset, validation_ids, schedule, adam, detector, state }, frames, warnings))
    }

    /// One step: forward, backward, clipping, update.
    fn learn(&mut self, batch: &[Sample], clock: &mut Clock) -> Result<Step, TrainError> {
        let losses = clock.forward(|| self.detector.loss(batch))?;
        let scale = Precision::chosen().loss_scale();
        // Losses and norm are read together: the device is waited for once a step.
        let (gradients, norm, values) = clock.backward(|| {
            let (names, values) = (loss_names(&losses), loss_tensor(&losses));
            let loss = if scale == 1.0 { losses.total } else { losses.total * scale };
            let gradients = GradientsParams::from_grads(loss.backward(), &self.detector.network);
            let network = &self.detector.network;
            let (mut norm, values) = GradientNorm::beside(Some(values), network, &gradients, reference_name);
            norm.total /= scale;
            let values: Vec<_> = names.into_iter().zip(values.into_iter().map(f64::from)).collect();
            (gradients, norm, values)
        });
        // The parts are checked before their sum, so that the message names the part.
        if let Some((name, _)) = values[1..].iter().chain(&values[..1]).find(|(_, value)| !value.is_finite()) {
            return Err(self.not_finite(format!("the loss {name}"), batch));
        }
        if let Some(parameter) = norm.not_finite {
            return Err(self.not_finite(format!("the gradient of {parameter}"), batch));
        }
        let (lr, beta1) = self.schedule.at(self.state.step);
        let clip = norm.clip_scale(self.config.detector.optimization.clip_norm);
        clock.optimizer(|| {
            self.detector.network = self.adam.step(self.detector.network.clone(), gradients, clip / scale, (lr, beta1));
        });
        Ok(Step { losses: values, gradient_norm: norm.total, lr, beta1 })
    }

    fn not_finite(&self, what: String, batch: &[Sample]) -> TrainError {
        TrainError::NotFinite {
            step: self.state.step,
            what,
            frames: batch.iter().map(|s| s.id().to_string()).collect(),
        }
    }

    /// Whether an evaluation is due after the current epoch.
    fn is_evaluation_due(&self, epochs: u64) -> bool {
        let (done, every) = (self.state.epoch + 1, self.config.run.evaluate_every_epochs);
        !self.validation_ids.is_empty() && (done == epochs || done.is_multiple_of(every))
    }

    fn validate(&mut self, workers: usize) -> Result<ValidationMetrics, TrainError> {
        let found = evaluate_detector(&self.detector, &self.dataset, &self.validation_ids, workers, &mut |_| {})?;
        let metrics = found.metrics(&self.config.detector.classes);
        if let Some(ap) = metrics.ap
            && self.state.best.as_ref().is_none_or(|best| ap > best.ap)
        {
            self.state.best = Some(Best { step: self.state.step, ap });
        }
        Ok(metrics)
    }

    fn checkpoint(&self, folder: &RunFolder, clock: &mut Clock) -> Result<(), TrainError> {
        let metadata = BTreeMap::from([
            ("detector".to_string(), toml::to_string(&self.config.detector).expect("a detector is plain TOML")),
            ("seed".to_string(), self.config.seed.to_string()),
            ("step".to_string(), self.state.step.to_string()),
        ]);
        clock.checkpoint(|| {
            let weights = self.detector.to_named()?;
            folder.save(&self.state, &weights, &metadata, &self.adam.to_named(), self.config.run.keep_checkpoints)
        })
    }
}

/// Refuses a folder with a run, unless it is to be resumed with the same configuration.
fn refuse_other_run(config: &RunConfig, folder: &RunFolder, resume: bool) -> Result<(), TrainError> {
    let path = folder.config_path();
    if !path.may_be_file() {
        return Ok(());
    }
    if !resume {
        let message = "there is a run in this folder already: add --resume to continue it, or choose another --out";
        return Err(TrainError::folder(folder.path(), message));
    }
    let differences = RunConfig::read(&path)?.differences(config);
    if differences.is_empty() {
        return Ok(());
    }
    let message = format!(
        "this run was started with other settings ({}), which cannot change: leave them out to continue, or start a new run with \
         another --out",
        differences.join("; ")
    );
    Err(TrainError::folder(&path, message))
}
