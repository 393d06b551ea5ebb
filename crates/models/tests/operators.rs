//! Pillars, anchors, box coder, target assigner and decoding against reference values of OpenPCDet.

use lidarshift_models as models;
use models::bev::pillars::{PillarGrid, Pillars, decorate, pillarise};
use models::checkpoint::{HostTensor, HostValues, NamedTensors, read_safetensors};
use models::pointpillars::anchors::{AnchorClass, anchors};
use models::pointpillars::box_coder::{self, DIRECTION_OFFSET_RAD, limit_period};
use models::pointpillars::decode::{DecodeOptions, RawBox, decode, decode_boxes};
use models::pointpillars::target_assigner::{NearestBev, Targets, assign};
use std::path::{Path, PathBuf};

fn own(name: &str) -> PathBuf {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden")).join(name)
}

/// Reference values on real scans, which may not be copied into the repository.
fn shared(case: &str) -> Option<PathBuf> {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/golden")).join(case);
    if !folder.exists() {
        eprintln!("skipped: there is no {}", folder.display());
        return None;
    }
    Some(folder)
}

fn read(path: &Path) -> NamedTensors {
    read_safetensors(path).unwrap()
}

fn floats(tensors: &NamedTensors, name: &str) -> Vec<f32> {
    match &tensors.get(name).unwrap_or_else(|| panic!("no {name}")).values {
        HostValues::F32(values) => values.clone(),
        other => panic!("{name}: {other:?}"),
    }
}

fn ints(tensors: &NamedTensors, name: &str) -> Vec<i64> {
    match &tensors.get(name).unwrap_or_else(|| panic!("no {name}")).values {
        HostValues::I64(values) => values.clone(),
        other => panic!("{name}: {other:?}"),
    }
}

fn rows<const N: usize>(tensors: &NamedTensors, name: &str) -> Vec<[f32; N]> {
    floats(tensors, name).as_chunks::<N>().0.to_vec()
}

#[track_caller]
fn assert_close(ours: &[f32], reference: &[f32], tolerance: f32) {
    assert_eq!(ours.len(), reference.len());
    let largest = ours.iter().zip(reference).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(largest <= tolerance, "largest difference {largest}");
}

fn kitti_classes() -> Vec<AnchorClass> {
    let class = |name: &str, size, bottom, matched, unmatched| AnchorClass {
        name: name.into(),
        size,
        bottom,
        rotations: vec![0.0, 1.57],
        matched,
        unmatched,
    };
    vec![
        class("Car", [3.9, 1.6, 1.56], -1.78, 0.6, 0.45),
        class("Pedestrian", [0.8, 0.6, 1.73], -0.6, 0.5, 0.35),
        class("Cyclist", [1.76, 0.6, 1.73], -0.6, 0.5, 0.35),
    ]
}

#[test]
fn pillars_of_the_reference() {
    let file = read(&own("operators/pillars.safetensors"));
    let grid = PillarGrid {
        range: [0.0, -39.68, -3.0, 69.12, 39.68, 1.0],
        size: [0.16, 0.16, 4.0],
        max_points: 32,
        max_pillars: ints(&file, "max_pillars")[0] as usize,
    };
    let pillars = pillarise(&floats(&file, "points"), 4, &grid);
    assert_eq!(coords(&pillars), ints(&file, "coords_zyx"));
    assert_eq!(counts(&pillars), ints(&file, "num_points"));

    let features = decorate(&pillars, &grid);
    let padded = |values: &[f32], width: usize| {
        let mut rest = values;
        let mut padded = Vec::new();
        for &count in &pillars.num_points[..20] {
            let (mine, others) = rest.split_at(count as usize * width);
            rest = others;
            padded.extend_from_slice(mine);
            padded.resize(padded.len() + (32 - count as usize) * width, 0.0);
        }
        padded
    };
    assert_eq!(padded(&pillars.points, 4), floats(&file, "voxels.first20"));
    let reference = floats(&file, "augmented.first20");
    assert_close(&padded(&features, 10), &reference, 4e-6);
}

fn coords(pillars: &Pillars) -> Vec<i64> {
    pillars.coords_zyx.iter().flatten().map(|&c| i64::from(c)).collect()
}

fn counts(pillars: &Pillars) -> Vec<i64> {
    pillars.num_points.iter().map(|&n| i64::from(n)).collect()
}

#[test]
fn box_coder_of_the_reference() {
    let file = read(&own("operators/box_coders.safetensors"));
    let (boxes, anchors) = (rows::<7>(&file, "boxes"), rows::<7>(&file, "anchors"));
    let encoded: Vec<[f32; 7]> = boxes.iter().zip(&anchors).map(|(&b, &a)| box_coder::encode(b, a)).collect();
    assert_close(encoded.as_flattened(), &floats(&file, "residual.encoded"), 1e-6);
    let reference = rows::<7>(&file, "residual.encoded");
    let decoded: Vec<[f32; 7]> = reference.iter().zip(&anchors).map(|(&r, &a)| box_coder::decode(r, a)).collect();
    assert_close(decoded.as_flattened(), &floats(&file, "residual.decoded"), 4e-6);

    let angles = floats(&file, "limit_period.in");
    // The second is that of the direction target, relative to the start of the first bin.
    for (start, offset, name) in
        [(0.0, 0.5, "limit_period.offset05_period_2pi"), (DIRECTION_OFFSET_RAD, 0.0, "limit_period.offset0_period_2pi")]
    {
        let ours: Vec<f32> = angles.iter().map(|&a| limit_period(a - start, offset, std::f32::consts::TAU)).collect();
        assert_eq!(ours, floats(&file, name), "{name}");
    }

    let bins = ints(&file, "direction.bin");
    // The bins are an input, in place of the direction classifier.
    let turned = angles.iter().zip(&bins);
    let headings: Vec<f32> = turned
        .map(|(&yaw, &bin)| box_coder::direction_decode(yaw, bin as usize, DIRECTION_OFFSET_RAD, 0.0, 2))
        .collect();
    assert_close(&headings, &floats(&file, "direction.decoded_heading"), 1e-6);

    let nearest = floats(&file, "nearest_bev_iou");
    let of = |a: &[[f32; 7]], b: &[[f32; 7]]| -> Vec<f32> {
        a.iter().flat_map(|a| b.iter().map(|b| NearestBev::new(a).iou(&NearestBev::new(b)))).collect()
    };
    assert_eq!(of(&boxes, &anchors), nearest);
}

#[test]
fn target_assigner_of_the_reference() {
    let file = read(&own("operators/target_assigner.safetensors"));
    let boxes = rows::<8>(&file, "gt_boxes");
    let anchors = rows::<7>(&file, "anchors");
    let frames = frame_targets(&anchors, [40, 40], &boxes, 6);
    assert_eq!(labels(&frames), ints(&file, "box_cls_labels"));
    assert_eq!(positive(&frames), ints(&file, "positive_index"));
    assert_eq!(directions(&frames), ints(&file, "direction.positive"));
    let reg: Vec<f32> = frames.iter().flat_map(|t| t.reg.as_flattened().to_vec()).collect();
    assert_close(&reg, &floats(&file, "box_reg_targets.positive"), 1e-6);
}

fn frame_targets(anchors: &[[f32; 7]], map: [usize; 2], boxes: &[[f32; 8]], slots: usize) -> Vec<Targets> {
    boxes.chunks(slots).map(|frame| assign(anchors, &kitti_classes(), map, frame, DIRECTION_OFFSET_RAD)).collect()
}

fn labels(frames: &[Targets]) -> Vec<i64> {
    frames.iter().flat_map(|t| t.labels.iter().map(|&l| i64::from(l))).collect()
}

fn positive(frames: &[Targets]) -> Vec<i64> {
    let of = |(f, t): (usize, &Targets)| t.positive.iter().flat_map(|&(a, _)| [f as i64, a as i64]).collect::<Vec<_>>();
    frames.iter().enumerate().flat_map(of).collect()
}

fn directions(frames: &[Targets]) -> Vec<i64> {
    frames.iter().flat_map(|t| t.dir.iter().map(|&bin| bin as i64)).collect()
}

struct Case {
    folder: PathBuf,
    grid: PillarGrid,
    max_pillars: [usize; 2],
    map: [usize; 2],
    anchors: Vec<[f32; 7]>,
}

fn tiny(folder: PathBuf) -> Case {
    let range = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0];
    let grid = PillarGrid { range, size: [0.32, 0.32, 4.0], max_points: 8, max_pillars: 0 };
    Case {
        folder,
        grid,
        max_pillars: [40_000, 16_000],
        map: [16, 16],
        anchors: anchors(range, [16, 16], &kitti_classes()),
    }
}

fn published(folder: PathBuf) -> Case {
    let range = [0.0, -39.68, -3.0, 69.12, 39.68, 1.0];
    let grid = PillarGrid { range, size: [0.16, 0.16, 4.0], max_points: 32, max_pillars: 0 };
    let map = [248, 216];
    Case { folder, grid, max_pillars: [40_000, 16_000], map, anchors: anchors(range, map, &kitti_classes()) }
}

fn cases() -> Vec<Case> {
    let mut cases = vec![tiny(own("synthetic/pointpillars_tiny"))];
    cases.extend(shared("pointpillars_tiny").map(tiny));
    cases.extend(shared("pointpillars_kitti").map(published));
    cases
}

#[test]
fn pillars_and_anchors_of_the_eval_frames() {
    for case in cases() {
        let file = read(&case.folder.join("eval.safetensors"));
        let grid = PillarGrid { max_pillars: case.max_pillars[0], ..case.grid.clone() };
        let pillars = pillarise(&floats(&file, "in.points"), 4, &grid);
        let cells: Vec<i64> = coords(&pillars).as_chunks::<3>().0.iter().flat_map(|&[z, y, x]| [0, z, y, x]).collect();
        assert_eq!(cells, ints(&file, "pillar.coords_bzyx"));
        assert_eq!(counts(&pillars), ints(&file, "pillar.num_points"));

        let [_, width] = case.map;
        let cell = 6;
        let x: Vec<f32> = case.anchors.iter().step_by(cell).take(width).map(|a| a[0]).collect();
        let y: Vec<f32> = case.anchors.iter().step_by(cell * width).map(|a| a[1]).collect();
        assert_eq!(x, floats(&file, "anchor_x"));
        let reference = floats(&file, "anchor_y");
        let off = y.iter().zip(&reference).filter(|(a, b)| a != b).count();
        assert!(off <= y.len() / 4, "{off} of {} rows", y.len());
        assert_close(&y, &reference, 4e-6); // one unit in the last place of 39.68
        let first: Vec<[f32; 5]> = case.anchors[..cell].iter().map(|a| [a[2], a[3], a[4], a[5], a[6]]).collect();
        let want = rows::<7>(&file, "anchors_first_cell");
        assert_eq!(first, want.iter().map(|a| [a[2], a[3], a[4], a[5], a[6]]).collect::<Vec<_>>());
        let step = ints(&file, "anchors.step")[0] as usize;
        let sample: Vec<f32> = case.anchors.as_flattened().iter().step_by(step).copied().collect();
        assert_close(&sample, &floats(&file, "anchors.sample"), 4e-6);
    }
}

#[test]
fn targets_of_the_train_frames() {
    for case in cases() {
        let file = read(&case.folder.join("train.safetensors"));
        let shape = &file["in.gt_boxes"].shape;
        let (frames, slots) = (shape[0], shape[1]);
        let frames_targets = frame_targets(&case.anchors, case.map, &rows::<8>(&file, "in.gt_boxes"), slots);
        assert_eq!(frames_targets.len(), frames);
        let all = labels(&frames_targets);
        let step = ints(&file, "target.box_cls_labels.step")[0] as usize;
        let sample: Vec<i64> = all.iter().step_by(step).copied().collect();
        assert_eq!(sample, ints(&file, "target.box_cls_labels.sample"));
        assert_eq!(positive(&frames_targets), ints(&file, "target.positive_index"));
        assert_eq!(directions(&frames_targets), ints(&file, "target.positive_dir"));
        let ignored: Vec<i64> = frames_targets
            .iter()
            .enumerate()
            .flat_map(|(f, t)| {
                t.labels.iter().enumerate().filter(|l| *l.1 < 0).flat_map(move |l| [f as i64, l.0 as i64])
            })
            .collect();
        assert_eq!(ignored, ints(&file, "target.ignored_index"));
        let positive_label: Vec<i64> =
            frames_targets.iter().flat_map(|t| t.positive.iter().map(|p| i64::from(t.labels[p.0]))).collect();
        assert_eq!(positive_label, ints(&file, "target.positive_label"));
        let reg: Vec<f32> = frames_targets.iter().flat_map(|t| t.reg.as_flattened().to_vec()).collect();
        assert_close(&reg, &floats(&file, "target.positive_reg"), 2e-6);

        let mut cells = Vec::new();
        let mut points_of = Vec::new();
        for f in 0..frames {
            let grid = PillarGrid { max_pillars: case.max_pillars[1], ..case.grid.clone() };
            let pillars = pillarise(&floats(&file, &format!("in.points{f}")), 4, &grid);
            let of_frame = coords(&pillars);
            cells.extend(of_frame.as_chunks::<3>().0.iter().flat_map(|&[z, y, x]| [f as i64, z, y, x]));
            points_of.extend(counts(&pillars));
        }
        assert_eq!(cells, ints(&file, "pillar.coords_bzyx"));
        assert_eq!(points_of, ints(&file, "pillar.num_points"));
    }
}

fn options(score_threshold: f32) -> DecodeOptions {
    DecodeOptions {
        score_threshold,
        nms_iou: 0.01,
        nms_pre: 4096,
        nms_post: 500,
        dir_offset: DIRECTION_OFFSET_RAD,
        dir_limit_offset: 0.0,
    }
}

/// The reference stores scores and decoded boxes completely only for a few anchors. The head outputs are therefore
/// constructed: the boxes as anchors, residuals of zero, and the logits of the scores.
fn decode_again(boxes: &[[f32; 7]], scores: &[f32], options: &DecodeOptions) -> Vec<RawBox> {
    let logits: Vec<f32> = scores.iter().map(|&s| (f64::from(s) / (1.0 - f64::from(s))).ln() as f32).collect();
    let direction = [0.0, 1.0].repeat(boxes.len());
    decode(&logits, &vec![0.0; boxes.len() * 7], &direction, boxes, options).unwrap()
}

#[test]
fn suppression_of_the_reference() {
    let file = read(&own("operators/rotated_nms.safetensors"));
    let (boxes, scores) = (rows::<7>(&file, "boxes"), floats(&file, "scores"));
    for threshold in ["0.01", "0.1", "0.5", "0.7", "0.8", "0.85"] {
        let nms_iou = threshold.parse().unwrap();
        let kept = decode_again(&boxes, &scores, &DecodeOptions { nms_iou, ..options(0.0) });
        let kept: Vec<i64> = kept.iter().map(|raw| raw.anchor as i64).collect();
        assert_eq!(kept, ints(&file, &format!("thresh{threshold}.keep")), "{threshold}");
    }
}

#[test]
fn detections_stay_as_they_are() {
    for case in cases() {
        let file = read(&case.folder.join("eval.safetensors"));
        for set in ["det", "det2"] {
            let boxes = rows::<7>(&file, &format!("{set}.boxes"));
            let scores = floats(&file, &format!("{set}.scores"));
            let again = decode_again(&boxes, &scores, &options(0.0));
            assert_eq!(again.iter().map(|raw| raw.anchor).collect::<Vec<_>>(), (0..boxes.len()).collect::<Vec<_>>());
        }
    }
}

/// Head outputs that decode to the anchors, for all anchors of the published network.
#[test]
fn decoding_is_the_inverse_of_the_targets() {
    let case = tiny(own("synthetic/pointpillars_tiny"));
    let file = read(&case.folder.join("train.safetensors"));
    let slots = file["in.gt_boxes"].shape[1];
    let boxes = &rows::<8>(&file, "in.gt_boxes")[..slots];
    let targets = assign(&case.anchors, &kitti_classes(), case.map, boxes, DIRECTION_OFFSET_RAD);
    let count = case.anchors.len();
    let (mut residuals, mut direction) = (vec![0.0; count * 7], vec![0.0; count * 2]);
    for (k, &(anchor, _)) in targets.positive.iter().enumerate() {
        residuals[anchor * 7..][..7].copy_from_slice(&targets.reg[k]);
        direction[anchor * 2 + targets.dir[k]] = 1.0;
    }
    let decoded = decode_boxes(&residuals, &direction, &case.anchors, &options(0.1));
    for &(anchor, truth) in &targets.positive {
        assert_close(&decoded[anchor][..6], &boxes[truth][..6], 1e-5);
        let turned = limit_period(decoded[anchor][6] - boxes[truth][6], 0.5, std::f32::consts::TAU);
        assert!(turned.abs() < 1e-4, "{turned}");
    }
}

#[test]
fn the_reference_file_has_the_expected_shape() {
    let tensor: &HostTensor = &read(&own("operators/pillars.safetensors"))["points"];
    assert_eq!(tensor.shape, [600, 4]);
}
