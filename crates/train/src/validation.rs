//! A detector on the frames of a split: detections, average precision and loss.

use crate::{TrainError, ValidationMetrics};
use burn::tensor::Tensor;
use data::{Dataset, Detection, prefetch, stream};
use eval::{Difficulty, EvalFrame, EvalOptions, EvalReport, Metric, evaluate, reference_overlaps};
use models::layers::host;
use models::{Detector, Losses, Prediction, Preparer, Sample, predict_frames};
use std::collections::BTreeMap;
use std::time::Instant;

/// The detections of a detector on labelled frames, and their evaluation.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// Labels and detections as texts, in the frame of the data set's labels.
    pub frames: Vec<EvalFrame>,
    /// The detections of each frame, by falling score, in the LiDAR frame.
    pub detections: Vec<Vec<Detection>>,
    /// Average precision and recall.
    pub report: EvalReport,
    /// Mean total loss over the batches, with the running statistics.
    pub loss: f64,
    /// Duration, s.
    pub seconds: f64,
}

/// Runs the detector over frames of a data set with labels. `progress` is called with the number of frames done.
///
/// # Errors
/// A frame that cannot be read, or scores that are not numbers.
pub fn evaluate_detector(
    detector: &Detector,
    dataset: &Dataset,
    ids: &[String],
    workers: usize,
    progress: &mut dyn FnMut(usize),
) -> Result<Evaluation, TrainError> {
    let begin = Instant::now();
    let batch_size = detector.config().optimization.batch_size;
    let preparer = Preparer::new(detector.config());
    let set = dataset.clone();
    let mut samples = prefetch(ids.to_vec(), workers, 2 * batch_size, move |id: &String| {
        let frame = set.load(id)?;
        Ok::<(Sample, Sample), TrainError>((
            preparer.inference(&frame)?,
            preparer.training(&frame, &mut stream(0, "validation", 0, 0))?,
        ))
    });
    let mut detections = Vec::with_capacity(ids.len());
    let mut losses = Vec::new();
    predict_frames(detector, batch_size, &mut samples, |batch: Vec<(Sample, Prediction)>| {
        let (training, found): (Vec<Sample>, Vec<Prediction>) = batch.into_iter().unzip();
        losses.push(f64::from(host(detector.validation_loss(&training)?.total)?[0]));
        detections.extend(found.into_iter().map(|found| found.detections));
        progress(detections.len());
        Ok::<(), TrainError>(())
    })?;
    let frames = ids
        .iter()
        .zip(&detections)
        .map(|(id, found)| {
            let labels = dataset.labels(id)?;
            Ok(EvalFrame { id: id.clone(), labels, detections: dataset.detection_boxes(id, found)? })
        })
        .collect::<Result<Vec<_>, TrainError>>()?;
    let options = EvalOptions {
        classes: detector.config().classes.clone(),
        label_frame: dataset.config.label_frame,
        ..EvalOptions::default()
    };
    let report = evaluate(&frames, &options);
    let loss = losses.iter().sum::<f64>() / losses.len().max(1) as f64;
    Ok(Evaluation { frames, detections, report, loss, seconds: begin.elapsed().as_secs_f64() })
}

impl Evaluation {
    /// The metrics for `metrics.jsonl`.
    pub fn metrics(&self, classes: &[String]) -> ValidationMetrics {
        let of_set = |set: usize| -> BTreeMap<String, Option<f64>> {
            let of_class = |class: &String| {
                let overlap = reference_overlaps(class, Metric::ThreeD)[set];
                let row = self.report.row(class, Metric::ThreeD, overlap, Difficulty::All);
                row.filter(|row| row.n_gt > 0).and_then(|row| row.ap_area)
            };
            classes.iter().map(|class| (class.clone(), of_class(class))).collect()
        };
        let mean = |aps: &BTreeMap<String, Option<f64>>| {
            let known: Vec<f64> = aps.values().flatten().copied().collect();
            (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
        };
        let (official, loose) = (of_set(0), of_set(1));
        let (ap, ap_loose) = (mean(&official), mean(&loose));
        ValidationMetrics { loss: self.loss, ap, ap_loose, ap_of_class: official, seconds: self.seconds }
    }
}

/// The total and the parts of a loss on its device, without autodiff graph, in the order of [`loss_names`].
pub(crate) fn loss_tensor(losses: &Losses) -> Tensor<1> {
    let tensors = std::iter::once(&losses.total).chain(losses.parts.iter().map(|(_, part)| part));
    Tensor::cat(tensors.map(|t| t.clone().inner()).collect(), 0)
}

/// `total` and the names of the parts of a loss.
pub(crate) fn loss_names(losses: &Losses) -> Vec<&'static str> {
    std::iter::once("total").chain(losses.parts.iter().map(|(name, _)| *name)).collect()
}
