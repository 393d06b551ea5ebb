//! The file readers, each with a valid file and the checks of its data.

use anyhow::Result;
use data::{
    Calibration, Cloud, DatasetConfig, FARTHEST_M, KittiText, PcdEncoding, PointColumns, encode_pcd, parse_bin,
};
use data::{parse_kitti_text, parse_pcd, parse_split};
use models::checkpoint::{HostTensor, HostValues, NamedTensors, parse_checkpoint, write_safetensors};
use models::config::DetectorConfig;
use models::results::parse_results;
use std::collections::BTreeMap;
use std::path::Path;
use train::{RunFolder, RunState};

/// Reads bytes: whether they were accepted, or an error if the accepted data are invalid.
pub(super) type Reader = Box<dyn Fn(&[u8]) -> Result<bool, String>>;

/// A reader with a valid file.
pub(super) struct Target {
    pub name: &'static str,
    pub valid: Vec<u8>,
    pub read: Reader,
}

/// All readers. `folder` is for readers that read from disk.
pub(super) fn targets(folder: &Path) -> Result<Vec<Target>> {
    let cloud = Cloud { values: (0..400).map(|i| (i as f32 * 0.37).sin() * 40.0).collect(), channels: 4 };
    let mut targets = vec![Target {
        name: "bin",
        valid: cloud.values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        read: Box::new(|bytes| cloud_is_valid(parse_bin(bytes, Path::new("fuzz.bin"), PointColumns::Xyzi).ok())),
    }];
    for (name, encoding) in [
        ("pcd ascii", PcdEncoding::Ascii),
        ("pcd binary", PcdEncoding::Binary),
        ("pcd compressed", PcdEncoding::BinaryCompressed),
    ] {
        let read = |bytes: &[u8]| cloud_is_valid(parse_pcd(bytes, Path::new("fuzz.pcd")).ok());
        targets.push(Target { name, valid: encode_pcd(&cloud, encoding), read: Box::new(read) });
    }
    let label = "Car 0.00 0 -1.57 599.41 156.40 629.75 189.25 2.85 2.63 12.34 0.47 1.49 69.44 -1.56\n\
                 DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10\n";
    targets.push(Target {
        name: "label",
        valid: label.into(),
        read: text(|t| {
            let lines = parse_kitti_text(t, Path::new("fuzz.txt"), KittiText::Labels).ok();
            let valid = |line: &data::LabelBox| line.location.iter().chain(&line.size_hwl).all(|v| v.is_finite());
            lines.map(|lines| lines.iter().all(valid))
        }),
    });
    let calibration = "P2: 721.5 0 609.5 44.8 0 721.5 172.8 0.21 0 0 1 0.0027\n\
                       R0_rect: 1 0 0 0 1 0 0 0 1\n\
                       Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n";
    targets.push(Target {
        name: "calibration",
        valid: calibration.into(),
        read: text(|t| {
            let read = Calibration::parse(t, Path::new("fuzz.txt")).ok();
            read.map(|c| c.cam_point([1.0, 2.0, 3.0]).iter().all(|v| v.is_finite()))
        }),
    });
    targets.push(Target {
        name: "detector toml",
        valid: models::detector_text("pointpillars_small")?.into_bytes(),
        read: text(|t| DetectorConfig::parse(t).ok().map(|c| c.check().is_ok())),
    });
    let toml = "name = \"track\"\nroot = \".\"\nlayout = \"kitti\"\nclasses = [\"Car\"]\n[splits]\ntrain = \"ImageSets/train.txt\"\n";
    targets.push(Target {
        name: "dataset toml",
        valid: toml.into(),
        read: text(|t| DatasetConfig::parse(t, Path::new("fuzz.toml")).ok().map(|_| true)),
    });
    targets.push(Target {
        name: "split",
        valid: "000000\n000017\n000023\n".into(),
        read: text(|t| {
            let inside = |id: &str| !id.is_empty() && !id.contains(['/', '\\']) && id != "..";
            parse_split(t, Path::new("fuzz.txt")).ok().map(|ids| ids.iter().all(|(_, id)| inside(id)))
        }),
    });
    let path = folder.join("weights.safetensors");
    write_safetensors(&path, &weights(), &BTreeMap::new())?;
    for (name, valid) in [
        ("safetensors", fs_err::read(&path)?),
        ("pth legacy", include_bytes!("../../../../tests/golden/checkpoints/tiny_legacy.pth").to_vec()),
        ("pth zip", include_bytes!("../../../../tests/golden/checkpoints/tiny_zip.pth").to_vec()),
    ] {
        let read = |bytes: &[u8]| match parse_checkpoint(Path::new("fuzz.pth"), bytes) {
            Err(_) => Ok(false),
            Ok(read) if read.values().all(fills_its_shape) => Ok(true),
            Ok(_) => Err("a tensor whose values do not fill its shape".into()),
        };
        targets.push(Target { name, valid, read: Box::new(read) });
    }
    for (name, valid) in [
        ("result.pkl old", include_bytes!("../../../../tests/golden/results/numpy1_protocol2.pkl").to_vec()),
        ("result.pkl new", include_bytes!("../../../../tests/golden/results/numpy2_protocol5.pkl").to_vec()),
        ("result.pkl forms", include_bytes!("../../../../tests/golden/results/numpy2_other_forms.pkl").to_vec()),
    ] {
        let read = |bytes: &[u8]| match parse_results(Path::new("fuzz.pkl"), bytes) {
            Err(_) => Ok(false),
            Ok(frames) if frames.iter().flat_map(|f| &f.detections).all(is_finite) => Ok(true),
            Ok(_) => Err("a detection that is not finite".into()),
        };
        targets.push(Target { name, valid, read: Box::new(read) });
    }
    targets.extend(super::scenes::targets(folder)?);
    targets.extend(super::shards::targets(folder)?);
    targets.extend(super::recordings::targets(folder)?);
    targets.extend(run_folder(&folder.join("run"))?);
    Ok(targets)
}

/// The files of a run folder, each damaged separately: reading returns the written state or an error.
fn run_folder(path: &Path) -> Result<Vec<Target>> {
    let state = RunState {
        step: 20,
        total_steps: 100,
        epoch: 1,
        position: 4,
        seed: 7,
        config_sha256: "c".into(),
        data_sha256: None,
        frames_sha256: "f".into(),
        best: None,
    };
    let folder = RunFolder::open(path)?;
    folder.save(&state, &weights(), &BTreeMap::new(), &weights(), 1)?;
    drop(folder);
    let names = [
        ("run state", "state.json"),
        ("run weights", "step-20.safetensors"),
        ("run moments", "step-20.optimizer.safetensors"),
    ];
    let target = |(name, file): (&'static str, &str)| {
        let damaged = path.join("checkpoint").join(file);
        let (valid, path, state) = (fs_err::read(&damaged)?, path.to_path_buf(), state.clone());
        let read = {
            let valid = valid.clone();
            move |bytes: &[u8]| {
                // Remove the file first, so that hard links to it are not damaged.
                fs_err::remove_file(&damaged)
                    .and_then(|()| fs_err::write(&damaged, bytes))
                    .map_err(|e| e.to_string())?;
                let loaded = RunFolder::open(&path).and_then(|folder| folder.load());
                fs_err::write(&damaged, &valid).map_err(|e| e.to_string())?;
                match loaded {
                    Err(_) => Ok(false),
                    Ok(Some(read)) if read.state == state && read.weights == read.moments => Ok(true),
                    Ok(_) => Err("read a state that was not written".to_string()),
                }
            }
        };
        Ok(Target { name, valid, read: Box::new(read) })
    };
    names.into_iter().map(target).collect()
}

fn weights() -> NamedTensors {
    let tensor = HostTensor { shape: vec![2, 3], values: HostValues::F32(vec![0.5; 6]) };
    [("a.weight".to_string(), tensor.clone()), ("b.weight".to_string(), tensor)].into()
}

fn is_finite(detection: &data::Detection) -> bool {
    detection.bbox.to_array().iter().all(|v| v.is_finite()) && detection.score.is_finite()
}

fn fills_its_shape(tensor: &HostTensor) -> bool {
    let values = match &tensor.values {
        HostValues::F32(v) => v.len(),
        HostValues::F64(v) => v.len(),
        HostValues::I64(v) => v.len(),
    };
    values == tensor.shape.iter().product::<usize>()
}

/// Checks for finite coordinates within 10 km, complete points and at least one point.
fn cloud_is_valid(cloud: Option<Cloud>) -> Result<bool, String> {
    let Some(cloud) = cloud else { return Ok(false) };
    let near = |i: usize| cloud.xyz(i).iter().all(|v| v.abs() <= FARTHEST_M);
    if cloud.is_empty() || cloud.values.len() % cloud.channels != 0 || !(0..cloud.len()).all(near) {
        return Err("a cloud that is empty, incomplete or larger than 10 km".into());
    }
    Ok(true)
}

/// A reader of text. `read` returns `None` for an error, else whether the data are valid.
pub(super) fn text(read: impl Fn(&str) -> Option<bool> + 'static) -> Reader {
    Box::new(move |bytes| match read(&String::from_utf8_lossy(bytes)) {
        None => Ok(false),
        Some(true) => Ok(true),
        Some(false) => Err("a value that is not finite".into()),
    })
}
