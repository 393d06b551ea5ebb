//! Meshes of glTF files.

use super::file::{MOST_MESH_BYTES, MOST_MESH_VERTICES, Part};
use base64::Engine as _;
use data::DataError;
use data::limits::read_file;
use gltf::accessor::{DataType, Dimensions};
use nalgebra::{Matrix4, Point3};
use std::path::Path;

/// Nodes of a glTF file, counted once for each scene.
pub const MOST_NODES: usize = 100_000;

/// The triangles of all nodes of all scenes, in the frame of the file.
pub(super) fn read_gltf(path: &Path) -> Result<Vec<Part>, DataError> {
    let wrong = |message: String| DataError::file(path, message);
    let invalid = |e: &dyn std::fmt::Display| wrong(format!("is not a valid glTF file: {e}"));
    let bytes = read_file(path, MOST_MESH_BYTES)?;
    // The library computes with these numbers before it checks them.
    let length = bytes.get(8..12).and_then(|n| n.first_chunk::<4>()).map(|n| u32::from_le_bytes(*n));
    if bytes.starts_with(b"glTF") && length.is_none_or(|length| length < 12) {
        return Err(invalid(&"its header is cut off or gives a length below 12 bytes"));
    }
    let gltf = gltf::Gltf::from_slice_without_validation(&bytes).map_err(|e| invalid(&e))?;
    check_indices(gltf.document.as_json()).map_err(|e| invalid(&e))?;
    let blob = gltf.blob;
    let document = gltf::Document::from_json(gltf.document.into_json()).map_err(|e| invalid(&e))?;
    let buffers = buffers(path, &document, blob)?;
    let mut parts = Parts { path, buffers, parts: Vec::new(), vertices: 0 };
    let mut nodes = 0;
    for scene in document.scenes() {
        let mut seen = vec![false; document.nodes().len()];
        let mut open: Vec<_> = scene.nodes().map(|node| (node, Matrix4::identity())).collect();
        while let Some((node, above)) = open.pop() {
            nodes += 1;
            if nodes > MOST_NODES {
                return Err(wrong(format!("has more than {MOST_NODES} nodes in its scenes")));
            }
            if std::mem::replace(&mut seen[node.index()], true) {
                return Err(wrong(format!(
                    "nodes[{}] is reached twice: a node of glTF has one parent and is not below itself",
                    node.index()
                )));
            }
            let local = Matrix4::from(node.transform().matrix()).map(f64::from);
            let root_from_node: Matrix4<f64> = above * local;
            for primitive in node.mesh().into_iter().flat_map(|mesh| mesh.primitives().collect::<Vec<_>>()) {
                parts.add(&primitive, &root_from_node)?;
            }
            open.extend(node.children().map(|child| (child, root_from_node)));
        }
    }
    Ok(parts.parts)
}

/// Checks that the accessors of all primitives exist.
fn check_indices(json: &gltf::json::Root) -> Result<(), String> {
    for (i, mesh) in json.meshes.iter().enumerate() {
        for primitive in &mesh.primitives {
            if let Some(index) = primitive.attributes.values().find(|index| index.value() >= json.accessors.len()) {
                return Err(format!("meshes[{i}] names accessors[{}], which does not exist", index.value()));
            }
        }
    }
    Ok(())
}

/// Checks that an accessor has values of one of these types, and that they lie in its buffer.
fn check_accessor(accessor: &gltf::Accessor, types: &[DataType], dimensions: Dimensions) -> Result<(), String> {
    let what = format!("accessors[{}]", accessor.index());
    if !types.contains(&accessor.data_type()) || accessor.dimensions() != dimensions {
        let (found, shape) = (accessor.data_type(), accessor.dimensions());
        return Err(format!("{what} has values {found:?} {shape:?}, but must have {types:?} {dimensions:?}"));
    }
    let sparse = accessor.sparse();
    if accessor.count() == 0 || sparse.as_ref().is_some_and(|s| !(1..=accessor.count()).contains(&s.count())) {
        return Err(format!("{what}.count is 0, or smaller than the number of its sparse values"));
    }
    let most = MOST_MESH_BYTES as usize;
    let check_view = |view: gltf::buffer::View, offset: usize, size: usize| {
        if view.stride().is_some_and(|stride| stride < size || stride > most) {
            return Err(format!("bufferViews[{}].byteStride: its values have {size} bytes", view.index()));
        }
        if [view.offset(), view.length(), offset].iter().any(|&bytes| bytes > most) {
            return Err(format!("bufferViews[{}] of {what} ends after its buffer", view.index()));
        }
        Ok(())
    };
    if let Some(view) = accessor.view() {
        check_view(view, accessor.offset(), accessor.size())?;
    }
    if let Some(sparse) = sparse {
        let (indices, values) = (sparse.indices(), sparse.values());
        check_view(indices.view(), indices.offset(), indices.index_type().size())?;
        check_view(values.view(), values.offset(), accessor.size())?;
    }
    Ok(())
}

fn buffers(path: &Path, document: &gltf::Document, mut blob: Option<Vec<u8>>) -> Result<Vec<Vec<u8>>, DataError> {
    let wrong = |message: String| DataError::file(path, message);
    let mut buffers = Vec::new();
    for buffer in document.buffers() {
        let bytes = match buffer.source() {
            gltf::buffer::Source::Bin => blob.take().ok_or_else(|| wrong("has no binary part".into()))?,
            gltf::buffer::Source::Uri(uri) => match uri.split_once(";base64,") {
                Some((_, text)) => base64::engine::general_purpose::STANDARD
                    .decode(text)
                    .map_err(|e| wrong(format!("has a damaged buffer: {e}")))?,
                None => read_file(&path.parent().unwrap_or(Path::new("")).join(uri), MOST_MESH_BYTES)?,
            },
        };
        if bytes.len() < buffer.length() {
            return Err(wrong(format!("has {} bytes in a buffer of {}", bytes.len(), buffer.length())));
        }
        buffers.push(bytes);
    }
    Ok(buffers)
}

/// What was read.
struct Parts<'a> {
    path: &'a Path,
    buffers: Vec<Vec<u8>>,
    parts: Vec<Part>,
    /// Positions and corners so far.
    vertices: usize,
}

impl Parts<'_> {
    fn add(&mut self, primitive: &gltf::Primitive, root_from_node: &Matrix4<f64>) -> Result<(), DataError> {
        let wrong = |message: String| DataError::file(self.path, message);
        if primitive.mode() != gltf::mesh::Mode::Triangles {
            return Err(wrong("has lines or strips; write it as plain triangles".into()));
        }
        let of_positions = primitive.get(&gltf::Semantic::Positions);
        let of_corners = primitive.indices();
        for accessor in of_positions.iter().chain(&of_corners) {
            self.vertices = self.vertices.saturating_add(accessor.count());
            if self.vertices > MOST_MESH_VERTICES {
                let index = accessor.index();
                return Err(wrong(format!(
                    "accessors[{index}].count = {}: at most {MOST_MESH_VERTICES} vertices and corners are read from a file",
                    accessor.count()
                )));
            }
        }
        if let Some(accessor) = &of_positions {
            check_accessor(accessor, &[DataType::F32], Dimensions::Vec3).map_err(wrong)?;
        }
        if let Some(accessor) = &of_corners {
            let types = [DataType::U8, DataType::U16, DataType::U32];
            check_accessor(accessor, &types, Dimensions::Scalar).map_err(wrong)?;
        }
        let reader = primitive.reader(|buffer| self.buffers.get(buffer.index()).map(Vec::as_slice));
        let positions = reader.read_positions().ok_or_else(|| wrong("has a mesh without positions".into()))?;
        let positions: Vec<[f64; 3]> =
            positions.map(|p| root_from_node.transform_point(&Point3::from(p.map(f64::from))).coords.into()).collect();
        let corners = match reader.read_indices() {
            Some(indices) => indices.into_u32().collect(),
            None => (0..positions.len() as u32).collect(),
        };
        self.parts.push(Part { positions, corners, material: primitive.material().name().map(String::from) });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error_of(text: &str) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("car.gltf");
        std::fs::write(&path, text).unwrap();
        match read_gltf(&path) {
            Ok(parts) => format!("{} parts", parts.len()),
            Err(error) => error.to_string(),
        }
    }

    fn with_nodes(nodes: &str) -> String {
        format!(r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{nodes}]}}"#)
    }

    #[test]
    fn numbers_that_the_library_does_not_check_are_errors() {
        let with = |accessors: &str, views: &str| {
            format!(
                r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
                "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
                "buffers":[{{"byteLength":3,"uri":"data:application/octet-stream;base64,AAAA"}}],
                "bufferViews":[{views}],"accessors":[{accessors}]}}"#
            )
        };
        let positions = r#"{"bufferView":0,"componentType":5126,"count":1,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}"#;
        let corners = |numbers: &str| format!(r#"{positions},{{"bufferView":0,{numbers}}}"#);
        let view = r#"{"buffer":0,"byteLength":3}"#;
        for (text, wanted) in [
            (with("", view), "meshes[0] names accessors[0], which does not exist"),
            (with(&corners(r#""componentType":5126,"count":3,"type":"SCALAR""#), view), "accessors[1] has values F32"),
            (
                with(&corners(r#""componentType":5121,"count":3,"type":"VEC3""#), view),
                "must have [U8, U16, U32] Scalar",
            ),
            (with(&corners(r#""componentType":5121,"count":0,"type":"SCALAR""#), view), "accessors[1].count is 0"),
            (
                with(
                    &corners(r#""componentType":5121,"count":3,"type":"SCALAR""#),
                    r#"{"buffer":0,"byteLength":18446744073709551615,"byteOffset":9}"#,
                ),
                "bufferViews[0] of accessors[0] ends after its buffer",
            ),
            ("glTF\u{2}\0\0\0\u{3}\0\0\0".into(), "a length below 12 bytes"),
            ("glTF\u{2}\0".into(), "cut off"),
        ] {
            let error = error_of(&text);
            assert!(error.contains("car.gltf") && error.contains(wanted), "no {wanted:?} in {error}");
        }
    }

    #[test]
    fn nodes_form_a_tree() {
        let error = error_of(&with_nodes(r#"{"children":[0]}"#));
        assert!(error.contains("car.gltf: nodes[0] is reached twice"), "{error}");
        // Each node has the next one as both of its children: 2 to the power of 60 paths.
        let nodes: Vec<String> =
            (1..60).map(|next| format!(r#"{{"children":[{next},{next}]}}"#)).chain(["{}".into()]).collect();
        let error = error_of(&with_nodes(&nodes.join(",")));
        assert!(error.contains("is reached twice"), "{error}");
        let chain: Vec<String> =
            (1..60).map(|next| format!(r#"{{"children":[{next}]}}"#)).chain(["{}".into()]).collect();
        assert_eq!(error_of(&with_nodes(&chain.join(","))), "0 parts");
    }

    #[test]
    fn counts_are_compared_before_values_are_read() {
        let text = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],
            "meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],
            "buffers":[{"byteLength":12,"uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAA"}],
            "bufferViews":[{"buffer":0,"byteLength":12}],
            "accessors":[{"bufferView":0,"componentType":5126,"count":4000000000,"type":"VEC3","min":[0,0,0],
            "max":[1,1,1]}]}"#;
        let error = error_of(text);
        assert!(error.contains("accessors[0].count = 4000000000: at most 20000000"), "{error}");
    }
}
