//! The map as a PLY file, which MeshLab, CloudCompare and Open3D show.

use super::SurfelMap;

/// Encodes the surfels as a binary little-endian PLY: a vertex each, with its position (m), normal, intensity (0 to 1),
/// opacity (0 to 1), radius (the geometric mean of its half axes, m), and its numbers of returns and frames.
pub fn encode_ply(map: &SurfelMap) -> Vec<u8> {
    let properties =
        ["x", "y", "z", "nx", "ny", "nz", "intensity", "opacity", "radius"].map(|p| format!("property float {p}\n"));
    let header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment surfels of a lidarshift twin; m\nelement vertex {}\n{}property uint returns\nproperty uint frames\nend_header\n",
        map.surfels().len(),
        properties.concat()
    );
    let mut bytes = header.into_bytes();
    for (i, s) in map.surfels().iter().enumerate() {
        let length = |a: [f32; 3]| a.iter().map(|v| v * v).sum::<f32>().sqrt();
        let radius = (length(s.axes[0]) * length(s.axes[1])).sqrt();
        for v in s.place.iter().chain(&s.normal).chain(&[s.intensity, map.opacity(i), radius]) {
            bytes.extend(v.to_le_bytes());
        }
        bytes.extend(s.returns.to_le_bytes());
        bytes.extend(s.frames.to_le_bytes());
    }
    bytes
}
