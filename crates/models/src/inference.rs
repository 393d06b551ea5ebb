//! The one pass of a detector over frames that detection, validation and studies share.

use crate::{Detector, ModelError, Prediction, Preparer, Sample};
use data::{Dataset, Frame, Prefetch, prefetch};

/// What the network reads of frames of a data set, in their order. The samples are made ahead on `workers` threads; labels are not read.
pub fn inference_samples(
    detector: &Detector,
    set: &Dataset,
    ids: &[String],
    workers: usize,
) -> Prefetch<Result<Sample, ModelError>> {
    let (preparer, set) = (Preparer::new(detector.config()), set.clone());
    prefetch(ids.to_vec(), workers, 2 * detector.config().optimization.batch_size, move |id: &String| {
        preparer.inference(&Frame { id: id.clone(), cloud: set.load_cloud(id)?, objects: Vec::new() })
    })
}

/// What a detector finds in each sample. A sample without points is not given to the network: nothing is found in it.
///
/// # Errors
/// As [`Detector::predict`].
pub fn predict_samples(detector: &Detector, samples: &[Sample]) -> Result<Vec<Prediction>, ModelError> {
    if !samples.is_empty() && samples.iter().all(|sample| !sample.is_empty()) {
        return detector.predict_with_regions(samples);
    }
    let seen: Vec<Sample> = samples.iter().filter(|sample| !sample.is_empty()).cloned().collect();
    let found = if seen.is_empty() { Vec::new() } else { detector.predict_with_regions(&seen)? };
    let mut found = found.into_iter();
    let of_sample = |sample: &Sample| {
        if sample.is_empty() { Prediction::default() } else { found.next().unwrap_or_default() }
    };
    Ok(samples.iter().map(of_sample).collect())
}

/// Runs a detector over samples in batches, in their order. `on_batch` takes what was found in each sample of a batch, beside the value
/// that came with the sample.
///
/// # Errors
/// The first error of a sample, of the network or of `on_batch`. Of the batch in which it occurs nothing is handed on.
pub fn predict_frames<T, E: From<ModelError>>(
    detector: &Detector,
    batch_size: usize,
    samples: impl IntoIterator<Item = Result<(Sample, T), E>>,
    mut on_batch: impl FnMut(Vec<(T, Prediction)>) -> Result<(), E>,
) -> Result<(), E> {
    let mut samples = samples.into_iter();
    loop {
        let batch: Vec<(Sample, T)> = samples.by_ref().take(batch_size.max(1)).collect::<Result<_, E>>()?;
        if batch.is_empty() {
            return Ok(());
        }
        let (batch, beside): (Vec<Sample>, Vec<T>) = batch.into_iter().unzip();
        let found = predict_samples(detector, &batch)?;
        on_batch(beside.into_iter().zip(found).collect())?;
    }
}
