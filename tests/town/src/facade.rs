//! Houses: upright boxes whose faces have recessed windows, and may be wavy.

use crate::solid::{Block, Material, Ray};
use nalgebra::Vector3;
use std::f64::consts::TAU;

/// A regular lattice of windows on the faces of a house.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Windows {
    /// Distance of neighbouring windows, along the face and vertical, m.
    pub pitch_m: [f64; 2],
    /// Width and height of a window, m.
    pub size_m: [f64; 2],
    /// Height of the lowest sill above the foot of the house, m.
    pub sill_m: f64,
    /// Depth of the glass behind the face, m.
    pub inset_m: f64,
}

/// A wave of the faces: amplitude and wavelength along the face, m; phase, rad.
pub type Wave = [f64; 3];

/// A house.
#[derive(Clone, Debug, PartialEq)]
pub struct House {
    /// Its body.
    pub block: Block,
    /// Its windows, if any.
    pub windows: Option<Windows>,
    /// Its wave, if any.
    pub wave: Option<Wave>,
    /// Reflectivity of the wall.
    pub reflectivity: f64,
}

/// Smallest sine of the angle between a ray and a face for which a wave is applied.
const LEAST_SINE: f64 = 0.08;

impl House {
    /// Entry of a ray: distance, outward normal and material.
    pub fn enter(&self, ray: &Ray) -> Option<(f64, Vector3<f64>, Material)> {
        let local = self.block.to_local(ray);
        let (mut t, axis) = self.block.enter_local(&local)?;
        let mut normal = Vector3::zeros();
        normal[axis] = -local.direction[axis].signum();
        let mut material = Material::Plaster;
        if axis < 2 {
            let along = 1 - axis;
            let straight = t;
            if let Some(windows) = &self.windows
                && let Some((deeper, side, glass)) = windows.enter(&self.block, &local, t, axis)
            {
                t += deeper;
                if let Some((k, sign)) = side {
                    normal = Vector3::zeros();
                    normal[k] = sign;
                }
                if glass {
                    material = Material::Glass;
                }
            }
            let rate = local.direction[axis].abs();
            if let Some([amplitude_m, length_m, phase]) = self.wave
                && rate / local.direction.norm() > LEAST_SINE
            {
                let out = |t: f64| amplitude_m * (TAU * local.at(t)[along] / length_m + phase).sin();
                t -= out(straight - out(straight) / rate) / rate;
            }
        }
        Some((t, self.block.to_outer(normal), material))
    }
}

/// How much farther a ray goes in a window, the axis and sign of the normal of the reveal that it meets, and whether it
/// meets the glass.
type Inside = (f64, Option<(usize, f64)>, bool);

impl Windows {
    /// What a ray meets that arrives at the face `axis` of a house after `t`; `None` beside the windows.
    fn enter(&self, block: &Block, local: &Ray, t: f64, axis: usize) -> Option<Inside> {
        let along = 1 - axis;
        let p = local.at(t);
        let (u, z) = (p[along], p.z + block.half.z - self.sill_m);
        let [pitch_u, pitch_z] = self.pitch_m;
        let [half_u, half_z] = self.size_m.map(|v| v / 2.0);
        let center_u = (u / pitch_u).round() * pitch_u;
        let floor = (z / pitch_z).floor();
        let center_z = floor * pitch_z + half_z;
        let top = self.sill_m + center_z + half_z;
        let fits = center_u.abs() + half_u < block.half[along] - 0.2 && floor >= 0.0 && top < 2.0 * block.half.z - 0.2;
        let (a, b) = (u - center_u, z - center_z);
        if !fits || a.abs() > half_u || b.abs() > half_z {
            return None;
        }
        let until = |at: f64, rate: f64, half: f64| (rate.signum() * half - at) / rate;
        let (du, dz) = (local.direction[along], local.direction.z);
        let glass = self.inset_m / local.direction[axis].abs();
        let side = if du.abs() > 1e-12 { until(a, du, half_u) } else { f64::INFINITY };
        let lintel = if dz.abs() > 1e-12 { until(b, dz, half_z) } else { f64::INFINITY };
        Some(if glass <= side.min(lintel) {
            (glass, None, true)
        } else if side < lintel {
            (side, Some((along, -du.signum())), false)
        } else {
            (lintel, Some((2, -dz.signum())), false)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    fn house() -> House {
        House {
            block: Block::new([10.0, 0.0, 5.0], [4.0, 20.0, 10.0], 0.0),
            windows: Some(Windows { pitch_m: [3.0, 3.0], size_m: [1.0, 1.5], sill_m: 1.0, inset_m: 0.2 }),
            wave: None,
            reflectivity: 0.5,
        }
    }

    fn meet(house: &House, from: [f64; 3], direction: [f64; 3]) -> (f64, Vector3<f64>, Material) {
        house.enter(&Ray { origin: Point3::from(from), direction: Vector3::from(direction).normalize() }).unwrap()
    }

    #[test]
    fn windows_are_recessed_and_have_reveals() {
        let house = house();
        let (t, normal, material) = meet(&house, [0.0, 0.0, 1.7], [1.0, 0.0, 0.0]);
        assert!((t - 8.2).abs() < 1e-9 && material == Material::Glass && normal.x == -1.0);
        let (t, _, material) = meet(&house, [0.0, 1.2, 1.7], [1.0, 0.0, 0.0]);
        assert!((t - 8.0).abs() < 1e-9 && material == Material::Plaster);
        let (t, normal, material) = meet(&house, [0.0, -7.55, 1.7], [1.0, 1.0, 0.0]);
        assert!(t > 8.0 * 2f64.sqrt() && material == Material::Plaster && normal.y == -1.0, "{t} {normal}");
        let (t, normal, _) = meet(&house, [0.0, 0.0, -5.5], [1.0, 0.0, 1.0]);
        assert!((t - 8.0 * 2f64.sqrt()).abs() < 0.2 * 2f64.sqrt() && (normal.x == -1.0 || normal.z == -1.0));
    }

    #[test]
    fn waves_move_the_face_along_its_normal() {
        let wavy = House { windows: None, wave: Some([0.05, 8.0, 0.0]), ..house() };
        let (t, ..) = meet(&wavy, [0.0, 2.0, 3.0], [1.0, 0.0, 0.0]);
        assert!((t - 7.95).abs() < 1e-9, "{t}");
        let (t, ..) = meet(&wavy, [0.0, -2.0, 3.0], [1.0, 0.0, 0.0]);
        assert!((t - 8.05).abs() < 1e-9, "{t}");
    }
}
