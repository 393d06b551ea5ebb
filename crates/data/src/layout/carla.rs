//! CARLA's PLY: `*.ply` as `save_to_disk` of a LiDAR writes them, ascii or binary.
//!
//! CARLA's frame is left-handed with y to the right: y is negated here. CARLA's clouds are known by their property `I`
//! (`sensor.lidar.ray_cast`), or `ObjTag` (`sensor.lidar.ray_cast_semantic`, without an intensity). Source:
//! `PointCloudIO.h` and `LidarData.h` of LibCarla.

use super::DataLayout;
use crate::cloud_file::check_cloud;
use crate::kitti_text::{KittiText, read_kitti_text};
use crate::limits::{MOST_CLOUD_BYTES, MOST_POINTS, at_most, read_file};
use crate::write::write_kitti_text;
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns, write_atomic};
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{Encoding, Header, Property, PropertyAccess, PropertyAccessResult};
use std::collections::BTreeSet;
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// Clouds that CARLA wrote.
pub(super) struct Carla;

/// Folder of labels: KITTI text in the LiDAR frame, which the user's recorder writes.
const LABELS: &str = "label";

/// A vertex, as far as it is used.
#[derive(Clone, Copy)]
struct Vertex {
    point: [f32; 4],
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        // What a file does not give is no number, which the checks of clouds refuse.
        Vertex { point: [f32::NAN, f32::NAN, f32::NAN, 0.0] }
    }

    fn set_property(&mut self, key: &str, property: Property) -> PropertyAccessResult {
        let channel = match key {
            "x" => 0,
            "y" => 1,
            "z" => 2,
            "I" => 3,
            _ => return PropertyAccessResult::Ignored,
        };
        self.point[channel] = match property {
            Property::Float(v) => v,
            Property::Double(v) => v as f32,
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

impl DataLayout for Carla {
    fn name(&self) -> &'static str {
        "carla"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["*.ply (CARLA)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        self.frame_ids(folder).ok()?;
        Some(DatasetConfig { layout: Layout::Carla, root: folder.into(), ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        self.frame_ids(root).map(drop)
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        let mut ids = BTreeSet::new();
        for entry in fs_err::read_dir(root)? {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == "ply") {
                let id = path.file_stem().and_then(|id| id.to_str());
                ids.insert(id.ok_or_else(|| DataError::file(&path, "its name is not UTF-8"))?.to_string());
            }
        }
        if ids.is_empty() {
            return Err(DataError::file(root, "has no .ply file: check `root` and `layout` of the data set"));
        }
        Ok(ids.into_iter().collect())
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(format!("{id}.ply"))
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(LABELS).join(format!("{id}.txt"))
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(LABELS).is_dir()
    }

    /// From the header of the first cloud.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        let path = self.cloud_path(root, &self.frame_ids(root)?[0]);
        let bytes = read_file(&path, MOST_CLOUD_BYTES)?;
        Ok(vertices(&header(&mut Reader::new(Cursor::new(&bytes[..])), &path)?, &path)?.1)
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let path = self.cloud_path(root, id);
        let cloud = parse_carla_ply(&read_file(&path, MOST_CLOUD_BYTES)?, &path)?;
        Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud })
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        read_kitti_text(&self.labels_path(root, id), KittiText::Labels)
    }

    fn folders(&self) -> &'static [&'static str] {
        &["", LABELS]
    }

    fn write_cloud(&self, root: &Path, id: &str, cloud: &Cloud) -> Result<(), DataError> {
        write_atomic(&self.cloud_path(root, id), &encode_carla_ply(cloud))
    }

    fn write_labels(&self, root: &Path, id: &str, labels: &[LabelBox]) -> Result<(), DataError> {
        write_kitti_text(&self.labels_path(root, id), labels)
    }
}

fn header(input: &mut Reader<Cursor<&[u8]>>, path: &Path) -> Result<Header, DataError> {
    let parser = Parser::<Vertex>::new();
    parser.read_header(input).map_err(|e| DataError::file(path, format!("its PLY header cannot be read: {e}")))
}

/// Number of vertices, and whether they have an intensity.
fn vertices(header: &Header, path: &Path) -> Result<(usize, bool), DataError> {
    let Some((first, element)) = header.elements.first() else {
        return Err(DataError::file(path, "has no element vertex"));
    };
    if first != "vertex" {
        return Err(DataError::file(path, format!("its first element is {first:?}; CARLA writes vertex alone")));
    }
    let has = |name: &str| element.properties.contains_key(name);
    if let Some(missing) = ["x", "y", "z"].into_iter().find(|name| !has(name)) {
        return Err(DataError::file(path, format!("its vertices have no property {missing}")));
    }
    if !has("I") && !has("ObjTag") {
        let message = "was not written by a LiDAR of CARLA: its vertices have neither I nor ObjTag. Its frame is not \
                       known; convert it to .bin or .pcd with x forward, y left, z up";
        return Err(DataError::file(path, message));
    }
    at_most(path, "points", element.count as u64, MOST_POINTS)?;
    Ok((element.count, has("I")))
}

/// Parses a cloud of CARLA. y is negated. `path` is used in error messages.
///
/// # Errors
/// A header that is not CARLA's, fewer or more vertices than it says, and the checks of [`crate::read_cloud`].
pub fn parse_carla_ply(bytes: &[u8], path: &Path) -> Result<Cloud, DataError> {
    let mut input = Reader::new(Cursor::new(bytes));
    let header = header(&mut input, path)?;
    let (count, intensity) = vertices(&header, path)?;
    let element = &header.elements["vertex"];
    // Every value of a vertex has at least one byte, in text two.
    let least = if header.encoding == Encoding::Ascii { 2 } else { 1 };
    let left = (bytes.len() as u64).saturating_sub(input.get_ref().position());
    if (count * element.properties.len() * least) as u64 > left + 1 {
        return Err(DataError::file(path, format!("has {left} bytes behind its header, too few for {count} vertices")));
    }
    let parser = Parser::<Vertex>::new();
    let read = parser.read_payload_for_element(&mut input, element, &header);
    let read = read.map_err(|e| {
        // The lines behind the first repeat the line of the file.
        let why = e.to_string();
        let why = why.lines().next().unwrap_or_default();
        DataError::file(path, format!("its {count} vertices cannot be read: {why}"))
    })?;
    let rest = &bytes[(input.get_ref().position() as usize).min(bytes.len())..];
    if header.elements.len() == 1 && rest.iter().any(|b| !b.is_ascii_whitespace()) {
        return Err(DataError::file(path, format!("has {} bytes behind its {count} vertices", rest.len())));
    }
    let channels = if intensity { 4 } else { 3 };
    let mut values = Vec::with_capacity(count * channels);
    for Vertex { point: [x, y, z, i] } in read {
        values.extend_from_slice(&[x, -y, z, i][..channels]);
    }
    let cloud = Cloud { values, channels };
    check_cloud(&cloud, path)?;
    Ok(cloud)
}

/// Encodes a cloud as CARLA's clouds, in binary. y is negated. A cloud without an intensity gets one of 0.
fn encode_carla_ply(cloud: &Cloud) -> Vec<u8> {
    let mut out = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float32 x\nproperty float32 y\n\
         property float32 z\nproperty float32 I\nend_header\n",
        cloud.len()
    )
    .into_bytes();
    for point in cloud.points() {
        let intensity = point.get(3).copied().unwrap_or(0.0);
        out.extend([point[0], -point[1], point[2], intensity].iter().flat_map(|v| v.to_le_bytes()));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ASCII: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float32 x\nproperty float32 y\n\
                         property float32 z\nproperty float32 I\nend_header\n1.0000 2.0000 3.0000 0.9500\n\
                         -4.0000 -5.5000 0.2500 0.8000 \n";

    fn parsed(text: &str) -> Result<Cloud, String> {
        parse_carla_ply(text.as_bytes(), Path::new("out/12.ply")).map_err(|e| e.to_string())
    }

    #[test]
    fn y_is_negated_in_text_and_binary() {
        let want = [1.0, -2.0, 3.0, 0.95, -4.0, 5.5, 0.25, 0.8];
        let cloud = parsed(ASCII).unwrap();
        assert_eq!((&cloud.values[..], cloud.channels), (&want[..], 4));
        let binary = parse_carla_ply(&encode_carla_ply(&cloud), Path::new("b.ply")).unwrap();
        assert_eq!(binary, cloud);
    }

    #[test]
    fn a_semantic_lidar_has_no_intensity() {
        let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float32 x\nproperty float32 y\nproperty float32 z\n\
                    property float32 CosAngle\nproperty uint32 ObjIdx\nproperty uint32 ObjTag\nend_header\n\
                    1 2 3 0.5 17 10\n";
        assert_eq!(parsed(text).unwrap(), Cloud { values: vec![1.0, -2.0, 3.0], channels: 3 });
    }

    #[test]
    fn wrong_files_are_errors() {
        for (from, to, want) in [
            ("float32 I", "float32 nx", "not written by a LiDAR of CARLA"),
            ("float32 y", "float32 v", "no property y"),
            ("vertex 2", "vertex 3", "3 vertices cannot be read"),
            ("vertex 2", "vertex 1", "bytes behind its 1 vertices"),
            ("vertex 2", "vertex 900", "too few for 900 vertices"),
            ("vertex 2", "vertex 99999999", "at most"),
            ("vertex 2", "face 2", "its first element is \"face\""),
            ("ply\n", "plt\n", "header cannot be read"),
            ("3.0000", "nan", "cannot be read: Line 9"),
        ] {
            assert!(ASCII.contains(from), "{from}");
            let error = parsed(&ASCII.replacen(from, to, 1)).unwrap_err();
            assert!(error.contains("12.ply") && error.contains(want), "{error}, not {want}");
        }
    }

    proptest! {
        #[test]
        fn damaged_files_do_not_panic(at in any::<prop::sample::Index>(), byte in any::<u8>(), text in any::<bool>()) {
            let cloud = parsed(ASCII).unwrap();
            let mut bytes = if text { ASCII.as_bytes().to_vec() } else { encode_carla_ply(&cloud) };
            let at = at.index(bytes.len());
            let _ = parse_carla_ply(&bytes[..at], Path::new("a.ply"));
            bytes[at] = byte;
            let _ = parse_carla_ply(&bytes, Path::new("a.ply"));
        }
    }
}
