//! How the own car moves from frame to frame, from posts, ends of walls and other edges of the simulated side that stand still.

use crate::inference::median;
use crate::pairing::{FramePair, Surface};
use nalgebra::{Point3, Vector2};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Motion of the own car between two frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnMotion {
    /// Along its heading, m/s.
    pub speed_m_s: f64,
    /// Counter-clockwise, rad/s.
    pub yaw_rate_rad_s: f64,
}

/// Side of a cell of a frame seen from above, m.
pub const CELL_M: f64 = 0.35;

/// Fastest that is looked for, m/s.
const FASTEST_M_S: f64 = 95.0;

/// Fewer edges than that say nothing.
const FEWEST: usize = 40;

/// The motion at each frame; `None` where the scene does not tell.
pub fn own_motion(frames: &[FramePair], times: &[f64], origins: &[Point3<f64>]) -> Vec<Option<OwnMotion>> {
    let edges: Vec<Vec<Vector2<f64>>> = frames.par_iter().map(|f| edges(f, origins)).collect();
    let steps: Vec<Option<OwnMotion>> = (0..frames.len().saturating_sub(1))
        .into_par_iter()
        .map(|i| between(&edges[i], &edges[i + 1], times[i + 1] - times[i]))
        .collect();
    let raw: Vec<Option<OwnMotion>> = (0..frames.len())
        .map(|i| {
            let before = i.checked_sub(1).and_then(|j| steps[j]);
            let after = steps.get(i).copied().flatten();
            match (before, after) {
                (Some(a), Some(b)) => Some(OwnMotion {
                    speed_m_s: 0.5 * (a.speed_m_s + b.speed_m_s),
                    yaw_rate_rad_s: 0.5 * (a.yaw_rate_rad_s + b.yaw_rate_rad_s),
                }),
                (one, None) | (None, one) => one,
            }
        })
        .collect();
    smooth(&raw, times)
}

/// Fewer frames with a motion than this share: nothing is known.
const KNOWN: f64 = 0.4;

/// Speeds change slowly: the median of the motions within a second, where there are enough.
fn smooth(raw: &[Option<OwnMotion>], times: &[f64]) -> Vec<Option<OwnMotion>> {
    let known = raw.iter().flatten().count();
    if (known as f64) < KNOWN * raw.len() as f64 || known < 3 {
        return vec![None; raw.len()];
    }
    (0..raw.len())
        .map(|i| {
            let near: Vec<OwnMotion> =
                (0..raw.len()).filter(|&j| (times[j] - times[i]).abs() < 0.8).filter_map(|j| raw[j]).collect();
            (near.len() >= 2).then(|| OwnMotion {
                speed_m_s: median(near.iter().map(|m| m.speed_m_s).collect()),
                yaw_rate_rad_s: median(near.iter().map(|m| m.yaw_rate_rad_s).collect()),
            })
        })
        .collect()
}

/// Places of edges that stand: not of the ground, not of objects, not of smooth walls.
fn edges(frame: &FramePair, origins: &[Point3<f64>]) -> Vec<Vector2<f64>> {
    let mut cells = BTreeSet::new();
    let mut points = Vec::new();
    for ray in &frame.simulated {
        if ray.smooth || ray.surface != Surface::Standing || ray.own_range_m() > 70.0 {
            continue;
        }
        let p = origins[ray.sensor as usize] + ray.direction_vector() * ray.own_range_m();
        let near_object = frame.objects.iter().filter_map(|o| o.simulated).any(|b| {
            let local = b.to_local(p.into());
            local[0].abs() < b.size[0] / 2.0 + 1.0 && local[1].abs() < b.size[1] / 2.0 + 1.0
        });
        if !near_object && cells.insert(cell(&p.xy().coords)) {
            points.push(p.xy().coords);
        }
    }
    points
}

fn cell(p: &Vector2<f64>) -> (i32, i32) {
    ((p.x / CELL_M).floor() as i32, (p.y / CELL_M).floor() as i32)
}

/// A square about the own car in cells, seen from above.
pub struct Cells {
    taken: Vec<bool>,
}

impl Cells {
    /// Cells of a side; edges lie within 70 m, and what is moved farther away lies beyond.
    const SIDE: i32 = 432;

    /// Those with a point.
    pub fn new<'a>(points: impl IntoIterator<Item = &'a Vector2<f64>>) -> Self {
        let mut taken = vec![false; (Self::SIDE * Self::SIDE) as usize];
        points.into_iter().filter_map(Self::place).for_each(|i| taken[i] = true);
        Cells { taken }
    }

    fn place(p: &Vector2<f64>) -> Option<usize> {
        let (x, y) = cell(p);
        let [x, y] = [x, y].map(|v| v + Self::SIDE / 2);
        ((0..Self::SIDE).contains(&x) && (0..Self::SIDE).contains(&y)).then_some((x * Self::SIDE + y) as usize)
    }

    /// Whether a point lies in one of them.
    pub fn contains(&self, p: &Vector2<f64>) -> bool {
        Self::place(p).is_some_and(|i| self.taken[i])
    }
}

/// The motion under which most edges of the first frame come to lie on edges of the second.
fn between(first: &[Vector2<f64>], second: &[Vector2<f64>], dt: f64) -> Option<OwnMotion> {
    if first.len() < FEWEST || second.len() < FEWEST || dt <= 0.0 || dt > 0.6 {
        return None;
    }
    let taken = Cells::new(second);
    let stride = (first.len() / 400).max(1);
    let some: Vec<Vector2<f64>> = first.iter().step_by(stride).copied().collect();
    let hits = |d: f64, yaw: f64| {
        let (s, c) = yaw.sin_cos();
        // The car moves along its mean heading.
        let (ms, mc) = (0.5 * yaw).sin_cos();
        let count = some.iter().filter(|p| {
            let q = Vector2::new(p.x - d * mc, p.y - d * ms);
            taken.contains(&Vector2::new(c * q.x + s * q.y, -s * q.x + c * q.y))
        });
        count.count()
    };
    let far = FASTEST_M_S * dt;
    let turn = 0.6 * dt;
    let yaw_steps = 1 + 2 * ((turn / 0.006).ceil() as i32);
    let mut scores = Vec::new();
    let mut best = (0usize, 0.0, 0.0);
    let mut d = 0.0;
    while d <= far {
        let mut top = 0;
        for k in 0..yaw_steps {
            let yaw = turn * (2.0 * f64::from(k) / f64::from(yaw_steps - 1).max(1.0) - 1.0);
            let n = hits(d, yaw);
            top = top.max(n);
            if n > best.0 {
                best = (n, d, yaw);
            }
        }
        scores.push(top);
        d += 0.15;
    }
    scores.sort_unstable();
    let usual = scores[scores.len() / 2];
    // The right place must stand out from wrong ones.
    if best.0 < 12 || (best.0 as f64) < 1.35 * usual as f64 + 4.0 {
        return None;
    }
    let mut sum = [0.0; 3];
    for i in -4..=4 {
        for k in -4..=4 {
            let (d, yaw) = (best.1 + 0.05 * f64::from(i), best.2 + 0.0015 * f64::from(k));
            let weight = (hits(d, yaw) as f64 - 0.7 * best.0 as f64).max(0.0).powi(2);
            sum = [sum[0] + weight, sum[1] + weight * d, sum[2] + weight * yaw];
        }
    }
    Some(OwnMotion { speed_m_s: sum[1] / sum[0] / dt, yaw_rate_rad_s: sum[2] / sum[0] / dt })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn posts_tell_the_motion_and_walls_do_not() {
        let posts: Vec<Vector2<f64>> = (0..60)
            .map(|i| {
                Vector2::new(-60.0 + 2.2 * f64::from(i) + f64::from(i * i % 7) * 0.23, f64::from(i % 5) * 2.1 - 9.3)
            })
            .collect();
        let (d, yaw): (f64, f64) = (2.4, 0.012);
        let moved: Vec<Vector2<f64>> = posts
            .iter()
            .map(|p| {
                let (ms, mc) = (0.5 * yaw).sin_cos();
                let q = Vector2::new(p.x - d * mc, p.y - d * ms);
                Vector2::new(yaw.cos() * q.x + yaw.sin() * q.y, -yaw.sin() * q.x + yaw.cos() * q.y)
            })
            .collect();
        let motion = between(&posts, &moved, 0.05).unwrap();
        assert!((motion.speed_m_s - 48.0).abs() < 3.0 && (motion.yaw_rate_rad_s - 0.24).abs() < 0.1, "{motion:?}");
        // Each scan meets a wall at other places of it.
        let wall = |jitter: i32| -> Vec<Vector2<f64>> {
            (0..400).map(|i| Vector2::new(0.35 * f64::from(i) + 0.05 * f64::from(i * i % jitter) - 70.0, 8.0)).collect()
        };
        assert_eq!(between(&wall(7), &wall(5), 0.05), None);
    }
}
