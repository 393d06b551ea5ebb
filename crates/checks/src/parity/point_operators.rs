//! Comparison of PointRCNN's operations, box coder, targets and losses with reference values.

use super::operators::{LOSS, rows, wide, wide_host};
use super::reference::ReferenceFile;
use anyhow::{Context, Result};
use burn::tensor::{Device, Int, Tensor, TensorData};
use geometry::{Box3, TieRule, ball_query, farthest_point_sampling, roi_points};
use models::point_ops::{Groups, Interpolation, interpolate};
use models::pointrcnn::RoiSamplingConfig;
use models::pointrcnn::box_coder::{corners, decode, encode};
use models::pointrcnn::loss::{corner_loss, roi_cross_entropy};
use models::pointrcnn::point_targets::assign;
use models::pointrcnn::roi_targets::{kind, overlaps};

/// Mean box sizes of KITTI's classes, m.
const MEAN_SIZES: [[f32; 3]; 3] = [[3.9, 1.6, 1.56], [0.8, 0.6, 1.73], [1.76, 0.6, 1.73]];
/// `GT_EXTRA_WIDTH`: total enlargement of ground truth boxes; points only in the enlarged box are ignored, m.
const EXTRA_WIDTH_M: [f32; 3] = [0.2; 3];

fn whole(values: &[u32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

fn flags(values: impl Iterator<Item = bool>) -> Vec<f64> {
    values.map(|v| f64::from(u8::from(v))).collect()
}

/// Transposes `[C, N]` of a file to `[N, C]`.
fn transposed(values: &[f32], channels: usize) -> Vec<f32> {
    let length = values.len() / channels.max(1);
    (0..length).flat_map(|i| (0..channels).map(move |c| values[c * length + i])).collect()
}

pub(super) fn sampling(file: &mut ReferenceFile) -> Result<()> {
    for tensor in file.names().filter(|n| n.ends_with(".xyz")).map(String::from).collect::<Vec<_>>() {
        let cloud = tensor.trim_end_matches(".xyz");
        let points = rows::<3>(file, &tensor)?;
        for (rule, name) in [(TieRule::ReferenceKernel, "kernel"), (TieRule::LowestIndex, "lowest")] {
            let want = format!("{cloud}.index_{name}_tie");
            let count = file.ints(&want)?.len();
            file.compare(&want, &whole(&farthest_point_sampling(&points, count, rule)), 0.0)?;
        }
    }
    Ok(())
}

pub(super) fn neighbours(file: &mut ReferenceFile) -> Result<()> {
    for tensor in file.names().filter(|n| n.ends_with(".index")).map(String::from).collect::<Vec<_>>() {
        // In `boundary.r1_n4` the radius is in the name; otherwise it is a tensor.
        let query = tensor.trim_end_matches(".index");
        let (prefix, name) = query.rsplit_once('.').map_or(("", query), |(p, _)| (p, query));
        let boundary = prefix.starts_with("boundary");
        let prefix = if boundary { "boundary." } else { "" };
        let (points, centers) =
            (rows::<3>(file, &format!("{prefix}xyz"))?, rows::<3>(file, &format!("{prefix}new_xyz"))?);
        let radius_m = if boundary { 1.0 } else { file.floats(&format!("{name}.radius"))?[0] };
        let samples = file.input(&tensor)?.shape[1];
        file.compare(&tensor, &whole(&ball_query(&points, &centers, radius_m, samples)), 0.0)?;
    }
    Ok(())
}

pub(super) fn interpolation(file: &mut ReferenceFile, device: &Device) -> Result<()> {
    let from = Interpolation::new(&rows::<3>(file, "unknown")?, &rows::<3>(file, "known")?);
    file.compare("index", &whole(from.source.as_flattened()), 0.0)?;
    file.compare("squared_distance", &wide(&from.distance2), LOSS)?;
    let distance: Vec<f64> = from.distance2.as_flattened().iter().map(|d| f64::from(d.sqrt())).collect();
    file.compare("distance", &distance, LOSS)?;
    file.compare("weight", &wide(&from.weight), LOSS)?;
    let from = from.to_device(device);
    gathered(file, device, ["interpolated", "features", "grad_out", "grad_features"], |features| {
        interpolate(features, &from)
    })
}

/// Compares a gather and its gradient; the file stores channels first.
fn gathered(
    file: &mut ReferenceFile,
    device: &Device,
    [out, input, weights, gradient]: [&str; 4],
    gather: impl Fn(Tensor<2>) -> Tensor<2>,
) -> Result<()> {
    let [channels, points] = file.input(input)?.shape[..] else { anyhow::bail!("{input} needs two dimensions") };
    let tensor = |values: Vec<f32>| {
        let rows = values.len() / channels;
        Tensor::<2>::from_data(TensorData::new(transposed(&values, channels), [rows, channels]), device)
    };
    let features = tensor(file.floats(input)?).require_grad();
    let ours = gather(features.clone());
    file.compare(out, &wide_host(ours.clone().transpose())?, LOSS)?;
    let gradients = (ours * tensor(file.floats(weights)?)).sum().backward();
    let ours = features.grad(&gradients).with_context(|| format!("{points} points without a gradient"))?;
    file.compare(gradient, &wide_host(ours.transpose())?, LOSS)
}

pub(super) fn grouping(file: &mut ReferenceFile, device: &Device) -> Result<()> {
    let index: Vec<i32> = file.ints("index")?.into_iter().map(|i| i as i32).collect();
    let length = index.len();
    let index = Tensor::<1, Int>::from_data(TensorData::new(index, [length]), device);
    gathered(file, device, ["grouped", "features", "grad_out", "grad_features"], |features| {
        features.select(0, index.clone())
    })
}

/// Offsets and features of each slot, including repeated points.
pub(super) fn query_and_group(file: &mut ReferenceFile) -> Result<()> {
    let (points, centers) = (rows::<3>(file, "xyz")?, rows::<3>(file, "new_xyz")?);
    let channels = file.input("features")?.shape[0];
    let features = transposed(&file.floats("features")?, channels);
    let (radius_m, samples) = (file.floats("radius")?[0], file.input("out")?.shape[2]);
    let slots = ball_query(&points, &centers, radius_m, samples);
    let mut out = vec![0.0; (3 + channels) * slots.len()];
    for (g, (&center, of_center)) in centers.iter().zip(slots.chunks_exact(samples)).enumerate() {
        let mut group = Groups::default();
        group.push(center, of_center.iter().map(|&i| (i, points[i as usize])), 1.0);
        for (s, slot) in of_center.iter().enumerate() {
            let row = group.source.iter().position(|source| source == slot).context("each slot is a row")?;
            let of_point = &features[*slot as usize * channels..][..channels];
            for (c, value) in group.offset_m[row].iter().chain(of_point).enumerate() {
                out[c * slots.len() + g * samples + s] = f64::from(*value);
            }
        }
    }
    file.compare("out", &out, LOSS)
}

pub(super) fn pooling(file: &mut ReferenceFile) -> Result<()> {
    let (points, features) = (rows::<3>(file, "points")?, rows::<6>(file, "features")?);
    let rois = rows::<7>(file, "rois")?;
    let samples = file.input("pooled")?.shape[1];
    for (name, extra) in [("", 0.0), ("extra1.", 1.0)] {
        let enlarged = |r: &[f32; 7]| [r[0], r[1], r[2], r[3] + extra, r[4] + extra, r[5] + extra, r[6]];
        let boxes: Vec<Box3> = rois.iter().map(|r| Box3::from_array(enlarged(r).map(f64::from))).collect();
        let found = roi_points(points.as_flattened(), 3, &boxes, samples);
        let empty = flags(found.count.iter().map(|&c| c == 0));
        if extra == 0.0 {
            file.compare("index", &whole(&found.index), 0.0)?;
            file.compare("empty", &empty, 0.0)?;
        } else {
            file.compare(&format!("{name}pooled_empty"), &empty, 0.0)?;
        }
        let mut pooled = Vec::new();
        for (place, &i) in found.index.iter().enumerate() {
            let row = points[i as usize].iter().chain(&features[i as usize]);
            let some = found.count[place / samples] > 0;
            pooled.extend(row.map(|&v| if some { f64::from(v) } else { 0.0 }));
        }
        file.compare(&format!("{name}pooled"), &pooled, LOSS)?;
    }
    Ok(())
}

pub(super) fn point_targets(file: &mut ReferenceFile) -> Result<()> {
    let points = rows::<3>(file, "points")?;
    let truth: Vec<[f32; 8]> = rows::<8>(file, "gt_boxes")?.into_iter().filter(|b| b[7] > 0.0).collect();
    let targets = assign(&points, &truth, &MEAN_SIZES, EXTRA_WIDTH_M);
    let labels: Vec<f64> = targets.labels.iter().map(|&l| f64::from(l)).collect();
    let (mut of_point, mut codes) = (vec![-1.0; points.len()], vec![0.0; points.len() * 8]);
    for (&(point, truth), code) in targets.positive.iter().zip(&targets.codes) {
        of_point[point] = truth as f64;
        codes[point * 8..][..8].copy_from_slice(&code.map(f64::from));
    }
    file.compare("cls_labels", &labels, 0.0)?;
    file.compare("box_index", &of_point, 0.0)?;
    file.compare("box_labels", &codes, LOSS)
}

pub(super) fn roi_targets(file: &mut ReferenceFile) -> Result<()> {
    let rois = rows::<7>(file, "rois")?;
    let labels: Vec<i32> = file.ints("roi_labels")?.into_iter().map(|l| l as i32).collect();
    let truth: Vec<[f32; 8]> = rows::<8>(file, "gt_boxes")?.into_iter().filter(|b| b[7] > 0.0).collect();
    let (iou, of) = overlaps(&rois, &labels, &truth);
    file.compare("max_iou_same_class", &iou.iter().map(|&v| f64::from(v)).collect::<Vec<_>>(), LOSS)?;
    file.compare("gt_index", &of.iter().map(|&t| t as f64).collect::<Vec<_>>(), 0.0)?;
    let config = RoiSamplingConfig::default();
    let kinds: Vec<_> = file.floats("thresholds.iou")?.iter().map(|&iou| kind(iou, &config)).collect();
    let labels: Vec<f64> = kinds.iter().map(|k| f64::from(k.label)).collect();
    file.compare("thresholds.rcnn_cls_labels", &labels, 0.0)?;
    file.compare("thresholds.is_fg_candidate", &flags(kinds.iter().map(|k| k.foreground)), 0.0)?;
    file.compare("thresholds.is_easy_bg", &flags(kinds.iter().map(|k| k.easy)), 0.0)?;
    file.compare("thresholds.is_hard_bg", &flags(kinds.iter().map(|k| k.hard)), 0.0)?;
    file.compare("thresholds.reg_valid_mask", &flags(kinds.iter().map(|k| k.box_counts)), 0.0)
}

pub(super) fn coder(file: &mut ReferenceFile) -> Result<()> {
    let (boxes, points) = (rows::<7>(file, "boxes")?, rows::<3>(file, "points")?);
    let sizes: Vec<[f32; 3]> = file.ints("classes")?.into_iter().map(|c| MEAN_SIZES[c as usize - 1]).collect();
    let each = boxes.iter().zip(&points).zip(&sizes);
    let encoded: Vec<[f32; 8]> = each.map(|((&b, &p), &size)| encode(b, p, size)).collect();
    let each = encoded.iter().zip(&points).zip(&sizes);
    let decoded: Vec<[f32; 7]> = each.map(|((&e, &p), &size)| decode(e, p, size)).collect();
    file.compare("point.encoded", &wide(&encoded), LOSS)?;
    file.compare("point.decoded", &wide(&decoded), LOSS)?;
    let corners: Vec<[f32; 3]> = boxes.iter().flat_map(|&b| corners(b)).collect();
    file.compare("corners", &wide(&corners), LOSS)
}

pub(super) fn losses(file: &mut ReferenceFile, device: &Device) -> Result<()> {
    let (pred, truth) = (rows::<7>(file, "corner.pred")?, rows::<7>(file, "corner.gt")?);
    let boxes = TensorData::new(pred.as_flattened().to_vec(), [pred.len(), 7]);
    let boxes = Tensor::<2>::from_data(boxes, device).require_grad();
    let loss = corner_loss(boxes.clone(), &truth);
    file.compare("corner.loss", &wide_host(loss.clone())?, LOSS)?;
    let gradient = boxes.grad(&loss.mean().backward()).context("no gradient of the corners")?;
    file.compare("corner.grad_of_mean", &wide_host(gradient)?, LOSS)?;

    let logits = file.floats("rcnn_bce.logits")?;
    let labels: Vec<i32> = file.ints("rcnn_bce.labels")?.into_iter().map(|l| l as i32).collect();
    let logits = Tensor::<1>::from_data(TensorData::new(logits, [labels.len()]), device).require_grad();
    let loss = roi_cross_entropy(logits.clone(), &labels);
    file.compare("rcnn_bce.loss", &wide_host(loss.clone())?, LOSS)?;
    let gradient = logits.grad(&loss.backward()).context("no gradient of the scores")?;
    file.compare("rcnn_bce.grad", &wide_host(gradient)?, LOSS)
}
