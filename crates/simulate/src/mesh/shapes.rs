//! Basic mesh shapes. All except [`grid`] are closed.

use super::{Face, Mesh};
use sensor::material::MaterialId;

/// Joins rows of points to a surface, two triangles per cell. `points[row][column]`, m.
pub fn grid(points: &[Vec<[f64; 3]>], material: MaterialId) -> Mesh {
    let columns = points.first().map_or(0, Vec::len);
    let mut mesh = Mesh { vertices: points.iter().flatten().copied().collect(), faces: Vec::new() };
    for row in 1..points.len() {
        for column in 1..columns {
            let d = (row * columns + column) as u32;
            let (a, b, c) = (d - columns as u32 - 1, d - columns as u32, d - 1);
            mesh.faces.extend([[a, b, c], [b, d, c]].map(|corners| Face { corners, material, object: 0 }));
        }
    }
    mesh
}

/// Joins rings with equal numbers of points to a tube, closed at both ends by a fan. m.
pub fn loft(rings: &[Vec<[f64; 3]>], material: MaterialId) -> Mesh {
    let n = rings.first().map_or(0, Vec::len) as u32;
    let mut mesh = Mesh { vertices: rings.iter().flatten().copied().collect(), faces: Vec::new() };
    let mut push = |corners| mesh.faces.push(Face { corners, material, object: 0 });
    for ring in 1..rings.len() as u32 {
        for i in 0..n {
            let (a, b) = ((ring - 1) * n + i, (ring - 1) * n + (i + 1) % n);
            push([a, b, a + n]);
            push([b, b + n, a + n]);
        }
    }
    let last = (rings.len() as u32).saturating_sub(1) * n;
    for i in 1..n.saturating_sub(1) {
        push([0, i + 1, i]);
        push([last, last + i, last + i + 1]);
    }
    mesh
}

/// A box given by two corners, m.
pub fn cuboid(low: [f64; 3], high: [f64; 3], material: MaterialId) -> Mesh {
    let ring = |x: f64| vec![[x, low[1], low[2]], [x, high[1], low[2]], [x, high[1], high[2]], [x, low[1], high[2]]];
    loft(&[ring(low[0]), ring(high[0])], material)
}

/// A cylinder with `sides` sides from `from` to `to`, m.
pub fn cylinder(from: [f64; 3], to: [f64; 3], radius_m: f64, sides: usize, material: MaterialId) -> Mesh {
    let axis = nalgebra::Vector3::from(to) - nalgebra::Vector3::from(from);
    let across = if axis.z.abs() < 0.9 * axis.norm() { nalgebra::Vector3::z() } else { nalgebra::Vector3::x() };
    let u = axis.cross(&across).normalize();
    let v = axis.cross(&u).normalize();
    let ring = |centre: [f64; 3]| {
        let point = |i: usize| {
            let (s, c) = (std::f64::consts::TAU * i as f64 / sides as f64).sin_cos();
            std::array::from_fn(|k| centre[k] + radius_m * (c * u[k] + s * v[k]))
        };
        (0..sides).map(point).collect()
    };
    loft(&[ring(from), ring(to)], material)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ANY: MaterialId = MaterialId(0);

    #[test]
    fn bodies_are_closed_and_as_large_as_said() {
        let cube = cuboid([-1.0, -2.0, 0.0], [1.0, 2.0, 3.0], ANY);
        assert_eq!((cube.faces.len(), cube.open_edges()), (12, 0));
        assert_eq!(cube.bounds().unwrap(), [[-1.0, -2.0, 0.0], [1.0, 2.0, 3.0]]);
        let rod = cylinder([0.0; 3], [0.0, 0.0, 2.0], 0.5, 16, ANY);
        assert_eq!((rod.faces.len(), rod.open_edges()), (16 * 2 + 14 * 2, 0));
        let [low, high] = rod.bounds().unwrap();
        assert!((high[2] - low[2] - 2.0).abs() < 1e-12 && (high[0] - low[0] - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_sheet_is_open() {
        let points: Vec<Vec<[f64; 3]>> =
            (0..3).map(|i| (0..4).map(|j| [f64::from(i), f64::from(j), 0.0]).collect()).collect();
        let sheet = grid(&points, ANY);
        assert_eq!((sheet.faces.len(), sheet.open_edges()), (12, 10));
        assert!(sheet.check().is_ok());
        assert!(Mesh::default().check().unwrap_err().contains("no triangle"));
    }
}
