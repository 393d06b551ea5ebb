//! Comparison of single operations, losses, box coders, target assigner and optimiser with reference values.

use super::reference::{ReferenceFile, Row, numbers};
use super::{point_operators, toy_training};
use anyhow::Result;
use burn::tensor::{Device, Tensor, TensorData};
use geometry::{Box3, bev_intersection, bev_iou, iou_3d, rotated_nms};
use models::bev::pillars::{PillarGrid, decorate, pillarise};
use models::config::OptimizationConfig;
use models::layers::{BatchNorm, Init, host};
use models::loss::{add_sin_difference, cross_entropy, sigmoid_focal, smooth_l1};
use models::pointpillars::anchors::{AnchorClass, anchors};
use models::pointpillars::box_coder::{decode, direction_decode, encode, limit_period};
use models::pointpillars::target_assigner::{NearestBev, assign};
use std::f32::consts::TAU;
use std::path::Path;
use train::OneCycle;

/// Tolerance of losses and box coders, whose values are of order one.
pub(super) const LOSS: f64 = 1e-6;
/// `DIR_OFFSET` of OpenPCDet's KITTI configuration: start of the first direction bin.
#[expect(clippy::approx_constant, reason = "OpenPCDet's rounded value, not exactly pi / 4")]
const DIR_OFFSET_RAD: f32 = 0.78539;

/// Compares all operations in a folder.
pub fn compare(folder: &Path, device: &Device) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    let mut names: Vec<String> = Vec::new();
    for entry in fs_err::read_dir(folder)? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        names.extend(name.strip_suffix(".safetensors").map(String::from));
    }
    names.sort();
    for name in names {
        let mut file = ReferenceFile::read(folder, &name)?;
        // Results of a copy of the reference's CUDA kernel, for information only: this program computes exact overlaps.
        for tensor in file.names().filter(|t| t.contains("kernel_copy")).map(String::from).collect::<Vec<_>>() {
            file.input(&tensor)?;
        }
        let learning = device.clone().autodiff();
        match name.as_str() {
            "rotated_iou" => overlap(&mut file)?,
            "rotated_nms" => suppression(&mut file)?,
            "box_coders" => {
                coders(&mut file)?;
                point_operators::coder(&mut file)?;
            }
            "pillars" => pillars(&mut file)?,
            "target_assigner" => assigner(&mut file)?,
            "losses" => {
                losses(&mut file, &learning)?;
                point_operators::losses(&mut file, &learning)?;
            }
            "furthest_point_sampling" => point_operators::sampling(&mut file)?,
            "ball_query" => point_operators::neighbours(&mut file)?,
            "three_nn_interpolate" => point_operators::interpolation(&mut file, &learning)?,
            "grouping" => point_operators::grouping(&mut file, &learning)?,
            "query_and_group" => point_operators::query_and_group(&mut file)?,
            "roipoint_pool3d" => point_operators::pooling(&mut file)?,
            "point_targets" => point_operators::point_targets(&mut file)?,
            "roi_targets" => point_operators::roi_targets(&mut file)?,
            "batch_norm" => batch_norm(&mut file, device)?,
            "one_cycle" => one_cycle(&mut file)?,
            "adam_onecycle_toy" => toy_training::compare(&mut file, &learning)?,
            // The tensors of an unknown operation count as not compared.
            _ => {}
        }
        rows.extend(file.finish());
    }
    Ok(rows)
}

pub(super) fn rows<const N: usize>(file: &mut ReferenceFile, tensor: &str) -> Result<Vec<[f32; N]>> {
    Ok(file.floats(tensor)?.as_chunks::<N>().0.to_vec())
}

fn boxes(file: &mut ReferenceFile, tensor: &str) -> Result<Vec<Box3>> {
    Ok(rows::<7>(file, tensor)?.iter().map(|b| Box3::from_array(b.map(f64::from))).collect())
}

pub(super) fn wide<const N: usize>(rows: &[[f32; N]]) -> Vec<f64> {
    rows.iter().flatten().map(|&v| f64::from(v)).collect()
}

pub(super) fn wide_host<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f64>> {
    Ok(host(tensor)?.into_iter().map(f64::from).collect())
}

fn overlap(file: &mut ReferenceFile) -> Result<()> {
    let (a, b) = (boxes(file, "boxes_a")?, boxes(file, "boxes_b")?);
    let each = |f: fn(&Box3, &Box3) -> f64| a.iter().zip(&b).map(|(a, b)| f(a, b)).collect::<Vec<_>>();
    file.compare("bev_overlap", &each(bev_intersection), LOSS)?;
    file.compare("bev_iou", &each(bev_iou), LOSS)?;
    file.compare("iou3d", &each(iou_3d), LOSS)
}

fn suppression(file: &mut ReferenceFile) -> Result<()> {
    let (boxes, scores) = (boxes(file, "boxes")?, file.floats("scores")?);
    for tensor in file.names().filter(|n| n.ends_with(".keep")).map(String::from).collect::<Vec<_>>() {
        let threshold: f64 = tensor.trim_start_matches("thresh").trim_end_matches(".keep").parse()?;
        let kept: Vec<f64> = rotated_nms(&boxes, &scores, threshold).into_iter().map(|i| i as f64).collect();
        file.compare(&tensor, &kept, 0.0)?;
    }
    Ok(())
}

fn coders(file: &mut ReferenceFile) -> Result<()> {
    let (boxes, anchors) = (rows::<7>(file, "boxes")?, rows::<7>(file, "anchors")?);
    let encoded: Vec<[f32; 7]> = boxes.iter().zip(&anchors).map(|(&b, &a)| encode(b, a)).collect();
    let decoded: Vec<[f32; 7]> = encoded.iter().zip(&anchors).map(|(&e, &a)| decode(e, a)).collect();
    file.compare("residual.encoded", &wide(&encoded), LOSS)?;
    file.compare("residual.decoded", &wide(&decoded), LOSS)?;
    // The bins are an input: possible outputs of a direction classifier.
    let bins = file.ints("direction.bin")?;
    let angles = file.floats("limit_period.in")?;
    let heading = |(&yaw, &bin): (&f32, &i64)| f64::from(direction_decode(yaw, bin as usize, DIR_OFFSET_RAD, 0.0, 2));
    file.compare("direction.decoded_heading", &angles.iter().zip(&bins).map(heading).collect::<Vec<_>>(), LOSS)?;
    // The second case is that of the direction target, whose angles are relative to the start of the first bin.
    for (tensor, offset, start) in
        [("limit_period.offset05_period_2pi", 0.5, 0.0), ("limit_period.offset0_period_2pi", 0.0, DIR_OFFSET_RAD)]
    {
        let folded: Vec<f64> = angles.iter().map(|&a| f64::from(limit_period(a - start, offset, TAU))).collect();
        file.compare(tensor, &folded, LOSS)?;
    }
    let (boxes, anchors): (Vec<_>, Vec<_>) =
        (boxes.iter().map(|b| NearestBev::new(b)).collect(), anchors.iter().map(|a| NearestBev::new(a)).collect());
    let iou: Vec<f64> = boxes.iter().flat_map(|b| anchors.iter().map(|a| f64::from(b.iou(a)))).collect();
    file.compare("nearest_bev_iou", &iou, LOSS)
}

fn pillars(file: &mut ReferenceFile) -> Result<()> {
    let grid = PillarGrid {
        range: [0.0, -39.68, -3.0, 69.12, 39.68, 1.0],
        size: [0.16, 0.16, 4.0],
        max_points: 32,
        max_pillars: file.ints("max_pillars")?[0] as usize,
    };
    let pillars = pillarise(&file.floats("points")?, 4, &grid);
    let coords: Vec<f64> = pillars.coords_zyx.iter().flatten().map(|&c| f64::from(c)).collect();
    file.compare("coords_zyx", &coords, 0.0)?;
    let counts: Vec<f64> = pillars.num_points.iter().map(|&n| f64::from(n)).collect();
    file.compare("num_points", &counts, 0.0)?;
    let features = decorate(&pillars, &grid);
    let mut voxels = vec![0.0; 20 * 32 * 4];
    let mut augmented = vec![0.0; 20 * 32 * 10];
    let mut row = 0;
    for (p, &count) in pillars.num_points.iter().take(20).enumerate() {
        for slot in 0..count as usize {
            for c in 0..4 {
                voxels[(p * 32 + slot) * 4 + c] = f64::from(pillars.points[row * 4 + c]);
            }
            for c in 0..10 {
                augmented[(p * 32 + slot) * 10 + c] = f64::from(features[row * 10 + c]);
            }
            row += 1;
        }
    }
    file.compare("voxels.first20", &voxels, 0.0)?;
    file.compare("augmented.first20", &augmented, LOSS)
}

/// The three classes of KITTI on the grid of the file.
fn assigner(file: &mut ReferenceFile) -> Result<()> {
    let class = |name: &str, size, bottom, matched, unmatched| AnchorClass {
        name: name.into(),
        size,
        bottom,
        rotations: vec![0.0, 1.57],
        matched,
        unmatched,
    };
    let classes = [
        class("Car", [3.9, 1.6, 1.56], -1.78, 0.6, 0.45),
        class("Pedestrian", [0.8, 0.6, 1.73], -0.6, 0.5, 0.35),
        class("Cyclist", [1.76, 0.6, 1.73], -0.6, 0.5, 0.35),
    ];
    let range = file.floats("range")?;
    let grid = file.ints("grid_size")?;
    let map = [grid[1] as usize / 2, grid[0] as usize / 2];
    let ours = anchors(std::array::from_fn(|i| range[i]), map, &classes);
    file.compare("anchors", &wide(&ours), f64::from(f32::EPSILON))?;
    let anchors = rows::<7>(file, "anchors")?;
    let frames = file.input("gt_boxes")?.shape.clone();
    let boxes = rows::<8>(file, "gt_boxes")?;
    let (mut labels, mut positive, mut residuals, mut bins, mut weights) = (vec![], vec![], vec![], vec![], vec![]);
    for (f, boxes) in boxes.chunks(frames[1]).enumerate() {
        let truth: Vec<[f32; 8]> = boxes.iter().filter(|b| b[7] > 0.0).copied().collect();
        let targets = assign(&anchors, &classes, map, &truth, DIR_OFFSET_RAD);
        labels.extend(targets.labels.iter().map(|&l| f64::from(l)));
        positive.extend(targets.positive.iter().flat_map(|&(anchor, _)| [f as f64, anchor as f64]));
        residuals.extend(wide(&targets.reg));
        bins.extend(targets.dir.iter().map(|&d| d as f64));
        weights.push(targets.positive.len() as f64);
    }
    file.compare("box_cls_labels", &labels, 0.0)?;
    file.compare("positive_index", &positive, 0.0)?;
    file.compare("box_reg_targets.positive", &residuals, LOSS)?;
    file.compare("direction.positive", &bins, 0.0)?;
    file.compare("reg_weights_sum", &weights, LOSS)
}

fn losses(file: &mut ReferenceFile, device: &Device) -> Result<()> {
    let tensor = |values: Vec<f32>, shape: [usize; 2]| Tensor::<2>::from_data(TensorData::new(values, shape), device);
    // Compares the loss of each entry and the gradient of the sum with respect to `input`.
    let check = |file: &mut ReferenceFile, name: &str, input: &Tensor<2>, loss: Tensor<2>| -> Result<()> {
        file.compare(&format!("{name}.loss"), &wide_host(loss.clone())?, LOSS)?;
        let gradients = loss.sum().backward();
        let gradient = input.grad(&gradients).ok_or_else(|| anyhow::anyhow!("no gradient of {name}"))?;
        file.compare(&format!("{name}.grad_of_sum"), &wide_host(gradient)?, LOSS)
    };
    let logits = tensor(file.floats("focal.logits")?, [400, 3]).require_grad();
    let target = tensor(file.floats("focal.one_hot")?, [400, 3]);
    let weights = tensor(file.floats("focal.weights")?, [400, 1]);
    check(file, "focal", &logits, sigmoid_focal(logits.clone(), target) * weights.clone())?;

    let pred = tensor(file.floats("smooth_l1.pred")?, [400, 7]).require_grad();
    let (a, b) = add_sin_difference(pred.clone(), tensor(file.floats("smooth_l1.target")?, [400, 7]));
    file.compare("smooth_l1.pred_sin", &wide_host(a.clone())?, LOSS)?;
    file.compare("smooth_l1.target_sin", &wide_host(b.clone())?, LOSS)?;
    check(file, "smooth_l1", &pred, smooth_l1(a - b, 1.0 / 9.0) * weights.clone())?;

    let logits = tensor(file.floats("direction.logits")?, [400, 2]).require_grad();
    let bins: Vec<usize> = file.ints("direction.target")?.into_iter().map(|b| b as usize).collect();
    check(file, "direction", &logits, cross_entropy(logits.clone(), &bins).reshape([400, 1]) * weights)
}

fn batch_norm(file: &mut ReferenceFile, device: &Device) -> Result<()> {
    let setting = |file: &mut ReferenceFile, name: &str| -> Result<f64> { Ok(numbers(file.input(name)?)[0]) };
    let (epsilon, momentum) = (setting(file, "eps")?, setting(file, "momentum")?);
    let shape = file.input("x")?.shape.clone();
    let norm = BatchNorm::new(shape[1], momentum, epsilon, &Init { seed: 0, device });
    let x = Tensor::<2>::from_data(TensorData::new(file.floats("x")?, [shape[0], shape[1]]), device);
    file.compare("y", &wide_host(norm.forward_train(x))?, LOSS)?;
    file.compare("running_mean", &wide_host(norm.running_mean.value())?, LOSS)?;
    file.compare("running_var", &wide_host(norm.running_var.value())?, LOSS)
}

fn one_cycle(file: &mut ReferenceFile) -> Result<()> {
    for tensor in file.names().filter(|n| n.ends_with(".lr")).map(String::from).collect::<Vec<_>>() {
        let run = tensor.trim_end_matches(".lr");
        let lr_max: f64 = run.trim_start_matches("lr_max_").parse()?;
        let steps = file.input(&tensor)?.shape[0] as u64;
        let cycle = OneCycle::new(&OptimizationConfig { lr_max, ..Default::default() }, steps);
        let (lr, beta1): (Vec<f64>, Vec<f64>) = (0..steps).map(|i| cycle.at(i)).unzip();
        file.compare(&tensor, &lr, 1e-12)?;
        file.compare(&format!("{run}.beta1"), &beta1, 1e-12)?;
    }
    Ok(())
}
