//! The readers of what simulations and studies are made of: meshes, tracks, rigs, effects, studies, manifests.

use super::targets::{Reader, Target, text};
use anyhow::Result;
use data::{DataError, verify_frames};
use sensor::material::MaterialTable;
use sensor::{EffectList, Rig};
use simulate::mesh::MeshFile;
use simulate::race::RaceConfig;
use simulate::scenario::Trajectory;
use simulate::track::CentreLine;
use simulate::{FrameCounts, Manifest, RoadConfig, make_road_dataset};
use std::path::{Path, PathBuf};
use study::StudyConfig;

/// An open box of two triangles of each material.
const OBJ: &str =
    "mtllib none.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl skin\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n";

const STL: &str = "solid a\nfacet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n\
                   endfacet\nfacet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 0 1 0\nvertex 0 0 1\nendloop\n\
                   endfacet\nendsolid a\n";

/// A triangle whose buffer stands in the text, placed by two nodes.
const GLTF: &str = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],
"nodes":[{"mesh":0,"translation":[10,0,0],"children":[1]},{"mesh":0,"rotation":[0,0,0,1],"scale":[1,2,1]}],
"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1,"mode":4}]}],
"buffers":[{"byteLength":42,"uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAAAAABAAIA"}],
"bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":36},{"buffer":0,"byteOffset":36,"byteLength":6}],
"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]},
{"bufferView":1,"componentType":5123,"count":3,"type":"SCALAR"}]}"#;

const EFFECTS: &str = "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n\n[[effect]]\nkind = \"fog\"\nvisibility_m = 80\n\n\
                       [[effect]]\nkind = \"range_dropout\"\nrange_m = [20.0, 60.0]\nshare = [0.1, 0.6]\n";

/// The text of a file of `configs`.
fn built_in(path: &str) -> &'static str {
    configs::text(path).expect("the file comes with the program")
}

/// A binary STL of two triangles.
fn binary_stl() -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend(2u32.to_le_bytes());
    for corner in [1.0f32, 2.0] {
        for value in [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, corner, 0.0, 0.0, 0.0, corner, 0.0] {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend([0; 2]);
    }
    bytes
}

/// The JSON and the buffer of [`GLTF`] in one binary file.
fn glb() -> Vec<u8> {
    let (before, after) = GLTF.split_once(",\"uri\":\"").expect("it has a buffer");
    let mut json = before.to_string() + after.split_once('"').expect("the buffer ends").1;
    while json.len() % 4 != 0 {
        json.push(' ');
    }
    let mut buffer = Vec::new();
    for value in [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0] {
        buffer.extend(value.to_le_bytes());
    }
    buffer.extend([0, 0, 1, 0, 2, 0, 0, 0]);
    let chunk = |kind: &[u8], bytes: &[u8]| [&(bytes.len() as u32).to_le_bytes(), kind, bytes].concat();
    let chunks = [chunk(b"JSON", json.as_bytes()), chunk(b"BIN\0", &buffer)].concat();
    let head = [2, 12 + chunks.len() as u32].map(u32::to_le_bytes).concat();
    [&b"glTF"[..], &head, &chunks].concat()
}

/// The readers. `folder` is for those that read from disk.
pub(super) fn targets(folder: &Path) -> Result<Vec<Target>> {
    let mut targets = Vec::new();
    for (name, file, valid) in [
        ("mesh obj", "a.obj", OBJ.into()),
        ("mesh stl text", "text.stl", STL.into()),
        ("mesh stl binary", "binary.stl", binary_stl()),
        ("mesh gltf", "a.gltf", GLTF.into()),
        ("mesh glb", "a.glb", glb()),
    ] {
        targets.push(Target { name, valid, read: mesh(folder, file)? });
    }
    let circle = |i: usize| (i as f64 / 40.0 * std::f64::consts::TAU).sin_cos();
    let line = |i| format!("{:.3},{:.3},0.5,2.0,6.0,7.0\n", 60.0 * circle(i).1, 60.0 * circle(i).0);
    targets.push(Target {
        name: "track csv",
        valid: format!("x_m,y_m,z_m,bank_deg,width_left_m,width_right_m\n{}", (0..40).map(line).collect::<String>())
            .into(),
        read: of_file(folder.join("track.csv"), |path| {
            CentreLine::read(path).map(|track| {
                let way_m = track.length_m();
                let at = track.at(0.7 * way_m);
                way_m.is_finite() && format!("{at:?}").find("NaN").is_none()
            })
        }),
    });
    let header = "time_s,x_m,y_m,z_m,yaw_rad,pitch_rad,roll_rad,vx_mps,vy_mps,vz_mps\n";
    let state = |i: usize| format!("{:.2},{i}.5,2.0,0.3,0.1,0.0,0.0,10.0,0.0,0.0\n", i as f64 * 0.1);
    targets.push(Target {
        name: "trajectory csv",
        valid: format!("{header}{}", (0..12).map(state).collect::<String>()).into(),
        read: of_file(folder.join("trajectory.csv"), |path| {
            Trajectory::read(path).map(|way| way.span_s().iter().all(|time| time.is_finite()))
        }),
    });
    for (name, valid) in
        [("rig toml", built_in("sensors/av21.toml")), ("rig toml spinning", built_in("sensors/hdl64e.toml"))]
    {
        let read = text(|t| {
            let rig = Rig::parse(t, Path::new("fuzz.toml")).ok()?;
            Some(rig.sensors.iter().all(|sensor| sensor.rate_hz.is_finite()))
        });
        targets.push(Target { name, valid: valid.into(), read });
    }
    targets.push(Target {
        name: "effects toml",
        valid: EFFECTS.into(),
        read: text(|t| EffectList::parse(t, Path::new("fuzz.toml")).ok().map(|_| true)),
    });
    targets.push(Target {
        name: "race toml",
        valid: built_in("simulate/race.toml").into(),
        read: text(|t| RaceConfig::parse(t, Path::new("fuzz.toml")).ok().map(|config| config.check().is_ok())),
    });
    for (name, valid) in
        [("study toml", built_in("studies/quick.toml")), ("study toml paper", built_in("studies/paper.toml"))]
    {
        let read = text(|t| StudyConfig::parse(t, Path::new("fuzz.toml")).ok().map(|study| !study.name.is_empty()));
        targets.push(Target { name, valid: valid.into(), read });
    }
    targets.extend(manifests(&folder.join("road"))?);
    Ok(targets)
}

/// A reader of mesh files: whether all corners exist and all coordinates are finite.
fn mesh(folder: &Path, file: &str) -> Result<Reader> {
    let materials = serde_json::json!({ "skin": "paint", "a": "paint" });
    let config: MeshFile =
        serde_json::from_value(serde_json::json!({ "file": file, "allow_open": true, "materials": materials }))?;
    let (path, folder, table) = (folder.join(file), folder.to_path_buf(), MaterialTable::default());
    Ok(of_file(path, move |_| {
        config.read(&folder, &table).map(|mesh| {
            let exists = |corner: &u32| (*corner as usize) < mesh.vertices.len();
            mesh.faces.iter().all(|face| face.corners.iter().all(exists))
                && mesh.vertices.iter().flatten().all(|value| value.is_finite())
        })
    }))
}

/// A reader of a file at a path. `read` says whether the data are valid.
fn of_file(path: PathBuf, read: impl Fn(&Path) -> Result<bool, DataError> + 'static) -> Reader {
    Box::new(move |bytes| {
        fs_err::write(&path, bytes).map_err(|e| e.to_string())?;
        match read(&path) {
            Err(_) => Ok(false),
            Ok(true) => Ok(true),
            Ok(false) => Err("data that are not valid".into()),
        }
    })
}

/// `manifest.json` and `frames.jsonl` of a data set, each damaged separately: either is refused, or all frames are the
/// recorded ones.
fn manifests(root: &Path) -> Result<Vec<Target>> {
    let road = RoadConfig { frames: FrameCounts { train: 1, val: 1, test: 1 }, ..RoadConfig::default() };
    make_road_dataset(&road, root, &|_, _| ())?;
    let target = |(name, file): (&'static str, &str)| {
        let (path, root) = (root.join(file), root.to_path_buf());
        let valid = fs_err::read(&path)?;
        let whole = valid.clone();
        let read = move |bytes: &[u8]| {
            fs_err::write(&path, bytes).map_err(|e| e.to_string())?;
            let parsed = serde_json::from_slice::<Manifest>(bytes).is_ok();
            let found = verify_frames(&root);
            fs_err::write(&path, &whole).map_err(|e| e.to_string())?;
            match found {
                Err(_) => Ok(parsed),
                Ok(3) => Ok(true),
                Ok(frames) => Err(format!("{frames} frames instead of 3")),
            }
        };
        Ok(Target { name, valid, read: Box::new(read) })
    };
    [("manifest", "manifest.json"), ("frame records", "frames.jsonl")].into_iter().map(target).collect()
}
