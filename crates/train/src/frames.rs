//! The frames of a training run: their order, augmentation and preparation, each a function of (seed, epoch, frame)
//! alone.

use crate::order::{EpochOrders, Others};
use crate::{RunConfig, TrainError};
use data::augment::{AugmentConfig, augment, crop_to_range};
use data::checksum::hex;
use data::{Dataset, Frame, GtDatabase, Prefetch, Stream, prefetch_numbered, stream};
use models::config::DetectorConfig;
use models::{Preparer, Sample};
use sha2::{Digest, Sha256};
use std::path::Path;
use std::sync::Arc;

/// The training frames of a run.
pub struct TrainingFrames {
    dataset: Dataset,
    ids: Vec<String>,
    seed: u64,
    orders: EpochOrders,
    augmentation: Option<(AugmentConfig, Option<GtDatabase>)>,
    classes: Vec<String>,
    range_m: [f64; 6],
    preparer: Preparer,
}

impl TrainingFrames {
    /// From a run's data set: the training split with augmentation, or all frames without augmentation to overfit.
    ///
    /// The database of ground-truth sampling is built once, in a file of `cache_folder` that other runs may share.
    ///
    /// # Errors
    /// A split that is missing or has no frame, classes or channels of the detector that the data set does not have, a
    /// frame that cannot be read for the objects.
    pub fn new(config: &RunConfig, dataset: &Dataset, cache_folder: &Path) -> Result<Self, TrainError> {
        let detector = &config.detector;
        check_fit(config, dataset)?;
        let ids = if config.overfit { dataset.all_ids()? } else { dataset.ids(&config.run.train_split)? };
        let gt_sampling = &detector.augmentation.gt_sampling;
        let augmentation = if config.overfit {
            None
        } else if gt_sampling.enabled {
            let database = GtDatabase::open_or_build(cache_folder, dataset, &ids, &detector.classes, gt_sampling)?;
            Some((detector.augmentation.clone(), Some(database)))
        } else {
            Some((detector.augmentation.clone(), None))
        };
        Ok(TrainingFrames {
            dataset: dataset.clone(),
            orders: EpochOrders::new(config.seed, ids.len()),
            ids,
            seed: config.seed,
            augmentation,
            classes: detector.classes.clone(),
            range_m: range_of_boxes(detector),
            preparer: Preparer::new(detector),
        })
    }

    /// Their ids, in the order of the split.
    pub fn ids(&self) -> &[String] {
        &self.ids
    }

    /// SHA-256 of the ids, in hexadecimal.
    pub fn sha256(&self) -> String {
        hex(&Sha256::digest(self.ids.join("\n")))
    }

    /// Index of the frame at a position in the order of `epoch`.
    pub fn index(&self, epoch: u64, position: usize) -> usize {
        self.orders.of(epoch)[position] as usize
    }

    /// The sample of frame `index` in `epoch`.
    ///
    /// As in the reference, a frame without a box of the detector's classes in range after augmentation is replaced by
    /// a random other one, except when overfitting. Others are drawn one by one, each at most once.
    ///
    /// # Errors
    /// A frame that cannot be read, or no frame at all with a box.
    pub fn sample(&self, epoch: u64, index: usize) -> Result<Sample, TrainError> {
        let mut random = stream(self.seed, "augment", epoch, index as u64);
        let frame = self.frame(index, &mut random)?;
        if self.augmentation.is_none() || !frame.objects.is_empty() {
            return Ok(self.preparer.training(&frame, &mut random)?);
        }
        let mut others = Others::of(index, self.ids.len());
        while let Some(other) = others.draw(&mut random) {
            let frame = self.frame(other, &mut random)?;
            if !frame.objects.is_empty() {
                return Ok(self.preparer.training(&frame, &mut random)?);
            }
        }
        let message = format!(
            "none of its {} training frames has a box of {} within the detector's range: there is nothing to learn; \
             `lidarshift doctor` says what the labels hold",
            self.ids.len(),
            self.classes.join(", ")
        );
        Err(TrainError::folder(&self.dataset.config.root, message))
    }

    /// The augmented frame, cropped to the range.
    fn frame(&self, index: usize, random: &mut Stream) -> Result<Frame, TrainError> {
        let mut frame = self.dataset.load(&self.ids[index])?;
        if let Some((config, database)) = &self.augmentation {
            frame = augment(frame, config, database.as_ref(), random)?;
        }
        let mut frame = crop_to_range(frame, &self.range_m);
        frame.objects.retain(|o| self.classes.contains(&o.class));
        Ok(frame)
    }
}

/// The samples of all epochs from `(epoch, position)` on, prefetched by `workers` threads; at most `depth` are queued.
pub fn samples(
    frames: &Arc<TrainingFrames>,
    (epoch, position): (u64, usize),
    epochs: u64,
    workers: usize,
    depth: usize,
) -> Prefetch<Result<Sample, TrainError>> {
    let per_epoch = frames.ids().len();
    let left = (epochs.saturating_sub(epoch) as usize * per_epoch).saturating_sub(position);
    let frames = frames.clone();
    prefetch_numbered(left, workers, depth, move |job| {
        let (later, position) = ((position + job) / per_epoch, (position + job) % per_epoch);
        let epoch = epoch + later as u64;
        frames.sample(epoch, frames.index(epoch, position))
    })
}

/// The range in which training boxes are kept, `[x_min, y_min, z_min, x_max, y_max, z_max]`, m, LiDAR frame. If heights
/// count from the ground, the z of the range does as well and is tested by the preparation.
fn range_of_boxes(detector: &DetectorConfig) -> [f64; 6] {
    let mut range = detector.range_m.map(f64::from);
    if detector.ground.is_some() {
        (range[2], range[5]) = (f64::NEG_INFINITY, f64::INFINITY);
    }
    range
}

/// Whether the data set has the classes, channels and labels that the detector needs.
fn check_fit(config: &RunConfig, dataset: &Dataset) -> Result<(), TrainError> {
    let (detector, path) = (&config.detector, &config.dataset);
    let missing: Vec<&str> =
        detector.classes.iter().filter(|c| !dataset.config.classes.contains(c)).map(String::as_str).collect();
    if !missing.is_empty() {
        let message = format!(
            "the detector {} is to find {}, the data set has the classes {}; give a detector for these classes, or name them in the data \
             set's TOML",
            detector.name,
            missing.join(", "),
            dataset.config.classes.join(", ")
        );
        return Err(TrainError::folder(path, message));
    }
    let channels = dataset.config.points.channels();
    if channels < detector.channels {
        let message = format!(
            "its points have {channels} values, the detector {} reads {}; choose a detector for these points, or --set channels={channels}",
            detector.name, detector.channels
        );
        return Err(TrainError::folder(path, message));
    }
    if !dataset.has_labels() {
        let labels = dataset.config.layout.labels_path(Path::new(""), "");
        let folder = labels.parent().unwrap_or(&labels).display();
        return Err(TrainError::folder(&dataset.config.root, format!("there are no labels in {folder}")));
    }
    Ok(())
}
