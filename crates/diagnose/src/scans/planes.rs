//! Planes of the ground and of walls that are fitted to a scan; everything else is masked.

use super::rings::{RingScan, Shot};
use data::{Object, Stream};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use rand::RngExt;
use sensor::directions::lasers::Beam;

/// A plane n . p = d, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit normal.
    pub normal: Vector3<f64>,
    /// Distance of the plane from the origin along it.
    pub offset_m: f64,
}

/// A shot on a plane.
#[derive(Clone, Copy, Debug)]
pub struct OnPlane {
    /// Number of its laser.
    pub beam: usize,
    /// Its place in the ring.
    pub at: usize,
    /// The shot.
    pub shot: Shot,
}

/// A flat piece of the scene.
#[derive(Clone, Debug)]
pub struct Patch {
    /// Plane fitted to its points.
    pub plane: Plane,
    /// Its points.
    pub shots: Vec<OnPlane>,
}

/// Width of the sectors in which walls are searched for, rad: 6 degrees.
const SECTOR_RAD: f64 = 0.105;

/// Ranges of walls, m.
const WALL_RANGE_M: [f64; 2] = [3.0, 45.0];

/// Smallest height of a point of a wall above the ground, m.
const WALL_ABOVE_M: f64 = 0.4;

/// Fewest lasers on a wall.
const WALL_BEAMS: usize = 8;

/// Fewest points of a wall.
const WALL_POINTS: usize = 80;

/// Largest distance of a point from the plane of its wall, m.
const OFF_WALL_M: f64 = 0.09;

/// Largest median distance of the points of a flat wall, m.
const FLAT_M: f64 = 0.022;

/// Largest distance of a point of a wall, in medians.
const MEDIANS: f64 = 5.0;

/// Smallest height of a wall, m.
const WALL_HEIGHT_M: f64 = 1.2;

/// Largest range of the ground, m.
const GROUND_RANGE_M: f64 = 30.0;

/// Largest distance of a point of the ground from its plane, m.
const OFF_GROUND_M: f64 = 0.12;

impl Plane {
    /// Range at which a ray hits it, and the cosine of incidence; `None` where it does not.
    pub fn meets(&self, beam: &Beam, azimuth_rad: f64) -> Option<[f64; 2]> {
        let along = self.normal.dot(&beam.direction(azimuth_rad));
        let range = (self.offset_m - self.normal.dot(&beam.origin())) / along;
        (along.abs() > 1e-3 && range > 0.0).then_some([range, along.abs()])
    }

    /// Distance of a point from it, m.
    pub fn off(&self, p: &Vector3<f64>) -> f64 {
        self.normal.dot(p) - self.offset_m
    }

    /// The plane of least squares.
    pub fn through(points: &[Vector3<f64>]) -> Option<Plane> {
        if points.len() < 3 {
            return None;
        }
        let middle = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
        let spread: Matrix3<f64> = points.iter().map(|p| (p - middle) * (p - middle).transpose()).sum();
        let eigen = SymmetricEigen::new(spread);
        let least = eigen.eigenvalues.imin();
        let normal: Vector3<f64> = eigen.eigenvectors.column(least).into_owned();
        normal.x.is_finite().then(|| Plane { normal, offset_m: normal.dot(&middle) })
    }

    fn of_three(p: [&Vector3<f64>; 3]) -> Option<Plane> {
        let normal = (p[1] - p[0]).cross(&(p[2] - p[0])).try_normalize(1e-6)?;
        Some(Plane { normal, offset_m: normal.dot(p[0]) })
    }
}

/// The plane through three points with the most points within `off_m` (RANSAC), of those that `allowed` accepts.
fn consensus(
    points: &[Vector3<f64>],
    off_m: f64,
    tries: usize,
    rng: &mut Stream,
    allowed: impl Fn(&Plane) -> bool,
) -> Option<Plane> {
    let stride = (points.len() / 500).max(1);
    let mut best = (0, None);
    for _ in 0..tries {
        let mut draw = || &points[rng.random_range(0..points.len())];
        let Some(plane) = Plane::of_three([draw(), draw(), draw()]).filter(&allowed) else { continue };
        let n = points.iter().step_by(stride).filter(|p| plane.off(p).abs() < off_m).count();
        if n > best.0 {
            best = (n, Some(plane));
        }
    }
    best.1
}

/// The ground around the vehicle with its points; `None` where none is found.
pub fn ground(scan: &RingScan, beams: &[Beam], boxes: &[Object], rng: &mut Stream) -> Option<Patch> {
    let all = shots(scan, beams, boxes, |shot, p| p.z < -0.8 && shot.range_m < GROUND_RANGE_M);
    let points: Vec<Vector3<f64>> = all.iter().map(|s| s.1).collect();
    if points.len() < 500 {
        return None;
    }
    let level = |p: &Plane| p.normal.z.abs() > 0.985;
    let mut plane = consensus(&points, 0.06, 150, rng, level)?;
    for off in [0.15, OFF_GROUND_M, OFF_GROUND_M] {
        plane = Plane::through(&points.iter().filter(|p| plane.off(p).abs() < off).copied().collect::<Vec<_>>())?;
    }
    if plane.normal.z < 0.0 {
        plane = Plane { normal: -plane.normal, offset_m: -plane.offset_m };
    }
    let shots = all.into_iter().filter(|(_, p)| plane.off(p).abs() < OFF_GROUND_M).map(|(s, _)| s).collect();
    level(&plane).then_some(Patch { plane, shots })
}

/// Flat walls, at most two in each sector.
pub fn walls(scan: &RingScan, beams: &[Beam], boxes: &[Object], ground: &Plane, rng: &mut Stream) -> Vec<Patch> {
    let near = WALL_RANGE_M[0]..WALL_RANGE_M[1];
    let all = shots(scan, beams, boxes, |shot, p| near.contains(&shot.range_m) && ground.off(p) > WALL_ABOVE_M);
    let sectors = (std::f64::consts::TAU / SECTOR_RAD) as usize + 1;
    let mut by_sector: Vec<Vec<(OnPlane, Vector3<f64>)>> = vec![Vec::new(); sectors];
    for s in all {
        by_sector[((s.0.shot.azimuth_rad + std::f64::consts::PI) / SECTOR_RAD) as usize % sectors].push(s);
    }
    let mut found = Vec::new();
    for mut left in by_sector {
        for _ in 0..2 {
            let Some((patch, rest)) = wall(left, ground, rng) else { break };
            found.extend(patch);
            left = rest;
        }
    }
    found
}

type Points = Vec<(OnPlane, Vector3<f64>)>;

/// The largest wall of a sector if it is flat, and the other points.
fn wall(all: Points, ground: &Plane, rng: &mut Stream) -> Option<(Option<Patch>, Points)> {
    if all.len() < WALL_POINTS {
        return None;
    }
    let points: Vec<Vector3<f64>> = all.iter().map(|s| s.1).collect();
    let upright = |p: &Plane| p.normal.dot(&ground.normal).abs() < 0.12;
    let mut plane = consensus(&points, 0.05, 80, rng, upright)?;
    for _ in 0..3 {
        let on: Vec<Vector3<f64>> = points.iter().filter(|p| plane.off(p).abs() < OFF_WALL_M).copied().collect();
        plane = Plane::through(&on)?;
    }
    let (mut on, rest): (Points, Points) = all.into_iter().partition(|s| plane.off(&s.1).abs() < OFF_WALL_M);
    let mut beams: Vec<usize> = on.iter().map(|s| s.0.beam).collect();
    beams.sort_unstable();
    beams.dedup();
    let median = statistics::median_upper(on.iter().map(|s| plane.off(&s.1).abs()).collect::<Vec<f64>>())?;
    on.retain(|s| plane.off(&s.1).abs() < MEDIANS * median);
    let heights = on.iter().map(|s| ground.off(&s.1)).fold([f64::MAX, f64::MIN], |[l, h], v| [l.min(v), h.max(v)]);
    let good = on.len() >= WALL_POINTS
        && beams.len() >= WALL_BEAMS
        && median < FLAT_M
        && heights[1] - heights[0] > WALL_HEIGHT_M
        && upright(&plane);
    let patch = good.then(|| Patch { plane, shots: on.iter().map(|s| s.0).collect() });
    Some((patch, rest))
}

/// Shots outside of all boxes that `keep` accepts, with their points.
fn shots(
    scan: &RingScan,
    beams: &[Beam],
    boxes: &[Object],
    keep: impl Fn(&Shot, &Vector3<f64>) -> bool,
) -> Vec<(OnPlane, Vector3<f64>)> {
    let in_a_box = |p: &Vector3<f64>| {
        boxes.iter().any(|o| {
            let local = o.bbox.to_local((*p).into());
            (0..3).all(|k| local[k].abs() < o.bbox.size[k] / 2.0 + 0.2)
        })
    };
    let mut out = Vec::new();
    for (beam, ring) in scan.rings.iter().enumerate() {
        for (at, shot) in ring.iter().enumerate() {
            let p = beams[beam].point(shot.azimuth_rad, shot.range_m);
            if keep(shot, &p) && !in_a_box(&p) {
                out.push((OnPlane { beam, at, shot: *shot }, p));
            }
        }
    }
    out
}
