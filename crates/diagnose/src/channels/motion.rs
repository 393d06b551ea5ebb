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

/// Speeds that are looked for: their number, and the step, m/s.
const SPEEDS: usize = 160;
const SPEED_M_S: f64 = 0.6;

/// Hardest that cars brake, m/s2.
const HARDEST_M_S2: f64 = 15.0;

/// Frames farther apart in time show other things, s.
const LONGEST_S: f64 = 0.6;

/// Fewer edges than that say nothing.
const FEWEST: usize = 40;

/// Frames that are held against one for what edges have in common wherever the car is, are at least so far from it in time, s.
const ELSEWHERE_S: f64 = 0.5;

/// Edges of a frame that are moved, at most.
const SOME: usize = 250;

/// Times what the best path through chance gains that the speeds must gain.
const STANDS_OUT: f64 = 1.25;

/// Number of the slowest speed that is looked for: the sensors' pattern stands still in the car's frame.
const SLOWEST: usize = 8;

/// The motion at each frame; `None` where the scene does not tell.
pub fn own_motion(frames: &[FramePair], times: &[f64], origins: &[Point3<f64>]) -> Vec<Option<OwnMotion>> {
    let seen = |f: &FramePair| {
        let edges = edges(f, origins);
        Seen { taken: Cells::new(&edges), edges }
    };
    let seen: Vec<Seen> = frames.par_iter().map(seen).collect();
    let pair = |i: usize| {
        // Of the frames in which nothing of this one stands where it stood, those that look most like it.
        let far = (0..frames.len()).filter(|&j| (times[j] - times[i]).abs() > ELSEWHERE_S);
        let mut far: Vec<&Seen> = far.map(|j| &seen[j]).collect();
        far.sort_by_cached_key(|other| std::cmp::Reverse(hits(&seen[i].edges, other, 0.0, 0.0) as usize));
        let [one, other, ..] = far[..] else { return None };
        Some(Pair::new(&seen[i], &seen[i + 1], [one, other], times[i + 1] - times[i]))
    };
    let pairs: Option<Vec<Pair>> = (0..frames.len().saturating_sub(1)).into_par_iter().map(pair).collect();
    let told = pairs.and_then(|pairs| speeds(&pairs).map(|speeds| (pairs, speeds)));
    let Some((pairs, speeds)) = told else { return vec![None; frames.len()] };
    let steps: Vec<Option<OwnMotion>> = pairs.par_iter().zip(speeds).map(|(pair, k)| pair.motion(k)).collect();
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

/// Edges seen from above, and the cells that they take.
struct Seen {
    edges: Vec<Vector2<f64>>,
    taken: Cells,
}

/// How many of some edges come to lie on edges of another frame if the car moves ahead by `d` and turns by `yaw` along its mean heading.
fn hits(some: &[Vector2<f64>], other: &Seen, d: f64, yaw: f64) -> f64 {
    let (s, c) = yaw.sin_cos();
    let (ms, mc) = (0.5 * yaw).sin_cos();
    let on = some.iter().filter(|p| {
        let q = Vector2::new(p.x - d * mc, p.y - d * ms);
        other.taken.contains(&Vector2::new(c * q.x + s * q.y, -s * q.x + c * q.y))
    });
    on.count() as f64
}

/// Two frames that follow one another, and others from elsewhere: the sensors' pattern stays where it is in the car's frame, and a wall looks like itself
/// wherever one is along it.
struct Pair<'a> {
    some: Vec<Vector2<f64>>,
    second: &'a Seen,
    elsewhere: [&'a Seen; 2],
    dt: f64,
    /// By speed: how many more edges of the first frame come to lie on those of the second than on those from elsewhere, at the best turn, and that turn; and
    /// how many more on those of one frame from elsewhere than on those of the other, which is chance.
    scores: Vec<[f64; 3]>,
}

impl<'a> Pair<'a> {
    fn new(first: &Seen, second: &'a Seen, elsewhere: [&'a Seen; 2], dt: f64) -> Self {
        let stride = first.edges.len().div_ceil(SOME);
        let some = first.edges.iter().step_by(stride.max(1)).copied().collect();
        let mut pair = Pair { some, second, elsewhere, dt, scores: vec![[0.0; 3]; SPEEDS] };
        if first.edges.len() >= FEWEST && second.edges.len() >= FEWEST && dt > 0.0 && dt < LONGEST_S {
            let yaw_steps = (0.6 * dt / 0.009).ceil() as i32;
            let yaws = (-yaw_steps..=yaw_steps).map(|k| 0.6 * dt * f64::from(k) / f64::from(yaw_steps.max(1)));
            let at = |k: usize| {
                let mut best = [f64::NEG_INFINITY, 0.0, f64::NEG_INFINITY];
                for yaw in yaws.clone() {
                    let [more, chance] = pair.more(SPEED_M_S * k as f64 * dt, yaw);
                    if more > best[0] {
                        (best[0], best[1]) = (more, yaw);
                    }
                    best[2] = best[2].max(chance);
                }
                best
            };
            pair.scores = (0..SPEEDS).map(at).collect();
        }
        pair
    }

    fn more(&self, d: f64, yaw: f64) -> [f64; 2] {
        let [on, one, other] = [self.second, self.elsewhere[0], self.elsewhere[1]].map(|s| hits(&self.some, s, d, yaw));
        [on - 0.5 * (one + other), one - other]
    }

    /// The motion about the speed number `k`; `None` where no edges tell.
    fn motion(&self, k: usize) -> Option<OwnMotion> {
        let [best, yaw, _] = self.scores[k];
        let mut sum = [0.0; 3];
        for i in -6..=6 {
            for j in -4..=4 {
                let (d, yaw) = (SPEED_M_S * k as f64 * self.dt + 0.05 * f64::from(i), yaw + 0.0015 * f64::from(j));
                let weight = (self.more(d, yaw)[0] - 0.7 * best).max(0.0).powi(2);
                sum = [sum[0] + weight, sum[1] + weight * d, sum[2] + weight * yaw];
            }
        }
        (best > 0.0 && sum[0] > 0.0)
            .then(|| OwnMotion { speed_m_s: sum[1] / sum[0] / self.dt, yaw_rate_rad_s: sum[2] / sum[0] / self.dt })
    }
}

/// Of every pair the number of the speed, so that the most edges come to lie on others and the car neither brakes nor accelerates harder than cars do. `None`
/// where chance finds such speeds as well, or all lie at the lower end: what moves with the car seems to stand.
fn speeds(pairs: &[Pair]) -> Option<Vec<usize>> {
    let (speeds, sum) = path(pairs, 0)?;
    let (_, by_chance) = path(pairs, 2)?;
    let usual = median(speeds.iter().map(|k| *k as f64).collect());
    (sum > STANDS_OUT * by_chance.max(1.0) && usual > SLOWEST as f64 + 2.0).then_some(speeds)
}

/// The path of speeds on which one of the scores has the largest sum, and that sum.
fn path(pairs: &[Pair], score: usize) -> Option<(Vec<usize>, f64)> {
    // Best sum that ends at each speed, and from where.
    let mut best: Vec<f64> = vec![0.0; SPEEDS];
    let mut from: Vec<Vec<usize>> = Vec::new();
    for pair in pairs {
        let reach = (HARDEST_M_S2 * pair.dt.abs() / SPEED_M_S).ceil().min(SPEEDS as f64) as usize;
        let before = |k: usize| {
            let near = k.saturating_sub(reach).max(SLOWEST)..(k + reach + 1).min(SPEEDS);
            near.max_by(|&a, &b| best[a].total_cmp(&best[b])).unwrap_or(SLOWEST)
        };
        let came: Vec<usize> = (0..SPEEDS).map(before).collect();
        // What all speeds have in common tells nothing.
        let middle = median(pair.scores[SLOWEST..].iter().map(|s| s[score]).collect());
        best = came.iter().zip(&pair.scores).map(|(&k, s)| best[k] + s[score] - middle).collect();
        from.push(came);
    }
    let last = (SLOWEST..SPEEDS).max_by(|&a, &b| best[a].total_cmp(&best[b]))?;
    let back = from.iter().rev().scan(last, |k, came| {
        let here = *k;
        *k = came[here];
        Some(here)
    });
    let mut speeds: Vec<usize> = back.collect();
    speeds.reverse();
    Some((speeds, best[last]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

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
        let seen = |edges: Vec<Vector2<f64>>| Seen { taken: Cells::new(&edges), edges };
        let mut rng = data::stream(0, "elsewhere", 0, 0);
        let mut scattered = |n: usize, across_m: f64| {
            let mut at = |half: f64| if half > 0.0 { rng.random_range(-half..half) } else { 8.0 };
            seen((0..n).map(|_| Vector2::new(at(70.0), at(across_m))).collect())
        };
        let (first, second) = (seen(posts), seen(moved));
        let [one, other] = [scattered(60, 10.0), scattered(60, 10.0)];
        let pair = Pair::new(&first, &second, [&one, &other], 0.05);
        let motion = pair.motion(speeds(std::slice::from_ref(&pair)).unwrap()[0]).unwrap();
        assert!((motion.speed_m_s - 48.0).abs() < 3.0 && (motion.yaw_rate_rad_s - 0.24).abs() < 0.1, "{motion:?}");
        // Each scan meets a wall at other places of it.
        let walls: Vec<Seen> = (0..12).map(|_| scattered(400, 0.0)).collect();
        let pair = |i: usize| Pair::new(&walls[i], &walls[i + 1], [&walls[(i + 5) % 12], &walls[(i + 7) % 12]], 0.25);
        assert_eq!(speeds(&(0..11).map(pair).collect::<Vec<_>>()), None);
    }
}
