//! Comparison of PointRCNN with reference values: sampled points and neighbours, both stages, targets, detections.
//!
//! A stage has the shape `[B, C, N]` in the reference and `[B * N, C]` in this program, and is transposed for the
//! comparison. This program stores repeated points and centres of a region once; they are repeated for the comparison.

mod sizes;

use super::network::{Case, DetectorChecks, Gradients, frame, wide};
use super::reference::ReferenceFile;
use super::rotations::{centers, reference_rotations};
use anyhow::{Context, Result, bail};
use burn::tensor::Tensor;
use data::Cloud;
use geometry::{ball_query, three_nearest};
use models::config::NetworkConfig;
use models::layers::{Mode, host};
use models::pointrcnn::hierarchy::Hierarchy;
use models::pointrcnn::loss::{point_losses, roi_losses};
use models::pointrcnn::proposals::{Proposals, point_boxes, proposals};
use models::pointrcnn::roi_input::{RoiInput, Scene};
use models::pointrcnn::roi_targets::{RoiTargets, overlaps};
use models::pointrcnn::{
    PointRcnn, PointRcnnConfig, PointStages, Preparation, RoiHeadConfig, RoiStages, Sample, SampleTargets, final_boxes,
    point_scores, suppress,
};
use models::{Detector, Losses, Network};

/// The comparisons of PointRCNN.
pub const CHECKS: DetectorChecks =
    DetectorChecks { name: "PointRCNN", config: sizes::config, eval, train, gradients: Gradients::WIDE };

/// Tolerance of squared distances, boxes and box codes, which depend on coordinates only.
const EXACT: f64 = 1e-6;

fn parts<'a>(case: &Case<'a>, detector: &'a Detector) -> Result<(&'a PointRcnnConfig, &'a PointRcnn)> {
    match (&case.config.network, &detector.network) {
        (NetworkConfig::PointRcnn(net), Network::PointRcnn(network)) => Ok((net, network)),
        _ => bail!("{} is not a PointRCNN", case.config.name),
    }
}

/// The file to compare with, and the number of frames in a batch.
struct View<'a> {
    case: &'a Case<'a>,
    mode: &'static str,
    frames: usize,
}

impl View<'_> {
    /// Compares a stage whose values have the order of the reference.
    fn stage(&self, file: &mut ReferenceFile, name: &str, values: &[f64], shape: &[usize]) -> Result<()> {
        file.compare_stage(name, values, shape, self.case.tolerance(&format!("{}/{name}", self.mode)))
    }

    /// Compares rows in the order of the reference.
    fn rows(&self, file: &mut ReferenceFile, name: &str, rows: &Tensor<2>) -> Result<()> {
        self.stage(file, name, &wide(&host(rows.clone())?), &rows.dims())
    }

    /// Compares rows of consecutive frames or regions with a reference that stores channels first. `dense` maps the
    /// rows of the reference to ours.
    fn columns(
        &self,
        file: &mut ReferenceFile,
        name: &str,
        rows: &Tensor<2>,
        dense: Option<&[u32]>,
        blocks: usize,
        last_axis: bool,
    ) -> Result<()> {
        let channels = rows.dims()[1];
        let values = host(rows.clone())?;
        let all: Vec<u32> = (0..rows.dims()[0] as u32).collect();
        let dense = dense.unwrap_or(&all);
        let length = dense.len() / blocks;
        let mut turned = vec![0.0; dense.len() * channels];
        for (place, &row) in dense.iter().enumerate() {
            let (block, at) = (place / length, place % length);
            for c in 0..channels {
                turned[(block * channels + c) * length + at] = f64::from(values[row as usize * channels + c]);
            }
        }
        let shape = [blocks, channels, length, 1];
        self.stage(file, name, &turned, if last_axis { &shape } else { &shape[..3] })
    }

    /// Compares the first stage up to the predictions of the points.
    fn points(&self, file: &mut ReferenceFile, clouds: &[&Hierarchy], stages: &PointStages) -> Result<()> {
        for i in 0..clouds[0].levels.len() {
            let points: Vec<[f32; 3]> = clouds.iter().flat_map(|c| c.levels[i].points.iter().copied()).collect();
            let shape = [self.frames, points.len() / self.frames, 3];
            self.stage(file, &format!("sa{i}.xyz"), &wide(points.as_flattened()), &shape)?;
            let features = &stages.backbone.set_abstraction[i];
            self.columns(file, &format!("sa{i}.features"), features, None, self.frames, false)?;
            let features = &stages.backbone.propagation[i];
            self.columns(file, &format!("fp{i}.features"), features, None, self.frames, false)?;
        }
        self.rows(file, "point_features", &stages.point_features())?;
        self.rows(file, "point_cls_preds", &stages.predictions.cls)?;
        self.rows(file, "point_box_preds", &stages.predictions.boxes)
    }

    /// Compares the second stage.
    fn regions(&self, file: &mut ReferenceFile, input: &RoiInput, stages: &RoiStages) -> Result<()> {
        let regions = input.regions();
        self.columns(file, "rcnn_xyz_up", &stages.xyz_up, Some(&input.dense[0]), regions, true)?;
        self.columns(file, "rcnn_merged", &stages.merged, Some(&input.dense[0]), regions, true)?;
        for (l, positions) in centers(input).iter().enumerate() {
            let here = positions.len() / regions;
            self.stage(file, &format!("rcnn_sa{l}.xyz"), &wide(positions.as_flattened()), &[regions, here, 3])?;
            let (rows, dense) = (&stages.set_abstraction[l], &input.dense[l + 1]);
            self.columns(file, &format!("rcnn_sa{l}.features"), rows, Some(dense), regions, false)?;
        }
        let last = stages.set_abstraction.len() - 1;
        self.columns(file, &format!("rcnn_sa{last}.features"), &stages.set_abstraction[last], None, regions, false)?;
        self.rows(file, "rcnn_cls", &stages.cls)?;
        self.rows(file, "rcnn_reg", &stages.reg)
    }
}

fn whole(values: impl IntoIterator<Item = u32>) -> Vec<f64> {
    values.into_iter().map(f64::from).collect()
}

/// A sample with all points of a cloud in the order of the file, as in the reference.
fn sample(
    preparation: &Preparation,
    case: &Case,
    file: &mut ReferenceFile,
    points: &str,
    boxes: Option<Vec<[f32; 8]>>,
) -> Result<Sample> {
    let cloud: Cloud = frame(file.floats(points)?, case.config.channels).cloud;
    let all: Vec<usize> = (0..cloud.len()).collect();
    Ok(preparation.of_points("reference", &cloud, &all, boxes, 0))
}

/// Comparison in evaluation mode.
fn eval(case: &mut Case, detector: &Detector) -> Result<()> {
    let (net, network) = parts(case, detector)?;
    let mut file = case.file("eval")?;
    let view = View { case, mode: "eval", frames: 1 };
    let preparation = Preparation::new(case.config, net);
    let sample = sample(&preparation, case, &mut file, "in.points", None)?;
    neighbours(&mut file, &sample, net)?;
    let stages = network.points(&[&sample], Mode::Eval);
    view.points(&mut file, &[&sample.hierarchy], &stages)?;

    let classes = preparation.mean_sizes.len();
    let (logits, codes) = (host(stages.predictions.cls.clone())?, host(stages.predictions.boxes.clone())?);
    let scores = point_scores(&logits, classes);
    view.stage(&mut file, "point_cls_scores", &wide(&scores), &[scores.len()])?;
    let boxes = point_boxes(&sample.points, &logits, &codes, &preparation.mean_sizes);
    view.stage(&mut file, "point_boxes_decoded", &wide(boxes.as_flattened()), &[boxes.len(), 7])?;
    for (name, config) in [("proposals_train", &net.proposals.train), ("proposals_test", &net.proposals.test)] {
        compare_proposals(&view, &mut file, name, proposals(&boxes, &logits, classes, config), &logits)?;
    }

    // From here on, the regions of the reference are used.
    let rois = file.floats("proposals_test.rois")?.as_chunks::<7>().0.to_vec();
    let labels = file.ints("proposals_test.roi_labels")?;
    let scene = Scene { points: &sample.points, scores: &scores, first_row: 0 };
    let rotations = reference_rotations(&mut file, scene, &rois, 0, &net.roi_head)?;
    let input = RoiInput::rotated(scene, &rois, &rotations, &net.roi_head);
    file.compare("pooled_count", &whole(input.count.iter().copied()), 0.0)?;
    pooled(&view, &mut file, &input, &stages.point_features(), &net.roi_head)?;
    for (l, picks) in input.picks.iter().enumerate() {
        let shape = [rois.len(), net.roi_head.levels[l].centers];
        file.compare_stage(&format!("rcnn_sa{l}.fps_index_all"), &whole(picks.iter().copied()), &shape, 0.0)?;
    }
    let roi = network.roi_head.forward(stages.point_features(), &input, Mode::Eval);
    view.regions(&mut file, &input, &roi)?;
    let (cls, reg) = (host(roi.cls)?, host(roi.reg)?);
    view.stage(&mut file, "final_cls", &wide(&cls), &[1, cls.len(), 1])?;
    let boxes = final_boxes(&rois, &reg);
    view.stage(&mut file, "final_boxes", &wide(boxes.as_flattened()), &[1, boxes.len(), 7])?;
    let kept = suppressed(&mut file, &boxes, &cls, net)?;
    file.compare("det.roi_index", &whole(kept.iter().map(|k| k.0 as u32)), 0.0)?;
    file.compare("det.labels", &kept.iter().map(|k| labels[k.0] as f64).collect::<Vec<_>>(), 0.0)?;
    let scores: Vec<f32> = kept.iter().map(|k| k.1).collect();
    file.compare("det.scores", &wide(&scores), case.tolerance("eval/final_cls"))?;
    let boxes: Vec<f64> = kept.iter().flat_map(|k| boxes[k.0]).map(f64::from).collect();
    file.compare("det.boxes", &boxes, case.tolerance("eval/final_boxes"))?;
    case.rows.extend(file.finish());
    Ok(())
}

/// Regions kept by non-maximum suppression. Regions with equal scores (empty ones, or with a sigmoid of exactly 1) are
/// processed in the order of the reference.
fn suppressed(
    file: &mut ReferenceFile,
    boxes: &[[f32; 7]],
    logits: &[f32],
    net: &PointRcnnConfig,
) -> Result<Vec<(usize, f32)>> {
    let mut order: Vec<usize> = file.ints("det.roi_index")?.into_iter().map(|i| i as usize).collect();
    anyhow::ensure!(order.iter().all(|&i| i < boxes.len()), "det.roi_index contains a region that does not exist");
    let others: Vec<usize> = (0..boxes.len()).filter(|i| !order.contains(i)).collect();
    order.extend(others);
    let boxes: Vec<[f32; 7]> = order.iter().map(|&i| boxes[i]).collect();
    let logits: Vec<f32> = order.iter().map(|&i| logits[i]).collect();
    let kept = suppress(&boxes, &logits, &net.detection);
    Ok(kept.into_iter().map(|(i, score)| (order[i], score)).collect())
}

/// Compares the indices of sampled points and neighbours.
fn neighbours(file: &mut ReferenceFile, sample: &Sample, net: &PointRcnnConfig) -> Result<()> {
    let mut above = &sample.points;
    for (i, (level, config)) in sample.hierarchy.levels.iter().zip(&net.levels).enumerate() {
        file.compare(&format!("sa{i}.fps_index"), &whole(level.picks.iter().copied()), 0.0)?;
        for (g, scale) in config.scales.iter().enumerate() {
            let index = ball_query(above, &level.points, scale.radius_m, scale.samples);
            let shape = [level.points.len(), scale.samples];
            file.compare_stage(&format!("sa{i}.ball{g}_index"), &whole(index), &shape, 0.0)?;
        }
        let found = three_nearest(above, &level.points);
        let shape = [above.len(), 3];
        let index = whole(found.index.as_flattened().iter().copied());
        file.compare_stage(&format!("fp{i}.three_nn_index"), &index, &shape, 0.0)?;
        file.compare_stage(&format!("fp{i}.three_nn_dist2"), &wide(found.distance2.as_flattened()), &shape, EXACT)?;
        above = &level.points;
    }
    Ok(())
}

/// Our regions in the order of the reference: each reference region is matched with the nearest unmatched one of ours.
fn in_order_of(file: &mut ReferenceFile, tensor: &str, mut ours: Proposals) -> Result<Proposals> {
    let reference = file.floats(tensor)?.as_chunks::<7>().0.to_vec();
    let mut sorted = Proposals::default();
    for want in reference.iter().take(ours.boxes.len()) {
        let apart = |b: &[f32; 7]| (0..7).map(|i| (b[i] - want[i]).abs()).sum::<f32>();
        let near = (0..ours.boxes.len()).min_by(|&a, &b| apart(&ours.boxes[a]).total_cmp(&apart(&ours.boxes[b])));
        let near = near.context("there are fewer regions than in the reference")?;
        sorted.boxes.push(ours.boxes.remove(near));
        sorted.scores.push(ours.scores.remove(near));
        sorted.labels.push(ours.labels.remove(near));
    }
    Ok(sorted)
}

/// Compares proposals. Proposals with almost equal scores may be swapped. The tolerance of the scores is scaled with
/// the magnitude of all logits.
fn compare_proposals(view: &View, file: &mut ReferenceFile, name: &str, ours: Proposals, logits: &[f32]) -> Result<()> {
    let ours = in_order_of(file, &format!("{name}.rois"), ours)?;
    let boxes = view.case.tolerance("eval/point_boxes_decoded");
    file.compare(&format!("{name}.rois"), &wide(ours.boxes.as_flattened()), boxes)?;
    let rms = |values: &[f32]| {
        let square: f64 = values.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        (square / values.len().max(1) as f64).sqrt()
    };
    let share = rms(logits) / rms(&ours.scores).max(f64::MIN_POSITIVE);
    let scores = view.case.tolerance("eval/point_cls_preds") * share.clamp(1.0, 10.0);
    file.compare(&format!("{name}.roi_scores"), &wide(&ours.scores), scores)?;
    let labels: Vec<f64> = ours.labels.iter().map(|&l| f64::from(l)).collect();
    file.compare(&format!("{name}.roi_labels"), &labels, 0.0)
}

/// Compares position, score, distance and features of every pooled point.
fn pooled(
    view: &View,
    file: &mut ReferenceFile,
    input: &RoiInput,
    features: &Tensor<2>,
    config: &RoiHeadConfig,
) -> Result<()> {
    let channels = features.dims()[1];
    let features = host(features.clone())?;
    let mut values = Vec::new();
    for &row in &input.dense[0] {
        values.extend(input.prefix[row as usize].map(f64::from));
        match input.source[row as usize] {
            Some(point) => values.extend(wide(&features[point as usize * channels..][..channels])),
            None => values.resize(values.len() + channels, 0.0),
        }
    }
    let shape = [input.regions(), config.points, input.prefix[0].len() + channels];
    file.compare_stage("pooled_features", &values, &shape, view.case.tolerance("eval/point_features"))
}

/// Comparison in training mode with the regions of the reference. Returns the losses with their autodiff graph.
fn train(case: &mut Case, detector: &Detector) -> Result<Losses> {
    let (net, network) = parts(case, detector)?;
    let mut file = case.file("train")?;
    let preparation = Preparation::new(case.config, net);
    let truth = case.ground_truth(&mut file)?;
    let view = View { case, mode: "train", frames: truth.len() };
    let mut batch = Vec::new();
    for (f, truth) in truth.iter().enumerate() {
        batch.push(sample(&preparation, case, &mut file, &format!("in.points{f}"), Some(truth.clone()))?);
    }
    let batch: Vec<&Sample> = batch.iter().collect();
    let targets: Vec<&SampleTargets> = batch.iter().filter_map(|s| s.targets.as_ref()).collect();
    point_targets(&mut file, &targets)?;
    let stages = network.points(&batch, Mode::Train);
    let clouds: Vec<&Hierarchy> = batch.iter().map(|s| &s.hierarchy).collect();
    view.points(&mut file, &clouds, &stages)?;
    let of_points: Vec<_> = targets.iter().map(|t| &t.points).collect();
    let [point_cls, point_box] = point_losses(&stages.predictions, &of_points, &net.loss);

    let rois = file.floats("in.rois")?.as_chunks::<7>().0.to_vec();
    let labels: Vec<i32> = file.ints("in.roi_labels")?.into_iter().map(|l| l as i32).collect();
    let (logits, classes) = (host(stages.predictions.cls.clone())?, preparation.mean_sizes.len());
    let (mut regions, mut input) = (RoiTargets::default(), RoiInput::empty(&net.roi_head));
    let mut truth_of_roi = Vec::new();
    let (of_frame, points) = (rois.len() / batch.len(), batch[0].points.len());
    for (f, sample) in batch.iter().enumerate() {
        let span = f * of_frame..(f + 1) * of_frame;
        let (iou, of) = overlaps(&rois[span.clone()], &labels[span.clone()], &truth[f]);
        for (r, roi) in rois[span.clone()].iter().enumerate() {
            let truth = truth[f].get(of[r]).copied().unwrap_or([0.0; 8]);
            regions.push(*roi, iou[r], truth, &net.roi_sampling);
        }
        truth_of_roi.extend(of);
        let scores = point_scores(&logits[f * points * classes..][..points * classes], classes);
        let scene = Scene { points: &sample.points, scores: &scores, first_row: (f * points) as u32 };
        let rotations = reference_rotations(&mut file, scene, &rois[span.clone()], span.start, &net.roi_head)?;
        input.append(&RoiInput::rotated(scene, &rois[span], &rotations, &net.roi_head));
    }
    roi_targets(&mut file, &regions, &truth_of_roi)?;
    let roi = network.roi_head.forward(stages.point_features(), &input, Mode::Train);
    view.regions(&mut file, &input, &roi)?;
    let [rcnn_cls, rcnn_reg, rcnn_corner] = roi_losses(roi.cls, roi.reg, &regions, &net.loss);
    let parts = [point_cls, point_box, rcnn_cls, rcnn_reg, rcnn_corner];
    let total = parts.iter().cloned().reduce(|sum, part| sum + part).context("five losses")?;
    let names = ["point_cls", "point_box", "rcnn_cls", "rcnn_reg", "rcnn_corner"];
    let losses = Losses { total, parts: names.into_iter().zip(parts).collect() };
    case.losses(&mut file, &losses)?;
    case.rows.extend(file.finish());
    Ok(losses)
}

fn point_targets(file: &mut ReferenceFile, targets: &[&SampleTargets]) -> Result<()> {
    let (mut labels, mut codes) = (Vec::new(), Vec::new());
    let (mut positive, mut positive_codes) = (Vec::new(), Vec::new());
    for target in targets.iter().map(|t| &t.points) {
        let first = labels.len();
        labels.extend(target.labels.iter().map(|&l| f64::from(l)));
        codes.resize(labels.len() * 8, 0.0);
        for (&(point, _), code) in target.positive.iter().zip(&target.codes) {
            positive.push((first + point) as u32);
            positive_codes.extend(code.map(f64::from));
            codes[(first + point) * 8..][..8].copy_from_slice(&code.map(f64::from));
        }
    }
    file.compare("target.point_cls_labels", &labels, 0.0)?;
    file.compare("target.point_positive_index", &whole(positive), 0.0)?;
    file.compare("target.point_positive_box_labels", &positive_codes, EXACT)?;
    file.compare_stage("target.point_box_labels", &codes, &[labels.len(), 8], EXACT)
}

fn roi_targets(file: &mut ReferenceFile, regions: &RoiTargets, truth_of_roi: &[usize]) -> Result<()> {
    file.compare("target.gt_iou_of_rois", &wide(&regions.iou), EXACT)?;
    file.compare("target.gt_index_of_roi", &whole(truth_of_roi.iter().map(|&t| t as u32)), 0.0)?;
    file.compare("target.gt_of_rois_src", &wide(regions.truth.as_flattened()), 0.0)?;
    file.compare("target.gt_of_rois", &wide(regions.truth_canonical.as_flattened()), EXACT)?;
    let labels: Vec<f64> = regions.labels.iter().map(|&l| f64::from(l)).collect();
    file.compare("target.rcnn_cls_labels", &labels, 0.0)?;
    file.compare("target.reg_valid_mask", &whole(regions.box_counts.iter().map(|&c| u32::from(c))), 0.0)
}
