//! Points of a scan as pieces of surfaces.

use geometry::Pose;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use sensor::directions::{DirectionIndex, SensorScan, Steps, fit_surface};

/// A point of a scan with the piece of surface that its shot stands for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patch {
    /// Position, map frame, m.
    pub place: [f32; 3],
    /// Unit normal towards the sensor, map frame.
    pub normal: [f32; 3],
    /// Half axes on the surface: half a step of the scan pattern along the row and across it, map frame, m.
    pub axes: [[f32; 3]; 2],
    /// The returns around it lie on one plane.
    pub smooth: bool,
    /// Distance from the sensor, m.
    pub range_m: f32,
    /// Intensity as the recording has it, 0 to 1.
    pub intensity: f32,
    /// Number of the frame among those of the map.
    pub frame: u32,
}

impl Patch {
    /// The patch in another frame.
    pub fn moved(&self, dst_from_src: &Pose) -> Patch {
        let turned = |v: [f32; 3]| (dst_from_src.rotation * Vector3::from(v.map(f64::from))).map(|v| v as f32).into();
        let place = dst_from_src * Point3::from(self.place.map(f64::from));
        Patch {
            place: place.coords.map(|v| v as f32).into(),
            normal: turned(self.normal),
            axes: self.axes.map(turned),
            ..*self
        }
    }

    /// The mirror image in the plane y = 0.
    pub fn mirrored(&self) -> Patch {
        let mirror = |[x, y, z]: [f32; 3]| [x, -y, z];
        Patch { place: mirror(self.place), normal: mirror(self.normal), axes: self.axes.map(mirror), ..*self }
    }

    /// Sum of the squared half axes, m^2.
    pub(super) fn size(&self) -> f32 {
        self.axes.iter().flatten().map(|v| v * v).sum()
    }
}

/// Distance across a plane from which on a return is not on it, m.
const EDGE_M: f64 = 0.12;

/// Longest half axis of a patch, m: surfaces are not flat over more.
const LONGEST_M: f64 = 1.5;

/// Patches of the returns of one scan, in their order, in the frame of the scan.
///
/// `steps` are the angles between neighbouring shots; the surface of a return is looked for within `window`.
pub fn patches(scan: &SensorScan, intensity: &[f32], steps: Steps, window: Steps, frame: u32) -> Vec<Patch> {
    let index = DirectionIndex::new(scan, window, true);
    let width = [f64::from(window.azimuth_rad), f64::from(window.elevation_rad)];
    let patch = |i: usize| {
        let (az, el, range) = (scan.azimuth_rad[i], scan.elevation_rad[i], f64::from(scan.range_m[i]));
        let ((sa, ca), (se, ce)) = (f64::from(az).sin_cos(), f64::from(el).sin_cos());
        let along = Vector3::new(ca * ce, sa * ce, se);
        let side = Vector3::new(-sa, ca, 0.0);
        let up = Vector3::new(-ca * se, -sa * se, ce);
        let surface = fit_surface(&index, width, az, el, |_| true)
            .filter(|s| s.smooth(EDGE_M) && (s.range_m - range).abs() * s.cos_incidence < EDGE_M);
        let (normal, slope) = match &surface {
            Some(s) => {
                let [a, b, c] = s.normal();
                (along * a + side * b + up * c, s.slope_m_per_rad)
            }
            None => (-along, [0.0; 2]),
        };
        let half = |direction: Vector3<f64>, slope: f64, step: f64| {
            let axis = 0.5 * step * (direction * range + along * slope);
            axis * (LONGEST_M / axis.norm()).min(1.0)
        };
        let single = |v: Vector3<f64>| v.map(|v| v as f32).into();
        Patch {
            place: single(along * range),
            normal: single(normal),
            axes: [
                single(half(side, slope[0], f64::from(steps.azimuth_rad) * ce)),
                single(half(up, slope[1], f64::from(steps.elevation_rad))),
            ],
            smooth: surface.is_some(),
            range_m: range as f32,
            intensity: intensity[i],
            frame,
        }
    };
    (0..scan.len()).into_par_iter().with_min_len(1024).map(patch).collect()
}
