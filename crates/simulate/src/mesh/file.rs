//! Meshes from OBJ, STL and glTF files.

use super::gltf_file::read_gltf;
use super::{Face, Mesh};
use data::DataError;
use data::limits::read_file;
use schemars::JsonSchema;
use sensor::material::{MaterialId, MaterialTable};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// A mesh file and its import settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MeshFile {
    /// `.obj`, `.stl`, `.gltf` or `.glb`, relative to the file that contains this path.
    pub file: PathBuf,
    /// Metres per file unit.
    #[serde(default = "one")]
    pub scale: f64,
    /// Up axis of the file.
    #[serde(default)]
    pub up: UpAxis,
    /// Maps material names of the file to ours. Default: the same name.
    #[serde(default)]
    pub materials: BTreeMap<String, String>,
    /// Our material for faces without one.
    #[serde(default = "unknown")]
    pub default_material: String,
    /// Accept a mesh that is not closed.
    #[serde(default)]
    pub allow_open: bool,
}

fn one() -> f64 {
    1.0
}

fn unknown() -> String {
    "unknown".into()
}

/// Up axis of a mesh file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum UpAxis {
    /// x forward, y left, z up, as in this program.
    #[default]
    Z,
    /// glTF's convention: y up, z forward, x left.
    Y,
}

/// A mesh of the file with its material names.
pub(super) struct Part {
    pub(super) positions: Vec<[f64; 3]>,
    pub(super) corners: Vec<u32>,
    pub(super) material: Option<String>,
}

impl MeshFile {
    /// Reads the mesh; the path is relative to `folder`.
    pub fn read(&self, folder: &Path, table: &MaterialTable) -> Result<Mesh, DataError> {
        let path = folder.join(&self.file);
        let wrong = |message: String| DataError::file(&path, message);
        let ending = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        let parts = match ending.as_deref() {
            Some("obj") => read_obj(&path)?,
            Some("stl") => read_stl(&path)?,
            Some("gltf" | "glb") => read_gltf(&path)?,
            _ => {
                return Err(wrong(
                    "is not a supported mesh file: its name must end in .obj, .stl, .gltf or .glb".into(),
                ));
            }
        };
        if !(self.scale.is_finite() && self.scale > 0.0) {
            return Err(wrong(format!("scale = {} is not a positive finite number", self.scale)));
        }
        let mut mesh = Mesh::default();
        for part in parts {
            let material = self.material(part.material.as_deref(), table).map_err(wrong)?;
            if part.corners.len() % 3 != 0 || part.corners.iter().any(|c| *c as usize >= part.positions.len()) {
                return Err(wrong("has triangles whose corners do not exist".into()));
            }
            let face = |c: &[u32]| Face { corners: [c[0], c[1], c[2]], material, object: 0 };
            let turned = part.positions.iter().map(|[x, y, z]| match self.up {
                UpAxis::Z => [*x, *y, *z],
                UpAxis::Y => [*z, *x, *y],
            });
            mesh.append(&Mesh {
                vertices: turned.map(|v| v.map(|c| c * self.scale)).collect(),
                faces: part.corners.chunks_exact(3).map(face).collect(),
            });
        }
        mesh.check().map_err(wrong)?;
        let open = mesh.open_edges();
        if open > 0 && !self.allow_open {
            return Err(wrong(format!(
                "is open: {open} edges belong to one triangle only, so that rays pass through it; close it, or set allow_open = true"
            )));
        }
        Ok(mesh)
    }

    fn material(&self, of_file: Option<&str>, table: &MaterialTable) -> Result<MaterialId, String> {
        let name = match of_file {
            Some(name) => self.materials.get(name).map_or(name, String::as_str),
            None => &self.default_material,
        };
        table.find(name).ok_or_else(|| {
            let known = table.names().join(", ");
            format!("its material {name:?} is not known; name one of ours for it under `materials` ({known})")
        })
    }
}

/// Bytes of a mesh file or of one of its buffers.
pub const MOST_MESH_BYTES: u64 = 1 << 30;

/// Vertices or corners of a mesh, counted as often as they are placed.
pub const MOST_MESH_VERTICES: usize = 20_000_000;

fn read_obj(path: &Path) -> Result<Vec<Part>, DataError> {
    let bytes = read_file(path, MOST_MESH_BYTES)?;
    let failed = |e: tobj::LoadError| DataError::file(path, format!("is not a valid OBJ file: {e}"));
    let options = tobj::LoadOptions { triangulate: true, single_index: true, ..tobj::LoadOptions::default() };
    let folder = path.parent().unwrap_or(Path::new(""));
    let library = |name: &Path| match read_file(&folder.join(name), MOST_MESH_BYTES) {
        Ok(bytes) => tobj::load_mtl_buf(&mut bytes.as_slice()),
        Err(_) => Err(tobj::LoadError::OpenFileFailed),
    };
    let (models, materials) = tobj::load_obj_buf(&mut bytes.as_slice(), &options, library).map_err(failed)?;
    let materials = materials.unwrap_or_default(); // a file without its material library still has triangles
    let part = |model: tobj::Model| Part {
        positions: model.mesh.positions.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect(),
        corners: model.mesh.indices,
        material: model.mesh.material_id.and_then(|i| materials.get(i)).map(|m| m.name.clone()),
    };
    Ok(models.into_iter().map(part).collect())
}

fn read_stl(path: &Path) -> Result<Vec<Part>, DataError> {
    let bytes = read_file(path, MOST_MESH_BYTES)?;
    let failed = |e: &dyn std::fmt::Display| DataError::file(path, format!("is not a valid STL file: {e}"));
    if !bytes.starts_with(b"solid")
        && let Some(count) = bytes.get(80..).and_then(|rest| rest.first_chunk::<4>()).map(|n| u32::from_le_bytes(*n))
        && bytes.len() as u64 != 84 + 50 * u64::from(count)
    {
        return Err(failed(&format!(
            "it has {} bytes, but its header says {count} triangles of 50 bytes",
            bytes.len()
        )));
    }
    let mesh = stl_io::read_stl(&mut Cursor::new(bytes)).map_err(|e| failed(&e))?;
    let positions = mesh.vertices.iter().map(|v| [v[0], v[1], v[2]].map(f64::from)).collect();
    let corners = mesh.faces.iter().flat_map(|face| face.vertices.map(|v| v as u32)).collect();
    Ok(vec![Part { positions, corners, material: None }])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::cuboid;
    use base64::Engine as _;

    fn mesh_file(name: &str) -> MeshFile {
        toml::from_str(&format!("file = {name:?}")).unwrap()
    }

    fn obj_text(closed: bool) -> String {
        let cube = cuboid([0.0; 3], [2.0, 1.0, 1.0], MaterialId(0));
        let mut text = String::from("mtllib car.mtl\nusemtl skin\n");
        for [x, y, z] in &cube.vertices {
            text += &format!("v {x} {y} {z}\n");
        }
        for face in cube.faces.iter().skip(usize::from(!closed)) {
            let [a, b, c] = face.corners.map(|c| c + 1);
            text += &format!("f {a} {b} {c}\n");
        }
        text
    }

    #[test]
    fn an_obj_with_materials() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("car.obj"), obj_text(true)).unwrap();
        std::fs::write(folder.path().join("car.mtl"), "newmtl skin\nKd 1 0 0\n").unwrap();
        let table = MaterialTable::default();
        let mut file = mesh_file("car.obj");
        let error = file.read(folder.path(), &table).unwrap_err().to_string();
        assert!(error.contains("car.obj: its material \"skin\" is not known"), "{error}");
        file.materials.insert("skin".into(), "paint".into());
        file.scale = 0.5;
        file.up = UpAxis::Y;
        let mesh = file.read(folder.path(), &table).unwrap();
        assert_eq!(mesh.bounds().unwrap(), [[0.0; 3], [0.5, 1.0, 0.5]]);
        assert!(mesh.faces.iter().all(|f| f.material == MaterialTable::built_in("paint")) && mesh.faces.len() == 12);

        std::fs::write(folder.path().join("car.obj"), obj_text(false)).unwrap();
        let error = file.read(folder.path(), &table).unwrap_err().to_string();
        assert!(error.contains("is open: 3 edges"), "{error}");
        file.allow_open = true;
        assert_eq!(file.read(folder.path(), &table).unwrap().faces.len(), 11);
    }

    #[test]
    fn an_stl_in_both_forms() {
        let cube = cuboid([0.0; 3], [2.0, 1.0, 1.0], MaterialId(0));
        let triangle = |face: &Face| stl_io::Triangle {
            normal: stl_io::Normal::new([0.0; 3]),
            vertices: face.corners.map(|c| stl_io::Vertex::new(cube.vertices[c as usize].map(|v| v as f32))),
        };
        let triangles: Vec<_> = cube.faces.iter().map(triangle).collect();
        let folder = tempfile::tempdir().unwrap();
        let mut binary = Vec::new();
        stl_io::write_stl(&mut binary, triangles.iter()).unwrap();
        let mut text = String::from("solid cube\n");
        for t in &triangles {
            text += "facet normal 0 0 0\nouter loop\n";
            for v in t.vertices {
                text += &format!("vertex {} {} {}\n", v[0], v[1], v[2]);
            }
            text += "endloop\nendfacet\n";
        }
        text += "endsolid cube\n";
        for bytes in [binary, text.into_bytes()] {
            std::fs::write(folder.path().join("a.stl"), bytes).unwrap();
            let mesh = mesh_file("a.stl").read(folder.path(), &MaterialTable::default()).unwrap();
            assert_eq!((mesh.faces.len(), mesh.open_edges()), (12, 0));
            assert_eq!(mesh.bounds().unwrap(), [[0.0; 3], [2.0, 1.0, 1.0]]);
        }
    }

    #[test]
    fn a_gltf_with_a_moved_node() {
        let positions: [f32; 12] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let indices: [u16; 12] = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2];
        let bytes: Vec<u8> = positions
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .chain(indices.iter().flat_map(|v| v.to_le_bytes()))
            .collect();
        let buffer = base64::engine::general_purpose::STANDARD.encode(&bytes);
        let json = serde_json::json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }],
            "nodes": [{ "mesh": 0, "translation": [10.0, 0.0, 0.0] }],
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1, "material": 0 }] }],
            "materials": [{ "name": "rubber" }],
            "buffers": [{ "byteLength": bytes.len(), "uri": format!("data:application/octet-stream;base64,{buffer}") }],
            "bufferViews": [{ "buffer": 0, "byteOffset": 0, "byteLength": 48 }, { "buffer": 0, "byteOffset": 48, "byteLength": 24 }],
            "accessors": [
                { "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1] },
                { "bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR" }
            ]
        });
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.gltf"), json.to_string()).unwrap();
        let mesh = mesh_file("a.gltf").read(folder.path(), &MaterialTable::default()).unwrap();
        assert_eq!(mesh.bounds().unwrap(), [[10.0, 0.0, 0.0], [11.0, 1.0, 1.0]]);
        assert!(mesh.faces.iter().all(|f| f.material == MaterialTable::built_in("rubber")));
    }

    #[test]
    fn what_is_no_mesh_is_named() {
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in [
            ("a.obj", &b"f 1 2 3\n"[..]),
            ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            ("a.obj", b"# nothing\n"),
            ("a.stl", b"no stl"),
            ("a.gltf", b"{}"),
            ("a.glb", b"glTF"),
            ("a.ply", b""),
        ] {
            std::fs::write(folder.path().join(name), bytes).unwrap();
            let error = mesh_file(name).read(folder.path(), &MaterialTable::default()).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
        let error = mesh_file("none.obj").read(folder.path(), &MaterialTable::default()).unwrap_err().to_string();
        assert!(error.contains("none.obj"), "{error}");
    }
}
