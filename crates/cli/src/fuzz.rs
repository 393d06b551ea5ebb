//! `lidarshift fuzz`: damaged files for every reader. A reader answers with data that keeps its promises or with an error; it never panics.

use anyhow::Result;
use clap::Args;
use data::{
    Calibration, Cloud, DatasetConfig, FARTHEST_M, KittiText, PcdEncoding, PointColumns, encode_pcd, parse_bin,
};
use data::{parse_kitti_text, parse_pcd, stream};
use models::checkpoint::{HostTensor, HostValues, NamedTensors, read_checkpoint, write_safetensors};
use models::config::DetectorConfig;
use rand::RngExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// Feeds damaged files to every reader: no panic, and nothing damaged beyond its promises is taken for data.
#[derive(Args, Debug)]
pub struct FuzzArgs {
    /// Damaged inputs for each reader
    #[arg(long, default_value_t = 1000)]
    inputs: u64,
    /// Of the damage
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Reads bytes; says whether they were taken, and fails when what was taken breaks a promise.
type Reader = Box<dyn Fn(&[u8]) -> Result<bool, String>>;

/// A reader with a sound file to start from.
struct Target {
    name: &'static str,
    sound: Vec<u8>,
    read: Reader,
}

impl FuzzArgs {
    /// Whether every reader stood.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<bool> {
        let folder = tempfile::tempdir()?;
        let mut stood = true;
        std::panic::set_hook(Box::new(|_| {}));
        for target in targets(folder.path())? {
            let (mut taken, mut broken) = (0u64, Vec::new());
            for input in 0..self.inputs {
                let bytes = damaged(&target.sound, self.seed, target.name, input);
                match catch_unwind(AssertUnwindSafe(|| (target.read)(&bytes))) {
                    Ok(Ok(was_taken)) => taken += u64::from(was_taken),
                    Ok(Err(promise)) => broken.push(format!("input {input}: {promise}")),
                    Err(_) => broken.push(format!("input {input}: panic")),
                }
            }
            println!("{:<18} {} inputs, {taken} taken as data, {} broken", target.name, self.inputs, broken.len());
            broken.iter().take(5).for_each(|b| println!("    {b}"));
            stood &= broken.is_empty();
        }
        let _ = std::panic::take_hook();
        Ok(stood)
    }
}

/// One to four changes: a bit, a byte, a cut, a repeated piece, a swapped piece.
fn damaged(sound: &[u8], seed: u64, name: &str, input: u64) -> Vec<u8> {
    let mut random = stream(seed, &format!("fuzz/{name}"), 0, input);
    let mut bytes = sound.to_vec();
    for _ in 0..random.random_range(1..=4) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        let until = (at + random.random_range(1..=16)).min(bytes.len());
        match random.random_range(0..6) {
            0 => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes[at] = random.random(),
            2 => bytes.truncate(at),
            3 => drop(bytes.drain(at..until)),
            4 => {
                let piece = bytes[at..until].to_vec();
                let to = random.random_range(0..=bytes.len());
                bytes.splice(to..to, piece);
            }
            _ => {
                const NUMBERS: [&[u8]; 6] = [b"-1", b"nan", b"inf", b"99999999999999999999", b"0", b"\xff\xff\xff\xff"];
                let number = NUMBERS[random.random_range(0..NUMBERS.len())];
                bytes.splice(at..until, number.iter().copied());
            }
        }
    }
    bytes
}

fn targets(folder: &Path) -> Result<Vec<Target>> {
    let cloud = Cloud { values: (0..400).map(|i| (i as f32 * 0.37).sin() * 40.0).collect(), channels: 4 };
    let mut targets = vec![Target {
        name: "bin",
        sound: cloud.values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        read: Box::new(|bytes| cloud_promises(parse_bin(bytes, Path::new("fuzz.bin"), PointColumns::Xyzi).ok())),
    }];
    for (name, encoding) in [
        ("pcd ascii", PcdEncoding::Ascii),
        ("pcd binary", PcdEncoding::Binary),
        ("pcd compressed", PcdEncoding::BinaryCompressed),
    ] {
        let read = |bytes: &[u8]| cloud_promises(parse_pcd(bytes, Path::new("fuzz.pcd")).ok());
        targets.push(Target { name, sound: encode_pcd(&cloud, encoding), read: Box::new(read) });
    }
    let label = "Car 0.00 0 -1.57 599.41 156.40 629.75 189.25 2.85 2.63 12.34 0.47 1.49 69.44 -1.56\n\
                 DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10\n";
    targets.push(Target {
        name: "label",
        sound: label.into(),
        read: text(|t| {
            let lines = parse_kitti_text(t, Path::new("fuzz.txt"), KittiText::Labels).ok();
            let sound = |line: &data::KittiLine| line.location.iter().chain(&line.size_hwl).all(|v| v.is_finite());
            lines.map(|lines| lines.iter().all(sound))
        }),
    });
    let calibration = "P2: 721.5 0 609.5 44.8 0 721.5 172.8 0.21 0 0 1 0.0027\n\
                       R0_rect: 1 0 0 0 1 0 0 0 1\n\
                       Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n";
    targets.push(Target {
        name: "calibration",
        sound: calibration.into(),
        read: text(|t| {
            let read = Calibration::parse(t, Path::new("fuzz.txt")).ok();
            read.map(|c| c.cam_point([1.0, 2.0, 3.0]).iter().all(|v| v.is_finite()))
        }),
    });
    targets.push(Target {
        name: "detector toml",
        sound: crate::detectors::detector_text("pointpillars_small")?.into_bytes(),
        read: text(|t| DetectorConfig::parse(t).ok().map(|c| c.check().is_ok())),
    });
    let path = folder.join("dataset.toml");
    let toml = "name = \"track\"\nroot = \".\"\nlayout = \"kitti\"\nclasses = [\"Car\"]\n[splits]\ntrain = \"ImageSets/train.txt\"\n";
    targets.push(Target {
        name: "dataset toml",
        sound: toml.into(),
        read: Box::new(move |bytes| {
            fs_err::write(&path, bytes).map_err(|e| e.to_string())?;
            Ok(DatasetConfig::read(&path).is_ok())
        }),
    });
    let path = folder.join("weights.safetensors");
    let tensor = HostTensor { shape: vec![2, 3], values: HostValues::F32(vec![0.5; 6]) };
    let weights: NamedTensors = [("a.weight".to_string(), tensor.clone()), ("b.weight".to_string(), tensor)].into();
    write_safetensors(&path, &weights, &Default::default())?;
    targets.push(Target {
        name: "safetensors",
        sound: fs_err::read(&path)?,
        read: Box::new(move |bytes| {
            fs_err::write(&path, bytes).map_err(|e| e.to_string())?;
            let Ok(read) = read_checkpoint(&path) else { return Ok(false) };
            let whole = |t: &HostTensor| match &t.values {
                HostValues::F32(v) => v.len() == t.shape.iter().product::<usize>(),
                HostValues::F64(v) => v.len() == t.shape.iter().product::<usize>(),
                HostValues::I64(v) => v.len() == t.shape.iter().product::<usize>(),
            };
            if read.values().all(whole) { Ok(true) } else { Err("a tensor whose values do not fill its shape".into()) }
        }),
    });
    Ok(targets)
}

/// Finite coordinates within 10 km, whole points, at least one.
fn cloud_promises(cloud: Option<Cloud>) -> Result<bool, String> {
    let Some(cloud) = cloud else { return Ok(false) };
    let near = |i: usize| cloud.xyz(i).iter().all(|v| v.abs() <= FARTHEST_M);
    if cloud.is_empty() || cloud.values.len() % cloud.channels != 0 || !(0..cloud.len()).all(near) {
        return Err("a cloud that is empty, cut, or reaches beyond 10 km".into());
    }
    Ok(true)
}

/// A reader of text: `None` for an error, else whether the promises hold.
fn text(read: impl Fn(&str) -> Option<bool> + 'static) -> Reader {
    Box::new(move |bytes| match read(&String::from_utf8_lossy(bytes)) {
        None => Ok(false),
        Some(true) => Ok(true),
        Some(false) => Err("a value that is not finite".into()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readers_stand_damage() {
        assert!(FuzzArgs { inputs: 300, seed: 1 }.run().unwrap());
    }
}
